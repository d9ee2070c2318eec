"""A body whose clamps move as measured, or whose force on a clamp was measured, as a `Problem`.

The path of a clamp is prescribed. The data are the tracked points and the force of each clamp along each measured axis, as means between
frames: that is what the momentum that a clamp takes in a simulation gives. A force is multiplied by the ratio of the noise of a position to
that of a force, so that all data have the noise of a position.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, NamedTuple

import numpy as np

from neuido.data.measured.clamps import MeasuredForce
from neuido.data.measured.experiment import Experiment
from neuido.data.measured.experiment import Recording as Measured
from neuido.discrepancy.problems import noise
from neuido.discrepancy.problems.body import WINDOWS, BodyProblem, Run, body_problem
from neuido.discrepancy.problems.body_launches import PATH_SCALE, Pushes
from neuido.discrepancy.problems.problem import Parameter, Point, Recording
from neuido.discrepancy.problems.rollouts import Motions
from neuido.discrepancy.problems.settings import SETTINGS
from neuido.errors import UserError

CALIBRATION = 0.01
"""Prior standard deviation of the scale of a load cell, and of its zero relative to the largest force: class 1 of ISO 7500-1."""
LEAST = 1e-3
"""Least noise of a force, relative to the largest one: a load cell of class 1 resolves about that."""
ASSUMED = 0.01
"""Noise of a force whose values are too few to estimate it, relative to the largest one."""
PATH_ERROR = 0.003
"""Prior standard deviation of the scale of a path, as that of the length scale of tracked points."""
AXES = "xyz"


class ForceSeries(NamedTuple):
    """The force of one clamp along one axis in a recording."""

    clamp: str
    axis: int
    edges: np.ndarray
    """Times between which means are compared [s], (m + 1,)."""
    values: np.ndarray
    """Mean force on the body [N], (m,)."""
    noise: float
    """Standard deviation of the noise of a mean [N]."""
    stated: bool

    @property
    def name(self) -> str:
        """Name in the report."""
        return f"{self.clamp}_{AXES[self.axis]}"

    @property
    def largest(self) -> float:
        """Largest force [N]."""
        return max(float(np.abs(self.values).max()), 1e-12)

    def predicted(self, pushes: Pushes, clamp: int) -> np.ndarray:
        """Return the mean forces [N], (S, m), of simulations.

        Args:
            pushes: Their impulses.
            clamp: Number of the clamp.
        """
        rows = [np.interp(self.edges, pushes.t, own[:, clamp, self.axis]) for own in pushes.impulse]
        return np.diff(np.stack(rows), axis=1) / np.diff(self.edges)


@dataclass(frozen=True, eq=False)
class ClampedProblem(BodyProblem):
    """An experiment with clamps that move or have a measured force."""

    series: tuple[tuple[ForceSeries, ...], ...] = ()
    """The forces of each recording."""
    scales: tuple[float, ...] = ()
    """Noise of a position [m] of each recording."""

    def coordinates(self, recording: int) -> int:
        """Return how many of the data are coordinates of points; forces follow."""
        return 3 * int(self.measured[recording].seen[1:].sum())

    def directions(self, recording: int) -> np.ndarray:
        """Return `BodyProblem.directions`, and bumps in time of each force."""
        of_points = super().directions(recording)
        blocks = [of_points, *(_bumps(own) for own in self.series[recording])]
        out = np.zeros((sum(len(b) for b in blocks), sum(b.shape[1] for b in blocks)))
        row = column = 0
        for block in blocks:
            out[row : row + len(block), column : column + block.shape[1]] = block
            row, column = row + len(block), column + block.shape[1]
        return out

    def simulated(self, recording: int) -> Measured:
        """Return the recording with the points and forces that the declared model predicts, without noise."""
        out = super().simulated(recording)
        clamps = []
        for clamp in out.clamps:
            own = [(s, f) for s, f in zip(self.series[recording], self.forces({}, recording)) if s.clamp == clamp.name]
            if own:
                middle = (own[0][0].edges[1:] + own[0][0].edges[:-1]) / 2
                values = np.full((len(middle), 3), np.nan)
                for series, force in own:
                    values[:, series.axis] = np.interp(middle, (series.edges[1:] + series.edges[:-1]) / 2, force)
                clamp = replace(clamp, force=MeasuredForce(middle, values))
            clamps.append(clamp)
        return replace(out, clamps=tuple(clamps))

    def forces(self, point: Point, recording: int, setting: int = 0) -> list[np.ndarray]:
        """Predict the mean forces [N] of each series, (m,) each, with the errors of the load cells at a point."""
        ((_, _, pushes),) = self._simulate([([point], recording)], setting)
        return [own[0] for own in self._read(point, recording, pushes)]

    def pictured(self, points: dict[str, Point], recording: int, setting: int = 0) -> dict[str, np.ndarray]:
        """Return measured and predicted forces for pictures: `force_times` (m,) [s], `force_measured` and `force_<name>` (m, B) [N]."""
        series = self.series[recording]
        if not series:
            return {}
        middles = [(own.edges[1:] + own.edges[:-1]) / 2 for own in series]
        t = max(middles, key=len)

        def columns(values: Sequence[np.ndarray]) -> np.ndarray:
            return np.stack([np.interp(t, at, own, left=np.nan, right=np.nan) for at, own in zip(middles, values, strict=True)], axis=1)

        out = {"force_times": t, "force_measured": columns([own.values for own in series])}
        return out | {f"force_{name}": columns(self.forces(point, recording, setting)) for name, point in points.items()}

    def _simulate(self, runs: Sequence[Motions], setting: int) -> list[tuple[np.ndarray, np.ndarray, Pushes]]:
        pushed: list[Pushes] = []
        moved = self._tracked_motion(runs, setting, pushed)
        return [(x, v, own) for (x, v), own in zip(moved, pushed, strict=True)]

    def _fill(self, run: Run, moved: Any) -> None:
        xs, vs, pushes = moved
        super()._fill(run._replace(out=run.out[:, : self.coordinates(run.recording)]), (xs, vs))
        for k, group in enumerate(run.groups):
            own = Pushes(pushes.t, pushes.impulse[k : k + 1])
            for i in group:
                read = self._read(run.points[i], run.recording, own)
                scaled = [self.scales[run.recording] / s.noise * f[0] for s, f in zip(self.series[run.recording], read, strict=True)]
                run.out[i, self.coordinates(run.recording) :] = np.concatenate(scaled) if scaled else []
                if np.isnan(run.out[i]).any():
                    run.out[i] = np.nan

    def _read(self, point: Point, recording: int, pushes: Pushes) -> list[np.ndarray]:
        """Return the mean forces that the load cells read, (S, m) each."""
        r = self.measured[recording]
        numbers = {clamp.name: i for i, clamp in enumerate(r.clamps)}
        out = []
        for own in self.series[recording]:
            scale = point.get(f"force_scale_{own.clamp}:{r.name}", 0.0)
            zero = point.get(f"force_zero_{own.name}:{r.name}", 0.0)
            out.append((1 + scale) * own.predicted(pushes, numbers[own.clamp]) + zero)
        return out


def clamped_problem(experiment: Experiment, *, device: str = "cpu", batch: int = 0) -> ClampedProblem:
    """Build the problem of an experiment with clamps that have a name.

    Finite elements do not move clamps: the settings are those of material points.

    Raises:
        UserError: As `body_problem`, or a recording whose points are too few to estimate their noise.
    """
    base = body_problem(experiment, device=device, batch=batch)
    made, every, scales, nuisances, kinds = [], [], [], list(base.nuisances), list(base.instruments)
    for r, own in zip(base.measured, base.recordings, strict=True):
        sigma = own.noise or noise.of_series(own.y, own.groups, own.times)
        if not sigma:
            raise UserError(f"recording {r.name}: its frames are too few to estimate the noise of a position: give `noise` [m]")
        series = [s for clamp in r.clamps if clamp.force is not None for s in _series(r, clamp.name, clamp.force)]
        made.append(_joined(own, series, sigma))
        every.append(tuple(series))
        scales.append(sigma)
        for s in series:
            zero = CALIBRATION * s.largest
            nuisances.append(Parameter(f"force_zero_{s.name}:{r.name}", "N", 0.0, zero, -8 * zero, 8 * zero, prior=1.0))
        for clamp in dict.fromkeys(s.clamp for s in series):
            bounds = -8 * CALIBRATION, 8 * CALIBRATION
            nuisances.append(Parameter(f"force_scale_{clamp}:{r.name}", "1", 0.0, CALIBRATION, *bounds, prior=1.0))
        if any(clamp.motion is not None for clamp in r.clamps):
            bounds = -8 * PATH_ERROR, 8 * PATH_ERROR
            nuisances.append(Parameter(f"{PATH_SCALE}:{r.name}", "1", 0.0, PATH_ERROR, *bounds, prior=1.0))
        kinds += [f"force_zero_{s.name}" for s in series] + [f"force_scale_{s.clamp}" for s in series]
    given = {f.name: getattr(base, f.name) for f in fields(base) if f.init}
    able = sum(s.solver == "material_points" for s in SETTINGS)  # these settings are the first ones
    given |= {"recordings": tuple(made), "nuisances": tuple(nuisances), "instruments": tuple(dict.fromkeys(kinds))}
    return ClampedProblem(**(given | {"settings": able, "solvers": (0,)}), series=tuple(every), scales=tuple(scales))


def _series(r: Measured, clamp: str, force: MeasuredForce) -> list[ForceSeries]:
    """Return the force of a clamp along each measured axis, as means over one or more frame intervals with a value in each."""
    assert r.t is not None
    out = []
    for axis in range(3):
        if not np.isfinite(force.values[:, axis]).any():
            continue
        t = force.t[np.isfinite(force.values[:, axis])]
        edges = [float(r.t[0])]
        for at in r.t.numpy()[1:]:
            if ((t >= edges[-1]) & (t < at)).any() and edges[-1] >= t[0] - 1e-9 and at <= t[-1] + 1e-9:
                edges.append(float(at))
            elif edges[-1] < t[0] - 1e-9:
                edges[-1] = float(at)  # the load cell started later
        if len(edges) < 3:
            raise UserError(f"recording {r.name}: the force of clamp {clamp} has values in fewer than two frame intervals: leave it out")
        at = np.array(edges)
        means, counts = force.means(at)
        values, count = means[:, axis], max(float(np.median(counts[:, axis])), 1.0)
        largest = max(float(np.abs(values).max()), 1e-12)
        if force.noise is not None:
            sigma = force.noise / count**0.5
        else:
            found = noise.high_pass([(at[1:], values)])
            sigma = max(ASSUMED if found is None else found / largest, LEAST) * largest
        out.append(ForceSeries(clamp, axis, at, values, sigma, force.noise is not None))
    return out


def _joined(own: Recording, series: Sequence[ForceSeries], sigma: float) -> Recording:
    """Return a recording of points with the forces behind them, in the unit of the points."""
    first = int(own.groups.max(initial=-1)) + 1
    y = [own.y, *(sigma / s.noise * s.values for s in series)]
    groups = [own.groups, *(np.full(len(s.values), first + i) for i, s in enumerate(series))]
    times = [own.times, *(s.edges[1:] for s in series)]
    return replace(own, y=np.concatenate(y), groups=np.concatenate(groups), times=np.concatenate(times))


def _bumps(series: ForceSeries) -> np.ndarray:
    """Return windows of time (m, k) of one force; the squares of a row add up to one, in the mean."""
    t = series.edges[1:]
    knots = np.linspace(t[0], t[-1], WINDOWS)
    out = np.maximum(0.0, 1.0 - np.abs(t[:, None] - knots) / (knots[1] - knots[0]))
    return out / np.sqrt(np.mean(np.sum(out**2, axis=1)))
