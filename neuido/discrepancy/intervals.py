"""How sure the fitted parameters are: noise, nuisances, and what another grid, step or solver would have made of them."""

import math
from collections.abc import Sequence

import numpy as np
from scipy.stats import norm
from scipy.stats import t as student

from neuido.discrepancy.fit import Fit
from neuido.discrepancy.floors import Floor
from neuido.discrepancy.problem import Parameter
from neuido.discrepancy.screening import Screening

QUANTILE = 0.95
"""Of each end of a 90 % interval."""
NORMAL = float(norm.ppf(QUANTILE))
ROOM = 4.0
"""Times the mean square that a refit leaves of the discretisation error up to which a residual above the noise widens an interval."""
NEARBY = 0.02
"""Sum of squares of the amounts of the other settings up to which the data lie on the setting in use."""


def intervals(laboratory: Screening, fit: Fit, floor: Floor, errors: np.ndarray) -> dict[str, tuple[float, float]]:
    """90 % intervals of the parameters of a fit that leaves `errors`, mean squares of the parts.

    Noise, nuisances and the differences of the settings count to first order, as the fit has them. What no difference shows is estimated
    by fits to the motions under other settings, each without its own difference: how far the parameters go, with Student's quantile since
    such fits are few, and scaled by what the residuals leave for it, or by how far the data lie from the setting in use where that is more.
    The residual is of the part where it is largest beside it: where a fit has taken the error of the solver into its parameters, only what
    was held out shows it. A parameter that does nothing may have any value.
    """
    parameters = [laboratory.problem.parameter(name) for name in fit.names]
    above = np.maximum(errors - laboratory.noise_squares, 0.0)
    variances = _first_order(laboratory, parameters, fit, floor)
    away = float(np.sum(laboratory.amounts(fit.point, floor) ** 2))
    if parameters and (away > NEARBY or not laboratory.is_noise(errors)):
        refits = laboratory.refits(fit.point, parameters, floor)
        if refits:
            room = max(_room(above, np.mean([squares for _, squares in refits], axis=0)), min(away, ROOM))
            shifts = np.array([[p.coordinate(f.point[p.name]) - p.coordinate(fit.point[p.name]) for p in parameters] for f, _ in refits])
            variances = variances + room * _widened(len(shifts)) ** 2 * np.mean(shifts**2, axis=0)
    out = {}
    for parameter, deviation in zip(parameters, np.sqrt(variances), strict=True):
        q, half = parameter.coordinate(fit.point[parameter.name]), NORMAL * deviation
        ends = (parameter.lower, parameter.upper)
        out[parameter.name] = (parameter.physical(q - half), parameter.physical(q + half)) if math.isfinite(half) else ends
    return out


def _room(above: np.ndarray, error: np.ndarray) -> float:
    """How many times an error, at most `ROOM`, what is left above the noise has room for; both mean squares of the parts."""
    shares = above / np.maximum(error, 1e-300)
    return min(float(np.max(shares[np.isfinite(shares)], initial=0.0)), ROOM)


def _widened(count: int) -> float:
    """Student's quantile over the normal one, for a deviation about a known mean of so many values."""
    return float(student.ppf(QUANTILE, count)) / NORMAL


def _first_order(laboratory: Screening, parameters: Sequence[Parameter], fit: Fit, floor: Floor) -> np.ndarray:
    """Variances of the coordinates through the slopes, the nuisances and the amounts of the settings' differences marginalised.

    The size of the errors is that of the residual: the weights go by what the settings differ by, which the fit may have taken out.
    """
    if not parameters:
        return np.empty(0)
    whiten, recordings = floor.whitener(laboratory.parts), laboratory.fitted_recordings
    slopes = laboratory.slopes(parameters, fit.point, recordings, step=0.1)
    J = np.concatenate([whiten(slopes[n], n) for n in recordings])
    gain = np.linalg.pinv(J)
    gain[~J.any(axis=0)] = np.inf
    left = np.concatenate([whiten(laboratory.residual(fit.point, n), n) for n in recordings])
    return np.sum(gain**2, axis=1) * float(np.mean(left**2))
