"""One round of a diagnosis: screen every candidate, fit the best, and test the best one's gain against chance and floors.

The order is that of protocols for model discrepancy: the base fit with its nuisances; the discretisation error from several settings; the
direction of every candidate in the data, and its gain after a refit of the declared parameters; full fits of the best candidates; the gain
on held-out recordings against a parametric bootstrap of the largest gain.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from scipy.stats import norm

from neuido.discrepancy.inference import bootstrap, comparing, directions, discretisation
from neuido.discrepancy.inference.floors import Floor, Led, Round, Stand, Trial, patterns, score, times_over, worst_over
from neuido.discrepancy.inference.laboratory import Laboratory
from neuido.discrepancy.inference.least_squares import Fit
from neuido.discrepancy.inference.search import contests, judging, prospects, refining, stand_ins
from neuido.discrepancy.inference.search.contests import MANY, better
from neuido.discrepancy.inference.search.judging import ABOVE, ALPHA, LED_AWAY, WITHIN
from neuido.discrepancy.inference.search.refining import MEASURED, NEAR
from neuido.discrepancy.inference.search.search_state import Look, Search, Start
from neuido.discrepancy.problems.problem import Candidate, Parameter, Problem

CONFIRMED = 0.8
"""Share of the search's work at which first fits end, for a method that is asked after another one named an effect. The rest is for a
second effect."""
PLAIN, AS_WELL = 2, 1.2
"""Number of fitted effects from whose ends the model without them is evaluated, and the ratio to the base fit's error in the fitted
recordings up to which such a point replaces the base."""
MEMBERS = 3
"""Number of members of a class from whose ends the model without them is evaluated."""
UNEXPLAINED_EXACT = 3.0
"""`ABOVE` where nothing is discretised: larger, because the noise that a folder states is an estimate."""
UNSURE = float(norm.ppf(1.0 - 0.5 * ALPHA))
"""Standard deviations of an estimated noise that widen the limit of the answer `unknown`."""


def new_search(problem: Problem, *, keep: int = 7, draws: int = 199, seed: int = 0, **options: Any) -> Search:
    """Return a search that has not begun; `options` are those of `Laboratory`."""
    lab = Laboratory(problem, **options)
    return Search(lab, judging.SimulatedEnds(lab), keep, draws, seed)


def unexplained(lab: Laboratory) -> float:
    """Return the ratio to its floor above which a residual that no effect explains is called unknown."""
    unsure = max(lab.noise_uncertainty(n) for n in lab.scored_recordings)  # where the noise is uncertain, the residual may be noise
    return (ABOVE if lab.problem.settings > 1 else UNEXPLAINED_EXACT) * (1.0 + UNSURE * unsure)


def find(search: Search, base: Fit, floor: Floor, found: Sequence[Trial], rival: Round | None = None, *, most: float = math.inf) -> Round:
    """Search for one more effect beside those that were found.

    Args:
        search: The search by one method.
        base: The fit to which an effect is to be added.
        floor: Noise and discretisation there, as `discretisation.stand` gives them.
        found: The effects so far.
        rival: Round of another method that named an effect. Its leading candidates and the first of the screening get a fit.
        most: Largest number of parameters of a candidate.
    """
    lab = search.lab
    first = rival is None and not found
    led, until = (None, 1.0) if rival is None else (rival.led, CONFIRMED)
    look = first_look(search, base, floor, found, led, most=most, until=until)
    candidates, free, slopes, columns, chosen, *_ = look.asked
    best, other, errors = dict(look.contest.best), look.contest.other, lab.mean_squares([base.point], floor)[0]
    if not lab.budget.skips("refining the best fits"):
        best |= stand_ins.limiting_cases(lab, free, best, candidates, floor)
        best |= refining.refine(lab, free, best, base, floor, rival, other)
        best |= stand_ins.similar_candidates(lab, free, best, candidates, chosen, columns, slopes, floor)
        best |= refining.refine_large(lab, free, best, floor)
        if not found:
            best |= stand_ins.candidates_in_place(lab, free, best, candidates, base, floor)
    floors = discretisation.floors(lab, base.point, free, floor)
    model = linear_model(search, base.point, floor, floors - lab.noise_squares, slopes, columns, chosen, candidates)
    null, unfitted = model.null(errors, search.draws), look.contest.unfitted
    empty = Round(base.point, errors, [], None, [], 1.0, floor, floors, null=null, unfitted=unfitted)
    every = lab.problem.together

    def judged(step: Round) -> Round:
        result = judging.judge(search, step, best, model, every=every)
        lab.tell(judging.verdict(lab, result))
        if result.trials:
            lead = result.chosen or result.trials[0]
            comparing.report_lead(lab, lead.candidate.key, lead.errors, result.errors)
        return result

    result = judged(empty)
    promising = result.over > WITHIN and any(t.gain > judging.by_chance(lab, result) for t in result.trials)
    again = first and result.chosen is None and (promising or result.over > 1.0)
    if again and not lab.budget.skips("fits from elsewhere"):
        best |= refining.refit_from_larger_sizes(lab, base, best, {c.key: c.starts[chosen.get(c.key, 0)] for c in candidates}, floor)
        result = judged(empty)
    if again and result.chosen is None and not every and not lab.budget.skips("measuring every fit where it ends"):
        every = True
        result = judged(empty)
    missed = again and result.chosen is None and not look.grown and is_led_away(lab, base, result)
    if missed and not lab.budget.skips("growing fits"):
        with discretisation.quickly(lab, base.point, floor):
            grown = list(refining.growing(search, base, floor, candidates).values())
        best |= refining.refit_at_own_floors(lab, grown, best, floor)
        result = judged(empty)
    if leaves_more(lab, result) and not lab.budget.skips("fits of the effects that were left out or given up"):
        best |= fits_of_the_rest(lab, free, [c for c in candidates if c.key not in best], base, slopes, floor)
        best |= continued(lab, free, best, floor)
        result = judged(empty)
    plain = without_effect(lab, result, base, floor)
    if plain is not None:
        if not found:
            lab.journal.bases.append(lab.journal.fit(lab.own, {}, None, plain, lab.parts))
        result = judged(replace(empty, base=plain.fit.point, errors=plain.errors, plain=plain))
    if not found:
        search.asked = result
    return result


def leaves_more(lab: Laboratory, r: Round) -> bool:
    """Return whether the best effect of a round leaves so much where nothing is discretised that no effect may go without a fit.

    "Something more that no effect explains" is then about to be said, and the directions of a screening far from the truth are no proof.
    """
    left = min([times_over(t.errors, r.floors) for t in r.trials] or [r.over])
    return lab.problem.settings == 1 and left > unexplained(lab)


def fits_of_the_rest(
    lab: Laboratory, free: Sequence[Parameter], rest: Sequence[Candidate], base: Fit, slopes: Mapping[int, np.ndarray], floor: Floor
) -> dict[str, tuple[Candidate, Fit]]:
    """Fit candidates from their own starts and the best of larger sizes; return the best fit of each by key."""
    starts: list[Start] = [(c, {**base.point, **start}, None) for c in rest for start in c.starts]
    if not starts:
        return {}
    lab.tell(f"fitting {', '.join(c.key for c in rest)}")
    return contests.contest(lab, free, contests.sized(lab, starts, base, slopes, floor)[0], floor).best


def continued(
    lab: Laboratory, free: Sequence[Parameter], best: Mapping[str, tuple[Candidate, Fit]], floor: Floor
) -> dict[str, tuple[Candidate, Fit]]:
    """Continue the fits that were given up because others led, each alone; return those that end lower, by key."""
    given_up = [(c, fit) for c, fit in best.values() if not fit.converged and np.isfinite(fit.cost)]
    ends = lab.fits([lab.request((*free, *c.parameters), fit.point) for c, fit in given_up], floor)
    return better(((c, end) for (c, _), end in zip(given_up, ends, strict=True)), best)


def without_effect(lab: Laboratory, result: Round, base: Fit, floor: Floor) -> Stand | None:
    """Return the model without the round's effect at the point where a fit with an effect ended, if it is better there than the base.

    Where differences between settings are large, the fitted recordings hardly determine a modulus, and each fit with an effect ends at
    another one. What the modulus alone does to the held-out recordings must not count as an effect. The point must fit the fitted
    recordings about as well as the base.

    Where no effect explains the residual, the declared model is fitted again from these points, because the base may be a wrong local
    minimum. Where effects were named, the floor at their ends is used, because differences between settings at the base may have misled the
    base fit. Return None if no point is better.
    """
    if lab.problem.settings == 1 or not result.trials:
        return None
    lost = result.chosen is None
    if lost and not is_unexplained(lab, result):
        return None
    limit = (result.chosen or result.trials[0]).score + 2.0 * math.log(NEAR)
    places = [t.candidate.without(t.fit.point) for t in result.trials if t.score < limit][:MEASURED]
    left = [score(squares) for squares in lab.mean_squares(places, floor)]
    here, as_well = score(result.errors), comparing.fitted_score(lab, result.errors) + 2.0 * math.log(AS_WELL)
    wanted = [places[i] for i in sorted(range(len(places)), key=lambda i: left[i])[:PLAIN] if left[i] < (math.inf if lost else here)]
    if result.chosen is not None:  # measured with the floor of the base, the model may seem worse there than it is
        own = [t.candidate.without(t.fit.point) for t in result.members[:MEMBERS]]
        wanted = own + [place for place in wanted if place not in own][: max(PLAIN - len(own), 0)]
    if not wanted:
        return None
    discretisation.prefetch(lab, wanted)
    stands = [Stand(replace(base, point=place), *discretisation.stand(lab, place, like=floor)) for place in wanted]
    if lost and not lab.budget.skips("the declared model again from where effects were fitted"):
        free = [lab.problem.parameter(name) for name in base.names]
        able = [(s.fit.point, s.floor) for s, runs in zip(stands, lab.which_run(wanted), strict=True) if runs]
        fits = lab.fits([lab.request(free, point) for point, _ in able], [own for _, own in able])
        ends = [fit.point for fit in fits]
        stands += [Stand(f, *discretisation.stand(lab, f.point, like=floor)) for f, ok in zip(fits, lab.which_run(ends), strict=True) if ok]
    found = [s for s in stands if score(s.errors) < here and comparing.fitted_score(lab, s.errors) < as_well]
    return min(found, key=lambda s: score(s.errors), default=None)


def is_led_away(lab: Laboratory, base: Fit, r: Round) -> bool:
    """Return whether the base fit of a motion leaves more than noise in the fitted data, at values far from the declared ones."""
    far = lab.problem.settings > 1 and comparing.moved(lab, base.point) > LED_AWAY
    return far and not comparing.is_noise(lab, r.errors[lab.fitted], fitted=True)


def is_unexplained(lab: Laboratory, r: Round) -> bool:
    """Return whether the residual of a round's base is so far above its floor that the answer cannot be `none`.

    Where nothing is discretised, that of its worst part counts: what one recording shows is not less there because others do not show it.
    """
    if lab.problem.settings == 1:
        return max(r.over, worst_over(r.errors, r.floors)) > unexplained(lab)
    return r.over > unexplained(lab) or r.held_out_over(lab.fitted) > ABOVE


def first_look(
    search: Search,
    base: Fit,
    floor: Floor,
    found: Sequence[Trial] = (),
    led: Led | None = None,
    *,
    most: float = math.inf,
    beyond: float = math.inf,
    until: float = 1.0,
    grows: bool = True,
) -> Look:
    """Screen the candidates and fit the best ones, or return the last look if it had the same base.

    Args:
        search: The search by one method.
        base: The fit to which an effect is to be added.
        floor: Noise and discretisation there.
        found: The effects so far.
        led: Leading candidates of another method; only these, also from the ends of their fits there, and a few others get a fit.
        most: Largest number of parameters of a candidate.
        beyond: Score of the first fits above which no others are made.
        until: Share of the search's work after which no fit begins.
        grows: Whether growing fits are made where the first fits leave much, also for a look that was made without them.
    """
    lab = search.lab
    if not found and search.seen is not None and search.seen.base is base:
        if grows:
            search.seen = with_growing_fits(search, with_postponed_fits(search, search.seen, floor, until), floor, found, until)
        return search.seen
    with discretisation.quickly(lab, base.point, floor):
        asked = prospects.promising(search, base, floor, found, led, most=most, until=until)
        candidates, free, *_, starts, _ = asked
        lab.tell(f"fitting {', '.join(dict.fromkeys(c.key for c, *_ in starts))}")
        without = partial(prospects.without_own, search, base.point, starts, found)
        grown: list[tuple[Candidate, Fit]] = []

        def between(remains: np.ndarray) -> Sequence[tuple[Candidate, Fit]]:
            astray = grows and not found and refining.is_astray(search, base, floor) and refining.leaves_much(lab, [remains])
            if astray and not lab.budget.skips("growing fits", until):
                grown.extend(refining.growing(search, base, floor, candidates, until=until).values())
            return grown

        options = {"beyond": beyond, "until": until, "between": between, "puts_off": not grows}
        contest = contests.contest(lab, free, starts, floor, asked.hopeful, without, **options)
        left = left_by(lab, contest.best, floor)
    look = Look(base, asked, contest, left[:1], bool(grown))
    if grows and len(found) < 2:
        look = with_growing_fits(search, look, floor, found, until)
    if not found:
        search.seen = look
    return look


def with_postponed_fits(search: Search, look: Look, floor: Floor, until: float) -> Look:
    """Complete a look for a first effect with the fits that were put off."""
    lab = search.lab
    begun = look.contest.put_off
    if begun is None or lab.budget.skips(f"fits of {', '.join(begun.keys)}", until):
        return look
    asked, point = look.asked, look.base.point
    without = partial(prospects.without_own, search, point, asked.starts, ())
    with discretisation.quickly(lab, point, floor):
        contest = contests.contest(lab, asked.free, begun.starts, floor, asked.hopeful, without, until=until, before=begun.ended)
        left = left_by(lab, contest.best, floor)
    return look._replace(contest=contest, least=left[:1])


def with_growing_fits(search: Search, look: Look, floor: Floor, found: Sequence[Trial], until: float) -> Look:
    """Add growing fits, repeated under the method's own setting, to a look that has none and leaves much."""
    lab = search.lab
    if look.grown or not refining.leaves_much(lab, look.least) or lab.budget.skips("growing fits", until):
        return look
    with discretisation.quickly(lab, look.base.point, floor):
        further = list(refining.growing(search, look.base, floor, look.asked.candidates, found, until=until).values())
        refitted = contests.refit_under_own_setting(lab, look.asked.free, further, floor, until)
        best = {**look.contest.best, **better(refitted, look.contest.best)}
        left = left_by(lab, best, floor)
    return look._replace(contest=look.contest._replace(best=best), least=left[:1], grown=True)


