"""Plausibility checks of motion: units and signs of positions and times, points that were not seen, gaps, pivots.

Each error or warning is one line that says what is implausible and what to change.
"""

import math
import warnings
from collections.abc import Mapping, Sequence

import numpy as np

from neuido.data.measured.held_start import held_rows
from neuido.data.measured.plausibility import lone_jump
from neuido.errors import PlausibilityWarning, UserError

SENTINELS = (0.0, -9999.0, 9999.0, -999999.0)
"""Values that trackers write into the coordinates of a marker that they did not see."""
LOST = 4.0
"""Usual steps from frame to frame by which a position of exactly zero is away from the nearest one where the point was not
seen; a body that passes the origin is rarely faster than that."""
MAX_LEFT = 0.03
"""Share of its range that a parabola leaves of a flight, at the most."""
FASTEST, SLOWEST = 30.0, 3e-3
"""Acceleration, relative to gravity, above which lengths are in another unit, and below which times are: (1/30)^2 is that of frames."""
UPRIGHT, BENT = 0.8, 5.0
"""Share of gravity that a fall along an axis has at the least, and how many times the noise it is seen above."""
CERTAIN, STEADY, ERRORS = 0.1, 0.2, 3.0
"""What an acceleration may be off from gravity, and change by in a flight, as shares of gravity, for nothing else to be meant; and how many
standard errors are added to both. Drag of 1/s, lift and circles change it by more."""
FARTHEST = 1e3
"""Distance [m] above which positions are taken to be in another unit."""
GAP = 10.0
"""Length of a gap in usual intervals from which on it is said."""
DENSEST, LIGHTEST = 3e4, 0.1
"""Densities [kg/m^3] of no solid: osmium has 22,600, helium 0.17."""
TURNED = 0.4
"""Speed before and after a bounce, as a share of the largest speeds of a flight."""
ON_CIRCLE = 0.01
"""Distance from a circle, as a share of the extent, at which a path is taken to be on it."""
OUTSIDE = 0.01
"""Share of the positions outside the domain from which on it is said."""
ROOM, EMPTY = 3.0, 1e5
"""Volume of the particles, relative to the box about them, above which its unit is doubtful, and inverse of that below which it is."""


FOOT, MAX_FEET = 0.3048, 0.05
"""A foot [m], and how far an acceleration may be from gravity in feet where that unit is meant: drag and the scale are within it."""


def check_flight(t: np.ndarray, x: np.ndarray, gravity: float, axis: str, where: str) -> None:
    """Check that the coordinates of a flight are in metres, and its times in seconds, with the declared direction of gravity.

    Args:
        t: Times [s], (n,).
        x: Coordinates along one axis, (n,).
        gravity: Declared gravity along this axis [m/s^2].
        axis: Name of the axis.
        where: Name of the recording in error messages.

    Raises:
        UserError: The path is a parabola whose acceleration differs from gravity by a unit (pixels, millimetres, milliseconds, frames), or
            within noise by its sign alone. Where drag or lift may turn the sign, it is a warning.
    """
    if len(t) < 6 or abs(gravity) < 1 or np.ptp(x) == 0:
        return
    time = (t - t[0]) / (t[-1] - t[0])
    parabola = np.polynomial.Polynomial.fit(time, x, 2, domain=[0, 1], window=[0, 1])
    line = np.polynomial.Polynomial.fit(time, x, 1, domain=[0, 1], window=[0, 1])
    left, of_line = (float(np.std(x - fit(time)) / np.ptp(x)) for fit in (parabola, line))
    acceleration = 2 * parabola.coef[2] / (t[-1] - t[0]) ** 2
    ratio = acceleration / gravity
    slow = abs(ratio) < SLOWEST and of_line > max(MAX_LEFT, 3 * left)
    feet = 1 - MAX_FEET < abs(ratio) * FOOT < 1 + MAX_FEET
    if left > MAX_LEFT or not (abs(ratio) > FASTEST or -1.3 < ratio < -0.7 or slow or feet):
        return
    told = f"{where}: the acceleration along {axis} is {acceleration:.4g} /s^2, {ratio:.3g} times model.gravity"
    if feet:
        _warn(f"{told}: are the positions in feet? Then give scale: {{{axis}: {math.copysign(FOOT, ratio):.4g}}}, or --units.x ft")
        return
    if slow:
        raise UserError(
            f"{told}; are the times in ms or frames? Give about scale: {{t: {math.sqrt(abs(ratio)):.3g}}}; or set model.gravity to zero "
            f"along {axis} if the body is supported or {axis} is horizontal"
        )
    sign = f"{axis} points down" if ratio < 0 else ""
    unit = "the unit is not metres" if abs(ratio) > FASTEST else ""
    change = (
        f"give about scale: {{{axis}: {1 / ratio:.3g}}}, or use `neuido import` with "
        f"{' and '.join(filter(None, ('--scale' if unit else '', '--y_down true' if sign else '')))}"
    )
    if not unit and not _is_gravity(t, x[:, None], [-gravity], abs(gravity)):
        _warn(f"{told}: {sign}, or drag or lift turns it? If it points down, {change}")
        return
    raise UserError(f"{told}: {' and '.join(filter(None, (unit, sign)))}; {change}")


