"""The start of a track in which a body that flies later is still held."""

import math
from collections.abc import Sequence

import numpy as np

BAND = 8.0
"""Height of the band in which a still coordinate stays, in standard deviations of its noise: four on either side."""
LEAST_ROWS = 4
"""Least rows of a held start, and of the flight after it."""


def held_rows(t: np.ndarray, x: np.ndarray, gravity: Sequence[float]) -> int:
    """Return the number of rows at the start in which a body cannot have flown.

    A free body draws a parabola, which stays within a band of height h for sqrt(8 h / g) at the most, when its apex is in the middle of
    that time. Where a track stays within the noise for longer, and leaves it later, the body was held.

    Args:
        t: Times [s], (n,).
        x: Coordinates [m], (n, A).
        gravity: Declared gravity along each of them [m/s^2], (A,).

    Returns:
        The rows before the first one that is off; 0 where the body flies from the start, does not fly, or has no weight along the axes.
    """
    g = float(np.linalg.norm(gravity))
    if g == 0.0 or len(t) < 2 * LEAST_ROWS:
        return 0
    height = x @ np.asarray(gravity) / g
    bends = np.diff(height, 2)
    noise = 1.4826 * float(np.median(np.abs(bends - np.median(bends)))) / math.sqrt(6.0)
    band = BAND * noise + 1e-9 * float(np.ptp(height))
    spread = np.maximum.accumulate(height) - np.minimum.accumulate(height)
    count = int(np.argmax(spread > band)) if (spread > band).any() else 0
    if not LEAST_ROWS <= count <= len(t) - LEAST_ROWS:
        return 0
    return count if float(t[count - 1] - t[0]) > math.sqrt(8.0 * band / g) else 0
