"""What a search by one method of prediction knows: where it stands, what it looked at last, and how it measures where fits end."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np

from neuido.discrepancy.inference.floors import Floor, Led, Round, Stand
from neuido.discrepancy.inference.laboratory import Laboratory
from neuido.discrepancy.inference.least_squares import Fit
from neuido.discrepancy.problems.problem import Candidate, Parameter, Point

HOPELESS = 0.75
"""Share of the misfit that a candidate beyond the first few may leave, as the screening predicts it, and still get a fit."""
LED_BY = 8
"""First fits by one method that lead when another one is asked."""

Start = tuple[Candidate, Point, np.ndarray | None]
"""A candidate, where a fit of it begins, and about the slopes there, if they are known."""


class PutOff(NamedTuple):
    """Candidates whose fits wait until another method was asked, and the fits that were made before them."""

    ended: tuple[tuple[Candidate, Fit], ...]
    starts: tuple[Start, ...]

    @property
    def keys(self) -> list[str]:
        """Of the candidates that wait."""
        return list(dict.fromkeys(c.key for c, *_ in self.starts))


class Contest(NamedTuple):
    """What fits of candidates came to; those that came close ended under the own setting, others may be quick ones (`Fit.setting`)."""

    best: dict[str, tuple[Candidate, Fit]]
    """Of each candidate, by its key."""
    other: tuple[Candidate, Fit] | None
    """The leading candidate's of the other sign."""
    unfitted: dict[str, str]
    """Why a candidate got no fit, by its key."""
    put_off: PutOff | None = None
    """What goes on later."""


class Promising(NamedTuple):
    """Which candidates are to be fitted, and where their fits begin."""

    candidates: list[Candidate]
    free: tuple[Parameter, ...]
    slopes: dict[int, np.ndarray]
    columns: dict[tuple[str, int], dict[int, np.ndarray]]
    chosen: dict[str, int]
    """The start of each candidate that gets a fit which the screening put first."""
    starts: list[Start]
    promise: dict[str, float]
    """The least share of the misfit that a candidate leaves, predicted by the screening or by one simulation."""

    @property
    def hopeful(self) -> set[str]:
        """Keys of the candidates that could take something off."""
        return {c.key for c in self.candidates if self.promise.get(c.key, math.inf) < HOPELESS or not c.linear}


class Look(NamedTuple):
    """The first fits of a step."""

    base: Fit
    asked: Promising
    contest: Contest
    least: list[np.ndarray]
    """What the best of them leaves, mean squares of the parts; empty where nothing runs."""
    grown: bool = False
    """Whether some grew with the recordings."""

    @property
    def led(self) -> Led:
        """The candidates of the least costs, and after them what was put off."""
        fits = sorted(self.contest.best.values(), key=lambda entry: entry[1].cost)
        begun = self.contest.put_off
        waiting = begun.keys if begun else []
        return Led([*(c.key for c, _ in fits), *waiting][:LED_BY], {c.key: fit.point for c, fit in fits}, self.asked.chosen)


class Ends(Protocol):
    """Where fits end and what they leave there: simulated, or as a journal stored it."""

    def measured(self, best: Mapping[str, tuple[Candidate, Fit]], floor: Floor, *, every: bool = False) -> list[Stand]:
        """Return each fit with what it leaves, as `refining.measured` does."""
        ...

    def finished(self, named: Stand) -> Stand:
        """Return a fit at its end, as `base_fits.finished` does."""
        ...

    def alone(self, stand: Stand) -> np.ndarray:
        """Return what one simulation leaves, as `judging.left_alone` does."""
        ...


@dataclass(eq=False)
class Search:
    """The search for effects by one method of prediction."""

    lab: Laboratory
    """What it measures with."""
    ends: Ends
    keep: int = 7
    """Candidates that get a full fit by their place in the screening, at the least; in the first round all small ones do beside."""
    draws: int = 199
    """Of the bootstrap."""
    seed: int = 0
    """Of the draws."""
    begun: Point | None = None
    """Where the declared model fits the first part of the fitted recordings, if that was asked for."""
    still: Point | None = None
    """Where the declared model fits best without a parameter of the problem's own, if it was given one."""
    seen: Look | None = None
    """The last look for a first effect."""
    asked: Round | None = None
    """The last round for a first effect."""
