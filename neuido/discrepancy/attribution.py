"""From a residual to a name: grow the model by one effect at a time, drop what became needless, and say how sure the answer is."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from neuido.discrepancy.choosing import first_rounds, told_exactly
from neuido.discrepancy.classes import drop, narrow, widen
from neuido.discrepancy.deadline import Deadline
from neuido.discrepancy.fit import Fit, NotFinite
from neuido.discrepancy.floors import Floor, Part, split
from neuido.discrepancy.intervals import intervals
from neuido.discrepancy.judging import ALPHA, WITHIN
from neuido.discrepancy.laboratory import Tell
from neuido.discrepancy.memo import Memo, Work
from neuido.discrepancy.pairs import by_growing, two_effects
from neuido.discrepancy.problem import Point, Problem
from neuido.discrepancy.rounds import UNEXPLAINED, Inference
from neuido.discrepancy.trials import Round, Stand, Trial
from neuido.errors import UserError

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

    Raises:
        UserError: No method can predict the declared model; the line of its simulator.
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
        try:
            start = inference.start(near)
        except NotFinite as error:
            raise UserError(problem.refusal(n)) from error
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
    others = {tried[i]: own[0] for i, own in firsts.items() if i != chosen and len(own) == 1}
    hurried, grown = False, None
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
        if problem.together and len(found) == 1 and (grown := by_growing(inference, rounds[0], at, others)):
            break
        if problem.settings > 1 and not inference.is_settled(at.errors) and inference.over(at) < FURTHER:
            break
        rounds.append(inference.round(at.fit, at.floor, found))
    # where every point costs pairs grow after what takes less, and where nothing was named last of all
    if not hurried and (not found or (len(found) == 1 and not problem.together)):
        grown = by_growing(inference, rounds[0], at, others)
    if grown or (0 < len(found) < 3 and not hurried):
        by, pair = grown or two_effects(inference, rounds, found, at, others)
        if by is not inference:
            inference, start = by, pair[0].plain or starts[tried.index(by)]
        if pair:
            rounds = pair
            found = [r.chosen for r in pair if r.chosen is not None]
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
