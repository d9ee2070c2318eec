"""Whether an error of the length scale would explain a track as well as the effects that were named."""

import numpy as np

from neuido.discrepancy.problems.problem import Point, Problem

WIDE = 0.1
"""Standard deviation of the length scale with which the model without effects is fitted again: far wider than any calibration."""
AS_WELL = 1.05
"""Ratio of two errors up to which one model fits as well as the other; the words compare rivals from the same ratio on."""


def rival_scale(problem: Problem, before: Point, after: Point) -> list[float] | None:
    """Return the smallest and the largest error of the length scale by which the model without effects fits as well as with them.

    There is one for each fitted recording, and all must be of one sign. None: the data are no lengths of a track, or the effects leave
    less.

    Args:
        problem: What was diagnosed.
        before: The fit without effects.
        after: The fit with the named effects.
    """
    if not hasattr(problem, "with_scale_error") or problem.unit != "m":
        return None
    other = problem.with_scale_error(WIDE)
    fitted = problem.roles["fit"]
    left, by_scale = (sum(_squares(one, point, n) for n in fitted) for one, point in ((problem, after), (other, before)))
    if not by_scale < AS_WELL**2 * left:
        return None
    found = [other.nuisances_of(before, n)[f"length_scale:{problem.recordings[n].name}"] for n in fitted]
    return [min(found, key=abs), max(found, key=abs)] if min(found) > 0 or max(found) < 0 else None


def _squares(problem: Problem, point: Point, recording: int) -> float:
    return float(np.sum((problem.predict([point], recording)[0] - problem.recordings[recording].y) ** 2))
