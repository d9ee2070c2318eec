"""How large an effect is made: until the recorded points part by so many times the noise."""

import math
from collections.abc import Callable

import numpy as np

from neuido.data.undeclared.random_effects import Drawn

MIN_SEPARATION, MAX_SEPARATION = 15.0, 150.0
"""Separation over noise that a case may have."""
OVER_FLOOR = 2.0
"""Separation over what the solvers differ by, at the least; an effect below it could not be named by anybody."""


class Redraw(Exception):
    """What was drawn does not make a case."""


def scale_to_separation(drawn: Drawn, target: float, separation: Callable[[Drawn], float], least: float) -> Drawn:
    """Scale an effect until it moves the points by `target` [m], as near as its range allows, and by at least `least`."""
    s = separation(drawn)
    low, high = drawn.least, drawn.most
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
        s = separation(drawn.times(factor))
    if not least < s < 2.0 * target:
        raise Redraw(f"{drawn.kind} moves the points by {s:.2g} m and not by {target:.2g} m")
    return drawn.times(factor)


def rms(d: np.ndarray) -> float:
    """Return the root mean square."""
    return float(np.sqrt(np.mean(d**2)))


def rounded_to_4(value: float) -> float:
    """Round to four digits."""
    return float(f"{value:.4g}")
