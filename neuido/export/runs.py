"""Read a run that is to be exported: frames of a simulation, a prediction or a diagnosis. The files are not trusted."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import torch

from neuido.data.files.parsing import naming, read_arrays, read_json, read_yaml
from neuido.data.formats.frame_files import numbered_files, picked, read_frame_arrays, read_frame_times, read_surfaces
from neuido.data.formats.ply import read_ply_vertices
from neuido.errors import UserError
from neuido.models.inference.simulated_run import are_uniform, scene_and_laws
from neuido.types import Scene, Skin

KINDS = "a folder of `neuido simulate`, `neuido predict` or `neuido diagnose`, or a file of frames (.npz)"


class Run(NamedTuple):
    """A motion to export."""

    motion: SimpleNamespace
    """Positions x, velocities v, perhaps F, body and body_names, and times [s], as NumPy arrays."""
    what: str
    """What it is, for the message."""
    scene: Scene | None = None
    laws: tuple[Any, ...] = ()
    """Elastic law of all bodies, or of each; none where they are not known or vary within a body."""
    notes: tuple[str, ...] = ()


def read_run(source: str | Path, *, recording: str | None = None, when: str = "after", frame_interval: float | None = None) -> Run:
    """Read a motion.

    Args:
        source: The folder or file.
        recording: Name of the recording or scene, where there are several; the first where absent.
        when: Which motion of a diagnosis: `measured`, `before` or `after`.
        frame_interval: Time between two frames [s], for a motion without times.

    Raises:
        UserError: There is no motion, or a file is damaged.
    """
    place = Path(source).expanduser()
    if not place.exists():
        raise UserError(f"{source} is missing: give {KINDS}")
    if place.is_file() and place.suffix.lower() == ".npz":
        return _frames(place, frame_interval)
    if place.is_file():
        raise UserError(f"{source} is no motion: give {KINDS}")
    if (place / "diagnosis.json").is_file():
        return _diagnosis(place, recording, when)
    if (place / "frames.npz").is_file():
        return _frames(place / "frames.npz", frame_interval)
    return _prediction(place, recording, frame_interval)


def elastic_law(path: Path) -> Any:
    """Return the elastic law of a scene or model file, or of a law file of `neuido predict`.

    Raises:
        UserError: There is no law.
    """
    from neuido.models.inference.law_file import load_law
    from neuido.physics.laws.classical import material

    if path.suffix == ".safetensors":
        return load_law(path)[0]
    content = read_yaml(path)
    model = content.get("model", content)
    with naming(path):
        if not isinstance(model, dict) or not isinstance(model.get("elasticity"), dict):
            raise UserError(f"law = {path} has no model with an elasticity")
        return material(model["elasticity"])[0]


def _frames(path: Path, frame_interval: float | None) -> Run:
    arrays = read_frame_arrays(path)
    x, times = arrays["x"], arrays.get("times", arrays.get("t"))
    if times is not None and times.shape != (len(x),):
        raise UserError(f"{path}: times have the shape {times.shape} for {len(x)} frames of one scene: export each scene of its own")
    times = _times(times, len(x), frame_interval, path)
    own: dict[str, Any] = {name: arrays[name] for name in ("C", "F", "body") if name in arrays}
    if "body" not in own and "scene" in arrays and arrays["scene"].max() > 0:
        own["body"] = arrays["scene"]
    if "body_names" in arrays:
        own["body_names"] = tuple(str(name) for name in arrays["body_names"])
    bound, moved = read_surfaces(arrays, path)
    skins = tuple(Skin(**{part: torch.from_numpy(np.ascontiguousarray(values)) for part, values in each.items()}) for each in bound)
    colliders = tuple(
        SimpleNamespace(name=f"collider_{i}", mesh=SimpleNamespace(vertices=each["vertices"], faces=each["faces"]), poses=each["poses"])
        for i, each in enumerate(moved)
    )
    v = arrays["v"] if "v" in arrays else _velocities(x, times)
    motion = SimpleNamespace(x=x, v=v, times=times, skins=skins, colliders=colliders, **own)
    scene, laws = scene_and_laws(path.parent)
    if len(laws) > 1 and "body" not in own:
        laws = ()
    return Run(motion, path.parent.name if path.name == "frames.npz" else path.stem, scene, laws if are_uniform(laws) else ())


def _times(given: np.ndarray | None, frames: int, interval: float | None, place: Path) -> np.ndarray:
    if interval is not None:
        if not 0 < interval < np.inf:
            raise UserError(f"frame_interval is {interval:g}; it must be a positive number of seconds")
        return interval * np.arange(frames)
    if given is None and frames > 1:
        raise UserError(f"{place} has no times: give --frame_interval, in s")
    return np.zeros(1) if given is None else given.astype(np.float64)


def _velocities(x: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Return velocities by differences of the positions."""
    return np.zeros_like(x) if len(x) < 2 else np.gradient(x.astype(np.float64), times, axis=0).astype(np.float32)


