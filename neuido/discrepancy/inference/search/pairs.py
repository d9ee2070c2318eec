"""Two effects at once: what is tried with a second one where none is enough alone, and where one leaves more than noise."""

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
"""Times the error of the better method at which the other one is not asked any more: where that found nothing, and for two effects."""
LOOKED_AHEAD = 2
"""Effects that are tried with a second one, where none gains enough alone, or in the place of one with more parameters."""
FAR_ABOVE = 4.0
"""Times its floor above which the best few effects are tried with a second one, however little each gains alone."""
BLIND_GAIN = 2.0 * LEAST_GAIN
"""What an effect must gain in the fitted recordings to be tried with a second one although it foretells nothing of those held out."""
PROMISED = 0.9
"""Share of the misfit that a second effect may leave beside a first one, predicted or by one simulation, to be fitted there."""
BESIDE = 3
"""Members of a class beside which a second effect is looked for."""
GROWN = 3
"""Pairs that grew together whose ends are weighed."""
IN_TIME = 0.6
"""Share of the search's work past which no pairs grow where every point costs: what is left is for what takes less."""
IN_PLACE = 5
"""Effects that are fitted in the place of a first one beside the best that was tried beside it."""
CLOSE = 2.5
"""Times the error of a chosen effect up to which one with fewer parameters is weighed again once others were found."""


def look_ahead(search: Search, first: Round) -> list[Round]:
    """Where no single effect gains enough: the one of the best few beside which another does, and the round that found that one.

    Two effects may each be worth little without the other: a body that slides and dissipates is as badly fitted by friction alone.
    """
    lab = search.lab
    if first.chosen is not None or not first.trials:
        return [first]
    by_chance = judging.by_chance(lab, first)
    at_least = by_chance if first.over < FAR_ABOVE else 0.0
    good = [t for t in first.trials if t.gain > at_least and not unphysical(t.candidate, t.fit.point)]
    if first.over < next_effect.unexplained(lab):  # it may all be the discretisation
        good = [t for t in good if t.gain > LEAST_GAIN]
    bases = sorted(good, key=lambda t: t.penalised)[:LOOKED_AHEAD]
    blind = fits_alone(lab, first, bases)
    for t in (*bases, *blind):
        if lab.budget.skips(f"a second effect beside {t.candidate.key}"):
            break
        here = at_its_end(lab, t)
        second = next_effect.find(search, here.fit, here.floor, [t], most=MANY)
        if second.chosen is None or comparing.gain(lab, first.errors, second.chosen.errors) < 2.0 * LEAST_GAIN:
            continue
        little = t in blind or t.gain <= by_chance  # what the two leave must be near the floor then
        if little and times_over(second.chosen.errors, first.floors) > next_effect.unexplained(lab):
            continue
        t.reason = ""
        members = [t, *(other for other in good if other is not t and judging.is_rival(search, other, t))]
        for other in members:
            other.reason = ""
        return [replace(first, chosen=t, members=members), second]
    return [first]


