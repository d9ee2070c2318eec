"""First fits that read more and more of the recordings: where a bounce has led the fits of the whole astray."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from neuido.discrepancy.base_fits import ELSEWHERE, HORIZONS
from neuido.discrepancy.contests import IN_REACH, MANY, Contests
from neuido.discrepancy.fit import Fit
from neuido.discrepancy.floors import Floor
from neuido.discrepancy.problem import Candidate, Parameter, Point
from neuido.discrepancy.trials import Trial, score

ABOVE = 2.5
"""Times the noise of the fitted recordings that the best first fit leaves, from which on fits grow."""
SIDE_BY_SIDE, ONE_BY_ONE = 8, 4
"""Candidates that grow, where a launch of several points costs as one, one of them of more than `MANY` parameters, and where every point
costs, none of those."""


class Breadth(NamedTuple):
    """How many pairs of effects grow."""

    firsts: int
    """Candidates beside which a second one grows."""
    seconds: int
    """Beside each of these."""
    pairs: int
    """That go on past the second horizon."""
    parameters: int
    """Of a candidate, at the most."""


PAIRS, PAIRS_ONE_BY_ONE = Breadth(10, 4, 12, MANY), Breadth(5, 3, 4, 4)
"""Where a launch of several points costs as one, and where every point costs."""


class Pair(NamedTuple):
    """Two effects that were fitted together."""

    candidates: tuple[Candidate, Candidate]
    fit: Fit


class Growing(Contests):
    """Fits of candidates by growing horizons."""

    def leaves_much(self, errors: Sequence[np.ndarray]) -> bool:
        """Whether the least of what fits leave of all parts, mean squares, is far above noise: they may have missed a valley."""
        if self.problem.settings == 1 or not self.problem.declared:
            return False
        noise = score(self.noise_squares[self.fitted])
        return all(score(squares[self.fitted]) - noise > 2.0 * math.log(ABOVE) for squares in errors)

    def is_astray(self, base: Fit, floor: Floor) -> bool:
        """Whether the base fit leaves much and stands elsewhere than the declared model fits the first part of the recordings."""
        if self.begun is None or not self.leaves_much(self.mean_squares([base.point], floor)):
            return False
        return self.apart(base.point, self.begun) > ELSEWHERE

    def growing(
        self, base: Fit, floor: Floor, candidates: Sequence[Candidate], found: Sequence[Trial] = (), *, until: float = 1.0
    ) -> dict[str, tuple[Candidate, Fit]]:
        """Fits of the candidates that promise most in the first part of the fitted recordings, by growing horizons, by their keys.

        They are screened where the declared model, with the effects that were found, fits the first part of the recordings, by what they
        would take off a little more of it, and the start of each that does best is the one that grows. What falls behind at a horizon is
        given up. One of many parameters grows where a launch of several points costs as one.
        """
        free = (*self.problem.declared, *(p for t in found for p in t.candidate.parameters))
        at = self.at_first(free, self.at_declared(base.point), floor, found)
        starts = self.leading(at, candidates, self.early(floor, HORIZONS[1]), free)
        # where every point costs one of many parameters takes five times as long as the others together
        large = [entry for entry in starts if len(entry[0].parameters) > MANY][: 1 if self.problem.together else 0]
        live = [entry for entry in starts if entry in large or len(entry[0].parameters) <= MANY]
        live = live[: SIDE_BY_SIDE if self.problem.together else ONE_BY_ONE]
        self.tell(f"growing fits of {', '.join(c.key for c, _ in live)}")
        entries = [((*free, *c.parameters), point) for c, point in live]
        ended = [(live[i][0], fit) for i, fit in self.grown(entries, floor, until=until, reach=IN_REACH)]
        costs = self.costs([fit.point for _, fit in ended], floor) if ended else []  # the time may have ended them at an earlier horizon
        return {c.key: (c, replace(fit, cost=cost)) for (c, fit), cost in zip(ended, costs, strict=True) if np.isfinite(cost)}

    def growing_pairs(self, base: Point, floor: Floor) -> list[Pair]:
        """Fits of two effects at once by growing horizons, the least cost first.

        In the first part of the recordings many a single effect does about as well as the right ones, whichever they are; a little later
        the second one shows beside it. What one effect alone leaves of the whole says little of that.
        """
        free, breadth = self.problem.declared, PAIRS if self.problem.together else PAIRS_ONE_BY_ONE
        small = [c for c in self.problem.candidates if len(c.parameters) <= breadth.parameters]
        wide = self.early(floor, HORIZONS[1])
        firsts = self.leading(self.at_first(free, self.at_declared(base), floor), small, wide, free)[: breadth.firsts]
        self.tell(f"growing pairs beside {', '.join(c.key for c, _ in firsts)}")
        requests = [self.request((*free, *c.parameters), point, iterations=self.stepwise) for c, point in firsts]
        fits = self.fits(requests, self.early(floor, HORIZONS[0]))
        begun: dict[frozenset[str], tuple[tuple[Candidate, Candidate], Point]] = {}
        for (c, _), fit in zip(firsts, fits, strict=True):
            if np.isfinite(fit.cost):
                beside = [other for other in small if other.name != c.name]
                for other, point in self.leading(fit.point, beside, wide, (*free, *c.parameters))[: breadth.seconds]:
                    begun.setdefault(frozenset((c.key, other.key)), ((c, other), point))
        live = list(begun.values())
        entries = [((*free, *c.parameters, *other.parameters), point) for (c, other), point in live]
        sizes = [[p.name for p in other.size_parameters] if other.linear else [] for (_, other), _ in live]
        ended = self.grown(entries, floor, reach=IN_REACH, most=breadth.pairs, sizes=sizes)
        return [Pair(live[i][0], fit) for i, fit in ended if np.isfinite(fit.cost)]

    def at_first(self, free: Sequence[Parameter], point: Point, floor: Floor, found: Sequence[Trial] = ()) -> Point:
        """`first_part`, which is kept where no effect was found yet."""
        if found:
            return self.first_part(free, point, floor)
        if self.begun is None:
            self.begun = self.first_part(free, point, floor)
        return self.begun

    def leading(self, at: Point, candidates: Sequence[Candidate], floor: Floor, free: Sequence[Parameter]) -> list[tuple[Candidate, Point]]:
        """Candidates, those first that would take most off there past the free parameters, each with the start that does best."""
        ranked, _ = self.screen(at, candidates, floor, self.slopes(free, at, self.fitted_recordings))
        starts: dict[str, tuple[Candidate, Point]] = {}
        for _, c, _, begin in ranked:
            starts.setdefault(c.key, (c, begin))
        return list(starts.values())
