"""Full fits of candidates side by side: their starts, their order, and when a fit is given up."""

import math
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence

import numpy as np

from neuido.discrepancy.inference import comparing
from neuido.discrepancy.inference.floors import Floor, score
from neuido.discrepancy.inference.laboratory import Laboratory
from neuido.discrepancy.inference.least_squares import Fit, Race
from neuido.discrepancy.inference.search.search_state import Contest, PutOff, Start
from neuido.discrepancy.problems.problem import Candidate, Parameter, Point

SMALL = 2
"""Number of parameters up to which a candidate is fitted in the first round whatever its rank in the screening. The screening's
direction says little of what a yield stress or a lossy floor does once it acts."""
SIZED = 3
"""Number of parameters up to which a candidate with one size is tried at several sizes before it is fitted."""
TRIED_AT_ONCE = 48
"""Least number of starts in one batch where many simulations run in one launch. The budget is checked between batches."""
SHAPES = 4
"""Number of shapes of a candidate with more than `SMALL` parameters that are fitted. A fit finds a fibre from 17 degrees away, but not
from 47."""
FAR = 6.0
"""Factor from the size at which a candidate is screened to the larger size from which further fits begin."""
BESIDE = 2.0
"""Ratio of costs up to which a start with other declared values is kept beside a candidate's best start. Where the base fit may have
compensated for the effect, the cost of a start at the declared values is divided by it too: with values in between, such a start does
better."""
TAKEN = (0.75, 0.55)
"""Factors on a declared parameter that the fit without the effect makes too large (`Candidate.takes`); larger sizes are tried with them
too."""
LED_FAR = 1.6
"""Ratio of a fitted to a declared value, or the reverse, above which the base fit may have compensated for an effect, so that fits also
begin elsewhere."""


def _batches(places: Sequence[tuple[list[Start], list[Start]]], count: int) -> Iterator[list[tuple[list[Start], list[Start]]]]:
    """Yield batches of candidates, each with at least `count` starts but the last."""
    chunk: list[tuple[list[Start], list[Start]]] = []
    for place in places:
        chunk.append(place)
        if sum(len(made) for _, made in chunk) >= count:
            yield chunk
            chunk = []
    if chunk:
        yield chunk


MANY = 5
"""Number of parameters above which a candidate is fitted after the others, and not at all where one of those leaves only noise."""
LEADERS = 4
"""Number of candidates that are fitted before the others."""
IN_REACH = 4.0
"""Ratio to the least cost up to which a fit is worth refining; it means twice the error."""
CLOSELY = 8
"""Largest number of quick fits that are repeated under the method's own setting."""
AT_MOST = 6
"""Largest number of iterations of such a repeated fit."""

NO_TIME = "the search ended before its fit"
FAR_BEHIND = "by the method that fits best it was not fitted, by the other one the first few fits leave far more"
FEWER_DO = "an effect of fewer parameters leaves nothing but noise"
OTHERS_DO = "another effect leaves nothing but noise, and its direction in the data promises little"


def better(fits: Iterable[tuple[Candidate, Fit]], than: Mapping[str, tuple[Candidate, Fit]]) -> dict[str, tuple[Candidate, Fit]]:
    """Return the fit of least cost of each candidate, by key, where it costs less than the one in `than`."""
    out: dict[str, tuple[Candidate, Fit]] = {}
    for c, fit in fits:
        rival = out.get(c.key) or than.get(c.key)
        if rival is None or fit.cost < rival[1].cost:
            out[c.key] = (c, fit)
    return out


def first_slopes(
    lab: Laboratory,
    c: Candidate,
    start: int,
    free: Sequence[Parameter],
    slopes: Mapping[int, np.ndarray],
    columns: Mapping[tuple[str, int], Mapping[int, np.ndarray]],
    floor: Floor,
) -> np.ndarray | None:
    """Return the slopes of a candidate's fit as the screening knows them, whitened.

    Return None if they are unknown or small sizes of the effect do not act in proportion.
    """
    if not c.linear or c.size_parameters != c.parameters or any(p.log for p in c.parameters):
        return None
    coordinates = [p.coordinate(c.starts[start][p.name]) for p in c.parameters]
    return whitened(lab, slopes, {n: columns[c.key, start][n] / coordinates for n in lab.fitted_recordings}, floor)


