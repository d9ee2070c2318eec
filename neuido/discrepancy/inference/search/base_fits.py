"""The declared model fitted, and from there the directions of every candidate in the data."""

import math
from collections.abc import Sequence
from typing import Any

from neuido.discrepancy.inference import comparing, discretisation
from neuido.discrepancy.inference.discretisation import ROUGH
from neuido.discrepancy.inference.floors import Floor, Stand
from neuido.discrepancy.inference.laboratory import Laboratory
from neuido.discrepancy.inference.least_squares import Fit, NotFinite
from neuido.discrepancy.inference.search.search_state import Search
from neuido.discrepancy.problems.problem import Parameter, Point

FOLLOWED = 1.5
"""What the errors of the declared model must fall by for a parameter of the problem's own to leave its place."""
AGAIN, MOST_AGAIN = 2, 4
"""Fits of the declared model with the differences of the settings, each with those of where the last one ended: the least, and the most
while a parameter of the problem's own follows the amounts."""
HORIZONS = (0.25, 0.4, 0.6, 0.8)
"""Shares of the time of the fitted recordings that a growing fit reads, one after the other, before all of it."""
STEPWISE, STEPWISE_ONE_BY_ONE = 6, 16
"""Iterations at each of these, at the most; the second where every point costs, and an iteration is one point or two: of twelve pairs of
effects that turn a phase six of them find four there, sixteen ten for a fifth more points."""
ELSEWHERE = 1.0
"""Coordinates that the base fit stands apart from where the declared model fits the first horizon, to be taken for led astray."""
ASTRAY = 1.05
"""Times the error of the fitted parts from which on the end of a fit is not taken for a better one."""


def fit_declared(lab: Laboratory, starts: Sequence[Point], floor: Floor, **options: Any) -> Fit:
    """The declared parameters fitted from several starts; the best one after a few iterations goes on, with options of the fit."""
    free = lab.problem.declared
    if len(starts) > 1:
        short = lab.fits([lab.request(free, s, iterations=3) for s in starts], floor)
        starts = [min(short, key=lambda f: f.cost).point]
    return lab.fits([lab.request(free, starts[0], **options)], floor)[0]


def stepwise(lab: Laboratory) -> int:
    """Iterations at a horizon, at the most."""
    return STEPWISE if lab.problem.together else STEPWISE_ONE_BY_ONE


def early(lab: Laboratory, floor: Floor, share: float) -> Floor:
    """`Floor.early` of this problem."""
    return floor.early(lab.problem, lab.parts, share)


def first_part(lab: Laboratory, free: Sequence[Parameter], point: Point, floor: Floor) -> Point:
    """Where a fit of parameters from a point to the first horizon ends."""
    (fit,) = lab.fits([lab.request(free, point, iterations=stepwise(lab))], early(lab, floor, HORIZONS[0]))
    return fit.point


def grown(
    lab: Laboratory,
    entries: Sequence[tuple[Sequence[Parameter], Point]],
    floor: Floor,
    *,
    until: float = 1.0,
    reach: float = math.inf,
    most: int | None = None,
    sizes: Sequence[Sequence[str]] = (),
) -> list[tuple[int, Fit]]:
    """Fits of parameters from points of the first horizon, side by side, to more of the recordings and at last to all of them.

    What a body does after it has bounced has many valleys, and what it does before has few: each horizon begins where the one before
    it ended, near enough for the next bounce. What costs more than `reach` times the least at a horizon is given up, and all but the
    `most` that cost least; past the share `until` of the work they are where they are. Each with its place among the entries, the least
    cost first. `sizes`: of each entry, what begins smaller where its point does not run.
    """
    ended: list[tuple[int, Fit]] = []
    live = [(i, point) for i, (_, point) in enumerate(entries)]
    for share in (*HORIZONS[1:], 1.0):
        if not live or (ended and lab.budget.ends(until)):
            break
        options = {} if share == 1.0 else {"iterations": stepwise(lab)}
        requests = [lab.request(entries[i][0], point, until=until, sizes=sizes[i] if sizes else (), **options) for i, point in live]
        fits = lab.fits(requests, early(lab, floor, share))
        ranked = sorted(zip((i for i, _ in live), fits, strict=True), key=lambda entry: entry[1].cost)
        ended = [(i, fit) for i, fit in ranked[:most] if fit.cost <= reach * ranked[0][1].cost]
        live = [(i, fit.point) for i, fit in ended]
    return ended


def scattered(lab: Laboratory, point: Point) -> list[Point]:
    """A point, and half and twice each parameter whose logarithm is fitted."""
    out: list[Point] = [dict(point)]
    for p in lab.problem.declared:
        if p.log:
            value = point.get(p.name, p.value)
            out += [dict(point) | {p.name: p.within(value * f)} for f in (0.5, 2.0)]
    return out


