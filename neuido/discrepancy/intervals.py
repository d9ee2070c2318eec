"""How sure the fitted parameters are: noise, nuisances, and what another grid, step or solver would have made of them."""

from collections.abc import Sequence

import numpy as np
from scipy.stats import norm
from scipy.stats import t as student

from neuido.discrepancy.fit import Fit
from neuido.discrepancy.floors import Floor
from neuido.discrepancy.laboratory import Laboratory
from neuido.discrepancy.problem import Parameter

QUANTILE = 0.95
"""Of each end of a 90 % interval."""
NORMAL = float(norm.ppf(QUANTILE))


def intervals(laboratory: Laboratory, fit: Fit, floor: Floor, errors: np.ndarray) -> dict[str, tuple[float, float]]:
    """90 % intervals of the parameters of a fit that leaves `errors`, mean squares of the parts.

    The discretisation error comes from few settings, so that its share has Student's quantile. It is estimated twice, and the larger
    one counts: to first order, as the differences of the settings go through the slopes, and as the parameters of fits to the motions under
    other settings. Each is scaled by the room that the residuals leave for it. That is of the part whose residual is largest beside
    it: where a fit has taken the error of the solver into its parameters, only what was held out shows it.
    """
    parameters = [laboratory.problem.parameter(name) for name in fit.names]
    noise = np.array([floor.noise[p.recording] ** 2 for p in laboratory.parts])
    above = np.maximum(errors - noise, 0.0)
    spread = np.array([np.mean(floor.spread[p.recording][p.rows] ** 2) for p in laboratory.parts])
    variances, solver = _first_order(laboratory, parameters, fit, floor, _room(above, spread))
    if parameters and not laboratory.is_noise(errors):
        refits = laboratory.refits(fit.point, parameters, floor)
        if refits:
            room = _room(above, np.mean([squares for _, squares in refits], axis=0))
            shifts = np.array([[p.coordinate(f.point[p.name]) - p.coordinate(fit.point[p.name]) for p in parameters] for f, _ in refits])
            solver = np.maximum(solver, room * _widened(len(shifts)) ** 2 * np.mean(shifts**2, axis=0))
    out = {}
    for parameter, deviation in zip(parameters, np.sqrt(variances + solver), strict=True):
        q, half = parameter.coordinate(fit.point[parameter.name]), NORMAL * deviation
        out[parameter.name] = (parameter.physical(q - half), parameter.physical(q + half))
    return out


def _room(above: np.ndarray, error: np.ndarray) -> float:
    """The largest share, at most all, of an error that what is left above the noise has room for; both mean squares of the parts."""
    shares = above / np.maximum(error, 1e-300)
    return min(float(np.max(shares[np.isfinite(shares)], initial=0.0)), 1.0)


def _widened(count: int) -> float:
    """Student's quantile over the normal one, for a deviation about a known mean of so many values."""
    return float(student.ppf(QUANTILE, count)) / NORMAL


def _first_order(
    laboratory: Laboratory, parameters: Sequence[Parameter], fit: Fit, floor: Floor, room: float
) -> tuple[np.ndarray, np.ndarray]:
    """Variances of the coordinates by noise and nuisances, and by the differences of the settings, through the slopes."""
    parts = [p for p in laboratory.parts if p.fitted]
    slopes = laboratory.slopes(parameters, fit.point, [p.recording for p in parts], step=0.1)
    gain = np.linalg.pinv(np.concatenate([laboratory.weighted(slopes[p.recording], p, floor) for p in parts]))
    variances, solver, at = np.zeros(len(parameters)), np.zeros(len(parameters)), 0
    for p in parts:
        n, w = p.recording, floor.weight[p.recording][p.rows]
        own = gain[:, at : at + len(w)]
        at += len(w)
        variances += floor.noise[n] ** 2 * np.sum((own * w) ** 2, axis=1)
        if n in floor.nuisances:
            variances += min(room + 0.05, 1.0) * np.sum((own @ laboratory.weighted(floor.nuisances[n], p, floor)) ** 2, axis=1)
        count = max(floor.differences[n].shape[1], 1)
        shifts = own @ laboratory.weighted(floor.differences[n], p, floor)
        solver += room * _widened(count) ** 2 * np.sum(shifts**2, axis=1) / count
    return variances, solver