def whitened(lab: Laboratory, slopes: Mapping[int, np.ndarray], own: Mapping[int, np.ndarray], floor: Floor) -> np.ndarray | None:
    """Return whitened slopes of the declared and a candidate's parameters, or None if some are not finite.

    `slopes` and `own` map a recording to an array (n, k). The result has the fitted rows of all recordings.
    """
    whiten = floor.whitener(lab.parts)
    J = np.concatenate([whiten(np.concatenate([slopes[n], own[n]], axis=1), n) for n in lab.fitted_recordings])
    return J if np.isfinite(J).all() else None


def strong(lab: Laboratory, c: Candidate, places: Sequence[Point], point: Point, floor: Floor) -> list[Point]:
    """Return the best start of each sign at full strength, by the cost of one simulation each.

    A part that is many times as stiff as the rest moves the body differently than a slightly stiffer part does. A fit from a small size
    would end in the nearest local minimum.
    """
    begins = [{**point, **start, **along(lab, c, point, {c.apart: size})} for size in (c.far, -c.far) for start in places]
    if not begins:
        return []
    lab.tell(f"{len(begins)} places of {c.key} at full strength")
    costs = np.array(lab.costs(begins, floor))
    best = (min((i for i, b in enumerate(begins) if b[c.apart] * sign > 0), key=lambda i: costs[i]) for sign in (1, -1))
    return [begins[i] for i in best if np.isfinite(costs[i])]


def along(lab: Laboratory, c: Candidate, point: Point, size: Mapping[str, float]) -> dict[str, float]:
    """Return a size of a candidate, and the declared parameters that change with it (`Candidate.beside`) from their values at a point."""
    (value,) = size.values()
    beside = [p for p in lab.problem.declared if p.log and p.name in c.beside]
    moved = {p.name: p.physical(p.coordinate(point.get(p.name, p.value)) + c.beside[p.name] * value / p.scale) for p in beside}
    return {**moved, **size}


def secant(lab: Laboratory, c: Candidate, point: Point, base: Point, slopes: Mapping[int, np.ndarray], floor: Floor) -> np.ndarray | None:
    """Return approximate slopes for the fit of a candidate with one size: those of the base, and a secant for the size.

    Return None where the declared values of the point differ from the base, or shapes are fitted too.
    """
    (p,) = c.size_parameters
    same = all(point.get(name) == value for name, value in base.items())
    if not same or len(c.parameters) > 1 or p.log or point[p.name] == p.value:
        return None
    step = p.coordinate(point[p.name]) - p.coordinate(p.value)
    with lab.memo.during("errors of fits"):
        pairs = lab.predicted([base, point], lab.fitted_recordings)
    return whitened(lab, slopes, {n: (there - here)[:, None] / step for (n, _), (here, there) in pairs.items()}, floor)


