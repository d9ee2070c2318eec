"""Upper limits on the sizes of effects that were not found: how large could each effect be without being detected?"""

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from scipy.optimize import brentq
from scipy.stats import t as student

from neuido.discrepancy.inference import directions, discretisation
from neuido.discrepancy.inference.floors import Round, Stand, Trial, patterns
from neuido.discrepancy.inference.laboratory import Laboratory
from neuido.discrepancy.problems.problem import Parameter, Point

COMPATIBLE = 0.9
"""Probability that the size of an effect is below its upper limit."""
NOTHING = 1e-10
"""Least share of the influence of a size that the other sizes of its effect cannot imitate; below it the data give no limit."""


class Compatible(NamedTuple):
    """The upper limit on one parameter of an effect."""

    name: str
    """Name of the effect."""
    parameter: str
    """Name of the parameter, without that of the effect."""
    unit: str
    """Unit of the limit."""
    up_to: float | None
    """The limit; none: the data do not exclude any size within the range of the effect."""


def compatible(lab: Laboratory, at: Stand, r: Round, found: Sequence[Trial] = ()) -> list[Compatible]:
    """Return the size that each effect does not exceed with a probability of 90 %.

    The estimate is linear, from the fitted recordings. The size of an effect is fitted to the residual after the fitted parameters, the
    nuisances and the differences between settings are projected out. Its uncertainty comes from the noise, from smooth patterns of the
    size of the discretisation error after a refit, and from errors of the instruments that no nuisance has (`Problem.instrument_errors`).
    If the residual is larger than all of these, or neighbouring data err alike, the uncertainty grows with it: a residual of few
    independent data may hide an effect of its own size (`excess`). The prior is flat, over one sign if the effect has only one. Of several
    shapes of an effect, the largest limit counts. Recordings of the same data count as one measurement. The directions are those of the
    screening, so that hardly anything is simulated anew after a search.

    Args:
        lab: The method that gives the answer.
        at: The final model.
        r: The last round.
        found: The effects of the final model.

    Returns:
        A limit for each parameter of each other effect; none if there are no candidates or the final model does not run.
    """
    problem, recordings = lab.problem, lab.fitted_recordings
    taken = {t.candidate.name for t in found}
    candidates = [c for c in problem.candidates if not c.needs or c.needs in taken]
    if not candidates or not lab.runs(at.fit.point):
        return []
    own = {name.partition(".")[0] for name in r.base if "." in name}
    free = (*problem.declared, *(p for t in found if t.candidate.name in own for p in t.candidate.parameters))
    with discretisation.quickly(lab, r.base, r.floor):
        slopes = directions.slopes(lab, free, r.base, recordings)
        columns = directions.candidate_columns(lab, r.base, candidates, recordings)
    beside = [columns[t.candidate.key, 0] for t in found if (t.candidate.key, 0) in columns and t.candidate.name not in own]
    copies = _copies(lab)
    weights = {n: len(own) ** -0.5 for own in copies for n in own}

    def once(columns: Mapping[int, np.ndarray]) -> dict[int, np.ndarray]:
        return {n: weights[n] * columns[n] for n in recordings}

    project_all = directions.project_out_slopes(
        lab, once({n: np.concatenate([slopes[n], *(c[n] for c in beside)], axis=1) for n in recordings}), at.floor
    )

    def project(columns: Mapping[int, np.ndarray]) -> np.ndarray:
        return project_all(once(columns))

    left = project({n: lab.residual(at.fit.point, n) for n in recordings})
    unseen = {}
    for part, square in zip(lab.parts, r.floors - lab.noise_squares, strict=True):
        if part.fitted:
            own_rows = patterns(problem, r.floor, part, square)
            unseen[part.recording] = np.zeros((len(part.rows), own_rows.shape[1]))
            unseen[part.recording][part.rows] = own_rows
    S = np.concatenate([project(unseen), project(_each_its_own(lab, at.fit.point, copies))], axis=1)
    count = sum(weights[part.recording] ** 2 * int(part.rows.sum()) for part in lab.parts if part.fitted)
    growth, freedom = excess(left, S, _series(lab), count)
    largest: dict[tuple[str, str], Compatible] = {}
    for c in candidates:
        if c.name in taken:
            continue
        for i, start in enumerate(c.starts):
            means, deviations = amounts(project(columns[c.key, i]), left, S)
            for p, mean, deviation in zip(c.size_parameters, means, deviations * math.sqrt(growth), strict=True):
                size = bound(p, start[p.name] * mean, abs(start[p.name]) * deviation, freedom)
                one = Compatible(c.name, p.name.partition(".")[2], p.unit, size if size < max(abs(p.lower), abs(p.upper)) else None)
                before = largest.get((c.name, one.parameter))
                if before is None or (before.up_to is not None and (one.up_to is None or one.up_to > before.up_to)):
                    largest[c.name, one.parameter] = one
    return list(largest.values())