def fits_alone(lab: Laboratory, first: Round, others: Sequence[Trial]) -> list[Trial]:
    """The effect that fits the fitted recordings best, where it does so by far, is none of the others, and foretells nothing.

    What fits in the place of two effects is off wherever these come in another proportion.
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
    """Where more than noise is left: two effects, if any, as their rounds, and the method that they are found by.

    The other method comes before what else its own has, for it need not be the right one: of nine pairs that five blind seeds missed, seven
    were looked for by the wrong one. What it finds is taken where that leaves nothing but noise, or clearly less than its own. Where two
    were found already it alone is asked.

    Args:
        search: The one that named an effect.
        rounds: Its rounds: the first, and one beside that effect where one was made.
        found: The effects that they named.
        at: Where these stand.
        others: The other methods, with their first rounds.
    """
    elsewhere = by_another_method(others, search, at, found, within=len(rounds) == 1)
    if elsewhere is not None and comparing.is_noise(elsewhere[0].lab, elsewhere[1][-1].chosen.errors):
        return elsewhere
    own = beside_members(search, rounds, at) if len(found) == 1 else []
    if not own and len(found) == 1 and len(rounds) > 1:
        own = in_its_place(search, rounds[0], rounds[1], at.errors)
    if elsewhere is not None and (
        not own or comparing.gain(search.lab, own[-1].chosen.errors, elsewhere[1][-1].chosen.errors) > LEAST_GAIN
    ):
        return elsewhere
    return search, own


def by_growing(search: Search, first: Round, at: Stand, others: Mapping[Search, Round]) -> tuple[Search, list[Round]] | None:
    """Where much is left: two effects that grew together, and the method that they are found by.

    The round of the second one begins where both ended, and says whether it is one. All methods are asked until two leave noise alone, the
    suggested one first, whichever goes on: one effect chose it, and of three pairs of a blind seed for which it chose finite elements all
    were the suggested one's. Where nothing was named they are looked for if what is left is more than the discretisation, and must come
    down to that.
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
    """Two effects that were fitted together as a first round and one beside it; nothing where these gain less than `least`.

    The one that does better alone is the first.
    """
    lab = search.lab
    alone = {c.key: next((t for t in few(first.trials) if t.candidate.key == c.key and np.isfinite(t.score)), None) for c in both}
    able = sorted((t for t in alone.values() if t is not None), key=lambda t: t.score)
    if not able or comparing.gain(lab, errors, there.errors) < least:
        return []
    t = able[0]
    (second,) = (c for c in both if c.key != t.candidate.key)
    here = from_there(lab, t, there.fit.point)
    pair = fitted_with(search, first, t, here, Trial(second, there, comparing.gain(lab, here.errors, there.errors)), errors, least)
    if pair:
        t.stand, t.gain = here, comparing.gain(lab, first.errors, here.errors)
    return pair


def fitted_with(
    search: Search, first: Round, t: Trial, alone: Stand, second: Trial, errors: np.ndarray, least: float = LEAST_GAIN
) -> list[Round]:
    """A first effect, and the round beside it that begins where it was fitted with a second one.

    Nothing where none is named, or the two gain less than `least` beside `errors`.
    """
    led = replace(first, chosen=None, members=[], trials=[second])
    again = next_effect.find(search, alone.fit, alone.floor, [t], led, most=MANY)
    if again.chosen is None or comparing.gain(search.lab, errors, again.chosen.errors) < least:
        return []
    t.reason = ""
    return [replace(first, chosen=t, members=[t]), again]


def beside_members(search: Search, rounds: Sequence[Round], at: Stand) -> list[Round]:
    """Where one effect was found and leaves more than noise: a member of its class beside which a second one is named, and that round.

    Two effects at once leave a class of effects each of which is partly right, and the best of them need be neither of the two. Nor was a
    second one looked for beside what lies within its floor. One of many parameters may stand for both: what is simpler is tried instead,
    and it itself last, for what is simpler may leave too much alone to say what is beside it; `narrow` then takes it for what it is.
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
    """Where more than noise is left: another method by which two effects leave less than that, and the two rounds.

    The method goes by what one effect leaves. Where there are two, that is no measure: by the wrong method one effect may stand for both
    and for what the method gets wrong, and beside it there is no other. The first one of the other method gets what that of the chosen
    method had: a search beside it, whatever the screening promises. Where that named none, and what is left is above its floor, so does
    the first one that the chosen method named.

    Args:
        others: The other methods, with their first rounds.
        search: The one that named an effect.
        at: Where what it named stands.
        found: The effects that it named.
        within: It lies within its floor, where no second one was looked for: two effects must show a promise, and leave what may be noise
            once they are refined.
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
        here = from_there(other.lab, lead, at.fit.point)
        own = first if lead is first.chosen else replace(first, chosen=lead, members=[lead])
        pair = second_beside(other, own, few(own.members), at.errors, at=here, sure=None if within else lead)
        if pair and (not within or comparing.may_be_noise(other.lab, pair[-1].chosen.errors)):
            lead.stand, lead.gain, lead.reason = here, comparing.gain(other.lab, first.errors, here.errors), ""
            made.append((other, pair))
    return min(made, key=lambda entry: entry[1][-1].chosen.score, default=None)


