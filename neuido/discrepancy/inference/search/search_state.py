"""The state of a search by one method of prediction: its base, its last results, and the interface to the ends of fits."""

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
"""Predicted share of the misfit from which a candidate beyond the first few gets no fit."""
LED_BY = 8
"""Number of first fits by one method that lead the fits when another method is asked."""

Start = tuple[Candidate, Point, np.ndarray | None]
"""A candidate, the start of a fit of it, and approximate slopes there if they are known."""


class PutOff(NamedTuple):
    """Starts of fits that wait until another method was asked, and the fits that were made before."""

    ended: tuple[tuple[Candidate, Fit], ...]
    starts: tuple[Start, ...]

    @property
    def keys(self) -> list[str]:
        """Keys of the candidates that wait."""
        return list(dict.fromkeys(c.key for c, *_ in self.starts))


class Contest(NamedTuple):
    """The fits of candidates. Those that came close ended under the method's own setting, others may be quick ones (`Fit.setting`)."""

    best: dict[str, tuple[Candidate, Fit]]
    """The best fit of each candidate, by its key."""
    other: tuple[Candidate, Fit] | None
    """The leading candidate's fit with the opposite sign."""
    unfitted: dict[str, str]
    """Why a candidate got no fit, by its key."""
    put_off: PutOff | None = None
    """Fits that are made later."""


class Promising(NamedTuple):
    """Candidates that are to be fitted, and the starts of these fits."""

    candidates: list[Candidate]
    free: tuple[Parameter, ...]
    slopes: dict[int, np.ndarray]
    columns: dict[tuple[str, int], dict[int, np.ndarray]]
    chosen: dict[str, int]
    """Number of the start that the screening ranks first, of each candidate that gets a fit, by key."""
    starts: list[Start]
    promise: dict[str, float]
    """Least share of the misfit that a candidate leaves, predicted by the screening or by one simulation, by key."""

    @property
    def hopeful(self) -> set[str]:
        """Keys of the candidates that could lower the misfit notably."""
        return {c.key for c in self.candidates if self.promise.get(c.key, math.inf) < HOPELESS or not c.linear}


class Look(NamedTuple):
    """The screening and first fits of one round."""

    base: Fit
    asked: Promising
    contest: Contest
    least: list[np.ndarray]
    """The least errors of the fits, mean squares of the parts; empty where no fit runs."""
    grown: bool = False
    """Whether growing fits were made."""

    @property
    def led(self) -> Led:
        """The candidates of least cost, and after them those whose fits were put off."""
        fits = sorted(self.contest.best.values(), key=lambda entry: entry[1].cost)
        begun = self.contest.put_off
        waiting = begun.keys if begun else []
        return Led([*(c.key for c, _ in fits), *waiting][:LED_BY], {c.key: fit.point for c, fit in fits}, self.asked.chosen)


class Ends(Protocol):
    """Where fits end and what they leave there, by simulation or from a journal."""

    def measured(self, best: Mapping[str, tuple[Candidate, Fit]], floor: Floor, *, every: bool = False) -> list[Stand]:
        """Return each fit with the errors that it leaves, as `refining.measured` does."""
        ...

    def finished(self, named: Stand) -> Stand:
        """Return a fit continued to its end, as `base_fits.finished` does."""
        ...

    def alone(self, stand: Stand) -> np.ndarray:
        """Return the errors that one simulation leaves, as `judging.errors_of_one_simulation` does."""
        ...


@dataclass(eq=False)
class Search:
    """The search for effects by one method of prediction."""

    lab: Laboratory
    """The method: simulations, fits and errors."""
    ends: Ends
    keep: int = 7
    """Least number of candidates that get a full fit by their rank in the screening. In the first round all small ones get one too."""
    draws: int = 199
    """Number of draws of the bootstrap."""
    seed: int = 0
    """Seed of the draws."""
    begun: Point | None = None
    """Point at which a fit of the declared model to the first horizon ends, once it was made."""
    still: Point | None = None
    """Point at which the declared model fits best with the extra parameters at their first values, if the base moved them."""
    seen: Look | None = None
    """The last look for a first effect."""
    asked: Round | None = None
    """The last round for a first effect."""
