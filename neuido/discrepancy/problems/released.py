"""The nuisances of a track (start of the flight, clock, length scale), and their estimate from its first frames."""

from collections.abc import Mapping, Sequence

import numpy as np

from neuido.data.measured.track import AXES, Track
from neuido.discrepancy.problems.noise import SeriesError
from neuido.discrepancy.problems.problem import Parameter
from neuido.physics.points.point_mass import Forces, fly

LARGEST_ERROR = 2.0
"""Largest error of a clock or length scale, in standard deviations of its prior."""
VELOCITY_FRAMES = 4
"""Number of frames for the first estimate of the velocity."""
ITERATIONS = 25
"""Largest number of steps of the least-squares fit."""
PROBE = 1e-3
"""Step of the finite differences, in units of `Parameter.scale`."""
CONVERGED = 1e-5
"""Step at which the fit has converged, in units of `Parameter.scale`."""
LONGEST, LEAST_STEPS = 0.05, 60
"""Largest time step of the integration [s], and least number of steps per recording."""


class Released:
    """One recording of a body that is held until its release and then flies, with the errors of its instruments.

    Its parameters are position [m] and velocity [m/s] along each measured axis, then `release_time` [s], `length_scale` [-] and
    `time_base` [-] where the folder gives them a standard deviation. Each name is followed by a colon and the name of the recording.
    A time t in the file is the true time (1 + time_base) t. A displacement from the place of release is measured (1 + length_scale)
    times too large.

    Args:
        track: The recording.
        nuisances: Prior standard deviation of `release_time` [s], `length_scale` [-] and `time_base` [-]; 0: without error.
        gravity: Acceleration of gravity [m/s^2], (3,).
        error: Error of the tracked positions [m].
    """

    def __init__(self, track: Track, nuisances: Mapping[str, float], gravity: Sequence[float], error: SeriesError) -> None:
        self.track, self.error = track, error
        sigma = error.sigma if track.noise is None else track.noise
        n = min(VELOCITY_FRAMES, len(track.t))
        span = float(track.t[n - 1] - track.t[0])
        slope = np.polyfit(track.t[:n], track.x[:n], 1)[0]
        extent = max(float(np.ptp(track.x)), 10 * sigma)
        size = max(float(np.linalg.norm(gravity)), 1e-3)
        # noise and gravity alone change the slope of the first frames by this much
        spread = float(np.hypot(2 * sigma / span, size * span))
        out = []
        for a, at in zip(track.axes, np.median(track.x[:3], axis=0), strict=True):
            step = max(3 * sigma, 1e-3 * extent)
            out.append(Parameter(f"position_{AXES[a]}:{track.name}", "m", float(at), step, at - extent, at + extent))
        for a, speed in zip(track.axes, slope):
            lower, upper = speed - 5 * spread, speed + 5 * spread
            out.append(Parameter(f"velocity_{AXES[a]}:{track.name}", "m/s", float(speed), spread / 4, lower, upper, prior=4.0))
        for name, unit in (("release_time", "s"), ("length_scale", "1"), ("time_base", "1")):
            sd = nuisances[name]
            if sd > 0:
                out.append(Parameter(f"{name}:{track.name}", unit, 0.0, sd / 4, -LARGEST_ERROR * sd, LARGEST_ERROR * sd, prior=4.0))
        self.parameters: tuple[Parameter, ...] = tuple(out)

    def seen(self, values: np.ndarray, forces: Forces, t: np.ndarray) -> np.ndarray:
        """Predict the measured coordinates [m], (P, n, A) for A axes, at times t (n,) [s] for P rows of parameters (P, k)."""
        axes, count = list(self.track.axes), len(values)
        x, v = np.zeros((count, 3)), np.zeros((count, 3))
        x[:, axes], v[:, axes] = values[:, : len(axes)], values[:, len(axes) : 2 * len(axes)]
        off = dict.fromkeys(("release_time", "length_scale", "time_base"), np.zeros(count))
        for i, p in enumerate(self.parameters[2 * len(axes) :], 2 * len(axes)):
            off[p.name.partition(":")[0]] = values[:, i]
        step = min(LONGEST, float(np.ptp(self.track.t)) / LEAST_STEPS)
        moved = fly((1 + off["time_base"])[:, None] * t, x, v, off["release_time"], forces, step=step)
        return (x[:, None] + (1 + off["length_scale"])[:, None, None] * (moved - x[:, None]))[..., axes]

    def off_prior(self, values: np.ndarray) -> np.ndarray:
        """Return the deviation of parameters (P, k) from their priors in standard deviations, a column per parameter with a prior."""
        owned = [(i, p, p.prior) for i, p in enumerate(self.parameters) if p.prior is not None]
        return np.stack([(values[:, i] - p.value) / (p.scale * prior) for i, p, prior in owned], axis=1)

    @property
    def variance(self) -> float:
        """Variance of the tracking error of a coordinate [m^2]: of the stated noise, or of the estimated error with its slow part."""
        return self.error.sigma**2 + self.error.amplitude**2 if self.track.noise is None else self.track.noise**2

    def whitener(self, t: np.ndarray) -> np.ndarray:
        """Return the matrix (n, n) [1/m] that turns tracking errors at times t (n,) into independent ones of variance one."""
        if self.track.noise is not None:
            return np.eye(len(t)) / self.track.noise
        return np.linalg.inv(np.linalg.cholesky(self.error.covariance(t)))