def from_there(lab: Laboratory, t: Trial, point: Point) -> Stand:
    """An effect's fit, or the one from the declared values of a point, where another method has come further: what leaves less.

    And from the sizes that the effect has there, if it has any.
    """
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


def at_its_end(lab: Laboratory, t: Trial) -> Stand:
    """Where an effect's fit comes to by itself: one that was given up in a race stands where nothing beside it looks like the truth."""
    here = Stand(t.fit, *discretisation.stand(lab, t.fit.point))
    return here if t.fit.converged else base_fits.finished(lab, here)


def second_beside(
    search: Search, first: Round, members: Sequence[Trial], errors: np.ndarray, *, at: Stand | None = None, sure: Trial | None = None
) -> list[Round]:
    """The member beside which a second effect leaves least, and the round of that one.

    Nothing is returned where none leaves clearly less than `errors`, or nothing but noise in one simulation. A member is asked where the
    screening beside it promises much, or it is `sure`. `at` is where the chosen one stands, if its fit was finished.
    """
    lab = search.lab
    pairs: list[list[Round]] = []
    for t in sorted(members, key=lambda t: t.penalised)[:BESIDE]:
        if lab.budget.skips(f"a second effect beside {t.candidate.key}"):
            break
        here = at if at is not None and t is first.chosen else at_its_end(lab, t)
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


def in_its_place(search: Search, first: Round, second: Round, errors: np.ndarray) -> list[Round]:
    """Where nothing was named beside an effect, though one takes most off the fitted recordings: that one beside another first effect.

    What leads alone, where there are two, need be neither of them, nor be in a class with one: a quadratic drag of a body that yields is a
    linear one. The best of the others are fitted with the second one from where that ended, and beside what leaves least so one is looked
    for as beside any. Nothing is returned where it is not named, or the two leave no less than `errors`.
    """
    lab = search.lab
    here = comparing.fitted_score(lab, second.errors)
    tried = [t for t in few(second.trials) if not unphysical(t.candidate, t.fit.point)]
    lead = min(tried, key=lambda t: comparing.fitted_score(lab, t.errors), default=None)
    if lead is None or here - comparing.fitted_score(lab, lead.errors) < 2.0 * LEAST_GAIN:
        return []
    instead = [t for t in few(others(first)) if t.candidate.name != lead.candidate.name]
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
    return fitted_with(search, first, best, at_its_end(lab, best), replace(lead, stand=there), errors)


def simpler(r: Round, chosen: Trial) -> list[Trial]:
    """What may take the chosen one's place: the best trials with fewer parameters that came close to it, and what it is in a limit.

    A limit need not come close: what the force of many parameters gained beyond it may be the other effect's.
    """
    sizes = len(chosen.candidate.size_parameters)
    narrower = [t for t in others(r) if t.candidate.name in LIMITS.get(chosen.candidate.name, ())]
    fewer = [t for t in close_to(r, chosen) if t not in narrower and len(t.candidate.size_parameters) < sizes]
    return narrower + fewer[:LOOKED_AHEAD]


def neighbours(r: Round, chosen: Trial) -> list[Trial]:
    """The best trials of no more parameters than the chosen one that came close to it."""
    most = len(chosen.candidate.parameters)
    return [t for t in close_to(r, chosen) if len(t.candidate.parameters) <= most][:LOOKED_AHEAD]


def few(trials: Iterable[Trial]) -> list[Trial]:
    """Those whose candidates have few parameters."""
    return [t for t in trials if len(t.candidate.parameters) <= MANY]


def others(r: Round) -> list[Trial]:
    """The trials of a round that can be, but for those of the class that was named."""
    return [t for t in r.trials if t not in r.members and not unphysical(t.candidate, t.fit.point)]


def close_to(r: Round, chosen: Trial) -> list[Trial]:
    """Those of `others` that came close to the chosen one, best first."""
    limit = chosen.score + 2.0 * math.log(CLOSE)
    return sorted((t for t in others(r) if t.score < limit), key=lambda t: t.penalised)
