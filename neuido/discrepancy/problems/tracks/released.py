"""The nuisances of a track (start of the motion, clock, length scale, spin, attitude), and their estimate from its first frames."""

from collections.abc import Mapping

import numpy as np

from neuido.data.measured.track import AXES
from neuido.discrepancy.problems.noise import SeriesError
from neuido.discrepancy.problems.problem import Parameter
from neuido.discrepancy.problems.tracks.guides import Guide
from neuido.physics.points.point_kernels import WIDTHS
from neuido.physics.points.point_mass import Forces, fly

LARGEST_ERROR = 2.0
"""Largest error of a clock or length scale, in standard deviations of its prior."""
FARTHEST = 5.0
"""Largest error of a spin or an attitude, in standard deviations of its prior."""
ITERATIONS = 25
"""Largest number of steps of the least-squares fit."""
PROBE = 1e-3
"""Step of the finite differences, in units of `Parameter.scale`."""
CONVERGED = 1e-4
"""Step at which the fit has converged, in units of `Parameter.scale`."""
LONGEST, LEAST_STEPS = 0.05, 60
"""Largest time step of the integration [s], and least number of steps per recording."""
BLOCK = 1000
"""Samples whose slow tracking errors are correlated at the most; longer series are divided, which bounds the memory."""


class Released:
    """One recording of a body that is held until its release and then moves, with the errors of its instruments.

    Its parameters are those of its guide (in free flight position [m] and velocity [m/s] along each measured axis), then `release_time`
    [s], `length_scale` [-] and `time_base` [-] where the folder gives them a standard deviation, and the deviations of spin and attitude
    where an effect depends on them. Each name is followed by a colon and the name of the recording. A time t in the file is the true time
    (1 + time_base) t. A displacement from the place of release is measured (1 + length_scale) times too large.

    Args:
        guide: The guide of the recording.
        nuisances: Standard deviation of the nuisances; 0: without error.
        error: Error of the tracked positions, in the unit of the data.
        period: Shortest period of the declared model [s]; infinite where nothing swings.
        spin: Axes along which a spin shows.
        attitude: Axes along which the attitude of a disc may be tilted.
    """

    def __init__(
        self,
        guide: Guide,
        nuisances: Mapping[str, float],
        error: SeriesError,
        *,
        period: float = np.inf,
        spin: tuple[int, ...] = (),
        attitude: tuple[int, ...] = (),
    ) -> None:
        self.guide, self.track, self.error = guide, guide.track, error
        out, track = guide.parameters(), guide.track
        for name, unit in (("release_time", "s"), ("length_scale", "1"), ("time_base", "1")):
            sd = nuisances[name]
            if sd > 0 and not (name == "length_scale" and track.angle):
                out.append(Parameter(f"{name}:{track.name}", unit, 0.0, sd / 4, -LARGEST_ERROR * sd, LARGEST_ERROR * sd, prior=4.0))
        for name, axes, sd in (
            ("spin", spin if track.spin is not None else (), nuisances["spin"]),
            ("attitude", attitude, nuisances["attitude"]),
        ):
            for a in axes if sd > 0 else ():
                limit = FARTHEST * sd
                out.append(Parameter(f"{name}_{AXES[a]}:{track.name}", "1", 0.0, sd / 4, -limit, limit, prior=4.0))
        self.parameters: tuple[Parameter, ...] = tuple(out)
        self.names = [p.name.partition(":")[0] for p in out]
        self.step = min(LONGEST, float(np.ptp(track.t)) / LEAST_STEPS, period / LEAST_STEPS)
        self._factors: dict[int, list[np.ndarray]] = {}

    def seen(self, values: np.ndarray, forces: Forces, t: np.ndarray) -> np.ndarray:
        """Predict the measured coordinates, (P, n, A) for A axes, at times t (n,) [s] for P rows of parameters (P, k)."""
        count = len(values)
        own = dict(zip(self.names, values.T, strict=True))
        if forces.pendulum is not None:
            own["length"] = np.broadcast_to(np.asarray(forces.pendulum, dtype=np.float64), (count, 2))[:, 1]
        x, v = self.guide.begin(own)
        zero = np.zeros(count)
        times = (1 + own.get("time_base", zero))[:, None] * t
        moved = fly(times, x, v, own.get("release_time", zero), self.turned(forces, own, count), step=self.step)
        if "length_scale" not in own:
            return self.guide.seen(moved, own)
        first = self.guide.seen(x[:, None], own)
        return first + (1 + own["length_scale"])[:, None, None] * (self.guide.seen(moved, own) - first)

    def turned(self, forces: Forces, own: Mapping[str, np.ndarray], count: int) -> Forces:
        """Return the forces with the spin and the attitude of this recording."""
        off = {name: np.zeros((count, 3)) for name in ("spin", "attitude")}
        for name, rows in off.items():
            for i, a in enumerate(AXES):
                rows[:, i] = own.get(f"{name}_{a}", 0.0)
        changed = {}
        for name in ("magnus", "surface_velocity"):
            value = getattr(forces, name)
            if value is not None and off["spin"].any():
                value = np.broadcast_to(np.asarray(value, dtype=np.float64), (count, 3))
                changed[name] = value + np.linalg.norm(value, axis=1, keepdims=True) * off["spin"]
        if forces.disc_normal is not None:
            normal = np.broadcast_to(np.asarray(forces.disc_normal, dtype=np.float64), (count, 3)) + off["attitude"]
            changed["disc_normal"] = normal / np.linalg.norm(normal, axis=1, keepdims=True)
        return forces._replace(**changed)

    def off_prior(self, values: np.ndarray) -> np.ndarray:
        """Return the deviation of parameters (P, k) from their priors in standard deviations, a column per parameter with a prior."""
        owned = [(i, p, p.prior) for i, p in enumerate(self.parameters) if p.prior is not None]
        return np.stack([(values[:, i] - p.value) / (p.scale * prior) for i, p, prior in owned], axis=1)

    @property
    def variance(self) -> float:
        """Variance of the tracking error of a coordinate: of the stated noise, or of the estimated error with its slow part."""
        return self.error.sigma**2 + self.error.amplitude**2 if self.track.noise is None else self.track.noise**2

    def whiten(self, errors: np.ndarray) -> np.ndarray:
        """Turn tracking errors of the first n frames (P, n, A) into independent ones of variance one."""
        if self.track.noise is not None or self.error.amplitude == 0.0:
            return errors / self.variance**0.5
        n = errors.shape[1]
        if n not in self._factors:
            parts = [self.track.t[i : min(i + BLOCK, n)] for i in range(0, n, BLOCK)]
            self._factors[n] = [np.linalg.inv(np.linalg.cholesky(self.error.covariance(t))) for t in parts]
        cuts = range(0, n, BLOCK)
        done = [np.tensordot(w, errors[:, i : i + BLOCK], (1, 1)).swapaxes(0, 1) for i, w in zip(cuts, self._factors[n], strict=True)]
        return np.concatenate(done, axis=1)


