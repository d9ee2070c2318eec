"""Parts of the data (fitted or held out), the error floor of each, and the results of the steps of a diagnosis."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import NamedTuple

import numpy as np

from neuido.discrepancy.inference.least_squares import Covariance, Fit
from neuido.discrepancy.problems.problem import Candidate, Point, Problem

BOUND = 2.5
"""Most prior standard deviations that a nuisance may move by: 98.8 % of its prior."""
REACH = 3.0
"""Largest amount of a difference between settings, as a multiple of it: the data may lie past the other grid, on a finer one again."""


@dataclass(frozen=True, eq=False)
class Part:
    """The rows of a recording that are fitted, or that are only scored."""

    recording: int
    """Number of the recording."""
    rows: np.ndarray
    """Mask of the rows, (n,)."""
    fitted: bool
    """Whether the rows are fitted; else they validate."""
    name: str
    """Name in reports."""


@dataclass(frozen=True, eq=False)
class Floor:
    """Expected errors of each recording by noise and discretisation, at one point. Recordings go by number, settings by place."""

    noise: dict[int, float]
    """Standard deviation of the noise."""
    weight: dict[int, np.ndarray]
    """One over the standard deviation of each datum, (n,)."""
    differences: dict[int, np.ndarray]
    """Prediction of each other setting minus that of the setting in use, (n, k); zeros for a setting that does not run."""
    spread: dict[int, np.ndarray]
    """Root mean square over the settings of the discretisation error of each datum, (n,)."""
    nuisances: dict[int, np.ndarray] = field(default_factory=dict)
    """Change of the prediction by one prior standard deviation of each nuisance, (n, k); empty: nuisances are held fixed."""

    def whitener(self, parts: Sequence[Part]) -> Callable[[np.ndarray, int], np.ndarray]:
        """Return a function that scales residuals (n,) or (n, k) of a recording to unit covariance and keeps the fitted rows.

        Nuisances and amounts of the differences between settings are marginalised. The data follow no grid, so they may differ from the
        prediction along these directions whatever the law is (Richardson 1911 extrapolates along one of them).
        """
        rows = {p.recording: p.rows for p in parts if p.fitted}
        columns = {
            n: np.concatenate([c[n] for c in (self.nuisances, self.differences) if n in c], axis=1)
            for n in rows
            if n in self.nuisances or n in self.differences
        }
        covariance = {n: Covariance.of(1.0, (c * self.weight[n][:, None])[rows[n]]) for n, c in columns.items()}

        def whiten(r: np.ndarray, n: int) -> np.ndarray:
            weighted = (r * (self.weight[n][:, None] if r.ndim == 2 else self.weight[n]))[rows[n]]
            return covariance[n].whiten(weighted) if n in covariance else weighted

        return whiten

    def weighed(self, share: float) -> "Floor":
        """Return the floor with weights for a given share of the discretisation error beside the noise.

        The share is what is expected outside the directions of `differences`.
        """
        return replace(self, weight={n: 1.0 / np.sqrt(self.noise[n] ** 2 + (share * self.spread[n]) ** 2) for n in self.weight})

    def early(self, problem: Problem, parts: Sequence[Part], share: float) -> "Floor":
        """Return the floor with zero weight after the first part of each fitted recording; `share` is that part of its fitted time."""
        weight = dict(self.weight)
        for p in parts:
            if p.fitted and p.recording in weight:
                t = problem.recordings[p.recording].times
                weight[p.recording] = weight[p.recording] * (t <= t[p.rows].min() + share * np.ptp(t[p.rows]))
        return replace(self, weight=weight)

    def joined(self, other: "Floor") -> "Floor":
        """Return this floor together with the floor of other recordings."""
        return Floor(*({**getattr(self, f.name), **getattr(other, f.name)} for f in fields(Floor)))

    def spread_squares(self, parts: Sequence[Part]) -> np.ndarray:
        """Return the mean square of the differences between settings in each part, without a refit, (len(parts),)."""
        return np.array([np.mean(self.spread[p.recording][p.rows] ** 2) for p in parts])

    def without(self, setting: int) -> "Floor":
        """Return the floor with the difference of one of the other settings set to zero; `setting` is its column in `differences`."""
        kept = {n: D * (np.arange(D.shape[1]) != setting) for n, D in self.differences.items()}
        return replace(self, differences=kept)

    def amounts(self, residuals: Mapping[int, np.ndarray], parts: Sequence[Part]) -> np.ndarray:
        """Estimate the amount of each difference between settings in the residuals (n,) of the fitted parts, (k,).

        The amounts are the same for all recordings. Each has a Gaussian prior of mean zero and standard deviation one, and is at most
        `REACH` in size.
        """
        A, b = [], []
        for part in parts:
            if part.fitted and part.recording in self.differences:
                n, w = part.recording, self.noise[part.recording]
                N = self.nuisances.get(n, np.empty((len(part.rows), 0)))
                project = project_out_nuisances(N[part.rows], w)
                A.append(project(self.differences[n][part.rows]) / w)
                b.append(project(residuals[n][part.rows]) / w)
        if not A or not A[0].shape[1]:
            return np.zeros(0)
        A, b = np.concatenate(A), np.concatenate(b)
        return _bounded(A.T @ A + np.eye(A.shape[1]), A.T @ b, REACH)

    def settle(self, r: np.ndarray, part: Part, amounts: np.ndarray | None = None) -> np.ndarray:
        """Return a residual (n,) after the differences between settings and the most probable nuisances are subtracted.

        Args:
            r: Predicted minus measured, (n,).
            part: The rows that determine the nuisances.
            amounts: Amount of each difference between settings, (k,); none are subtracted by default.
        """
        if amounts is not None and len(amounts):
            r = r - self.differences[part.recording] @ amounts
        N = self.nuisances.get(part.recording)
        if N is None or not N.shape[1]:
            return r
        A, b = N[part.rows], r[part.rows]
        w = self.noise[part.recording]
        return r - N @ _bounded(A.T @ A / w**2 + np.eye(A.shape[1]), A.T @ b / w**2, BOUND)


def patterns(problem: Problem, floor: Floor, part: Part, square: float) -> np.ndarray:
    """Return smooth patterns (rows, k) for errors of the simulation that no setting shows.

    Args:
        problem: Gives the patterns.
        floor: Gives the course over time: patterns are large where settings differ much.
        part: The rows.
        square: Mean square of the sum of all patterns.
    """
    over_time = floor.spread[part.recording][part.rows]
    scale = over_time * math.sqrt(max(square, 0.0) / max(float(np.mean(over_time**2)), 1e-300))
    return scale[:, None] * problem.directions(part.recording)[part.rows]


def project_out_nuisances(N: np.ndarray, noise: float) -> Callable[[np.ndarray], np.ndarray]:
    """Return a function that subtracts from columns (n, m) what nuisances are expected to explain of them.

    Args:
        N: Change of the data by one prior standard deviation of each nuisance, (n, k).
        noise: Standard deviation of the noise.
    """
    back = np.linalg.solve(N.T @ N / noise**2 + np.eye(N.shape[1]), N.T / noise**2)
    return lambda A: A - N @ (back @ A)


def _bounded(normal: np.ndarray, right: np.ndarray, bound: float) -> np.ndarray:
    """Solve normal equations with all values within -bound and bound.

    A prior alone does not hold the values back, as thousands of correlated data outweigh it.
    """
    values, inside = np.zeros(len(right)), np.ones(len(right), bool)
    while inside.any():
        values[inside] = np.linalg.solve(normal[np.ix_(inside, inside)], right[inside] - normal[np.ix_(inside, ~inside)] @ values[~inside])
        beyond = inside & (np.abs(values) > bound)
        if not beyond.any():
            break
        values[beyond] = np.clip(values[beyond], -bound, bound)
        inside &= ~beyond
    return values


def sealed(problem: Problem) -> tuple[int, ...]:
    """Return the numbers of the recordings that serve for the test error alone: the last by name, if several are held out.

    The other held-out recordings steer the search (ranking, naming, dropping of effects), so their error is a validation error.
    """
    held = sorted(problem.roles["held_out"], key=lambda n: problem.recordings[n].name)
    return tuple(held[-1:]) if len(held) > 1 else ()


def split(problem: Problem) -> list[Part]:
    """Return the parts that are fitted and those that validate.

    Whole held-out recordings validate if there are any, else the last 40 % of the time of each recording.
    """
    roles, aside = problem.roles, sealed(problem)
    roles = {role: [n for n in own if n not in aside] for role, own in roles.items()}
    whole = {n: np.ones(len(r.y), bool) for n, r in enumerate(problem.recordings)}
    names = {n: r.name for n, r in enumerate(problem.recordings)}
    if roles["held_out"]:
        return [Part(n, whole[n], True, names[n]) for n in roles["fit"]] + [Part(n, whole[n], False, names[n]) for n in roles["held_out"]]
    parts = []
    for fitted in (True, False):
        for n in roles["fit"]:
            t = problem.recordings[n].times
            early = t <= t.min() + 0.6 * np.ptp(t)
            parts.append(Part(n, early if fitted else ~early, fitted, names[n] if fitted else f"{names[n]} (last 40 %)"))
    return parts


def over_time(size: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Return for each datum the root mean square of `size` (n,) over all data of the same time, (n,)."""
    _, index = np.unique(times, return_inverse=True)
    total = np.bincount(index, size**2) / np.bincount(index)
    return np.sqrt(total)[index]


