"""Read a run that is to be exported: frames of a simulation, a prediction or a diagnosis. The files are not trusted."""

import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import torch

from neuido.data.files.parsing import naming, read_arrays, read_json, read_yaml
from neuido.data.formats.ply import read_ply_vertices
from neuido.errors import UserError, suggest
from neuido.types import Scene, Skin

KINDS = "a folder of `neuido simulate`, `neuido predict` or `neuido diagnose`, or a file of frames (.npz)"
SCENE, LAW = "scene.yaml", "law.safetensors"
"""Files beside the frames of a simulation: its scene with the model, and a learned law."""


SURFACES = {"skin": ("vertices", "faces", "indices", "weights"), "collider": ("vertices", "faces", "poses")}
"""Arrays of each skin and collider in a file of frames, as `Frames.save` names them."""
MOST_SURFACES = 64
"""Skins, and colliders, of a file that are read."""


class Run(NamedTuple):
    """A motion to export."""

    motion: SimpleNamespace
    """Positions x, velocities v, perhaps F, body and body_names, and times [s], as NumPy arrays."""
    what: str
    """What it is, for the message."""
    scene: Scene | None = None
    law: Any = None
    """Elastic law of the simulation; None where it is not known."""
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
    kept = [f"{kind}_{i}_{part}" for kind, parts in SURFACES.items() for i in range(MOST_SURFACES) for part in parts]
    optional = ("v", "C", "F", "times", "scene", "body", "body_names", *kept)
    arrays = read_arrays(path, ("x",), optional, what="file of frames with positions x")
    x = arrays["x"]
    if x.ndim != 3 or x.shape[-1] != 3 or not x.size or x.dtype.kind != "f":
        raise UserError(f"{path}: x has the shape {x.shape} of {x.dtype}; frames of particles are numbers (K, P, 3)")
    for name, shape in (("v", x.shape), ("F", (*x.shape, 3)), ("C", (*x.shape, 3)), ("body", x.shape[1:2]), ("scene", x.shape[1:2])):
        if name in arrays and arrays[name].shape != shape:
            raise UserError(f"{path}: {name} has the shape {arrays[name].shape}; with x {x.shape} it must be {shape}")
    times = arrays.get("times")
    if times is not None and times.shape != (len(x),):
        raise UserError(f"{path}: times have the shape {times.shape} for {len(x)} frames of one scene: export each scene of its own")
    times = _times(times, len(x), frame_interval, path)
    own: dict[str, Any] = {name: arrays[name] for name in ("C", "F", "body") if name in arrays}
    if "body" not in own and "scene" in arrays and arrays["scene"].max() > 0:
        own["body"] = arrays["scene"]
    if "body_names" in arrays:
        own["body_names"] = tuple(str(name) for name in arrays["body_names"])
    skins, colliders = _surfaces(arrays, x.shape[1], path)
    v = arrays["v"] if "v" in arrays else _velocities(x, times)
    motion = SimpleNamespace(x=x, v=v, times=times, skins=skins, colliders=colliders, **own)
    scene, law = _beside(path.parent)
    return Run(motion, path.parent.name if path.name == "frames.npz" else path.stem, scene, law)


