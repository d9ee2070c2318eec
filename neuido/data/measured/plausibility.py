"""What measured data cannot be: units, signs, order and markers, checked at reading; a refusal is one line that names what to change."""

import math
import warnings
from collections.abc import Mapping
from typing import Any

import numpy as np

from neuido.errors import UserError

MAX_UNIT_FACTOR = 300.0
"""How far a stiffness or an acceleration may be from the declared one before a unit is to blame."""
MAX_REST_FACTOR = 3.0
"""A path of stretches must come this near to 1 (as a factor), and none may be above `MOST`."""
MAX_STRETCH = 20.0
SENTINELS = (0.0, -9999.0, 9999.0, -999999.0)
"""What trackers write in all three coordinates of a marker that they did not see."""


def check_stretches(path: np.ndarray, where: str) -> None:
    """Refuse stretches (n, A) that look like a strain in percent, or a length.

    Raises:
        UserError: None is near 1, or one is far above what any material bears.
    """
    away = np.maximum(path, 1 / np.maximum(path, 1e-300)).max(axis=1)
    row = int(np.argmax(away))
    if away.min() > MAX_REST_FACTOR or path.max() > MAX_STRETCH:
        raise UserError(
            f"{where}: stretches run from {path.min():g} to {path.max():g} (data row {row}), and a stretch is 1 at rest: a strain in "
            "percent or a length? Let `neuido import` turn it into a stretch (--strain_unit percent, --length)"
        )


def check_order(path: np.ndarray, where: str) -> None:
    """Refuse the rows (n,) of a path without times that jump to and fro.

    Raises:
        UserError: They are in no order, as of a table that was shuffled.
    """
    steps = np.diff(path)
    moved = steps[steps != 0]
    if len(moved) < 7 or np.ptp(path) == 0:
        return
    turns = np.mean(moved[1:] * moved[:-1] < 0)
    if turns > 0.4 and np.median(np.abs(moved)) > 0.12 * np.ptp(path):
        row = int(np.argmax(np.abs(steps)))
        raise UserError(
            f"{where}: the rows jump to and fro (data row {row}: {path[row]:g}, then {path[row + 1]:g}), which is no path: sort them in "
            "the order of the test, or give columns.time"
        )


def check_stress(path: np.ndarray, stress: np.ndarray, model: Mapping[str, Any], where: str, *, timed: bool, rest: float = 1.0) -> None:
    """Refuse stresses that are zero, constant, of the wrong sign, or a thousand or a million times what the declared modulus gives.

    Args:
        path: Stretches or shears (n, A).
        stress: [Pa], (n, A).
        model: Has `elasticity`, perhaps with `young` [Pa].
        where: What the test is called in an error.
        timed: Whether it has times, so that it may be a creep test.
        rest: The path's value of the unloaded specimen.

    Raises:
        UserError: One of these.
    """
    if not stress.any():
        raise UserError(f"{where}: the stress is zero in all {len(stress)} rows: another column is meant (columns), or the channel was off")
    if not timed and len(stress) > 4 and np.ptp(stress) == 0 and np.ptp(path) > 0:
        raise UserError(f"{where}: the stress is {stress[0, 0]:g} Pa in all {len(stress)} rows while the specimen deforms: see columns")
    strain, force = path[:, 0] - rest, stress[:, 0]
    kept = (np.abs(strain) > 0.05 * np.abs(strain).max()) & (force != 0)
    if kept.sum() < 3:
        return
    secant = force[kept] / strain[kept]
    young = model.get("elasticity", {}).get("young")
    if np.mean(secant < 0) > 0.9:
        raise UserError(
            f"{where}: the stress is {force[kept][0]:g} Pa at {path[kept][0, 0]:g}, and tension (above {rest:g}) is positive here, "
            "compression negative: give scale a negative factor, or a stretch in place of a strain"
        )
    if not isinstance(young, int | float) or not young > 0:
        return
    ratios = np.abs(secant) / young
    if ratios.max() < 1 / MAX_UNIT_FACTOR or ratios.min() > MAX_UNIT_FACTOR:
        power = 10.0 ** (3 * round(math.log10(float(np.median(ratios))) / 3))
        raise UserError(
            f"{where}: stress over strain is {np.median(np.abs(secant)):.3g} Pa, about {power:g} times model.elasticity.young = {young:g} "
            f"Pa: are stresses in Pa? Give scale 1.0e{round(-math.log10(power)):+d} for the stress, or another young"
        )


def check_flight(t: np.ndarray, x: np.ndarray, gravity: float, axis: str, where: str) -> None:
    """Refuse heights in pixels, in millimetres, or with y down, told from the acceleration of a flight.

    Args:
        t: Times [s], (n,).
        x: Coordinates along one axis, (n,).
        gravity: The declared acceleration along it [m/s^2].
        axis: Its name.
        where: What the recording is called in an error.

    Raises:
        UserError: The body flies along a parabola whose acceleration is gravity's by another unit or sign.
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
    down = f" and {axis} points down" if ratio < 0 else ""
    unit = "no metres" if abs(ratio) > 30 else "metres"
    raise UserError(
        f"{where}: the acceleration along {axis} is {acceleration:.4g} /s^2, {ratio:.3g} times model.gravity: its figures are {unit}{down}"
        f"; give scale: {{{axis}: {1 / ratio:.3g}}} or the like, or use `neuido import --scale`"
    )


def mask_unseen(x: np.ndarray, where: str) -> np.ndarray:
    """Return positions (T, N, 3) with NaN where a marker that was not seen sits at a sentinel; a warning says how many.

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
            warnings.simplefilter("ignore", RuntimeWarning)  # of points that were never seen
            usual = np.nanmedian(np.where(hit[..., None], np.nan, x), axis=0)
        far = ~(np.abs(usual - value).max(axis=1) < 1e-3 * size)
        hit &= far & (hit.sum(axis=0) > 0)
        count += int(hit.sum())
        x[hit] = np.nan
    if not np.isfinite(x).any():
        raise UserError(f"{where}: no point of x was seen in any frame (all NaN): export the positions again")
    if count:
        warnings.warn(f"{where}: {count} points that sit at exactly 0 or -9999 are taken as not seen", stacklevel=2)
    return x


def check_positions(x: np.ndarray, x0: np.ndarray, track: np.ndarray | None, lower: np.ndarray, upper: np.ndarray, where: str) -> None:
    """Refuse positions (T, N, 3) that are in another unit or frame than the body x0 (P, 3) or the domain.

    Raises:
        UserError: Most lie a domain's size outside of it, or the first frame is far from the particles that it follows.
    """
    size = float((upper - lower).max())
    middle = np.nanmedian(x.reshape(-1, 3), axis=0)
    if ((middle < lower - size) | (middle > upper + size)).any():
        raise UserError(
            f"{where}: half of the positions lie beyond {', '.join(f'{v:.3g}' for v in middle)} m, and scene.domain ends at "
            f"{', '.join(f'{v:g}' for v in upper)}: is x in millimetres? Give metres, as of x0"
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
                f"more than the body's size of {body:.3g} m: x and x0 are in different units or frames"
            )
