"""Write pictures of a motion: one PNG, numbered PNGs, or a video in H.264 (MP4) or VP9 (WebM) by PyAV."""

from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path

import numpy as np

from neuido.data.files.writing import atomic_write, write_png
from neuido.errors import UserError
from neuido.physics.runtime.lazy import import_extra

CODECS = {".mp4": ("libx264", "mp4", {"crf": "20", "preset": "medium"}), ".webm": ("libvpx-vp9", "webm", {"crf": "30", "b": "0"})}
"""Encoder, container and options of each ending; constant quality."""
ENDINGS = (*CODECS, ".png")
RATES = (1.0, 240.0)
"""Least and largest frames a second of a video."""


def check_output(path: Path, frame_rate: float | None = None) -> None:
    """Check before long work that a picture or video of this name can be written.

    Raises:
        UserError: An unknown ending, a frame rate outside `RATES`, or PyAV is missing for a video.
    """
    if path.suffix.lower() not in ENDINGS:
        raise UserError(f"out = {path}: its ending must be {', '.join(ENDINGS)}")
    if path.is_dir():
        raise UserError(f"out = {path} is a folder: give the name of a file")
    if frame_rate is not None and not RATES[0] <= frame_rate <= RATES[1]:
        raise UserError(f"frame_rate is {frame_rate:g}; it must lie between {RATES[0]:g} and {RATES[1]:g} frames a second")
    if path.suffix.lower() in CODECS:
        import_extra("av", path.name, extra="viewer")


def write_video(path: Path, pictures: Iterable[np.ndarray], frame_rate: float) -> None:
    """Write a video that browsers and phones play (yuv420p; the index of an MP4 at its beginning), all at once.

    Args:
        path: File that ends in .mp4 or .webm.
        pictures: RGB (H, W, 3) uint8 of even sides, all of one size.
        frame_rate: Frames a second.
    """
    av = import_extra("av", path.name, extra="viewer")
    codec, container, options = CODECS[path.suffix.lower()]
    flags = {"movflags": "+faststart"} if container == "mp4" else {}
    with atomic_write(path, keep_suffix=True) as hidden, av.open(str(hidden), "w", format=container, options=flags) as sink:
        stream = None
        for image in pictures:
            if stream is None:
                stream = sink.add_stream(codec, rate=Fraction(frame_rate).limit_denominator(1001))
                stream.height, stream.width = image.shape[:2]
                stream.pix_fmt, stream.options = "yuv420p", dict(options)
            for packet in stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")):
                sink.mux(packet)
        if stream is not None:
            for packet in stream.encode():
                sink.mux(packet)


def write_pngs(path: Path, pictures: Iterable[np.ndarray], count: int) -> list[Path]:
    """Write pictures as PNG files: one under its name, several as NAME_0000.png and on; return their paths."""
    digits = max(4, len(str(count - 1)))
    written = []
    for k, image in enumerate(pictures):
        own = path if count == 1 else path.with_name(f"{path.stem}_{k:0{digits}d}{path.suffix}")
        write_png(own, np.ascontiguousarray(image[..., ::-1]))
        written.append(own)
    return written