def _surfaces(arrays: dict[str, np.ndarray], particles: int, path: Path) -> tuple[tuple[Skin, ...], tuple[SimpleNamespace, ...]]:
    """Return the skins and colliders of a file of frames (`Frames.save`)."""
    skins, colliders = [], []
    for kind, parts in SURFACES.items():
        for i in range(MOST_SURFACES):
            found = {part: arrays[f"{kind}_{i}_{part}"] for part in parts if f"{kind}_{i}_{part}" in arrays}
            if not found:
                continue
            corners = found.get("vertices", np.empty(0))
            whole = len(found) == len(parts) and corners.ndim == 2 and corners.shape[1] == 3
            if not whole or not _within(found["faces"], len(corners)) or found["faces"].shape[1:] != (3,):
                raise UserError(f"{path}: {kind} {i} is not whole, or its triangles name vertices that are not there")
            if kind == "skin":
                if found["weights"].shape != found["indices"].shape or len(found["indices"]) != len(corners):
                    raise UserError(f"{path}: skin {i} has {found['indices'].shape} indices and {found['weights'].shape} weights")
                if not _within(found["indices"], particles):
                    raise UserError(f"{path}: skin {i} is bound to particles that are not there")
                skins.append(Skin(**{part: torch.from_numpy(np.ascontiguousarray(values)) for part, values in found.items()}))
            else:
                if found["poses"].shape[1:] != (4, 4) or not np.isfinite(found["poses"]).all():
                    raise UserError(f"{path}: collider {i} has poses of shape {found['poses'].shape}; needed (K, 4, 4)")
                mesh = SimpleNamespace(vertices=corners, faces=found["faces"])
                colliders.append(SimpleNamespace(name=f"collider_{i}", mesh=mesh, poses=found["poses"]))
    return tuple(skins), tuple(colliders)


def _within(indices: np.ndarray, count: int) -> bool:
    return indices.ndim == 2 and indices.dtype.kind in "iu" and bool(((indices >= 0) & (indices < count)).all())


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


def _beside(folder: Path) -> tuple[Scene | None, Any]:
    """Return the scene and the elastic law that lie beside the frames of a simulation."""
    from neuido.data.bodies.scene_files import scene_from_dict

    if not (folder / SCENE).is_file():
        return None, None
    content = read_yaml(folder / SCENE)
    with naming(folder / SCENE):
        scene = scene_from_dict(content["scene"], content["discretisation"])
    file = folder / LAW if (folder / LAW).is_file() else folder / SCENE
    return scene, elastic_law(file) if file.name == LAW or "model" in content else None


def _numbered(folder: Path) -> list[Path]:
    found = [(int(match[1]), path) for path in folder.glob("*.ply") if (match := re.search(r"(\d+)$", path.stem))]
    return [path for _, path in sorted(found)]


def _prediction(folder: Path, recording: str | None, interval: float | None) -> Run:
    """Read the PLY files of particles that `neuido predict` wrote, of one scene."""
    notes: tuple[str, ...] = ()
    own = next((each for each in (folder / "particles", folder) if each.is_dir() and _numbered(each)), None)
    if own is None:
        names = sorted(path.parent.name for path in folder.glob("*/particles") if _numbered(path))
        if not names:
            raise UserError(f"{folder} holds no motion: give {KINDS}")
        own = folder / _picked(names, recording, folder) / "particles"
        notes = _others(names, recording)
    paths = _numbered(own)
    tables = [read_ply_vertices(path) for path in paths]
    if len({len(table) for table in tables}) > 1:
        raise UserError(f"{own}: the files have different numbers of particles: give a folder of one motion")
    for name in ("x", "y", "z"):
        if name not in (tables[0].dtype.names or ()):
            raise UserError(f"{paths[0]} has no points: its vertices lack the column {name}")
    times = _times(None, len(paths), interval, own)

    def columns(*names: str) -> np.ndarray:
        return np.stack([np.stack([table[name].astype(np.float32) for name in names], axis=1) for table in tables])

    x = columns("x", "y", "z")
    moving = all(name in (tables[0].dtype.names or ()) for name in ("vx", "vy", "vz"))
    v = columns("vx", "vy", "vz") if moving else _velocities(x, times)
    return Run(SimpleNamespace(x=x, v=v, times=times), own.parent.name, notes=notes)


def _picked(names: list[str], wanted: str | None, place: Path) -> str:
    if wanted is not None and wanted not in names:
        raise UserError(f"recording = {wanted!r} is not in {place}{suggest(wanted, names) or ';'} it has {', '.join(names)}")
    return names[0] if wanted is None else wanted


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
    chosen = _picked(list(found), recording, folder)
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
