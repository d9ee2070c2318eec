"""Growing fits, which read more and more of the recordings, and further fits of the best candidates from other starts."""

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
"""Ratio of the best first fit's error in the fitted recordings to the noise, above which growing fits are made."""
SIDE_BY_SIDE, ONE_BY_ONE = 8, 4
"""Number of candidates with growing fits. The first is for many simulations in one launch, and includes one candidate of more than
`MANY` parameters; the second is for simulations one by one, and includes none."""


class Breadth(NamedTuple):
    """Limits on the number of pairs of effects with growing fits."""

    firsts: int
    """Number of first effects."""
    seconds: int
    """Number of second effects beside each first one."""
    pairs: int
    """Number of pairs that go on past each horizon."""
    parameters: int
    """Largest number of parameters of a candidate."""


PAIRS, PAIRS_ONE_BY_ONE = Breadth(10, 4, 12, MANY), Breadth(5, 3, 4, 4)
"""Limits where many simulations run in one launch, and where they run one by one."""


class Pair(NamedTuple):
    """Two effects that were fitted together."""

    candidates: tuple[Candidate, Candidate]
    fit: Fit


POLISHED = 4
"""Number of candidates whose fits are refined from further starts."""
NEARBY = 2.5
"""Ratio to the least error, held-out data included, up to which a fit is worth refining."""
BEYOND = 8.0
"""Ratio to the error of another method's named effect above which no fit is refined: refining has gained up to 7-fold."""
MEASURED, NEAR = 6, 4.0
"""Fits that are measured with the floor at their ends: this many of the best, with errors up to this factor above the least. Without the
first limit, all within this factor are measured."""
BY_FAR = 0.5
"""Share of the least cost of candidates of few parameters below which a fit of many parameters is refined."""
ONWARD = 3
"""Number of further fits of a candidate, each with the floor at the end of the one before. They go on while each gains `SOME_GAIN` or
has not converged."""
SOME_GAIN = math.log(1.2)
"""Least gain that is a reason to search further."""

Onset = tuple[Sequence[Parameter], Fit, Sequence[Point]]
"""The parameters, a fit of them, and the starts of further fits."""


def leaves_much(lab: Laboratory, errors: Sequence[np.ndarray]) -> bool:
    """Return whether all fits leave far more than noise, so that they may have missed a minimum.

    `errors` are the mean squares of all parts, of each fit.
    """
    if lab.problem.settings == 1 or not lab.problem.declared:
        return False
    noise = score(lab.noise_squares[lab.fitted])
    return all(score(squares[lab.fitted]) - noise > 2.0 * math.log(MUCH) for squares in errors)


def is_astray(search: Search, base: Fit, floor: Floor) -> bool:
    """Return whether the base fit leaves much, and is far from the fit of the declared model to the first horizon."""
    lab = search.lab
    if search.begun is None or not leaves_much(lab, lab.mean_squares([base.point], floor)):
        return False
    return base_fits.apart(lab, base.point, search.begun) > ELSEWHERE


def growing(
    search: Search, base: Fit, floor: Floor, candidates: Sequence[Candidate], found: Sequence[Trial] = (), *, until: float = 1.0
) -> dict[str, tuple[Candidate, Fit]]:
    """Fit the candidates that promise most in the first part of the recordings by growing horizons.

    They are screened at the fit of the declared model, with the found effects, to the first horizon, by how much they would improve the fit
    to the second one. Each grows from its best start, and those that fall behind at a horizon are given up. A candidate of many parameters
    is included only where many simulations run in one launch.

    Returns:
        The candidate and its fit, by key, with the cost over the whole recordings.
    """
    lab = search.lab
    free = (*lab.problem.declared, *(p for t in found for p in t.candidate.parameters))
    at = at_first(search, free, contests.at_declared(lab, base.point), floor, found)
    starts = ranked_starts(lab, at, candidates, floor, free)
    # one by one, the simulations for a candidate of many parameters take five times as long as for all others together
    large = [entry for entry in starts if len(entry[0].parameters) > MANY][: 1 if lab.problem.together else 0]
    live = [entry for entry in starts if entry in large or len(entry[0].parameters) <= MANY]
    live = live[: SIDE_BY_SIDE if lab.problem.together else ONE_BY_ONE]
    lab.tell(f"growing fits of {', '.join(c.key for c, _ in live)}")
    entries = [((*free, *c.parameters), point) for c, point in live]
    ended = [(live[i][0], fit) for i, fit in base_fits.grown(lab, entries, floor, until=until, reach=IN_REACH)]
    # the fits may have ended at an earlier horizon, so their costs are taken anew
    costs = lab.costs([fit.point for _, fit in ended], floor) if ended else []
    return {c.key: (c, replace(fit, cost=cost)) for (c, fit), cost in zip(ended, costs, strict=True) if np.isfinite(cost)}