def sized(
    lab: Laboratory, starts: Sequence[Start], base: Fit, slopes: Mapping[int, np.ndarray], floor: Floor, *, until: float = 1.0
) -> tuple[list[Start], dict[str, float]]:
    """Return the best starts of each candidate, and the least share of the base fit's misfit that one start leaves, by key.

    Candidates with one size and few parameters are tried at the sizes and shapes of `tried`, one simulation each. The best start is kept,
    and beside it the best one that has the other declared values (fitted or declared). A direction has several local minima, so for
    candidates with more than `SMALL` parameters the best start of each of several shapes is kept. After the share `until` of the search's
    work, the remaining candidates keep their starts.
    """
    led_far = comparing.moved(lab, base.point) > LED_FAR
    places: list[tuple[list[Start], list[Start]]] = []
    for c in {c.key: c for c, *_ in starts}.values():
        own = [start for start in starts if start[0] is c]
        if len(c.size_parameters) > 1 or len(c.parameters) > SIZED or c.apart:
            continue
        places.append((own, own + (tried(lab, own[0], base, led_far=led_far) if c.linear else each_as_declared(lab, c, base.point))))
    out = [start for start in starts if all(start[0] is not own[0][0] for own, _ in places)]
    least: dict[str, float] = {}
    lab.tell(f"{sum(len(made) for _, made in places)} starts of {len(places)} effects")
    for chunk in _batches(places, TRIED_AT_ONCE if lab.problem.together else 1):
        if lab.budget.ends(until):
            out += [start for own, _ in chunk for start in own]
            continue
        before, *costs = lab.costs([base.point, *(point for _, made in chunk for _, point, _ in made)], floor)
        for _, own in chunk:
            left, costs = costs[: len(own)], costs[len(own) :]
            order = sorted(range(len(own)), key=lambda i: left[i])
            c = own[0][0]
            declared = [at_declared(lab, begin) == begin for _, begin, _ in own]
            least[c.key] = min(v / before / (BESIDE if d and led_far else 1.0) for v, d in zip(left, declared, strict=True))
            other = [i for i in order if declared[i] != declared[order[0]] and left[i] < BESIDE * left[order[0]]]
            by_shape = {c.shape(own[i][1]): i for i in reversed(order)} if len(c.parameters) > SMALL else {}
            further = sorted(by_shape.values(), key=lambda i: left[i])[:SHAPES]
            for i in dict.fromkeys([order[0], *other[:1], *further]):
                _, point, J = own[i]
                out.append((c, point, secant(lab, c, point, base.point, slopes, floor) if J is None and c.linear else J))
    return out, least


def tried(lab: Laboratory, start: Start, base: Fit, *, led_far: bool) -> list[Start]:
    """Return further starts of a candidate with one size: larger sizes, and the other shapes in which it is screened.

    The slope at zero does not tell how a large effect acts, and an effect that has shapes may be very large. If `led_far`, the base fit may
    have compensated for the effect, so sizes are also tried at the declared values and half way to them. An effect that stiffens a body is
    tried with a smaller modulus too, and one that changes together with a declared value (`Candidate.beside`) along that line.
    """
    c, begun, _ = start
    (p,) = c.size_parameters
    size = abs(c.starts[0][p.name])
    begin = {**begun, **{name: base.point.get(name, value) for name, value in lab.as_declared.items()}}
    near, middle, far, beyond = ([{p.name: p.within(sign * f * size)} for sign in p.signs] for f in (1.0, math.sqrt(FAR), FAR, FAR**2))
    made = [{**begin, **value} for value in (far if begin == begun else near + far)]
    if led_far:
        made += [{**at_declared(lab, begin), **value} for value in near + far]
        made += [{**half_way_to_declared(lab, begin), **value} for value in far]
    others = [{**begin, **shape} for shape in c.starts if c.shape({**begin, **shape}) != c.shape(begin)]
    made += [{**other, **value} for other in others for value in middle + far]
    made += [{**place, **value} for place in [begin, *others] for value in beyond] if others else []
    if c.beside:
        made += [{**begin, **along(lab, c, begin, value)} for value in near + middle + far]
    if takes := [name for name in c.takes if name in lab.as_declared]:
        sizes = far[:1] if others else middle[:1] + far[:1]
        less = [{name: factor * begin[name] for name in takes} for factor in TAKEN]
        made += [{**place, **taken, **value} for taken in less for place in [begin, *others] for value in sizes]
    return [(c, point, None) for point in made]


def each_as_declared(lab: Laboratory, c: Candidate, point: Point) -> list[Start]:
    """Return every start of a candidate at the declared values.

    They matter for an effect that does not act in proportion: the size at which it begins to act depends on the declared values.
    """
    return [(c, {**at_declared(lab, point), **start}, None) for start in c.starts]


def at_declared(lab: Laboratory, point: Point) -> Point:
    """Return the point with the declared parameters as stated and without extra parameters of the problem; effects keep their values."""
    return {k: v for k, v in point.items() if "." in k} | lab.as_declared


