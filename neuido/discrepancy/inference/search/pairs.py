"""Two effects at once: the search where no single effect is enough, or where one effect leaves more than noise."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from neuido.discrepancy.inference import comparing, discretisation
from neuido.discrepancy.inference.comparing import LEAST_GAIN
from neuido.discrepancy.inference.floors import Round, Stand, Trial, score, times_over, unphysical
from neuido.discrepancy.inference.laboratory import Laboratory
from neuido.discrepancy.inference.search import base_fits, judging, next_effect, refining
from neuido.discrepancy.inference.search.contests import MANY
from neuido.discrepancy.inference.search.search_state import Search
from neuido.discrepancy.problems.problem import Candidate, Point
from neuido.physics.effects.library import LIMITS

WORSE = 3.0
"""Ratio of the errors of two methods above which the worse one is not asked any more, for a first effect or for two."""
LOOKED_AHEAD = 2
"""Number of effects that are tried with a second one where none gains enough alone, or in the place of one with more parameters."""
FAR_ABOVE = 4.0
"""Ratio of the residual to its floor from which the best few effects are tried with a second one, however small their gains."""
BLIND_GAIN = 2.0 * LEAST_GAIN
"""Least gain in the fitted recordings of an effect that is tried with a second one although it does not improve the held-out data."""
PROMISED = 0.9
"""Largest share of the misfit that a second effect may leave beside a first one, predicted or by one simulation, to be fitted there."""
BESIDE = 3
"""Number of members of a class beside which a second effect is searched for."""
GROWN = 3
"""Number of pairs from growing fits that are fitted further."""
IN_TIME = 0.6
"""Share of the search's work after which no pairs grow where simulations run one by one; the rest is for cheaper steps."""
IN_PLACE = 5
"""Number of other first effects that are fitted beside the best second one."""
CLOSE = 2.5
"""Ratio to the error of a chosen effect up to which one with fewer parameters is compared again once others were found."""


def look_ahead(search: Search, first: Round) -> list[Round]:
    """Try the best few effects with a second one where no single effect gains enough.

    Two effects may each be worth little alone: friction alone hardly improves the fit of a body that slides and also dissipates.

    Returns:
        The round of the first effect and that of the second, or `first` alone where no two effects gain enough.
    """
    lab = search.lab
    if first.chosen is not None or not first.trials:
        return [first]
    by_chance = judging.by_chance(lab, first)
    at_least = by_chance if first.over < FAR_ABOVE else 0.0
    good = [t for t in first.trials if t.gain > at_least and not unphysical(t.candidate, t.fit.point)]
    if first.over < next_effect.unexplained(lab):  # all of the residual may be discretisation
        good = [t for t in good if t.gain > LEAST_GAIN]
    bases = sorted(good, key=lambda t: t.penalised)[:LOOKED_AHEAD]
    blind = best_on_fitted(lab, first, bases)
    for t in (*bases, *blind):
        if lab.budget.skips(f"a second effect beside {t.candidate.key}"):
            break
        here = continued_to_end(lab, t)
        second = next_effect.find(search, here.fit, here.floor, [t], most=MANY)
        if second.chosen is None or comparing.gain(lab, first.errors, second.chosen.errors) < 2.0 * LEAST_GAIN:
            continue
        little = t in blind or t.gain <= by_chance  # then the two effects must leave little more than the floor
        if little and times_over(second.chosen.errors, first.floors) > next_effect.unexplained(lab):
            continue
        t.reason = ""
        members = [t, *(other for other in good if other is not t and judging.is_rival(search, other, t))]
        for other in members:
            other.reason = ""
        return [replace(first, chosen=t, members=members), second]
    return [first]


