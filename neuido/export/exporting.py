"""Motion of particles as files that other programs read; the ending of the file selects the format."""

import os
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from neuido.errors import PlausibilityWarning, UserError, suggest
from neuido.physics.laws.base import ElasticLaw
from neuido.types import Cameras, Gaussians, Scene

FORMATS = {
    ".npz": "NumPy archive",
    ".ply": "PLY sequence",
    ".csv": "table",
    ".usd": "USD",
    ".usdc": "USD, binary",
    ".usda": "USD, text",
    ".glb": "glTF, binary",
    ".gltf": "glTF",
    ".pvd": "VTK series",
    ".abc": "Alembic",
}
"""Endings and what they stand for."""
PARTICLES_ALONE = (".npz", ".csv")
"""Formats that hold the particles and nothing else."""
DRAWN = (".usd", ".usdc", ".usda", ".glb", ".gltf", ".abc")
"""Formats of programs that draw; in the others a solid keeps its vertices as they are, connected."""


def export(
    frames: Any,
    path: str | os.PathLike,
    *,
    frame_interval: float | None = None,
    every: int = 1,
    law: ElasticLaw | Sequence[ElasticLaw] | None = None,
    scene: Scene | None = None,
    surface: bool = False,
    surface_spacing: float | None = None,
    gaussians: Gaussians | None = None,
    cameras: Cameras | None = None,
    speed: float = 1.0,
    progress: bool = False,
) -> Path:
    """Write the frames of a rollout; the extension of the file selects the format (`Frames.save`).

    Written are the particles with velocities and fields (volume ratio, strain, stress, body), the skins and colliders that the frames have,
    and what the options add. Positions are in metres. docs/howto/export.md says what each format holds and which programs open it.

    Args:
        frames: `Frames`, or another motion with positions x [m] and velocities v [m/s], (K, P, 3); C, F and times [s] are optional.
        path: `.npz`: one archive of all arrays. `.csv`: one row for each frame and particle. `.ply`: a sequence `NAME_0000.ply`, ...,
            with an index `NAME.json`. `.usd`, `.usdc`, `.usda`: a USD stage. `.glb`, `.gltf`: a glTF scene. `.pvd`: a VTK series. `.abc`:
            an Alembic archive.
        frame_interval: Time between two frames [s], for a motion without times.
        every: Write every so many frames.
        law: Elastic law of one scene, or one of each body in their order, from which the field `stress` is computed.
        scene: The scene, for its planes and the direction of gravity.
        surface: Whether the surface of each body is reconstructed in each frame.
        surface_spacing: Distance between neighbouring particles of the surface [m]; found in the first frame where absent.
        gaussians: Gaussians at the first frame, which move with the particles (.ply, .usd).
        cameras: Cameras that are written with the motion (.usd, .glb).
        speed: Speed at which it plays (.usd, .glb, .abc): 0.1 is ten times slower than it happened.
        progress: Whether progress is shown on stderr.

    Returns:
        The file; for a sequence, its first file.

    Raises:
        UserError: An unknown extension, a wrong shape, times that are missing or unevenly spaced, an option that the format has no place
            for, or a library that is not installed.
    """
    from neuido.physics.runtime.frames import Frames

    target = Path(path).expanduser()
    ending = target.suffix.lower()
    if ending not in FORMATS:
        close = suggest(ending, FORMATS) or ";"
        raise UserError(f"path = {path}{close} its ending must be one of {', '.join(f'{end} ({what})' for end, what in FORMATS.items())}")
    if not 0 < speed < float("inf"):
        raise UserError(f"speed is {speed:g}; it must be positive, 1 for real time")
    laws = () if law is None else tuple(law) if isinstance(law, Sequence) else (law,)
    given = {"surface": surface, "gaussians": gaussians is not None, "cameras": cameras is not None, "law": bool(laws)}
    _check_places(ending, given)
    if not isinstance(frames, Frames):
        frames = _as_frames(frames, ending, frame_interval)
    if ending in PARTICLES_ALONE:
        return _thinned(frames, every).save(target)[0]
    made = _collected(frames, every, laws, scene, surface, surface_spacing, gaussians, cameras, progress)
    if ending in DRAWN:
        _sharpen(made.colliders)
    written = _write(target, ending, made, speed, progress)
    for note in made.notes:
        warnings.warn(note, PlausibilityWarning, stacklevel=2)
    return written[0]


def _sharpen(solids: Sequence[Any]) -> None:
    from neuido.export.exchange import with_edges

    for solid in solids:
        solid.vertices, solid.faces, solid.normals = ([part] for part in with_edges(solid.vertices[0], solid.faces[0]))