def growing_pairs(search: Search, base: Point, floor: Floor) -> list[Pair]:
    """Fit pairs of effects by growing horizons, and return them with the least cost first.

    In the first part of the recordings many single effects fit about as well as the right ones; a little later the second effect shows
    beside a right one. The error of a single effect over the whole recordings says little about that.
    """
    lab = search.lab
    free, breadth = lab.problem.declared, PAIRS if lab.problem.together else PAIRS_ONE_BY_ONE
    small = [c for c in lab.problem.candidates if len(c.parameters) <= breadth.parameters and not c.needs]
    firsts = ranked_starts(lab, at_first(search, free, contests.at_declared(lab, base), floor), small, floor, free)[: breadth.firsts]
    lab.tell(f"growing pairs beside {', '.join(c.key for c, _ in firsts)}")
    requests = [lab.request((*free, *c.parameters), point, iterations=base_fits.stepwise(lab)) for c, point in firsts]
    fits = base_fits.early_fits(lab, requests, floor, HORIZONS[0])
    begun: dict[frozenset[str], tuple[tuple[Candidate, Candidate], Point]] = {}
    for (c, _), fit in zip(firsts, fits, strict=True):
        if np.isfinite(fit.cost):
            beside = [other for other in small if other.name != c.name]
            for other, point in ranked_starts(lab, fit.point, beside, floor, (*free, *c.parameters))[: breadth.seconds]:
                begun.setdefault(frozenset((c.key, other.key)), ((c, other), point))
    live = list(begun.values())
    entries = [((*free, *c.parameters, *other.parameters), point) for (c, other), point in live]
    sizes = [[p.name for p in other.size_parameters] if other.linear else [] for (_, other), _ in live]
    ended = base_fits.grown(lab, entries, floor, reach=IN_REACH, most=breadth.pairs, sizes=sizes)
    return [Pair(live[i][0], fit) for i, fit in ended if np.isfinite(fit.cost)]


def at_first(search: Search, free: Sequence[Parameter], point: Point, floor: Floor, found: Sequence[Trial] = ()) -> Point:
    """Return the result of `first_part`, stored for reuse while no effect was found."""
    lab = search.lab
    if found:
        return base_fits.first_part(lab, free, point, floor)
    if search.begun is None:
        search.begun = base_fits.first_part(lab, free, point, floor)
    return search.begun


def ranked_starts(
    lab: Laboratory, at: Point, candidates: Sequence[Candidate], floor: Floor, free: Sequence[Parameter]
) -> list[tuple[Candidate, Point]]:
    """Return the candidates with their best starts, those first that would most improve the fit to the second horizon at a point."""
    wide = base_fits.early(lab, floor, HORIZONS[1])
    with lab.early(HORIZONS[1]):
        ranked, _ = directions.screen(lab, at, candidates, wide, directions.slopes(lab, free, at, lab.fitted_recordings))
    starts: dict[str, tuple[Candidate, Point]] = {}
    for _, c, _, begin in ranked:
        starts.setdefault(c.key, (c, begin))
    return list(starts.values())


