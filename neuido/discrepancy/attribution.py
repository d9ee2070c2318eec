"""From a residual to a name: grow the model by one effect at a time, drop what became needless, and say how sure the answer is."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from neuido.discrepancy.deadline import Deadline
from neuido.discrepancy.fit import Fit
from neuido.discrepancy.floors import Floor, Part, split
from neuido.discrepancy.intervals import intervals
from neuido.discrepancy.judging import ALPHA, CLASS_RATIO, WITHIN
from neuido.discrepancy.laboratory import LEAST_GAIN, Tell
from neuido.discrepancy.memo import Memo, Work
from neuido.discrepancy.pairs import WORSE, look_ahead, neighbours, simpler, two_effects
from neuido.discrepancy.problem import Point, Problem
from neuido.discrepancy.refining import BEYOND
from neuido.discrepancy.rounds import UNEXPLAINED, Inference
from neuido.discrepancy.trials import Round, Stand, Trial, score

__all__ = [
    "ALPHA",
    "MOST",
    "UNEXPLAINED",
    "WITHIN",
    "Diagnosis",
    "Floor",
    "Inference",
    "Part",
    "Round",
    "Stand",
    "Trial",
    "diagnose",
    "split",
]

MOST = 3
"""Effects that a growth may add."""
FURTHER = 1.5
"""Times its floor above which what an effect leaves is searched for another one: eight searches below it found none."""
CLEARLY = 1.5
"""Times the error of another method's first fits at which those of the suggested one are refined first all the same."""
LOOKS = (0.5, 0.8)
"""Shares of the time for the search at which the first fits by the first method end, and those by others: the rest is for refining."""
NEARLY = 2.5
"""Times the noise up to which what the first fits leave is refined before another method is asked: it may be noise then."""
AS_SURE = 2.0
"""Times the noise up to which what a named effect leaves is no reason to ask another method: in five blind seeds none of eight that were
asked there took its place, of three that left 2.3 to 2.4 times as much all."""
EARLY = 1.5
"""Times its floor above which what the suggested method leaves is searched before another method has its declared model fitted."""
UNASKED = math.log(3.0)
"""Gain from which an effect is named although there was no time to refine by another method: of the searches of a blind seed that were cut
off there a false alarm gained 2.4, half of a pair 2.7, what was right or near 3.3 to 9."""


@dataclass(eq=False)
class Diagnosis:
    """What `diagnose` found; `report.py` writes it."""

    problem: Problem
    answer: str
    rounds: list[Round]
    before: Point
    after: Point
    parts: list[Part]
    errors: dict[str, dict[str, float]]
    """`before` and `after`: error of each recording by name, with the differences of the settings that the fitted recordings hold."""
    one_setting: dict[str, dict[str, float]]
    """The same of a simulation under one setting alone."""
    amounts: dict[str, np.ndarray]
    """`before` and `after`: how much of each difference that is."""
    final: dict[str, Floor]
    """`before` and `after`: noise and discretisation there."""
    floors: dict[str, float]
    intervals: dict[str, tuple[float, float]]
    declared_intervals: dict[str, tuple[float, float]]
    setting: int
    work: Mapping[str, Work]
    """What each step ran."""
    deadline: Deadline = field(default_factory=Deadline)
    """When it has to come to its end."""

    @property
    def left_out(self) -> tuple[str, ...]:
        """What there was no time for."""
        return tuple(self.deadline.left_out)

    @property
    def evaluations(self) -> int:
        """Simulations in all."""
        return sum(w.simulations for w in self.work.values())

    @property
    def effects(self) -> list[Trial]:
        return [r.chosen for r in self.rounds if r.chosen is not None]


