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
from neuido.discrepancy.problems.problem import Parameter, Point

QUANTILE = 0.95
"""Probability below the upper end of a 90 % interval."""
NORMAL = float(norm.ppf(QUANTILE))
ROOM = 4.0
"""Largest factor by which a residual above the noise may scale the estimated discretisation error of an interval, a ratio of mean
squares."""
HALF_TURN = math.pi
"""Angle after which a direction of an axis repeats itself."""
FIRST_STEP = 0.125
"""Half of the first step of a profile, in typical steps of the parameter; each further one is twice as long."""
TRIES = 14
"""Refits of each end of a profile at the most: ten doublings reach a hundred typical steps, and four more halve what is left."""
PROFILED = 4
"""Number of fitted parameters up to which all intervals are profiled where one linear interval fails; with more, those that fail."""
AT_LEAST = 1000
"""Simulations that all profiles of a diagnosis may take, however few the search took."""
CLOSE = 0.03
"""Relative error of the root of the rise at which the end of a profile is found."""
NEARBY = 0.02
"""Sum of squares of the amounts of the other settings up to which the data are taken to lie on the setting in use."""


def intervals(lab: Laboratory, fit: Fit, floor: Floor, errors: np.ndarray) -> dict[str, tuple[float, float]]:
    """Return 90 % intervals of the fitted parameters, in their physical units.

    Noise, nuisances and the differences between settings count to first order, as in the fit. Solver errors that no difference shows are
    estimated by refits: the motion under each other setting is fitted without its own difference, and the shifts of the parameters are
    measured. The shifts count with Student's quantile, because there are few refits. They are scaled by the part with the largest residual
    relative to what the refits leave, or by the distance of the data from the setting in use where that is more. Held-out parts count here,
    because a fit may hide the error of the solver in its parameters.

    Where nothing is discretised and an interval would leave the range of its parameter, the linear model has failed: at an angle where the
    prediction is stationary, or beside a size of zero, slopes say nothing. The intervals are found by refits then (`profiled`), those of
    all parameters if there are at most `PROFILED`. Elsewhere a parameter without influence on the data gets its whole range.

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
    out, failed = {}, []
    for parameter, deviation in zip(parameters, np.sqrt(variances), strict=True):
        q, half = parameter.coordinate(fit.point[parameter.name]), NORMAL * deviation
        ends = (parameter.lower, parameter.upper)
        out[parameter.name] = (parameter.physical(q - half), parameter.physical(q + half)) if math.isfinite(half) else ends
        low, high = _range(parameter, q)
        failed += [parameter] if not (low <= q - half and q + half <= high) else []
    if not failed or lab.problem.settings > 1:
        return out
    return out | profiled(lab, fit, floor, parameters if len(parameters) <= PROFILED else failed, failed)


class _End:
    """One end of a profiled interval: the coordinates between which it lies, each with the root of the rise of the misfit."""

    def __init__(self, parameter: Parameter, fit: Fit, side: int) -> None:
        self.parameter, self.side, self.point = parameter, side, fit.point
        self.inside, self.outside = (parameter.coordinate(fit.point[parameter.name]), 0.0), (math.nan, math.inf)
        self.limit = _range(parameter, self.inside[0])[side > 0]
        self.step = FIRST_STEP
        self.found = self.inside[0] == self.limit

    def next(self, rise: float) -> float:
        """Return the coordinate to try next: twice as far as before, or by interpolation where the end is enclosed."""
        (q, root), (beyond, above) = self.inside, self.outside
        if math.isinf(above):
            self.step *= 2.0
            return min(q + self.step, self.limit) if self.side > 0 else max(q - self.step, self.limit)
        return q + (beyond - q) * float(np.clip((rise - root) / (above - root), 0.1, 0.9))

    def take(self, q: float, fit: Fit, root: float, rise: float) -> None:
        """Note the root of the rise of the misfit at a coordinate."""
        near = abs(root - rise) < CLOSE * rise
        if root <= rise or near:
            self.inside, self.point = (q, root), fit.point
        else:
            self.outside = (q, root)
        self.found = near or self.inside[0] == self.limit


def profiled(
    lab: Laboratory, fit: Fit, floor: Floor, parameters: Sequence[Parameter], still: Sequence[Parameter] = ()
) -> dict[str, tuple[float, float]]:
    """Return 90 % intervals by the profile of the misfit: the values with which a refit of the others leaves as little as chance allows.

    The unit of the misfit is what the fit leaves for each datum, as to first order. Directions are looked for within a quarter of a turn on
    either side, which is every direction of an axis. Profiles take no more simulations than all that was done before them, or `AT_LEAST`;
    an interval that is not found by then is left out.

    Args:
        lab: The method that predicts.
        fit: The fit.
        floor: Noise and discretisation at its end.
        parameters: Parameters whose intervals are wanted.
        still: Parameters whose slopes may be zero at the fit, where a refit of them would stay: refits also begin a typical step away.
    """
    others = {p.name: [lab.problem.parameter(name) for name in fit.names if name != p.name] for p in parameters}
    white = floor.whitener(lab.parts)
    left = np.concatenate([white(lab.residual(fit.point, n), n) for n in lab.fitted_recordings])
    rise = NORMAL * float(np.sqrt(np.mean(left**2)))
    every = [lab.problem.parameter(name) for name in fit.names]
    anew = lab.fits([lab.request(every, start, until=math.inf) for start in _starts(fit.point, still)], floor, step="intervals")
    least = min(lab.costs([fit.point, *(one.point for one in anew)], floor))
    ends = [_End(p, fit, side) for p in parameters for side in (-1, 1)]
    before = lab.memo.simulations
    for _ in range(TRIES):
        open_ends = [end for end in ends if not end.found]
        if not open_ends or lab.memo.simulations > before + max(before, AT_LEAST):
            break
        tried = [end.next(rise) for end in open_ends]
        begun = [
            (i, {**start, end.parameter.name: end.parameter.physical(q)})
            for i, (end, q) in enumerate(zip(open_ends, tried, strict=True))
            for start in _starts(end.point, [p for p in still if p is not end.parameter])
        ]
        requests = [
            lab.request(others[open_ends[i].parameter.name], start, until=math.inf, iterations=8, tolerance=discretisation.ROUGH)
            for i, start in begun
        ]
        fits = lab.fits(requests, floor, step="intervals")
        for i, (end, q) in enumerate(zip(open_ends, tried, strict=True)):
            found = min((one for (j, _), one in zip(begun, fits, strict=True) if j == i), key=lambda one: one.cost)
            end.take(q, found, math.sqrt(max(found.cost - least, 0.0)), rise)
    pairs = zip(parameters, ends[::2], ends[1::2], strict=True)
    return {p.name: (p.physical(low.inside[0]), p.physical(high.inside[0])) for p, low, high in pairs if low.found and high.found}


def _starts(point: Point, still: Sequence[Parameter]) -> list[Point]:
    """Return the points from which a refit begins: a point, and where slopes may be zero the same with these parameters moved by a step."""
    away = {}
    for p in still:
        q = p.coordinate(point[p.name])
        away[p.name] = p.physical(q + 1.0) if q + 1.0 <= _range(p, q)[1] else p.physical(q - 1.0)
    return [point, {**point, **away}] if away else [point]


def _range(parameter: Parameter, q: float) -> tuple[float, float]:
    """Return the coordinates between which an interval about q may lie: the range, or of a direction half a turn."""
    low, high = (parameter.coordinate(v) if v > 0 or not parameter.log else -math.inf for v in (parameter.lower, parameter.upper))
    turn = HALF_TURN / parameter.scale if parameter.unit == "rad" else math.inf
    return max(low, q - 0.5 * turn), min(high, q + 0.5 * turn)


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
