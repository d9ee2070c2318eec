"""Which method of prediction a diagnosis goes by, where several can move the body, and the first round of each that is asked."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from neuido.discrepancy.inference import comparing, discretisation
from neuido.discrepancy.inference.comparing import LEAST_GAIN
from neuido.discrepancy.inference.floors import Round, Stand, score
from neuido.discrepancy.inference.search import base_fits, judging, next_effect, refining
from neuido.discrepancy.inference.search.judging import CLEAR, WITHIN
from neuido.discrepancy.inference.search.pairs import WORSE, look_ahead
from neuido.discrepancy.inference.search.refining import BEYOND
from neuido.discrepancy.inference.search.search_state import Search

CLEARLY = 1.5
"""Times the error of another method's first fits at which those of the suggested one are refined first all the same."""
LOOKS = (0.5, 0.8)
"""Shares of the search's work at which the first fits by the first method end, and those by others: the rest is for refining."""
AS_SURE = 2.0
"""Times the noise up to which what a named effect leaves is no reason to ask another method: in five blind seeds none of eight that were
asked there took its place, of three that left 2.3 to 2.4 times as much all."""
HANDICAP = math.log(1.2)
"""Mean logarithm of the errors' squares that another method must do better by, to take the place of the suggested one."""
UNASKED = 2.0 * LEAST_GAIN
"""Gain from which an effect is named although the search ended before it was refined by another method, twice the usual one: of the
searches of a blind seed that were cut off there a false alarm gained log 2.4, half of a pair log 2.7, what was right log 3.3 to log 9."""


def told_exactly(search: Search, start: Stand) -> bool:
    """Whether a method names an effect with which one simulation leaves nothing but noise: no other one is asked then.

    Looked for where the residual is above the floor, and the first fits come down to noise; `first_rounds` takes the round that it took.
    Where every point costs, none grow before the other method was asked: by the wrong one all leave much.
    """
    lab = search.lab
    if lab.problem.settings == 1 or next_effect.over_floor(lab, start) < CLEAR:
        return False
    look = next_effect.first_look(search, start.fit, start.floor, until=LOOKS[0], grows=lab.problem.together)
    if not look.least or not comparing.is_noise(lab, look.least[0]):
        return False
    first = next_effect.find(search, start.fit, start.floor, [])
    if first.chosen is None or lab.budget.ends():
        return False
    return judging.is_exact(search, replace(first.chosen, stand=base_fits.finished(lab, first.chosen.stand)))


def first_rounds(tried: Sequence[Search], starts: Sequence[Stand]) -> tuple[int, dict[int, list[Round]]]:
    """Which of the methods goes on, and the first round of each that was asked, or two where it takes two effects to gain enough.

    The one whose declared model fits best begins. Where nothing but noise is left there is nothing to look for.
    """
    settled = [i for i, start in enumerate(starts) if comparing.is_noise(tried[i].lab, start.errors)]
    if settled:
        chosen = min(settled, key=lambda i: float(np.mean(starts[i].errors)))
        return chosen, {chosen: [unsearched(starts[chosen], tried[chosen].lab.noise_squares)]}
    handicap = [0.0 if i == 0 else HANDICAP for i in range(len(tried))]
    base = [score(start.errors) + h for start, h in zip(starts, handicap, strict=True)]
    order = sorted(range(len(tried)), key=lambda i: base[i])
    # what is left of the declared model says little of the methods where an effect is missing: unless it is far worse, the suggested one
    suggested = base[0] - base[order[0]] < 2.0 * math.log(WORSE)
    seen = by_first_fits(tried, starts, sorted(order, key=lambda i: i > 0) if suggested else order, handicap)
    order = sorted(order, key=lambda i: seen.get(i, math.inf) + 2.0 * math.log(CLEARLY) * (i > 0))
    firsts: dict[int, list[Round]] = {}
    unasked = False
    for i in order:
        named = [rounds[0] for rounds in firsts.values() if rounds[0].chosen]
        if firsts and not named and at_best(tried[i], starts[i]) + handicap[i] - base[order[0]] > 2.0 * math.log(WORSE):
            continue
        at_first = -math.inf if waits(tried[i]) else seen.get(i, -math.inf)
        if any(r.chosen and at_first > r.chosen.score + handicap[i] + 2.0 * math.log(BEYOND) for r in named):
            continue
        if firsts and tried[i].lab.budget.skips("effects by the other method"):
            unasked = True
            continue
        first = tried[i].asked or next_effect.find(tried[i], starts[i].fit, starts[i].floor, [], named[0] if named else None)
        least = min((t.score for t in first.trials), default=math.inf)
        beaten = any(r.chosen and r.chosen.score <= least for r in named)
        firsts[i] = [first] if beaten else look_ahead(tried[i], first)
        last = firsts[i][-1]
        if last.trials and comparing.is_noise(tried[i].lab, last.trials[0].errors):
            break
        if last.chosen is not None and comparing.is_noise(tried[i].lab, last.chosen.errors / AS_SURE**2):
            break
        if last.chosen is None and last.over < WITHIN:
            break
    best = {
        i: min([t.score for r in rounds for t in r.trials if not t.reason or t in r.members] + [score(rounds[0].errors)])
        for i, rounds in firsts.items()
    }
    # by a method whose declared model is not the best one an effect must leave clearly less than that one does without any
    bare = min(range(len(tried)), key=lambda i: base[i])
    alone = bare not in firsts or firsts[bare][0].chosen is None
    sure = {i: 2.0 * LEAST_GAIN * (i != bare and firsts[i][0].chosen is not None and alone) for i in firsts}
    weighed = {i: best[i] + handicap[i] + sure[i] for i in firsts}
    chosen = min(firsts, key=lambda i: weighed[i])
    if bare not in firsts and firsts[chosen][0].chosen is not None and weighed[chosen] > base[bare]:
        start, there = starts[bare], tried[bare]  # it was not asked, and no effect does better than that
        floors = discretisation.floors(there.lab, start.fit.point, there.lab.problem.declared, start.floor)
        chosen, firsts[bare] = bare, [unsearched(start, floors)]
    first = firsts[chosen][0]
    if unasked and len(firsts[chosen]) == 1 and first.chosen is not None and first.chosen.gain < UNASKED:
        for t in first.members:
            t.reason = t.too_little(UNASKED, "as the search ended before the other method")
        firsts[chosen] = [replace(first, chosen=None, members=[], unsure=True)]
    return chosen, firsts