def left_by(lab: Laboratory, best: Mapping[str, tuple[Candidate, Fit]], floor: Floor) -> list[np.ndarray]:
    """Return the errors that fits under the method's own setting leave, mean squares of the parts, the least first."""
    ends = [fit.point for _, fit in best.values() if fit.setting == lab.own]
    with lab.under(lab.own):
        return sorted(lab.mean_squares(ends, floor), key=score)


def over_floor(lab: Laboratory, at: Stand) -> float:
    """Return the ratio of the residual to what noise and discretisation would leave after a refit."""
    free = [lab.problem.parameter(name) for name in at.fit.names]
    return times_over(at.errors, discretisation.floors(lab, at.fit.point, free, at.floor))


def promised(search: Search, at: Stand, beside: Trial) -> float:
    """Return the least share of the misfit that a second effect of few parameters would leave, predicted or by one simulation."""
    with discretisation.quickly(search.lab, at.fit.point, at.floor):
        return min(prospects.promising(search, at.fit, at.floor, [beside], most=MANY).promise.values(), default=1.0)


def linear_model(search: Search, point, floor, left, slopes, columns, chosen, candidates) -> bootstrap.LinearModel:
    """Return the linear model of the fits, for the null hypothesis.

    It has all candidates, or those with a fit once the search is over. `left` is what discretisation leaves after a refit, mean squares of
    the parts.
    """
    lab = search.lab
    held = [p.recording for p in lab.parts if not p.fitted]
    by_key = {c.key: c for c in candidates}
    best = dict(chosen) if chosen and lab.budget.ends() else {c.key: 0 for c in candidates} | chosen
    one = [replace(by_key[key], starts=(by_key[key].starts[i],)) for key, i in best.items()]
    new = [n for n in held if n not in lab.fitted_recordings]
    with discretisation.quickly(lab, point, floor):
        there = directions.candidate_columns(lab, point, one, new) if new else {}
    nuisances = floor.nuisances or {n: np.empty((len(lab.problem.recordings[n].y), 0)) for n in lab.scored_recordings}
    made = []
    for part, square in zip(lab.parts, left, strict=True):
        n, rows = part.recording, part.rows
        own = {}
        for key, i in best.items():
            c = columns[key, i][n] if n in columns[key, i] else there[key, 0][n]
            if np.isfinite(c).all():
                own[key] = c[rows]
        smooth = patterns(lab.problem, floor, part, square)
        settings = floor.differences[n][rows]
        made.append(bootstrap.Columns(floor.weight[n][rows], floor.noise[n], slopes[n][rows], nuisances[n][rows], settings, smooth, own))
    common = set.intersection(*(set(c.candidates) for c in made))
    made = [replace(c, candidates={k: v for k, v in c.candidates.items() if k in common}) for c in made]
    return bootstrap.LinearModel(
        [c for c, p in zip(made, lab.parts, strict=True) if p.fitted],
        [c for c, p in zip(made, lab.parts, strict=True) if not p.fitted],
        seed=search.seed,
    )
