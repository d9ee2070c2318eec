"""Read video files with PyAV: the times of the frames, their images upright, and the loudness of the sound. The files are not trusted."""

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from neuido.data.files.parsing import parser_errors
from neuido.errors import UserError
from neuido.physics.runtime.lazy import import_extra
from neuido.physics.runtime.limits import check_limit

SUFFIXES = (".mp4", ".mov", ".avi", ".mkv", ".webm", ".m4v", ".mpg", ".mpeg", ".wmv", ".mts")
"""Endings by which a file counts as a video."""
CONTAINERS = ("mov", "mp4", "m4a", "3gp", "3g2", "mj2", "matroska", "webm", "avi", "mpeg", "mpegts", "asf")
"""Formats that are read. Playlists and scripts, which name other files, are none of them."""


class Clip(NamedTuple):
    """A video file: size of the upright images and the times of its T frames."""

    path: Path
    width: int
    height: int
    times: np.ndarray
    """Times in the clock of the file [s], (T,) float64, increasing."""

    @property
    def interval(self) -> float:
        """Median time between frames [s]."""
        return float(np.median(np.diff(self.times)))


def is_video(path: Path) -> bool:
    """Whether a file is a video by its ending."""
    return path.suffix.lower() in SUFFIXES


def read_clip(path: Path, *, frame_rate: float | None = None) -> Clip:
    """Read the times of all frames of a video; the images are decoded once to find damage.

    Args:
        path: The file.
        frame_rate: True frames per second of a slow-motion video, in place of the times in the file.

    Raises:
        UserError: The file is missing, not a video, damaged or too large, has fewer than three frames, or its times do not increase.
    """
    times, size = [], None
    for time, image in _decoded(path):
        size = size or image.shape[1::-1]
        if image.shape[1::-1] != size:
            raise UserError(f"{path}: the image size changes from {size} to {image.shape[1::-1]} px: cut the video there")
        times.append(time)
        check_limit(len(times), "NEUIDO_MAX_FRAMES", f"{path} has more frames")
    if len(times) < 3 or size is None:
        raise UserError(f"{path} has {len(times)} frames that can be decoded; at least 3 are needed")
    if frame_rate is not None:
        return Clip(path, *size, np.arange(len(times)) / frame_rate)
    t = np.array(times)
    if not np.isfinite(t).all() or (np.diff(t) <= 0).any():
        raise UserError(f"{path}: the times of its frames do not increase: give the frames per second (--frame_rate)")
    return Clip(path, *size, t)


def images(clip: Clip, chosen: np.ndarray) -> Iterator[np.ndarray]:
    """Yield the RGB images (H, W, 3) uint8 of the chosen frames in order.

    Args:
        clip: The video.
        chosen: Indices of frames, increasing.
    """
    wanted = set(int(i) for i in chosen)
    last = max(wanted, default=-1)
    for i, (_, image) in enumerate(_decoded(clip.path)):
        if i in wanted:
            yield image
        if i >= last:
            return


def loudness(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return times [s] (n,) in the clock of the file and the loudness (n,), the root mean square of each millisecond.

    Raises:
        UserError: The video has no sound.
    """
    with _opened(path) as container:
        if not container.streams.audio:
            raise UserError(f"{path} has no sound: give --synchronise flash, or --offsets (s)")
        stream = container.streams.audio[0]
        parts, count, start, rate = [], 0, None, int(stream.rate or 0)
        for frame in container.decode(stream):
            start = frame.time if start is None else start
            samples = np.asarray(frame.to_ndarray(), dtype=np.float64)
            channels = max(frame.layout.nb_channels, 1)
            parts.append(samples.reshape(-1, channels)[:, 0] if samples.shape[0] == 1 else samples[0])
            count += len(parts[-1])
            check_limit(count, "NEUIDO_MAX_ARRAY_ELEMENTS", f"{path} has {count} samples of sound")
        if not parts or rate < 1:
            raise UserError(f"{path} has no sound: give --synchronise flash, or --offsets (s)")
    sound = np.concatenate(parts)
    sound = sound - sound.mean()
    length = max(rate // 1000, 1)
    blocks = sound[: len(sound) // length * length].reshape(-1, length)
    return (start or 0.0) + np.arange(len(blocks)) * length / rate, np.sqrt(np.mean(blocks**2, axis=1))


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[Any]:
    av = import_extra("av", path.name, extra="video")
    if not path.is_file():
        raise UserError(f"{path} is missing" if not path.exists() else f"{path} is not a file")
    options = {"protocol_whitelist": "file", "format_whitelist": ",".join(CONTAINERS)}
    with parser_errors(path, "video"), av.open(f"file:{path.resolve()}", options=options) as container:
        yield container


def _decoded(path: Path) -> Iterator[tuple[float, np.ndarray]]:
    """Yield the time [s] and the upright RGB image of each frame."""
    with _opened(path) as container:
        if not container.streams.video:
            raise UserError(f"{path} has no video stream")
        stream = container.streams.video[0]
        pixels = int(stream.codec_context.width or 0) * int(stream.codec_context.height or 0)
        check_limit(pixels, "NEUIDO_MAX_IMAGE_PIXELS", f"{path} has {pixels} pixels a frame")
        stream.thread_type = "AUTO"
        for frame in container.decode(stream):
            check_limit(frame.width * frame.height, "NEUIDO_MAX_IMAGE_PIXELS", f"{path} has {frame.width} x {frame.height} pixels")
            image = frame.to_ndarray(format="rgb24")
            turns = round(getattr(frame, "rotation", 0) / 90) % 4
            time = frame.time if frame.time is not None else float("nan")
            yield time, np.ascontiguousarray(np.rot90(image, turns)) if turns else image
