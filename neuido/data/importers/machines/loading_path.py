"""Preparation of a measured loading path: choice of rows, zero of the strain, block means, thinning and cycles."""

import re
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from neuido.data.importers.tables.units import conversion_factor
from neuido.errors import UserError

MAX_ROWS = 400
"""Largest number of rows; a longer table is thinned evenly."""
LEAST_ROWS = 3
"""Rows of a test or of a part of it, at the least."""
REVERSAL = 0.05
"""Share of the range of a path by which it must turn back for a new loading or unloading to begin; noise of the strain is far below."""
TOE = (0.05, 0.2)
"""Shares of the largest stress of the first loading between which its straight line is taken, that of ASTM D638, annex A1."""
SLACK = (0.02, 0.05, 0.5)
"""A specimen may hang loose where the stress stays below this share of the largest, over this share of the path or more, and grows less
there than by this share of what it grows by over as much path again."""
LEVEL, HELD, MOVES, SLOWER = 0.01, 0.8, 0.05, 1.5
"""A stress is prescribed where it stays within the first share of its largest value over the second share of the rows, and where at a level
the strain moves by the third share of its range, in the first half of the time by the last factor more than in the second half. A machine
that prescribes the strain moves evenly there; creep and its recovery slow down."""
CYCLES, ZEROS = ("together", "split"), ("none", "first", "toe")


class Preparation(NamedTuple):
    """What is done to a measured path before it becomes a material test; each step is stated in the summary."""

    rows: str = ""
    """Data rows to use, START:STOP or START:STOP:STEP, counted from 0; all where empty."""
    average: int = 1
    """Number of rows whose mean becomes one row."""
    zero: str = "none"
    """Zero of the strain: `none`, `first`, `toe`, or the force or stress of a preload, such as `0.5 N`."""
    cycles: str = "together"
    """`together`: one history. `split`: each loading and unloading is a test of its own."""

    def changed(self) -> dict[str, object]:
        """Return the options that differ from those of no preparation."""
        return {name: value for name, value in self._asdict().items() if value != getattr(Preparation(), name)}


class Part(NamedTuple):
    """A half-open range of rows of a path in which it is loaded or unloaded."""

    name: str
    start: int
    stop: int