def half_way_to_declared(lab: Laboratory, point: Point) -> Point:
    """Return the point with the declared parameters half way to their stated values, in fit coordinates."""
    half = {p.name: p.physical(0.5 * (p.coordinate(point.get(p.name, p.value)) + p.coordinate(p.value))) for p in lab.problem.declared}
    return {**point, **half}


def contest(
    lab: Laboratory,
    free: Sequence[Parameter],
    starts: Sequence[Start],
    floor: Floor,
    hopeful: Collection[str] | None = None,
    then: Callable[[Sequence[tuple[Candidate, Fit]]], Sequence[Start]] = lambda led: (),
    beyond: float = math.inf,
    until: float = 1.0,
    between: Callable[[np.ndarray], Iterable[tuple[Candidate, Fit]]] = lambda remains: (),
    puts_off: bool = False,
    before: Sequence[tuple[Candidate, Fit]] = (),
) -> Contest:
    """Fit the candidates side by side, and stop fits that cannot catch up with the best one.

    Where simulations run one by one, the leading candidates of the screening are fitted first, so that others can be given up early.
    Candidates with many parameters come last, if at all, where predictions are simulations. Where the first fits leave only noise, later
    candidates that are not `hopeful` get no fit, and the others one each. All fits use the setting in use, which may be a quick one; those
    that come close are repeated under the method's own setting.

    Args:
        lab: The method that predicts.
        free: Parameters that are fitted beside those of a candidate.
        starts: Starts of the fits.
        floor: Weights of the residuals.
        hopeful: Keys of candidates that could lower the misfit according to the screening; all where absent.
        then: Returns further starts, given the best fit of each candidate in order of cost.
        beyond: Score of the best first fit above which no others are made, because another method does far better.
        until: Share of the search's work at which fits stop and no others begin.
        between: Returns further fits after the first ones, given the least errors that these leave, where other fits are to come.
        puts_off: Whether the other fits wait where the first ones leave more than what may be noise: the method may be the wrong one.
        before: Fits that were made before `starts` were put off (`PutOff.ended`).
    """
    ended = list(before)
    best = better(ended, {})
    unfitted: dict[str, str] = {}
    race = Race(min((fit.cost for _, fit in ended), default=math.inf))

    def fitted(own: Sequence[Start]) -> None:
        requests = []
        for c, begin, J in own:
            sizes = [p.name for p in c.size_parameters] if c.linear else []
            requests.append(lab.request((*free, *c.parameters), begin, until=until, race=race, slopes=J, sizes=sizes))
        fits = list(zip((c for c, *_ in own), lab.fits(requests, floor), strict=True))
        ended.extend(fits)
        best.update(better(fits, best))

    def left() -> tuple[tuple[Candidate, Fit], np.ndarray]:
        (leading,) = refit_under_own_setting(lab, free, [min(best.values(), key=lambda entry: entry[1].cost)], floor, until)
        with lab.under(lab.own):
            return leading, lab.mean_squares([leading[1].point], floor)[0]

    small = [c.key for c, *_ in starts if len(c.parameters) <= MANY]
    first = list(dict.fromkeys(small))[:LEADERS] if not before else []
    waves: list[list[Start]] = [[], [], []]
    at_once = lab.problem.together and beyond == math.inf
    large_too = at_once and lab.problem.settings == 1  # the slopes of many parameters are half of the work, where that is a simulation each
    for entry in starts:
        key = entry[0].key
        waves[0 if large_too or key in first or (at_once and key in small) else 1 if key in small else 2].append(entry)
    for i, own in enumerate(waves):
        if best and own and lab.budget.skips(f"fits of {', '.join(dict.fromkeys(c.key for c, *_ in own))}", until):
            unfitted |= {c.key: NO_TIME for wave in waves[i:] for c, *_ in wave}
            break
        leading, remains = left() if own and best else (None, None)
        if remains is not None and i == 1 and (further := better(between(remains), best)):
            best |= further
            race.best = min(race.best, *(fit.cost for _, fit in further.values()))
            leading, remains = left()
        if remains is not None and score(remains) > beyond:
            unfitted = {c.key: FAR_BEHIND for wave in waves[i:] for c, *_ in wave}
            return Contest(*refit_nearest(lab, free, best, None, floor, until), unfitted)
        if puts_off and leading is not None and remains is not None and not comparing.may_be_noise(lab, remains):
            waiting = tuple(start for wave in waves[i:] for start in wave)
            unfitted = {c.key: NO_TIME for c, *_ in waiting}
            return Contest({**best, leading[0].key: leading}, None, unfitted, PutOff(tuple(ended), waiting))
        if remains is not None and comparing.is_noise(lab, remains):
            if own is waves[2]:
                unfitted |= {c.key: FEWER_DO for c, *_ in own}
                break
            if hopeful is not None:
                unfitted |= {c.key: OTHERS_DO for c, *_ in own if c.key not in hopeful}
                once = {entry[0].key: entry for entry in reversed(own) if entry[0].key in hopeful}
                own = [entry for entry in own if once.get(entry[0].key) is entry]
        fitted(own)
    if further := then(sorted(best.values(), key=lambda entry: entry[1].cost)):
        fitted(further)
    other = other_sign(lab, free, best, ended, floor)
    if other is not None and other[1].cost < best[other[0].key][1].cost:
        best[other[0].key], other = other, best[other[0].key]
    return Contest(*refit_nearest(lab, free, best, other, floor, until), unfitted)


