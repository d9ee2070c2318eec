"""What is fitted and what is held out, what noise, nuisances and discretisation do to each, and what the steps of a diagnosis leave."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import NamedTuple

import numpy as np

from neuido.discrepancy.inference.least_squares import Covariance, Fit
from neuido.discrepancy.problems.problem import Candidate, Point, Problem

BOUND = 2.5
"""Prior standard deviations that a nuisance may move by: 98.8 % of its prior."""
REACH = 3.0
"""Times the difference of a setting that the data may lie in its direction: another grid, and one as fine again."""


@dataclass(frozen=True, eq=False)
class Part:
    """The rows of a recording that are fitted, or that are only scored."""

    recording: int
    rows: np.ndarray
    fitted: bool
    name: str


@dataclass(frozen=True, eq=False)
class Floor:
    """What noise and discretisation do to each recording at one point."""

    noise: dict[int, float]
    weight: dict[int, np.ndarray]
    """One over the standard deviation of each datum."""
    differences: dict[int, np.ndarray]
    """Of the other settings to the one in use, (n, k): a column each, zero for one that cannot run."""
    spread: dict[int, np.ndarray]
    """Root mean square of the discretisation error of each datum."""
    nuisances: dict[int, np.ndarray] = field(default_factory=dict)
    """What one prior standard deviation of each nuisance does, (n, k); empty: they are held."""

    def whitener(self, parts: Sequence[Part]) -> Callable[[np.ndarray, int], np.ndarray]:
        """Residuals (n,) or (n, k) of the fitted rows in units of their standard deviation.

        The nuisances are marginalised, and so are the amounts of the differences of the settings: the data may lie on another grid or
        under another method, and go with these directions whatever the law (Richardson 1911 takes one of them to its limit).
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
        """The floor with weights that leave so large a share of the discretisation error outside the directions of the differences."""
        return replace(self, weight={n: 1.0 / np.sqrt(self.noise[n] ** 2 + (share * self.spread[n]) ** 2) for n in self.weight})

    def early(self, problem: Problem, parts: Sequence[Part], share: float) -> "Floor":
        """The floor that weighs nothing of the fitted recordings past this share of the time that is fitted of each."""
        weight = dict(self.weight)
        for p in parts:
            if p.fitted and p.recording in weight:
                t = problem.recordings[p.recording].times
                weight[p.recording] = weight[p.recording] * (t <= t[p.rows].min() + share * np.ptp(t[p.rows]))
        return replace(self, weight=weight)

    def joined(self, other: "Floor") -> "Floor":
        """This floor and that of other recordings."""
        return Floor(*({**getattr(self, f.name), **getattr(other, f.name)} for f in fields(Floor)))

    def spread_squares(self, parts: Sequence[Part]) -> np.ndarray:
        """Mean squares of what the settings differ by, without a refit, of each part, (len(parts),)."""
        return np.array([np.mean(self.spread[p.recording][p.rows] ** 2) for p in parts])

    def without(self, setting: int) -> "Floor":
        """The floor without the difference of one of the other settings, by its place among them."""
        kept = {n: D * (np.arange(D.shape[1]) != setting) for n, D in self.differences.items()}
        return replace(self, differences=kept)

    def amounts(self, residuals: Mapping[int, np.ndarray], parts: Sequence[Part]) -> np.ndarray:
        """How much of each difference of the settings the fitted parts of residuals (n,) hold, (k,): the same for all recordings.

        The prior of each is of mean zero and deviation one, and none is beyond `REACH`.
        """
        A, b = [], []
        for part in parts:
            if part.fitted and part.recording in self.differences:
                n, w = part.recording, self.noise[part.recording]
                N = self.nuisances.get(n, np.empty((len(part.rows), 0)))
                past = project_out_nuisances(N[part.rows], w)
                A.append(past(self.differences[n][part.rows]) / w)
                b.append(past(residuals[n][part.rows]) / w)
        if not A or not A[0].shape[1]:
            return np.zeros(0)
        A, b = np.concatenate(A), np.concatenate(b)
        return _bounded(A.T @ A + np.eye(A.shape[1]), A.T @ b, REACH)

    def settle(self, r: np.ndarray, part: Part, amounts: np.ndarray | None = None) -> np.ndarray:
        """A residual (n,) with the nuisances of its recording at their most probable values, and the differences in their amounts (k,)."""
        if amounts is not None and len(amounts):
            r = r - self.differences[part.recording] @ amounts
        N = self.nuisances.get(part.recording)
        if N is None or not N.shape[1]:
            return r
        A, b = N[part.rows], r[part.rows]
        w = self.noise[part.recording]
        return r - N @ _bounded(A.T @ A / w**2 + np.eye(A.shape[1]), A.T @ b / w**2, BOUND)


def patterns(problem: Problem, floor: Floor, part: Part, square: float) -> np.ndarray:
    """Return smooth patterns of a part that together have this mean square, spread over time as the settings differ, (rows, k)."""
    over_time = floor.spread[part.recording][part.rows]
    scale = over_time * math.sqrt(max(square, 0.0) / max(float(np.mean(over_time**2)), 1e-300))
    return scale[:, None] * problem.directions(part.recording)[part.rows]


def project_out_nuisances(N: np.ndarray, noise: float) -> Callable[[np.ndarray], np.ndarray]:
    """What nuisances N (n, k), columns of one prior standard deviation each, leave of columns of data of that noise."""
    back = np.linalg.solve(N.T @ N / noise**2 + np.eye(N.shape[1]), N.T / noise**2)
    return lambda A: A - N @ (back @ A)