def diagnose(
    problem: Problem,
    *,
    keep: int = 7,
    draws: int = 199,
    seed: int = 0,
    most: int = MOST,
    tell: Tell | None = None,
    seconds: float = math.inf,
) -> Diagnosis:
    """Fit the declared model, look for effects that it lacks, and say what was found.

    Args:
        problem: Model and data.
        keep: Candidates that get a full fit in each round, at the least.
        draws: Of the parametric bootstrap of the largest gain.
        seed: Of the draws.
        most: Effects that may be added.
        tell: Called with a line of progress.
        seconds: After which it comes to its end; see `Deadline`.
    """
    memo = Memo(problem)
    deadline = Deadline(seconds, pace=lambda: memo.pace)
    tried: list[Inference] = []
    starts: list[Stand] = []
    for n in problem.solvers:
        inference = Inference(problem, setting=n, keep=keep, draws=draws, seed=seed, tell=tell, memo=memo, deadline=deadline)
        if starts and (tried[-1].is_settled(starts[-1].errors) or deadline.skips(problem.setting_name(n))):
            continue
        if len(starts) == 1 and told_exactly(tried[0], starts[0]):
            break
        # the problem's own parameters are about the other method
        near = {name: starts[0].fit.point[name] for name in inference.as_declared} if starts else None
        start = inference.start(near)
        if start is not None:
            tried.append(inference)
            starts.append(start)
    chosen, firsts = first_rounds(tried, starts)
    inference, rounds = tried[chosen], firsts[chosen]
    start = rounds[0].plain or starts[chosen]
    if len(tried) > 1:
        inference.tell(f"solver: {problem.setting_name(inference.setting)}")
    at = start
    found: list[Trial] = [r.chosen for r in rounds[:-1] if r.chosen is not None]
    hurried = False
    while rounds[-1].chosen is not None:
        step = rounds[-1].chosen
        found.append(step)
        # near the noise too: what leaves that alone in one simulation is told by it, however little it gains
        settled = len(found) == most or inference.is_noise(step.errors)
        hurried = deadline.over
        if hurried and not settled:
            deadline.skips("a further effect")
        if hurried:  # what is left of the time is for the last fit
            deadline.conclude()
        at = inference.finished(step.stand)
        if settled or hurried or inference.is_noise(at.errors):
            break
        if problem.settings > 1 and not inference.is_settled(at.errors) and inference.over(at) < FURTHER:
            break
        rounds.append(inference.round(at.fit, at.floor, found))
    others = {tried[i]: own[0] for i, own in firsts.items() if i != chosen and len(own) == 1}
    if 0 < len(found) < 3 and not hurried:
        by, pair = two_effects(inference, rounds, found, at, others)
        if by is not inference:
            inference, start = by, pair[0].plain or starts[tried.index(by)]
        if pair:
            rounds = pair
            found = [r.chosen for r in pair]
            at = inference.finished(found[-1].stand)
    if len(found) == 1:
        widen(inference, rounds[0], at, others.values())
    deadline.conclude()
    if len(found) > 1:
        floor = inference.floor(at.fit.point)
        fit, found = drop(inference, at.fit, floor, found)
        fit, found = narrow(inference, fit, floor, found, rounds)
        at = inference.finished(Stand(fit, floor, inference.mean_squares([fit.point], floor)[0]))
    return conclude(inference, start, at, found, rounds)


def told_exactly(inference: Inference, start: Stand) -> bool:
    """Whether a method names an effect with which one simulation leaves nothing but noise: no other one is asked then.

    Looked for where the residual is above the floor, and the first fits come down to noise; `first_rounds` takes the round that it took.
    """
    if inference.problem.settings == 1 or inference.over(start) < EARLY:
        return False
    look = inference.look(start.fit, start.floor, until=LOOKS[0])
    if not look.least or not inference.is_noise(look.least[0]):
        return False
    first = inference.round(start.fit, start.floor, [])
    if first.chosen is None or inference.deadline.over:
        return False
    return inference.is_exact(replace(first.chosen, stand=inference.finished(first.chosen.stand)))


def first_rounds(tried: Sequence[Inference], starts: Sequence[Stand]) -> tuple[int, dict[int, list[Round]]]:
    """Which of the methods goes on, and the first round of each that was asked, or two where it takes two effects to gain enough.

    The one whose declared model fits best begins. Where nothing but noise is left there is nothing to look for.
    """
    settled = [i for i, start in enumerate(starts) if tried[i].is_noise(start.errors)]
    if settled:
        chosen = min(settled, key=lambda i: float(np.mean(starts[i].errors)))
        return chosen, {chosen: [unsearched(starts[chosen], tried[chosen].noise_squares)]}
    # another method must do clearly better before it takes the place of the suggested one
    handicap = [0.0 if i == 0 else math.log(1.2) for i in range(len(tried))]
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
        if any(r.chosen and seen.get(i, -math.inf) > r.chosen.score + handicap[i] + 2.0 * math.log(BEYOND) for r in named):
            continue
        if firsts and tried[i].deadline.skips("effects by the other method"):
            unasked = True
            continue
        first = tried[i].asked or tried[i].round(starts[i].fit, starts[i].floor, [], named[0] if named else None)
        least = min((t.score for t in first.trials), default=math.inf)
        beaten = any(r.chosen and r.chosen.score <= least for r in named)
        firsts[i] = [first] if beaten else look_ahead(tried[i], first)
        last = firsts[i][-1]
        if last.trials and tried[i].is_noise(last.trials[0].errors):
            break
        if last.chosen is not None and tried[i].is_noise(last.chosen.errors / AS_SURE**2):
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
        floors = there.floors(start.fit.point, there.problem.declared, start.floor)
        chosen, firsts[bare] = bare, [unsearched(start, floors)]
    first = firsts[chosen][0]
    if unasked and len(firsts[chosen]) == 1 and first.chosen is not None and first.chosen.gain < UNASKED:
        for t in first.members:
            t.reason = t.too_little(UNASKED, "with no time for the other method")
        firsts[chosen] = [replace(first, chosen=None, members=[], unsure=True)]
    return chosen, firsts