def unsearched(start: Stand, floors: np.ndarray) -> Round:
    """The round of a declared model beside which no effect was looked for."""
    return Round(start.fit.point, start.errors, [], None, [], 1.0, start.floor, floors)


def waits(search: Search) -> bool:
    """Whether most of the first fits by a method were put off: what the others leave says little of it."""
    return search.seen is not None and search.seen.contest.put_off is not None


def at_best(search: Search, start: Stand) -> float:
    """Score of what the declared model leaves, or the first fits of effects beside it, where these were made already and leave less."""
    look = search.seen
    fits = look.least if look is not None and look.base is start.fit else []
    return min(score(squares) for squares in [start.errors, *fits])


def by_first_fits(tried: Sequence[Search], starts: Sequence[Stand], order: Sequence[int], handicap: Sequence[float]) -> dict[int, float]:
    """Score of what the first fits of effects leave by each method, its handicap included.

    Asked of another one where the first in the order promises an effect, or its residual is above the floor, and its fits leave more than
    what may be noise once it is refined: what a method leaves of the declared model says little of how well it fits with the effect, and
    to refine by the wrong one takes long. By another one those are fitted that led by the first, from where their fits ended too, and the
    few that its own directions add. Where every point costs, fits grow after these alone, by the method that leaves least, and by the
    others while that leaves much.
    """
    first, *others = order
    at_once = tried[first].lab.problem.together
    limit = score(starts[first].errors) + handicap[first] + 2.0 * math.log(WORSE)
    others = [i for i in others if at_best(tried[i], starts[i]) + handicap[i] <= limit]
    if not others:
        return {}
    look = next_effect.first_look(tried[first], starts[first].fit, starts[first].floor, until=LOOKS[0], grows=at_once)
    least = min([*look.least, starts[first].errors], key=score)
    if (
        comparing.gain(tried[first].lab, starts[first].errors, least) < LEAST_GAIN
        and next_effect.over_floor(tried[first].lab, starts[first]) < 1.0
    ):
        return {}
    left = {first: score(least) + handicap[first]}

    def least_by(i: int, **options: Any) -> list[np.ndarray]:
        """What a look by a method leaves at the least, which is put down."""
        there = next_effect.first_look(tried[i], starts[i].fit, starts[i].floor, until=LOOKS[1], **options).least
        left[i] = score(there[0]) + handicap[i] if there else math.inf
        return there

    if comparing.may_be_noise(tried[first].lab, least):
        return left
    for i in others:
        if tried[i].lab.budget.skips("first fits by the other method", LOOKS[1]):
            break
        beyond = left[first] - handicap[i] + 2.0 * math.log(WORSE)
        least_by(i, led=look.led, beyond=beyond, grows=at_once)
    for i in [] if at_once else sorted(left, key=lambda i: left[i]):
        if not refining.leaves_much(tried[i].lab, least_by(i)):
            break
    return left
