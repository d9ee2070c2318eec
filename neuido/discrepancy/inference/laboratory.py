"""Predictions, fits and errors of one problem under one setting of its discretisation."""

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
    """Predicts, fits and computes errors for one problem under one setting of its discretisation.

    Args:
        problem: The model and its data.
        setting: Number of the setting that predicts; the other settings serve to estimate its error.
        tell: Called with a line of progress.
        memo: Cache of predictions, shared by the methods of a diagnosis.
        budget: Decides when fits must stop early.
        journal: Records, shared by the methods of a diagnosis.
        parts: Parts of the data; by default those of `split`.
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
        """Recordings that serve for the test error alone."""
        self.fitted = [p.fitted for p in self.parts]
        self.scored_recordings = list(dict.fromkeys(p.recording for p in self.parts))
        self.fitted_recordings = list(dict.fromkeys(p.recording for p in self.parts if p.fitted))
        self.as_declared = {p.name: p.value for p in problem.declared}
        """The declared values of the declared parameters, by name."""
        self.noises = [_noise(r) for r in problem.recordings]
        self.noise_squares = np.array([self.noise_of(p.recording) ** 2 for p in self.parts])
        """Mean square of the noise of each part, (parts,)."""
        self.unable: dict[int, list[int]] = {}
        """By recording, the other settings that did not run where its floor was computed last."""
        self.scale = problem.error(np.ones(1), 0)
        """Factor from a root mean square of the data to an error in the unit of the problem."""

    @contextmanager
    def under(self, setting: int) -> Iterator[None]:
        """Predict under another setting while the context is open."""
        before, self.setting = self.setting, setting
        try:
            yield
        finally:
            self.setting = before

    @contextmanager
    def early(self, share: float) -> Iterator[None]:
        """Predict no more than this share of the time while the context is open, where that is cheaper (`Problem.early`)."""
        with self.under(self.problem.early(self.setting, share)):
            yield

    def bears(self, point: Point, setting: int) -> bool:
        """Return whether a setting is sure to run at a point: it is the suggested one, or `Problem.bears` says so."""
        return setting == self.own or self.problem.bears(point, setting)

    def fits(
        self,
        requests: Sequence,
        floor: Floor | Sequence[Floor],
        *,
        to: Sequence[Mapping[int, np.ndarray]] | None = None,
        step: str = "fits",
    ) -> list[Fit]:
        """Run fits together, so that they share their launches.

        Args:
            requests: The fits, from `request`.
            floor: Gives the weights of the residuals; one for all fits, or one for each.
            to: Data of each fit by recording, (n,); by default the recordings themselves.
            step: Name of the step of the search that this work is counted under.
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
        """Return the sum of squares of the whitened residuals of the fitted parts at each point, without priors.

        It is infinite if the model does not run there.
        """
        with self.memo.during("errors of fits"):
            rows = residuals(self.memo, points, floor.whitener(self.parts), self.fitted_recordings, self.setting)
        return [math.inf if row is None else float(row @ row) for row in rows]

    def predicted(
        self, points: Sequence[Point], recordings: Sequence[int], settings: Sequence[int] = ()
    ) -> dict[tuple[int, int], np.ndarray]:
        """Predict recordings at several points, in one launch.

        Args:
            points: Parameter values.
            recordings: Numbers of the recordings.
            settings: Numbers of the settings; by default the one in use.

        Returns:
            (recording, setting) -> predictions (len(points), n), not finite if the model does not run.
        """
        pairs = [(n, s) for n in recordings for s in settings or (self.setting,)]
        return dict(zip(pairs, self.memo.predict_several([(points, *pair) for pair in pairs]), strict=True))

    def mean_squares(self, points: Sequence[Point], floor: Floor, *, fitted: bool = False, plain: bool = False) -> list[np.ndarray]:
        """Return the mean square of the residual of each part at each point, after the most probable nuisances are subtracted.

        The differences between settings are subtracted too, in the amounts of the fitted parts (`Floor.amounts`).

        Args:
            points: Parameter values.
            floor: Gives nuisances and differences.
            fitted: Whether to return the fitted parts alone.
            plain: Whether to leave the differences between settings in, which gives the error of one setting alone.

        Returns:
            An array (parts,) for each point, infinite for a recording that does not run.
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
        """Return the mean square of each part, (parts,), of residuals (n,) after `Floor.settle`; infinite for a recording without one."""
        return np.array([
            np.mean(floor.settle(residuals[p.recording], p, amounts)[p.rows] ** 2) if p.recording in residuals else np.inf
            for p in self.parts
        ])  # fmt: skip

    def amounts(self, point: Point, floor: Floor) -> np.ndarray:
        """Estimate the amount of each difference between settings at a point, (k,), as in `Floor.amounts`; empty if it does not run."""
        rows = {n: self.residual(point, n) for n in self.fitted_recordings}
        return floor.amounts(rows, self.parts) if all(np.isfinite(row).all() for row in rows.values()) else np.zeros(0)

    def recentred(self, point: Point, floor: Floor) -> Point:
        """Move a point by its amounts of the differences between settings, if a parameter can take them over (`Problem.recentred`)."""
        amounts = self.amounts(point, floor)
        return self.problem.recentred(point, self.setting, amounts) if len(amounts) else point

    def noise(self, of: Sequence[int] | None = None) -> Floor:
        """Return a floor of noise alone, without discretisation error, of all scored recordings or of those in `of`."""
        noise = {n: self.noise_of(n) for n in of or self.scored_recordings}
        ones = {n: np.ones(len(self.problem.recordings[n].y)) for n in noise}
        return Floor(
            noise,
            {n: ones[n] / noise[n] for n in noise},
            {n: np.empty((len(ones[n]), 0)) for n in noise},
            {n: 0.0 * ones[n] for n in noise},
        )

    def noise_of(self, n: int) -> float:
        """Return the standard deviation of the noise of a recording; `noise_from` says where it comes from."""
        return self.noises[n][0]

    def noise_squares_with(self, point: Point) -> np.ndarray:
        """Return the mean square of what noise and nuisances leave of each part where the model at a point is right, (parts,)."""
        own = {p.recording: self.problem.noise_with(point, p.recording) or 0.0 for p in self.parts}
        return np.maximum(self.noise_squares, [own[p.recording] ** 2 for p in self.parts])

    def noise_uncertainty(self, n: int) -> float:
        """Return the relative standard deviation of `noise_of`; zero for a stated noise."""
        count = max(len(self.problem.recordings[n].y), 1)
        return {"stated": 0.0, "estimated": math.sqrt(noises.OVERLAP / count), "assumed": noises.UNSURE}[self.noise_from(n)]

    def noise_from(self, n: int) -> str:
        """Return where the noise of a recording comes from: `stated`, `estimated` or `assumed`."""
        return self.noises[n][1]

    def request(self, parameters: Sequence[Parameter], start: Point, *, until: float = 1.0, **options: Any) -> Request:
        """Prepare a fit for `fits`.

        Args:
            parameters: Parameters to fit.
            start: Point to start from.
            until: Share of the work of the search after which the fit stops early; infinite: it never does.
            options: Further options of `levenberg_marquardt`.
        """
        margin = functools.partial(self.problem.margin, setting=self.setting)
        together = self.problem.together
        return levenberg_marquardt(parameters, start, together=together, margin=margin, halt=lambda: self.budget.ends(until), **options)

    def runs(self, point: Point) -> bool:
        """Return whether the model runs at a point for every scored recording; finite elements fail if they tangle, as in flowing sand."""
        return self.which_run([point])[0]

    def which_run(self, points: Sequence[Point]) -> list[bool]:
        """Return `runs` of each of several points, by one launch."""
        rows = self.predicted(points, self.scored_recordings)
        return [all(bool(np.isfinite(of[i]).all()) for of in rows.values()) for i in range(len(points))]

    def residual(self, point: Point, n: int) -> np.ndarray:
        """Return predicted minus measured of a recording at a point, (n,)."""
        return self.memo.predict([point], n, self.setting)[0] - self.problem.recordings[n].y


def _noise(r: Recording) -> tuple[float, str]:
    """Return the standard deviation of the noise of a recording, and where it comes from (`Laboratory.noise_from`)."""
    if r.noise:
        return r.noise, r.noise_from
    estimate = noises.of_series(r.y, r.groups, r.times)
    if estimate:
        return estimate, "estimated"
    return max(noises.ASSUMED * noises.moved(r.y, r.groups), 1e-12), "assumed"
