"""When the clips of one motion started: given offsets, a flash of light that all see, or a sound that all hear."""

from collections.abc import Sequence

import numpy as np

from neuido.data.footage.video_frames import Clip, images, loudness
from neuido.errors import UserError

METHODS = ("none", "flash", "audio")
FLASH_FACTOR = 8.0
"""Standard deviations by which a flash brightens the image from one frame to the next."""
CLAP_FACTOR = 5.0
"""Ratio of the loudest millisecond to the usual loudness that counts as a clap."""


def start_times(clips: Sequence[Clip], method: str, offsets: Sequence[float] | None) -> tuple[np.ndarray, str]:
    """Return what to add to the times of each clip [s], (V,), and a line for the summary.

    Args:
        clips: The clips.
        method: `none`, `flash` or `audio`.
        offsets: What to add to the times of each clip [s], given by the user; None: see `method`.

    Raises:
        UserError: The method is unknown, the number of offsets differs from that of the clips, or a clip has no flash or no clap.
    """
    if method not in METHODS:
        raise UserError(f"--synchronise {method} is unknown: choose from {', '.join(METHODS)}")
    if offsets is not None:
        if method != "none":
            raise UserError("give --offsets or --synchronise, not both")
        if len(offsets) != len(clips) or not np.isfinite(offsets).all():
            raise UserError(f"--offsets has {len(offsets)} numbers for {len(clips)} clips: give one finite number (s) for each")
        return np.array(offsets, float), f"synchronised by the given offsets ({', '.join(f'{v:g}' for v in offsets)} s)"
    if method == "none":
        return np.array([-clip.times[0] for clip in clips]), "taken as started together (--synchronise flash or audio, or --offsets)"
    marks = np.array([(_flash if method == "flash" else _clap)(clip) for clip in clips])
    late = marks[0] - marks
    return late, f"synchronised by the {method}: {', '.join(f'{clip.path.name} {v:+.4f} s' for clip, v in zip(clips, late))}"


def _flash(clip: Clip) -> float:
    """Return the time [s] of the frame in which the image brightens most."""
    light = np.array([image[::4, ::4].mean() for image in images(clip, np.arange(len(clip.times)))])
    steps = np.diff(light)
    usual = 1.4826 * float(np.median(np.abs(steps - np.median(steps)))) + 1e-3
    at = int(np.argmax(steps))
    if steps[at] < FLASH_FACTOR * usual or steps[at] < 1.0:
        raise UserError(f"{clip.path} has no flash: its brightness changes by {steps[at]:.2g} of 255 at the most; give --offsets (s)")
    return float(clip.times[at + 1])


def _clap(clip: Clip) -> float:
    """Return the time [s] at which the loudest sound begins: half of its peak is reached."""
    times, level = loudness(clip.path)
    peak = int(np.argmax(level))
    if not level[peak] > CLAP_FACTOR * (float(np.median(level)) + 1e-9):
        raise UserError(f"{clip.path} has no clap: no sound is {CLAP_FACTOR:g} times louder than usual; give --offsets (s)")
    first = peak
    while first > 0 and level[first - 1] > 0.5 * level[peak]:
        first -= 1
    return float(times[first])
