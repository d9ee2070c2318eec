"""What the errors of fits say beside each other and beside the noise."""

import math

import numpy as np

from neuido.discrepancy.inference import bootstrap
from neuido.discrepancy.inference.bootstrap import NOISE_ALONE
from neuido.discrepancy.inference.floors import score
from neuido.discrepancy.inference.laboratory import Laboratory
from neuido.discrepancy.problems.problem import Point

LEAST_GAIN = math.log(1.7)
"""Smaller gains are no reason to name anything: other solvers differ by as much in ways that no setting of one solver shows."""
NEARLY = 2.5
"""Times the noise up to which what first fits leave is refined before another method is asked: it may be noise then."""


def moved(lab: Laboratory, point: Point) -> float:
    """The largest ratio of a declared parameter to the value that the model states, or of this to that."""
    ratios = [point[p.name] / p.value for p in lab.problem.declared if p.log]
    return max((max(r, 1.0 / r) for r in ratios), default=1.0)


def tell_lead(lab: Laboratory, key: str, squares: np.ndarray, before: np.ndarray) -> None:
    """Tell which candidate leads and what it leaves, where progress shows that."""
    lead = getattr(lab.tell, "lead", None)
    if lead is not None:
        lead(key, typical(lab, squares), typical(lab, before), lab.problem.unit)


def typical(lab: Laboratory, squares: np.ndarray) -> float:
    """The geometric mean over the parts of root mean squares, in the unit of the data."""
    return lab.scale * math.exp(0.5 * score(squares))


def is_noise(lab: Laboratory, errors: np.ndarray, *, fitted: bool = False) -> bool:
    """Whether nothing but noise is left in any part, or in those of the fitted ones that are given."""
    return bool(np.all(errors < NOISE_ALONE * (lab.noise_squares[lab.fitted] if fitted else lab.noise_squares)))


def may_be_noise(lab: Laboratory, errors: np.ndarray) -> bool:
    """Whether what a fit leaves in any part is so near the noise that it may be that once it is refined."""
    return is_noise(lab, errors / NEARLY**2)


def is_settled(lab: Laboratory, errors: np.ndarray) -> bool:
    """Whether no effect could be named any more: nothing is left but noise, or too little above it for any gain to be enough."""
    hopeless = lab.problem.settings > 1 and gain(lab, errors, lab.noise_squares) < LEAST_GAIN
    return hopeless or is_noise(lab, errors)


def gain(lab: Laboratory, before: np.ndarray, after: np.ndarray) -> float:
    """`bootstrap.gain` of mean squares of the parts."""
    return bootstrap.gain(before, after, lab.fitted, lab.noise_squares)


def foretold(lab: Laboratory, before: np.ndarray, after: np.ndarray) -> float:
    """Logarithm of the ratio of errors of what is held out, or of all parts where nothing is; of mean squares of the parts."""
    fitted = np.array(lab.fitted)
    return bootstrap.ratio(before, after, fitted if fitted.all() else ~fitted)


def fitted_score(lab: Laboratory, errors: np.ndarray) -> float:
    """Score of what is left of the fitted parts, of mean squares of all."""
    return score(errors[lab.fitted])
