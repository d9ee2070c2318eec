"""Confidence intervals of fitted parameters, and findings that forbid an answer."""

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
"""Probability below the upper end of a 90 % interval."""
NORMAL = float(norm.ppf(QUANTILE))
ROOM = 4.0
"""Largest factor by which a residual above the noise may scale the estimated discretisation error of an interval, a ratio of mean
squares."""
NEARBY = 0.02
"""Sum of squares of the amounts of the other settings up to which the data are taken to lie on the setting in use."""


def intervals(lab: Laboratory, fit: Fit, floor: Floor, errors: np.ndarray) -> dict[str, tuple[float, float]]:
    """Return 90 % intervals of the fitted parameters, in their physical units.

    Noise, nuisances and the differences between settings count to first order, as in the fit. Solver errors that no difference shows are
    estimated by refits: the motion under each other setting is fitted without its own difference, and the shifts of the parameters are
    measured. The shifts count with Student's quantile, because there are few refits. They are scaled by the part with the largest residual
    relative to what the refits leave, or by the distance of the data from the setting in use where that is more. Held-out parts count here,
    because a fit may hide the error of the solver in its parameters.

    A parameter without influence on the data gets its whole range.

    Args:
        lab: The method that predicts.
        fit: The fit.
        floor: Noise and discretisation at its end.
        errors: Mean squares of its residual, of each part.
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
    """Return by what factor, at most `ROOM`, a solver's error fits into what is left above the noise; mean squares of the parts."""
    shares = above / np.maximum(error, 1e-300)
    return min(float(np.max(shares[np.isfinite(shares)], initial=0.0)), ROOM)


def _widened(count: int) -> float:
    """Return the ratio of Student's to the normal quantile, for a deviation from `count` values with a known mean."""
    return float(student.ppf(QUANTILE, count)) / NORMAL


def _first_order(lab: Laboratory, parameters: Sequence[Parameter], fit: Fit, floor: Floor) -> np.ndarray:
    """Return variances of the fit coordinates to first order, with nuisances and amounts of the settings' differences marginalised.

    The size of the errors is that of the residual, because the weights rest on differences between settings that the fit may have removed.
    """
    if not parameters:
        return np.empty(0)
    whiten, recordings = floor.whitener(lab.parts), lab.fitted_recordings
    slopes = directions.slopes(lab, parameters, fit.point, recordings, step=0.1)
    J = np.concatenate([whiten(slopes[n], n) for n in recordings])
    known = np.isfinite(J).all(axis=0)  # the model may fail just beside the point; then nothing is known of the parameter
    gain = np.linalg.pinv(np.where(known, J, 0.0))
    gain[~(known & J.any(axis=0))] = np.inf
    left = np.concatenate([whiten(lab.residual(fit.point, n), n) for n in recordings])
    return np.sum(gain**2, axis=1) * float(np.mean(left**2))


TOLD = 3.84
"""The 95 % quantile of chi squared with one degree of freedom. The data do not determine a figure whose change costs less."""
AT_BOUND = 1e-6
"""Relative distance from a bound within which a figure stands at it."""
FREE_AT = {"poisson": "upper"}
"""Bounds at which a figure may stand without a fault: an incompressible body has the largest Poisson's ratio."""


def findings(lab: Laboratory, at: Stand) -> list[str]:
    """Return sentences on fitted figures of the declared model that stand at a bound or far from their declared values.

    A figure counts only if the data determine it: moved back to a plausible value, with the others unchanged, it must make the fit worse by
    more than chance.
    """
    point, out = at.fit.point, []
    for p in lab.problem.declared:
        value = point.get(p.name, p.value)
        said = f"{p.name} would be {value:.3g} {p.unit} (declared: {p.value:.3g} {p.unit})"
        ends = [
            side for side in ("lower", "upper") if FREE_AT.get(p.name) != side and _is_at(p, value, side) and not _is_at(p, p.value, side)
        ]
        near = min(max(p.value, min(shown := lab.problem.shown(point, p))), max(shown))
        ratio = max(near / p.value, p.value / near) if p.log else 1.0
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
    """Return whether a value stands at the `lower` or the `upper` bound of a parameter."""
    bound = getattr(p, side)
    return abs(value - bound) <= AT_BOUND * max(abs(bound), 0.0 if p.log else p.scale)


def would_help(kind: str, *, discretised: bool) -> list[str]:
    """Return suggestions for measurements or settings that would let a further diagnosis say more."""
    out = ["a longer or faster recording of the same body", "a recording of another launch, fitted beside these"]
    if kind == "material test":
        out = ["tests to larger strain, in another mode, or at another rate", "a repeated test, which gives the scatter of the specimens"]
    if kind == "plane specimen":
        out = ["load steps of larger strain", "forces that are known better than within one per cent", "less noise in the displacements"]
    if discretised:
        out = ["a finer grid and a smaller time step in the scene", *out, "more views or more tracked points"]
    return out


def unable(lab: Laboratory) -> Mapping[str, list[str]]:
    """Return the names of the other settings that do not run at the model's final point, by recording."""
    problem = lab.problem
    return {problem.recordings[n].name: [problem.setting_name(s) for s in own] for n, own in lab.unable.items() if own}


def blind_to_settings(lab: Laboratory) -> bool:
    """Return whether no other setting runs for some recording, so that its discretisation error is unknown."""
    others = lab.problem.others(lab.setting)
    return bool(others) and any(len(own) == len(others) for own in lab.unable.values())