def check_upright(t: np.ndarray, x: np.ndarray, gravity: Sequence[float], axes: Sequence[str], where: str) -> None:
    """Check that a free flight falls along the declared gravity, and warn where it may fall along another axis.

    Args:
        t: Times [s], (n,).
        x: Coordinates [m], (n, A).
        gravity: Declared gravity along each axis [m/s^2].
        axes: Names of the axes.
        where: Name of the recording in error messages.

    Raises:
        UserError: The acceleration is within noise this gravity along another axis, and stays so.
    """
    size = float(np.linalg.norm(gravity))
    if len(t) < 6 or size < 1 or max(map(abs, gravity)) < UPRIGHT * size:
        return
    time = t - t[0]
    found, left, bent = {}, {}, {}
    for a, axis in enumerate(axes):
        curve = np.polynomial.Polynomial.fit(time, x[:, a], 2).convert()
        span = max(float(np.ptp(x[:, a])), 1e-30)
        found[axis] = 2 * float(curve.coef[2]) if len(curve.coef) > 2 else 0.0
        left[axis] = float(np.std(x[:, a] - curve(time)))
        bent[axis] = left[axis] < MAX_LEFT * span and abs(found[axis]) * float(time[-1]) ** 2 / 8 > BENT * left[axis]
    down = axes[int(np.argmax(np.abs(gravity)))]
    other = max(found, key=lambda axis: abs(found[axis]))
    level = abs(found[down]) < (1 - UPRIGHT) * size
    if other == down or not level or not bent[other] or not UPRIGHT < abs(found[other]) / size < 2 - UPRIGHT:
        return
    change = "--up z" if other == "z" and found[other] < 0 else "--columns.y for the height (and --y_down true where it points down)"
    fitted = ", ".join(f"{value:.3g}" for value in found.values())
    text = f"{where}: the acceleration ({', '.join(axes)}) is ({fitted}) m/s^2, and gravity is declared along {down}"
    along = [math.copysign(size, found[axis]) if axis == other else 0.0 for axis in axes]
    if _is_gravity(t, x, along, size):
        raise UserError(
            f"{text}: that along {other} is as of gravity, so {other} is the vertical. Give {change} to `neuido import`, or another "
            "model.gravity"
        )
    _warn(f"{text}: if {other} is the vertical, give {change} to `neuido import`; drag, lift or a circle may look like this too")


def _is_gravity(t: np.ndarray, x: np.ndarray, gravity: Sequence[float], size: float) -> bool:
    """Return whether the acceleration of a path x (n, A) [m] is within noise this gravity (A,), of `size` [m/s^2], and stays so."""
    span = float(t[-1] - t[0])
    time = 2 * (t - t[0]) / span - 1
    parts = []  # acceleration of a parabola, and the change from start to end by a cubic, each with its standard error
    for degree, factor in ((2, 8.0), (3, 96.0)):
        basis = np.polynomial.polynomial.polyvander(time, degree)
        curve, *_ = np.linalg.lstsq(basis, x, rcond=None)
        left = np.sum((x - basis @ curve) ** 2, axis=0) / max(len(t) - degree - 1, 1)
        error = np.sqrt(left * np.linalg.inv(basis.T @ basis)[degree, degree])
        parts.append((factor / span**2 * curve[degree], factor / span**2 * float(np.linalg.norm(error))))
    (found, error), (change, doubt) = parts
    away = float(np.linalg.norm(found - np.asarray(gravity)))
    return away + ERRORS * error < CERTAIN * size and float(np.linalg.norm(change)) + ERRORS * doubt < STEADY * size