def refit_nearest(
    lab: Laboratory,
    free: Sequence[Parameter],
    best: Mapping[str, tuple[Candidate, Fit]],
    other: tuple[Candidate, Fit] | None,
    floor: Floor,
    until: float,
) -> tuple[dict[str, tuple[Candidate, Fit]], tuple[Candidate, Fit] | None]:
    """Repeat the quick fits of least cost under the method's own setting, from their ends; at most `CLOSELY` of them."""
    fits = sorted(best.values(), key=lambda entry: entry[1].cost)
    near = [entry for entry in fits if entry[1].cost < IN_REACH * fits[0][1].cost][:CLOSELY]
    ended = refit_under_own_setting(lab, free, near if other is None else [*near, other], floor, until)
    again = None if other is None else ended.pop()
    return {**best, **{c.key: (c, fit) for c, fit in ended}}, again


def refit_under_own_setting(
    lab: Laboratory, free: Sequence[Parameter], fits: Sequence[tuple[Candidate, Fit]], floor: Floor, until: float
) -> list[tuple[Candidate, Fit]]:
    """Repeat quick fits under the method's own setting, from their ends, and keep a quick fit where that does not run.

    No fit is given up early, because the class of an effect depends on where all of them end.
    """
    if lab.setting == lab.own:
        return list(fits)
    with lab.under(lab.own):
        options = {"until": until, "iterations": AT_MOST}
        requests = [lab.request((*free, *c.parameters), fit.point, slopes=fit.slopes, **options) for c, fit in fits]
        ends = lab.fits(requests, floor)
    return [(c, end if np.isfinite(end.cost) else fit) for (c, fit), end in zip(fits, ends, strict=True)]


def other_sign(
    lab: Laboratory,
    free: Sequence[Parameter],
    best: Mapping[str, tuple[Candidate, Fit]],
    ended: Sequence[tuple[Candidate, Fit]],
    floor: Floor,
) -> tuple[Candidate, Fit] | None:
    """Return the leading candidate's best fit with the opposite sign, if its sign cannot change during a fit (`Candidate.apart`).

    A stiff end of a body resembles a soft rest of it, and the sign that descends faster makes the other be given up. That fit is continued
    here alone.
    """
    if not best:
        return None
    lead, first = min(best.values(), key=lambda entry: entry[1].cost)
    beyond = [fit for c, fit in ended if lead.apart and c.key == lead.key and fit.point[lead.apart] * first.point[lead.apart] < 0]
    if not beyond:
        return None
    fit = min(beyond, key=lambda fit: fit.cost)
    if not fit.converged and np.isfinite(fit.cost):
        (fit,) = lab.fits([lab.request((*free, *lead.parameters), fit.point)], floor)
    return lead, fit