def base_fit(search: Search, near: Point | None = None) -> Stand | None:
    """The base fit, with what noise and discretisation do to it; from about the declared values, or from them and from `near`.

    None: given `near`, the fit ends where not every recording can be predicted.
    """
    lab = search.lab
    # the first fit only says where the floor is to be found
    begins = [{}, near] if near else scattered(lab, {})
    with discretisation.quickly(lab):
        fit = fit_declared(lab, begins, lab.noise(), iterations=6, tolerance=ROUGH)
    if fit.setting != lab.own and not lab.runs(fit.point):
        fit = fit_declared(lab, begins, lab.noise(), iterations=6, tolerance=ROUGH)
    if not lab.runs(fit.point):
        if near is None:
            raise NotFinite("the declared model has no finite prediction")
        return None
    if lab.problem.settings == 1:
        floor = discretisation.floor_at(lab, fit.point)
        fit = fit_declared(lab, [fit.point], floor)
        return Stand(fit, floor, lab.mean_squares([fit.point], floor)[0])
    floor, errors = discretisation.stand(lab, fit.point, fitted=True)
    made, asked = [Stand(fit, floor, errors)], False
    for turn in range(MOST_AGAIN):
        begin = lab.recentred(fit.point, floor) if turn else fit.point
        if turn >= AGAIN and begin == fit.point:
            break
        if turn and lab.budget.skips("the declared model again"):
            break
        begins = [begin]
        if begin != fit.point and not asked:  # a modulus may have made up for where the floor is
            begins.append({**begin, **lab.as_declared})
            asked = True
        fit = fit_declared(lab, begins, floor)
        if not lab.runs(fit.point):
            break
        floor, errors = discretisation.stand(lab, fit.point, like=floor, fitted=True)
        made.append(Stand(fit, floor, errors))
    made += begun_anew(search, made)
    best = plainest(search, made)
    return Stand(best.fit, *discretisation.stand(lab, best.fit.point, like=best.floor))


def begun_anew(search: Search, made: Sequence[Stand]) -> list[Stand]:
    """The base fit by growing horizons from the declared values, where others leave more than noise: they may be in a side valley.

    It is weighed by the floor where the first horizon ends, for what the settings differ by elsewhere may have led the others.
    """
    lab = search.lab
    best = min(made, key=lambda stand: comparing.fitted_score(lab, stand.errors))
    free = lab.problem.declared
    if comparing.is_noise(lab, best.errors[lab.fitted], fitted=True) or not free or lab.budget.ends():
        return []
    with discretisation.quickly(lab):
        first = search.begun = first_part(lab, free, dict(lab.as_declared), best.floor)
    if apart(lab, best.fit.point, first) < ELSEWHERE or not lab.runs(first):
        return []
    floor = discretisation.floor_at(lab, first, like=best.floor, fitted=True)
    with discretisation.quickly(lab):
        ((_, fit),) = grown(lab, [(free, first)], floor)
    out: list[Stand] = []
    for _ in range(AGAIN):
        if not lab.runs(fit.point):
            break
        floor, errors = discretisation.stand(lab, fit.point, like=floor, fitted=True)
        out.append(Stand(fit, floor, errors))
        if comparing.fitted_score(lab, errors) - comparing.fitted_score(lab, best.errors) > 2.0 * math.log(FOLLOWED):
            break
        fit = fit_declared(lab, [fit.point], floor)
    return out


def apart(lab: Laboratory, point: Point, other: Point) -> float:
    """The largest difference of two points in a coordinate of a declared parameter."""
    return max(abs(p.coordinate(point[p.name]) - p.coordinate(other[p.name])) for p in lab.problem.declared)


def plainest(search: Search, made: Sequence[Stand]) -> Stand:
    """The stand that leaves least of the fitted parts: one whose point follows the amounts must leave clearly less than the others.

    A parameter of the problem's own that makes up for an effect in part stands in the way of all that begins there.
    """
    lab = search.lab

    def left(stand: Stand) -> float:
        return comparing.fitted_score(lab, stand.errors)

    own = [{k: v for k, v in stand.fit.point.items() if k not in lab.as_declared} for stand in made]
    still = min((stand for stand, place in zip(made, own, strict=True) if place == own[0]), key=left)
    best = min(made, key=left)
    if left(still) - left(best) <= 2.0 * math.log(FOLLOWED):
        return still
    search.still = still.fit.point
    return best


def finished(lab: Laboratory, named: Stand) -> Stand:
    """A fit once more from its end, with the floor there, until a standard deviation of the noise would show.

    Unless that leaves more of the fitted parts than `named` does, with the floor where it stands or the one that it was named with:
    weights are about what another grid does, and a step along that can go further from the data.
    """

    def left(stand: Stand) -> float:
        return comparing.fitted_score(lab, stand.errors)

    fit = named.fit
    here = Stand(fit, *discretisation.stand(lab, fit.point))
    unit = 1.0 / sum(int(p.rows.sum()) for p in lab.parts if p.fitted)
    parameters = [lab.problem.parameter(name) for name in fit.names]
    begin = lab.recentred(fit.point, here.floor)
    (further,) = lab.fits([lab.request(parameters, begin, iterations=6, tolerance=0.3 * unit, nothing=0.1 * unit)], here.floor)
    least = min(named, here, key=left)
    if not parameters or not lab.runs(further.point):
        return least
    _, after = discretisation.stand(lab, further.point, like=here.floor)
    if comparing.fitted_score(lab, after) - left(least) > 2.0 * math.log(ASTRAY):
        return least
    return Stand(further, *discretisation.stand(lab, further.point))