def lost_positions(x: np.ndarray) -> np.ndarray:
    """Return at which rows (n,) of positions (n, A) a tracker wrote a number for a point that it did not see.

    Such numbers are -9999 and the like in any coordinate, and zero in all of two or more that is far from the rows before and after.
    """
    out = np.isin(x, SENTINELS[1:]).any(axis=1)
    zero = (x == 0).all(axis=1)
    good = np.flatnonzero(~zero & ~out & np.isfinite(x).all(axis=1))
    if not zero.any() or len(good) < 2 or x.shape[1] < 2:
        return out
    usual = float(np.median(np.linalg.norm(np.diff(x[good], axis=0), axis=1) / np.diff(good)))
    for i in np.flatnonzero(zero):
        j = int(np.searchsorted(good, i))
        near = [good[k] for k in (j - 1, j) if 0 <= k < len(good)]
        gap = min(abs(int(k) - int(i)) for k in near)
        out[i] = all(np.linalg.norm(x[k]) > LOST * max(usual, 1e-12) * gap for k in near if abs(int(k) - int(i)) == gap)
    return out


def check_track(t: np.ndarray, x: np.ndarray, axes: Sequence[str], where: str, *, free: bool = True) -> None:
    """Check one track for unseen points, a point that stands still, gaps, jumps and a pivot.

    Args:
        t: Times [s], (n,).
        x: Coordinates [m], (n, A).
        axes: Names of the axes.
        where: Name of the recording in messages.
        free: Whether the point is declared to fly.

    Raises:
        UserError: The point stands still, or rows hold the number of a point that was not seen.
    """
    if len(x) > 1 and not np.ptp(x, axis=0).any():
        raise UserError(f"{where}: the point is at the same place in all {len(x)} rows: name the right columns")
    lost = lost_positions(x)
    if lost.any():
        row = int(np.argmax(lost))
        place = ", ".join(f"{value:g}" for value in x[row])
        raise UserError(
            f"{where}: data row {row} has {place}, as of a point that was not seen, and {int(lost.sum()) - 1} rows more: leave them out"
        )
    for a, axis in enumerate(axes):
        row = lone_jump(x[:, a])
        if len(axes) > 1 and np.ptp(x[:, a]) == 0:
            _warn(f"{where}: {axis} is {x[0, a]:g} in all {len(x)} rows: leave it out of columns if it was not measured")
        elif row is not None:
            _warn(
                f"{where}: {axis} jumps to {x[row, a]:.4g} m in data row {row} and back: leave that row out if the tracker lost the point"
            )
    if float(np.ptp(x, axis=0).max()) > FARTHEST:
        _warn(f"{where}: the point travels {np.ptp(x, axis=0).max():.4g} m; are the positions in mm or pixels? (scale)")
    check_gaps(t, where)
    pivot = _pivot(x) if free else None
    if pivot is not None:
        _warn(
            f"{where}: the point moves to and fro on a circle of {pivot:.3g} m, as on a pivot, and no constraint is declared: give "
            f"model.constraint: {{type: pendulum, length: {pivot:.3g}}} "
            "(`neuido import --guide pendulum`)"
        )


def check_gaps(t: np.ndarray, where: str) -> None:
    """Warn of a gap in times (n,) [s] that is far longer than the others."""
    steps = np.diff(t)
    if len(steps) > 4 and steps.max() > GAP * np.median(steps):
        row = int(np.argmax(steps))
        _warn(
            f"{where}: {steps.max():.3g} s lie between data rows {row} and {row + 1}, and {np.median(steps):.3g} s between others: was "
            "the recording cut? Give its parts as recordings of their own (rows)"
        )


