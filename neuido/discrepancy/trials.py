"""What the steps of a diagnosis leave: the declared model fitted, candidates fitted in full, and what one step of the growth found."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from neuido.discrepancy.fit import Fit
from neuido.discrepancy.floors import Floor
from neuido.discrepancy.problem import Candidate, Point

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
