"""The choice between methods of prediction: which one a diagnosis uses where several can simulate the body."""

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
"""Factor by which the first fits of the suggested method may leave more than another method's and still be refined first."""
LOOKS = (0.5, 0.8)
"""Shares of the search's work at which first fits end: by the first method, and by other methods. The rest is for refining."""
AS_SURE = 2.0
"""Ratio to the noise up to which the error with a named effect is no reason to ask another method. In five blind seeds another method
took its place in none of eight such cases, and in all three cases with a ratio of 2.3 to 2.4."""
HANDICAP = math.log(1.2)
"""Penalty on the score (mean logarithm of squared errors) of a method other than the suggested one."""
UNASKED = 2.0 * LEAST_GAIN
"""Least gain of a named effect where the search ended before another method refined it: twice the usual one. Among such searches of a
blind seed a false alarm gained log 2.4, half of a pair log 2.7, and correct effects log 3.3 to log 9."""


def is_explained_exactly(search: Search, start: Stand) -> bool:
    """Return whether a method names an effect with which one simulation leaves only noise; no other method is asked then.

    An effect is searched for only where the residual is clearly above the floor and the first fits come down to noise. `first_rounds`
    reuses the round of that search. Where simulations run one by one, no growing fits are made here: they cost much, and by the wrong
    method all of them leave much.
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
    """Return the method that the diagnosis uses, and the first round of each method that was asked.

    A method has two rounds where only two effects together gain enough. The suggested method is asked first, unless the declared model fits
    far better by another. Where some method leaves only noise, no effect is searched for.

    Args:
        tried: The search of each method.
        starts: The base fit of each method.

    Returns:
        The index of the method, and the rounds by index.
    """
    settled = [i for i, start in enumerate(starts) if comparing.is_noise(tried[i].lab, start.errors)]
    if settled:
        chosen = min(settled, key=lambda i: float(np.mean(starts[i].errors)))
        return chosen, {chosen: [unsearched(starts[chosen], tried[chosen].lab.noise_squares)]}
    handicap = [0.0 if i == 0 else HANDICAP for i in range(len(tried))]
    base = [score(start.errors) + h for start, h in zip(starts, handicap, strict=True)]
    order = sorted(range(len(tried)), key=lambda i: base[i])
    # where an effect is missing, the base fits say little about the methods: the suggested one goes first unless it is far worse
    suggested = base[0] - base[order[0]] < 2.0 * math.log(WORSE)
    seen = by_first_fits(tried, starts, sorted(order, key=lambda i: i > 0) if suggested else order, handicap)
    order = sorted(order, key=lambda i: seen.get(i, math.inf) + 2.0 * math.log(CLEARLY) * (i > 0))
    firsts: dict[int, list[Round]] = {}
    unasked = False
    for i in order:
        named = [rounds[0] for rounds in firsts.values() if rounds[0].chosen]
        if firsts and not named and least_score(tried[i], starts[i]) + handicap[i] - base[order[0]] > 2.0 * math.log(WORSE):
            continue
        at_first = -math.inf if has_put_off_fits(tried[i]) else seen.get(i, -math.inf)
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
    # by a method whose base fit is not the best, an effect must leave clearly less than the best base fit
    bare = min(range(len(tried)), key=lambda i: base[i])
    alone = bare not in firsts or firsts[bare][0].chosen is None
    sure = {i: 2.0 * LEAST_GAIN * (i != bare and firsts[i][0].chosen is not None and alone) for i in firsts}
    weighed = {i: best[i] + handicap[i] + sure[i] for i in firsts}
    chosen = min(firsts, key=lambda i: weighed[i])
    if bare not in firsts and firsts[chosen][0].chosen is not None and weighed[chosen] > base[bare]:
        start, there = starts[bare], tried[bare]  # that method was not asked, and no effect does better than its base fit
        floors = discretisation.floors(there.lab, start.fit.point, there.lab.problem.declared, start.floor)
        chosen, firsts[bare] = bare, [unsearched(start, floors)]
    first = firsts[chosen][0]
    if unasked and len(firsts[chosen]) == 1 and first.chosen is not None and first.chosen.gain < UNASKED:
        for t in first.members:
            t.reason = t.too_little(UNASKED, "as the search ended before the other method")
        firsts[chosen] = [replace(first, chosen=None, members=[], unsure=True)]
    return chosen, firsts


def unsearched(start: Stand, floors: np.ndarray) -> Round:
    """Return a round of the declared model in which no effect was searched for."""
    return Round(start.fit.point, start.errors, [], None, [], 1.0, start.floor, floors)


def has_put_off_fits(search: Search) -> bool:
    """Return whether most first fits by a method were put off, so that the others say little about the method."""
    return search.seen is not None and search.seen.contest.put_off is not None


def least_score(search: Search, start: Stand) -> float:
    """Return the score of the base fit, or of the best first fit of an effect where such fits exist and leave less."""
    look = search.seen
    fits = look.least if look is not None and look.base is start.fit else []
    return min(score(squares) for squares in [start.errors, *fits])


def by_first_fits(tried: Sequence[Search], starts: Sequence[Stand], order: Sequence[int], handicap: Sequence[float]) -> dict[int, float]:
    """Return the score of the first fits of effects by each method, its handicap included.

    How well a method fits the declared model says little about how well it fits with the missing effect, and refining by the wrong method
    takes long. So other methods are asked for first fits where those of the first method promise an effect, or its residual is above the
    floor, and they leave more than what refining may bring down to noise.

    Another method fits only the candidates that led by the first method, also from the ends of those fits, and a few that its own screening
    adds. Where simulations run one by one, growing fits come after all of these: by the method that leaves least, and by the others as long
    as that one leaves much.

    Args:
        tried: The search of each method.
        starts: The base fit of each method.
        order: Indices of the methods, the first to be asked first.
        handicap: Penalty on the score of each method.
    """
    first, *others = order
    at_once = tried[first].lab.problem.together
    limit = score(starts[first].errors) + handicap[first] + 2.0 * math.log(WORSE)
    others = [i for i in others if least_score(tried[i], starts[i]) + handicap[i] <= limit]
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
        """Record the score of the first fits by a method, and return the least errors that they leave."""
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