def prepare(
    columns: dict[str, np.ndarray], how: Preparation, summary: list[str], *, area: float | None = None, at_rest: bool = False
) -> tuple[dict[str, np.ndarray], list[Part]]:
    """Prepare the columns of a test, prescribed ones first; append what was done to `summary`.

    Args:
        columns: Quantities of a material test, (n,).
        how: The steps.
        summary: Lines of the summary.
        area: Cross-section [m^2], for a preload that is given as a force.
        at_rest: Whether the specimen is at rest until time zero; a row of zeros is then put before the first.

    Returns:
        The columns, and the parts of the path; one part without a name where it is not split.

    Raises:
        UserError: An option is malformed, or fewer than three rows remain.
    """
    if how.cycles not in CYCLES:
        raise UserError(f"--cycles {how.cycles} is unknown: choose from {', '.join(CYCLES)}")
    if how.average < 1:
        raise UserError(f"--average {how.average} must be a number of rows, at least 1")
    columns = _valid(_chosen(columns, how.rows), summary)
    _check_zero(columns, how.zero, summary, area)
    columns = _zeroed(columns, how.zero, summary, area)
    if how.average > 1:
        count, rest = divmod(len(next(iter(columns.values()))), how.average)
        columns = {key: values[: count * how.average].reshape(count, how.average).mean(1) for key, values in columns.items()}
        left = f"; the last {rest} rows, too few for a mean, are left out" if rest else ""
        summary.append(f"means of {how.average} rows each: {count} rows, whose noise is independent{left}")
    count = len(next(iter(columns.values())))
    every = max(1, -(-count // MAX_ROWS))
    if every > 1:
        summary.append(f"one row in {every} of {count} is used (--average {every} takes means)")
        columns = {key: values[::every] for key, values in columns.items()}
    if len(next(iter(columns.values()))) < LEAST_ROWS:
        raise UserError(f"{len(next(iter(columns.values())))} rows remain; at least {LEAST_ROWS} are needed: check --rows and --average")
    if at_rest:
        columns = {key: np.concatenate([[0.0], values]) for key, values in columns.items()}
    elif "time" in columns:
        if columns["time"][0] != 0:
            summary.append(f"times start at {columns['time'][0]:g} s, which becomes 0 s")
        columns["time"] = columns["time"] - columns["time"][0]
    prescribed, _ = _keys(columns)
    path, rest = columns[prescribed], 1.0 if prescribed.startswith("stretch") else 0.0
    parts = loading_parts(path - rest) if how.cycles == "split" else []
    if len(parts) > 1:
        summary.append(f"{len(parts)} loadings and unloadings: {', '.join(part.name for part in parts[:12])}")
        return columns, parts
    turns = len(loading_parts(path - rest)) - 1
    if turns > 0 and how.cycles == "together":
        summary.append(f"the path turns back {turns} times (--cycles split makes each loading and unloading a test)")
    return columns, [Part("", 0, len(path))]


def _chosen(columns: dict[str, np.ndarray], rows: str) -> dict[str, np.ndarray]:
    if not rows:
        return columns
    found = re.fullmatch(r"(\d{0,9}):(\d{0,9})(?::(\d{1,9}))?", str(rows).strip())
    if found is None or found[3] == "0" * len(found[3] or "1"):
        raise UserError(f"--rows {str(rows)[:40]!r} must be START:STOP or START:STOP:STEP, for example 0:200 or 5::12")
    count = len(next(iter(columns.values())))
    chosen = range(count)[int(found[1] or 0) : int(found[2]) if found[2] else None : int(found[3] or 1)]
    if len(chosen) < LEAST_ROWS:
        raise UserError(f"--rows {rows} leaves {len(chosen)} of {count} data rows; at least {LEAST_ROWS} are needed")
    return {key: values[chosen.start : chosen.stop : chosen.step] for key, values in columns.items()}


def _valid(columns: dict[str, np.ndarray], summary: list[str]) -> dict[str, np.ndarray]:
    """Drop rows that are incomplete or whose time does not increase."""
    valid = np.isfinite(np.stack(list(columns.values()))).all(axis=0)
    incomplete = int((~valid).sum())
    if incomplete:
        summary.append(f"{incomplete} rows without a number in every column are left out")
    if "time" in columns:
        latest = np.maximum.accumulate(np.where(valid, columns["time"], -np.inf))
        repeated = valid & (np.concatenate([[-np.inf], latest[:-1]]) >= columns["time"])
        if repeated.sum() > 0.2 * valid.sum():
            row = int(np.argmax(repeated))
            raise UserError(
                f"the time does not increase in {repeated.sum()} of {valid.sum()} rows (data row {row}: {columns['time'][row]:g} s): sort "
                "the rows, or name the right column with --columns.time"
            )
        if repeated.any():
            summary.append(f"{repeated.sum()} rows whose time does not increase are left out")
        valid &= ~repeated
    if valid.sum() < LEAST_ROWS:
        raise UserError("fewer than 3 rows have a number in every column: name the right columns with --columns")
    return {key: values[valid] for key, values in columns.items()}


def _keys(columns: dict[str, np.ndarray]) -> tuple[str, str]:
    """Return the names of the first prescribed and the first measured column."""
    return next(iter(columns)), next(key for key in columns if "stress" in key)


def _check_zero(columns: dict[str, np.ndarray], zero: str, summary: list[str], area: float | None) -> None:
    """Check the option; say where a specimen may have hung loose."""
    if zero not in ZEROS:
        _preload(zero, area)
    path, stress = (columns[key] for key in _keys(columns))
    top = int(np.argmax(np.abs(stress)))
    loose = np.flatnonzero(np.abs(stress[: top + 1]) > SLACK[0] * np.abs(stress[top]))
    if zero == "none" and len(loose) and top > 0:
        i = int(loose[0])
        share = abs(path[i] - path[0]) / max(float(np.ptp(path[: top + 1])), 1e-30)
        later = int(np.argmax(np.abs(path[i : top + 1] - path[0]) >= min(2 * abs(path[i] - path[0]), abs(path[top] - path[0])))) + i
        if share > SLACK[1] and abs(stress[i] - stress[0]) < SLACK[2] * abs(stress[later] - stress[i]):
            summary.append(
                f"the first {100 * share:.0f} % of the path carry less than {100 * SLACK[0]:.0f} % of the stress: slack? (--zero toe)"
            )


def _zeroed(columns: dict[str, np.ndarray], zero: str, summary: list[str], area: float | None) -> dict[str, np.ndarray]:
    """Shift the zero of the strain, and for `first` that of the stress; drop the rows before it."""
    if zero == "none":
        return columns
    prescribed, measured = _keys(columns)
    if prescribed.endswith("_1"):
        raise UserError("--zero is for tests along one axis")
    path, stress = columns[prescribed], columns[measured]
    rest = 1.0 if prescribed == "stretch" else 0.0
    first, strain, offset = 0, path[0] - rest, 0.0
    if zero == "first":
        offset = float(stress[0])
    elif zero == "toe":
        first, strain = _toe(path - rest, stress)
    else:
        level = _preload(zero, area)
        reached = np.flatnonzero(np.abs(stress) >= level)
        if not len(reached):
            raise UserError(f"--zero {zero!r}: the largest stress is {np.abs(stress).max():.4g} Pa, below this preload of {level:.4g} Pa")
        first, strain = int(reached[0]), float(path[reached[0]] - rest)
    summary.append(f"zero of the strain ({zero}): shifted by {strain:.4g}" + (f", {first} rows before it left out" if first else "")
                   + (f"; stress by {offset:.4g} Pa" if offset else ""))  # fmt: skip
    return {key: values[first:] - (strain if key == prescribed else offset if key == measured else 0.0) for key, values in columns.items()}


def _toe(strain: np.ndarray, stress: np.ndarray) -> tuple[int, float]:
    """Return the first row that is loaded and the strain at which the straight line of the first loading meets zero stress."""
    top = int(np.argmax(np.abs(stress)))
    part = np.abs(stress[: top + 1]) / np.abs(stress[top])
    chosen = np.flatnonzero((part >= TOE[0]) & (part <= TOE[1]))
    if len(chosen) < LEAST_ROWS or np.ptp(strain[chosen]) == 0:
        raise UserError(
            f"--zero toe needs three rows between {100 * TOE[0]:.0f} and {100 * TOE[1]:.0f} % of the largest stress, and there are "
            f"{len(chosen)}: give a preload, for example --zero '0.5 N', or --zero first"
        )
    slope, intercept = np.polynomial.Polynomial.fit(strain[chosen], stress[chosen], 1).convert().coef[::-1]
    shift = float(-intercept / slope)
    sign = np.sign(strain[top] - shift)
    return int(np.argmax(sign * (strain - shift) >= 0)), shift


def _preload(text: str, area: float | None) -> float:
    """Return the stress [Pa] of a preload such as `0.5 N` or `2 kPa`."""
    found = re.fullmatch(r"\s*([0-9.]+(?:[eE][-+]?[0-9]+)?)\s*([^\s\d].{0,20})", str(text))
    if found is None or found[1].count(".") > 1:
        raise UserError(f"--zero {str(text)[:40]!r} must be {', '.join(ZEROS)} or a preload with a unit, for example '0.5 N' or '2 kPa'")
    if found[2].strip().lower().rstrip() in ("n", "kn", "mn", "lbf", "kgf", "gf"):
        if area is None:
            raise UserError(f"--zero {text!r} is a force, and the table has stresses: give a stress, for example '2 kPa'")
        return float(found[1]) * conversion_factor(found[2].strip(), "N", "--zero") / area
    return float(found[1]) * conversion_factor(found[2].strip(), "Pa", "--zero")


def loading_parts(path: np.ndarray) -> list[Part]:
    """Split a strain path (n,) where it turns back by more than `REVERSAL` of its range; parts of fewer than three rows are none."""
    span = float(np.ptp(path))
    if span == 0:
        return [Part("load-1", 0, len(path))]
    turns, extreme, direction = [0], 0, 0
    for i, value in enumerate(path):
        if direction == 0:
            if abs(value - path[0]) > REVERSAL * span:
                direction, extreme = (1 if value > path[0] else -1), i
        elif (value - path[extreme]) * direction > 0:
            extreme = i
        elif (path[extreme] - value) * direction > REVERSAL * span:
            turns.append(extreme + 1)
            direction, extreme = -direction, i
    bounds = [*turns, len(path)]
    kept = [bounds[0]]
    for bound in bounds[1:-1]:
        if bound - kept[-1] >= LEAST_ROWS and len(path) - bound >= LEAST_ROWS:
            kept.append(bound)
    kept.append(len(path))
    returns = abs(path[0]) > abs(path[kept[1] - 1]) + REVERSAL * span  # it starts loaded
    names = ["unload" if i % 2 != returns else "load" for i in range(len(kept) - 1)]
    return [Part(f"{name}-{i // 2 + 1}", start, stop) for i, (name, start, stop) in enumerate(zip(names, kept, kept[1:]))]


def holds_stress(columns: Mapping[str, np.ndarray]) -> bool:
    """Return whether a test along one axis prescribes its stress: it stays at one or several levels while the strain follows ever slower.

    A stress that yields may stay at a level too, but there the machine moves on at the same rate.
    """
    if "time" not in columns or len(columns) != 3:
        return False
    (path, stress), time = (values for key, values in columns.items() if key != "time"), columns["time"]
    largest, size = float(np.abs(stress).max()), float(np.ptp(path))
    if not (largest > 0 and size > 0):
        return False
    levels, start = [], 0
    for i in range(1, len(stress) + 1):
        if i == len(stress) or np.ptp(stress[start : i + 1]) > LEVEL * largest:
            levels.append(slice(start, i))
            start = i
    held = [rows for rows in levels if rows.stop - rows.start >= 2 * LEAST_ROWS]
    if sum(rows.stop - rows.start for rows in held) < HELD * len(stress):
        return False

    def creeps(rows: slice) -> bool:
        e, t = path[rows], time[rows]
        half = int(np.searchsorted(t, (t[0] + t[-1]) / 2))
        early, late = abs(float(e[half] - e[0])), abs(float(e[-1] - e[half]))
        return early + late > MOVES * size and early > SLOWER * late

    return any(creeps(rows) for rows in held)
