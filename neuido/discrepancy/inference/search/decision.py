"""The answer of a diagnosis from its judged rounds, without further simulation; the rounds may be live or stored in a journal."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from neuido.discrepancy.inference.floors import Floor, Part, Round, Stand, Trial, times_over, worst_over
from neuido.discrepancy.inference.journal import CaseRecord, FitRecord, RoundRecord, candidate_from_dict, place, problem_to_dicts
from neuido.discrepancy.inference.laboratory import Laboratory
from neuido.discrepancy.inference.least_squares import Fit
from neuido.discrepancy.inference.search import judging, next_effect
from neuido.discrepancy.inference.search.judging import STANDS_OUT
from neuido.discrepancy.inference.search.search_state import Search
from neuido.discrepancy.problems.problem import Candidate, Parameter, Problem, Recording

ENOUGH = 3, 10
"""Data that each part needs to answer `none`: this many for each parameter of the declared model, and this many more."""


def decided(
    lab: Laboratory,
    before: np.ndarray,
    found: Sequence[Trial],
    steps: Sequence[Round],
    *,
    cut: bool,
    wrong: Sequence[str],
    blind: bool,
) -> tuple[str, list[str]]:
    """Return the answer, and why the recordings say too little or what is wrong with them.

    Args:
        lab: The method on which the answer rests.
        before: Mean squares of the residual of the declared model, of each part.
        found: The effects that were named.
        steps: The rounds of the answer.
        cut: Whether the search ended early.
        wrong: What is wrong with fitted figures of the declared model.
        blind: Whether no other setting of the simulation runs.
    """
    first = steps[0]
    if cut:
        return "unfinished", []
    if wrong:
        return "insufficient", list(wrong)
    missing = bool(found) or first.unsure or next_effect.is_unexplained(lab, first)
    if missing and blind:
        return "insufficient", ["no other setting of the simulation runs there, so that its own error is not known"]
    if found:
        several = any(len({t.candidate.name for t in r.members}) > 1 for r in steps if r.chosen is not None)
        return "class" if several else "effect", []
    if missing:
        return "unknown", []
    if not enough(lab):
        return "insufficient", ["there are few data for the figures that are free"]
    noisy = times_over(before, lab.noise_squares)
    worst = worst_over(before, lab.noise_squares)
    if lab.problem.settings == 1 and worst > next_effect.UNEXPLAINED_EXACT:
        return "insufficient", [f"what is left is up to {worst:.1f} times the noise, which is an estimate that may be as far off"]
    if noisy > STANDS_OUT:
        return "insufficient", [f"what is left is {noisy:.0f} times the noise, and the discretisation alone may make as much"]
    return "none", []


def enough(lab: Laboratory) -> bool:
    """Return whether every part has many more data than the declared model has parameters; see `ENOUGH`."""
    each, beside = ENOUGH
    return all(int(p.rows.sum()) > each * len(lab.problem.declared) + beside for p in lab.parts)


def case_of(
    lab: Laboratory, before: Stand, after: Stand, rounds: Sequence[Round], answer: str, why: Sequence[str], facts: Mapping[str, Any]
) -> CaseRecord:
    """Return all that the decision of a diagnosis rests on."""
    problem, journal, parts = lab.problem, lab.journal, lab.parts
    declared, candidates = problem_to_dicts(problem)
    stands = [journal.fit(lab.own, s.fit.point, None, s, parts) for s in (before, after)]
    return CaseRecord(
        problem.name,
        lab.own,
        problem.settings > 1,
        tuple((p.recording, bool(p.fitted), int(p.rows.sum()), p.name) for p in parts),
        tuple((r.name, r.role, len(r.y), lab.noise_of(n), lab.noise_from(n)) for n, r in enumerate(problem.recordings)),
        declared,
        candidates,
        tuple(journal.bases),
        tuple(journal.rounds),
        journal.steps(rounds),
        *stands,
        answer,
        tuple(facts["found"]),
        tuple(why),
        dict(facts),
        {step: asdict(w) for step, w in lab.memo.work.items()},
    )


@dataclass(frozen=True)
class Decision:
    """The answer that follows from stored fits."""

    answer: str
    why: tuple[str, ...]
    effects: tuple[str, ...]
    """Keys of the named effects."""
    classes: tuple[tuple[str, ...], ...]
    """Names of the effects in the class of each named effect, itself among them."""
    differs: tuple[int, ...]
    """Numbers of the judged rounds that now name another effect, or another class, than when they were made."""


class StoredEnds:
    """Fit results (`search_state.Ends`) of one judged round, read from a journal.

    Args:
        lab: The method of the round.
        candidates: All candidates of the case, by key.
        record: The stored round.
    """

    def __init__(self, lab: Laboratory, candidates: Mapping[str, Candidate], record: RoundRecord) -> None:
        self.best: dict[str, tuple[Candidate, Fit]] = {}
        self.stands: list[Stand] = []
        self.ends: list[tuple[Stand, Stand]] = []
        """Pairs of a fitted model and its continuation to the end of the fit."""
        self.left: dict[tuple, np.ndarray] = {}
        """Errors of one simulation alone, mean squares of the parts, by `journal.place`."""
        self.lab = lab
        for fit in record.fits:
            c, stand = candidates[fit.effects[-1]], self._stand(fit)
            self.best[c.key] = (c, stand.fit)
            self.stands.append(stand)
            if fit.finished is not None:
                self.ends.append((stand, self._stand(fit.finished)))

    def _stand(self, record: FitRecord) -> Stand:
        """Return the fitted model of a record, and keep the errors of one simulation alone if they are stored."""
        stand = stand_of(self.lab, record)
        if record.alone is not None:
            self.left[place(self.lab.own, stand)] = np.array(record.alone)
        return stand

    def measured(self, best: Mapping[str, tuple[Candidate, Fit]], floor: Floor, *, every: bool = False) -> list[Stand]:
        return self.stands

    def finished(self, named: Stand) -> Stand:
        return next((end for begun, end in self.ends if begun is named), named)

    def alone(self, stand: Stand) -> np.ndarray:
        return self.left.get(place(self.lab.own, stand), np.full(len(self.lab.parts), np.inf))


def stored_problem(case: CaseRecord) -> Problem:
    """Return a problem with the stored facts only; it cannot predict."""
    declared = tuple(Parameter(**p) for p in case.declared)
    recordings = tuple(
        Recording(name, role, np.zeros(count), noise, np.zeros(count, int), np.linspace(0.0, 1.0, count), origin)
        for name, role, count, noise, origin in case.recordings
    )
    settings = 2 if case.discretised else 1
    candidates, labels = tuple(map(candidate_from_dict, case.candidates)), {"scatter": case.facts.get("scatter", False)}
    return Problem(case.name, "", "", declared, (), candidates, recordings, settings, labels=labels)


def stand_of(lab: Laboratory, record: FitRecord) -> Stand:
    """Return the fitted model of a record, without its arrays."""
    fit = Fit(record.point, record.names, record.cost, np.empty(0), record.evaluations, record.converged, setting=record.setting)
    return Stand(fit, floor_of(lab, np.array(record.spread)), np.array(record.errors))


def floor_of(lab: Laboratory, spread: np.ndarray) -> Floor:
    """Return a floor of which only the mean squares of the differences between settings are known."""
    by_row = {n: np.zeros(len(lab.problem.recordings[n].y)) for n in lab.scored_recordings}
    for part, square in zip(lab.parts, spread, strict=True):
        by_row[part.recording][part.rows] = np.sqrt(square)
    return Floor({n: lab.noise_of(n) for n in by_row}, {}, {}, by_row)


class _Drawn:
    """The stored draws of the null hypothesis, in the place of a `bootstrap.LinearModel`."""

    keys: tuple[str, ...] = ()

    def __init__(self, exact: np.ndarray) -> None:
        self.exact = exact

    def null(self, errors: np.ndarray, draws: int, *, exact: bool = False) -> np.ndarray:
        return self.exact


def stored_parts(case: CaseRecord) -> list[Part]:
    """Return the parts of a case; parts of the same recording get disjoint rows."""
    parts, begun = [], dict.fromkeys((n for n, *_ in case.parts), 0)
    for n, fitted, count, name in case.parts:
        rows = np.zeros(case.recordings[n][2], bool)
        rows[begun[n] : begun[n] + count] = True
        begun[n] += count
        parts.append(Part(n, rows, fitted, name))
    return parts


def judged_again(lab: Laboratory, candidates: Mapping[str, Candidate], r: RoundRecord) -> Round:
    """Return a stored round as the present rules judge it."""
    ends = StoredEnds(lab, candidates, r)
    floor = floor_of(lab, np.zeros(len(lab.parts)))
    empty = Round(
        r.base, np.array(r.errors), [], None, [], 1.0, floor, np.array(r.floors), null=np.array(r.null), unfitted=dict(r.unfitted)
    )
    return judging.judge(Search(lab, ends), empty, ends.best, _Drawn(np.array(r.exact_null)))


def decide(case: CaseRecord) -> Decision:
    """Return the answer that the present rules give to stored fits, without a simulation.

    Every stored round is judged again. A round with the same outcome keeps its step of the answer. A round with another outcome becomes a
    step as it is judged now, and no step follows it.
    """
    problem, parts = stored_problem(case), stored_parts(case)
    candidates = {c.key: c for c in problem.candidates}
    methods = {m: Laboratory(problem, setting=m, parts=parts) for m in {case.method, *(r.method for r in case.judged)}}
    again = [judged_again(methods[r.method], candidates, r) for r in case.judged]
    differs = [
        i
        for i, (r, now) in enumerate(zip(case.judged, again, strict=True))
        if (now.chosen.candidate.key if now.chosen else None) != r.chosen or tuple(t.candidate.key for t in now.members) != r.members
    ]
    lab = methods[case.method]
    steps: list[Round] = []
    for step in case.steps:
        floor = floor_of(lab, np.zeros(len(lab.parts)))
        if step.judged in differs:
            steps.append(again[step.judged])
            break
        named = {key: Trial(candidates[key], stand_of(lab, case.after), 0.0) for key in (*step.members, step.chosen) if key}
        made = Round(step.base, np.array(step.errors), list(named.values()), None, [], 1.0, floor, np.array(step.floors))
        chosen = named[step.chosen] if step.chosen else None
        steps.append(replace(made, chosen=chosen, members=[named[key] for key in step.members], unsure=step.unsure))
    changed = bool(steps) and any(s.judged in differs for s in case.steps[: len(steps)])
    kept = {s.chosen.candidate.key for s in steps if s.chosen} if changed else set(case.facts["found"])
    found = [r.chosen for r in steps if r.chosen is not None and r.chosen.candidate.key in kept]
    steps = [r for r in steps if r.chosen is None or r.chosen.candidate.key in kept]
    cut, wrong, blind = (case.facts[key] for key in ("cut", "wrong", "blind"))
    answer, why = decided(lab, np.array(case.before.errors), found, steps, cut=cut, wrong=wrong, blind=blind)
    if answer not in ("effect", "class"):
        return Decision(answer, tuple(why), (), (), tuple(differs))
    own = [r for r in steps if r.chosen is not None]
    classes = tuple(tuple(dict.fromkeys(t.candidate.name for t in r.members)) for r in own)
    return Decision(answer, tuple(why), tuple(t.candidate.key for t in found), classes, tuple(differs))
