"""Which candidates get a full fit, and where their fits begin: what the screening and single simulations promise."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from neuido.discrepancy.inference.floors import Floor, Led, Trial
from neuido.discrepancy.inference.least_squares import Fit
from neuido.discrepancy.inference.search.contests import LEADERS, MANY, SMALL, Start
from neuido.discrepancy.inference.search.judging import Judging
from neuido.discrepancy.problems.problem import Candidate, Parameter, Point

VAIN = 0.98
"""Share of the misfit that even such a candidate may leave, as the screening predicts it, if small sizes of it act in proportion."""
HOPELESS = 0.75
"""Share of the misfit that a candidate beyond the first few may leave, as the screening predicts it, and still get a fit."""
FAINT = 0.9
"""Share of the misfit that a candidate of one size leaves at the least, predicted or by one simulation, from which on it gets no first fit
where every point costs."""
PLACES = 9
"""Starts of a candidate that are tried at full strength, the first of the screening."""
ALSO_WITHOUT = 6
"""Candidates of the least costs that are fitted without the problem's own parameters too."""
OWN, LED_BY = 3, 8
"""Candidates that the screening of a second solver may add to those that led with the first one, and how many of its first fits lead."""


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


class Prospects(Judging):
    """What of the candidates is worth a fit."""

    keep: int
    """Candidates that get a full fit by their place in the screening, at the least."""

    def promising(
        self,
        base: Fit,
        floor: Floor,
        found: Sequence[Trial] = (),
        led: Led | None = None,
        *,
        most: float = math.inf,
        until: float = 1.0,
    ) -> Promising:
        """Screen the candidates, and say which are to be fitted and where their fits begin; arguments as those of `look`."""
        ends = led.ends if led is not None else {}
        first = not found and (led is None or led.chosen is not None)
        candidates, free, slopes, ranked, columns = self.screened(base.point, floor, found, most, led)
        hurried = self.deadline.ends(until)
        chosen, begun = self.begin(base, floor, found, led, candidates, free, slopes, ranked, columns, hurried=hurried)
        led_here = [c for c in candidates if c.key in chosen and c.key in ends]
        starts = [(c, self.with_effect(base.point, c, ends[c.key], found), None) for c in led_here] + begun
        promise = {c.key: stays for stays, c, *_ in reversed(ranked)}
        if (first or found) and not hurried:
            starts, least = self.sized(starts, base, slopes, floor, until=until)
            promise |= {key: min(share, promise.get(key, math.inf)) for key, share in least.items()}
            starts.sort(key=lambda start: promise.get(start[0].key, math.inf))
            keys = list(dict.fromkeys(c.key for c, *_ in starts))
            out: set[str] = set()
            if found:
                near = _near(promise[c.key] for c, *_ in starts if len(c.parameters) <= MANY)
                out = {key for key in keys[self.keep :] if promise.get(key, math.inf) >= near}
            elif self.tries_all(led):
                out = set([key for key in keys if key not in led.keys][OWN:])
            elif not self.problem.together:
                runs = {c.key for _, c, *_ in ranked}
                able = {c.key for c, *_ in starts if c.linear and c.key in runs and c.key in least}
                out = {key for key in keys[LEADERS:] if key in able and promise[key] > FAINT}
            starts = [start for start in starts if start[0].key not in out]
            chosen = {key: i for key, i in chosen.items() if key not in out}
        return Promising(candidates, free, slopes, columns, chosen, starts, promise)

    def tries_all(self, led: Led | None) -> bool:
        """Whether the first look by another method tries every small candidate at several sizes, before it keeps a few: in one launch.

        A viscosity of volume promised nothing by its direction where the declared model was fitted, and left noise alone at a larger size.
        """
        return led is not None and led.chosen is not None and self.problem.together

    def begin(
        self,
        base: Fit,
        floor: Floor,
        found: Sequence[Trial],
        led: Led | None,
        candidates: Sequence[Candidate],
        free: Sequence[Parameter],
        slopes: Mapping[int, np.ndarray],
        ranked: Sequence[tuple[float, Candidate, int, Point]],
        columns: Mapping[tuple[str, int], Mapping[int, np.ndarray]],
        *,
        hurried: bool = False,
    ) -> tuple[dict[str, int], list[Start]]:
        """Which candidates get a fit by the screening, with the start of each that it put first, and where their fits could begin.

        `hurried`: without trying any place at full strength.
        """
        chosen: dict[str, int] = {}
        starts: list[Start] = []
        # what many parameters could fit says little of how near the others are
        near = _near(stays for stays, c, *_ in ranked if len(c.parameters) <= MANY)
        keep, leaders = (self.keep, ()) if led is None else (min(self.keep, OWN), led.keys)
        first = led is None and not found
        # beside an effect they are tried at larger sizes before any is chosen, and by another method where that costs one launch
        every = bool(found or self.tries_all(led)) and not hurried
        for stays, c, i, begin in ranked:
            leads = c.key in leaders
            small = len(c.parameters) <= SMALL and (every or (first and (stays < VAIN or not c.linear)))
            if c.key not in chosen and (keep > 0 or leads or small or (led is None and stays < near)):
                keep -= not (small or leads)
                chosen[c.key] = i
                starts.append((c, begin, self.first_slopes(c, i, free, slopes, columns, floor)))
                if not c.linear:
                    starts.append((c, self.at_declared(begin), None))
            elif not c.linear and c.key in chosen and sum(s[0].key == c.key for s in starts) < 3:
                starts.append((c, begin, None))
            elif c.apart and c.key in chosen and all(begin[c.apart] * s[1][c.apart] < 0 for s in starts if s[0].key == c.key):
                starts.append((c, begin, None))
        finite = {c.key for _, c, *_ in ranked}
        for c in candidates:
            # what cannot run where the base fit went, or does nothing there, may do so where the model was declared
            small = len(c.parameters) <= MANY if c.key not in finite else c.linear and len(c.parameters) <= SMALL
            if c.key not in chosen and ((first and small) or c.key in leaders):
                chosen[c.key] = 0
                starts.append((c, {**self.at_declared(base.point), **c.starts[0]}, None))
        for c in (c for c in candidates if first and not hurried and c.far and c.key in chosen):
            places = [c.starts[i] for _, other, i, _ in ranked if other is c][:PLACES]
            starts += [(c, begin, None) for begin in self.strong(c, places, base.point, floor)]
        return chosen, starts

    def with_effect(self, point: Point, c: Candidate, end: Point, found: Sequence[Trial] = ()) -> Point:
        """A point with a candidate's parameters, the declared ones and those of what was found, of the end of another fit of it."""
        names = {*self.as_declared, *(p.name for t in found for p in t.candidate.parameters)}
        return {**point, **{name: value for name, value in end.items() if name in names}, **c.own(end)}

    def without_own(
        self, point: Point, starts: Sequence[Start], found: Sequence[Trial], ended: Sequence[tuple[Candidate, Fit]]
    ) -> list[Start]:
        """The starts once more without the problem's own parameters, where the base has some: what it needs them for may be an effect.

        Of the candidates that the screening or the fits with them (`ended`, best first) put among the first; and where these fits ended.
        """
        plain = {k: v for k, v in point.items() if "." in k or k in self.as_declared}
        if plain == dict(point):
            return []
        if not found and self.still is not None:
            plain = dict(self.still)
        keys = {*list(dict.fromkeys(c.key for c, *_ in starts))[:LEADERS], *(c.key for c, _ in ended[:ALSO_WITHOUT])}
        begun: list[Start] = [(c, plain | c.own(b), None) for c, b, _ in starts if c.key in keys]
        return begun + [(c, self.with_effect(plain, c, fit.point), None) for c, fit in ended[:ALSO_WITHOUT]]

    def screened(self, point: Point, floor: Floor, found: Sequence[Trial], most: float, led: Led | None = None):
        """The candidates beside effects that were found, the free parameters and their slopes, and what `screen` says.

        What did not lead among another method's first fits has the one start here that it was given there.
        """
        taken = {t.candidate.name for t in found}
        candidates = [c for c in self.problem.candidates if c.name not in taken and len(c.parameters) <= most]
        if led is not None and led.chosen is not None:
            at = led.chosen
            candidates = [c if c.key in led.keys else replace(c, starts=(c.starts[at.get(c.key, 0)],)) for c in candidates]
        free = (*self.problem.declared, *(p for t in found for p in t.candidate.parameters))
        slopes = self.slopes(free, point, self.scored_recordings)
        return candidates, free, slopes, *self.screen(point, candidates, floor, slopes)


def _near(promises: Iterable[float]) -> float:
    """Share of the misfit below which a candidate beyond the first few may promise as much as they do."""
    return min(2.0 * min(promises, default=0.0), HOPELESS)
