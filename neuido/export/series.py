"""Names of the files of a sequence, its removal of older frames, and PLY sequences with their index."""

import re
from pathlib import Path

import numpy as np

from neuido.data.files.writing import write_bytes, write_json
from neuido.data.formats.ply import ply_bytes
from neuido.data.progress import Progress
from neuido.export.exchange import Exchange, Surface
from neuido.models.render.gaussians import save_gaussians

FORMAT = "neuido-sequence/1"


def safe_name(name: str) -> str:
    """Return a name as part of a file's name: letters, digits, `-` and `_`."""
    return re.sub(r"[^A-Za-z0-9_-]", "_", name)[:60] or "part"


def frame_name(name: str, frame: int, frames: int, suffix: str) -> str:
    """Return the file name of a frame: `NAME_0007.ply`."""
    return f"{name}_{frame:0{max(4, len(str(frames - 1)))}d}{suffix}"


def remove_other_frames(folder: Path, name: str, suffix: str, written: list[Path]) -> None:
    """Remove the frames that an earlier, longer sequence of this name left."""
    pattern = re.compile(re.escape(name) + r"_\d{4,}" + re.escape(suffix))
    for old in folder.iterdir():
        if pattern.fullmatch(old.name) and old not in written:
            old.unlink()


def write_ply(path: Path, made: Exchange, *, progress: bool = False) -> list[Path]:
    """Write PLY sequences: particles `NAME_0000.ply`, each surface `NAME_SURFACE_0000.ply`, Gaussians `NAME_splats_0000.ply` (3DGS).

    `NAME.json`, written last, lists them with the times of the frames and the units.

    Args:
        path: `NAME.ply`.
        made: The motion.
        progress: Whether progress is shown on stderr.

    Returns:
        The files of the particles, then the others; the index is the last.
    """
    surfaces = [(f"{path.stem}_{safe_name(each.name)}", each) for each in (*made.surfaces, *made.colliders)]
    names: dict[str, list[Path]] = {}
    with Progress("writing PLY", made.frames, unit="frames", shown=progress) as work:
        for k in range(made.frames):
            own = path.with_name(frame_name(path.stem, k, made.frames, path.suffix))
            _write_points(own, made, k)
            names.setdefault(path.stem, []).append(own)
            for name, surface in surfaces:
                own = path.with_name(frame_name(name, k, made.frames, path.suffix))
                _write_mesh(own, surface, k)
                names.setdefault(name, []).append(own)
            if made.gaussians is not None:
                name = f"{path.stem}_splats"
                own = path.with_name(frame_name(name, k, made.frames, path.suffix))
                save_gaussians(own, made.gaussians.at(k))
                names.setdefault(name, []).append(own)
            work.update()
    index = path.with_suffix(".json")
    units = {"position": "m", "velocity": "m/s", "time": "s", **{name: field.unit for name, field in made.fields.items()}}
    series = {name: [file.name for file in files] for name, files in names.items()}
    write_json(index, {"format": FORMAT, "times": made.times.tolist(), "up": made.up, "units": units, "series": series})
    for name, files in names.items():
        remove_other_frames(path.parent, name, path.suffix, files)
    return [*(file for files in names.values() for file in files), index]


def _vertices(columns: dict[str, np.ndarray]) -> np.ndarray:
    return np.rec.fromarrays(list(columns.values()), dtype=[(name, column.dtype) for name, column in columns.items()])


def _write_points(path: Path, made: Exchange, k: int) -> None:
    columns = dict(zip("xyz", made.x[k].T))
    if made.v is not None:
        columns |= dict(zip(("vx", "vy", "vz"), made.v[k].T))
    columns |= {name: field.at(k) for name, field in made.fields.items()}
    write_bytes(path, ply_bytes(_vertices(columns)))


def _write_mesh(path: Path, surface: Surface, k: int) -> None:
    vertices, faces, normals = surface.placed(k)
    columns = dict(zip("xyz", vertices.T)) | dict(zip(("nx", "ny", "nz"), normals.T))
    write_bytes(path, ply_bytes(_vertices(columns), faces))
