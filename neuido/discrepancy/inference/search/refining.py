"""First fits that read more and more of the recordings, and the best fits once more from where they and others stand."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from neuido.discrepancy.inference import comparing, directions, discretisation
from neuido.discrepancy.inference.floors import Floor, Round, Stand, Trial, score
from neuido.discrepancy.inference.laboratory import Laboratory
from neuido.discrepancy.inference.least_squares import Fit, Race
from neuido.discrepancy.inference.search import base_fits, contests
from neuido.discrepancy.inference.search.base_fits import ELSEWHERE, HORIZONS
from neuido.discrepancy.inference.search.contests import FAR, IN_REACH, MANY, SMALL, better
from neuido.discrepancy.inference.search.search_state import Search
from neuido.discrepancy.problems.problem import Candidate, Parameter, Point

MUCH = 2.5
"""Times the noise of the fitted recordings that the best first fit leaves, from which on fits grow."""
SIDE_BY_SIDE, ONE_BY_ONE = 8, 4
"""Candidates that grow, where a launch of several points costs as one, one of them of more than `MANY` parameters, and where every point
costs, none of those."""


class Breadth(NamedTuple):
    """How many pairs of effects grow."""

    firsts: int
    """Candidates beside which a second one grows."""
    seconds: int
    """Beside each of these."""
    pairs: int
    """That go on past the second horizon."""
    parameters: int
    """Of a candidate, at the most."""


PAIRS, PAIRS_ONE_BY_ONE = Breadth(10, 4, 12, MANY), Breadth(5, 3, 4, 4)
"""Where a launch of several points costs as one, and where every point costs."""


class Pair(NamedTuple):
    """Two effects that were fitted together."""

    candidates: tuple[Candidate, Candidate]
    fit: Fit


POLISHED = 4
"""Candidates whose fits are refined from further starts."""
NEARBY = 2.5
"""Times the least error, that of what is held out too, up to which a fit is worth refining."""
BEYOND = 8.0
"""Times the error of what another solver named beyond which fits are not refined: that has gained up to 7-fold."""
MEASURED, NEAR = 6, 4.0
"""Fits whose errors are measured with the differences of the settings where they end: so many of the best, or all, within this factor of
their errors."""
BY_FAR = 0.5
"""Share of the least cost of a candidate of few parameters below which one of many is refined."""
ONWARD = 3
"""Further fits of a candidate, each with the differences of the settings where the last one ended: while each gains `SOME_GAIN` or has
not come to its end."""
SOME_GAIN = math.log(1.2)
"""Smaller gains are no reason to look further."""

Onset = tuple[Sequence[Parameter], Fit, Sequence[Point]]
"""What is fitted, a fit of it, and where further ones begin."""


def leaves_much(lab: Laboratory, errors: Sequence[np.ndarray]) -> bool:
    """Whether the least of what fits leave of all parts, mean squares, is far above noise: they may have missed a valley."""
    if lab.problem.settings == 1 or not lab.problem.declared:
        return False
    noise = score(lab.noise_squares[lab.fitted])
    return all(score(squares[lab.fitted]) - noise > 2.0 * math.log(MUCH) for squares in errors)


def is_astray(search: Search, base: Fit, floor: Floor) -> bool:
    """Whether the base fit leaves much and stands elsewhere than the declared model fits the first part of the recordings."""
    lab = search.lab
    if search.begun is None or not leaves_much(lab, lab.mean_squares([base.point], floor)):
        return False
    return base_fits.apart(lab, base.point, search.begun) > ELSEWHERE


def growing(
    search: Search, base: Fit, floor: Floor, candidates: Sequence[Candidate], found: Sequence[Trial] = (), *, until: float = 1.0
) -> dict[str, tuple[Candidate, Fit]]:
    """Fits of the candidates that promise most in the first part of the fitted recordings, by growing horizons, by their keys.

    They are screened where the declared model, with the effects that were found, fits the first part of the recordings, by what they
    would take off a little more of it, and the start of each that does best is the one that grows. What falls behind at a horizon is
    given up. One of many parameters grows where a launch of several points costs as one.
    """
    lab = search.lab
    free = (*lab.problem.declared, *(p for t in found for p in t.candidate.parameters))
    at = at_first(search, free, contests.at_declared(lab, base.point), floor, found)
    starts = leading(lab, at, candidates, base_fits.early(lab, floor, HORIZONS[1]), free)
    # where every point costs one of many parameters takes five times as long as the others together
    large = [entry for entry in starts if len(entry[0].parameters) > MANY][: 1 if lab.problem.together else 0]
    live = [entry for entry in starts if entry in large or len(entry[0].parameters) <= MANY]
    live = live[: SIDE_BY_SIDE if lab.problem.together else ONE_BY_ONE]
    lab.tell(f"growing fits of {', '.join(c.key for c, _ in live)}")
    entries = [((*free, *c.parameters), point) for c, point in live]
    ended = [(live[i][0], fit) for i, fit in base_fits.grown(lab, entries, floor, until=until, reach=IN_REACH)]
    costs = lab.costs([fit.point for _, fit in ended], floor) if ended else []  # they may have ended at an earlier horizon
    return {c.key: (c, replace(fit, cost=cost)) for (c, fit), cost in zip(ended, costs, strict=True) if np.isfinite(cost)}


def growing_pairs(search: Search, base: Point, floor: Floor) -> list[Pair]:
    """Fits of two effects at once by growing horizons, the least cost first.

    In the first part of the recordings many a single effect does about as well as the right ones, whichever they are; a little later
    the second one shows beside it. What one effect alone leaves of the whole says little of that.
    """
    lab = search.lab
    free, breadth = lab.problem.declared, PAIRS if lab.problem.together else PAIRS_ONE_BY_ONE
    small = [c for c in lab.problem.candidates if len(c.parameters) <= breadth.parameters]
    wide = base_fits.early(lab, floor, HORIZONS[1])
    firsts = leading(lab, at_first(search, free, contests.at_declared(lab, base), floor), small, wide, free)[: breadth.firsts]
    lab.tell(f"growing pairs beside {', '.join(c.key for c, _ in firsts)}")
    requests = [lab.request((*free, *c.parameters), point, iterations=base_fits.stepwise(lab)) for c, point in firsts]
    fits = lab.fits(requests, base_fits.early(lab, floor, HORIZONS[0]))
    begun: dict[frozenset[str], tuple[tuple[Candidate, Candidate], Point]] = {}
    for (c, _), fit in zip(firsts, fits, strict=True):
        if np.isfinite(fit.cost):
            beside = [other for other in small if other.name != c.name]
            for other, point in leading(lab, fit.point, beside, wide, (*free, *c.parameters))[: breadth.seconds]:
                begun.setdefault(frozenset((c.key, other.key)), ((c, other), point))
    live = list(begun.values())
    entries = [((*free, *c.parameters, *other.parameters), point) for (c, other), point in live]
    sizes = [[p.name for p in other.size_parameters] if other.linear else [] for (_, other), _ in live]
    ended = base_fits.grown(lab, entries, floor, reach=IN_REACH, most=breadth.pairs, sizes=sizes)
    return [Pair(live[i][0], fit) for i, fit in ended if np.isfinite(fit.cost)]


def at_first(search: Search, free: Sequence[Parameter], point: Point, floor: Floor, found: Sequence[Trial] = ()) -> Point:
    """`first_part`, which is kept where no effect was found yet."""
    lab = search.lab
    if found:
        return base_fits.first_part(lab, free, point, floor)
    if search.begun is None:
        search.begun = base_fits.first_part(lab, free, point, floor)
    return search.begun


def leading(
    lab: Laboratory, at: Point, candidates: Sequence[Candidate], floor: Floor, free: Sequence[Parameter]
) -> list[tuple[Candidate, Point]]:
    """Candidates, those first that would take most off there past the free parameters, each with the start that does best."""
    ranked, _ = directions.screen(lab, at, candidates, floor, directions.slopes(lab, free, at, lab.fitted_recordings))
    starts: dict[str, tuple[Candidate, Point]] = {}
    for _, c, _, begin in ranked:
        starts.setdefault(c.key, (c, begin))
    return list(starts.values())


def polish(
    lab: Laboratory,
    free: Sequence[Parameter],
    best: Mapping[str, tuple[Candidate, Fit]],
    base: Fit,
    floor: Floor,
    rival: Round | None = None,
    other: tuple[Candidate, Fit] | None = None,
) -> dict[str, tuple[Candidate, Fit]]:
    """The best fits once more, from where they ended, from the declared values, and from those of the very best one.

    The base fit may have led all of them astray, and its weights too, for the settings differ most where the model is wrong: each is
    weighed by the floor where it stands. Which end is the best one is said by the errors, for weights differ. Where `rival`, the round
    of another solver, named an effect that leaves far less than any of them, none is refined. `other`, the leading candidate's fit of
    the other sign, is refined beside it.
    """
    ranked = sorted(best.values(), key=lambda entry: entry[1].cost)
    within = [entry for entry in ranked if entry[1].cost < IN_REACH * ranked[0][1].cost]
    top = [entry for entry in within if len(entry[0].parameters) <= MANY][:POLISHED]
    if not top:
        return {}
    before, *squares = lab.mean_squares([base.point, *(fit.point for _, fit in top)], floor)
    near = min(map(score, squares)) + 2.0 * math.log(NEARBY)
    top, squares = zip(*((t, s) for t, s in zip(top, squares, strict=True) if t is top[0] or score(s) < near), strict=True)
    if rival is not None and rival.chosen is not None and min(map(score, squares)) > rival.chosen.score + 2.0 * math.log(BEYOND):
        return {}
    gains = max(comparing.gain(lab, before, square) for square in squares)
    if (top[0][1].cost > 0.7 * lab.costs([base.point], floor)[0] and gains < SOME_GAIN) or comparing.is_noise(lab, squares[0]):
        return {}
    ends = (f"{c.key} ({comparing.typical(lab, square):.3g})" for (c, _), square in zip(top, squares, strict=True))
    lab.tell(f"refining {', '.join(ends)} of {comparing.typical(lab, before):.3g} {lab.problem.unit}")
    first = min(range(len(top)), key=lambda i: score(squares[i]))
    comparing.tell_lead(lab, top[first][0].key, squares[first], before)
    leading = ranked[0][1].point
    out: dict[str, tuple[Candidate, Fit]] = {}
    least: dict[str, float] = {}
    if other is not None and other[1].cost < IN_REACH * ranked[0][1].cost:
        top = (*top, other)
    able = runnable(lab, top)  # elsewhere there is no floor
    entries = []
    for c, fit in able:
        starts = [fit.point, contests.at_declared(lab, fit.point)]
        if fit is not ranked[0][1]:
            starts.append({**fit.point, **{name: leading[name] for name in lab.as_declared}})
        entries.append(((*free, *c.parameters), fit, starts))
    for (c, _), (found, own) in zip(able, onward(lab, entries, floor), strict=True):
        left = score(lab.mean_squares([found.point], own, fitted=True)[0])
        if left < least.get(c.key, math.inf):
            least[c.key] = left
            out[c.key] = (c, replace(found, cost=lab.costs([found.point], floor)[0]))
    return out


def widened(
    lab: Laboratory, free: Sequence[Parameter], best: Mapping[str, tuple[Candidate, Fit]], floor: Floor
) -> dict[str, tuple[Candidate, Fit]]:
    """The fit of many parameters that leads all of few by far, once more with the floor where it stands, as `polish` does for those.

    What another grid does where the model is wrong is then in its many parameters: a force in time came to the noise by the weights of
    the base, 53 mm off, and left more than a uniform one of what was held out.
    """
    ranked = sorted(best.values(), key=lambda entry: entry[1].cost)
    few = min((fit.cost for c, fit in ranked if len(c.parameters) <= MANY), default=math.inf)
    if lab.problem.settings == 1 or not ranked or ranked[0][1].cost >= BY_FAR * few or len(ranked[0][0].parameters) <= MANY:
        return {}
    lead, fit = ranked[0]
    if not lab.runs(fit.point) or lab.budget.skips(f"refining {lead.key}"):
        return {}
    lab.tell(f"refining {lead.key}")
    ((found, own),) = onward(lab, [((*free, *lead.parameters), fit, [fit.point])], floor)
    left, there = (score(lab.mean_squares([point], own, fitted=True)[0]) for point in (fit.point, found.point))
    return {lead.key: (lead, replace(found, cost=lab.costs([found.point], floor)[0]))} if there < left else {}


def runnable(lab: Laboratory, fits: Sequence[tuple[Candidate, Fit]]) -> list[tuple[Candidate, Fit]]:
    """Those that end where every recording runs."""
    return [entry for entry, ok in zip(fits, lab.which_run([fit.point for _, fit in fits]), strict=True) if ok]


def onward(lab: Laboratory, entries: Sequence[Onset], floor: Floor) -> list[tuple[Fit, Floor]]:
    """What `from_here` makes of each entry, and further from where that ends, up to `ONWARD` times."""
    ends = from_here(lab, entries, floor)
    going = list(range(len(ends)))
    for _ in range(ONWARD):
        if lab.budget.ends():
            break
        run = lab.which_run([ends[i][0].point for i in going])
        left = {i: lab.mean_squares([ends[i][0].point], ends[i][1], fitted=True)[0] for i in going}
        going = [i for i, ok in zip(going, run, strict=True) if ok and not comparing.is_noise(lab, left[i], fitted=True)]
        if not going:
            break
        made = from_here(lab, [(entries[i][0], ends[i][0], [ends[i][0].point]) for i in going], floor)
        further = []
        for i, (fit, there) in zip(going, made, strict=True):
            gained = score(left[i]) - score(lab.mean_squares([fit.point], there, fitted=True)[0])
            if gained > 0:
                ends[i] = (fit, there)
                further += [i] * (not fit.converged or gained >= 2.0 * SOME_GAIN)
        going = further
    return ends


def from_here(lab: Laboratory, entries: Sequence[Onset], like: Floor) -> list[tuple[Fit, Floor]]:
    """Of each entry the best of its fit and of those from its starts, and the floor of all of them: that where the fit stands.

    The fits of all entries run side by side.
    """
    discretisation.foresee(lab, [fit.point for _, fit, _ in entries], fitted=True)
    owns, requests, of = [], [], []
    for k, (free, fit, starts) in enumerate(entries):
        (own, _), race = discretisation.stand(lab, fit.point, like=like, fitted=True), Race()
        moved = lab.recentred(fit.point, own)
        follow = {name: value for name, value in moved.items() if value != fit.point.get(name)}
        begins = [{**start, **follow} if set(start) == set(fit.point) else start for start in starts]
        requests += [lab.request(free, begin, race=race) for begin in begins]
        of += [k] * len(begins)
        owns.append(own)
    made = lab.fits(requests, [owns[k] for k in of])
    out = []
    for k, (_, fit, _) in enumerate(entries):
        ends = [fit, *(end for end, its in zip(made, of, strict=True) if its == k)]
        left = [score(squares) for squares in lab.mean_squares([end.point for end in ends], owns[k], fitted=True)]
        out.append((ends[int(np.argmin(left))], owns[k]))
    return out


def measured(lab: Laboratory, best: Mapping[str, tuple[Candidate, Fit]], floor: Floor, *, every: bool = False) -> list[Stand]:
    """Each fit, in their order, with what it leaves by `floor`, or for the leading ones by that where they end, if it leaves less.

    What another grid does moves with the law: the differences at the base say little of it where a fit has gone far. By these the
    truth of a blind case, a yield stress that grows with the rate, was behind twenty others. `every`: not the leading ones alone.
    """
    fits, points = [fit for _, fit in best.values()], [fit.point for _, fit in best.values()]
    squares: dict[int, np.ndarray] = {}
    for setting in {fit.setting for fit in fits}:  # those that came close have the own one
        own = [i for i, fit in enumerate(fits) if fit.setting == setting]
        with lab.under(setting):
            squares |= zip(own, lab.mean_squares([points[i] for i in own], floor), strict=True)
    found = [Stand(fit, floor, squares[i]) for i, fit in enumerate(fits)]
    if lab.problem.settings == 1 or not points:
        return found
    order = sorted(range(len(points)), key=lambda i: score(found[i].errors))
    order = order if every else order[:MEASURED]
    limit = score(found[order[0]].errors) + 2.0 * math.log(NEAR)
    leading = [i for i in order if score(found[i].errors) < limit and not comparing.is_noise(lab, found[i].errors)]
    discretisation.foresee(lab, [points[i] for i in leading])
    for i in leading:
        if lab.runs(points[i]):
            there = Stand(found[i].fit, *discretisation.stand(lab, points[i], like=floor))
            found[i] = min(found[i], there, key=lambda stand: score(stand.errors))
    return found


def elsewhere(
    lab: Laboratory, base: Fit, best: Mapping[str, tuple[Candidate, Fit]], starts: Mapping[str, Mapping[str, float]], floor: Floor
) -> dict[str, tuple[Candidate, Fit]]:
    """Fits of one size once more, from the declared values and a larger size: the slope at zero may have led into a side valley."""
    begins: list[tuple[Candidate, Point]] = []
    for key, (c, fit) in best.items():
        if not c.linear or len(c.size_parameters) != 1 or len(c.parameters) > SMALL:
            continue
        p = c.size_parameters[0]
        for sign in p.signs:
            size = p.within(sign * FAR * abs(starts[key][p.name]))
            begins.append((c, dict(fit.point) | lab.as_declared | {p.name: size}))
    lab.tell(f"again from elsewhere: {', '.join(dict.fromkeys(c.key for c, _ in begins))}")
    with discretisation.quickly(lab, base.point, floor):
        race = Race(min((fit.cost for _, fit in best.values() if fit.setting == lab.setting), default=np.inf))
        requests = [lab.request((*lab.problem.declared, *c.parameters), begin, race=race) for c, begin in begins]
        ended = list(zip((c for c, _ in begins), lab.fits(requests, floor), strict=True))
    found = better((entry for entry in ended if entry[1].setting == lab.own), best)  # the costs of quick ones are of another motion
    return found | ahead(lab, ended, {**best, **found}, floor)


def ahead(
    lab: Laboratory, ended: Sequence[tuple[Candidate, Fit]], best: Mapping[str, tuple[Candidate, Fit]], floor: Floor
) -> dict[str, tuple[Candidate, Fit]]:
    """Ends of fits once more with the floor where they stand, those that leave least: candidates that then leave less than their best.

    Any will do for one that has none. What another grid does there may be another thing than at the base, and by the weights of that
    the truth stays behind.
    """
    ended = [entry for entry in ended if np.isfinite(entry[1].cost)]
    if lab.problem.settings == 1 or not ended or lab.budget.ends():
        return {}

    def left_there(fit: Fit, there: Floor) -> float:
        return score(lab.mean_squares([fit.point], there, fitted=True)[0])

    with lab.under(ended[0][1].setting):
        left = [score(squares) for squares in lab.mean_squares([fit.point for _, fit in ended], floor)]
    out: dict[str, tuple[Candidate, Fit]] = {}
    ends = runnable(lab, [ended[i] for i in np.argsort(left)[:POLISHED]])
    made = from_here(lab, [((*lab.problem.declared, *c.parameters), fit, [fit.point]) for c, fit in ends], floor)
    for (c, _), (further, own) in zip(ends, made, strict=True):
        rival, its = out.get(c.key) or best.get(c.key), math.inf
        if rival is not None:
            its = left_there(rival[1], discretisation.stand(lab, rival[1].point, like=floor, fitted=True)[0])
        if left_there(further, own) < its:
            out[c.key] = (c, replace(further, cost=lab.costs([further.point], floor)[0]))
    return out
