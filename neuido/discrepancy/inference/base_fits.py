"""The declared model fitted, and from there the directions of every candidate in the data."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from neuido.discrepancy.inference.floors import Floor, Stand
from neuido.discrepancy.inference.laboratory import ROUGH, Laboratory
from neuido.discrepancy.inference.least_squares import Fit, NotFinite
from neuido.discrepancy.problems.problem import Candidate, Parameter, Point
from neuido.errors import UserError

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


LEAST_STEP = 1e-3
"""Of a slope, in typical steps of a parameter: below it no smaller one is tried."""


class BaseFits(Laboratory):
    """Fits of the declared model, and the linear look at every candidate that comes before full fits of a few."""

    def base(self, starts: Sequence[Point], floor: Floor, **options: Any) -> Fit:
        """The declared parameters fitted from several starts; the best one after a few iterations goes on, with options of the fit."""
        free = self.problem.declared
        if len(starts) > 1:
            short = self.fits([self.request(free, s, iterations=3) for s in starts], floor)
            starts = [min(short, key=lambda f: f.cost).point]
        return self.fits([self.request(free, starts[0], **options)], floor)[0]

    @property
    def stepwise(self) -> int:
        """Iterations at a horizon, at the most."""
        return STEPWISE if self.problem.together else STEPWISE_ONE_BY_ONE

    def early(self, floor: Floor, share: float) -> Floor:
        """`Floor.early` of this problem."""
        return floor.early(self.problem, self.parts, share)

    def first_part(self, free: Sequence[Parameter], point: Point, floor: Floor) -> Point:
        """Where a fit of parameters from a point to the first horizon ends."""
        (fit,) = self.fits([self.request(free, point, iterations=self.stepwise)], self.early(floor, HORIZONS[0]))
        return fit.point

    def grown(
        self,
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
        `most` that cost least; past the share `until` of the time they are where they are. Each with its place among the entries, the least
        cost first. `sizes`: of each entry, what begins smaller where its point does not run.
        """
        ended: list[tuple[int, Fit]] = []
        live = [(i, point) for i, (_, point) in enumerate(entries)]
        for share in (*HORIZONS[1:], 1.0):
            if not live or (ended and self.deadline.ends(until)):
                break
            options = {} if share == 1.0 else {"iterations": self.stepwise}
            requests = [self.request(entries[i][0], point, until=until, sizes=sizes[i] if sizes else (), **options) for i, point in live]
            fits = self.fits(requests, self.early(floor, share))
            ranked = sorted(zip((i for i, _ in live), fits, strict=True), key=lambda entry: entry[1].cost)
            ended = [(i, fit) for i, fit in ranked[:most] if fit.cost <= reach * ranked[0][1].cost]
            live = [(i, fit.point) for i, fit in ended]
        return ended

    def starts(self, point: Point) -> list[Point]:
        """A point, and half and twice each parameter whose logarithm is fitted."""
        out: list[Point] = [dict(point)]
        for p in self.problem.declared:
            if p.log:
                value = point.get(p.name, p.value)
                out += [dict(point) | {p.name: p.within(value * f)} for f in (0.5, 2.0)]
        return out

    def start(self, near: Point | None = None) -> Stand | None:
        """The base fit, with what noise and discretisation do to it; from about the declared values, or from them and from `near`.

        None: given `near`, the fit ends where not every recording can be predicted.
        """
        # the first fit only says where the floor is to be found
        begins = [{}, near] if near else self.starts({})
        with self.quickly():
            fit = self.base(begins, self.noise(), iterations=6, tolerance=ROUGH)
        if fit.setting != self.own and not self.runs(fit.point):
            fit = self.base(begins, self.noise(), iterations=6, tolerance=ROUGH)
        if not self.runs(fit.point):
            if near is None:
                raise NotFinite("the declared model has no finite prediction")
            return None
        if self.problem.settings == 1:
            floor = self.floor(fit.point)
            fit = self.base([fit.point], floor)
            return Stand(fit, floor, self.mean_squares([fit.point], floor)[0])
        floor, errors = self.stand(fit.point, fitted=True)
        made, asked = [Stand(fit, floor, errors)], False
        for turn in range(MOST_AGAIN):
            begin = self.recentred(fit.point, floor) if turn else fit.point
            if turn >= AGAIN and begin == fit.point:
                break
            if turn and self.deadline.skips("the declared model again"):
                break
            begins = [begin]
            if begin != fit.point and not asked:  # a modulus may have made up for where the floor is
                begins.append({**begin, **self.as_declared})
                asked = True
            fit = self.base(begins, floor)
            if not self.runs(fit.point):
                break
            floor, errors = self.stand(fit.point, like=floor, fitted=True)
            made.append(Stand(fit, floor, errors))
        made += self.begun_anew(made)
        best = self.plainest(made)
        return Stand(best.fit, *self.stand(best.fit.point, like=best.floor))

    def begun_anew(self, made: Sequence[Stand]) -> list[Stand]:
        """The base fit by growing horizons from the declared values, where others leave more than noise: they may be in a side valley.

        It is weighed by the floor where the first horizon ends, for what the settings differ by elsewhere may have led the others.
        """
        best = min(made, key=lambda stand: self.fitted_score(stand.errors))
        free = self.problem.declared
        if self.is_noise(best.errors[self.fitted], fitted=True) or not free or self.deadline.ends():
            return []
        with self.quickly():
            first = self.begun = self.first_part(free, dict(self.as_declared), best.floor)
        if self.apart(best.fit.point, first) < ELSEWHERE or not self.runs(first):
            return []
        floor = self.floor(first, like=best.floor, fitted=True)
        with self.quickly():
            ((_, fit),) = self.grown([(free, first)], floor)
        out: list[Stand] = []
        for _ in range(AGAIN):
            if not self.runs(fit.point):
                break
            floor, errors = self.stand(fit.point, like=floor, fitted=True)
            out.append(Stand(fit, floor, errors))
            if self.fitted_score(errors) - self.fitted_score(best.errors) > 2.0 * math.log(FOLLOWED):
                break
            fit = self.base([fit.point], floor)
        return out

    def apart(self, point: Point, other: Point) -> float:
        """The largest difference of two points in a coordinate of a declared parameter."""
        return max(abs(p.coordinate(point[p.name]) - p.coordinate(other[p.name])) for p in self.problem.declared)

    def plainest(self, made: Sequence[Stand]) -> Stand:
        """The stand that leaves least of the fitted parts: one whose point follows the amounts must leave clearly less than the others.

        A parameter of the problem's own that makes up for an effect in part stands in the way of all that begins there.
        """

        def left(stand: Stand) -> float:
            return self.fitted_score(stand.errors)

        own = [{k: v for k, v in stand.fit.point.items() if k not in self.as_declared} for stand in made]
        still = min((stand for stand, place in zip(made, own, strict=True) if place == own[0]), key=left)
        best = min(made, key=left)
        if left(still) - left(best) <= 2.0 * math.log(FOLLOWED):
            return still
        self.still = still.fit.point
        return best

    def finished(self, named: Stand) -> Stand:
        """A fit once more from its end, with the floor there, until a standard deviation of the noise would show.

        Unless that leaves more of the fitted parts than `named` does, with the floor where it stands or the one that it was named with:
        weights are about what another grid does, and a step along that can go further from the data.
        """

        def left(stand: Stand) -> float:
            return self.fitted_score(stand.errors)

        fit = named.fit
        here = Stand(fit, *self.stand(fit.point))
        unit = 1.0 / sum(int(p.rows.sum()) for p in self.parts if p.fitted)
        parameters = [self.problem.parameter(name) for name in fit.names]
        begin = self.recentred(fit.point, here.floor)
        (further,) = self.fits([self.request(parameters, begin, iterations=6, tolerance=0.3 * unit, nothing=0.1 * unit)], here.floor)
        least = min(named, here, key=left)
        if not parameters or not self.runs(further.point):
            return least
        _, after = self.stand(further.point, like=here.floor)
        if self.fitted_score(after) - left(least) > 2.0 * math.log(ASTRAY):
            return least
        return Stand(further, *self.stand(further.point))

    def columns(
        self, point: Point, candidates: Sequence[Candidate], recordings: Sequence[int]
    ) -> dict[tuple[str, int], dict[int, np.ndarray]]:
        """Directions of each candidate and start in the data of recordings: (key, start) -> {recording: (n, sizes)}."""
        asked, places = [], []
        for c in candidates:
            for i, start in enumerate(c.starts):
                sizes = [p.name for p in c.size_parameters]
                shape = {k: v for k, v in start.items() if k not in sizes}
                for name in sizes:
                    asked.append(dict(point) | shape | {name: start[name]})
                    places.append((c.key, i))
        out: dict[tuple[str, int], dict[int, np.ndarray]] = {place: {} for place in places}
        with self.memo.during("screening"):
            predicted = self.memo.predict_several([([point, *asked], n, self.setting) for n in recordings])
        for n, (here, *rows) in zip(recordings, predicted, strict=True):
            self.tell(f"directions of {len(asked)} effects in {self.problem.recordings[n].name}")
            for place in out:
                out[place][n] = np.stack([row - here for row, p in zip(rows, places, strict=True) if p == place], axis=1)
        return out

    def around(self, parameters: Sequence[Parameter], point: Point, step: float) -> tuple[list[Point], list[list[float]]]:
        """The points on both sides of one, a step in each coordinate, and how far they are from it, within the ranges."""
        asked: list[Point] = []
        spans = []
        for p in parameters:
            q = p.coordinate(point.get(p.name, p.value))
            ends = [p.physical(q + step), p.physical(q - step)]
            asked += [dict(point) | {p.name: end} for end in ends]
            spans.append([p.coordinate(ends[0]) - q, q - p.coordinate(ends[1])])
        return asked, spans

    def slopes(self, parameters: Sequence[Parameter], point: Point, recordings: Sequence[int], step: float = 0.3) -> dict[int, np.ndarray]:
        """Derivatives of the data by coordinates of parameters, one typical step each; central where the range allows.

        One-sided where the model runs on one side alone; where it runs on neither, by smaller steps.

        Raises:
            UserError: The model runs at the point, but not even a small step away from it on either side.
        """
        out = {}
        asked, spans = self.around(parameters, point, step)
        with self.memo.during("slopes"):
            predicted = self.memo.predict_several([([point, *asked], n, self.setting) for n in recordings])
        for n, (here, *rows) in zip(recordings, predicted, strict=True):
            columns = [np.empty((len(here), 0))]
            for i, (up, down) in enumerate(spans):
                high, low = (bool(np.isfinite(row).all()) for row in rows[2 * i : 2 * i + 2])
                if not (high or low) and np.isfinite(here).all():
                    if step < LEAST_STEP:
                        p = parameters[i]
                        at = f"{p.name} = {point.get(p.name, p.value):.6g} {p.unit}"
                        raise UserError(f"{self.problem.recordings[n].name} cannot be simulated on either side of {at}: give another value")
                    columns.append(self.slopes([parameters[i]], point, [n], step / 10)[n])
                    continue
                change = (rows[2 * i] if high else here) - (rows[2 * i + 1] if low else here)
                columns.append((change / max(up * high + down * low, 1e-9))[:, None])
            out[n] = np.concatenate(columns, axis=1)
        return out

    def screen(self, point: Point, candidates: Sequence[Candidate], floor: Floor, slopes: Mapping[int, np.ndarray]):
        """Starts of full fits, best first: (predicted share of the misfit that stays, candidate, start, point), and the directions."""
        fits = [p for p in self.parts if p.fitted]
        columns = self.columns(point, candidates, [p.recording for p in fits])
        past = self.past(slopes, floor)
        left = past({p.recording: self.residual(point, p.recording) for p in fits})
        ranked = []
        for c in candidates:
            for i, start in enumerate(c.starts):
                B = past(columns[c.key, i])
                if not np.isfinite(B).all():
                    continue
                amount = -np.linalg.lstsq(B, left, rcond=1e-6)[0]
                sizes = c.size_parameters
                if not c.linear:
                    amount = np.clip(amount, 0.0, 1.5)
                for k, p in enumerate(sizes):
                    if start[p.name] == 0:  # its direction is nothing
                        amount[k] = 0.0
                        continue
                    low, high = (p.lower / start[p.name], p.upper / start[p.name])
                    amount[k] = np.clip(amount[k], min(low, high), max(low, high))
                stays = float(np.sum((left + B @ amount) ** 2) / max(np.sum(left**2), 1e-300))
                if c.linear:
                    factor = np.clip(amount, -4.0, 4.0)
                    factor = np.where(np.abs(factor) < 0.2, np.where(factor < 0, -0.2, 0.2), factor)
                else:
                    factor = np.ones(len(sizes))
                ranked.append((stays, c, i, dict(point) | c.times(start, factor)))
        ranked.sort(key=lambda entry: entry[0])
        return ranked, columns

    def past(self, slopes: Mapping[int, np.ndarray], floor: Floor) -> Callable[[Mapping[int, np.ndarray]], np.ndarray]:
        """What columns of the fitted recordings, {recording: (n,) or (n, k)}, do past the parameters of the slopes, whitened."""
        whiten = floor.whitener(self.parts)

        def rows(of: Mapping[int, np.ndarray]) -> np.ndarray:
            return np.concatenate([whiten(of[n], n) for n in self.fitted_recordings])

        q, _ = np.linalg.qr(rows(slopes))

        def past(columns: Mapping[int, np.ndarray]) -> np.ndarray:
            A = rows(columns)
            return A - q @ (q.T @ A)

        return past
