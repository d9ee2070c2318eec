"""The base fit: the declared model fitted before any effect is added, and the helpers that grow a fit over time."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from neuido.discrepancy.inference import comparing, discretisation
from neuido.discrepancy.inference.discretisation import ROUGH
from neuido.discrepancy.inference.floors import Floor, Stand
from neuido.discrepancy.inference.laboratory import Laboratory
from neuido.discrepancy.inference.least_squares import Fit, NotFinite, Request
from neuido.discrepancy.inference.search.search_state import Search
from neuido.discrepancy.problems.problem import Parameter, Point

FOLLOWED = 1.5
"""Factor by which the error of the declared model must fall before an extra parameter of the problem (such as the height of the
colliders) may leave its first value."""
DOUBLINGS = 5
"""Doublings and halvings of a declared value that the fit of the declared model looks at before it begins: a modulus that is only guessed
may be wrong by a factor of ten."""
AGAIN, MOST_AGAIN = 2, 4
"""Least and largest number of fits of the declared model, each with the differences of the settings at the end of the fit before. More
than the least are made only while an extra parameter of the problem still changes."""
HORIZONS = (0.25, 0.4, 0.6, 0.8)
"""Shares of the time of the fitted recordings that a growing fit reads one after the other, before it reads all of it."""
STEPWISE, STEPWISE_ONE_BY_ONE = 6, 16
"""Largest number of iterations at each horizon. The second is used where simulations run one by one and an iteration takes only one or
two of them: of twelve pairs of effects that change the phase of a motion, six iterations find four and sixteen find ten, with a fifth
more simulations."""
ELSEWHERE = 1.0
"""Distance in fit coordinates between the base fit and the fit to the first horizon, above which the base fit is taken to be in a wrong
local minimum."""
ASTRAY = 1.05
"""Ratio of the errors of the fitted parts above which the end of a further fit is rejected."""


def fit_declared(lab: Laboratory, starts: Sequence[Point], floor: Floor, **options: Any) -> Fit:
    """Fit the declared parameters from the best of several starts.

    Each start gets a few iterations, and the one of least cost goes on. `options` are those of `Laboratory.request`.
    """
    free = lab.problem.declared
    if len(starts) > 1:
        short = lab.fits([lab.request(free, s, iterations=3) for s in starts], floor)
        starts = [min(short, key=lambda f: f.cost).point]
    return lab.fits([lab.request(free, starts[0], **options)], floor)[0]


def stepwise(lab: Laboratory) -> int:
    """Return the largest number of iterations at one horizon."""
    return STEPWISE if lab.problem.together else STEPWISE_ONE_BY_ONE


def early(lab: Laboratory, floor: Floor, share: float) -> Floor:
    """Return a floor that gives no weight to data after this share of the fitted time; see `Floor.early`."""
    return floor.early(lab.problem, lab.parts, share)


def early_fits(lab: Laboratory, requests: Sequence[Request], floor: Floor, share: float) -> list[Fit]:
    """Run fits to the data up to a share of the fitted time, after which no motion is predicted."""
    setting = lab.setting
    with lab.early(share):
        return [replace(fit, setting=setting) for fit in lab.fits(requests, early(lab, floor, share))]


def first_part(lab: Laboratory, free: Sequence[Parameter], point: Point, floor: Floor) -> Point:
    """Return the point at which a fit of the parameters to the first horizon ends."""
    (fit,) = early_fits(lab, [lab.request(free, point, iterations=stepwise(lab))], floor, HORIZONS[0])
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
    """Fit parameters to a growing share of the recordings, several fits side by side.

    The motion after a bounce gives the cost many local minima, the motion before it few. Therefore each horizon begins at the end of the
    one before, which is near enough to pass the next bounce.

    Args:
        lab: The method that predicts.
        entries: Parameters and the point, already fitted to the first horizon, of each fit.
        floor: Weights of the residuals.
        until: Share of the search's work after which the fits stop at the horizon that they have reached.
        reach: Ratio to the least cost above which a fit is given up at a horizon.
        most: Number of fits that go on past each horizon; all where absent.
        sizes: Names of the parameters of each entry that are made smaller where its point does not run.

    Returns:
        The index of the entry and the fit, the least cost first.
    """
    ended: list[tuple[int, Fit]] = []
    live = [(i, point) for i, (_, point) in enumerate(entries)]
    for share in (*HORIZONS[1:], 1.0):
        if not live or (ended and lab.budget.ends(until)):
            break
        options = {} if share == 1.0 else {"iterations": stepwise(lab)}
        requests = [lab.request(entries[i][0], point, until=until, sizes=sizes[i] if sizes else (), **options) for i, point in live]
        fits = early_fits(lab, requests, floor, share)
        ranked = sorted(zip((i for i, _ in live), fits, strict=True), key=lambda entry: entry[1].cost)
        ended = [(i, fit) for i, fit in ranked[:most] if fit.cost <= reach * ranked[0][1].cost]
        live = [(i, fit.point) for i, fit in ended]
    return ended


def scaled_starts(lab: Laboratory, floor: Floor) -> list[Point]:
    """Return the declared values, and copies of them with each log-scaled declared parameter scaled.

    Each parameter is halved and doubled. It also takes the value in a coarse scan over `DOUBLINGS` that predicts the first horizon best.
    The motion of a body that is much too stiff hardly depends on its modulus, so that a fit from there would stay there.
    """
    out: list[Point] = [{}]
    first = early(lab, floor, HORIZONS[0])
    for p in lab.problem.declared:
        if p.log:
            scan = {k: {p.name: p.within(p.value * 2.0**k)} for k in range(-DOUBLINGS, DOUBLINGS + 1)}
            with lab.early(HORIZONS[0]):
                able = [k for k, point in scan.items() if lab.problem.margin(point, lab.setting) >= 0.0]
                costs = dict(zip(able, lab.costs([scan[k] for k in able], first), strict=True))
            best = min(able, key=lambda k: costs[k], default=0)
            out += [scan[k] for k in (-1, 1, *({best} - {-1, 0, 1}))]
    return out


def base_fit(search: Search, near: Point | None = None) -> Stand | None:
    """Fit the declared model, and measure what noise and discretisation add at its end.

    The fit begins at several points about the declared values, or at the declared values and at `near`.

    Returns:
        The fitted model, or None if `near` is given and some recording cannot be predicted at the end of the fit.

    Raises:
        NotFinite: Without `near`, some recording cannot be predicted at the end of the fit.
    """
    lab = search.lab
    # the first fit only finds the point at which to measure the floor
    with discretisation.quickly(lab):
        begins = [{}, near] if near else scaled_starts(lab, lab.noise())
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
        if begin != fit.point and not asked:  # a modulus may have compensated for a wrong height of the floor
            begins.append({**begin, **lab.as_declared})
            asked = True
        fit = fit_declared(lab, begins, floor)
        if not lab.runs(fit.point):
            break
        floor, errors = discretisation.stand(lab, fit.point, like=floor, fitted=True)
        made.append(Stand(fit, floor, errors))
    made += refit_by_growing(search, made)
    best = best_base_fit(search, made)
    return Stand(best.fit, *discretisation.stand(lab, best.fit.point, like=best.floor))


def refit_by_growing(search: Search, made: Sequence[Stand]) -> list[Stand]:
    """Fit the declared model again by growing horizons, in case the fits so far ended in a wrong local minimum.

    This is done only where more than noise is left. The new fits use the floor at the end of the first horizon, because the differences of
    the settings elsewhere may have misled the other fits. The list is empty where no new fit was made.
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
    """Return the largest distance between two points in the fit coordinate of a declared parameter."""
    return max(abs(p.coordinate(point[p.name]) - p.coordinate(other[p.name])) for p in lab.problem.declared)


def best_base_fit(search: Search, made: Sequence[Stand]) -> Stand:
    """Return the fitted model with the least error, preferring those whose extra parameters kept their first values.

    An extra parameter of the problem, such as the height of the colliders, may compensate for part of an effect and so hide it. It must
    therefore lower the error of the fitted parts by the factor `FOLLOWED`.
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
    """Continue the fit of a fitted model with the floor at its end, until a change of one standard deviation of the noise would show.

    Return the continued fit, unless it leaves more of the fitted parts than `named` does. That can happen because the weights come from the
    differences between grids, and a step in their direction can move away from the data.
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