def best_on_fitted(lab: Laboratory, first: Round, others: Sequence[Trial]) -> list[Trial]:
    """Return the effect that fits the fitted recordings best, as a list of one, to be tried with a second effect.

    The list is empty where its gain there is at most `BLIND_GAIN`, or it is among `others`. An effect that stands for two may fit well and
    still fail on held-out recordings, where the two occur in another proportion.
    """
    if first.over < next_effect.unexplained(lab) or all(lab.fitted):
        return []
    trials = [t for t in first.trials if np.isfinite(t.errors).all() and not unphysical(t.candidate, t.fit.point)]
    if not trials:
        return []
    fitted = lab.fitted
    best = min(trials, key=lambda t: comparing.fitted_score(lab, t.errors))
    far = math.log(times_over(first.errors[fitted], best.errors[fitted])) > BLIND_GAIN
    return [best] if far and best not in others else []


def two_effects(
    search: Search, rounds: Sequence[Round], found: Sequence[Trial], at: Stand, others: Mapping[Search, Round]
) -> tuple[Search, list[Round]]:
    """Search for two effects where the named one leaves more than noise.

    The other methods are asked before the chosen one tries again, because the choice may be wrong: of nine pairs that five blind seeds
    missed, seven were searched for by the wrong method. The result of another method is taken where it leaves only noise, or clearly less
    than that of the chosen one. Where two effects were found already, only the other methods are asked.

    Args:
        search: The search that named an effect.
        rounds: Its rounds: the first, and one beside that effect if it was made.
        found: The effects that they named.
        at: The model fitted with these effects.
        others: The searches by other methods, with their first rounds.

    Returns:
        The search of the method that found two effects, and their rounds; no rounds where there are none.
    """
    elsewhere = by_another_method(others, search, at, found, within=len(rounds) == 1)
    if elsewhere is not None and comparing.is_noise(elsewhere[0].lab, elsewhere[1][-1].chosen.errors):
        return elsewhere
    own = beside_members(search, rounds, at) if len(found) == 1 else []
    if not own and len(found) == 1 and len(rounds) > 1:
        own = replace_first_effect(search, rounds[0], rounds[1], at.errors)
    if elsewhere is not None and (
        not own or comparing.gain(search.lab, own[-1].chosen.errors, elsewhere[1][-1].chosen.errors) > LEAST_GAIN
    ):
        return elsewhere
    return search, own


def by_growing(search: Search, first: Round, at: Stand, others: Mapping[Search, Round]) -> tuple[Search, list[Round]] | None:
    """Search for two effects with growing fits where much is left.

    All methods are asked, the suggested one first, until two effects leave only noise. The choice of a method rests on one effect and may
    be wrong: for three pairs of a blind seed finite elements were chosen, and the suggested method was right each time. The round of the
    second effect begins at the end of the joint fit and decides whether it is one. Where nothing was named, pairs are searched for only if
    the residual is more than discretisation, and they must bring it down to that.

    Returns:
        The search of the method that found the pair and its rounds, or None.
    """
    lab = search.lab
    named = first.chosen is not None
    if not refining.leaves_much(lab, [at.errors]) or not (named or (first.trials and next_effect.is_unexplained(lab, first))):
        return None
    least, until = LEAST_GAIN if named else 2.0 * LEAST_GAIN, 1.0 if lab.problem.together else IN_TIME
    made: list[tuple[Search, list[Round]]] = []
    for method, own in sorted({search: first, **others}.items(), key=lambda entry: entry[0].lab.own):
        if method.lab.budget.skips("two effects that grow together", until):
            break
        with discretisation.quickly(method.lab, own.base, own.floor):
            pairs = refining.growing_pairs(method, own.base, own.floor)[:GROWN]
        free = method.lab.problem.declared
        starts = [method.lab.request((*free, *a.parameters, *b.parameters), fit.point) for (a, b), fit in pairs]
        fits = method.lab.fits(starts, own.floor)
        able = method.lab.which_run([fit.point for fit in fits])
        ends = [(pair.candidates, fit) for pair, fit, runs in zip(pairs, fits, able, strict=True) if runs]
        stands = [(both, Stand(fit, *discretisation.stand(method.lab, fit.point, like=own.floor))) for both, fit in ends]
        for both, there in sorted(stands, key=lambda entry: score(entry[1].errors)):
            pair = as_rounds(method, own, both, there, at.errors, least)
            if pair and (named or times_over(pair[-1].chosen.errors, own.floors) < next_effect.unexplained(method.lab)):
                made.append((method, pair))
                break
        if made and comparing.is_noise(made[-1][0].lab, made[-1][1][-1].chosen.errors):
            return made[-1]
    return min(made, key=lambda entry: entry[1][-1].chosen.score, default=None)