def _bounded(normal: np.ndarray, right: np.ndarray, bound: float) -> np.ndarray:
    """The solution of normal equations within bounds: thousands of correlated data would outweigh any prior."""
    values, free = np.zeros(len(right)), np.ones(len(right), bool)
    while free.any():
        values[free] = np.linalg.solve(normal[np.ix_(free, free)], right[free] - normal[np.ix_(free, ~free)] @ values[~free])
        beyond = free & (np.abs(values) > bound)
        if not beyond.any():
            break
        values[beyond] = np.clip(values[beyond], -bound, bound)
        free &= ~beyond
    return values


def sealed(problem: Problem) -> tuple[int, ...]:
    """The recordings that nothing but the test error is taken from, by number: of several that are held out the last by name.

    What is held out steers the search (its ranking, what is named, what is dropped), so that its error is one of validation.
    """
    held = sorted(problem.roles["held_out"], key=lambda n: problem.recordings[n].name)
    return tuple(held[-1:]) if len(held) > 1 else ()


def split(problem: Problem) -> list[Part]:
    """What is fitted, and what it is validated by: whole recordings where there are some, else the last 40 % of the time."""
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
    """Root mean square of a size over all data of one time."""
    _, index = np.unique(times, return_inverse=True)
    total = np.bincount(index, size**2) / np.bincount(index)
    return np.sqrt(total)[index]


PARSIMONY = 0.04
"""What a further parameter must lower the mean logarithm of the errors' squares by."""
LED = 5
"""Candidates of the best scores that lead a round."""


@dataclass(frozen=True, eq=False)
class Stand:
    """A model, fitted: the declared one, or one with effects beside it."""

    fit: Fit
    floor: Floor
    """What `errors` are measured with."""
    errors: np.ndarray
    """Mean squares of each part."""


@dataclass(eq=False)
class Trial:
    """One candidate fitted in full."""

    candidate: Candidate
    stand: Stand
    gain: float
    reason: str = ""
    """Why it is rejected; empty: it is not."""

    @property
    def fit(self) -> Fit:
        return self.stand.fit

    @property
    def errors(self) -> np.ndarray:
        """Mean squares of each part."""
        return self.stand.errors

    @property
    def score(self) -> float:
        """Of its errors: lower is better."""
        return score(self.errors)

    @property
    def penalised(self) -> float:
        """The score, made worse for each parameter."""
        return self.score + PARSIMONY * len(self.candidate.size_parameters)

    def too_little(self, at_least: float, why: str) -> str:
        """The reason for one whose gain is below the one that it takes."""
        return f"lowers the error {math.exp(self.gain):.2f}-fold; {why} it takes {math.exp(at_least):.2f}-fold"


class Led(NamedTuple):
    """What led by another method."""

    keys: Sequence[str]
    """Of the candidates."""
    ends: Mapping[str, Point]
    """Where its fits ended, by key."""
    chosen: Mapping[str, int] | None = None
    """Where these were first fits, the start that each was given, by key."""


@dataclass(eq=False)
class Round:
    """One step of the growth."""

    base: Point
    errors: np.ndarray
    trials: list[Trial]
    chosen: Trial | None
    members: list[Trial]
    p_value: float
    floor: Floor
    floors: np.ndarray
    """What noise and discretisation would leave after a refit, mean squares of each part."""
    cosines: dict[str, float] = field(default_factory=dict)
    null: np.ndarray = field(default_factory=lambda: np.empty(0))
    unfitted: dict[str, str] = field(default_factory=dict)
    """Why a candidate got no fit, by its key."""
    unsure: bool = False
    """Whether an effect gained enough, had there been time for the other method."""
    plain: Stand | None = None
    """The model without a further effect, where it does better than at the base that was looked from."""
    record: int | None = None
    """Its number in the journal."""

    @property
    def over(self) -> float:
        """How far the residual of its base is above its floors: a ratio of errors."""
        return times_over(self.errors, self.floors)

    def held_out_over(self, fitted: Sequence[bool]) -> float:
        """The same of the parts that were not fitted alone; zero where there are none."""
        out = ~np.asarray(fitted)
        return times_over(self.errors[out], self.floors[out]) if out.any() else 0.0

    def by_chance(self, level: float) -> float:
        """Gain that the best candidate exceeds by chance with this probability; zero where nothing was drawn."""
        return float(np.quantile(self.null, 1 - level)) if len(self.null) else 0.0

    @property
    def led(self) -> Led:
        """The candidates that the chosen one could be mistaken for, and the next best."""
        keys = list(dict.fromkeys(t.candidate.key for t in (*self.members, *self.trials[:LED])))
        return Led(keys, {t.candidate.key: t.fit.point for t in self.trials})


def score(errors: np.ndarray) -> float:
    """Mean logarithm of the mean squares of the parts."""
    return float(np.mean(np.log(np.maximum(errors, 1e-300))))


def times_over(errors: np.ndarray, floors: np.ndarray) -> float:
    """Ratio of errors, both given as mean squares of the parts: the geometric mean over these."""
    return math.exp(0.5 * (score(errors) - score(floors)))


def unphysical(c: Candidate, point: Point) -> str:
    """Why a fitted candidate cannot be: at the edge of its range, or zero; empty where it can."""
    for p in c.size_parameters:
        value = point[p.name]
        for bound in (p.lower,) if p.saturates else (p.lower, p.upper):
            zero = abs(bound) < 1e-12
            if (zero and abs(value) < 1e-3 * p.scale and len(c.size_parameters) == 1 and not p.log) or (
                not zero and abs(value - bound) < 1e-6 * abs(bound)
            ):
                return f"{p.name} ends at {value:.3g} {p.unit}, the edge of its physical range" if not zero else "its size fits as zero"
    return ""
