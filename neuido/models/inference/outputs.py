"""Output files of a predicted motion: a PLY sequence of particles, a video, and a contact sheet."""

import os
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor

from neuido.data.files.writing import atomic_write, write_png, write_text
from neuido.data.formats.frame_files import TIMES
from neuido.data.formats.ply import ply_bytes
from neuido.errors import UserError
from neuido.types import ParticleState


def write_particles(folder: str | os.PathLike, motion: ParticleState, times: Tensor | None = None) -> None:
    """Write the particles of each frame to `000.ply`, `001.ply`, ... with x, y, z [m] and vx, vy, vz [m/s].

    Args:
        folder: Folder of the files, made if it is not there.
        motion: The particles.
        times: Times of the frames [s], (K,), written to `times.csv`.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    x, v = motion.x.detach().cpu().numpy(), motion.v.detach().cpu().numpy()
    digits = max(3, len(str(len(x) - 1)))
    for k, (position, velocity) in enumerate(zip(x, v)):
        columns = np.concatenate([position, velocity], 1, dtype=np.float32)
        vertices = np.rec.fromarrays(columns.T, names=["x", "y", "z", "vx", "vy", "vz"])
        with atomic_write(folder / f"{k:0{digits}d}.ply") as hidden:
            hidden.write_bytes(ply_bytes(vertices))
    for old in folder.glob("*.ply"):  # left by an earlier, longer run
        if old.stem.isdigit() and int(old.stem) >= len(x):
            old.unlink()
    if times is None:
        (folder / TIMES).unlink(missing_ok=True)
    else:
        write_text(folder / TIMES, "frame,time [s]\n" + "".join(f"{k},{time:.9g}\n" for k, time in enumerate(times.tolist())))


def write_video(path: str | os.PathLike, images: Tensor, *, rate: float = 20.0) -> None:
    """Write an MP4 file atomically.

    Args:
        path: File to write, ending in .mp4.
        images: RGB in [0, 1], (K, H, W, 3).
        rate: Frames per second.

    Raises:
        UserError: OpenCV cannot write the file.
    """
    path = Path(path)
    frames = (255 * images.detach().clamp(0, 1)).round().to(torch.uint8).cpu().numpy()
    height, width = (n - n % 2 for n in frames.shape[1:3])  # the codec requires even sides
    with atomic_write(path, keep_suffix=True) as hidden:
        writer = cv2.VideoWriter(str(hidden), cv2.VideoWriter_fourcc(*"mp4v"), rate, (width, height))
        if not writer.isOpened():
            raise UserError(f"OpenCV cannot write the video {path}")
        for frame in frames:
            writer.write(cv2.cvtColor(np.ascontiguousarray(frame[:height, :width]), cv2.COLOR_RGB2BGR))
        writer.release()
        written = cv2.VideoCapture(str(hidden))  # OpenCV reports no full disk
        count = int(written.get(cv2.CAP_PROP_FRAME_COUNT)) if written.isOpened() else 0
        written.release()
        if count != len(frames):
            raise UserError(
                f"the video {path} cannot be written whole, {count} of {len(frames)} frames: free some space, or give another out"
            )


def contact_sheet(path: str | os.PathLike, rows: Sequence[Tensor], *, columns: int = 8) -> None:
    """Write a PNG with one row for each sequence of images (K, H, W, 3) in [0, 1]; each row shows evenly spaced frames."""
    bands = []
    for row in rows:
        pick = torch.linspace(0, len(row) - 1, min(columns, len(row))).round().long()
        bands.append(torch.cat(list(row[pick].detach().clamp(0, 1).cpu()), 1))
    width = min(band.shape[1] for band in bands)
    sheet = torch.cat([band[:, :width] for band in bands])
    write_png(Path(path), cv2.cvtColor((255 * sheet).round().to(torch.uint8).numpy(), cv2.COLOR_RGB2BGR))
