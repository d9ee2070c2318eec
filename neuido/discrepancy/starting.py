"""Where fits of candidates begin: at several sizes and in several shapes, at full strength, and with the slopes that are known there."""

import math
from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from neuido.discrepancy.fit import Fit
from neuido.discrepancy.floors import Floor
from neuido.discrepancy.problem import Candidate, Parameter, Point
from neuido.discrepancy.screening import Screening

SMALL = 2
"""Parameters up to which a candidate gets a fit in the first round whatever its place in the screening: a direction says little of what a
yield stress or a lossy floor does once it acts."""
SIZED = 3
"""Parameters up to which a candidate of one size is tried at several sizes before it is fitted."""
TRIED_AT_ONCE = 48
"""Starts, at the least, that are tried in one go where points run together: between two goes the time is looked at."""
SHAPES = 4
"""Shapes of a candidate of more than `SMALL` parameters that are fitted: from 17 degrees beside a fibre a fit comes to it, from 47 not."""
FAR = 6.0
"""Times the size that a candidate is screened at, for a fit from elsewhere."""
BESIDE = 2.0
"""Times the cost of a candidate's best start up to which one with the other declared values is kept beside it. By as much one as declared
is taken to leave less, where the base fit made up for the effect: what does as well as that with the stated modulus does better between."""
TAKEN = (0.75, 0.55)
"""Times a declared parameter that a candidate takes from (`Candidate.takes`), at which larger sizes of it are tried too."""
LED_FAR = 1.6
"""Times a declared value, or part of it, at which the base fit stands for an effect itself, and says little of where fits are to begin."""

Start = tuple[Candidate, Point, np.ndarray | None]
"""A candidate, where a fit of it begins, and about the slopes there, if they are known."""


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


class Starting(Screening):
    """The starts of a step of a diagnosis."""

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
        begins = [{**point, **start, **self.along(c, point, {c.apart: size})} for size in (c.far, -c.far) for start in places]
        if not begins:
            return []
        self.tell(f"{len(begins)} places of {c.key} at full strength")
        costs = np.array(self.costs(begins, floor))
        best = (min((i for i, b in enumerate(begins) if b[c.apart] * sign > 0), key=lambda i: costs[i]) for sign in (1, -1))
        return [begins[i] for i in best if np.isfinite(costs[i])]

    def along(self, c: Candidate, point: Point, size: Mapping[str, float]) -> dict[str, float]:
        """A size of a candidate, with the declared parameters that go with it (`Candidate.beside`) from what they are at a point."""
        (value,) = size.values()
        beside = [p for p in self.problem.declared if p.log and p.name in c.beside]
        moved = {p.name: p.physical(p.coordinate(point.get(p.name, p.value)) + c.beside[p.name] * value / p.scale) for p in beside}
        return {**moved, **size}

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
            places.append((own, own + (self.tried(own[0], base, led_far=led_far) if c.linear else self.each_as_declared(c, base.point))))
        out = [start for start in starts if all(start[0] is not own[0][0] for own, _ in places)]
        least: dict[str, float] = {}
        self.tell(f"{sum(len(made) for _, made in places)} starts of {len(places)} effects")
        for chunk in _in_goes(places, TRIED_AT_ONCE if self.problem.together else 1):
            if self.deadline.ends(until):
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

        How a large effect acts is not what the slope at none says, and one that has shapes may be very large. Where the base fit has gone
        far from the declared values (`led_far`) from these too and from between, for it may have made up for the effect; what stiffens a
        body is tried with less of a modulus too, and what goes with a declared value along a valley (`Candidate.beside`) with that.
        """
        c, begun, _ = start
        (p,) = c.size_parameters
        size = abs(c.starts[0][p.name])
        begin = {**begun, **{name: base.point.get(name, value) for name, value in self.as_declared.items()}}
        near, middle, far, beyond = ([{p.name: p.within(sign * f * size)} for sign in p.signs] for f in (1.0, math.sqrt(FAR), FAR, FAR**2))
        made = [{**begin, **value} for value in (far if begin == begun else near + far)]
        if led_far:
            made += [{**self.at_declared(begin), **value} for value in near + far]
            made += [{**self.between(begin), **value} for value in far]
        others = [{**begin, **shape} for shape in c.starts if c.shape({**begin, **shape}) != c.shape(begin)]
        made += [{**other, **value} for other in others for value in middle + far]
        made += [{**place, **value} for place in [begin, *others] for value in beyond] if others else []
        if c.beside:
            made += [{**begin, **self.along(c, begin, value)} for value in near + middle + far]
        if takes := [name for name in c.takes if name in self.as_declared]:
            sizes = far[:1] if others else middle[:1] + far[:1]
            less = [{name: factor * begin[name] for name in takes} for factor in TAKEN]
            made += [{**place, **taken, **value} for taken in less for place in [begin, *others] for value in sizes]
        return [(c, point, None) for point in made]

    def each_as_declared(self, c: Candidate, point: Point) -> list[Start]:
        """Every start of a candidate with the declared values: where one that does not act in proportion begins to act goes with these."""
        return [(c, {**self.at_declared(point), **start}, None) for start in c.starts]

    def at_declared(self, point: Point) -> Point:
        """The point with the declared parameters, and the problem's own, as the model states them; the effects as they are."""
        return {k: v for k, v in point.items() if "." in k} | self.as_declared

    def between(self, point: Point) -> Point:
        """The point with the declared parameters half way from there to what the model states, in the coordinates that are fitted."""
        half = {p.name: p.physical(0.5 * (p.coordinate(point.get(p.name, p.value)) + p.coordinate(p.value))) for p in self.problem.declared}
        return {**point, **half}