def check_bounces(t: np.ndarray, x: np.ndarray, axis: str, where: str) -> None:
    """Warn of a free flight that turns round at its lowest points, as a body that bounces does.

    Args:
        t: Times [s], (n,).
        x: Coordinate against gravity [m], (n,).
        axis: Its name.
        where: Name of the recording in messages.
    """
    if len(t) < 12:
        return
    speed = np.diff(x) / np.diff(t)
    reach = max(float(np.quantile(np.abs(speed), 0.9)), 1e-12)
    turns = [
        i for i in range(2, len(speed) - 2) if np.min(speed[i - 2 : i]) < -TURNED * reach and np.max(speed[i : i + 2]) > TURNED * reach
    ]
    turns = [i for i in turns if x[i] <= np.min(x) + 0.2 * np.ptp(x)]
    if turns:
        row = turns[0]
        _warn(
            f"{where}: {axis} turns round within a few rows at {t[row]:.4g} s (data row {row}), as in a bounce, and no constraint is "
            f"declared: give model.constraint: {{type: bounce, floor: {np.min(x):.4g}, restitution: 0.8}}, or rows: [0, {row}] "
            "(`neuido import --guide bounce`)"
        )


def check_released(t: np.ndarray, x: np.ndarray, gravity: Sequence[float], where: str) -> None:
    """Warn of a free flight whose body is held at the start.

    Args:
        t: Times [s], (n,).
        x: Coordinates [m], (n, A).
        gravity: Declared gravity along each of them [m/s^2].
        where: Name of the recording in messages.
    """
    held = held_rows(t, x, gravity)
    if held:
        _warn(
            f"{where}: the point keeps its height for {t[held - 1] - t[0]:.3g} s, longer than a free body can: leave the first {held} data "
            f"rows out (rows: [{held}, {len(t)}]), or give nuisances.release_time (s)"
        )


def check_figures(body: str, figures: Mapping[str, float]) -> None:
    """Check that mass [kg] and diameter [m] of a body give the density of a solid.

    Raises:
        UserError: It is denser than any.
    """
    if len(figures) == 2:
        density = figures["mass"] / (math.pi / 6 * figures["diameter"] ** 3)
        told = f"bodies.{body}: mass {figures['mass']:g} kg and diameter {figures['diameter']:g} m give {density:.3g} kg/m^3"
        if density > DENSEST:
            raise UserError(f"{told}, more than any solid has; is the mass in g, or the diameter a radius?")
        if density < LIGHTEST:
            _warn(f"{told}, less than air; is the diameter in mm or cm?")


def _pivot(x: np.ndarray) -> float | None:
    """Return the radius [m] of the circle on which positions (n, 2) go to and fro; None for any other path."""
    if x.shape[1] != 2 or len(x) < 12:
        return None
    steps = np.diff(x, axis=0)
    extent = float(np.linalg.norm(np.ptp(x, axis=0)))
    if np.linalg.norm(steps, axis=1).sum() < 1.8 * extent:  # a path that never turns back is a flight
        return None
    centred = x - x.mean(axis=0)
    matrix = np.column_stack([2 * centred, np.ones(len(x))])
    found, *_ = np.linalg.lstsq(matrix, np.sum(centred**2, axis=1), rcond=None)
    radius = math.sqrt(max(float(found[2] + found[0] ** 2 + found[1] ** 2), 0.0))
    off = float(np.std(np.linalg.norm(centred - found[:2], axis=1)))
    straight = float(np.linalg.svd(centred, compute_uv=False)[1] / math.sqrt(len(x)))
    return radius if off < ON_CIRCLE * extent and straight > 3 * off and radius < 20 * extent else None


def _warn(text: str) -> None:
    warnings.warn(text, PlausibilityWarning, stacklevel=4)


def mask_unseen(x: np.ndarray, where: str) -> np.ndarray:
    """Replace sentinel positions (T, N, 3) of markers that were not seen by NaN, with a warning that counts them.

    Raises:
        UserError: No point was seen in any frame.
    """
    x = x.copy()
    count, size = 0, float(np.nanmedian(np.abs(x))) if np.isfinite(x).any() else 0.0
    for value in SENTINELS:
        hit = (x == value).all(axis=2)
        if not hit.any():
            continue
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # points that were never seen
            usual = np.nanmedian(np.where(hit[..., None], np.nan, x), axis=0)
        far = ~(np.abs(usual - value).max(axis=1) < 1e-3 * size)
        hit &= far & (hit.sum(axis=0) > 0)
        count += int(hit.sum())
        x[hit] = np.nan
    if not np.isfinite(x).any():
        raise UserError(f"{where}: no point of x was seen in any frame (all NaN): export the positions again")
    if count:
        _warn(f"{where}: {count} positions of exactly 0 or -9999 count as not seen")
    return x


