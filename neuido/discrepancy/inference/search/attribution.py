"""The whole diagnosis: add one effect at a time, drop effects that became needless, and state how sure the answer is."""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from time import monotonic

import numpy as np

from neuido.discrepancy.inference import comparing, discretisation
from neuido.discrepancy.inference.floors import Floor, Part, Round, Stand, Trial, score, times_over, worst_over
from neuido.discrepancy.inference.journal import CaseRecord, Journal
from neuido.discrepancy.inference.laboratory import Tell
from neuido.discrepancy.inference.least_squares import Fit, NotFinite
from neuido.discrepancy.inference.power import Compatible, compatible
from neuido.discrepancy.inference.search import base_fits, judging, next_effect
from neuido.discrepancy.inference.search.choosing import first_rounds, is_explained_exactly
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
"""Largest number of effects that one diagnosis may add."""


def widen(search: Search, r: Round, at: Stand, others: Iterable[Round]) -> None:
    """Add to the class of a round the effects that another method named, where they leave about the same error above noise.

    Two methods then differ as much as the effects do, and the data tell neither apart.
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
    """Compare the members of each class again beside all other effects that were found, and keep the best ones.

    Simpler candidates that came close are compared too: before the other effects were found, a force with many parameters may have stood
    for two effects. Where all effects together leave more than noise, other candidates that came close are compared as well.

    Returns:
        The fit with the best member of each class, and these members. The rounds are changed in place.
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
    """Remove effects that the others make needless, the most needless first, and refit after each removal.

    The held-out error decides: an effect may help to fit the fitted recordings and still predict nothing.
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
        lost = [comparing.held_out_gain(lab, without, with_all) for without in squares]
        least = min(range(len(found)), key=lambda i: lost[i])
        if lost[least] > FORETELLS:
            break
        base, found = fits[least], rests[least]
    return base, found


@dataclass(eq=False)
class Diagnosis:
    """The result of `diagnose`; `neuido.discrepancy.report` writes it."""

    problem: Problem
    answer: str
    rounds: list[Round]
    before: Point
    after: Point
    parts: list[Part]
    errors: dict[str, dict[str, float]]
    """`before` and `after`: error of each recording by name, of one simulation plus `amounts` of the differences between settings."""
    one_setting: dict[str, dict[str, float]]
    """`before` and `after`: error of each recording by name, of one simulation alone."""
    amounts: dict[str, np.ndarray]
    """`before` and `after`: how much of each difference between settings the fitted recordings show."""
    final: dict[str, Floor]
    """`before` and `after`: noise and discretisation at the fitted point."""
    floors: dict[str, float]
    intervals: dict[str, tuple[float, float]]
    declared_intervals: dict[str, tuple[float, float]]
    setting: int
    work: Mapping[str, Work]
    """Work of each step of the search."""
    budget: Budget = field(default_factory=Budget)
    """Limits of the search, and what ended it."""
    sealed: list[Part] = field(default_factory=list)
    """Recordings that took no part in the search; their error is the test error."""
    leads: list[Trial] = field(default_factory=list)
    """Leading effects of a search that was cut off; none of them is named."""
    why: list[str] = field(default_factory=list)
    """Why the recordings say too little, or what is wrong with them."""
    over: dict[str, float] = field(default_factory=dict)
    """Ratio of the final error to the `floor` and to the `noise`."""
    power: list[Compatible] = field(default_factory=list)
    """Largest size of each other effect with which the data are compatible."""
    unable: Mapping[str, list[str]] = field(default_factory=dict)
    """Names of the other settings that did not run, by recording."""
    noise_from: dict[str, str] = field(default_factory=dict)
    """Origin of the noise of each recording: `stated`, `estimated` or `assumed`."""
    case: CaseRecord | None = None
    """All that the decision rests on."""
    statistics: Mapping[str, np.ndarray] | None = None
    """Statistics of the best fits, if they were asked for."""

    @property
    def left_out(self) -> tuple[str, ...]:
        """Steps that the search did not do."""
        return tuple(self.budget.left_out)

    @property
    def evaluations(self) -> int:
        """Number of simulations in all."""
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
    clock: Callable[[], float] = monotonic,
    statistics: bool = False,
) -> Diagnosis:
    """Fit the declared model, search for effects that it lacks, and return what was found.

    Args:
        problem: Model and data.
        keep: Least number of candidates that get a full fit in each round.
        draws: Number of draws of the parametric bootstrap of the largest gain.
        seed: Seed of the draws.
        most: Largest number of effects that may be added.
        tell: Function that is called with each line of progress.
        passes: Work of the search, in runs of the declared model through all recordings under the suggested setting.
        seconds: Time [s] by `clock` after which the search is stopped; see `Budget`.
        statistics: Keep what a likelihood needs of the best fits, which takes further simulations.

    Raises:
        UserError: No method can predict the declared model; the message is that of its simulator.
    """
    memo, journal = Memo(problem), Journal()
    budget = budget_of(problem, memo, passes, seconds, clock)
    if (watch := getattr(tell, "watch", None)) is not None:
        watch(budget)

    def new_search(setting: int) -> Search:
        shared = {"tell": tell, "memo": memo, "budget": budget, "journal": journal}
        return next_effect.new_search(problem, setting=setting, keep=keep, draws=draws, seed=seed, **shared)

    tried, starts = fit_declared_model(problem, new_search, journal)
    course = first_effect(tried, starts)
    add_effects(course, most)
    if most > 1:
        try_pairs(course, tried, starts)
    if len(course.found) == 1:
        widen(course.search, course.rounds[0], course.at, course.others.values())
    budget.conclude()
    if len(course.found) > 1:
        weigh_together(course)
    made = conclude(course.search, course.start, course.at, course.found, course.rounds)
    if statistics and made.case is not None:
        made.statistics = statistics_of([s.lab for s in tried], [s.floor for s in starts], journal, (made.case.before, made.case.after))
    return made


@dataclass(eq=False)
class Course:
    """How far a diagnosis has come."""

    search: Search
    """The search by the method that was chosen."""
    start: Stand
    """The declared model by this method."""
    at: Stand
    """The model with all effects that were found."""
    rounds: list[Round]
    """A round for each effect, and perhaps one that found none."""
    found: list[Trial]
    """The effects, in the order in which they were found."""
    others: dict[Search, Round]
    """First rounds of the methods that were not chosen."""
    hurried: bool = False
    """Whether the budget ended while effects were added."""
    grown: tuple[Search, list[Round]] | None = None
    """Two effects that were fitted at once, and the search they belong to."""

    @property
    def settled(self) -> bool:
        """Whether nothing more can be asked of the data."""
        return comparing.is_settled(self.search.lab, self.at.errors)


def fit_declared_model(problem: Problem, new_search: Callable[[int], Search], journal: Journal) -> tuple[list[Search], list[Stand]]:
    """Fit the declared model by each method of simulation that may be needed, and return the searches and the fits.

    A further method is tried only where the ones before leave more than noise, and time.
    """
    tried: list[Search] = []
    starts: list[Stand] = []
    for n in problem.solvers:
        if problem.margin({}, n) < 0.0:
            if starts:
                continue
            raise UserError(problem.refusal(n))
        search = new_search(n)
        if starts and (comparing.is_settled(tried[-1].lab, starts[-1].errors) or search.lab.budget.skips(problem.setting_name(n))):
            continue
        if len(starts) == 1 and is_explained_exactly(tried[0], starts[0]):
            break
        # extra parameters of the problem belong to the other method: only the declared ones are passed on
        near = {name: starts[0].fit.point[name] for name in search.lab.as_declared} if starts else None
        try:
            start = base_fits.base_fit(search, near)
        except NotFinite as error:
            raise UserError(problem.refusal(n)) from error
        if start is not None:
            tried.append(search)
            starts.append(start)
            journal.bases.append(journal.fit(n, {}, None, start, search.lab.parts))
    return tried, starts


def first_effect(tried: list[Search], starts: list[Stand]) -> Course:
    """Look for the first effect by each method, and go on with the method that explains the data best."""
    chosen, firsts = first_rounds(tried, starts)
    search, rounds = tried[chosen], firsts[chosen]
    if len(tried) > 1:
        search.lab.tell(f"solver: {search.lab.problem.setting_name(search.lab.setting)}")
    start = rounds[0].plain or starts[chosen]
    found = [r.chosen for r in rounds[:-1] if r.chosen is not None]
    others = {tried[i]: own[0] for i, own in firsts.items() if i != chosen and len(own) == 1}
    return Course(search, start, start, rounds, found, others)


def add_effects(course: Course, most: int) -> None:
    """Add one effect after the other until only noise is left, the budget ends, or none of them helps.

    Where simulations run together, pairs are grown as soon as one effect leaves more than noise.
    """
    search, problem, rounds = course.search, course.search.lab.problem, course.rounds
    budget = search.lab.budget
    while rounds[-1].chosen is not None:
        step = rounds[-1].chosen
        course.found.append(step)
        # an effect near the noise counts too: it is named if one simulation with it leaves only noise, however small its gain
        enough = len(course.found) == most or comparing.is_noise(search.lab, step.errors)
        course.hurried = budget.over
        if course.hurried and not enough:
            budget.skips("a further effect")
        if course.hurried:  # only the last fit follows
            budget.conclude()
        course.at = base_fits.finished(search.lab, step.stand)
        if enough or course.hurried or comparing.is_noise(search.lab, course.at.errors):
            return
        if problem.together and len(course.found) == 1 and (grown := by_growing(search, rounds[0], course.at, course.others)):
            course.grown = grown
            return
        if problem.settings > 1 and not course.settled and next_effect.over_floor(search.lab, course.at) < CLEAR:
            return
        rounds.append(next_effect.find(search, course.at.fit, course.at.floor, course.found))


def try_pairs(course: Course, tried: list[Search], starts: list[Stand]) -> None:
    """Look for two effects that explain the data only together, and take them where they do better than what was found."""
    search, budget, found = course.search, course.search.lab.budget, course.found
    # where simulations run one by one, growing pairs come after the cheaper steps; where nothing was named, they come last
    if not course.hurried and (not found or (len(found) == 1 and not search.lab.problem.together)):
        course.grown = by_growing(search, course.rounds[0], course.at, course.others)
    if course.hurried and 0 < len(found) < MOST and not course.settled:
        budget.skips("two effects at once")
    if not course.grown and (course.hurried or not 0 < len(found) < MOST):
        return
    by, pair = course.grown or two_effects(search, course.rounds, found, course.at, course.others)
    if by is not search:
        course.search, course.start = by, pair[0].plain or starts[tried.index(by)]
    if pair:
        course.rounds = pair
        course.found = [r.chosen for r in pair if r.chosen is not None]
        course.at = base_fits.finished(by.lab, course.found[-1].stand)


def weigh_together(course: Course) -> None:
    """Drop effects that the others make needless, and choose again within the class of each beside all others."""
    lab = course.search.lab
    floor = discretisation.floor_at(lab, course.at.fit.point)
    fit, found = drop(course.search, course.at.fit, floor, course.found)
    fit, course.found = narrow(course.search, fit, floor, found, course.rounds)
    course.at = base_fits.finished(lab, Stand(fit, floor, lab.mean_squares([fit.point], floor)[0]))


def budget_of(problem: Problem, memo: Memo, passes: float, seconds: float, clock: Callable[[], float]) -> Budget:
    """Return the budget of a search in the unit of `Problem.effort` (particle-substeps for a body), so that it grows with the body."""
    one = sum(problem.effort(n, problem.solvers[0]) for n in range(len(problem.recordings)))
    return Budget(passes * one, spent=lambda: memo.effort, seconds=seconds, clock=clock, pace=lambda: memo.pace)


def conclude(search: Search, before: Stand, after: Stand, found: list[Trial], rounds: list[Round]) -> Diagnosis:
    """Return the diagnosis: the answer and its figures, before and after with the floor that each was measured with."""
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
        discretisation.floor_at(lab, after.fit.point, like=after.floor)  # records which settings run there
    facts = {"cut": cut, "wrong": wrong, "blind": missing and blind_to_settings(lab), "found": [t.candidate.key for t in found],
             "scatter": problem.labels.get("scatter", False)}  # fmt: skip
    answer, why = decided(lab, before.errors, found, steps, cut=cut, wrong=wrong, blind=facts["blind"])
    case = case_of(lab, before, after, rounds, answer, why, facts)
    if found and answer not in ("effect", "class"):  # no effect is named, so none is added
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
        over={"floor": over, "noise": times_over(after.errors, lab.noise_squares)}
        | ({"worst": worst_over(after.errors, lab.noise_squares_with(after.fit.point))} if problem.settings == 1 else {}),
        power=power,
        unable=unable(lab),
        noise_from={r.name: lab.noise_from(n) for n, r in enumerate(problem.recordings)},
        case=case,
    )


def leading(rounds: Sequence[Round]) -> list[Trial]:
    """Return the leading effects of a search that was cut off: those that would be named, else the best fit if it gains anything."""
    chosen = [r.chosen for r in rounds if r.chosen is not None]
    return chosen or [t for r in rounds[:1] for t in r.trials[:1] if t.gain > 0]


def tested(
    search: Search, stands: Mapping[str, Stand], amounts: Mapping[str, np.ndarray], alone: Mapping[str, np.ndarray]
) -> tuple[dict[str, Floor], dict[str, dict[str, float]], dict[str, dict[str, float]]]:
    """Return floors, errors and errors under one setting, `before` and `after`, of all recordings.

    The sealed recordings, which took no part in the search, are simulated here for the first time.
    """
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