def as_rounds(
    search: Search, first: Round, both: tuple[Candidate, Candidate], there: Stand, errors: np.ndarray, least: float
) -> list[Round]:
    """Return the rounds of two effects that were fitted together, or an empty list where they gain less than `least`.

    The effect that does better alone is the first.
    """
    lab = search.lab
    alone = {c.key: next((t for t in few(first.trials) if t.candidate.key == c.key and np.isfinite(t.score)), None) for c in both}
    able = sorted((t for t in alone.values() if t is not None), key=lambda t: t.score)
    if not able or comparing.gain(lab, errors, there.errors) < least:
        return []
    t = able[0]
    (second,) = (c for c in both if c.key != t.candidate.key)
    here = refit_from(lab, t, there.fit.point)
    pair = fitted_with(search, first, t, here, Trial(second, there, comparing.gain(lab, here.errors, there.errors)), errors, least)
    if pair:
        t.stand, t.gain = here, comparing.gain(lab, first.errors, here.errors)
    return pair


def fitted_with(
    search: Search, first: Round, t: Trial, alone: Stand, second: Trial, errors: np.ndarray, least: float = LEAST_GAIN
) -> list[Round]:
    """Return the rounds of a first effect and of a second one that was fitted together with it.

    The list is empty where the second round names no effect, or the two gain less than `least` compared with `errors`.
    """
    led = replace(first, chosen=None, members=[], trials=[second])
    again = next_effect.find(search, alone.fit, alone.floor, [t], led, most=MANY)
    if again.chosen is None or comparing.gain(search.lab, errors, again.chosen.errors) < least:
        return []
    t.reason = ""
    return [replace(first, chosen=t, members=[t]), again]


def beside_members(search: Search, rounds: Sequence[Round], at: Stand) -> list[Round]:
    """Search for a second effect beside the members of a class, where one effect was found and leaves more than noise.

    Two effects together give a class of effects that are each partly right, and its best member need be neither of the two. No second
    effect was searched for where the residual lay within its floor. An effect of many parameters may stand for both: simpler effects are
    tried in its place. It is tried itself last, because a simpler one may leave too much to show the other effect; `narrow` then replaces
    it.

    Returns:
        The round of the member and that of the second effect, or an empty list.
    """
    if comparing.is_settled(search.lab, at.errors):
        return []
    first = rounds[0]
    grown = first.chosen if len(rounds) > 1 else None
    instead = simpler(first, first.chosen) if len(first.chosen.candidate.parameters) > MANY else []
    members = few(t for t in (*first.members, *instead) if t is not grown)
    pair = second_beside(search, first, members, at.errors, at=at)
    if pair and pair[0].chosen in instead:
        for t in first.members:
            t.reason = f"leaves {math.exp(0.5 * (score(at.errors) - pair[1].chosen.score)):.1f} times the error of two effects"
        pair[0].chosen.reason = ""
        pair[0] = replace(pair[0], members=[pair[0].chosen])
    if not pair and grown is None and len(first.chosen.candidate.parameters) > MANY:
        pair = second_beside(search, first, [first.chosen], at.errors, at=at)
    return pair


