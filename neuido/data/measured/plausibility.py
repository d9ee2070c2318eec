"""Plausibility checks of material tests: units, signs and order of rows.

Each error or warning is one line that says what is implausible and what to change.
"""

import math
import warnings
from collections.abc import Mapping
from typing import Any

import numpy as np

from neuido.errors import PlausibilityWarning, UserError

MAX_UNIT_FACTOR = 300.0
"""Ratio of measured to declared stiffness above which, or below whose inverse, the unit is taken to be wrong."""
MAX_REST_FACTOR = 3.0
"""Factor from 1 within which at least one stretch of a test must lie."""
MAX_STRETCH = 20.0
"""Largest plausible stretch."""
ODD_UNIT_FACTOR = 30.0
"""The same ratio above which it is said, without an error: a guess may be as far off, a unit is farther."""
LONGEST_TEST = 3e8
"""Duration [s] above which times are taken for milliseconds or Unix times in them: ten years."""
DENSITIES = (5.0, 3e4)
"""Densities [kg/m^3] between that of the lightest foams and that of osmium."""
JUMP = (10.0, 0.3)
"""A lone row is away from its neighbours by this many usual distances, and by this share of the range of all other rows."""
FEW = 3
"""Rows from which a ratio is taken, at the least."""


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
    if len(path) > 4 and np.ptp(path) == 0 and (not timed or path[0, 0] == rest):
        raise UserError(f"{where}: the stretch or shear is {path[0, 0]:g} in all {len(path)} rows: name the right column (columns)")
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
    near = np.argsort(np.abs(strain[kept]), kind="stable")[: max(FEW, int(kept.sum()) // 3)]  # large strains may stiffen or flow
    ratio = float(np.median(np.abs(secant[near]))) / young
    if 1 / ODD_UNIT_FACTOR < ratio < ODD_UNIT_FACTOR:
        return
    modulus = f"stress over strain is {ratio * young:.3g} Pa at small strain, {{}} times model.elasticity.young = {young:g} Pa"
    if 1 / MAX_UNIT_FACTOR <= ratio <= MAX_UNIT_FACTOR:
        warnings.warn(f"{where}: {modulus.format(f'{ratio:.2g}')}: check the unit, or correct young", PlausibilityWarning, stacklevel=2)
        return
    power = 10.0 ** (3 * round(math.log10(ratio) / 3))
    raise UserError(
        f"{where}: {modulus.format(f'about {power:g}')}; are the stresses in Pa? Give the stress the scale "
        f"1.0e{round(-math.log10(power)):+d}, or correct young"
    )


def check_density(density: float) -> None:
    """Warn of a declared density [kg/m^3] that looks like one in g/cm^3 or in kg/mm^3."""
    if not DENSITIES[0] <= density <= DENSITIES[1]:
        warnings.warn(
            f"model.density = {density:g} kg/m^3 is that of no soft or solid body: check the unit", PlausibilityWarning, stacklevel=2
        )


def check_rows(path: np.ndarray, stress: np.ndarray, time: np.ndarray | None, where: str) -> None:
    """Warn of rows that stand still, of single rows that jump, and of gaps in time.

    Args:
        path: Stretches or shears (n, A).
        stress: [Pa], (n, A).
        time: [s], (n,), or None.
        where: Name of the test in messages.
    """
    same = (np.diff(path, axis=0) == 0).all(axis=1) & (np.diff(stress, axis=0) == 0).all(axis=1)
    if len(same) > 8 and same.mean() > 0.5:
        row = int(np.argmax(same))
        warnings.warn(
            f"{where}: {int(same.sum())} of {len(path)} rows repeat the one before (data row {row + 1}): was the clock faster than the "
            "channels? Leave the repeats out (rows)", PlausibilityWarning, stacklevel=2,
        )  # fmt: skip
    for j in range(stress.shape[1]):
        if stress.shape[1] > 1 and not stress[:, j].any():
            warnings.warn(f"{where}: stress {j + 1} is zero in all rows: check the channel (columns)", PlausibilityWarning, stacklevel=2)
        row = lone_jump(stress[:, j])
        if row is not None:
            warnings.warn(
                f"{where}: the stress jumps to {stress[row, j]:.4g} Pa in data row {row} and back: leave it out (rows) if the "
                "channel failed",
                PlausibilityWarning, stacklevel=2,
            )  # fmt: skip
    if time is not None and len(time) > 1 and np.ptp(time) > LONGEST_TEST:
        warnings.warn(
            f"{where}: the test lasts {np.ptp(time):.3g} s; are the times in ms? (scale: {{time: 0.001}})",
            PlausibilityWarning,
            stacklevel=2,
        )


def lone_jump(values: np.ndarray) -> int | None:
    """Return the row of the largest value that is away from both neighbours, by far more than other rows; None if there is none."""
    if len(values) < 8 or np.ptp(values) == 0:
        return None
    off = np.abs(values[1:-1] - 0.5 * (values[:-2] + values[2:]))
    row = int(np.argmax(off)) + 1
    back = abs(values[row + 1] - values[row - 1])
    alone = off[row - 1] > JUMP[0] * max(float(np.median(off)), back) and off[row - 1] > JUMP[1] * np.ptp(np.delete(values, row))
    return row if alone else None