def refine(
    lab: Laboratory,
    free: Sequence[Parameter],
    best: Mapping[str, tuple[Candidate, Fit]],
    base: Fit,
    floor: Floor,
    rival: Round | None = None,
    other: tuple[Candidate, Fit] | None = None,
) -> dict[str, tuple[Candidate, Fit]]:
    """Repeat the best fits from their ends, from the declared values, and from the declared parameters of the very best fit.

    The base fit may have misled all of them, and so may its floor, because settings differ most where the model is wrong. So each fit is
    weighted by the floor at its own end, and the best end is chosen by errors, which do not depend on the weights.

    Args:
        lab: The method that predicts.
        free: Parameters that are fitted beside those of a candidate.
        best: The best fit of each candidate, by key.
        base: The base fit.
        floor: Noise and discretisation at the base.
        rival: Round of another method. If it named an effect that leaves far less than any of these fits, none is refined.
        other: The leading candidate's fit with the opposite sign, which is refined too.

    Returns:
        The refined fits, by key.
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
    ends = (f"{c.key} ({comparing.typical_error(lab, square):.3g})" for (c, _), square in zip(top, squares, strict=True))
    lab.tell(f"refining {', '.join(ends)} of {comparing.typical_error(lab, before):.3g} {lab.problem.unit}")
    first = min(range(len(top)), key=lambda i: score(squares[i]))
    comparing.report_lead(lab, top[first][0].key, squares[first], before)
    leading = ranked[0][1].point
    out: dict[str, tuple[Candidate, Fit]] = {}
    least: dict[str, float] = {}
    if other is not None and other[1].cost < IN_REACH * ranked[0][1].cost:
        top = (*top, other)
    able = runnable(lab, top)  # where a recording does not run there is no floor
    entries = []
    for c, fit in able:
        starts = [fit.point, contests.at_declared(lab, fit.point)]
        if fit is not ranked[0][1]:
            starts.append({**fit.point, **{name: leading[name] for name in lab.as_declared}})
        entries.append(((*free, *c.parameters), fit, starts))
    for (c, _), (found, own) in zip(able, refit_repeatedly(lab, entries, floor), strict=True):
        left = score(lab.mean_squares([found.point], own, fitted=True)[0])
        if left < least.get(c.key, math.inf):
            least[c.key] = left
            out[c.key] = (c, replace(found, cost=lab.costs([found.point], floor)[0]))
    return out


def refine_large(
    lab: Laboratory, free: Sequence[Parameter], best: Mapping[str, tuple[Candidate, Fit]], floor: Floor
) -> dict[str, tuple[Candidate, Fit]]:
    """Repeat a leading fit of many parameters with the floor at its end, if it is far ahead of all fits of few parameters.

    Its many parameters may fit what another grid does where the model is wrong. With the floor of a base that was 53 mm off, a force that
    varies in time came down to the noise in the fitted recordings, and left more of the held-out ones than a uniform force. Return the fit
    by key if it is better.
    """
    ranked = sorted(best.values(), key=lambda entry: entry[1].cost)
    few = min((fit.cost for c, fit in ranked if len(c.parameters) <= MANY), default=math.inf)
    if lab.problem.settings == 1 or not ranked or ranked[0][1].cost >= BY_FAR * few or len(ranked[0][0].parameters) <= MANY:
        return {}
    lead, fit = ranked[0]
    if not lab.runs(fit.point) or lab.budget.skips(f"refining {lead.key}"):
        return {}
    lab.tell(f"refining {lead.key}")
    ((found, own),) = refit_repeatedly(lab, [((*free, *lead.parameters), fit, [fit.point])], floor)
    left, there = (score(lab.mean_squares([point], own, fitted=True)[0]) for point in (fit.point, found.point))
    return {lead.key: (lead, replace(found, cost=lab.costs([found.point], floor)[0]))} if there < left else {}


def runnable(lab: Laboratory, fits: Sequence[tuple[Candidate, Fit]]) -> list[tuple[Candidate, Fit]]:
    """Return the fits at whose ends every recording can be predicted."""
    return [entry for entry, ok in zip(fits, lab.which_run([fit.point for _, fit in fits]), strict=True) if ok]


def refit_repeatedly(lab: Laboratory, entries: Sequence[Onset], floor: Floor) -> list[tuple[Fit, Floor]]:
    """Refit each entry as `refit_from_starts` does, then repeat this from its end up to `ONWARD` times."""
    ends = refit_from_starts(lab, entries, floor)
    going = list(range(len(ends)))
    for _ in range(ONWARD):
        if lab.budget.ends():
            break
        run = lab.which_run([ends[i][0].point for i in going])
        left = {i: lab.mean_squares([ends[i][0].point], ends[i][1], fitted=True)[0] for i in going}
        going = [i for i, ok in zip(going, run, strict=True) if ok and not comparing.is_noise(lab, left[i], fitted=True)]
        if not going:
            break
        made = refit_from_starts(lab, [(entries[i][0], ends[i][0], [ends[i][0].point]) for i in going], floor)
        further = []
        for i, (fit, there) in zip(going, made, strict=True):
            gained = score(left[i]) - score(lab.mean_squares([fit.point], there, fitted=True)[0])
            if gained > 0:
                ends[i] = (fit, there)
                further += [i] * (not fit.converged or gained >= 2.0 * SOME_GAIN)
        going = further
    return ends


def refit_from_starts(lab: Laboratory, entries: Sequence[Onset], like: Floor) -> list[tuple[Fit, Floor]]:
    """Fit each entry from its starts, and return its best fit with the floor at the end of the given fit.

    The fits of all entries run side by side.
    """
    discretisation.prefetch(lab, [fit.point for _, fit, _ in entries], fitted=True)
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
    """Return each fit, in the given order, with the errors that it leaves.

    The errors are measured with `floor`, and for the leading fits also with the floor at their ends, if that leaves less. The differences
    between settings change with the law, so those at the base say little of a fit that ended far away: by these, the true effect of a blind
    case, a yield stress that grows with the rate, ranked behind twenty others. With `every`, all fits count as leading, up to the factor
    `NEAR`.
    """
    fits, points = [fit for _, fit in best.values()], [fit.point for _, fit in best.values()]
    squares: dict[int, np.ndarray] = {}
    for setting in {fit.setting for fit in fits}:  # fits that came close ended under the method's own setting
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
    discretisation.prefetch(lab, [points[i] for i in leading])
    for i in leading:
        if lab.runs(points[i]):
            there = Stand(found[i].fit, *discretisation.stand(lab, points[i], like=floor))
            found[i] = min(found[i], there, key=lambda stand: score(stand.errors))
    return found


def refit_from_larger_sizes(
    lab: Laboratory, base: Fit, best: Mapping[str, tuple[Candidate, Fit]], starts: Mapping[str, Mapping[str, float]], floor: Floor
) -> dict[str, tuple[Candidate, Fit]]:
    """Repeat the fits of candidates with one size from the declared values and a larger size.

    The slope at size zero may have led the earlier fits into a wrong local minimum.
    """
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
    # costs of quick fits belong to another motion and cannot be compared
    found = better((entry for entry in ended if entry[1].setting == lab.own), best)
    return found | refit_at_own_floors(lab, ended, {**best, **found}, floor)


def refit_at_own_floors(
    lab: Laboratory, ended: Sequence[tuple[Candidate, Fit]], best: Mapping[str, tuple[Candidate, Fit]], floor: Floor
) -> dict[str, tuple[Candidate, Fit]]:
    """Repeat the fits that leave least with the floor at their ends, and return those that then beat the candidate's best fit.

    A candidate without a fit takes any. The differences between grids may be others there than at the base, and with the floor of the base
    the true effect may stay behind.
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
    made = refit_from_starts(lab, [((*lab.problem.declared, *c.parameters), fit, [fit.point]) for c, fit in ends], floor)
    for (c, _), (further, own) in zip(ends, made, strict=True):
        rival, its = out.get(c.key) or best.get(c.key), math.inf
        if rival is not None:
            its = left_there(rival[1], discretisation.stand(lab, rival[1].point, like=floor, fitted=True)[0])
        if left_there(further, own) < its:
            out[c.key] = (c, replace(further, cost=lab.costs([further.point], floor)[0]))
    return out
