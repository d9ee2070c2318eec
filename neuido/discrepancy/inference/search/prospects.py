"""Which candidates get a full fit, and where their fits begin: what the screening and single simulations promise."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from neuido.discrepancy.inference import directions
from neuido.discrepancy.inference.floors import Floor, Led, Trial
from neuido.discrepancy.inference.laboratory import Laboratory
from neuido.discrepancy.inference.least_squares import Fit
from neuido.discrepancy.inference.search import contests
from neuido.discrepancy.inference.search.contests import LEADERS, MANY, SMALL
from neuido.discrepancy.inference.search.search_state import HOPELESS, Promising, Search, Start
from neuido.discrepancy.problems.problem import Candidate, Parameter, Point

VAIN = 0.98
"""Share of the misfit that even such a candidate may leave, as the screening predicts it, if small sizes of it act in proportion."""
FAINT = 0.9
"""Share of the misfit that a candidate of one size leaves at the least, predicted or by one simulation, from which on it gets no first fit
where every point costs."""
PLACES = 9
"""Starts of a candidate that are tried at full strength, the first of the screening."""
ALSO_WITHOUT = 6
"""Candidates of the least costs that are fitted without the problem's own parameters too."""
OWN = 3
"""Candidates that the screening of a second solver may add to those that led with the first one."""


def promising(
    search: Search,
    base: Fit,
    floor: Floor,
    found: Sequence[Trial] = (),
    led: Led | None = None,
    *,
    most: float = math.inf,
    until: float = 1.0,
) -> Promising:
    """Screen the candidates, and say which are to be fitted and where their fits begin; arguments as those of `first_look`."""
    lab = search.lab
    ends = led.ends if led is not None else {}
    first = not found and (led is None or led.chosen is not None)
    candidates, free, slopes, ranked, columns = screened(lab, base.point, floor, found, most, led)
    hurried = lab.budget.ends(until)
    chosen, begun = first_starts(search, base, floor, found, led, candidates, free, slopes, ranked, columns, hurried=hurried)
    led_here = [c for c in candidates if c.key in chosen and c.key in ends]
    starts = [(c, with_effect(lab, base.point, c, ends[c.key], found), None) for c in led_here] + begun
    promise = {c.key: stays for stays, c, *_ in reversed(ranked)}
    if (first or found) and not hurried:
        starts, least = contests.sized(lab, starts, base, slopes, floor, until=until)
        promise |= {key: min(share, promise.get(key, math.inf)) for key, share in least.items()}
        starts.sort(key=lambda start: promise.get(start[0].key, math.inf))
        keys = list(dict.fromkeys(c.key for c, *_ in starts))
        out: set[str] = set()
        if found:
            near = _near(promise[c.key] for c, *_ in starts if len(c.parameters) <= MANY)
            out = {key for key in keys[search.keep :] if promise.get(key, math.inf) >= near}
        elif tries_all(lab, led):
            out = set([key for key in keys if key not in led.keys][OWN:])
        elif not lab.problem.together:
            runs = {c.key for _, c, *_ in ranked}
            able = {c.key for c, *_ in starts if c.linear and c.key in runs and c.key in least}
            out = {key for key in keys[LEADERS:] if key in able and promise[key] > FAINT}
        starts = [start for start in starts if start[0].key not in out]
        chosen = {key: i for key, i in chosen.items() if key not in out}
    return Promising(candidates, free, slopes, columns, chosen, starts, promise)


def tries_all(lab: Laboratory, led: Led | None) -> bool:
    """Whether the first look by another method tries every small candidate at several sizes, before it keeps a few: in one launch.

    A viscosity of volume promised nothing by its direction where the declared model was fitted, and left noise alone at a larger size.
    """
    return led is not None and led.chosen is not None and lab.problem.together


def first_starts(
    search: Search,
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
    lab = search.lab
    chosen: dict[str, int] = {}
    starts: list[Start] = []
    # what many parameters could fit says little of how near the others are
    near = _near(stays for stays, c, *_ in ranked if len(c.parameters) <= MANY)
    keep, leaders = (search.keep, ()) if led is None else (min(search.keep, OWN), led.keys)
    first = led is None and not found
    # beside an effect they are tried at larger sizes before any is chosen, and by another method where that costs one launch
    every = bool(found or tries_all(lab, led)) and not hurried
    for stays, c, i, begin in ranked:
        leads = c.key in leaders
        small = len(c.parameters) <= SMALL and (every or (first and (stays < VAIN or not c.linear)))
        if c.key not in chosen and (keep > 0 or leads or small or (led is None and stays < near)):
            keep -= not (small or leads)
            chosen[c.key] = i
            starts.append((c, begin, contests.first_slopes(lab, c, i, free, slopes, columns, floor)))
            if not c.linear:
                starts.append((c, contests.at_declared(lab, begin), None))
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
            starts.append((c, {**contests.at_declared(lab, base.point), **c.starts[0]}, None))
    for c in (c for c in candidates if first and not hurried and c.far and c.key in chosen):
        places = [c.starts[i] for _, other, i, _ in ranked if other is c][:PLACES]
        starts += [(c, begin, None) for begin in contests.strong(lab, c, places, base.point, floor)]
    return chosen, starts


def with_effect(lab: Laboratory, point: Point, c: Candidate, end: Point, found: Sequence[Trial] = ()) -> Point:
    """A point with a candidate's parameters, the declared ones and those of what was found, of the end of another fit of it."""
    names = {*lab.as_declared, *(p.name for t in found for p in t.candidate.parameters)}
    return {**point, **{name: value for name, value in end.items() if name in names}, **c.own(end)}


def without_own(
    search: Search, point: Point, starts: Sequence[Start], found: Sequence[Trial], ended: Sequence[tuple[Candidate, Fit]]
) -> list[Start]:
    """The starts once more without the problem's own parameters, where the base has some: what it needs them for may be an effect.

    Of the candidates that the screening or the fits with them (`ended`, best first) put among the first; and where these fits ended.
    """
    lab = search.lab
    plain = {k: v for k, v in point.items() if "." in k or k in lab.as_declared}
    if plain == dict(point):
        return []
    if not found and search.still is not None:
        plain = dict(search.still)
    keys = {*list(dict.fromkeys(c.key for c, *_ in starts))[:LEADERS], *(c.key for c, _ in ended[:ALSO_WITHOUT])}
    begun: list[Start] = [(c, plain | c.own(b), None) for c, b, _ in starts if c.key in keys]
    return begun + [(c, with_effect(lab, plain, c, fit.point), None) for c, fit in ended[:ALSO_WITHOUT]]


def screened(lab: Laboratory, point: Point, floor: Floor, found: Sequence[Trial], most: float, led: Led | None = None):
    """The candidates beside effects that were found, the free parameters and their slopes, and what `screen` says.

    What did not lead among another method's first fits has the one start here that it was given there.
    """
    taken = {t.candidate.name for t in found}
    candidates = [c for c in lab.problem.candidates if c.name not in taken and len(c.parameters) <= most]
    if led is not None and led.chosen is not None:
        at = led.chosen
        candidates = [c if c.key in led.keys else replace(c, starts=(c.starts[at.get(c.key, 0)],)) for c in candidates]
    free = (*lab.problem.declared, *(p for t in found for p in t.candidate.parameters))
    slopes = directions.slopes(lab, free, point, lab.scored_recordings)
    return candidates, free, slopes, *directions.screen(lab, point, candidates, floor, slopes)


def _near(promises: Iterable[float]) -> float:
    """Share of the misfit below which a candidate beyond the first few may promise as much as they do."""
    return min(2.0 * min(promises, default=0.0), HOPELESS)
