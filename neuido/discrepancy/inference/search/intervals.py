"""How sure the fitted parameters are, and what forbids an answer."""

import math
from collections.abc import Mapping, Sequence

import numpy as np
from scipy.stats import norm
from scipy.stats import t as student

from neuido.discrepancy.inference import comparing, directions, discretisation
from neuido.discrepancy.inference.floors import Floor, Stand
from neuido.discrepancy.inference.laboratory import Laboratory
from neuido.discrepancy.inference.least_squares import Fit
from neuido.discrepancy.inference.search.judging import IMPLAUSIBLE
from neuido.discrepancy.problems.problem import Parameter

QUANTILE = 0.95
"""Of each end of a 90 % interval."""
NORMAL = float(norm.ppf(QUANTILE))
ROOM = 4.0
"""Times the mean square that a refit leaves of the discretisation error up to which a residual above the noise widens an interval."""
NEARBY = 0.02
"""Sum of squares of the amounts of the other settings up to which the data lie on the setting in use."""


def intervals(lab: Laboratory, fit: Fit, floor: Floor, errors: np.ndarray) -> dict[str, tuple[float, float]]:
    """90 % intervals of the parameters of a fit that leaves `errors`, mean squares of the parts.

    Noise, nuisances and the differences of the settings count to first order, as the fit has them. What no difference shows is estimated
    by fits to the motions under other settings, each without its own difference: how far the parameters go, with Student's quantile since
    such fits are few, and scaled by what the residuals leave for it, or by how far the data lie from the setting in use where that is more.
    The residual is of the part where it is largest beside it: where a fit has taken the error of the solver into its parameters, only what
    was held out shows it. A parameter that does nothing may have any value.
    """
    parameters = [lab.problem.parameter(name) for name in fit.names]
    above = np.maximum(errors - lab.noise_squares, 0.0)
    variances = _first_order(lab, parameters, fit, floor)
    away = float(np.sum(lab.amounts(fit.point, floor) ** 2))
    if parameters and (away > NEARBY or not comparing.is_noise(lab, errors)):
        refits = discretisation.refits(lab, fit.point, parameters, floor)
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


def _first_order(lab: Laboratory, parameters: Sequence[Parameter], fit: Fit, floor: Floor) -> np.ndarray:
    """Variances of the coordinates through the slopes, the nuisances and the amounts of the settings' differences marginalised.

    The size of the errors is that of the residual: the weights go by what the settings differ by, which the fit may have taken out.
    """
    if not parameters:
        return np.empty(0)
    whiten, recordings = floor.whitener(lab.parts), lab.fitted_recordings
    slopes = directions.slopes(lab, parameters, fit.point, recordings, step=0.1)
    J = np.concatenate([whiten(slopes[n], n) for n in recordings])
    known = np.isfinite(J).all(axis=0)  # beside a point where the model just runs it may not: then nothing is known of the parameter
    gain = np.linalg.pinv(np.where(known, J, 0.0))
    gain[~(known & J.any(axis=0))] = np.inf
    left = np.concatenate([whiten(lab.residual(fit.point, n), n) for n in recordings])
    return np.sum(gain**2, axis=1) * float(np.mean(left**2))


TOLD = 3.84
"""The 95 % quantile of chi squared with one degree of freedom: a figure whose change costs less is not told by the data."""
AT_BOUND = 1e-6
"""Relative distance from a bound at which a figure stands on it."""
FREE_AT = {"poisson": "upper"}
"""Bounds that are no sign of a fault: an incompressible body is one."""


def findings(lab: Laboratory, at: Stand) -> list[str]:
    """Return what is wrong with fitted figures of the declared model, in words: those at a bound, and those far from what was declared.

    A figure counts where the data tell it: put back to what is plausible, the others as they are, the fit is worse by more than chance.
    """
    point, out = at.fit.point, []
    for p in lab.problem.declared:
        value = point.get(p.name, p.value)
        said = f"{p.name} would be {value:.3g} {p.unit} (declared: {p.value:.3g} {p.unit})"
        ends = [
            side for side in ("lower", "upper") if FREE_AT.get(p.name) != side and _is_at(p, value, side) and not _is_at(p, p.value, side)
        ]
        ratio = max(value / p.value, p.value / value) if p.log else 1.0
        if not ends and ratio <= IMPLAUSIBLE:
            continue
        back = {**point, p.name: min(max(value, p.value / IMPLAUSIBLE), p.value * IMPLAUSIBLE) if ratio > IMPLAUSIBLE else p.value}
        if lab.costs([back], at.floor)[0] - lab.costs([point], at.floor)[0] < TOLD:
            continue
        if ends:
            out.append(f"{said}, the {ends[0]} end of what is possible")
        else:
            out.append(f"{said}, {ratio:.0f} times {'more' if value > p.value else 'less'}")
    return out


def _is_at(p: Parameter, value: float, side: str) -> bool:
    """Whether a value stands at the `lower` or the `upper` bound of a parameter."""
    bound = getattr(p, side)
    return abs(value - bound) <= AT_BOUND * max(abs(bound), 0.0 if p.log else p.scale)


def would_help(kind: str, *, discretised: bool) -> list[str]:
    """What would let a further diagnosis say more, in words."""
    out = ["a longer or faster recording of the same body", "a recording of another launch, fitted beside these"]
    if kind == "material test":
        out = ["tests to larger strain, in another mode, or at another rate", "a repeated test, which gives the scatter of the specimens"]
    if discretised:
        out = ["a finer grid and a smaller time step in the scene", *out, "more views or more tracked points"]
    return out


def unable(lab: Laboratory) -> Mapping[str, list[str]]:
    """The names of the other settings that do not run where the model stands, by recording."""
    problem = lab.problem
    return {problem.recordings[n].name: [problem.setting_name(s) for s in own] for n, own in lab.unable.items() if own}


def blind_to_settings(lab: Laboratory) -> bool:
    """Whether no other setting runs in some recording, so that its discretisation error is not known."""
    others = lab.problem.others(lab.setting)
    return bool(others) and any(len(own) == len(others) for own in lab.unable.values())
