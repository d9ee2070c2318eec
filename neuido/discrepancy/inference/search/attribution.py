"""From a residual to a name: grow the model by one effect at a time, drop what became needless, and say how sure the answer is."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from neuido.discrepancy.inference import comparing, discretisation
from neuido.discrepancy.inference.floors import Floor, Part, Round, Stand, Trial, score, times_over
from neuido.discrepancy.inference.journal import CaseRecord, Journal
from neuido.discrepancy.inference.laboratory import Tell
from neuido.discrepancy.inference.least_squares import Fit, NotFinite
from neuido.discrepancy.inference.power import Compatible, compatible
from neuido.discrepancy.inference.search import base_fits, judging, next_effect
from neuido.discrepancy.inference.search.choosing import first_rounds, told_exactly
from neuido.discrepancy.inference.search.decision import case_of, decided
from neuido.discrepancy.inference.search.intervals import blind_to_settings, findings, intervals, unable
from neuido.discrepancy.inference.search.judging import CLASS_RATIO, CLEAR, FORETELLS
from neuido.discrepancy.inference.search.pairs import by_growing, neighbours, simpler, two_effects
from neuido.discrepancy.inference.search.search_state import Search
from neuido.discrepancy.inference.statistics import statistics_of
from neuido.discrepancy.problems.problem import Point, Problem
from neuido.discrepancy.store import Budget, Memo, Work
from neuido.errors import UserError

MOST = 3
"""Effects that a growth may add."""


def widen(search: Search, r: Round, at: Stand, others: Iterable[Round]) -> None:
    """Put into the class of a round what another method named that leaves about as much, where that is more than noise.

    The methods differ there by as much as the effects do, so that the data tell neither apart.
    """
    if comparing.is_settled(search.lab, at.errors):
        return
    for other in others:
        if other.chosen is None or other.chosen.score > score(at.errors) + 2.0 * math.log(CLASS_RATIO):
            continue
        for t in other.members:
            if t.candidate.name not in {m.candidate.name for m in r.members}:
                r.trials = sorted([*(o for o in r.trials if o.candidate.key != t.candidate.key), t], key=lambda t: t.score)
                r.members = [*r.members, t]


def narrow(search: Search, base: Fit, floor: Floor, found: list[Trial], rounds: list[Round]) -> tuple[Fit, list[Trial]]:
    """Weigh each class of effects again beside all others that were found: the best one of each stays, with those near it.

    So are simpler candidates that came close: before the others were found a force of many parameters may have stood for two effects. And
    where all of them together leave more than noise, the others that came close: a neighbour of the true one may have led alone.
    """
    lab = search.lab
    for r in rounds:
        if r.chosen not in found:
            continue
        rest = [t for t in found if t is not r.chosen]
        beside = tuple(p for t in rest for p in t.candidate.parameters)
        own = {p.name for p in r.chosen.candidate.parameters}
        without = {k: v for k, v in base.point.items() if k not in own}
        left = lab.mean_squares([base.point], floor)[0]
        rivals = simpler(r, r.chosen) + ([] if comparing.is_noise(lab, left) else neighbours(r, r.chosen))
        taken = {o.candidate.name for o in rest}
        members = [t for t in dict.fromkeys((*r.members, *rivals)) if t.candidate.name not in taken]
        if len(members) == 1:
            continue
        requests = []
        for t in members:
            start = base.point if t is r.chosen else without | {p.name: t.fit.point[p.name] for p in t.candidate.parameters}
            requests.append(lab.request((*lab.problem.declared, *beside, *t.candidate.parameters), start))
        fits = lab.fits(requests, floor)
        squares = lab.mean_squares([fit.point for fit in fits], floor)
        weighed = [replace(t, stand=Stand(fit, floor, square)) for t, fit, square in zip(members, fits, squares, strict=True)]
        at = min(range(len(weighed)), key=lambda i: weighed[i].penalised)
        for t, new in zip(members, weighed, strict=True):
            above = math.exp(0.5 * (new.score - weighed[at].score))
            near = new is weighed[at] or judging.as_good(search, new, weighed[at])
            t.reason = "" if near else f"with all effects that were found it leaves {above:.1f} times the error of the best"
        found[found.index(r.chosen)] = members[at]
        base, r.chosen, r.members = fits[at], members[at], [t for t in members if not t.reason]
    return base, found


def drop(search: Search, base: Fit, floor: Floor, found: list[Trial]) -> tuple[Fit, list[Trial]]:
    """Leave out effects that the others make needless, from where all of them together brought the fit, the most needless one first.

    What is held out says so: what fits the fitted recordings alone as well may foretell nothing.
    """
    lab = search.lab
    while len(found) > 1:
        declared, requests = lab.problem.declared, []
        rests = [[t for t in found if t is not trial] for trial in found]
        for trial, rest in zip(found, rests, strict=True):
            free = (*declared, *(p for t in rest for p in t.candidate.parameters))
            requests.append(lab.request(free, trial.candidate.without(base.point)))
        fits = lab.fits(requests, floor)
        with_all, *squares = lab.mean_squares([base.point, *(fit.point for fit in fits)], floor)
        lost = [comparing.foretold(lab, without, with_all) for without in squares]
        least = min(range(len(found)), key=lambda i: lost[i])
        if lost[least] > FORETELLS:
            break
        base, found = fits[least], rests[least]
    return base, found


@dataclass(eq=False)
class Diagnosis:
    """What `diagnose` found; the folder `report` writes it."""

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
    budget: Budget = field(default_factory=Budget)
    """What it may take, and what ended it."""
    sealed: list[Part] = field(default_factory=list)
    """Recordings that took no part in the search: theirs is a test error."""
    leads: list[Trial] = field(default_factory=list)
    """What leads in a search that was cut off; nothing of it is named."""
    why: list[str] = field(default_factory=list)
    """Why the recordings say too little, or what is wrong with them."""
    over: dict[str, float] = field(default_factory=dict)
    """How far what is left after is above the `floor` and above the `noise`: ratios of errors."""
    power: list[Compatible] = field(default_factory=list)
    """The largest size of each other effect that the data are compatible with."""
    unable: Mapping[str, list[str]] = field(default_factory=dict)
    """The other settings that did not run, by recording."""
    noise_from: dict[str, str] = field(default_factory=dict)
    """`stated`, `estimated` or `assumed`, by recording."""
    case: CaseRecord | None = None
    """What the decision rests on."""
    statistics: Mapping[str, np.ndarray] | None = None
    """Statistics of the best fits, where they were asked for."""

    @property
    def left_out(self) -> tuple[str, ...]:
        """What the search has not done."""
        return tuple(self.budget.left_out)

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
    passes: float = math.inf,
    seconds: float = math.inf,
    statistics: bool = False,
) -> Diagnosis:
    """Fit the declared model, look for effects that it lacks, and say what was found.

    Args:
        problem: Model and data.
        keep: Candidates that get a full fit in each round, at the least.
        draws: Of the parametric bootstrap of the largest gain.
        seed: Of the draws.
        most: Effects that may be added.
        tell: Called with a line of progress.
        passes: Work of the search, in runs of the declared model through all recordings under the suggested setting.
        seconds: After which it is stopped; see `Budget`.
        statistics: Keep what a likelihood needs of the best fits, which takes further simulations.

    Raises:
        UserError: No method can predict the declared model; the line of its simulator.
    """
    memo, journal = Memo(problem), Journal()
    budget = budget_of(problem, memo, passes, seconds)
    if (watch := getattr(tell, "watch", None)) is not None:
        watch(budget)
    tried: list[Search] = []
    starts: list[Stand] = []
    for n in problem.solvers:
        if problem.margin({}, n) < 0.0:
            if starts:
                continue
            raise UserError(problem.refusal(n))
        shared = {"tell": tell, "memo": memo, "budget": budget, "journal": journal}
        search = next_effect.new_search(problem, setting=n, keep=keep, draws=draws, seed=seed, **shared)
        if starts and (comparing.is_settled(tried[-1].lab, starts[-1].errors) or budget.skips(problem.setting_name(n))):
            continue
        if len(starts) == 1 and told_exactly(tried[0], starts[0]):
            break
        # the problem's own parameters are about the other method
        near = {name: starts[0].fit.point[name] for name in search.lab.as_declared} if starts else None
        try:
            start = base_fits.base_fit(search, near)
        except NotFinite as error:
            raise UserError(problem.refusal(n)) from error
        if start is not None:
            tried.append(search)
            starts.append(start)
            journal.bases.append(journal.fit(n, {}, None, start, search.lab.parts))
    chosen, firsts = first_rounds(tried, starts)
    search, rounds = tried[chosen], firsts[chosen]
    start = rounds[0].plain or starts[chosen]
    if len(tried) > 1:
        search.lab.tell(f"solver: {problem.setting_name(search.lab.setting)}")
    at = start
    found: list[Trial] = [r.chosen for r in rounds[:-1] if r.chosen is not None]
    others = {tried[i]: own[0] for i, own in firsts.items() if i != chosen and len(own) == 1}
    hurried, grown = False, None
    while rounds[-1].chosen is not None:
        step = rounds[-1].chosen
        found.append(step)
        # near the noise too: what leaves that alone in one simulation is told by it, however little it gains
        settled = len(found) == most or comparing.is_noise(search.lab, step.errors)
        hurried = budget.over
        if hurried and not settled:
            budget.skips("a further effect")
        if hurried:  # nothing but the last fit follows
            budget.conclude()
        at = base_fits.finished(search.lab, step.stand)
        if settled or hurried or comparing.is_noise(search.lab, at.errors):
            break
        if problem.together and len(found) == 1 and (grown := by_growing(search, rounds[0], at, others)):
            break
        if problem.settings > 1 and not comparing.is_settled(search.lab, at.errors) and next_effect.over_floor(search.lab, at) < CLEAR:
            break
        rounds.append(next_effect.find(search, at.fit, at.floor, found))
    # where every point costs pairs grow after what takes less, and where nothing was named last of all
    if not hurried and (not found or (len(found) == 1 and not problem.together)):
        grown = by_growing(search, rounds[0], at, others)
    if hurried and 0 < len(found) < MOST and not comparing.is_settled(search.lab, at.errors):
        budget.skips("two effects at once")
    if grown or (0 < len(found) < 3 and not hurried):
        by, pair = grown or two_effects(search, rounds, found, at, others)
        if by is not search:
            search, start = by, pair[0].plain or starts[tried.index(by)]
        if pair:
            rounds = pair
            found = [r.chosen for r in pair if r.chosen is not None]
            at = base_fits.finished(search.lab, found[-1].stand)
    if len(found) == 1:
        widen(search, rounds[0], at, others.values())
    budget.conclude()
    if len(found) > 1:
        floor = discretisation.floor_at(search.lab, at.fit.point)
        fit, found = drop(search, at.fit, floor, found)
        fit, found = narrow(search, fit, floor, found, rounds)
        at = base_fits.finished(search.lab, Stand(fit, floor, search.lab.mean_squares([fit.point], floor)[0]))
    made = conclude(search, start, at, found, rounds)
    if statistics and made.case is not None:
        made.statistics = statistics_of([s.lab for s in tried], [s.floor for s in starts], journal, (made.case.before, made.case.after))
    return made


def budget_of(problem: Problem, memo: Memo, passes: float, seconds: float) -> Budget:
    """Return the budget of a search in the unit of the problem's effort: of a body particle-substeps, so that it goes with its size."""
    one = sum(problem.effort(n, problem.solvers[0]) for n in range(len(problem.recordings)))
    return Budget(passes * one, spent=lambda: memo.effort, seconds=seconds, pace=lambda: memo.pace)


