"""What a diagnosis measures on one problem under one setting: fits, floors, and what is left."""

import functools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import replace
from typing import Any

import numpy as np

from neuido.discrepancy.inference import bootstrap
from neuido.discrepancy.inference.bootstrap import NOISE_ALONE
from neuido.discrepancy.inference.floors import Floor, Part, over_time, score, sealed, split
from neuido.discrepancy.inference.journal import Journal
from neuido.discrepancy.inference.least_squares import Fit, Request, levenberg_marquardt, residuals, run
from neuido.discrepancy.problems import noise as noises
from neuido.discrepancy.problems.problem import Parameter, Point, Problem, Recording
from neuido.discrepancy.store import Deadline, Memo

LEAST_GAIN = math.log(1.7)
"""Smaller gains are no reason to name anything: other solvers differ by as much in ways that no setting of one solver shows."""
NEARLY = 2.5
"""Times the noise up to which what first fits leave is refined before another method is asked: it may be noise then."""
ROUGH = 0.02
"""Relative gain that ends a fit which only says where floors are to be found, or what they are."""
UNSEEN = 0.1
"""Largest share of the differences of the settings that lies outside their directions: what a fit weighs the data by, beside the noise."""
ALIKE = 0.3
"""Share of what is left that a quick setting may differ by, so that a search there is for what is left."""

Tell = Callable[[str], None]


