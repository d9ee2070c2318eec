"""Full fits of candidates side by side: who is fitted from where, who is given up, and whose fit is tried again from elsewhere."""

import math
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from neuido.discrepancy.fit import Fit, Race
from neuido.discrepancy.floors import Floor
from neuido.discrepancy.problem import Candidate, Parameter, Point
from neuido.discrepancy.screening import Screening
from neuido.discrepancy.trials import Round, Stand, score

SMALL = 2
"""Parameters up to which a candidate gets a fit in the first round whatever its place in the screening: a direction says little of what a
yield stress or a lossy floor does once it acts."""
MANY = 5
"""Parameters above which a candidate is fitted after the others, and not at all where one of those leaves noise alone."""
SIZED = 3
"""Parameters up to which a candidate of one size is tried at several sizes before it is fitted."""
TRIED_AT_ONCE = 48
"""Starts, at the least, that are tried in one go where points run together: between two goes the time is looked at."""
SHAPES = 4
"""Shapes of a candidate of more than `SMALL` parameters that are fitted: from 17 degrees beside a fibre a fit comes to it, from 47 not."""
LEADERS = 4
"""Candidates that are fitted before the others."""
FAR = 6.0
"""Times the size that a candidate is screened at, for a fit from elsewhere."""
POLISHED = 4
"""Candidates whose fits are refined from further starts."""
IN_REACH = 4.0
"""Times the lowest cost up to which that of a fit is worth refining: twice its error."""
NEARBY = 2.5
"""Times the least error, that of what is held out too, up to which a fit is worth refining."""
BEYOND = 8.0
"""Times the error of what another solver named beyond which fits are not refined: that has gained up to 7-fold."""
MEASURED, NEAR = 6, 4.0
"""Fits whose errors are measured with the differences of the settings where they end: so many of the best, within this factor of their
errors."""
ONWARD = 3
"""Further fits of a candidate, each with the differences of the settings where the last one ended: while each gains `SOME_GAIN` or has
not come to its end."""
SOME_GAIN = math.log(1.2)
"""Smaller gains are no reason to look further."""
BESIDE = 2.0
"""Times the cost of a candidate's best start up to which one with the other declared values is kept beside it. By as much one as declared
is taken to leave less, where the base fit made up for the effect: what does as well as that with the stated modulus does better between."""
LED_FAR = 1.6
"""Times a declared value, or part of it, at which the base fit stands for an effect itself, and says little of where fits are to begin."""
ALIKE = 0.3
"""Share of what the leading effect does to the data, past the declared parameters, that a candidate may leave to be fitted from there."""


NO_TIME = "there was no time for its fit"
FAR_BEHIND = "by the method that fits best it was not fitted, by the other one the first few fits leave far more"
FEWER_DO = "an effect of fewer parameters leaves nothing but noise"
OTHERS_DO = "another effect leaves nothing but noise, and its direction in the data promises little"

Start = tuple[Candidate, Point, np.ndarray | None]
"""A candidate, where a fit of it begins, and about the slopes there, if they are known."""
Onset = tuple[Sequence[Parameter], Fit, Sequence[Point]]
"""What is fitted, a fit of it, and where further ones begin."""


class Contest(NamedTuple):
    """What fits of candidates came to."""

    best: dict[str, tuple[Candidate, Fit]]
    """Of each candidate, by its key."""
    other: tuple[Candidate, Fit] | None
    """The leading candidate's of the other sign."""
    unfitted: dict[str, str]
    """Why a candidate got no fit, by its key."""


def better(fits: Iterable[tuple[Candidate, Fit]], than: Mapping[str, tuple[Candidate, Fit]]) -> dict[str, tuple[Candidate, Fit]]:
    """The fit of least cost of each candidate, by its key, where it beats the one there is."""
    out: dict[str, tuple[Candidate, Fit]] = {}
    for c, fit in fits:
        rival = out.get(c.key) or than.get(c.key)
        if rival is None or fit.cost < rival[1].cost:
            out[c.key] = (c, fit)
    return out


def _in_goes(places: Sequence[tuple[list[Start], list[Start]]], count: int) -> Iterator[list[tuple[list[Start], list[Start]]]]:
    """Candidates with their starts, so many starts together at the least."""
    chunk: list[tuple[list[Start], list[Start]]] = []
    for place in places:
        chunk.append(place)
        if sum(len(made) for _, made in chunk) >= count:
            yield chunk
            chunk = []
    if chunk:
        yield chunk


