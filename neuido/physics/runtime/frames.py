"""The result of a rollout: frames of the particles with their times, which can be unpacked, printed and saved."""

import functools
import os
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

import neuido
from neuido.physics.runtime import events
from neuido.physics.runtime.atomic_files import whole_file
from neuido.physics.runtime.events import Event, Marks
from neuido.types import Particles, ParticleState


class Frames(ParticleState):
    """K frames of P particles with their times; unpacks to x, v, C and F as a `ParticleState` does.

    Args:
        x: Position [m], (K, P, 3).
        v: Velocity [m/s], (K, P, 3).
        C: Affine velocity [1/s], (K, P, 3, 3).
        F: Elastic deformation gradient [-], (K, P, 3, 3).
        dt: Time between two frames [s], a number or one for each scene, (S,).
        particles: The scene of each particle; None: one scene.
        history: History of the effects, (K, P, width), with width 0 if no effect has one; None if the solver does not return it.
        marks: Record of det F in every step; None: `events` uses the frames alone.
        strain_limit: Largest logarithmic stretch for which the law is known; None: no limit.
        body: Index of each particle's body, (P,) int32; None: one body in each scene. In several scenes the bodies are counted on.
        body_names: Name of each body.
        skins: Surface meshes bound to the particles.
        colliders: What is drawn of the colliders: name, mesh or primitive, and poses.

    Attributes:
        dt: Time between two frames [s], (S,).
        particles: As given.
        history: As given.
        events: What makes the result doubtful, a tuple of `Event`.
    """

    dt: Tensor
    particles: Particles | None
    history: Tensor | None
    marks: Marks | None
    strain_limit: float | None
    body: Tensor | None
    body_names: tuple[str, ...]
    skins: tuple
    colliders: tuple

    def __new__(
        cls,
        x: Tensor,
        v: Tensor,
        C: Tensor,
        F: Tensor,
        dt: Tensor | Sequence[float] | float = 1.0,
        particles: Particles | None = None,
        history: Tensor | None = None,
        *,
        marks: Marks | None = None,
        strain_limit: float | None = None,
        body: Tensor | None = None,
        body_names: Sequence[str] = (),
        skins: Sequence = (),
        colliders: Sequence = (),
    ) -> "Frames":
        """Create frames; the class describes the arguments."""
        frames = super().__new__(cls, x, v, C, F)
        frames.dt = torch.as_tensor(dt, dtype=torch.float64).detach().cpu().reshape(-1)
        frames.particles, frames.history, frames.marks, frames.strain_limit = particles, history, marks, strain_limit
        frames.body, frames.body_names, frames.skins, frames.colliders = body, tuple(body_names), tuple(skins), tuple(colliders)
        return frames

    @classmethod
    def _make(cls, iterable: Iterable[Any]) -> ParticleState:  # type: ignore[override]  # called by `_replace`
        return ParticleState._make(iterable)

    @property
    def times(self) -> Tensor:
        """Time of each frame [s], (K,) float64, or (S, K) if the frame intervals of the scenes differ."""
        at = torch.arange(len(self.x), dtype=torch.float64)
        each = torch.unique(self.dt)
        return at * each if len(each) == 1 else self.dt[:, None] * at

    @functools.cached_property
    def events(self) -> tuple[Event, ...]:
        """Events that make the result doubtful: inverted or collapsed matter, and strains beyond the training of the law.

        They are computed at the first access. For frames of a simulator, inversion and collapse are those of every substep, else those
        of the frames. Strains are always those of the frames.
        """
        if self.F is None or not self.F.numel():
            return ()
        scene = torch.zeros(self.F.shape[1], dtype=torch.int32) if self.particles is None else self.particles.scene
        scene, each = scene.to(self.F.device), self.dt.tolist()
        each = each if len(each) > 1 else each * (int(scene.max()) + 1)
        marks = events.marks_of_frames(self.F, scene, each) if self.marks is None else self.marks
        beyond = [] if self.strain_limit is None else events.strain_events(self.F, self.strain_limit, scene, each)
        return (*marks.events(), *beyond)

    @property
    def forces(self) -> Tensor:
        """Force of the bodies on each solid collider, the mean since the frame before [N], (K, C, 3) float64.

        The C solids of all scenes are in the order of `colliders`, planes left out. Frame 0 has zeros. Differentiable.
        """
        return self._of_solids("force")

    @property
    def torques(self) -> Tensor:
        """Torque on each solid collider about its position, as `forces` [N m], (K, C, 3) float64."""
        return self._of_solids("torque")

    def _of_solids(self, what: str) -> Tensor:
        found = [t for t in (getattr(collider, what, None) for collider in self.colliders) if t is not None]
        if not found:
            return self.x.new_zeros(len(self.x), 0, 3, dtype=torch.float64)
        return torch.stack(found, dim=1)

    def __repr__(self) -> str:
        frames, count = self.x.shape[:2]
        scenes = 1 if self.particles is None else len(self.particles.offsets) - 1
        times = self.times[..., -1].reshape(-1)
        end = f"{float(times[0]):.4g} s" if len(times) == 1 else f"{float(times.min()):.4g} to {float(times.max()):.4g} s"
        failed = ~torch.isfinite(self.x[-1].detach()).all(dim=-1)
        word = f", {int(failed.sum())} particles not finite at the end" if bool(failed.any()) else ""
        plural = "" if scenes == 1 else "s"
        kind = f"{str(self.x.dtype).removeprefix('torch.')} on {self.x.device}"
        return f"Frames({frames} frames of {count} particles in {scenes} scene{plural}, the last at {end}, {kind}{word})"

    def save(self, path: str | os.PathLike) -> list[Path]:
        """Write the frames to a file; its extension selects the format. A file is complete or absent, never cut.

        Args:
            path: The file; missing folders are created. `.npz`: arrays x, v, C, F, times and scene (C and F if the motion has them),
                with body and body_names where there are several bodies; of skin i `skin_i_vertices`, `_faces`, `_indices` and `_weights`
                (`Skin`), and of collider i with a surface `collider_i_vertices` [m], `_faces` and `_poses`, (K, 4, 4); where there are
                solid colliders their `forces` [N], `torques` [N m] and `force_names`. `.ply`: one point cloud per frame,
                `NAME_0000.ply`, `NAME_0001.ply`, ..., with x, y, z [m] and vx, vy, vz [m/s]; other files of a series of that name are
                deleted. `.csv`: one row per frame and particle. Other endings, such as `.usd`, are those of `neuido.export`.

        Returns:
            The files that were written.

        Raises:
            UserError: Another extension, or a file that cannot be written.
        """
        path = Path(path)
        writers = {".npz": self._save_npz, ".ply": self._save_ply, ".csv": self._save_csv}
        if path.suffix.lower() not in writers:
            return [neuido.export(self, path)]  # by its public name: physics does not know the rooms above it
        return writers[path.suffix.lower()](path)

    def show(self, *, law: Any = None, scene: Any = None, colour: str | None = None, height: int = 480) -> Any:
        """Return a player of the motion for a notebook, which shows it where it is the last line of a cell; it needs no server.

        Args:
            law: Elastic law, for the colours of stress.
            scene: The scene of the frames, for floor and gravity.
            colour: Quantity by which particles are coloured, such as "speed" or "strain"; the first that there is where absent.
            height: Height of the player [px].

        Returns:
            The player; its `save` writes it as one HTML file.

        Raises:
            UserError: The extra `viewer` is missing, or the frames have no such quantity.
        """
        return neuido.show(self, law=law, scene=scene, colour=colour, height=height)

    def _scene(self) -> np.ndarray:
        """Return the scene of each particle, (P,)."""
        return np.zeros(self.x.shape[1], np.int32) if self.particles is None else self.particles.scene.cpu().numpy()

    def _save_npz(self, path: Path) -> list[Path]:
        arrays: dict[str, Any] = {name: t.detach().cpu().numpy() for name, t in zip(self._fields, self) if t is not None}
        if self.body is not None:
            arrays |= {"body": self.body.cpu().numpy(), "body_names": np.array(self.body_names)}
        for i, skin in enumerate(self.skins):
            arrays |= {f"skin_{i}_{name}": part.cpu().numpy() for name, part in zip(skin._fields, skin)}
        for i, collider in enumerate(self.colliders):
            if collider.mesh is not None:
                parts = collider.mesh._asdict() | {"poses": collider.poses.detach().cpu().numpy()}
                arrays |= {f"collider_{i}_{name}": part for name, part in parts.items()}
        if self.forces.shape[1]:
            arrays |= {"forces": self.forces.detach().cpu().numpy(), "torques": self.torques.detach().cpu().numpy()}
            arrays |= {"force_names": np.array([collider.name for collider in self.colliders if collider.force is not None])}
        with whole_file(path) as hidden, open(hidden, "wb") as file:
            np.savez_compressed(file, times=self.times.numpy(), scene=self._scene(), **arrays)
        return [path]

    def _save_ply(self, path: Path) -> list[Path]:
        rows = torch.cat([self.x, self.v], dim=-1).detach().cpu().numpy().astype("<f4")
        columns = "".join(f"property float {name}\n" for name in ("x", "y", "z", "vx", "vy", "vz"))
        head = f"ply\nformat binary_little_endian 1.0\nelement vertex {rows.shape[1]}\n{columns}end_header\n".encode("ascii")
        digits = max(4, len(str(len(rows) - 1)))
        written = [path.with_name(f"{path.stem}_{k:0{digits}d}{path.suffix}") for k in range(len(rows))]
        for own, row in zip(written, rows):
            with whole_file(own) as hidden:
                hidden.write_bytes(head + row.tobytes())
        series = re.compile(re.escape(path.stem) + r"_\d{4,}" + re.escape(path.suffix))
        for old in path.parent.iterdir():
            if series.fullmatch(old.name) and old not in written:
                old.unlink()
        return written

    def _save_csv(self, path: Path) -> list[Path]:
        times, scene = self.times.expand(len(self.dt), -1) if self.times.ndim == 1 else self.times, self._scene()
        rows = torch.cat([self.x, self.v], dim=-1).detach().cpu().double().numpy()
        with whole_file(path) as hidden, open(hidden, "w") as file:
            file.write("frame,time [s],scene,particle,x [m],y [m],z [m],vx [m/s],vy [m/s],vz [m/s]\n")
            for k, frame in enumerate(rows):
                for p, row in enumerate(frame):
                    at = float(times[min(int(scene[p]), len(times) - 1), k])
                    file.write(f"{k},{at:.9g},{scene[p]},{p}," + ",".join(f"{value:.9g}" for value in row) + "\n")
        return [path]
