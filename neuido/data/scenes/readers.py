"""Multi-view recordings of any known format: find the format of a folder, and read it."""

import os
from pathlib import Path

from neuido.data.formats import colmap, nerfstudio, neuma, pacnerf, springgaus
from neuido.data.formats.layout import MultiView
from neuido.data.measured import experiment_video
from neuido.errors import UserError

__all__ = ["FORMATS", "MultiView", "detect", "read"]

MARKS = {
    "experiment": ("experiment.yaml",),
    "pacnerf": ("all_data.json",),
    "neuma": ("data_dynamic.json", "dynamics"),
    "springgaus": ("camera.json", "dynamic/cameras_calib.json"),
    "nerfstudio": ("transforms.json", "transforms_train.json"),
    "colmap": tuple(f"{place}images.{kind}" for place in ("sparse/0/", "sparse/", "") for kind in ("bin", "txt")),
}
"""By which entries of a folder its format is known, in the order of the search."""
FORMATS = tuple(MARKS)
READERS = {
    "experiment": experiment_video.read,
    "pacnerf": pacnerf.read,
    "neuma": neuma.read,
    "springgaus": springgaus.read,
    "nerfstudio": nerfstudio.read,
    "colmap": colmap.read,
}


def read(path: str | os.PathLike, format: str = "auto", *, recording: str | None = None, frame_interval: float | None = None) -> MultiView:
    """Read a recording.

    Args:
        path: Its folder; for `nerfstudio` also a JSON file.
        format: One of `experiment`, `pacnerf`, `neuma` (synthetic and real), `springgaus` (mpm_synthetic and real_capture),
            `nerfstudio` (Blender's included) and `colmap` (one frame), or `auto`.
        recording: Which one, where a folder holds several: a recording's name (experiment), `<object>/<sequence>` (springgaus).
        frame_interval: Seconds from one frame to the next, where a format does not say; it replaces the times of one that does.

    Raises:
        UserError: An unknown format, a file that is missing or malformed, an image outside the folder.
    """
    folder = Path(path).expanduser()
    if not folder.exists():
        raise UserError(f"the folder {folder} is missing")
    if format == "auto":
        format = detect(folder)
    if format not in MARKS:
        raise UserError(f"format = {format!r} is unknown: choose from auto, {', '.join(FORMATS)}")
    if frame_interval is not None and not frame_interval > 0:
        raise UserError(f"frame_interval must be positive, got {frame_interval}")
    return READERS[format](folder, recording=recording, frame_interval=frame_interval)


def detect(folder: Path) -> str:
    """Return the format of a folder, by the files in it.

    Raises:
        UserError: None is known by them.
    """
    if folder.is_file():
        return "nerfstudio"
    for format, marks in MARKS.items():
        if any((folder / mark).exists() for mark in marks):
            return format
    marks = ", ".join(mark for group in MARKS.values() for mark in group)
    raise UserError(f"the format of {folder} is not known: it has none of {marks}")