def unsearched(start: Stand, floors: np.ndarray) -> Round:
    """The round of a declared model beside which no effect was looked for."""
    return Round(start.fit.point, start.errors, [], None, [], 1.0, start.floor, floors)


def at_best(inference: Inference, start: Stand) -> float:
    """Score of what the declared model leaves, or the first fits of effects beside it, where these were made already and leave less."""
    look = inference.seen
    fits = look.least if look is not None and look.base is start.fit else []
    return min(score(squares) for squares in [start.errors, *fits])


def by_first_fits(tried: Sequence[Inference], starts: Sequence[Stand], order: Sequence[int], handicap: Sequence[float]) -> dict[int, float]:
    """Score of what the first fits of effects leave by each method, its handicap included.

    Asked of another one where the first in the order promises an effect, or its residual is above the floor, and its fits leave more than
    what may be noise once it is refined: what a method leaves of the declared model says little of how well it fits with the effect, and
    to refine by the wrong one takes long. By another one those are fitted that led by the first, from where their fits ended too, and the
    few that its own directions add.
    """
    first, *others = order
    limit = score(starts[first].errors) + handicap[first] + 2.0 * math.log(WORSE)
    others = [i for i in others if at_best(tried[i], starts[i]) + handicap[i] <= limit]
    if not others:
        return {}
    look = tried[first].look(starts[first].fit, starts[first].floor, until=LOOKS[0])
    least = min([*look.least, starts[first].errors], key=score)
    if tried[first].gain(starts[first].errors, least) < LEAST_GAIN and tried[first].over(starts[first]) < 1.0:
        return {}
    left = {first: score(least) + handicap[first]}
    if tried[first].is_noise(least / NEARLY**2):
        return left
    for i in others:
        if tried[i].deadline.skips("first fits by the other method", LOOKS[1]):
            break
        beyond = left[first] - handicap[i] + 2.0 * math.log(WORSE)
        there = tried[i].look(starts[i].fit, starts[i].floor, led=look.led, beyond=beyond, until=LOOKS[1])
        left[i] = score(there.least[0]) + handicap[i] if there.least else math.inf
    return left


def widen(inference: Inference, r: Round, at: Stand, others: Iterable[Round]) -> None:
    """Put into the class of a round what another method named that leaves about as much, where that is more than noise.

    The methods differ there by as much as the effects do, so that the data tell neither apart.
    """
    if inference.is_settled(at.errors):
        return
    for other in others:
        if other.chosen is None or other.chosen.score > score(at.errors) + 2.0 * math.log(CLASS_RATIO):
            continue
        for t in other.members:
            if t.candidate.name not in {m.candidate.name for m in r.members}:
                r.trials = sorted([*(o for o in r.trials if o.candidate.key != t.candidate.key), t], key=lambda t: t.score)
                r.members = [*r.members, t]


