"""What a diagnosis measures on one problem under one setting: fits, floors, and what is left."""

import functools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np

from neuido.discrepancy.inference.floors import Floor, Part, sealed, split
from neuido.discrepancy.inference.journal import Journal
from neuido.discrepancy.inference.least_squares import Fit, Request, levenberg_marquardt, residuals, run
from neuido.discrepancy.problems import noise as noises
from neuido.discrepancy.problems.problem import Parameter, Point, Problem, Recording
from neuido.discrepancy.store import Budget, Memo

Tell = Callable[[str], None]


class Laboratory:
    """One problem under one setting of its discretisation.

    Args:
        problem: What to diagnose.
        setting: Setting of the discretisation that predicts; the others tell its error.
        tell: Called with a line of progress.
        memo: Predictions that are shared with those of other settings.
        budget: When fits end where they are.
        journal: What was judged, shared too.
        parts: What is fitted and what validates; None: as the roles of the recordings have it.
    """

    def __init__(
        self,
        problem: Problem,
        *,
        setting: int = 0,
        tell: Tell | None = None,
        memo: Memo | None = None,
        budget: Budget | None = None,
        journal: Journal | None = None,
        parts: Sequence[Part] | None = None,
    ) -> None:
        self.journal = journal if journal is not None else Journal()
        self.problem, self.own, self.setting, self.budget = problem, setting, setting, budget or Budget()
        self.tell = tell or (lambda line: None)
        self.memo = memo or Memo(problem)
        self.parts = split(problem) if parts is None else list(parts)
        self.sealed = [Part(n, np.ones(len(problem.recordings[n].y), bool), False, problem.recordings[n].name) for n in sealed(problem)]
        """Recordings that take no part in anything but the test error."""
        self.fitted = [p.fitted for p in self.parts]
        self.scored_recordings = list(dict.fromkeys(p.recording for p in self.parts))
        self.fitted_recordings = list(dict.fromkeys(p.recording for p in self.parts if p.fitted))
        self.as_declared = {p.name: p.value for p in problem.declared}
        """The declared parameters at the values that the model states."""
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

    def request(self, parameters: Sequence[Parameter], start: Point, *, until: float = 1.0, **options: Any) -> Request:
        """A fit, which ends where it is when this share of the search's work is done; options of `levenberg_marquardt`.

        `until`: infinite for a fit that nothing ends early.
        """
        margin = functools.partial(self.problem.margin, setting=self.setting)
        together = self.problem.together
        return levenberg_marquardt(parameters, start, together=together, margin=margin, halt=lambda: self.budget.ends(until), **options)

    def runs(self, point: Point) -> bool:
        """Whether every recording can be predicted there: finite elements tangle where sand flows, and now and then elsewhere."""
        return self.which_run([point])[0]

    def which_run(self, points: Sequence[Point]) -> list[bool]:
        """`runs` of several points, in one launch."""
        rows = self.predicted(points, self.scored_recordings)
        return [all(bool(np.isfinite(of[i]).all()) for of in rows.values()) for i in range(len(points))]

    def residual(self, point: Point, n: int) -> np.ndarray:
        return self.memo.predict([point], n, self.setting)[0] - self.problem.recordings[n].y


def _noise(r: Recording) -> tuple[float, str]:
    """The noise of a recording, and where it comes from."""
    if r.noise:
        return r.noise, r.noise_from
    found = noises.of_series(r.y, r.groups, r.times)
    if found:
        return found, "estimated"
    return max(noises.ASSUMED * noises.moved(r.y, r.groups), 1e-12), "assumed"
