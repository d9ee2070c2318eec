"""Clamps of an experiment that move as measured, or whose force on the body was measured: read, checked and written."""

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.integrate import cumulative_trapezoid
from torch import Tensor

from neuido.data.bodies import scene_files as scenes
from neuido.data.files.values import check_keys, file_name, mapping, number
from neuido.data.files.writing import write_text
from neuido.data.measured.columns import check_increasing, named_columns
from neuido.errors import PlausibilityWarning, UserError
from neuido.physics.colliders.solid_tables import path_poses, rotate
from neuido.physics.colliders.solids import Grip
from neuido.types import Attachment, Box, Keyframes, Scene

PLACE, TURN, FORCE = ("x", "y", "z"), ("qw", "qx", "qy", "qz"), ("fx", "fy", "fz")
"""Columns of a table of poses, and of one of forces."""
STILL = (1.0, 0.0, 0.0, 0.0)
ASTRAY = 0.2
"""Distance of a tracked point from where its clamp carries it, relative to the largest motion of the clamp, from which on it is odd."""

MOST = 0.9
"""Quantile of these distances that counts: a few lost points make single ones larger."""


@dataclass(frozen=True, eq=False)
class MeasuredForce:
    """The force of a clamp on the body, as a load cell measured it."""

    t: np.ndarray
    """Times [s], (n,), increasing."""
    values: np.ndarray
    """Force [N], (n, 3), positive along the axes of the scene; NaN where it was not measured."""
    noise: float | None = None
    """Standard deviation of the noise of one value [N]; None if unknown."""

    def means(self, edges: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the mean force between successive times of `edges` (m + 1,) [s], (m, 3) [N], and the number of values in each, (m, 3)."""
        out, counts = np.full((len(edges) - 1, 3), np.nan), np.zeros((len(edges) - 1, 3))
        for axis in range(3):
            seen = np.isfinite(self.values[:, axis])
            if not seen.any():
                continue
            t, force = self.t[seen], self.values[seen, axis]
            every = np.union1d(t, edges)
            impulse = cumulative_trapezoid(np.interp(every, t, force), every, initial=0.0)
            own = np.diff(np.interp(edges, every, impulse)) / np.diff(edges)
            inside = (edges[:-1] >= t[0] - 1e-9) & (edges[1:] <= t[-1] + 1e-9)
            out[inside, axis] = own[inside]
            counts[:, axis] = np.histogram(t, edges)[0]
        return out, counts


@dataclass(frozen=True, eq=False)
class Clamp:
    """A part of the body that is held, on a measured path or with a measured force."""

    name: str
    box: Box
    """The particles at t = 0 that are held."""
    motion: Keyframes | None = None
    """Poses of the clamp; only their change from t = 0 on moves the body. None: at rest."""
    force: MeasuredForce | None = None
    """The force on the body; None: not measured."""


def held_scene(scene: Scene, clamps: Sequence[Clamp]) -> Scene:
    """Return a scene in which the clamps hold their particles: each is a `Grip` with an `Attachment`."""
    grips = tuple(Grip(name=clamp.name, path=clamp.motion) for clamp in clamps)
    held = tuple(Attachment(clamp.box, clamp.name) for clamp in clamps)
    return replace(scene, colliders=(*scene.colliders, *grips), attachments=(*scene.attachments, *held))


def split_clamps(scene: Any) -> tuple[dict[str, Any], dict[str, Box]]:
    """Return the key `scene` without the clamps that have a name, and the boxes of those by their names.

    Raises:
        UserError: A name that is none, or that stands twice.
    """
    scene = mapping(scene, "scene")
    given = scene.get("clamps")
    if not isinstance(given, list):
        return scene, {}
    named: dict[str, Box] = {}
    rest = []
    for i, entry in enumerate(given):
        if not isinstance(entry, Mapping) or "name" not in entry:
            rest.append(entry)
            continue
        where = f"scene.clamps[{i}]"
        name = file_name(entry["name"], f"{where}.name")
        if name in named or ":" in name:
            raise UserError(f"{where}.name = {name!r} is the name of another clamp, or has a colon: rename it")
        named[name] = scenes.box_from_dict({key: value for key, value in entry.items() if key != "name"}, where)
    return scene | {"clamps": rest}, named


def read_clamps(given: Any, boxes: Mapping[str, Box], folder: Path, where: str) -> tuple[Clamp, ...]:
    """Read the key `clamps` of a recording: files with the motion and the force of each clamp that has a name.

    Args:
        given: The key; None where it is absent.
        boxes: Boxes of the clamps by name.
        folder: The folder of the experiment.
        where: Name of the recording in error messages.

    Raises:
        UserError: An unknown clamp or column, a missing file, or values that are impossible.
    """
    given = mapping({} if given is None else given, f"{where}.clamps")
    out = [Clamp(name, box) for name, box in boxes.items() if name not in given]
    for name, entry in given.items():
        at = f"{where}.clamps.{name}"
        if name not in boxes:
            raise UserError(f"{at}: scene.clamps has no clamp of that name; it has {', '.join(boxes) or 'none with a name'}")
        check_keys(entry, at, ("motion", "force", "noise"), ("motion", "force", "noise"))
        motion = None if entry.get("motion") is None else _motion(folder, entry["motion"], f"{at}.motion")
        noise = None if entry.get("noise") is None else number(entry["noise"], f"{at}.noise", above=0.0)
        force = None if entry.get("force") is None else _force(folder, entry["force"], f"{at}.force", noise)
        if noise is not None and force is None:
            raise UserError(f"{at}.noise is that of a force, and there is none: give `force`")
        out.append(Clamp(name, boxes[name], motion, force))
    return tuple(sorted(out, key=lambda clamp: list(boxes).index(clamp.name)))


def _motion(folder: Path, file: Any, where: str) -> Keyframes:
    columns, _ = named_columns(folder, file, where, ("t", *PLACE), TURN)
    lacking = next((title for title, own in columns.items() if not np.isfinite(own).all()), None)
    if lacking is not None:
        raise UserError(f"{where}: {lacking} is empty in data row {int(np.argmax(~np.isfinite(columns[lacking])))}: a path has no gaps")
    if 0 < sum(title in columns for title in TURN) < 4:
        raise UserError(f"{where}: a rotation is a quaternion of four columns, {', '.join(TURN)}; give all or none")
    t = check_increasing(columns["t"], where)
    if len(t) < 2:
        raise UserError(f"{where} has one row; a path needs two or more")
    turns = None
    if "qw" in columns:
        turned = np.stack([columns[title] for title in TURN], 1)
        length = np.linalg.norm(turned, axis=1)
        if not np.allclose(length, 1.0, atol=0.01):
            raise UserError(f"{where}: the quaternion in data row {int(np.abs(length - 1).argmax())} does not have the length 1")
        turns = tuple(map(tuple, (turned / length[:, None]).tolist()))
    places = np.stack([columns[title] for title in PLACE], 1)
    return Keyframes(tuple(t.tolist()), tuple(map(tuple, places.tolist())), turns, smooth=True)  # type: ignore[arg-type]


def _force(folder: Path, file: Any, where: str, noise: float | None) -> MeasuredForce:
    columns, _ = named_columns(folder, file, where, ("t",), FORCE)
    if not np.isfinite(columns["t"]).all():
        raise UserError(f"{where}: a time is empty")
    t = check_increasing(columns["t"], where)
    values = np.stack([columns.get(title, np.full(len(t), np.nan)) for title in FORCE], 1)
    if not np.isfinite(values).any():
        raise UserError(f"{where} has no force: title its columns {', '.join(FORCE)} [N]")
    return MeasuredForce(t, values, noise)


def check_clamps(clamps: Sequence[Clamp], scene: Scene, fields: Mapping[str, Any], where: str) -> None:
    """Check that motions and forces go with the frames of a recording, and warn where tracked points do not follow their clamp.

    Args:
        clamps: The clamps.
        scene: The scene, without them.
        fields: `body`, and where points were tracked `x`, `t`, and `track` or `anchor`.
        where: Name of the recording in messages.

    Raises:
        UserError: A clamp without particles, a path that does not cover the frames, or one that leaves the domain.
        PlausibilityWarning: Tracked points in a clamp do not move with it.
    """
    size = max(u - l for l, u in zip(scene.lower, scene.upper))
    for clamp in clamps:
        at = f"{where}.clamps.{clamp.name}"
        if not bool(_inside(clamp.box, fields["body"].x).any()):
            raise UserError(f"{at}: its box holds no particle of x0")
        end = float(fields["t"][-1]) if fields.get("t") is not None else 0.0
        if clamp.force is not None and not (clamp.force.t < end).sum() - (clamp.force.t <= 0).sum() >= 3:
            raise UserError(f"{at}.force has fewer than three values during the frames, which end at {end:g} s: is its time in s?")
        if clamp.motion is None:
            continue
        t, places = np.array(clamp.motion.times), np.array(clamp.motion.positions)
        if t[0] > 1e-9 or t[-1] < end * (1 - 1e-6):
            raise UserError(f"{at}.motion is known from {t[0]:g} to {t[-1]:g} s, and the frames are from 0 to {end:g} s: give all of it")
        moved = float(np.linalg.norm(places - places[0], axis=1).max())
        if moved > size:
            raise UserError(f"{at}.motion: the clamp moves by {moved:g} m, and the domain is {size:g} m large: give it in m")
        _follows(clamp, fields, moved, at)


def _follows(clamp: Clamp, fields: Mapping[str, Any], moved: float, where: str) -> None:
    """Warn where tracked points in a clamp do not move with it."""
    x, t = fields.get("x"), fields.get("t")
    if x is None or t is None or moved == 0.0:
        return
    anchor = fields.get("anchor")
    track = fields.get("track")
    start = anchor if anchor is not None else torch.where((track >= 0)[:, None], fields["body"].x[track.clamp(min=0)], torch.nan)
    held = _inside(clamp.box, start)
    if not bool(held.any()):
        return
    distance = (x[:, held].double() - carried(clamp, start[held].double(), t.numpy())).norm(dim=2).numpy()
    seen = distance[np.isfinite(distance)]
    worst = float(np.quantile(seen, MOST)) if len(seen) else 0.0
    if worst > ASTRAY * moved:
        warnings.warn(
            f"{where}.motion: tracked points in the clamp are {worst:.3g} m from where it carries them, and it moves by {moved:.3g} m: "
            "are its axes, unit and clock those of the points?",
            PlausibilityWarning,
            stacklevel=2,
        )


def carried(clamp: Clamp, start: Tensor, t: np.ndarray) -> Tensor:
    """Return where a clamp carries points that are at `start` (N, 3) [m] at t = 0, at the times t (T,) [s], (T, N, 3)."""
    if clamp.motion is None:
        return start.expand(len(t), *start.shape)
    poses = torch.from_numpy(path_poses(clamp.motion, STILL, np.concatenate([[0.0], t])))
    back = poses[0, 3:] * torch.tensor([1.0, -1.0, -1.0, -1.0], dtype=torch.float64)
    own = rotate(back.expand(len(start), 4), start - poses[0, :3])
    turns = poses[1:, None, 3:].expand(-1, len(start), 4)
    return poses[1:, None, :3] + rotate(turns, own.expand(len(t), *own.shape))


def _inside(box: Box, x: Tensor) -> Tensor:
    return ((x >= x.new_tensor(box.lower)) & (x <= x.new_tensor(box.upper))).all(dim=1)


def clamp_entries(clamps: Sequence[Clamp]) -> list[dict[str, Any]]:
    """Return the entries of clamps with a name in `scene.clamps`."""
    return [{"box": [list(clamp.box.lower), list(clamp.box.upper)], "name": clamp.name} for clamp in clamps]


def write_clamps(clamps: Sequence[Clamp], folder: Path, recording: str) -> dict[str, Any]:
    """Write motions and forces into the folder of a recording, and return its key `clamps`.

    Args:
        clamps: The clamps.
        folder: The folder of the experiment.
        recording: Name of the recording.
    """
    out: dict[str, Any] = {}
    for clamp in clamps:
        entry: dict[str, Any] = {}
        if clamp.motion is not None:
            entry["motion"] = f"{recording}/{clamp.name}_motion.csv"
            parts = [np.array(clamp.motion.times)[:, None], np.array(clamp.motion.positions)]
            parts += [] if clamp.motion.rotations is None else [np.array(clamp.motion.rotations)]
            _write(folder / entry["motion"], ("t", *PLACE, *(TURN if clamp.motion.rotations is not None else ())), np.concatenate(parts, 1))
        if clamp.force is not None:
            entry["force"] = f"{recording}/{clamp.name}_force.csv"
            kept = np.isfinite(clamp.force.values).any(0)
            titles = [title for title, wanted in zip(FORCE, kept) if wanted]
            _write(folder / entry["force"], ("t", *titles), np.concatenate([clamp.force.t[:, None], clamp.force.values[:, kept]], 1))
            if clamp.force.noise is not None:
                entry["noise"] = clamp.force.noise
        if entry:
            out[clamp.name] = entry
    return out


def _write(path: Path, titles: Sequence[str], rows: np.ndarray) -> None:
    lines = [",".join("nan" if np.isnan(value) else f"{value:.10g}" for value in row) for row in rows]
    write_text(path, "\n".join([",".join(titles), *lines]) + "\n")