PARSIMONY = 0.04
"""Least decrease of `score` by which a further parameter pays."""
LED = 5
"""Number of candidates with the best scores that another method tries too."""


@dataclass(frozen=True, eq=False)
class Stand:
    """A fitted model and its errors: the declared model, with or without effects."""

    fit: Fit
    floor: Floor
    """Floor that `errors` were computed with."""
    errors: np.ndarray
    """Mean square of the residual of each part, (parts,)."""


@dataclass(eq=False)
class Trial:
    """A candidate that was fitted in full."""

    candidate: Candidate
    stand: Stand
    gain: float
    """Logarithm of the error without the effect over that with it: `bootstrap.gain`."""
    reason: str = ""
    """Why the candidate was rejected; empty: it was not."""

    @property
    def fit(self) -> Fit:
        """Return the fit."""
        return self.stand.fit

    @property
    def errors(self) -> np.ndarray:
        """Return the mean square of the residual of each part, (parts,)."""
        return self.stand.errors

    @property
    def score(self) -> float:
        """Return the score of the errors; lower is better."""
        return score(self.errors)

    @property
    def penalised(self) -> float:
        """Return the score plus a penalty for each parameter."""
        return self.score + PARSIMONY * len(self.candidate.size_parameters)

    def too_little(self, at_least: float, why: str) -> str:
        """Return the reason to reject a candidate whose gain is below the required one (both are logarithms)."""
        return f"lowers the error {math.exp(self.gain):.2f}-fold; {why} it takes {math.exp(at_least):.2f}-fold"


