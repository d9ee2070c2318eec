"""What the data do not exclude: for each effect the largest size that is still compatible with them."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.stats import foldnorm, truncnorm

from neuido.discrepancy.inference import directions, discretisation
from neuido.discrepancy.inference.floors import Round, Stand, Trial, patterns
from neuido.discrepancy.inference.laboratory import Laboratory
from neuido.discrepancy.problems.problem import Parameter

COMPATIBLE = 0.9
"""Probability that the size of an effect is smaller than the largest compatible one."""
NOTHING = 1e-10
"""Share of what one size does that it must do by itself beside the other sizes of its effect for these data to limit it."""


class Compatible(NamedTuple):
    """The largest compatible size of an effect."""

    name: str
    parameter: str
    unit: str
    up_to: float | None
    """None: any size within the effect's range."""


def compatible(lab: Laboratory, at: Stand, r: Round, found: Sequence[Trial] = ()) -> list[Compatible]:
    """Return the size that each effect is smaller than with a probability of 90 %, beside the model where it stands.

    To first order, and of the fitted recordings: the size is what the residual holds of the motion that the effect makes, past what the
    fitted figures, the nuisances and the other settings make up for. How far it may be off is told by the noise and by the patterns of what
    another solver does, of the size that the settings leave of one another after a refit; where more is left than both, by that (Birge's
    ratio). Its prior is flat, over one sign where the effect has but one. Of several shapes of an effect the one counts that could be
    largest. Directions are those of the screening, so that next to nothing is simulated anew where effects were looked for.

    Args:
        lab: The method that the answer goes by.
        at: Where the model stands.
        r: The round that looked last.
        found: The effects that the model has.
    """
    problem, recordings = lab.problem, lab.fitted_recordings
    taken = {t.candidate.name for t in found}
    candidates = problem.candidates
    if not candidates or not lab.runs(at.fit.point):
        return []
    own = {name.partition(".")[0] for name in r.base if "." in name}
    free = (*problem.declared, *(p for t in found if t.candidate.name in own for p in t.candidate.parameters))
    with discretisation.quickly(lab, r.base, r.floor):
        slopes = directions.slopes(lab, free, r.base, recordings)
        columns = directions.candidate_columns(lab, r.base, candidates, recordings)
    beside = [columns[t.candidate.key, 0] for t in found if (t.candidate.key, 0) in columns and t.candidate.name not in own]
    past = directions.project_out_slopes(
        lab, {n: np.concatenate([slopes[n], *(c[n] for c in beside)], axis=1) for n in recordings}, at.floor
    )
    left = past({n: lab.residual(at.fit.point, n) for n in recordings})
    unseen = {}
    for part, square in zip(lab.parts, r.floors - lab.noise_squares, strict=True):
        if part.fitted:
            own_rows = patterns(problem, r.floor, part, square)
            unseen[part.recording] = np.zeros((len(part.rows), own_rows.shape[1]))
            unseen[part.recording][part.rows] = own_rows
    S = past(unseen)
    expected = 1.0 + float(np.sum(S**2)) / max(len(left), 1)
    birge = max(float(np.mean(left**2)) / expected, 1.0)
    largest: dict[tuple[str, str], Compatible] = {}
    for c in candidates:
        if c.name in taken:
            continue
        for i, start in enumerate(c.starts):
            means, deviations = amounts(past(columns[c.key, i]), left, S)
            for p, mean, deviation in zip(c.size_parameters, means, deviations * math.sqrt(birge), strict=True):
                size = bound(p, start[p.name] * mean, abs(start[p.name]) * deviation)
                one = Compatible(c.name, p.name.partition(".")[2], p.unit, size if size < max(abs(p.lower), abs(p.upper)) else None)
                before = largest.get((c.name, one.parameter))
                if before is None or (before.up_to is not None and (one.up_to is None or one.up_to > before.up_to)):
                    largest[c.name, one.parameter] = one
    return list(largest.values())


def amounts(B: np.ndarray, left: np.ndarray, S: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the amounts of directions that the measured data hold, and the standard deviation of each.

    Args:
        B: What the prediction gains by an amount of one of each, (n, k), whitened.
        left: Predicted minus measured, (n,), whitened.
        S: Further patterns in `left` beside white noise, of amounts of variance one, (n, s).
    """
    if not (np.isfinite(B).all() and np.isfinite(left).all()):
        return np.zeros(B.shape[1]), np.full(B.shape[1], math.inf)
    G = B.T @ B
    does = np.diag(G)
    inverse = np.linalg.inv(G + np.diag(np.where(does > 0.0, NOTHING * does, 1.0)))
    away = inverse @ (B.T @ S)
    variances = np.diag(inverse) + np.sum(away**2, axis=1)
    return -inverse @ (B.T @ left), np.where(does > 0.0, np.sqrt(variances), math.inf)


def bound(p: Parameter, mean: float, deviation: float) -> float:
    """Return the size that a Gaussian amount is smaller than with a probability of 90 %, within the signs that a parameter has."""
    if not math.isfinite(deviation) or deviation <= 0.0:
        return math.inf
    if p.lower < 0.0 < p.upper:
        return float(deviation * foldnorm.ppf(COMPATIBLE, abs(mean) / deviation))
    mean = mean if p.upper > 0.0 else -mean
    return float(truncnorm.ppf(COMPATIBLE, -mean / deviation, math.inf, loc=mean, scale=deviation))