def settle(start: Released, forces: Forces, count: int, frames: int) -> np.ndarray:
    """Fit the nuisances of a recording to its first frames, for P models at once.

    The fit is least squares with the priors, weighted by the tracking error (Levenberg-Marquardt). It starts from the centre of the
    priors and from a release where a hand is seen to let go, or one standard deviation later, and the better result counts.

    Args:
        start: The recording.
        forces: Forces on the body, a row per model or one for all.
        count: Number of models P.
        frames: Number of frames that are fitted.

    Returns:
        Nuisances (P, k) in the order of `start.parameters`.
    """
    parameters, track = start.parameters, start.track
    t, y = track.t[:frames], track.x[:frames]
    scale, centre, low, high = (np.array([getattr(p, key) for p in parameters]) for key in ("scale", "value", "lower", "upper"))
    release = [i for i, p in enumerate(parameters) if p.name.startswith("release_time")]
    later = [(p.prior or 0.0) * p.scale if start.guide.release is None else start.guide.release for p in parameters]
    begun = [centre, centre + np.array([later[i] if i in release else 0.0 for i in range(len(parameters))])]
    begun = begun if release else begun[:1]
    values = np.repeat(np.clip(begun, low, high), count, axis=0)
    rows, k = values.shape
    forces = _repeated(forces, count, len(begun) * (k + 1))

    def evaluate(v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return residuals (rows, m) and their derivatives (rows, m, k) by the parameters in units of `scale`."""
        step = np.where(v + PROBE * scale > high, -PROBE, PROBE)
        probes = np.concatenate([v[None], v[None] + np.eye(k)[:, None] * (step * scale)[None]]).reshape(-1, k)
        seen = start.seen(probes, forces, t) - y
        r = start.whiten(seen).reshape(len(probes), -1)
        r = np.concatenate([r, start.off_prior(probes)], axis=1)
        r = r.reshape(k + 1, rows, -1)
        return r[0], np.moveaxis(r[1:] - r[0], 0, -1) / step[:, None, :]

    def cost_of(r: np.ndarray) -> np.ndarray:
        return np.where(np.isfinite(r).all(1), (r**2).sum(1), np.inf)

    r, J = evaluate(values)
    cost, damping = cost_of(r), np.full(rows, 1e-4)
    for _ in range(ITERATIONS):
        usable = np.asarray(np.isfinite(J).all((1, 2)) & np.isfinite(r).all(1))
        Jc, rc = np.where(usable[:, None, None], J, 0.0), np.where(usable[:, None], r, 0.0)
        A, g = np.einsum("pmi,pmj->pij", Jc, Jc), np.einsum("pmi,pm->pi", Jc, rc)
        # a parameter at its bound that would move out of the range stays there
        held = ((values <= low) & (g > 0)) | ((values >= high) & (g < 0))
        free = ~held
        A = A * free[:, :, None] * free[:, None, :]
        A = A + np.eye(k) * (held[:, :, None] + damping[:, None, None] * np.einsum("pii->pi", A)[:, :, None] + 1e-12)
        tried = np.clip(values + np.linalg.solve(A, -(g * free)[..., None])[..., 0] * scale, low, high)
        moved = np.abs((tried - values) / scale).max(axis=1)
        r_new, J_new = evaluate(tried)
        cost_new = cost_of(r_new)
        better = cost_new <= cost
        values, r = np.where(better[:, None], tried, values), np.where(better[:, None], r_new, r)
        J = np.where(better[:, None, None], J_new, J)
        cost = np.where(better, cost_new, cost)
        damping = np.clip(np.where(better, damping / 10, damping * 30), 1e-6, 1e8)
        if ((moved < CONVERGED) | (damping > 1e4)).all():
            break
    best = cost.reshape(len(begun), count).argmin(0)
    return values.reshape(len(begun), count, k)[best, np.arange(count)]


def settled_error(start: Released, forces: Forces, frames: int) -> float:
    """Return the root mean square error [m] of the later frames that the tracking error alone causes in the right model.

    It is the tracking error of these frames together with the error of the nuisances, which `settle` fits to the first `frames` frames
    and which grows with time.
    """
    parameters = start.parameters
    J, _ = _influence(start, forces, frames)
    early = np.moveaxis(start.whiten(np.moveaxis(J[:frames], -1, 0)), 0, -1).reshape(-1, len(parameters))
    information = early.T @ early + np.diag([p.prior**-2 if p.prior is not None else 0.0 for p in parameters])
    spread = np.einsum("nak,kl,nal->na", J[frames:], np.linalg.pinv(information), J[frames:])
    return float(np.sqrt(spread.mean() + start.variance))


def scale_gradient(start: Released, forces: Forces) -> np.ndarray:
    """Return how a length scale that changes along the path of a fitted recording changes its coordinates, (n, A) [m].

    A scale that is known to some standard deviation need not be off by the same amount everywhere: a camera that looks askew, or from
    near, sees it change over the field. One standard deviation is a change by that of the scale from the release to the farthest point.
    What the nuisances make up for is removed, to first order. Without an uncertain scale the result is zero.
    """
    sd = next((p.prior * p.scale for p in start.parameters if p.name.startswith("length_scale")), 0.0)
    J, seen = _influence(start, forces, len(start.track.t))
    moved = seen - seen[:1]
    far = np.linalg.norm(moved, axis=1, keepdims=True)
    column = sd * moved * far / max(float(far.max()), 1e-300)
    white = np.moveaxis(start.whiten(np.moveaxis(J, -1, 0)), 0, -1).reshape(-1, J.shape[-1])
    information = white.T @ white + np.diag([p.prior**-2 if p.prior is not None else 0.0 for p in start.parameters])
    taken = np.linalg.pinv(information) @ (white.T @ start.whiten(column[None])[0].reshape(-1))
    return column - J @ taken


def _influence(start: Released, forces: Forces, frames: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the derivatives (n, A, k) of all frames by the nuisances in units of their `scale`, and the frames (n, A) [m].

    The nuisances are those that `settle` fits to the first `frames` frames.
    """
    scale = np.array([p.scale for p in start.parameters])
    values = settle(start, forces, 1, frames)
    probes = np.concatenate([values, values + PROBE * np.diag(scale)])
    seen = start.seen(probes, _repeated(forces, 1, len(probes)), start.track.t)
    return np.moveaxis(seen[1:] - seen[0], 0, -1) / PROBE, seen[0]


def _repeated(forces: Forces, count: int, times: int) -> Forces:
    """Repeat the rows of P = `count` models `times` times."""
    fields = {}
    for name, value in forces._asdict().items():
        if value is not None and name != "time_force_interval":
            value = np.asarray(value, dtype=np.float64)
            shape = 2 if name == "time_force" else int(WIDTHS[name] > 1)
            if value.ndim > shape and len(value) == count and count > 1:
                value = np.tile(value, (times, *([1] * shape)))
        fields[name] = value
    return Forces(**fields)