def narrow(inference: Inference, base: Fit, floor: Floor, found: list[Trial], rounds: list[Round]) -> tuple[Fit, list[Trial]]:
    """Weigh each class of effects again beside all others that were found: the best one of each stays, with those near it.

    So are simpler candidates that came close: before the others were found a force of many parameters may have stood for two effects. And
    where all of them together leave more than noise, the others that came close: a neighbour of the true one may have led alone.
    """
    for r in rounds:
        if r.chosen not in found:
            continue
        rest = [t for t in found if t is not r.chosen]
        beside = tuple(p for t in rest for p in t.candidate.parameters)
        own = {p.name for p in r.chosen.candidate.parameters}
        without = {k: v for k, v in base.point.items() if k not in own}
        left = inference.mean_squares([base.point], floor)[0]
        rivals = simpler(r, r.chosen) + ([] if inference.is_noise(left) else neighbours(r, r.chosen))
        taken = {o.candidate.name for o in rest}
        members = [t for t in dict.fromkeys((*r.members, *rivals)) if t.candidate.name not in taken]
        if len(members) == 1:
            continue
        requests = []
        for t in members:
            start = base.point if t is r.chosen else without | {p.name: t.fit.point[p.name] for p in t.candidate.parameters}
            requests.append(inference.request((*inference.problem.declared, *beside, *t.candidate.parameters), start))
        fits = inference.fits(requests, floor)
        squares = inference.mean_squares([fit.point for fit in fits], floor)
        weighed = [replace(t, stand=Stand(fit, floor, square)) for t, fit, square in zip(members, fits, squares, strict=True)]
        at = min(range(len(weighed)), key=lambda i: weighed[i].penalised)
        for t, new in zip(members, weighed, strict=True):
            above = math.exp(0.5 * (new.score - weighed[at].score))
            near = new is weighed[at] or inference.as_good(new, weighed[at])
            t.reason = "" if near else f"with all effects that were found it leaves {above:.1f} times the error of the best"
        found[found.index(r.chosen)] = members[at]
        base, r.chosen, r.members = fits[at], members[at], [t for t in members if not t.reason]
    return base, found


def drop(inference: Inference, base: Fit, floor: Floor, found: list[Trial]) -> tuple[Fit, list[Trial]]:
    """Leave out effects that the others make needless, from where all of them together brought the fit, the most needless one first.

    What is held out says so: what fits the fitted recordings alone as well may foretell nothing.
    """
    while len(found) > 1:
        declared, requests = inference.problem.declared, []
        rests = [[t for t in found if t is not trial] for trial in found]
        for trial, rest in zip(found, rests, strict=True):
            free = (*declared, *(p for t in rest for p in t.candidate.parameters))
            requests.append(inference.request(free, trial.candidate.without(base.point)))
        fits = inference.fits(requests, floor)
        with_all, *squares = inference.mean_squares([base.point, *(fit.point for fit in fits)], floor)
        lost = [inference.foretold(without, with_all) for without in squares]
        least = min(range(len(found)), key=lambda i: lost[i])
        if lost[least] > LEAST_GAIN / 2:
            break
        base, found = fits[least], rests[least]
    return base, found


def conclude(inference: Inference, before: Stand, after: Stand, found: list[Trial], rounds: list[Round]) -> Diagnosis:
    """The answer and its figures, each stand with the floor that its effects were weighed with."""
    first = rounds[0]
    kept = {t.candidate.key for t in found}
    steps = [r for r in rounds if r.chosen is None or r.chosen.candidate.key in kept]
    if found:
        classes = [len({t.candidate.name for t in r.members}) for r in steps if r.chosen is not None]
        answer = "class" if max(classes) > 1 else "effect"
    elif first.unsure or inference.is_unexplained(first):
        answer = "unknown"
    else:
        answer = "none" if enough(inference) else "insufficient"
    stands = {"before": before, "after": after}
    alone = {when: inference.mean_squares([s.fit.point], s.floor, plain=True)[0] for when, s in stands.items()}
    own = intervals(inference, after.fit, after.floor, after.errors)
    declared = {}
    if inference.problem.declared:
        stated = Fit(before.fit.point, tuple(p.name for p in inference.problem.declared), 0.0, np.empty(0), 0, True)
        declared = intervals(inference, stated, before.floor, before.errors)
    scale, floor = inference.scale, after.floor
    return Diagnosis(
        inference.problem,
        answer,
        steps,
        before.fit.point,
        after.fit.point,
        inference.parts,
        {when: _by_recording(inference, s.errors) for when, s in stands.items()},
        {when: _by_recording(inference, row) for when, row in alone.items()},
        {when: inference.amounts(s.fit.point, s.floor) for when, s in stands.items()},
        {when: s.floor for when, s in stands.items()},
        {
            "noise": scale * math.sqrt(np.mean([v**2 for v in floor.noise.values()])),
            "discretisation": scale * math.sqrt(np.mean([np.mean(v**2) for v in floor.spread.values()])),
        },
        own,
        declared,
        inference.setting,
        inference.memo.work,
        inference.deadline,
    )


def enough(inference: Inference) -> bool:
    """Whether there are many more data than parameters in every part."""
    return all(int(p.rows.sum()) > 3 * len(inference.problem.declared) + 10 for p in inference.parts)


def _by_recording(inference: Inference, squares: np.ndarray) -> dict[str, float]:
    return {p.name: inference.scale * math.sqrt(float(v)) for p, v in zip(inference.parts, squares, strict=True)}