class Contests(Screening):
    """The fits of a step of a diagnosis."""

    def first_slopes(
        self,
        c: Candidate,
        start: int,
        free: Sequence[Parameter],
        slopes: Mapping[int, np.ndarray],
        columns: Mapping[tuple[str, int], Mapping[int, np.ndarray]],
        floor: Floor,
    ) -> np.ndarray | None:
        """What the screening says of the slopes of a candidate's fit; none where it probed only sizes, or they do not act in proportion."""
        if not c.linear or c.size_parameters != c.parameters or any(p.log for p in c.parameters):
            return None
        coordinates = [p.coordinate(c.starts[start][p.name]) for p in c.parameters]
        return self.whitened(slopes, {n: columns[c.key, start][n] / coordinates for n in self.fitted_recordings}, floor)

    def whitened(self, slopes: Mapping[int, np.ndarray], own: Mapping[int, np.ndarray], floor: Floor) -> np.ndarray | None:
        """Slopes of the declared and of a candidate's parameters, {recording: (n, k)}, as fits take them; none where not all are finite."""
        whiten = floor.whitener(self.parts)
        J = np.concatenate([whiten(np.concatenate([slopes[n], own[n]], axis=1), n) for n in self.fitted_recordings])
        return J if np.isfinite(J).all() else None

    def strong(self, c: Candidate, places: Sequence[Point], point: Point, floor: Floor) -> list[Point]:
        """The best of some starts at full strength, of either sign, by what they leave as they are.

        A part that is many times as stiff as the rest moves the body in another way than the direction of a little stiffness says, and a
        fit that begins at a little comes down into the nearest valley.
        """
        beside = [p for p in self.problem.declared if p.log and p.name in c.beside]
        begins: list[Point] = []
        for size in (c.far, -c.far):
            moved = {p.name: p.physical(p.coordinate(point.get(p.name, p.value)) + c.beside[p.name] * size / p.scale) for p in beside}
            begins += [{**point, **start, c.apart: size, **moved} for start in places]
        if not begins:
            return []
        self.tell(f"{len(begins)} places of {c.key} at full strength")
        costs = np.array(self.costs(begins, floor))
        best = (min((i for i, b in enumerate(begins) if b[c.apart] * sign > 0), key=lambda i: costs[i]) for sign in (1, -1))
        return [begins[i] for i in best if np.isfinite(costs[i])]

    def secant(self, c: Candidate, point: Point, base: Point, slopes: Mapping[int, np.ndarray], floor: Floor) -> np.ndarray | None:
        """About the slopes of a fit of a candidate of one size: those of the declared values at the base, and the secant from there.

        None where the point has other declared values than the base, or shapes that are fitted too.
        """
        (p,) = c.size_parameters
        same = all(point.get(name) == value for name, value in base.items())
        if not same or len(c.parameters) > 1 or p.log or point[p.name] == p.value:
            return None
        step = p.coordinate(point[p.name]) - p.coordinate(p.value)
        with self.memo.during("errors of fits"):
            pairs = self.predicted([base, point], self.fitted_recordings)
        return self.whitened(slopes, {n: (there - here)[:, None] / step for (n, _), (here, there) in pairs.items()}, floor)

    def sized(
        self, starts: Sequence[Start], base: Fit, slopes: Mapping[int, np.ndarray], floor: Floor, *, until: float = 1.0
    ) -> tuple[list[Start], dict[str, float]]:
        """The best starts of each candidate, and the least share of the base fit's misfit that one leaves as it is, by key.

        Candidates of few parameters and one size are tried at the sizes and in the shapes of `tried`, one simulation each. The best one is
        kept, and of the others the best one with the base fit's, or with the declared, values. A direction has several valleys: of such
        candidates the best start of each of some shapes is kept. Past the share `until` of the time the rest keep their starts.
        """
        led_far = self.moved(base.point) > LED_FAR
        places: list[tuple[list[Start], list[Start]]] = []
        for c in {c.key: c for c, *_ in starts}.values():
            own = [start for start in starts if start[0] is c]
            if len(c.size_parameters) > 1 or len(c.parameters) > SIZED or c.apart:
                continue
            places.append((own, own + self.tried(own[0], base, led_far=led_far) if c.linear else own))
        out = [start for start in starts if all(start[0] is not own[0][0] for own, _ in places)]
        least: dict[str, float] = {}
        self.tell(f"{sum(len(made) for _, made in places)} starts of {len(places)} effects")
        for chunk in _in_goes(places, TRIED_AT_ONCE if self.problem.together else 1):
            if self.deadline.past(until):
                out += [start for own, _ in chunk for start in own]
                continue
            before, *costs = self.costs([base.point, *(point for _, made in chunk for _, point, _ in made)], floor)
            for _, own in chunk:
                left, costs = costs[: len(own)], costs[len(own) :]
                order = sorted(range(len(own)), key=lambda i: left[i])
                c = own[0][0]
                declared = [self.at_declared(begin) == begin for _, begin, _ in own]
                least[c.key] = min(v / before / (BESIDE if d and led_far else 1.0) for v, d in zip(left, declared, strict=True))
                other = [i for i in order if declared[i] != declared[order[0]] and left[i] < BESIDE * left[order[0]]]
                by_shape = {c.shape(own[i][1]): i for i in reversed(order)} if len(c.parameters) > SMALL else {}
                further = sorted(by_shape.values(), key=lambda i: left[i])[:SHAPES]
                for i in dict.fromkeys([order[0], *other[:1], *further]):
                    _, point, J = own[i]
                    out.append((c, point, self.secant(c, point, base.point, slopes, floor) if J is None and c.linear else J))
        return out, least

    def tried(self, start: Start, base: Fit, *, led_far: bool) -> list[Start]:
        """Further starts of a candidate of one size: at larger sizes, and in the other shapes that it is screened in.

        How a large effect acts is not what the slope at none says. Where the base fit has gone far from the declared values (`led_far`)
        from these too and from between, for it may have made up for the effect.
        """
        c, begun, _ = start
        (p,) = c.size_parameters
        size, signs = abs(c.starts[0][p.name]), (1.0, -1.0) if p.lower < 0 else (1.0,)
        begin = {**begun, **{name: base.point.get(name, value) for name, value in self.as_declared.items()}}
        near, middle, far = ([{p.name: min(max(sign * f * size, p.lower), p.upper)} for sign in signs] for f in (1.0, math.sqrt(FAR), FAR))
        made = [{**begin, **value} for value in (far if begin == begun else near + far)]
        if led_far:
            made += [{**self.at_declared(begin), **value} for value in near + far]
            made += [{**self.between(begin), **value} for value in far]
        others = [{**begin, **shape} for shape in c.starts if c.shape({**begin, **shape}) != c.shape(begin)]
        made += [{**other, **value} for other in others for value in middle + far]
        return [(c, point, None) for point in made]

    def contest(
        self,
        free: Sequence[Parameter],
        starts: Sequence[Start],
        floor: Floor,
        hopeful: Collection[str] | None = None,
        then: Callable[[Sequence[tuple[Candidate, Fit]]], Sequence[Start]] = lambda led: (),
        beyond: float = math.inf,
        until: float = 1.0,
    ) -> Contest:
        """Fit the candidates side by side; fits that cannot catch up with the best one stop.

        Where every point costs, the first of the screening set the pace, and candidates of many parameters come last, if at all. Where the
        first ones leave noise alone, those of the others that are not `hopeful` get no fit, and the rest one each.

        Args:
            free: What is fitted beside a candidate's parameters.
            starts: Of the fits.
            floor: What weighs the residuals.
            hopeful: Keys of candidates that could take something off by the screening; all where absent.
            then: Further starts, given the best fit of each candidate in the order of their costs.
            beyond: Score of the leading one after the first ones beyond which there are no others: another method does far better.
            until: Share of the time for the search at which fits end where they are and no others begin: the rest is for other steps.
        """
        best: dict[str, tuple[Candidate, Fit]] = {}
        ended: list[tuple[Candidate, Fit]] = []
        unfitted: dict[str, str] = {}
        race = Race()

        def fitted(own: Sequence[Start]) -> None:
            requests = []
            for c, begin, J in own:
                sizes = [p.name for p in c.size_parameters] if c.linear else []
                requests.append(self.request((*free, *c.parameters), begin, until=until, race=race, slopes=J, sizes=sizes))
            fits = list(zip((c for c, *_ in own), self.fits(requests, floor), strict=True))
            ended.extend(fits)
            best.update(better(fits, best))

        def left() -> np.ndarray:
            leading = min((fit for _, fit in best.values()), key=lambda fit: fit.cost)
            return self.mean_squares([leading.point], floor)[0]

        small = [c.key for c, *_ in starts if len(c.parameters) <= MANY]
        first = list(dict.fromkeys(small))[:LEADERS]
        waves: list[list[Start]] = [[], [], []]
        for entry in starts:
            key = entry[0].key
            waves[0 if (self.problem.together and beyond == math.inf) or key in first else 1 if key in small else 2].append(entry)
        for i, own in enumerate(waves):
            if best and own and self.deadline.skips(f"fits of {', '.join(dict.fromkeys(c.key for c, *_ in own))}", until):
                unfitted |= {c.key: NO_TIME for wave in waves[i:] for c, *_ in wave}
                break
            if own and best and score(left()) > beyond:
                return Contest(best, None, {c.key: FAR_BEHIND for wave in waves[i:] for c, *_ in wave})
            if own and best and self.is_noise(left()):
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
        other = self.other_sign(free, best, ended, floor)
        if other is not None and other[1].cost < best[other[0].key][1].cost:
            best[other[0].key], other = other, best[other[0].key]
        return Contest(best, other, unfitted)

    def other_sign(
        self, free: Sequence[Parameter], best: Mapping[str, tuple[Candidate, Fit]], ended: Sequence[tuple[Candidate, Fit]], floor: Floor
    ) -> tuple[Candidate, Fit] | None:
        """The leading candidate's best fit of the other sign, where its signs are apart.

        A stiff end of a body is much like a soft rest of it, and the one that comes down faster has the other given up: it goes on alone.
        """
        if not best:
            return None
        lead, first = min(best.values(), key=lambda entry: entry[1].cost)
        beyond = [fit for c, fit in ended if lead.apart and c.key == lead.key and fit.point[lead.apart] * first.point[lead.apart] < 0]
        if not beyond:
            return None
        fit = min(beyond, key=lambda fit: fit.cost)
        if not fit.converged and np.isfinite(fit.cost):
            (fit,) = self.fits([self.request((*free, *lead.parameters), fit.point)], floor)
        return lead, fit

    def polish(
        self,
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
        before, *squares = self.mean_squares([base.point, *(fit.point for _, fit in top)], floor)
        near = min(map(score, squares)) + 2.0 * math.log(NEARBY)
        top, squares = zip(*((t, s) for t, s in zip(top, squares, strict=True) if t is top[0] or score(s) < near), strict=True)
        if rival is not None and rival.chosen is not None and min(map(score, squares)) > rival.chosen.score + 2.0 * math.log(BEYOND):
            return {}
        gains = max(self.gain(before, square) for square in squares)
        if (top[0][1].cost > 0.7 * self.costs([base.point], floor)[0] and gains < SOME_GAIN) or self.is_noise(squares[0]):
            return {}
        ends = (f"{c.key} ({self.typical(square):.3g})" for (c, _), square in zip(top, squares, strict=True))
        self.tell(f"refining {', '.join(ends)} of {self.typical(before):.3g} {self.problem.unit}")
        leading = ranked[0][1].point
        out: dict[str, tuple[Candidate, Fit]] = {}
        least: dict[str, float] = {}
        if other is not None and other[1].cost < IN_REACH * ranked[0][1].cost:
            top = (*top, other)
        able = self.able(top)  # elsewhere there is no floor
        entries = []
        for c, fit in able:
            starts = [fit.point, self.at_declared(fit.point)]
            if fit is not ranked[0][1]:
                starts.append({**fit.point, **{name: leading[name] for name in self.as_declared}})
            entries.append(((*free, *c.parameters), fit, starts))
        for (c, _), (found, own) in zip(able, self.onward(entries, floor), strict=True):
            left = score(self.mean_squares([found.point], own, fitted=True)[0])
            if left < least.get(c.key, math.inf):
                least[c.key] = left
                out[c.key] = (c, replace(found, cost=self.costs([found.point], floor)[0]))
        return out

    def able(self, fits: Sequence[tuple[Candidate, Fit]]) -> list[tuple[Candidate, Fit]]:
        """Those that end where every recording runs."""
        return [entry for entry, ok in zip(fits, self.which_run([fit.point for _, fit in fits]), strict=True) if ok]

    def onward(self, entries: Sequence[Onset], floor: Floor) -> list[tuple[Fit, Floor]]:
        """What `from_here` makes of each entry, and further from where that ends, up to `ONWARD` times."""
        ends = self.from_here(entries, floor)
        going = list(range(len(ends)))
        for _ in range(ONWARD):
            if self.deadline.over:
                break
            run = self.which_run([ends[i][0].point for i in going])
            left = {i: self.mean_squares([ends[i][0].point], ends[i][1], fitted=True)[0] for i in going}
            going = [i for i, ok in zip(going, run, strict=True) if ok and not self.is_noise(left[i], fitted=True)]
            if not going:
                break
            made = self.from_here([(entries[i][0], ends[i][0], [ends[i][0].point]) for i in going], floor)
            further = []
            for i, (fit, there) in zip(going, made, strict=True):
                gained = score(left[i]) - score(self.mean_squares([fit.point], there, fitted=True)[0])
                if gained > 0:
                    ends[i] = (fit, there)
                    further += [i] * (not fit.converged or gained >= 2.0 * SOME_GAIN)
            going = further
        return ends

    def at_declared(self, point: Point) -> Point:
        """The point with the declared parameters, and the problem's own, as the model states them; the effects as they are."""
        return {k: v for k, v in point.items() if "." in k} | self.as_declared

    def between(self, point: Point) -> Point:
        """The point with the declared parameters half way from there to what the model states, in the coordinates that are fitted."""
        half = {p.name: p.physical(0.5 * (p.coordinate(point.get(p.name, p.value)) + p.coordinate(p.value))) for p in self.problem.declared}
        return {**point, **half}

    def from_here(self, entries: Sequence[Onset], like: Floor) -> list[tuple[Fit, Floor]]:
        """Of each entry the best of its fit and of those from its starts, and the floor of all of them: that where the fit stands.

        The fits of all entries run side by side.
        """
        self.foresee([fit.point for _, fit, _ in entries], fitted=True)
        owns, requests, of = [], [], []
        for k, (free, fit, starts) in enumerate(entries):
            (own, _), race = self.stand(fit.point, like=like, fitted=True), Race()
            moved = self.recentred(fit.point, own)
            follow = {name: value for name, value in moved.items() if value != fit.point.get(name)}
            begins = [{**start, **follow} if set(start) == set(fit.point) else start for start in starts]
            requests += [self.request(free, begin, race=race) for begin in begins]
            of += [k] * len(begins)
            owns.append(own)
        made = self.fits(requests, [owns[k] for k in of])
        out = []
        for k, (_, fit, _) in enumerate(entries):
            ends = [fit, *(end for end, its in zip(made, of, strict=True) if its == k)]
            left = [score(squares) for squares in self.mean_squares([end.point for end in ends], owns[k], fitted=True)]
            out.append((ends[int(np.argmin(left))], owns[k]))
        return out

    def measured(self, best: Mapping[str, tuple[Candidate, Fit]], floor: Floor) -> list[Stand]:
        """Each fit, in their order, with what it leaves by `floor`, or for the leading ones by that where they end, if it leaves less.

        What another grid does moves with the law: the differences at the base say little of it where a fit has gone far.
        """
        points = [fit.point for _, fit in best.values()]
        found = [Stand(fit, floor, squares) for (_, fit), squares in zip(best.values(), self.mean_squares(points, floor), strict=True)]
        if self.problem.settings == 1 or not points:
            return found
        order = sorted(range(len(points)), key=lambda i: score(found[i].errors))[:MEASURED]
        limit = score(found[order[0]].errors) + 2.0 * math.log(NEAR)
        leading = [i for i in order if score(found[i].errors) < limit and not self.is_noise(found[i].errors)]
        self.foresee([points[i] for i in leading])
        for i in leading:
            if self.runs(points[i]):
                there = Stand(found[i].fit, *self.stand(points[i], like=floor))
                found[i] = min(found[i], there, key=lambda stand: score(stand.errors))
        return found

    def alike(
        self,
        free: Sequence[Parameter],
        best: Mapping[str, tuple[Candidate, Fit]],
        candidates: Sequence[Candidate],
        chosen: Mapping[str, int],
        columns: Mapping[tuple[str, int], Mapping[int, np.ndarray]],
        slopes: Mapping[int, np.ndarray],
        floor: Floor,
    ) -> dict[str, tuple[Candidate, Fit]]:
        """Fits of the candidates that act on the data as the leading one does, from its fit, with the sizes that do as much.

        A fit that started far from there may have been given up, and a class would lack one of its members.
        """
        small = [entry for entry in best.values() if len(entry[0].parameters) <= MANY]
        if not small:
            return {}
        lead, fit = min(small, key=lambda entry: entry[1].cost)
        if not lead.linear or lead.size_parameters != lead.parameters:
            return {}
        past, start = self.past(slopes, floor), lead.starts[chosen[lead.key]]
        does = past(columns[lead.key, chosen[lead.key]]) @ np.array([fit.point[p.name] / start[p.name] for p in lead.parameters])
        if not np.isfinite(does).all():
            return {}
        requests, of = [], []
        without = {k: v for k, v in fit.point.items() if k not in start}
        for c in candidates:
            if c is lead or not c.linear or len(c.parameters) > MANY or (c.key in best and best[c.key][1].cost < 1.5 * fit.cost):
                continue
            for i, shape in enumerate(c.starts):
                A = past(columns[c.key, i])
                if not np.isfinite(A).all():
                    continue
                amount = np.linalg.lstsq(A, does, rcond=1e-6)[0]
                if np.sum((does - A @ amount) ** 2) < ALIKE * np.sum(does**2):
                    sizes = {p.name: min(max(shape[p.name] * f, p.lower), p.upper) for p, f in zip(c.size_parameters, amount, strict=True)}
                    requests.append(self.request((*free, *c.parameters), without | dict(shape) | sizes, race=Race(fit.cost)))
                    of.append(c)
                    break
        return better(zip(of, self.fits(requests, floor), strict=True), best)

    def elsewhere(
        self, best: Mapping[str, tuple[Candidate, Fit]], starts: Mapping[str, Mapping[str, float]], floor: Floor
    ) -> dict[str, tuple[Candidate, Fit]]:
        """Fits of one size once more, from the declared values and a larger size: the slope at zero may have led into a side valley."""
        requests, of, race = [], [], Race(min((fit.cost for _, fit in best.values()), default=np.inf))
        for key, (c, fit) in best.items():
            if not c.linear or len(c.size_parameters) > 1 or len(c.parameters) > SMALL:
                continue
            (p,) = c.size_parameters
            for sign in (1.0, -1.0) if p.lower < 0 else (1.0,):
                size = min(max(sign * FAR * abs(starts[key][p.name]), p.lower), p.upper)
                begin = dict(fit.point) | self.as_declared | {p.name: size}
                requests.append(self.request((*self.problem.declared, *c.parameters), begin, race=race))
                of.append(c)
        self.tell(f"again from elsewhere: {', '.join(dict.fromkeys(c.key for c in of))}")
        ended = list(zip(of, self.fits(requests, floor), strict=True))
        found = better(ended, best)
        return found | self.ahead(ended, {**best, **found}, floor)

    def ahead(
        self, ended: Sequence[tuple[Candidate, Fit]], best: Mapping[str, tuple[Candidate, Fit]], floor: Floor
    ) -> dict[str, tuple[Candidate, Fit]]:
        """Ends of fits once more with the floor where they stand, those that leave least: candidates that then leave less than their best.

        What another grid does there may be another thing than at the base, and by the weights of that the truth stays behind.
        """
        ended = [entry for entry in ended if np.isfinite(entry[1].cost)]
        if self.problem.settings == 1 or not ended or self.deadline.over:
            return {}
        left = [score(squares) for squares in self.mean_squares([fit.point for _, fit in ended], floor)]
        out: dict[str, tuple[Candidate, Fit]] = {}
        ends = self.able([ended[i] for i in np.argsort(left)[:POLISHED]])
        made = self.from_here([((*self.problem.declared, *c.parameters), fit, [fit.point]) for c, fit in ends], floor)
        for (c, _), (further, own) in zip(ends, made, strict=True):
            rival = (out.get(c.key) or best[c.key])[1]
            there = self.stand(rival.point, like=floor, fitted=True)[0]
            pairs = ((further, own), (rival, there))
            mine, its = (score(self.mean_squares([end.point], f, fitted=True)[0]) for end, f in pairs)
            if mine < its:
                out[c.key] = (c, replace(further, cost=self.costs([further.point], floor)[0]))
        return out
