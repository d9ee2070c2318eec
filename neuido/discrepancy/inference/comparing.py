"""Comparison of the errors of fits with each other and with the noise."""

import math

import numpy as np

from neuido.discrepancy.inference import bootstrap
from neuido.discrepancy.inference.bootstrap import NOISE_ALONE
from neuido.discrepancy.inference.floors import score
from neuido.discrepancy.inference.laboratory import Laboratory
from neuido.discrepancy.problems.problem import Point

LEAST_GAIN = math.log(1.7)
"""Least gain with which an effect is named: other solvers differ by as much in ways that no setting of one solver shows."""
NEARLY = 2.5
"""If a first fit leaves at most this many times the noise, it is refined before another method is tried: it may reach the noise."""


def moved(lab: Laboratory, point: Point) -> float:
    """Return the largest factor by which a fit raised or lowered a declared parameter that is fitted as a logarithm; 1 without any."""
    ratios = [point[p.name] / p.value for p in lab.problem.declared if p.log]
    return max((max(r, 1.0 / r) for r in ratios), default=1.0)


def report_lead(lab: Laboratory, key: str, squares: np.ndarray, before: np.ndarray) -> None:
    """Report the leading candidate and the errors with and without it to the progress display, if that shows them."""
    lead = getattr(lab.tell, "lead", None)
    if lead is not None:
        lead(key, typical_error(lab, squares), typical_error(lab, before), lab.problem.unit)


def typical_error(lab: Laboratory, squares: np.ndarray) -> float:
    """Return the geometric mean over the parts of their root mean squares, in the unit of the problem."""
    return lab.scale * math.exp(0.5 * score(squares))


def is_noise(lab: Laboratory, errors: np.ndarray, *, fitted: bool = False) -> bool:
    """Return whether the errors of all parts are at the noise; with `fitted`, `errors` holds the fitted parts alone."""
    return bool(np.all(errors < NOISE_ALONE * (lab.noise_squares[lab.fitted] if fitted else lab.noise_squares)))


def may_be_noise(lab: Laboratory, errors: np.ndarray) -> bool:
    """Return whether the errors of all parts are so close to the noise that a refined fit may reach it."""
    return is_noise(lab, errors / NEARLY**2)


def is_settled(lab: Laboratory, errors: np.ndarray) -> bool:
    """Return whether no further effect can be named: only noise is left, or no gain down to the noise would be enough."""
    hopeless = lab.problem.settings > 1 and gain(lab, errors, lab.noise_squares) < LEAST_GAIN
    return hopeless or is_noise(lab, errors)


def gain(lab: Laboratory, before: np.ndarray, after: np.ndarray) -> float:
    """Return `bootstrap.gain` between mean squares of the parts."""
    return bootstrap.gain(before, after, lab.fitted, lab.noise_squares)


def held_out_gain(lab: Laboratory, before: np.ndarray, after: np.ndarray) -> float:
    """Return the logarithm of the error before over the error after of the held-out parts, or of all parts if none is held out."""
    fitted = np.array(lab.fitted)
    return bootstrap.ratio(before, after, fitted if fitted.all() else ~fitted)


def fitted_score(lab: Laboratory, errors: np.ndarray) -> float:
    """Return the score of the fitted parts, given the mean squares of all parts."""
    return score(errors[lab.fitted])