def amounts(B: np.ndarray, left: np.ndarray, S: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the amount of each direction that explains the residual best, (k,), and its standard deviation, (k,).

    Args:
        B: Change of the prediction by an amount of one of each direction, (n, k), whitened.
        left: Predicted minus measured, (n,), whitened.
        S: Patterns that `left` may hold beside white noise, (n, s), with amounts of variance one.
    """
    if not (np.isfinite(B).all() and np.isfinite(left).all()):
        return np.zeros(B.shape[1]), np.full(B.shape[1], math.inf)
    G = B.T @ B
    squares = np.diag(G)
    inverse = np.linalg.inv(G + np.diag(np.where(squares > 0.0, NOTHING * squares, 1.0)))
    bias = inverse @ (B.T @ S)
    variances = np.diag(inverse) + np.sum(bias**2, axis=1)
    return -inverse @ (B.T @ left), np.where(squares > 0.0, np.sqrt(variances), math.inf)


def excess(left: np.ndarray, S: np.ndarray, series: Sequence[np.ndarray], count: float | None = None) -> tuple[float, float]:
    """Return the factor by which a residual enlarges the variance of what is fitted to it, and the degrees of freedom of that estimate.

    The factor is the mean square of the residual (Birge's ratio), divided by the share of the data that is independent. That share is
    (1 - r) / (1 + r) for a correlation r of neighbouring data (Bayley and Hammersley 1946). The factor is at least one.

    Args:
        left: Residual, (n,), whitened.
        S: Patterns that `left` may hold beside white noise, (n, s), with amounts of variance one.
        series: Indices of the data of each series, in the order of time.
        count: Number of data that `left` stands for; its length by default.
    """
    n = max(len(left) if count is None else count, 1)
    white = left - S @ np.linalg.solve(np.eye(S.shape[1]) + S.T @ S, S.T @ left)
    products = sum(float(white[i[1:]] @ white[i[:-1]]) for i in series)
    alike = float(np.clip(products / max(float(white @ white), 1e-300), 0.0, 1 - 2 / (n + 1)))  # so that one datum is left at the least
    independent = n * (1 - alike) / (1 + alike)
    return max(float(left @ white) / independent, 1.0), max(independent - 1, 1.0)


def _copies(lab: Laboratory) -> list[list[int]]:
    """Return the fitted recordings in lists of the same data: a copy of a recording is no second measurement."""
    found: dict[tuple[bytes, ...], list[int]] = {}
    for n in lab.fitted_recordings:
        own = lab.problem.recordings[n]
        found.setdefault(tuple(part.tobytes() for part in (own.y, own.groups, own.times)), []).append(n)
    return list(found.values())


def _each_its_own(lab: Laboratory, point: Point, copies: Sequence[Sequence[int]]) -> dict[int, np.ndarray]:
    """Return the errors of the instruments of each fitted recording, (n, k): columns of its own and its copies', zero in the others."""
    found = {n: lab.problem.instrument_errors(point, n) for n in lab.fitted_recordings}
    width, out, begun = sum(found[own[0]].shape[1] for own in copies), {}, 0
    for own in copies:
        for n in own:
            out[n] = np.zeros((len(found[n]), width))
            out[n][:, begun : begun + found[n].shape[1]] = found[n]
        begun += found[own[0]].shape[1]
    return out


def _series(lab: Laboratory) -> list[np.ndarray]:
    """Return the indices of the data of each series, in the order of time, among the fitted rows of all recordings together."""
    out, begun = [], 0
    masks = {p.recording: p.rows for p in lab.parts if p.fitted}
    for n in lab.fitted_recordings:
        groups, times = (of[masks[n]] for of in (lab.problem.recordings[n].groups, lab.problem.recordings[n].times))
        order = np.lexsort((times, groups))
        out += [begun + own for own in np.split(order, np.flatnonzero(np.diff(groups[order])) + 1)]
        begun += len(groups)
    return out


def bound(p: Parameter, mean: float, deviation: float, freedom: float = math.inf) -> float:
    """Return the size that an amount does not exceed with a probability of 90 %, if the range of `p` limits its sign.

    The amount has Student's distribution, which is Gaussian for infinitely many degrees of freedom. The size is infinite if the deviation
    is zero or not finite.
    """
    if not math.isfinite(deviation) or deviation <= 0.0:
        return math.inf
    if p.lower < 0.0 < p.upper:
        at = abs(mean) / deviation
        most = at + float(student.ppf(0.5 * (1 + COMPATIBLE), freedom))
        within = brentq(lambda u: student.cdf(u - at, freedom) - student.cdf(-u - at, freedom) - COMPATIBLE, 0.0, most * (1 + 1e-9))
        return float(deviation * within)
    at = (mean if p.upper > 0.0 else -mean) / deviation
    return float(deviation * (at + student.isf((1 - COMPATIBLE) * student.cdf(at, freedom), freedom)))
