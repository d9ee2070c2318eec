"""Model evidence of each set of effects: how well it predicts the held-out data from the fitted ones, less a penalty for the search.

    E(M) = log p(y_validation | y_fitted, M) - log(k C(K, m))

for a set of m of K effects, with k kinds of model (`KINDS`). The exponential of E is a prior weight times a predictive density, and the
prior weights of all models sum to one. Thresholds (how far the best model must lead, and when two models are distinguished) are
calibrated on blind cases: `calibration`.

The evidence is computed from stored fits and reported beside the answer of the rules. It decides nothing yet.
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
"""Largest prior standard deviation of a parameter without a prior of its own, in its typical steps."""
LEAST = 0.1
"""Least scale of the smooth patterns, as a share of the noise: settings finer than those that were tried differ a little too."""


@dataclass(frozen=True)
class Evidence:
    """A fitted model and its evidence."""

    record: FitRecord
    """The fit."""
    value: float
    """Log-evidence E, natural logarithm."""
    beyond: float = 0.0
    """Log-density of all recordings averaged over the scales of the patterns, minus that at the least scale. A large value means that
    the model lacks an effect that is not among the candidates."""

    @property
    def effects(self) -> tuple[str, ...]:
        """Return the keys of the effects of the model, in alphabetical order."""
        return tuple(sorted(self.record.effects))


@dataclass(frozen=True)
class Verdict:
    """The answer for a case by model evidence."""

    answer: str
    """`effect`, `class`, `unknown` or `none`."""
    sets: tuple[tuple[str, ...], ...]
    """Sets of effects that the data cannot tell apart, the best first; sets that contain another one of them are left out."""
    lead: float
    """Log-evidence of the best model minus that of the declared one."""
    p_value: float
    """Share of nulls with at least this lead; the case itself counts as one of them."""


def price(effects: int, candidates: int) -> float:
    """Return minus the logarithm of the prior weight of a set of effects.

    Args:
        effects: Number of effects in the set.
        candidates: Number of candidate effects.
    """
    return math.log(KINDS * math.comb(candidates, effects))


def prior_offsets(case: CaseRecord, fit: FitRecord) -> tuple[np.ndarray, np.ndarray]:
    """Return the offset of each fitted parameter from its prior mean, (p,), and its prior variance, (p,), in the coordinates of fits.

    The prior mean is the declared value of a parameter, and for an effect the value at which it is absent. A parameter that is fitted as
    a logarithm and has no such value takes the middle of its range.
    """
    known = {p["name"]: Parameter(**p) for p in (*case.declared, *(p for c in case.candidates for p in c["parameters"]))}
    offsets, variances = [], []
    for name in fit.names:
        p = known[name]
        span = p.coordinate(p.upper) - p.coordinate(p.lower) if not (p.log and p.lower <= 0) else math.inf
        if not (p.log and p.value <= 0):
            mean = p.coordinate(p.value)
        else:
            mean = p.coordinate(p.lower) + 0.5 * span if math.isfinite(span) else p.coordinate(fit.point[name])
        offsets.append(p.coordinate(fit.point[name]) - mean)
        variances.append((p.prior if p.prior is not None else min(span / math.sqrt(12.0), WIDE)) ** 2)
    return np.array(offsets), np.array(variances)


def unseen(parts: Sequence[PartStatistics], declared: Sequence[bool] | None = None) -> float:
    """Return the least scale of the smooth patterns: an estimate of the simulation error that no setting shows, in the unit of the data.

    The difference of each setting is fitted by the slopes and by the differences of the other settings. The scale is the root mean square
    of what these fits leave, and at least `LEAST` times the noise.

    Args:
        parts: The fitted parts.
        declared: Mask of the slopes by declared parameters, (p,); all by default. Slopes of effects are left out, as a set with many
            effects would get a smaller scale and lead for that reason alone.
    """
    slopes, settings = (np.concatenate([getattr(p, name) for p in parts]) for name in ("slopes", "settings"))
    if declared is not None:
        slopes = slopes[:, np.array(declared, bool)]
    rows, noise = sum(p.rows for p in parts), min(p.noise for p in parts)
    runnable = [j for j in range(settings.shape[1]) if settings[:, j].any()]
    left = []
    for j in runnable:
        others = np.concatenate([slopes, settings[:, [i for i in runnable if i != j]]], axis=1)
        fit = others @ np.linalg.lstsq(others, settings[:, j], rcond=1e-8)[0] if others.shape[1] else 0.0
        left.append(float(np.sum((settings[:, j] - fit) ** 2)) / rows)
    return max(math.sqrt(float(np.mean(left))) if left else 0.0, LEAST * noise)


def shift_to_prior_mean(parts: Sequence[PartStatistics], offsets: np.ndarray) -> list[PartStatistics]:
    """Return the parts with their residuals moved from the end of the fit to the prior mean of the parameters, by the slopes.

    The density then is that of the model with its prior, wherever the fit ended, so that a very flexible set of effects pays for it.

    Args:
        parts: Parts of the data.
        offsets: Offset of each fitted parameter from its prior mean, (p,).
    """
    return [replace(p, residual=p.residual - p.slopes @ offsets) for p in parts]


def densities(
    parts: Sequence[PartStatistics], recordings: Sequence[int], fitted: Sequence[bool], variances: np.ndarray, scale: float
) -> tuple[float, float]:
    """Compute the predictive density of the validation parts, averaged over the scales of the patterns.

    Args:
        parts: All parts, with residuals at the prior mean.
        recordings: Number of the recording of each part.
        fitted: Which parts were fitted.
        variances: Prior variance of each fitted parameter, (p,), in the coordinates of fits.
        scale: Least scale of the patterns, in the unit of the data.

    Returns:
        The log-density of the validation parts given the fitted ones (of the fitted ones themselves if nothing is held out), and the
        log-density of all parts minus that at the least scale.
    """
    shared = [np.concatenate([p.settings, p.slopes], axis=1) for p in parts]
    prior = np.concatenate([np.ones(parts[0].settings.shape[1]), variances])
    counted_share = {n: share([p for p, own in zip(parts, recordings, strict=True) if own == n]) for n in recordings}

    @cache  # a recording that is fitted as a whole is needed twice
    def rotated_recording(own: tuple[int, ...]) -> Rotated:
        return rotated([parts[i] for i in own], [shared[i] for i in own], counted_share[recordings[own[0]]])

    def by_scale(chosen: Sequence[int]) -> np.ndarray:
        by_recording: dict[int, list[int]] = {}
        for i in chosen:
            by_recording.setdefault(recordings[i], []).append(i)
        return log_densities([rotated_recording(tuple(own)) for own in by_recording.values()], prior, SCALES * scale)

    early = [i for i, f in enumerate(fitted) if f]
    everything = by_scale(range(len(parts)))
    whole = log_mean(everything)
    predictive = whole - log_mean(by_scale(early)) if len(early) < len(parts) else whole
    return predictive, whole - float(everything[0])


def evidences(case: CaseRecord, fits: Sequence[FitStatistics]) -> list[Evidence]:
    """Return the evidence of every stored fit, the best first.

    The least scale of the patterns is computed for the declared model of each method, and used for all sets of effects. The error of the
    simulation does not depend on the effects that are tried, so no set may lead because settings happen to differ less where its fit ended.

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
        offsets, variances = prior_offsets(case, fit.record)
        predictive, beyond = densities(shift_to_prior_mean(fit.parts, offsets), recordings, fitted, variances, scales[fit.record.method])
        out.append(Evidence(fit.record, predictive - price(len(fit.record.effects), len(case.candidates)), beyond))
    return sorted(out, key=lambda e: -e.value)


def judged(found: Sequence[Evidence], calibration: Calibration, alpha: float = ALPHA) -> Verdict:
    """Return the answer by model evidence. Each set of effects counts by its best fit of any method.

    Args:
        found: Evidence of each fit, the declared model included.
        calibration: Thresholds.
        alpha: Accepted probability of a false alarm.

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
    if top.beyond > calibration.unknown_threshold(alpha):
        return Verdict("unknown", (), lead, p)
    if lead <= calibration.least_lead(alpha):
        return Verdict("none", (), lead, p)
    near = [key for key, e in best.items() if key and top.value - e.value <= calibration.class_margin(alpha)]
    sets = tuple(key for key in near if not any(set(other) < set(key) for other in near))
    names = {tuple(sorted(key.partition(":")[0] for key in own)) for own in sets}
    return Verdict("effect" if len(names) == 1 else "class", sets, lead, p)