def check_positions(x: np.ndarray, x0: np.ndarray, track: np.ndarray | None, lower: np.ndarray, upper: np.ndarray, where: str) -> None:
    """Check that positions x (T, N, 3) have the unit and frame of the particles x0 (P, 3) and of the domain.

    Raises:
        UserError: The median position is farther outside the domain than the size of the domain, or the points of the first frame are
            farther from their particles (`track`) than the size of the body.
    """
    size = float((upper - lower).max())
    middle = np.nanmedian(x.reshape(-1, 3), axis=0)
    if ((middle < lower - size) | (middle > upper + size)).any():
        raise UserError(
            f"{where}: the median position is {', '.join(f'{v:.3g}' for v in middle)} m, but scene.domain ends at "
            f"{', '.join(f'{v:g}' for v in upper)} m; is x in millimetres? Give metres, as for x0"
        )
    out = np.argwhere(((x < lower) | (x > upper)).any(axis=2))
    if len(out) > OUTSIDE * np.isfinite(x[..., 0]).sum():
        frame, point = (int(i) for i in out[0])
        place = ", ".join(f"{v:.3g}" for v in x[frame, point])
        _warn(
            f"{where}: {len(out)} positions lie outside scene.domain, the first of point {point} in frame {frame} at {place} m: "
            "enlarge domain"
        )
    if track is None:
        return
    known = (track >= 0) & np.isfinite(x[0, :, 0])
    if known.any():
        gap = np.linalg.norm(x[0, known] - x0[track[known]], axis=1)
        body = float(np.linalg.norm(np.ptp(x0, axis=0)))
        if len(x0) > 1 and np.median(gap) > max(body, 1e-12):
            raise UserError(
                f"{where}: in the first frame the points are {np.median(gap):.3g} m from the particles of x0 that they follow (track), "
                f"more than the size of the body, {body:.3g} m: give x and x0 in the same unit and frame"
            )


def check_motion(
    x: np.ndarray, t: np.ndarray, x0: np.ndarray, v0: np.ndarray, volume: np.ndarray, gravity: Sequence[float], where: str
) -> None:
    """Check tracked points of a body: its fall, its start, its volume, points that stand still, and gaps in time.

    Args:
        x: Positions [m], (T, N, 3); NaN where a point was not seen.
        t: Times [s], (T,).
        x0: Particles at the start [m], (P, 3).
        v0: Their velocities [m/s], (P, 3).
        volume: Their volumes [m^3], (P,).
        gravity: [m/s^2]
        where: Name of the file in messages.

    Raises:
        UserError: The body flies with an acceleration that is gravity in another unit or direction.
    """
    whole = x[:, np.isfinite(x).all(axis=(0, 2))]
    if len(t) > 2 and whole.shape[1]:
        middle = whole.mean(axis=1)
        check_upright(t, middle, gravity, "xyz", where)
        for a, axis in enumerate("xyz"):
            check_flight(t, middle[:, a], gravity[a], axis, where)
        if not np.ptp(whole, axis=0).any():
            _warn(f"{where}: no point moves in any of {len(t)} frames: is it the right take?")
        elif whole.shape[1] == x.shape[1] or whole.shape[1] > 8:
            start = float(np.median(np.linalg.norm(whole[1] - whole[0], axis=1)) / (t[1] - t[0]))
            stated = float(np.median(np.linalg.norm(v0, axis=1)))
            fall = float(np.linalg.norm(gravity)) * float(t[1] - t[0])
            slower, faster = sorted((start, stated))
            if faster > FASTEST * slower > 0 and faster > FASTEST * fall:
                _warn(f"{where}: v0 has {stated:.3g} m/s, and the points move at {start:.3g} m/s in the first two frames: check its unit")
    check_gaps(t, where)
    total = float(volume.sum(dtype=np.float64))
    grain = (total / len(volume)) ** (1 / 3)
    box = float(np.prod(np.ptp(x0, axis=0).astype(np.float64) + grain))
    if total > ROOM * box or total < box / EMPTY:
        _warn(f"{where}: the volumes add up to {total:.3g} m^3, and the box about x0 has {box:.3g} m^3: check the unit of volume")
