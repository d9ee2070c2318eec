"""Plausibility checks of measured data: units, signs, order of rows and unseen markers.

Each error is one line that says what is implausible and what to change.
"""

import math
import warnings
from collections.abc import Mapping
from typing import Any

import numpy as np

from neuido.errors import UserError

MAX_UNIT_FACTOR = 300.0
"""Ratio of measured to declared stiffness above which, or below whose inverse, the unit is taken to be wrong."""
MAX_REST_FACTOR = 3.0
"""Factor from 1 within which at least one stretch of a test must lie."""
MAX_STRETCH = 20.0
"""Largest plausible stretch."""
SENTINELS = (0.0, -9999.0, 9999.0, -999999.0)
"""Values that trackers write into all three coordinates of a marker that they did not see."""


def check_stretches(path: np.ndarray, where: str) -> None:
    """Check that stretches (n, A) are not strains in percent, or lengths.

    Raises:
        UserError: No stretch is near 1, or one exceeds `MAX_STRETCH`.
    """
    away = np.maximum(path, 1 / np.maximum(path, 1e-300)).max(axis=1)
    row = int(np.argmax(away))
    if away.min() > MAX_REST_FACTOR or path.max() > MAX_STRETCH:
        raise UserError(
            f"{where}: stretches range from {path.min():g} to {path.max():g} (data row {row}), but a stretch is 1 at rest; are they "
            "strains in percent, or lengths? `neuido import` converts them (--units.strain percent, --length)"
        )


def check_order(path: np.ndarray, where: str) -> None:
    """Check that the rows (n,) of a path without times are in loading order.

    Raises:
        UserError: The values jump up and down between rows, as in a shuffled table.
    """
    steps = np.diff(path)
    moved = steps[steps != 0]
    if len(moved) < 7 or np.ptp(path) == 0:
        return
    turns = np.mean(moved[1:] * moved[:-1] < 0)
    if turns > 0.4 and np.median(np.abs(moved)) > 0.12 * np.ptp(path):
        row = int(np.argmax(np.abs(steps)))
        raise UserError(
            f"{where}: values jump up and down between rows (data row {row}: {path[row]:g}, then {path[row + 1]:g}): sort the rows in "
            "loading order, or give columns.time"
        )


def check_stress(path: np.ndarray, stress: np.ndarray, model: Mapping[str, Any], where: str, *, timed: bool, rest: float = 1.0) -> None:
    """Check that stresses are not zero, constant, of the wrong sign, or in another unit than Pa.

    Args:
        path: Stretches or shears (n, A).
        stress: [Pa], (n, A).
        model: The declared model, with `elasticity`, which may have `young` [Pa].
        where: Name of the test in error messages.
        timed: Whether the test has times; it may then be a creep test.
        rest: Value of the path at rest: 1 for a stretch, 0 for a shear.

    Raises:
        UserError: The stresses fail one of these checks.
    """
    if not stress.any():
        raise UserError(
            f"{where}: the stress is zero in all {len(stress)} rows: name the right column (columns), or check the force channel"
        )
    if not timed and len(stress) > 4 and np.ptp(stress) == 0 and np.ptp(path) > 0:
        raise UserError(
            f"{where}: the stress is {stress[0, 0]:g} Pa in all rows although the specimen deforms: name the right column (columns)"
        )
    strain, force = path[:, 0] - rest, stress[:, 0]
    kept = (np.abs(strain) > 0.05 * np.abs(strain).max()) & (force != 0)
    if kept.sum() < 3:
        return
    secant = force[kept] / strain[kept]
    young = model.get("elasticity", {}).get("young")
    if np.mean(secant < 0) > 0.9:
        raise UserError(
            f"{where}: the stress is {force[kept][0]:g} Pa at {path[kept][0, 0]:g}, but tension (above {rest:g}) must be positive and "
            "compression negative: give scale a negative factor, or give a stretch and not a strain"
        )
    if not isinstance(young, int | float) or not young > 0:
        return
    ratios = np.abs(secant) / young
    if ratios.max() < 1 / MAX_UNIT_FACTOR or ratios.min() > MAX_UNIT_FACTOR:
        power = 10.0 ** (3 * round(math.log10(float(np.median(ratios))) / 3))
        raise UserError(
            f"{where}: stress over strain is {np.median(np.abs(secant)):.3g} Pa, about {power:g} times model.elasticity.young = {young:g} "
            f"Pa; are the stresses in Pa? Give the stress the scale 1.0e{round(-math.log10(power)):+d}, or correct young"
        )


def check_flight(t: np.ndarray, x: np.ndarray, gravity: float, axis: str, where: str) -> None:
    """Check that the coordinates of a flight are in metres with the declared direction of gravity.

    Args:
        t: Times [s], (n,).
        x: Coordinates along one axis, (n,).
        gravity: Declared gravity along this axis [m/s^2].
        axis: Name of the axis.
        where: Name of the recording in error messages.

    Raises:
        UserError: The path is a parabola whose acceleration differs from gravity by a unit (pixels, millimetres) or by its sign.
    """
    if len(t) < 6 or abs(gravity) < 1 or np.ptp(x) == 0:
        return
    time = (t - t[0]) / (t[-1] - t[0])
    parabola = np.polynomial.Polynomial.fit(time, x, 2, domain=[0, 1], window=[0, 1])
    left = np.std(x - parabola(time)) / np.ptp(x)
    acceleration = 2 * parabola.coef[2] / (t[-1] - t[0]) ** 2
    ratio = acceleration / gravity
    if left > 0.03 or not (abs(ratio) > 30 or -1.3 < ratio < -0.7):
        return
    sign = f"{axis} points down" if ratio < 0 else ""
    unit = "the unit is not metres" if abs(ratio) > 30 else ""
    raise UserError(
        f"{where}: the acceleration along {axis} is {acceleration:.4g} /s^2, {ratio:.3g} times model.gravity: "
        f"{' and '.join(filter(None, (unit, sign)))}; give about scale: {{{axis}: {1 / ratio:.3g}}}, or use `neuido import --scale`"
    )


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
        warnings.warn(f"{where}: {count} positions of exactly 0 or -9999 count as not seen", stacklevel=2)
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