class Laboratory:
    """One problem under one setting of its discretisation.

    Args:
        problem: What to diagnose.
        setting: Setting of the discretisation that predicts; the others tell its error.
        tell: Called with a line of progress.
        memo: Predictions that are shared with those of other settings.
        deadline: When fits end where they are.
        journal: What was judged, shared too.
    """

    def __init__(
        self,
        problem: Problem,
        *,
        setting: int = 0,
        tell: Tell | None = None,
        memo: Memo | None = None,
        deadline: Deadline | None = None,
        journal: Journal | None = None,
    ) -> None:
        self.journal = journal if journal is not None else Journal()
        self.problem, self.own, self.setting, self.deadline = problem, setting, setting, deadline or Deadline()
        self.tell = tell or (lambda line: None)
        self.memo = memo or Memo(problem)
        self.parts = split(problem)
        self.sealed = [Part(n, np.ones(len(problem.recordings[n].y), bool), False, problem.recordings[n].name) for n in sealed(problem)]
        """Recordings that take no part in anything but the test error."""
        self.fitted = [p.fitted for p in self.parts]
        self.scored_recordings = list(dict.fromkeys(p.recording for p in self.parts))
        self.fitted_recordings = list(dict.fromkeys(p.recording for p in self.parts if p.fitted))
        self.as_declared = {p.name: p.value for p in problem.declared}
        """The declared parameters at the values that the model states."""
        self.begun: Point | None = None
        """Where the declared model fits the first part of the fitted recordings, if that was asked for."""
        self.still: Point | None = None
        """Where the declared model fits best without a parameter of the problem's own, if it was given one."""
        self.noises = [_noise(r) for r in problem.recordings]
        self.noise_squares = np.array([self.noise_of(p.recording) ** 2 for p in self.parts])
        """Mean squares of the noise of each part."""
        self.unable: dict[int, list[int]] = {}
        """The other settings that do not run where the floor of a recording was last taken."""
        self.scale = problem.error(np.ones(1), 0)
        """What a root mean square of one is as an error of the problem."""

    @contextmanager
    def under(self, setting: int) -> Iterator[None]:
        """While it is open, this setting predicts."""
        before, self.setting = self.setting, setting
        try:
            yield
        finally:
            self.setting = before

    def quickly(self, at: Point | None = None, floor: Floor | None = None) -> AbstractContextManager[None]:
        """While it is open, what moves about as the own setting does, for less, predicts in its place (`Problem.quick`).

        At a point that is given, unless that differs there by as much as is to be explained.
        """
        quick = self.problem.quick(self.own)
        return self.under(quick if at is None or floor is None or self.about_alike(at, floor, quick) else self.own)

    def about_alike(self, point: Point, floor: Floor, setting: int) -> bool:
        """Whether a setting differs from the own one by a small part of what is left, past what the differences of the settings take up."""
        if not self.bears(point, setting):
            return False
        with self.memo.during("discretisation"):
            rows = self.predicted([point], self.fitted_recordings, (self.own, setting))
        off = {n: rows[n, setting][0] - rows[n, self.own][0] for n in self.fitted_recordings}
        if not all(np.isfinite(row).all() for row in off.values()):
            return False
        squares = self.left(off, floor, floor.amounts(off, self.parts))[self.fitted]
        with self.under(self.own):
            (here,) = self.mean_squares([point], floor, fitted=True)
        return score(squares) < score(here) + 2.0 * math.log(ALIKE)

    def bears(self, point: Point, setting: int) -> bool:
        """Whether a setting is the own one, or sure to run at a point in its place."""
        return setting == self.own or self.problem.bears(point, setting)

    def fits(
        self,
        requests: Sequence,
        floor: Floor | Sequence[Floor],
        *,
        to: Sequence[Mapping[int, np.ndarray]] | None = None,
        step: str = "fits",
    ) -> list[Fit]:
        """Run fits side by side, to the data or each to motions in their place; their work counts as that of `step`.

        `floor`: what weighs the residuals, one for all fits or one for each.
        """

        def tick(count: int) -> None:
            self.tell(f"{self.memo.simulations} simulations")

        floors = [floor] * len(requests) if isinstance(floor, Floor) else floor
        whiteners = {id(f): f.whitener(self.parts) for f in floors}
        with self.memo.during(step):
            return run(
                self.memo,
                requests,
                [whiteners[id(f)] for f in floors],
                self.fitted_recordings,
                setting=self.setting,
                data=to,
                tick=tick,
            )

    def costs(self, points: Sequence[Point], floor: Floor) -> list[float]:
        """Sum of squares of the whitened residuals of the fitted parts, without priors; infinite where the model does not run."""
        with self.memo.during("errors of fits"):
            rows = residuals(self.memo, points, floor.whitener(self.parts), self.fitted_recordings, self.setting)
        return [math.inf if row is None else float(row @ row) for row in rows]

    def predicted(
        self, points: Sequence[Point], recordings: Sequence[int], settings: Sequence[int] = ()
    ) -> dict[tuple[int, int], np.ndarray]:
        """What points predict, (len(points), n), by recording and setting, its own if none is named: all of them side by side."""
        of = [(n, s) for n in recordings for s in settings or (self.setting,)]
        return dict(zip(of, self.memo.predict_several([(points, *one) for one in of]), strict=True))

    def mean_squares(self, points: Sequence[Point], floor: Floor, *, fitted: bool = False, plain: bool = False) -> list[np.ndarray]:
        """Of each part, or of the fitted ones alone, at several points, the nuisances at their most probable values.

        So are the amounts of the differences of the settings, as the fitted parts have them (`Floor.amounts`), unless `plain`: what is left
        then is that of one setting alone.
        """
        wanted = self.fitted_recordings if fitted else self.scored_recordings
        with self.memo.during("errors of fits"):
            rows = {n: of - self.problem.recordings[n].y for (n, _), of in self.predicted(points, wanted).items()}
        found = []
        for i in range(len(points)):
            own = {n: rows[n][i] for n in wanted if np.isfinite(rows[n][i]).all()}
            amounts = None
            if not plain and all(n in own for n in self.fitted_recordings):
                amounts = floor.amounts(own, self.parts)
            found.append(self.left(own, floor, amounts))
        return [squares[self.fitted] if fitted else squares for squares in found]

    def left(self, residuals: Mapping[int, np.ndarray], floor: Floor, amounts: np.ndarray | None) -> np.ndarray:
        """Mean squares of the parts of settled residuals (n,) by recording; infinite for a recording that is not there."""
        return np.array([
            np.mean(floor.settle(residuals[p.recording], p, amounts)[p.rows] ** 2) if p.recording in residuals else np.inf
            for p in self.parts
        ])  # fmt: skip

    def amounts(self, point: Point, floor: Floor) -> np.ndarray:
        """How much of each difference of the settings the fitted recordings hold there, (k,); see `Floor.amounts`."""
        rows = {n: self.residual(point, n) for n in self.fitted_recordings}
        return floor.amounts(rows, self.parts) if all(np.isfinite(row).all() for row in rows.values()) else np.zeros(0)

    def recentred(self, point: Point, floor: Floor) -> Point:
        """The point where its own amounts of the differences lead, as far as the problem has a parameter for that."""
        amounts = self.amounts(point, floor)
        return self.problem.recentred(point, self.setting, amounts) if len(amounts) else point

    def noise(self, of: Sequence[int] | None = None) -> Floor:
        """The floor without any discretisation error, of the recordings that are scored, or of those that are named."""
        noise = {n: self.noise_of(n) for n in of or self.scored_recordings}
        ones = {n: np.ones(len(self.problem.recordings[n].y)) for n in noise}
        return Floor(
            noise,
            {n: ones[n] / noise[n] for n in noise},
            {n: np.empty((len(ones[n]), 0)) for n in noise},
            {n: 0.0 * ones[n] for n in noise},
        )

    def noise_of(self, n: int) -> float:
        """Standard deviation of the noise of a recording: what is stated, or found in the data, or assumed (`noise_from`)."""
        return self.noises[n][0]

    def noise_uncertainty(self, n: int) -> float:
        """Relative standard deviation of that noise; zero for one that is stated."""
        count = max(len(self.problem.recordings[n].y), 1)
        return {"stated": 0.0, "estimated": math.sqrt(noises.OVERLAP / count), "assumed": noises.UNSURE}[self.noise_from(n)]

    def noise_from(self, n: int) -> str:
        """Where that comes from: `stated`, `estimated` or `assumed`."""
        return self.noises[n][1]

    def floor(self, point: Point, *, like: Floor | None = None, fitted: bool = False, of: Sequence[int] | None = None) -> Floor:
        """Noise and discretisation at a point: differences of the settings, and how large they are in the course of time.

        `like`: a floor whose nuisances serve here too. `fitted`: the differences of the fitted recordings alone, which is what fits read.
        `of`: the recordings, where these are not all that are scored. A setting that does not run there has a column of zeros, and is noted
        in `unable`.
        """
        plain = self.noise(of)
        others = self.problem.others(self.setting)
        if not others:
            return replace(plain, nuisances=self.nuisances(point, list(plain.noise)))
        wanted = self.fitted_recordings if fitted else list(plain.noise)
        with self.memo.during("discretisation"):
            rows = self.predicted([point], wanted, (self.setting, *others))
        differences, spread = {}, {}
        for n in wanted:
            here, *there = (rows[n, s][0] for s in (self.setting, *others))
            able = [bool(np.isfinite(t).all()) for t in there]
            self.unable[n] = [s for s, ok in zip(others, able, strict=True) if not ok]
            D = np.stack([t - here if ok else np.zeros_like(here) for t, ok in zip(there, able, strict=True)], axis=1)
            differences[n] = D
            spread[n] = over_time(np.sqrt(np.sum(D**2, axis=1) / max(sum(able), 1)), self.problem.recordings[n].times)
            self.tell(f"discretisation of {self.problem.recordings[n].name}")
        nuisances = self.nuisances(point, list(plain.noise)) if like is None else like.nuisances
        weight = {n: plain.weight[n] for n in wanted}
        return Floor(plain.noise, weight, differences, spread, nuisances).weighed(UNSEEN)

    def sharpened(self, floor: Floor, errors: np.ndarray) -> Floor:
        """The floor for fits about where `errors`, mean squares of all parts, are left: no more than that is unseen."""
        if self.problem.settings == 1 or not np.isfinite(errors[self.fitted]).all():
            return floor
        spread = np.mean(floor.spread_squares([p for p in self.parts if p.fitted]))
        above = max(float(np.mean((errors - self.noise_squares)[self.fitted])), 0.0)
        return floor.weighed(min(UNSEEN, math.sqrt(above / max(float(spread), 1e-300))))

    def foresee(self, points: Sequence[Point], *, fitted: bool = False) -> None:
        """Run what `floor` and `stand` of several points will ask for, in one launch; the memo keeps it."""
        with self.memo.during("discretisation"):
            wanted = self.fitted_recordings if fitted else self.scored_recordings
            self.predicted(points, wanted, [self.setting, *self.problem.others(self.setting)])

    def stand(self, point: Point, *, like: Floor | None = None, fitted: bool = False) -> tuple[Floor, np.ndarray]:
        """The floor at a point, sharpened by what is left there, and what that is, mean squares of the parts.

        `like` and `fitted` as for `floor`; infinite for parts that were not asked for.
        """
        floor = self.floor(point, like=like, fitted=fitted)
        errors = np.full(len(self.parts), np.inf)
        errors[np.array(self.fitted) | (not fitted)] = self.mean_squares([point], floor, fitted=fitted)[0]
        return self.sharpened(floor, errors), errors

    def request(self, parameters: Sequence[Parameter], start: Point, *, until: float = 1.0, **options: Any) -> Request:
        """A fit, which ends where it is when this share of the time for the search is over; options of `levenberg_marquardt`.

        `until`: infinite for a fit that the clock never ends.
        """
        margin = functools.partial(self.problem.margin, setting=self.setting)
        together = self.problem.together
        return levenberg_marquardt(parameters, start, together=together, margin=margin, halt=lambda: self.deadline.ends(until), **options)

    def runs(self, point: Point) -> bool:
        """Whether every recording can be predicted there: finite elements tangle where sand flows, and now and then elsewhere."""
        return self.which_run([point])[0]

    def which_run(self, points: Sequence[Point]) -> list[bool]:
        """`runs` of several points, in one launch."""
        rows = self.predicted(points, self.scored_recordings)
        return [all(bool(np.isfinite(of[i]).all()) for of in rows.values()) for i in range(len(points))]

    def moved(self, point: Point) -> float:
        """The largest ratio of a declared parameter to the value that the model states, or of this to that."""
        ratios = [point[p.name] / p.value for p in self.problem.declared if p.log]
        return max((max(r, 1.0 / r) for r in ratios), default=1.0)

    def tell_lead(self, key: str, squares: np.ndarray, before: np.ndarray) -> None:
        """Tell which candidate leads and what it leaves, where progress shows that."""
        lead = getattr(self.tell, "lead", None)
        if lead is not None:
            lead(key, self.typical(squares), self.typical(before), self.problem.unit)

    def typical(self, squares: np.ndarray) -> float:
        """The geometric mean over the parts of root mean squares, in the unit of the data."""
        return self.scale * math.exp(0.5 * score(squares))

    def is_noise(self, errors: np.ndarray, *, fitted: bool = False) -> bool:
        """Whether nothing but noise is left in any part, or in those of the fitted ones that are given."""
        return bool(np.all(errors < NOISE_ALONE * (self.noise_squares[self.fitted] if fitted else self.noise_squares)))

    def may_be_noise(self, errors: np.ndarray) -> bool:
        """Whether what a fit leaves in any part is so near the noise that it may be that once it is refined."""
        return self.is_noise(errors / NEARLY**2)

    def is_settled(self, errors: np.ndarray) -> bool:
        """Whether no effect could be named any more: nothing is left but noise, or too little above it for any gain to be enough."""
        hopeless = self.problem.settings > 1 and self.gain(errors, self.noise_squares) < LEAST_GAIN
        return hopeless or self.is_noise(errors)

    def gain(self, before: np.ndarray, after: np.ndarray) -> float:
        """`bootstrap.gain` of mean squares of the parts."""
        return bootstrap.gain(before, after, self.fitted, self.noise_squares)

    def foretold(self, before: np.ndarray, after: np.ndarray) -> float:
        """Logarithm of the ratio of errors of what is held out, or of all parts where nothing is; of mean squares of the parts."""
        fitted = np.array(self.fitted)
        return bootstrap.ratio(before, after, fitted if fitted.all() else ~fitted)

    def fitted_score(self, errors: np.ndarray) -> float:
        """Score of what is left of the fitted parts, of mean squares of all."""
        return score(errors[self.fitted])

    def residual(self, point: Point, n: int) -> np.ndarray:
        return self.memo.predict([point], n, self.setting)[0] - self.problem.recordings[n].y

    def refits(self, point: Point, free: Sequence[Parameter], floor: Floor) -> list[tuple[Fit, np.ndarray]]:
        """The motions under the other settings fitted as if they had been measured: the fits, and what they leave.

        Each without its own difference. Most of what a grid or a step does a stiffness, or the difference of another grid, can do as well:
        how far a fit goes from `point` is the discretisation error of the parameters, and what it leaves, mean squares of the parts, the
        one that an effect could be mistaken for. The clock ends none of them: one that stops at once leaves the whole difference
        of the settings, and any residual lies within that.
        """
        others = self.problem.others(self.setting)
        with self.memo.during("discretisation"):
            rows = self.predicted([point], list(floor.noise), others)
            made = {s: {n: rows[n, s][0] for n in floor.noise} for s in others}
        made = {s: y for s, y in made.items() if all(np.isfinite(row).all() for row in y.values())}
        floors = [floor.without(others.index(s)) for s in made]
        requests = [self.request(free, point, until=math.inf, iterations=8, tolerance=ROUGH) for _ in made]
        fits = self.fits(requests, floors, to=list(made.values()), step="discretisation")
        with self.memo.during("discretisation"):
            rows = self.predicted([fit.point for fit in fits], list(floor.noise))
        out = []
        for i, (fit, own, y) in enumerate(zip(fits, floors, made.values(), strict=True)):
            left = {n: rows[n, self.setting][i] - y[n] for n in y}
            out.append((fit, self.left(left, own, own.amounts(left, self.parts))))
        return out

    def floors(self, point: Point, free: Sequence[Parameter], floor: Floor) -> np.ndarray:
        """Noise, and what a refit leaves of the discretisation error, together as mean squares of the parts."""
        left = [squares for _, squares in self.refits(point, free, floor)]
        return self.noise_squares + np.nanmean(left, axis=0) if left else self.noise_squares

    def nuisances(self, point: Point, recordings: Sequence[int]) -> dict[int, np.ndarray]:
        """Directions of the nuisances of each recording, of one prior standard deviation, as a quick motion has them where it runs."""
        asks = {}
        for n in recordings:
            own = [
                (p, p.prior)
                for p in self.problem.nuisances
                if p.prior is not None and p.name.endswith(f":{self.problem.recordings[n].name}")
            ]
            asks[n] = [point, *({**point, p.name: p.physical(p.coordinate(point.get(p.name, p.value)) + prior)} for p, prior in own)]
        quick, predicted = self.problem.quick(self.own), {}
        for setting in dict.fromkeys((quick, self.own) if self.bears(point, quick) else (self.own,)):
            wanted = [n for n in recordings if n not in predicted or not np.isfinite(predicted[n][0]).all()]
            with self.memo.during("nuisances"):
                predicted |= dict(zip(wanted, self.memo.predict_several([(asks[n], n, setting) for n in wanted]), strict=True))
        out = {}
        for n, (here, *rows) in predicted.items():
            columns = [np.where(np.isfinite(row - here).all(), row - here, 0.0) for row in rows]
            out[n] = np.stack(columns, axis=1) if columns else np.empty((len(here), 0))
        return out


def _noise(r: Recording) -> tuple[float, str]:
    """The noise of a recording, and where it comes from."""
    if r.noise:
        return r.noise, r.noise_from
    found = noises.of_series(r.y, r.groups, r.times)
    if found:
        return found, "estimated"
    return max(noises.ASSUMED * noises.moved(r.y, r.groups), 1e-12), "assumed"