def by_another_method(
    others: Mapping[Search, Round], search: Search, at: Stand, found: Sequence[Trial], *, within: bool = False
) -> tuple[Search, list[Round]] | None:
    """Search for two effects by the other methods, where more than noise is left.

    The method is chosen by what one effect leaves. With two effects that is misleading: by the wrong method one effect may compensate both
    for the other and for errors of the method. So the first effect of each other method gets a search beside it, whatever the screening
    promises. Where a method named none, and the residual is above its floor, the first effect of the chosen method is used.

    Args:
        others: The searches by other methods, with their first rounds.
        search: The search that named an effect.
        at: The model fitted with what it named.
        found: The effects that it named.
        within: Whether the residual lies within its floor, where no second effect was searched for. Two effects must then be promised by
            the screening, and leave what may be noise once it is refined.

    Returns:
        The search that found the two effects with the least error and their rounds, or None.
    """
    if comparing.is_settled(search.lab, at.errors):
        return None
    made = []
    alone = score(at.errors) if len(found) == 1 else found[0].score
    for other, first in others.items():
        lead = first.chosen
        if lead is None and not within and next_effect.over_floor(search.lab, at) > 1.0:
            lead = next((t for t in first.trials if t.candidate.key == found[0].candidate.key and np.isfinite(t.score)), None)
        if lead is None or lead.score > alone + 2.0 * math.log(WORSE):
            continue
        if search.lab.budget.skips("two effects by the other method"):
            break
        here = refit_from(other.lab, lead, at.fit.point)
        own = first if lead is first.chosen else replace(first, chosen=lead, members=[lead])
        pair = second_beside(other, own, few(own.members), at.errors, at=here, sure=None if within else lead)
        if pair and (not within or comparing.may_be_noise(other.lab, pair[-1].chosen.errors)):
            lead.stand, lead.gain, lead.reason = here, comparing.gain(other.lab, first.errors, here.errors), ""
            made.append((other, pair))
    return min(made, key=lambda entry: entry[1][-1].chosen.score, default=None)


def refit_from(lab: Laboratory, t: Trial, point: Point) -> Stand:
    """Return the fit of an effect, or a new one from the values of `point` (declared ones and the effect's) if that leaves less."""
    free = (*lab.problem.declared, *t.candidate.parameters)
    here, begin = (
        Stand(t.fit, *discretisation.stand(lab, t.fit.point)),
        dict(t.fit.point) | {p.name: point[p.name] for p in free if p.name in point},
    )
    if not lab.runs(begin):
        return here
    (fit,) = lab.fits([lab.request(free, begin)], discretisation.stand(lab, begin)[0])
    return (
        min(here, Stand(fit, *discretisation.stand(lab, fit.point)), key=lambda stand: score(stand.errors)) if lab.runs(fit.point) else here
    )


def continued_to_end(lab: Laboratory, t: Trial) -> Stand:
    """Return the fitted model of a trial, continued to the end of its fit.

    A fit that was given up early stands at a point beside which no second effect looks right.
    """
    here = Stand(t.fit, *discretisation.stand(lab, t.fit.point))
    return here if t.fit.converged else base_fits.finished(lab, here)


def second_beside(
    search: Search, first: Round, members: Sequence[Trial], errors: np.ndarray, *, at: Stand | None = None, sure: Trial | None = None
) -> list[Round]:
    """Return the round of the member beside which a second effect leaves least, and the round of that effect.

    The list is empty where none leaves clearly less than `errors`, or only noise in one simulation.

    Args:
        search: The search by one method.
        first: The first round.
        members: Effects beside which a second one is searched for, if the screening there promises much.
        errors: Errors to improve on, mean squares of the parts.
        at: The model with the chosen effect, if its fit was continued to the end.
        sure: A member that is tried whatever the screening promises.
    """
    lab = search.lab
    pairs: list[list[Round]] = []
    for t in sorted(members, key=lambda t: t.penalised)[:BESIDE]:
        if lab.budget.skips(f"a second effect beside {t.candidate.key}"):
            break
        here = at if at is not None and t is first.chosen else continued_to_end(lab, t)
        if t is not sure and next_effect.promised(search, here, t) > PROMISED:
            continue
        second = next_effect.find(search, here.fit, here.floor, [t], most=MANY)
        told = second.chosen is not None and (
            comparing.gain(lab, errors, second.chosen.errors) > LEAST_GAIN or judging.is_exact(search, second.chosen)
        )
        if told:
            pairs.append([replace(first, chosen=t), second])
            if comparing.is_noise(lab, second.chosen.errors):
                break
    return min(pairs, key=lambda pair: pair[1].chosen.score, default=[])


