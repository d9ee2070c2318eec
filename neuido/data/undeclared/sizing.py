"""Scale an effect until it moves the recorded points by a given multiple of the noise."""

import math
from collections.abc import Callable

import numpy as np

from neuido.data.undeclared.random_effects import Drawn

MIN_SEPARATION, MAX_SEPARATION = 15.0, 150.0
"""Range of the ratio of separation to noise of a case."""
OVER_FLOOR = 2.0
"""Smallest ratio of separation to the difference between solvers; a smaller effect cannot be identified."""


class Redraw(Exception):
    """The drawn values make no usable case; draw again."""


def scale_to_separation(drawn: Drawn, target: float, separation: Callable[[Drawn], float], smallest: float) -> Drawn:
    """Scale an effect until it moves the points by about `target`.

    Args:
        drawn: The effect.
        target: Wanted separation, in the unit of the measured values.
        separation: Simulates an effect; returns its separation.
        smallest: Smallest acceptable separation.

    Raises:
        Redraw: The range of the effect allows no separation between `smallest` and twice `target`.
    """
    s = separation(drawn)
    low, high = drawn.smallest, drawn.largest
    factor, slope, previous = 1.0, 1.0, None
    for _ in range(5):
        if 0.85 < s / target < 1.18:
            break
        if previous is not None and s > 0 and previous[1] > 0 and factor != previous[0] and s != previous[1]:
            slope = float(np.clip(math.log(s / previous[1]) / math.log(factor / previous[0]), 0.3, 3.0))
        previous = (factor, s)
        step = (target / s) ** (1 / slope) if s > 0 else 3.0
        factor = float(np.clip(factor * np.clip(step, 1 / 6, 6.0), low, high))
        if factor == previous[0]:
            break
        s = separation(drawn.scaled(factor))
    if not smallest < s < 2.0 * target:
        raise Redraw(f"{drawn.kind} has a separation of {s:.2g}, not {target:.2g}")
    return drawn.scaled(factor)


def rms(d: np.ndarray) -> float:
    """Return the root mean square of all entries."""
    return float(np.sqrt(np.mean(d**2)))


def rounded_to_4(value: float) -> float:
    """Round to four significant digits."""
    return float(f"{value:.4g}")
