"""What a user says about video files, and which of their frames count."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from neuido.data.footage.video_frames import Clip
from neuido.errors import UserError

SAME_ASPECT = 0.01
"""Largest relative difference of the aspect ratios of two images of one camera: rounding to whole pixels makes less."""


class Filming(NamedTuple):
    """Options of `neuido import` for video files."""

    start: float | None = None
    """First moment to use, in the clock of the clip [s]."""
    end: float | None = None
    """Last moment to use [s]."""
    background: str | None = None
    """Image file of the empty scene; None: the median of the frames."""
    cameras: str | None = None
    """How the cameras of several views are found: `board`, `colmap`, or the path of a recording with one view per clip."""
    board: str | None = None
    """Printed ChArUco board: squares in x and y, side of a square, side of a marker, dictionary."""
    synchronise: str = "none"
    """`none`, `flash` or `audio`."""
    offsets: Sequence[float] | None = None
    """What to add to the times of each clip [s]."""
    picture: str | None = None
    """PNG file for a contact sheet of frames with the outline that was found."""

    @property
    def background_file(self) -> Path | None:
        """The image of the empty scene."""
        return None if self.background is None else Path(self.background).expanduser()


class View(NamedTuple):
    """The camera of one clip."""

    viewmat: np.ndarray
    """OpenCV world-to-camera matrix, (4, 4) float64."""
    K: np.ndarray
    """Intrinsic matrix [px], (3, 3) float64; pixel centres at half-integers."""
    distortion: tuple[float, ...] = ()
    """OpenCV's k1, k2, p1, p2, k3."""


def chosen_frames(clip: Clip, filming: Filming) -> np.ndarray:
    """Return the indices of the frames between `start` and `end`.

    Raises:
        UserError: Fewer than three frames remain.
    """
    t = clip.times - clip.times[0]
    kept = np.flatnonzero((t >= (filming.start or 0.0) - 1e-9) & (t <= (np.inf if filming.end is None else filming.end) + 1e-9))
    if len(kept) < 3:
        raise UserError(
            f"{clip.path}: {len(kept)} frames lie between --start {filming.start or 0:g} and --end "
            f"{t[-1] if filming.end is None else filming.end:.3g} s, at least 3 are needed; the video lasts {t[-1]:.3g} s"
        )
    return kept
