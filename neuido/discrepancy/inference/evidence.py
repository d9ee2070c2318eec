"""The evidence of each model: how well what was held out is foretold from what was fitted, less the price of the search.

    E(M) = log p(y_validation | y_fitted, M) - log(k C(K, m))

for a set of m of K effects, with k kinds of model (`KINDS`). The exponential of E is a prior weight times a predictive density, and the
weights of all models sum to one at most. Under the declared model the mean of a ratio of densities is one; so by Markov's inequality the
probability that any model leads it by more than log((k - 1) / alpha) is below alpha, whatever was tried.

This is computed beside the present decision, from stored fits, and decides nothing yet.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from scipy.special import logsumexp

from neuido.discrepancy.inference.journal import CaseRecord, FitRecord
from neuido.discrepancy.inference.likelihood import SCALES, Rotated, log_densities, log_mean, log_prior, rotated, share
from neuido.discrepancy.inference.statistics import FitStatistics, PartStatistics
from neuido.discrepancy.problems.problem import Parameter

KINDS = 5
"""Kinds of model, of equal prior weight: none, one, two or three effects, and what no effect explains."""
ALPHA = 0.05
"""Probability of naming anything where nothing is missing, and of a class that lacks the true effect."""
WIDE = 10.0
"""Prior standard deviation of a parameter without a finite range, in its typical steps."""
LEAST = 0.1
"""Share of the noise that the patterns' scale is at the least: finer settings than those that were tried differ by something too."""


@dataclass(frozen=True)
class Evidence:
    """A model with its evidence."""

    record: FitRecord
    value: float
    scale: float
    """About which the patterns' scale is taken: what the settings leave of one another after a refit, in the unit of the data."""
    unknown: bool = False
    """Whether its patterns' scale is free, so that they stand for what no effect explains."""

    @property
    def effects(self) -> tuple[str, ...]:
        """Keys of its effects, in alphabetical order."""
        return tuple(sorted(self.record.effects))


@dataclass(frozen=True)
class Verdict:
    """What the evidences of a case say."""

    answer: str
    """`effect`, `class`, `unknown` or `none`."""
    sets: tuple[tuple[str, ...], ...]
    """The smallest group of sets that holds all but a probability of `ALPHA`, the best first."""
    lead: float
    """Of the best model over the declared one."""


def price(effects: int, candidates: int) -> float:
    """Return the logarithm of one over the prior weight of a set of effects."""
    return math.log(KINDS * math.comb(candidates, effects))


def prior_of(case: CaseRecord, fit: FitRecord) -> tuple[np.ndarray, np.ndarray]:
    """Return how far a fit ended from the prior mean of each free parameter, and the prior variances, in the coordinates of fits.

    The mean is what is declared, the absence of an effect for its size, and the middle of the range for a logarithm without such a value.
    """
    known = {p["name"]: Parameter(**p) for p in (*case.declared, *(p for c in case.candidates for p in c["parameters"]))}
    away, variances = [], []
    for name in fit.names:
        p = known[name]
        span = p.coordinate(p.upper) - p.coordinate(p.lower) if not (p.log and p.lower <= 0) else math.inf
        if not (p.log and p.value <= 0):
            mean = p.coordinate(p.value)
        else:
            mean = p.coordinate(p.lower) + 0.5 * span if math.isfinite(span) else p.coordinate(fit.point[name])
        away.append(p.coordinate(fit.point[name]) - mean)
        variances.append((p.prior if p.prior is not None else min(span / math.sqrt(12.0), WIDE)) ** 2)
    return np.array(away), np.array(variances)


def unseen(parts: Sequence[PartStatistics], declared: Sequence[bool] | None = None) -> float:
    """Return what the settings leave of one another, root mean square: each fitted by the slopes and by the other differences.

    That is the scale of what another solver does that none of the settings shows, where the fit ended.

    Args:
        parts: Of the fitted recordings.
        declared: Which slopes are by parameters of the declared model; all by default. Those of effects take no part: the more a set
            has, the smaller its scale would be, and it would lead by that alone.
    """
    slopes, settings = (np.concatenate([getattr(p, name) for p in parts]) for name in ("slopes", "settings"))
    if declared is not None:
        slopes = slopes[:, np.array(declared, bool)]
    rows, noise = sum(p.rows for p in parts), min(p.noise for p in parts)
    able = [j for j in range(settings.shape[1]) if settings[:, j].any()]
    left = []
    for j in able:
        others = np.concatenate([slopes, settings[:, [i for i in able if i != j]]], axis=1)
        fit = others @ np.linalg.lstsq(others, settings[:, j], rcond=1e-8)[0] if others.shape[1] else 0.0
        left.append(float(np.sum((settings[:, j] - fit) ** 2)) / rows)
    return max(math.sqrt(float(np.mean(left))) if left else 0.0, LEAST * noise)


