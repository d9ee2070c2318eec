"""Read multi-view recordings of any supported format; detect the format of a folder."""

import os
from pathlib import Path

from neuido.data.files.parsing import naming
from neuido.data.formats import colmap, nerfstudio, neuma, pacnerf, springgaus
from neuido.data.formats.layout import MultiView
from neuido.data.measured import experiment_video
from neuido.errors import UserError

__all__ = ["FORMATS", "MultiView", "detect", "read_recording"]

MARKS = {
    "experiment": ("experiment.yaml",),
    "pacnerf": ("all_data.json",),
    "neuma": ("data_dynamic.json", "dynamics"),
    "springgaus": ("camera.json", "dynamic/cameras_calib.json"),
    "nerfstudio": ("transforms.json", "transforms_train.json"),
    "colmap": tuple(f"{place}images.{kind}" for place in ("sparse/0/", "sparse/", "") for kind in ("bin", "txt")),
}
"""Files and folders that identify each format, in the order of the search."""
FORMATS = tuple(MARKS)
READERS = {
    "experiment": experiment_video.read,
    "pacnerf": pacnerf.read,
    "neuma": neuma.read,
    "springgaus": springgaus.read,
    "nerfstudio": nerfstudio.read,
    "colmap": colmap.read,
}


def read_recording(
    path: str | os.PathLike, format: str = "auto", *, recording: str | None = None, frame_interval: float | None = None
) -> MultiView:
    """Read a multi-view recording: cameras, times and the paths of its images.

    Args:
        path: Folder of the recording; for `nerfstudio` also a JSON file.
        format: `experiment`, `pacnerf`, `neuma` (synthetic and real), `springgaus` (mpm_synthetic and real_capture), `nerfstudio` (also
            Blender), `colmap` (one frame, or with `frame_interval` frames of cameras that move), or `auto` to detect it.
        recording: Recording to read, if the folder has several: its name (experiment) or `<object>/<sequence>` (springgaus).
        frame_interval: Time between frames [s], for formats without times; it replaces the times of other formats.

    Raises:
        UserError: The format is unknown, a file is missing or malformed, or an image lies outside the folder.
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
    with naming(folder, "holds a value that cannot be used"):
        return READERS[format](folder, recording=recording, frame_interval=frame_interval)


def detect(folder: Path) -> str:
    """Detect the format of a recording from the files in its folder.

    Raises:
        UserError: No format matches.
    """
    if folder.is_file():
        return "nerfstudio"
    for format, marks in MARKS.items():
        if any((folder / mark).exists() for mark in marks):
            return format
    marks = ", ".join(mark for group in MARKS.values() for mark in group)
    raise UserError(f"the format of {folder} is unknown: it has none of {marks}")
