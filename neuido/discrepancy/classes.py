"""What becomes of named effects once all are found: what else is in their classes, and what the others make needless."""

import math
from collections.abc import Iterable
from dataclasses import replace

from neuido.discrepancy.fit import Fit
from neuido.discrepancy.floors import Floor
from neuido.discrepancy.judging import CLASS_RATIO
from neuido.discrepancy.laboratory import LEAST_GAIN
from neuido.discrepancy.pairs import neighbours, simpler
from neuido.discrepancy.rounds import Inference
from neuido.discrepancy.trials import Round, Stand, Trial, score


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