def _check_places(ending: str, given: dict[str, bool]) -> None:
    """Refuse what a format has no place for."""
    lacks = {end: ("surface", "gaussians", "cameras", "law") for end in PARTICLES_ALONE}
    lacks |= {".ply": ("cameras",), ".pvd": ("cameras", "gaussians"), ".abc": ("cameras", "gaussians")}
    lacks |= dict.fromkeys((".glb", ".gltf"), ("gaussians",))
    for name in lacks.get(ending, ()):
        if given[name]:
            other = [end for end in (".usd", ".ply", ".glb", ".pvd") if name not in lacks.get(end, ())]
            raise UserError(f"{name} has no place in {ending} files: leave it out, or export to {' or '.join(other[:2])}")


def _collected(
    frames: Any,
    every: int,
    laws: Sequence[ElasticLaw],
    scene: Scene | None,
    surface: bool,
    surface_spacing: float | None,
    gaussians: Gaussians | None,
    cameras: Cameras | None,
    progress: bool,
) -> Any:
    """Collect what is written."""
    from neuido.export.exchange import exchange_of
    from neuido.export.particle_fields import add_fields
    from neuido.export.reconstruction import reconstruct_surface
    from neuido.export.splats import MovingSplats

    made = exchange_of(frames, every=every, scene=scene)
    add_fields(made, laws)
    if surface:
        own = [reconstruct_surface(made, part, i, spacing=surface_spacing, progress=progress) for i, part in enumerate(made.parts)]
        made.surfaces = (*made.surfaces, *own)
    if gaussians is not None:
        if made.F is None:
            raise UserError("the motion has no deformation gradient F, with which the Gaussians could deform: leave out gaussians")
        made.gaussians = MovingSplats(gaussians, made.x, made.F)
    if cameras is not None:
        from neuido.data.cameras import refuse_moving

        refuse_moving(cameras, "the recording", "only fixed ones are written; leave --cameras out, or give cameras.at(frame)")
    made.cameras = cameras
    return made


def _write(target: Path, ending: str, made: Any, speed: float, progress: bool) -> list[Path]:
    if ending.startswith(".usd"):
        from neuido.export.usd_stage import write_usd

        return write_usd(target, made, speed=speed, progress=progress)
    if ending in (".glb", ".gltf"):
        from neuido.export.gltf_scene import write_gltf

        return write_gltf(target, made, speed=speed, progress=progress)
    if ending == ".abc":
        from neuido.export.alembic_archive import write_alembic

        return write_alembic(target, made, speed=speed, progress=progress)
    if ending == ".pvd":
        from neuido.export.vtk_series import write_vtk

        return write_vtk(target, made, progress=progress)
    from neuido.export.series import write_ply

    return write_ply(target, made, progress=progress)


def _thinned(frames: Any, every: int) -> Any:
    """Return every so many frames."""
    if every < 1:
        raise UserError(f"every is {every}; it must be a positive whole number")
    if every == 1:
        return frames
    from neuido.physics.runtime.frames import Frames

    parts = [None if part is None else part[::every] for part in (*frames, frames.history)]
    named = {name: getattr(frames, name) for name in ("body", "body_names", "skins", "colliders")}
    return Frames(*parts[:4], frames.dt * every, frames.particles, parts[4], **named)  # type: ignore[arg-type]


def _as_frames(motion: Any, ending: str, frame_interval: float | None) -> Any:
    """Return a motion of any type as `Frames`."""
    import torch

    from neuido.physics.runtime.frames import Frames

    names = ("x", "v", "C", "F")
    parts = [None if getattr(motion, name, None) is None else torch.as_tensor(getattr(motion, name)) for name in names]
    for name, part in zip(names[:2], parts):
        if part is None or part.ndim != 3 or part.shape[-1] != 3:
            found = "absent" if part is None else f"of shape {tuple(part.shape)}"
            raise UserError(f"frames.{name} is {found}; a motion has positions x and velocities v of shape (K, P, 3)")
    times = getattr(motion, "times", None)
    if frame_interval is None and times is not None and len(times) > 1:
        steps = torch.as_tensor(np.asarray(times), dtype=torch.float64).diff()
        frame_interval = float(steps.mean())
        if not bool(((steps - frame_interval).abs() <= 1e-3 * abs(frame_interval)).all()):
            raise UserError(f"frames.times are {float(steps.min()):g} to {float(steps.max()):g} s apart; export needs even times")
    if frame_interval is None and ending != ".ply" and len(parts[0]) > 1:  # type: ignore[arg-type]
        raise UserError("frames have no times: give export the frame_interval [s]")
    named = {name: value for name in ("body", "body_names", "skins", "colliders") if (value := getattr(motion, name, None)) is not None}
    return Frames(*parts, dt=frame_interval or 0.0, **named)  # type: ignore[arg-type]
