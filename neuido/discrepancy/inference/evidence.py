"""The evidence of each model: how well what was held out is foretold from what was fitted, less the price of the search.

    E(M) = log p(y_validation | y_fitted, M) - log(k C(K, m))

for a set of m of K effects, with k kinds of model (`KINDS`). The exponential of E is a prior weight times a predictive density, and the
weights of all models sum to one. How far the best model must lead, and when two are told apart, is measured: `calibration`.

This is computed beside the present decision, from stored fits, and decides nothing yet.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from neuido.discrepancy.inference.calibration import ALPHA, Calibration
from neuido.discrepancy.inference.journal import CaseRecord, FitRecord
from neuido.discrepancy.inference.likelihood import SCALES, Rotated, log_densities, log_mean, rotated, share
from neuido.discrepancy.inference.statistics import FitStatistics, PartStatistics
from neuido.discrepancy.problems.problem import Parameter

KINDS = 4
"""Kinds of model, of equal prior weight: none, one, two or three effects."""
WIDE = 10.0
"""Prior standard deviation of a parameter without a finite range, in its typical steps."""
LEAST = 0.1
"""Share of the noise that the patterns' scale is at the least: finer settings than those that were tried differ by something too."""


@dataclass(frozen=True)
class Evidence:
    """A model with its evidence."""

    record: FitRecord
    value: float
    beyond: float = 0.0
    """Log-density of all recordings with any scale of the patterns, over that with the one that the settings leave of one another. Where
    it is large, something is missing that the model has not."""

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
    """The sets of effects that the data do not tell apart, the best first; of those that hold another one only that."""
    lead: float
    """Of the best model over the declared one."""
    p_value: float
    """Share of nulls on which something led by as much, this case counted among them."""


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
) -> tuple[float, float]:
    """Return the log-density of the validation parts given the fitted ones, and how much a free scale adds to that of all parts.

    Where nothing is held out the first is that of the fitted parts themselves.

    Args:
        parts: Of all recordings, their residuals at the prior mean.
        recordings: The recording of each part.
        fitted: Which parts were fitted.
        variances: Prior variances of the coordinates of the free parameters.
        scale: Below which the patterns' scale is not.
    """
    shared = [np.concatenate([p.settings, p.slopes], axis=1) for p in parts]
    prior = np.concatenate([np.ones(parts[0].settings.shape[1]), variances])
    counted = {n: share([p for p, own in zip(parts, recordings, strict=True) if own == n]) for n in recordings}

    @cache  # a recording that is fitted as a whole is asked for twice
    def turned(own: tuple[int, ...]) -> Rotated:
        return rotated([parts[i] for i in own], [shared[i] for i in own], counted[recordings[own[0]]])

    def by_scale(chosen: Sequence[int]) -> np.ndarray:
        by_recording: dict[int, list[int]] = {}
        for i in chosen:
            by_recording.setdefault(recordings[i], []).append(i)
        return log_densities([turned(tuple(own)) for own in by_recording.values()], prior, SCALES * scale)

    early = [i for i, f in enumerate(fitted) if f]
    everything = by_scale(range(len(parts)))
    whole = log_mean(everything)
    foretold = whole - log_mean(by_scale(early)) if len(early) < len(parts) else whole
    return foretold, whole - float(everything[0])


def evidences(case: CaseRecord, fits: Sequence[FitStatistics]) -> list[Evidence]:
    """Return the evidence of every stored fit, the best first.

    The least scale of the patterns is that of the declared model by the same method, whatever a set adds: how far simulations of the body
    differ does not depend on what is asked about it, and no set leads by ending where they happen to differ less.

    Raises:
        ValueError: The declared model is not among the fits of a method.
    """
    recordings, fitted = [n for n, *_ in case.parts], [f for _, f, *_ in case.parts]
    declared = {p["name"] for p in case.declared}
    scales: dict[int, float] = {}
    for fit in fits:
        if not fit.record.effects:
            own = unseen([p for p, f in zip(fit.parts, fitted, strict=True) if f], [name in declared for name in fit.record.names])
            scales[fit.record.method] = max(own, scales.get(fit.record.method, 0.0))
    out = []
    for fit in fits:
        if fit.record.method not in scales:
            raise ValueError("the declared model has no statistics")
        away, variances = prior_of(case, fit.record)
        foretold, beyond = densities(at_the_prior_mean(fit.parts, away), recordings, fitted, variances, scales[fit.record.method])
        out.append(Evidence(fit.record, foretold - price(len(fit.record.effects), len(case.candidates)), beyond))
    return sorted(out, key=lambda e: -e.value)


def judged(found: Sequence[Evidence], calibration: Calibration, alpha: float = ALPHA) -> Verdict:
    """Return what evidences say: each set counts by its best fit, of whatever method.

    Args:
        found: With the declared model among them.
        calibration: What leads nulls had, and how far true effects were behind.
        alpha: Probability of naming anything where nothing is missing.

    Raises:
        ValueError: The declared model is not among them.
    """
    best: dict[tuple[str, ...], Evidence] = {}
    for e in sorted(found, key=lambda e: -e.value):
        best.setdefault(e.effects, e)
    if () not in best:
        raise ValueError("the declared model has no evidence")
    top = next(iter(best.values()))
    lead = top.value - best[()].value
    p = calibration.p_value(lead)
    if top.beyond > calibration.foreign(alpha):
        return Verdict("unknown", (), lead, p)
    if lead <= calibration.least_lead(alpha):
        return Verdict("none", (), lead, p)
    near = [key for key, e in best.items() if key and top.value - e.value <= calibration.apart(alpha)]
    sets = tuple(key for key in near if not any(set(other) < set(key) for other in near))
    names = {tuple(sorted(key.partition(":")[0] for key in own)) for own in sets}
    return Verdict("effect" if len(names) == 1 else "class", sets, lead, p)