def conclude(search: Search, before: Stand, after: Stand, found: list[Trial], rounds: list[Round]) -> Diagnosis:
    """The answer and its figures, each stand with the floor that its effects were weighed with."""
    lab = search.lab
    first, problem = rounds[0], lab.problem
    cut = lab.budget.cut and (bool(found) or not comparing.is_noise(lab, before.errors))
    kept = {t.candidate.key for t in found}
    steps = [r for r in rounds if r.chosen is None or r.chosen.candidate.key in kept]
    leads = leading(rounds) if cut else []
    over = next_effect.over_floor(lab, after) if found and not cut else first.over
    wrong = [] if cut else findings(lab, after)
    missing = bool(found) or first.unsure or next_effect.is_unexplained(lab, first)
    if missing and not cut and not wrong:
        discretisation.floor_at(lab, after.fit.point, like=after.floor)  # which settings run there
    facts = {"cut": cut, "wrong": wrong, "blind": missing and blind_to_settings(lab), "found": [t.candidate.key for t in found]}
    answer, why = decided(lab, before.errors, found, steps, cut=cut, wrong=wrong, blind=facts["blind"])
    case = case_of(lab, before, after, rounds, answer, why, facts)
    if found and answer not in ("effect", "class"):  # nothing is named, and nothing added
        after, found, over = before, [], first.over
        steps = [replace(first, chosen=None, members=[])]
    stands = {"before": before, "after": after}
    alone = {when: lab.mean_squares([s.fit.point], s.floor, plain=True)[0] for when, s in stands.items()}
    own = intervals(lab, after.fit, after.floor, after.errors)
    declared = {}
    if problem.declared:
        stated = Fit(before.fit.point, tuple(p.name for p in problem.declared), 0.0, np.empty(0), 0, True)
        declared = intervals(lab, stated, before.floor, before.errors)
    scale, floor = lab.scale, after.floor
    power = [] if cut or lab.budget.over else compatible(lab, after, rounds[-1], found)
    amounts = {when: lab.amounts(s.fit.point, s.floor) for when, s in stands.items()}
    final, errors, single = tested(search, stands, amounts, alone)
    return Diagnosis(
        problem,
        answer,
        steps,
        before.fit.point,
        after.fit.point,
        lab.parts,
        errors,
        single,
        amounts,
        final,
        {
            "noise": scale * math.sqrt(np.mean([v**2 for v in floor.noise.values()])),
            "discretisation": scale * math.sqrt(np.mean([np.mean(v**2) for v in floor.spread.values()])),
        },
        own,
        declared,
        lab.setting,
        lab.memo.work,
        lab.budget,
        sealed=list(lab.sealed),
        leads=leads,
        why=why,
        over={"floor": over, "noise": times_over(after.errors, lab.noise_squares)},
        power=power,
        unable=unable(lab),
        noise_from={r.name: lab.noise_from(n) for n, r in enumerate(problem.recordings)},
        case=case,
    )


