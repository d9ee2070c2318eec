"""Particles of a rollout as files: NumPy archive, PLY sequence, CSV table."""

import os
from pathlib import Path
from typing import Any

import numpy as np

from neuido.errors import UserError

FORMATS = {".npz": "NumPy archive", ".ply": "PLY sequence", ".csv": "table"}
VECTORS = {"x": ("x", "y", "z"), "v": ("vx", "vy", "vz")}


def export(frames: Any, path: str | os.PathLike) -> Path:
    """Write the frames of a rollout in the format that the name's ending says.

    Args:
        frames: What a rollout returned: positions x [m] and velocities v [m/s] (K, P, 3), perhaps more tensors and times [s].
        path: `.npz`: one archive of all tensors. `.ply`: a sequence `NAME-000.ply`, `NAME-001.ply`, ... with x, y, z [m] and vx, vy, vz
            [m/s] of each particle. `.csv`: one row for each frame and particle.

    Returns:
        The file, of a sequence the first one.

    Raises:
        UserError: An ending that is not known, or frames without positions of the shape (K, P, 3).
    """
    target = Path(path).expanduser()
    if target.suffix not in FORMATS:
        raise UserError(f"path = {path}: its ending must be one of {', '.join(f'{end} ({what})' for end, what in FORMATS.items())}")
    arrays = arrays_of(frames)
    target.parent.mkdir(parents=True, exist_ok=True)
    write = {".npz": _write_npz, ".ply": _write_plys, ".csv": _write_csv}[target.suffix]
    return write(arrays, target)


def arrays_of(frames: Any) -> dict[str, np.ndarray]:
    """Return the tensors of frames as NumPy arrays, and `t` [s] where the frames know their times.

    Raises:
        UserError: Frames without positions of the shape (K, P, 3).
    """
    found = {name: getattr(frames, name, None) for name in ("x", "v", "C", "F", "history")}
    arrays = {name: t.detach().cpu().numpy() if hasattr(t, "detach") else np.asarray(t) for name, t in found.items() if t is not None}
    if "x" not in arrays or arrays["x"].ndim != 3 or arrays["x"].shape[2] != 3:
        raise UserError(f"frames has positions of the shape {getattr(arrays.get('x'), 'shape', None)}, not (frames, particles, 3)")
    times = getattr(frames, "times", None)
    if times is not None:
        arrays["t"] = np.asarray(times.detach().cpu() if hasattr(times, "detach") else times)
    return arrays


def _hidden(path: Path) -> Path:
    return path.with_name(f".{path.name}.tmp")


def _write_npz(arrays: dict[str, np.ndarray], path: Path) -> Path:
    with _hidden(path).open("wb") as stream:
        np.savez_compressed(stream, **arrays)
    os.replace(_hidden(path), path)
    return path


def _write_csv(arrays: dict[str, np.ndarray], path: Path) -> Path:
    frames, particles = arrays["x"].shape[:2]
    index = [np.repeat(np.arange(frames), particles), np.tile(np.arange(particles), frames)]
    columns = {"frame": index[0], "particle": index[1]}
    if "t" in arrays:
        columns["t"] = arrays["t"][index[0]]
    for name, titles in VECTORS.items():
        if name in arrays:
            columns |= dict(zip(titles, arrays[name].reshape(-1, 3).T))
    formats = ["%d", "%d", *["%.9g"] * (len(columns) - 2)]
    with _hidden(path).open("w") as stream:
        np.savetxt(stream, np.stack(list(columns.values()), 1), delimiter=",", header=",".join(columns), comments="", fmt=formats)
    os.replace(_hidden(path), path)
    return path


def _write_plys(arrays: dict[str, np.ndarray], path: Path) -> Path:
    from plyfile import PlyData, PlyElement

    titles = [title for name, own in VECTORS.items() if name in arrays for title in own]
    digits = max(3, len(str(len(arrays["x"]) - 1)))
    paths = []
    for k in range(len(arrays["x"])):
        vertices = np.empty(arrays["x"].shape[1], [(title, "f4") for title in titles])
        values = np.concatenate([arrays[name][k] for name in VECTORS if name in arrays], 1)
        for title, column in zip(titles, values.T):
            vertices[title] = column
        paths.append(path.with_name(f"{path.stem}-{k:0{digits}d}.ply"))
        PlyData([PlyElement.describe(vertices, "vertex")]).write(str(_hidden(paths[-1])))
        os.replace(_hidden(paths[-1]), paths[-1])
    for old in path.parent.glob(f"{path.stem}-*.ply"):  # of a longer sequence before
        number = old.stem.removeprefix(f"{path.stem}-")
        if number.isdigit() and int(number) >= len(paths):
            old.unlink()
    return paths[0]