def at_the_prior_mean(parts: Sequence[PartStatistics], away: np.ndarray) -> list[PartStatistics]:
    """Return the parts with the residuals that the slopes promise at the prior mean of the parameters.

    So the density is that of the model with its prior, however far the fit went: a set that fits whatever it meets pays for it.
    """
    return [replace(p, residual=p.residual - p.slopes @ away) for p in parts]


def densities(
    parts: Sequence[PartStatistics], recordings: Sequence[int], fitted: Sequence[bool], variances: np.ndarray, scale: float
) -> tuple[float, float, float]:
    """Return log-densities: of the validation parts given the fitted ones, and of all parts with a free scale and with the prior's.

    Where nothing is held out the first is that of the fitted parts themselves.

    Args:
        parts: Of all recordings, their residuals at the prior mean.
        recordings: The recording of each part.
        fitted: Which parts were fitted.
        variances: Prior variances of the coordinates of the free parameters.
        scale: About which the patterns' scale is taken; a free one is any above it.
    """
    shared = [np.concatenate([p.settings, p.slopes], axis=1) for p in parts]
    prior = np.concatenate([np.ones(parts[0].settings.shape[1]), variances])
    scales = SCALES * scale
    weights = log_prior(scales, scale)
    counted = {n: share([p for p, own in zip(parts, recordings, strict=True) if own == n]) for n in recordings}

    @cache  # a recording that is fitted as a whole is asked for twice
    def turned(own: tuple[int, ...]) -> Rotated:
        return rotated([parts[i] for i in own], [shared[i] for i in own], counted[recordings[own[0]]])

    def by_scale(chosen: Sequence[int]) -> np.ndarray:
        by_recording: dict[int, list[int]] = {}
        for i in chosen:
            by_recording.setdefault(recordings[i], []).append(i)
        return log_densities([turned(tuple(own)) for own in by_recording.values()], prior, scales)

    early = [i for i, f in enumerate(fitted) if f]
    everything = by_scale(range(len(parts)))
    whole = log_mean(everything, weights)
    foretold = whole - log_mean(by_scale(early), weights) if len(early) < len(parts) else whole
    above = everything[scales >= scale]  # what is unknown is more than the settings show, never less
    return foretold, log_mean(above, np.full(len(above), -math.log(len(above)))), whole


def evidences(case: CaseRecord, fits: Sequence[FitStatistics]) -> list[Evidence]:
    """Return the evidence of every stored fit, the best first, and of the declared model with patterns of a free scale.

    What is unknown is told by the scale that all recordings show, for a scale that the fitted ones have shown foretells the others.
    """
    recordings, fitted = [n for n, *_ in case.parts], [f for _, f, *_ in case.parts]
    declared = {p["name"] for p in case.declared}
    out = []
    for fit in fits:
        own = fit.record
        scale = unseen([p for p, f in zip(fit.parts, fitted, strict=True) if f], [name in declared for name in own.names])
        away, variances = prior_of(case, own)
        foretold, free, whole = densities(at_the_prior_mean(fit.parts, away), recordings, fitted, variances, scale)
        value = foretold - price(len(own.effects), len(case.candidates))
        out.append(Evidence(own, value, scale))
        if not own.effects:
            out.append(Evidence(own, value + free - whole, scale, unknown=True))
    return sorted(out, key=lambda e: -e.value)


def judged(found: Sequence[Evidence], alpha: float = ALPHA) -> Verdict:
    """Return what evidences say: each set counts by its best fit, of whatever method.

    Raises:
        ValueError: The declared model is not among them.
    """
    best: dict[tuple[str, ...] | None, Evidence] = {}
    for e in sorted(found, key=lambda e: -e.value):
        best.setdefault(None if e.unknown else e.effects, e)
    if () not in best:
        raise ValueError("the declared model has no evidence")
    base = best.pop(())
    unknown = best.pop(None, None)
    ranked: Mapping[tuple[str, ...] | None, Evidence] = best
    top = max((e.value for e in ranked.values()), default=-math.inf)
    other = unknown.value if unknown is not None else -math.inf
    lead = max(top, other) - base.value
    if lead < math.log((KINDS - 1) / alpha):
        return Verdict("none", (), lead)
    if other >= top:
        return Verdict("unknown", (), lead)
    order = sorted(ranked, key=lambda key: -ranked[key].value)
    weights = np.exp(np.array([ranked[key].value for key in order]) - logsumexp([ranked[key].value for key in order]))
    count = int(np.searchsorted(np.cumsum(weights), 1.0 - alpha)) + 1
    return Verdict("effect" if count == 1 else "class", tuple(order[:count]), lead)