def replace_first_effect(search: Search, first: Round, second: Round, errors: np.ndarray) -> list[Round]:
    """Try other first effects beside a second one that improves the fitted recordings most, where no second one was named.

    Where there are two effects, the leading single one need be neither of them, nor share a class with one: a quadratic drag of a body that
    yields may appear as a linear one. The best other effects are fitted together with the second one. Beside the one that leaves least, a
    second effect is then searched for as usual.

    Returns:
        The two rounds, or an empty list where no second effect is named or the two leave no less than `errors`.
    """
    lab = search.lab
    here = comparing.fitted_score(lab, second.errors)
    tried = [t for t in few(second.trials) if not unphysical(t.candidate, t.fit.point)]
    lead = min(tried, key=lambda t: comparing.fitted_score(lab, t.errors), default=None)
    if lead is None or here - comparing.fitted_score(lab, lead.errors) < 2.0 * LEAST_GAIN:
        return []
    instead = [t for t in few(outside_class(first)) if t.candidate.name != lead.candidate.name]
    instead = sorted((t for t in instead if np.isfinite(t.score)), key=lambda t: t.penalised)[:IN_PLACE]
    if not instead or lab.budget.skips(f"effects in the place of {first.chosen.candidate.key}"):
        return []
    lab.tell(f"beside {lead.candidate.key}, in the place of {first.chosen.candidate.key}: {', '.join(t.candidate.key for t in instead)}")
    floor, free = discretisation.stand(lab, lead.fit.point)[0], lab.problem.declared
    without = first.chosen.candidate.without(lead.fit.point)
    requests = [
        lab.request((*free, *t.candidate.parameters, *lead.candidate.parameters), {**without, **t.candidate.own(t.fit.point)})
        for t in instead
    ]
    made = [(t, fit) for t, fit in zip(instead, lab.fits(requests, floor), strict=True) if lab.runs(fit.point)]
    stands = [(t, Stand(fit, *discretisation.stand(lab, fit.point))) for t, fit in made]
    if not stands:
        return []
    best, there = min(stands, key=lambda entry: score(entry[1].errors))
    if comparing.gain(lab, errors, there.errors) < LEAST_GAIN:
        return []
    return fitted_with(search, first, best, continued_to_end(lab, best), replace(lead, stand=there), errors)


def simpler(r: Round, chosen: Trial) -> list[Trial]:
    """Return trials that may replace the chosen one: its limiting cases, and the best close ones with fewer parameters.

    A limiting case need not come close: what a force of many parameters gains beyond it may be due to the other effect.
    """
    sizes = len(chosen.candidate.size_parameters)
    narrower = [t for t in outside_class(r) if t.candidate.name in LIMITS.get(chosen.candidate.name, ())]
    fewer = [t for t in close_to(r, chosen) if t not in narrower and len(t.candidate.size_parameters) < sizes]
    return narrower + fewer[:LOOKED_AHEAD]


def neighbours(r: Round, chosen: Trial) -> list[Trial]:
    """Return the best trials that came close to the chosen one with no more parameters."""
    most = len(chosen.candidate.parameters)
    return [t for t in close_to(r, chosen) if len(t.candidate.parameters) <= most][:LOOKED_AHEAD]


def few(trials: Iterable[Trial]) -> list[Trial]:
    """Return the trials whose candidates have few parameters."""
    return [t for t in trials if len(t.candidate.parameters) <= MANY]


def outside_class(r: Round) -> list[Trial]:
    """Return the physically possible trials of a round outside the named class."""
    return [t for t in r.trials if t not in r.members and not unphysical(t.candidate, t.fit.point)]


def close_to(r: Round, chosen: Trial) -> list[Trial]:
    """Return those of `outside_class` that came close to the chosen one, the best first."""
    limit = chosen.score + 2.0 * math.log(CLOSE)
    return sorted((t for t in outside_class(r) if t.score < limit), key=lambda t: t.penalised)