def _prediction(folder: Path, recording: str | None, interval: float | None) -> Run:
    """Read the PLY files of particles that `neuido predict` wrote, of one scene."""
    notes: tuple[str, ...] = ()
    own = next((each for each in (folder / "particles", folder) if each.is_dir() and numbered_files(each)), None)
    if own is None:
        names = sorted(path.parent.name for path in folder.glob("*/particles") if numbered_files(path))
        if not names:
            raise UserError(f"{folder} holds no motion: give {KINDS}")
        own = folder / picked(names, recording, folder) / "particles"
        notes = _others(names, recording)
    paths = numbered_files(own)
    tables = [read_ply_vertices(path) for path in paths]
    if len({len(table) for table in tables}) > 1:
        raise UserError(f"{own}: the files have different numbers of particles: give a folder of one motion")
    for name in ("x", "y", "z"):
        if name not in (tables[0].dtype.names or ()):
            raise UserError(f"{paths[0]} has no points: its vertices lack the column {name}")
    times = _times(read_frame_times(own, len(paths)), len(paths), interval, own)

    def columns(*names: str) -> np.ndarray:
        return np.stack([np.stack([table[name].astype(np.float32) for name in names], axis=1) for table in tables])

    x = columns("x", "y", "z")
    moving = all(name in (tables[0].dtype.names or ()) for name in ("vx", "vy", "vz"))
    v = columns("vx", "vy", "vz") if moving else _velocities(x, times)
    return Run(SimpleNamespace(x=x, v=v, times=times), own.parent.name, notes=notes)


def _others(names: list[str], wanted: str | None) -> tuple[str, ...]:
    return (f"one of {len(names)}: --recording chooses from {', '.join(names)}",) if len(names) > 1 and wanted is None else ()


def _diagnosis(folder: Path, recording: str | None, when: str) -> Run:
    """Read the motion of a diagnosis of a body or a track, from its predictions."""
    found: dict[str, dict[str, np.ndarray]] = {}
    for path in sorted((folder / "predicted").glob("*.npz")):
        arrays = read_arrays(path, None, what="file of predictions")
        if "t" in arrays and all(each in arrays and arrays[each].ndim == 3 for each in ("measured", "before")):
            found[path.stem] = arrays
    if not found:
        raise UserError(f"{folder} is a diagnosis without a motion in space: --to abaqus|ansys|febio|mujoco exports its law")
    chosen = picked(list(found), recording, folder)
    arrays = found[chosen]
    if when not in arrays:
        raise UserError(
            f"when = {when}: the diagnosis of {chosen} has {', '.join(w for w in ('measured', 'before', 'after') if w in arrays)}"
        )
    x, times = arrays[when].astype(np.float32), arrays["t"].astype(np.float64)
    seen = np.isfinite(x).all(axis=(0, 2))
    if not seen.any():
        raise UserError(f"no point of {chosen} was seen in all frames: export --when before or after")
    notes = _others(list(found), recording)
    notes += (f"{int((~seen).sum())} points that were not seen in all frames are left out",) if not seen.all() else ()
    name = read_json(folder / "diagnosis.json").get("experiment", folder.name)
    motion = SimpleNamespace(x=x[:, seen], v=_velocities(x[:, seen], times), times=times)
    return Run(motion, f"{name}, {chosen}, {when}", notes=notes)
