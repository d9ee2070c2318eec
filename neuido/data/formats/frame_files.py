"""Files of frames as `neuido simulate` and `Frames.save` write them, and numbered files of particles. The files are not trusted."""

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from neuido.data.files.parsing import read_arrays, read_table
from neuido.errors import UserError, suggest

SCENE, LAW = "scene.yaml", "law.safetensors"
"""Files that `neuido simulate` writes beside the frames: the scene with its model, and a learned law."""
TIMES = "times.csv"
"""File beside numbered PLY files: number and time [s] of each frame."""
SURFACES = {"skin": ("vertices", "faces", "indices", "weights"), "collider": ("vertices", "faces", "poses")}
"""Arrays of each skin and collider in a file of frames."""
MOST_SURFACES = 64
"""Skins, and colliders, of a file that are read."""
Surface = dict[str, np.ndarray]


def read_frame_arrays(path: Path) -> dict[str, np.ndarray]:
    """Return the arrays of a file of frames whose shapes fit: x (K, P, 3), and v, C, F, body, scene and times where they are there.

    Raises:
        UserError: No file of frames, or arrays of other shapes.
    """
    kept = [f"{kind}_{i}_{part}" for kind, parts in SURFACES.items() for i in range(MOST_SURFACES) for part in parts]
    optional = ("v", "C", "F", "times", "t", "scene", "body", "body_names", *kept)
    arrays = read_arrays(path, ("x",), optional, what="file of frames with positions x")
    given = arrays["x"]
    x = arrays["x"] = given[None] if given.ndim == 2 else given
    if x.ndim != 3 or x.shape[-1] != 3 or not x.size or x.dtype.kind != "f":
        raise UserError(f"{path}: x has the shape {given.shape} of {given.dtype}; frames of particles are numbers (K, P, 3)")
    tensors = (*x.shape, 3)
    for name, shape in {"v": x.shape, "F": tensors, "C": tensors, "body": x.shape[1:2], "scene": x.shape[1:2]}.items():
        if name in arrays and arrays[name].shape != shape:
            raise UserError(f"{path}: {name} has the shape {arrays[name].shape}; with x {x.shape} it must be {shape}")
    return arrays


def read_surfaces(arrays: dict[str, np.ndarray], path: Path) -> tuple[list[Surface], list[Surface]]:
    """Return the arrays of the skins and of the colliders in a file of frames, each whole and with indices that are there.

    Raises:
        UserError: A surface that lacks an array, or whose arrays do not fit each other or the particles.
    """
    found: dict[str, list[Surface]] = {kind: [] for kind in SURFACES}
    for kind, parts in SURFACES.items():
        for i in range(MOST_SURFACES):
            own = {part: arrays[f"{kind}_{i}_{part}"] for part in parts if f"{kind}_{i}_{part}" in arrays}
            if not own:
                continue
            corners = own.get("vertices", np.empty(0))
            whole = len(own) == len(parts) and corners.ndim == 2 and corners.shape[1] == 3
            if not whole or not _within(own["faces"], len(corners)) or own["faces"].shape[1:] != (3,):
                raise UserError(f"{path}: {kind} {i} is not whole, or its triangles name vertices that are not there")
            if kind == "skin" and (own["weights"].shape != own["indices"].shape or len(own["indices"]) != len(corners)):
                raise UserError(f"{path}: skin {i} has {own['indices'].shape} indices and {own['weights'].shape} weights")
            if kind == "skin" and not _within(own["indices"], arrays["x"].shape[1]):
                raise UserError(f"{path}: skin {i} is bound to particles that are not there")
            if kind == "collider":
                poses = own["poses"]
                if poses.shape[1:] != (4, 4) or not len(poses) or not np.isfinite(poses).all():
                    raise UserError(f"{path}: collider {i} has poses of shape {poses.shape}; needed finite ones, (K, 4, 4)")
            found[kind].append(own)
    return found["skin"], found["collider"]


def _within(indices: np.ndarray, count: int) -> bool:
    return indices.ndim == 2 and indices.dtype.kind in "iu" and bool(((indices >= 0) & (indices < count)).all())


def numbered_files(folder: Path) -> list[Path]:
    """Return the PLY files of a folder whose names end in a number, in its order."""
    found = [(int(match[1]), path) for path in folder.glob("*.ply") if (match := re.search(r"(\d+)$", path.stem))]
    return [path for _, path in sorted(found)]


def read_frame_times(folder: Path, frames: int) -> np.ndarray | None:
    """Return the times beside the PLY files of a folder [s], (frames,) float64; None without a file of times.

    Raises:
        UserError: A file with other columns, or whose times are not one a frame, finite and rising.
    """
    path = folder / TIMES
    if not path.is_file():
        return None
    try:
        table = np.array([[float(cell) for cell in row] for row in read_table(path)[1:]]).reshape(-1, 2)
    except ValueError as error:
        raise UserError(f"{path} must have two columns of numbers, the number and the time of a frame [s]") from error
    times = table[:, 1]
    if len(times) != frames or not np.isfinite(times).all() or (np.diff(times) <= 0).any():
        raise UserError(f"{path}: it has {len(times)} times for {frames} frames; they must be finite and rise")
    return times


def picked(names: Sequence[str], wanted: str | None, place: Path) -> str:
    """Return the wanted name of several, or the first.

    Raises:
        UserError: There is none of that name.
    """
    if wanted is None:
        return names[0]
    if wanted not in names:
        raise UserError(f"recording = {wanted!r} is not in {place}{suggest(wanted, names) or ';'} it has {', '.join(names)}")
    return wanted