def settle(start: Released, forces: Forces, count: int, frames: int) -> np.ndarray:
    """Fit the nuisances of a recording to its first frames, for P models at once.

    The fit is least squares with the priors, weighted by the tracking error (Levenberg-Marquardt). It starts from the centre of the
    priors and from a release one standard deviation later, and the better result counts.

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
    whiten = start.whitener(t)
    scale, centre, low, high = (np.array([getattr(p, key) for p in parameters]) for key in ("scale", "value", "lower", "upper"))
    release = [i for i, p in enumerate(parameters) if p.name.startswith("release_time")]
    begun = [centre, centre + np.array([(p.prior or 0.0) * p.scale if i in release else 0.0 for i, p in enumerate(parameters)])]
    begun = begun if release else begun[:1]
    values = np.repeat(np.clip(begun, low, high), count, axis=0)
    rows, k = values.shape
    forces = _repeated(forces, count, len(begun) * (k + 1))

    def evaluate(v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return residuals (rows, m) and their derivatives (rows, m, k) by the parameters in units of `scale`."""
        step = np.where(v + PROBE * scale > high, -PROBE, PROBE)
        probes = np.concatenate([v[None], v[None] + np.eye(k)[:, None] * (step * scale)[None]]).reshape(-1, k)
        seen = start.seen(probes, forces, t) - y
        r = np.einsum("ij,pja->pia", whiten, seen).reshape(len(probes), -1)
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
    parameters, t = start.parameters, start.track.t
    scale = np.array([p.scale for p in parameters])
    values = settle(start, forces, 1, frames)
    probes = np.concatenate([values, values + PROBE * np.diag(scale)])
    seen = start.seen(probes, _repeated(forces, 1, len(probes)), t)
    J = np.moveaxis(seen[1:] - seen[0], 0, -1) / PROBE  # (n, A, k)
    early = np.einsum("ij,jak->iak", start.whitener(t[:frames]), J[:frames]).reshape(-1, len(parameters))
    information = early.T @ early + np.diag([p.prior**-2 if p.prior is not None else 0.0 for p in parameters])
    spread = np.einsum("nak,kl,nal->na", J[frames:], np.linalg.pinv(information), J[frames:])
    return float(np.sqrt(spread.mean() + start.variance))


def _repeated(forces: Forces, count: int, times: int) -> Forces:
    """Repeat the rows of P = `count` models `times` times."""
    fields = {}
    for name, value in forces._asdict().items():
        if value is not None and name != "time_force_interval":
            value = np.asarray(value, dtype=np.float64)
            shape = {"time_force": 2, "gravity": 1, "uniform_acceleration": 1, "magnus": 1, "position_centre": 1}.get(name, 0)
            if value.ndim > shape and len(value) == count and count > 1:
                value = np.tile(value, (times, *([1] * shape)))
        fields[name] = value
    return Forces(**fields)
