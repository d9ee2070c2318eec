"""The point mass: a body whose deformation does not matter, held until its release, then moved by gravity and other forces.

x'' = g / (1 + added_mass) + uniform_acceleration + time_force(t) - drag_linear v - drag_quadratic |v| v + magnus x v
      - position_force (x - position_centre),
with the effects of `physics.effects` at the centre of mass. Many parameter sets run as one batch. The motion is integrated by the
classical Runge-Kutta scheme of fourth order, with cubic Hermite interpolation between its steps.
"""

import math
from typing import NamedTuple

import numpy as np

from neuido.errors import UserError
from neuido.types import brief_fields


class Forces(NamedTuple):
    """The forces on P point masses; numbers () or (P,), vectors (3,) or (P, 3). None: absent."""

    gravity: np.ndarray | tuple[float, float, float] = (0.0, -9.81, 0.0)
    """Acceleration of gravity [m/s^2], vector."""
    uniform_acceleration: np.ndarray | None = None
    """A further acceleration [m/s^2], vector."""
    drag_linear: np.ndarray | float | None = None
    """c of the acceleration -c v [1/s]."""
    drag_quadratic: np.ndarray | float | None = None
    """k of the acceleration -k |v| v [1/m]."""
    magnus: np.ndarray | None = None
    """w of the acceleration w x v [1/s], vector: the spin times a coefficient."""
    position_force: np.ndarray | float | None = None
    """k of the acceleration -k (x - centre) [1/s^2]."""
    position_centre: np.ndarray | None = None
    """The centre of `position_force` [m], vector; None: the origin."""
    time_force: np.ndarray | None = None
    """Accelerations [m/s^2] at J evenly spaced times from 0, (J, 3) or (P, J, 3); linear in between, constant after the last."""
    time_force_interval: float = 0.1
    """Time between two values of `time_force` [s]."""
    added_mass: np.ndarray | float | None = None
    """c of the factor 1 + c on the inertia at unchanged weight [-]."""

    def __repr__(self) -> str:
        return brief_fields(self)


def fly(
    times: np.ndarray,
    position: np.ndarray,
    velocity: np.ndarray,
    release: np.ndarray,
    forces: Forces,
    *,
    step: float = 0.01,
) -> np.ndarray:
    """Simulate the flight of P point masses from their release.

    Args:
        times: Times of the result [s], (n,) or (P, n).
        position: Position until the release [m], (P, 3).
        velocity: Velocity at the release [m/s], (P, 3).
        release: Time of the release [s], (P,); it may lie before the first of `times`.
        forces: The forces from the release on.
        step: Time step of the integration [s].

    Returns:
        Positions [m], (P, n, 3); NaN for a point mass whose motion is not finite.

    Raises:
        UserError: A step that is not positive, or forces whose number of rows is neither one nor P.
    """
    if not (step > 0 and math.isfinite(step)):
        raise UserError(f"step = {step} s must be positive")
    position, velocity = np.array(position, dtype=np.float64), np.array(velocity, dtype=np.float64)
    count = len(position)
    times = np.broadcast_to(times, (count, np.shape(times)[-1]))
    since = np.maximum(times - np.asarray(release, dtype=np.float64)[:, None], 0.0)
    duration = float(since.max())
    steps, h = max(math.ceil(duration / step), 1), step
    accelerate = _acceleration(forces, count, np.asarray(release, dtype=np.float64))
    X, V = np.empty((steps + 1, count, 3)), np.empty((steps + 1, count, 3))
    X[0], V[0] = position, velocity
    with np.errstate(over="ignore", invalid="ignore"):
        for i in range(steps):
            x, v, t = X[i], V[i], i * h
            a1 = accelerate(x, v, t)
            v2 = v + h / 2 * a1
            a2 = accelerate(x + h / 2 * v, v2, t + h / 2)
            v3 = v + h / 2 * a2
            a3 = accelerate(x + h / 2 * v2, v3, t + h / 2)
            v4 = v + h * a3
            a4 = accelerate(x + h * v3, v4, t + h)
            X[i + 1] = x + h / 6 * (v + 2 * v2 + 2 * v3 + v4)
            V[i + 1] = v + h / 6 * (a1 + 2 * a2 + 2 * a3 + a4)
        out = _hermite(X, V, since, h)
    out[~np.isfinite(out).all(axis=(1, 2))] = np.nan
    return out


def _hermite(X: np.ndarray, V: np.ndarray, since: np.ndarray, h: float) -> np.ndarray:
    """Interpolate positions, (P, n, 3), at times `since` the release (P, n), from x and v (K, P, 3) at multiples of `h`."""
    at = np.minimum((since / h).astype(np.int64), len(X) - 2)
    u = (since / h - at)[..., None]
    row = np.arange(X.shape[1])[:, None]
    x0, x1, v0, v1 = X[at, row], X[at + 1, row], V[at, row] * h, V[at + 1, row] * h
    return x0 + u * v0 + u**2 * (3 * (x1 - x0) - 2 * v0 - v1) + u**3 * (2 * (x0 - x1) + v0 + v1)


def _acceleration(forces: Forces, count: int, release: np.ndarray):
    """Return a function of x (P, 3), v (P, 3) and the time since the release that gives the acceleration [m/s^2], (P, 3)."""

    def scalar(name: str) -> np.ndarray | None:
        value = getattr(forces, name)
        return None if value is None else _rows(value, count, (), name)[:, None]

    constant = _rows(forces.gravity, count, (3,), "gravity")
    if (added := scalar("added_mass")) is not None:
        constant = constant / (1 + added)
    if forces.uniform_acceleration is not None:
        constant = constant + _rows(forces.uniform_acceleration, count, (3,), "uniform_acceleration")
    linear, quadratic, pull = scalar("drag_linear"), scalar("drag_quadratic"), scalar("position_force")
    centre = _rows(np.zeros(3) if forces.position_centre is None else forces.position_centre, count, (3,), "position_centre")
    spin = None if forces.magnus is None else _rows(forces.magnus, count, (3,), "magnus")
    knots = None
    if forces.time_force is not None:
        shape = np.shape(forces.time_force)[-2:]
        knots = _rows(forces.time_force, count, shape, "time_force")
        if not forces.time_force_interval > 0:
            raise UserError(f"time_force_interval = {forces.time_force_interval} s must be positive")

    def accelerate(x: np.ndarray, v: np.ndarray, t: float) -> np.ndarray:
        a = constant
        if linear is not None:
            a = a - linear * v
        if quadratic is not None:
            a = a - quadratic * np.sqrt((v * v).sum(1, keepdims=True)) * v
        if spin is not None:
            a = a + np.cross(spin, v)
        if pull is not None:
            a = a - pull * (x - centre)
        if knots is not None:
            u = np.clip((t + release) / forces.time_force_interval, 0, knots.shape[1] - 1)
            low = np.minimum(u.astype(np.int64), max(knots.shape[1] - 2, 0))
            share, row = (u - low)[:, None], np.arange(count)
            a = a + (1 - share) * knots[row, low] + share * knots[row, np.minimum(low + 1, knots.shape[1] - 1)]
        return a

    return accelerate


def _rows(value, count: int, shape: tuple[int, ...], name: str) -> np.ndarray:
    """Expand a parameter to one row for each point mass."""
    rows = np.asarray(value, dtype=np.float64)
    if rows.shape not in (shape, (1, *shape), (count, *shape)):
        raise UserError(f"{name} has the shape {rows.shape} for {count} point masses; give {shape} or {(count, *shape)}")
    return np.broadcast_to(rows, (count, *shape))