class Led(NamedTuple):
    """The leading candidates of another method."""

    keys: Sequence[str]
    """Keys of the candidates."""
    ends: Mapping[str, Point]
    """Point where each fit ended, by key."""
    chosen: Mapping[str, int] | None = None
    """Number of the start of each fit, by key; for first fits alone."""


@dataclass(eq=False)
class Round:
    """One step of a diagnosis: candidates are tried beside a base model, and one or a class of them may be chosen."""

    base: Point
    """Where the fit of the base model ended."""
    errors: np.ndarray
    """Mean square of the residual of the base in each part, (parts,)."""
    trials: list[Trial]
    """Fitted candidates, the best first."""
    chosen: Trial | None
    """The candidate that is named, if any."""
    members: list[Trial]
    """Candidates that the data cannot tell from the chosen one, itself included."""
    p_value: float
    """Probability of a gain as large under the null hypothesis."""
    floor: Floor
    """Floor of the base."""
    floors: np.ndarray
    """Mean square that noise and discretisation alone leave of each part after a refit, (parts,)."""
    cosines: dict[str, float] = field(default_factory=dict)
    """Cosine between each candidate and the leading one, by key."""
    null: np.ndarray = field(default_factory=lambda: np.empty(0))
    """Largest gain of any candidate in each draw under the null hypothesis; empty: nothing was drawn."""
    unfitted: dict[str, str] = field(default_factory=dict)
    """Why a candidate was not fitted, by key."""
    unsure: bool = False
    """Whether an effect gained enough, but there was no time to check it by the other method."""
    plain: Stand | None = None
    """A fit of the model without a further effect that is better than the base; none if there is no such fit."""
    record: int | None = None
    """Number of the round in the journal."""

    @property
    def over(self) -> float:
        """Return how many times its floor the residual of the base is: a geometric mean over the parts."""
        return times_over(self.errors, self.floors)

    def held_out_over(self, fitted: Sequence[bool]) -> float:
        """Return `over` of the parts that were not fitted alone; zero if all were fitted."""
        out = ~np.asarray(fitted)
        return times_over(self.errors[out], self.floors[out]) if out.any() else 0.0

    def by_chance(self, level: float) -> float:
        """Return the gain that the best candidate exceeds by chance with probability `level`; zero if nothing was drawn."""
        return float(np.quantile(self.null, 1 - level)) if len(self.null) else 0.0

    @property
    def led(self) -> Led:
        """Return the candidates that another method tries too: the members of the class, and the next best."""
        keys = list(dict.fromkeys(t.candidate.key for t in (*self.members, *self.trials[:LED])))
        return Led(keys, {t.candidate.key: t.fit.point for t in self.trials})


def score(errors: np.ndarray) -> float:
    """Return the mean over the parts of the logarithm of their mean squares."""
    return float(scores(errors))


def scores(errors: np.ndarray) -> np.ndarray:
    """Return `score` over the last axis of mean squares (..., parts)."""
    return np.log(np.maximum(errors, 1e-300)).mean(-1)


def times_over(errors: np.ndarray, floors: np.ndarray) -> float:
    """Return the ratio of errors to floors, both as mean squares of the parts: the geometric mean of the ratios of root mean squares."""
    return math.exp(0.5 * (score(errors) - score(floors)))


def worst_over(errors: np.ndarray, floors: np.ndarray) -> float:
    """Return the largest ratio of the root mean square of a part to its floor, both as mean squares of the parts."""
    return math.sqrt(float(np.max(errors / np.maximum(floors, 1e-300))))


def unphysical(c: Candidate, point: Point) -> str:
    """Return why a fitted candidate is unphysical (at the edge of its range, or zero); empty if it is physical."""
    for p in c.size_parameters:
        value = point[p.name]
        for bound in (p.lower,) if p.saturates else (p.lower, p.upper):
            zero = abs(bound) < 1e-12
            if (zero and abs(value) < 1e-3 * p.scale and len(c.size_parameters) == 1 and not p.log) or (
                not zero and abs(value - bound) < 1e-6 * abs(bound)
            ):
                return f"{p.name} ends at {value:.3g} {p.unit}, the edge of its physical range" if not zero else "its size fits as zero"
    return ""
