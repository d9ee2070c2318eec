"""The choice of candidates for full fits, and of the starts of these fits, from the screening and single simulations."""

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
"""Predicted share of the misfit from which a candidate of at most `SMALL` parameters gets no fit in the first round, if small sizes of
it act in proportion."""
FAINT = 0.9
"""Least share of the misfit, predicted or by one simulation, above which a candidate of one size gets no first fit where simulations run
one by one."""
PLACES = 9
"""Number of a candidate's starts, the first of the screening, that are tried at full strength."""
ALSO_WITHOUT = 6
"""Number of candidates of least cost that are also fitted without the extra parameters of the problem."""
OWN = 3
"""Number of candidates that the screening by a further method may add to those that led by the first one."""


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
    """Screen the candidates, and return those to be fitted with the starts of their fits; the arguments are those of `first_look`."""
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
    """Return whether the first look by another method tries every small candidate at several sizes before it keeps a few.

    It does so where all of them run in one launch. A volume viscosity seemed to do nothing by its direction at the base fit, and left only
    noise at a larger size.
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
    """Return the candidates that get a fit by the screening, and the starts of these fits.

    Args:
        search: The search by one method.
        base: The fit to which an effect is to be added.
        floor: Noise and discretisation there.
        found: The effects so far.
        led: Leading candidates of another method.
        candidates: All candidates.
        free: Parameters that are fitted beside those of a candidate.
        slopes: Slopes of the prediction along these, by recording.
        ranked: Result of the screening, the best first.
        columns: Directions of the candidates in the data.
        hurried: Whether to skip the starts at full strength.

    Returns:
        The best start of each chosen candidate, by key, and all starts.
    """
    lab = search.lab
    chosen: dict[str, int] = {}
    starts: list[Start] = []
    # a candidate of many parameters promises much anyway: only those of few set the limit
    near = _near(stays for stays, c, *_ in ranked if len(c.parameters) <= MANY)
    keep, leaders = (search.keep, ()) if led is None else (min(search.keep, OWN), led.keys)
    first = led is None and not found
    # beside a found effect, small candidates are first tried at larger sizes; by another method only where that is one launch
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
        # a candidate that fails or does nothing at the base fit may run and act at the declared values
        small = len(c.parameters) <= MANY if c.key not in finite else c.linear and len(c.parameters) <= SMALL
        if c.key not in chosen and ((first and small) or c.key in leaders):
            chosen[c.key] = 0
            starts.append((c, {**contests.at_declared(lab, base.point), **c.starts[0]}, None))
    for c in (c for c in candidates if first and not hurried and c.far and c.key in chosen):
        places = [c.starts[i] for _, other, i, _ in ranked if other is c][:PLACES]
        starts += [(c, begin, None) for begin in contests.strong(lab, c, places, base.point, floor)]
    return chosen, starts


def with_effect(lab: Laboratory, point: Point, c: Candidate, end: Point, found: Sequence[Trial] = ()) -> Point:
    """Return the point with the values of the candidate, the declared model and the found effects from the end of another fit."""
    names = {*lab.as_declared, *(p.name for t in found for p in t.candidate.parameters)}
    return {**point, **{name: value for name, value in end.items() if name in names}, **c.own(end)}


def without_own(
    search: Search, point: Point, starts: Sequence[Start], found: Sequence[Trial], ended: Sequence[tuple[Candidate, Fit]]
) -> list[Start]:
    """Return the starts once more without the extra parameters of the problem, or an empty list if the base has none.

    An extra parameter, such as the height of the colliders, may compensate for an effect. The list has the leading candidates of the
    screening and of the fits in `ended` (the best first), from their starts and from the ends of these fits.
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
    """Screen the candidates beside the effects that were found.

    A candidate that did not lead among another method's first fits has only the start that it was given there.

    Returns:
        The candidates, the free parameters, their slopes, and the two results of `directions.screen`.
    """
    taken = {t.candidate.name for t in found}
    able = [c for c in lab.problem.candidates if c.name not in taken and (not c.needs or c.needs in taken)]
    candidates = [c for c in able if len(c.parameters) <= most]
    if led is not None and led.chosen is not None:
        at = led.chosen
        candidates = [c if c.key in led.keys else replace(c, starts=(c.starts[at.get(c.key, 0)],)) for c in candidates]
    free = (*lab.problem.declared, *(p for t in found for p in t.candidate.parameters))
    slopes = directions.slopes(lab, free, point, lab.scored_recordings)
    return candidates, free, slopes, *directions.screen(lab, point, candidates, floor, slopes)


def _near(promises: Iterable[float]) -> float:
    """Return the share of the misfit below which a candidate beyond the first few is fitted too: twice the least, at most `HOPELESS`."""
    return min(2.0 * min(promises, default=0.0), HOPELESS)
