"""The point mass: a body whose deformation does not matter, held until its release, then moved by gravity and other forces.

x'' = g / (1 + added_mass) + uniform_acceleration + time_force(t) - drag_linear v - drag_quadratic |v| v + magnus x v
      - position_force (x - position_centre) - dry_friction v/|v| - local_force r exp((1 - r^2)/2) + |v|^2 (lift s e - lift_drag s^2 v/|v|),
with r = (x - local_centre) / local_width, s = -disc_normal . v/|v|, and e the unit vector normal to v in the plane of v and disc_normal. A
pendulum moves along its arc, the first coordinate. A floor returns the point. Many parameter sets run as one batch (`point_kernels`).
"""

import math
from typing import NamedTuple

import numpy as np

from neuido.errors import UserError
from neuido.physics.points.point_kernels import COLUMNS, WIDTHS, build
from neuido.physics.runtime.limits import check_limit
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
    dry_friction: np.ndarray | float | None = None
    """c of the acceleration -c v/|v| [m/s^2]; within the speed c times the step it falls to zero."""
    local_force: np.ndarray | float | None = None
    """Largest acceleration [m/s^2] towards a place, at the distance `local_width` from it; negative: away from it."""
    local_centre: np.ndarray | None = None
    """Place of `local_force` [m], vector; None: the origin."""
    local_width: np.ndarray | float | None = None
    """Distance from `local_centre` at which `local_force` is largest [m]; needed with it."""
    lift: np.ndarray | float | None = None
    """Lift of a disc, per squared speed and unit of s, the sine of its angle of attack [1/m]."""
    lift_drag: np.ndarray | float | None = None
    """Drag of a disc beyond `drag_quadratic`, per squared speed and s^2 [1/m]."""
    disc_normal: np.ndarray | None = None
    """Unit normal of the disc, vector; constant in a flight, as the spin holds it."""
    pendulum: np.ndarray | tuple[float, float] | None = None
    """Gravity [m/s^2] and length [m] of a pendulum, (2,) or (P, 2): -g sin(x / length) along the first coordinate, which is the arc."""
    floor_normal: np.ndarray | None = None
    """Unit normal of a floor, vector; None: no floor."""
    floor_height: np.ndarray | float | None = None
    """Coordinate of the point along `floor_normal` at contact [m]."""
    restitution: np.ndarray | float | None = None
    """Normal velocity after an impact at 1 m/s over that before it [-]."""
    restitution_speed: np.ndarray | float | None = None
    """p of the factor (speed in m/s)^-p on the restitution [-]."""
    bounce_friction: np.ndarray | float | None = None
    """Coulomb's friction coefficient of an impact [-]."""
    roundness: np.ndarray | float | None = None
    """Moment of inertia over m r^2 [-]: 0.4 of a solid ball, 2/3 of a hollow one. At 0 an impact causes no friction."""
    surface_velocity: np.ndarray | None = None
    """Spin times radius at the release [m/s], vector. Impacts change it, and nothing else does."""

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
        times: Times of the result [s], increasing, (n,) or (P, n).
        position: Position until the release [m], (P, 3).
        velocity: Velocity at the release [m/s], (P, 3).
        release: Time of the release [s], (P,); it may lie before the first of `times`.
        forces: The forces from the release on.
        step: Time step of the integration [s].

    Returns:
        Positions [m], (P, n, 3); NaN for a point mass whose motion is not finite.

    Raises:
        UserError: A step that is not positive, more steps than `NEUIDO_MAX_STEPS`, times that do not increase, or forces whose number of
            rows is neither one nor P.
    """
    if not (step > 0 and math.isfinite(step)):
        raise UserError(f"step = {step} s must be positive")
    position, velocity = (np.ascontiguousarray(given, dtype=np.float64) for given in (position, velocity))
    count = len(position)
    times = np.array(np.broadcast_to(times, (count, np.shape(times)[-1])), dtype=np.float64)
    release = np.array(release, dtype=np.float64)
    duration = float(np.nanmax(times - release[:, None], initial=0.0))
    check_limit(math.ceil(duration / step), "NEUIDO_MAX_STEPS", f"a flight of {duration:.4g} s in steps of {step:.4g} s")
    if (np.diff(times, axis=1) < 0).any():
        raise UserError("the times of a flight must increase")
    table, knots, interval = _table(forces, count)
    finite = np.isfinite(table).all(axis=1) & np.isfinite(np.concatenate([position, velocity, release[:, None]], axis=1)).all(axis=1)
    finite &= np.isfinite(times).all(axis=1)
    table[~finite], position, velocity = 0.0, np.where(finite[:, None], position, 0.0), np.where(finite[:, None], velocity, 0.0)
    times, release = np.where(finite[:, None], times, 0.0), np.where(finite, release, 0.0)
    out = _move(times, position, velocity, release, table, knots, interval, step)
    out[~finite | ~np.isfinite(out).all(axis=(1, 2))] = np.nan
    return out


def _move(times, position, velocity, release, table, knots, interval: float, step: float) -> np.ndarray:
    """Run the kernel on the CPU; return positions (P, n, 3)."""
    import warp as wp

    kernel = build()

    def array(values: np.ndarray, dtype: type) -> wp.array:
        return wp.array(np.ascontiguousarray(values), dtype=dtype, device="cpu")

    out = wp.empty(times.shape, dtype=wp.vec3d, device="cpu")
    given = [array(times, wp.float64), array(position, wp.vec3d), array(velocity, wp.vec3d), array(release, wp.float64)]
    given += [array(table, wp.float64), array(knots, wp.vec3d), interval, step]
    wp.launch(kernel, dim=len(times), inputs=given, outputs=[out], device="cpu")
    return out.numpy().copy()


def _table(forces: Forces, count: int) -> tuple[np.ndarray, np.ndarray, float]:
    """Return forces as the table of the kernel (P, M), the knots of `time_force` (P, J, 3) and their interval [s], 0 without a force."""
    table = np.zeros((count, sum(WIDTHS.values())))
    for name, width in WIDTHS.items():
        value = getattr(forces, name)
        if value is not None:
            rows = _rows(value, count, () if width == 1 else (width,), name)
            table[:, COLUMNS[name] : COLUMNS[name] + width] = rows.reshape(count, width)
    if forces.local_force is not None and (table[:, COLUMNS["local_width"]] <= 0).any():
        raise UserError("local_force needs a local_width above zero")
    if forces.time_force is None:
        return table, np.zeros((count, 1, 3)), 0.0
    if not forces.time_force_interval > 0:
        raise UserError(f"time_force_interval = {forces.time_force_interval} s must be positive")
    knots = _rows(forces.time_force, count, np.shape(forces.time_force)[-2:], "time_force")
    return table, np.array(knots), float(forces.time_force_interval)


def _rows(value, count: int, shape: tuple[int, ...], name: str) -> np.ndarray:
    """Expand a parameter to one row for each point mass."""
    rows = np.asarray(value, dtype=np.float64)
    if rows.shape not in (shape, (1, *shape), (count, *shape)):
        raise UserError(f"{name} has the shape {rows.shape} for {count} point masses; give {shape} or {(count, *shape)}")
    return np.broadcast_to(rows, (count, *shape))