def leading(rounds: Sequence[Round]) -> list[Trial]:
    """What leads in a search that was cut off: the effects that would be named, and else the best fit."""
    chosen = [r.chosen for r in rounds if r.chosen is not None]
    return chosen or [t for r in rounds[:1] for t in r.trials[:1] if t.gain > 0]


def tested(
    search: Search, stands: Mapping[str, Stand], amounts: Mapping[str, np.ndarray], alone: Mapping[str, np.ndarray]
) -> tuple[dict[str, Floor], dict[str, dict[str, float]], dict[str, dict[str, float]]]:
    """The floors, errors and errors under one setting, `before` and `after`, with those of the recordings that were sealed until now."""
    lab = search.lab
    floors, errors, single = {}, {}, {}
    for when, stand in stands.items():
        floors[when], point = stand.floor, stand.fit.point
        errors[when], single[when] = _by_recording(search, stand.errors), _by_recording(search, alone[when])
        for part in lab.sealed:
            there = discretisation.floor_at(lab, point, of=[part.recording])
            floors[when] = floors[when].joined(there)
            residual = {part.recording: lab.residual(point, part.recording)}
            for out, own in ((errors, amounts[when]), (single, None)):
                left = there.settle(residual[part.recording], part, own)
                out[when][part.name] = lab.scale * math.sqrt(float(np.mean(left**2)))
    return floors, errors, single


def _by_recording(search: Search, squares: np.ndarray) -> dict[str, float]:
    lab = search.lab
    return {p.name: lab.scale * math.sqrt(float(v)) for p, v in zip(lab.parts, squares, strict=True)}
