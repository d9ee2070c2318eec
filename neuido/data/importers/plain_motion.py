"""Reader of plain tables of motion: one point, points by id, points by the names of columns, several recordings, angles."""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from neuido.data.files.delimited import is_number
from neuido.data.importers.tables.clocks import timecode_seconds
from neuido.data.importers.tables.titled_tables import Table, read_titled
from neuido.data.importers.tables.titles import find_columns, named_points
from neuido.data.importers.tables.units import conversion_factor
from neuido.errors import UserError

REPEATED = 0.1
"""Share of rows that may repeat the time of a point at another place; with more, the table holds several recordings or a coarse clock."""
ANGLE = "angle"
"""First word of the unit of a motion whose single coordinate is an angle, before the angle's own unit: `angle deg`."""


class Motion(NamedTuple):
    """Positions of named points in T frames."""

    t: np.ndarray
    """Times [s] (T,), or frame numbers if `frames` is true."""
    points: dict[str, np.ndarray]
    """Positions (T, A) of each point by name; NaN if not seen."""
    unit: str
    """Unit of the positions; empty if the file states none, `ANGLE` with its own of angles."""
    frames: bool
    """Whether `t` holds frame numbers."""
    notes: list[str]
    """How the file was read, for the summary."""
    timed: bool = False
    """Whether the file states the unit of its times."""


def read_plain(path: Path, columns: dict[str, str], frame_rate: float | None = None) -> dict[str, Motion]:
    """Read a table with columns of time and positions; return the motion of each recording in it by its name, empty if there is one.

    Args:
        path: The file.
        columns: Title of the column of a quantity, if it is not recognised.
        frame_rate: Frames a second, for timecodes [1/s].

    Raises:
        UserError: Time or positions are missing, or rows repeat the time of a point at other places.
    """
    table = read_titled(path)
    found = find_columns(table.titles, columns, table.units)
    column = found.get("recording")
    names = _cells(table, column) if column is not None else []
    own = [name for name in dict.fromkeys(names) if name]
    if len(own) < 2:
        return {"": _motion(path, table, found, frame_rate)}
    out = {}
    for name in own:
        chosen = [i for i, other in enumerate(names) if other == name]
        notes = [*table.notes, f"column {column + 1} {table.titles[column]!r} -> recording"]
        part = table._replace(data=table.data[chosen], cells=[table.cells[i] for i in chosen], notes=notes)
        out[name] = _motion(path, part, found, frame_rate)
    return out


def _cells(table: Table, column: int) -> list[str]:
    return [row[column] if column < len(row) else "" for row in table.cells]


def _motion(path: Path, table: Table, found: Mapping[str, int], frame_rate: float | None) -> Motion:
    points = {"": {axis: found[axis] for axis in "xyz" if axis in found}}
    if not points[""]:
        named = named_points(table.titles)
        points = named or ({"": {"x": found["displacement"]}} if "displacement" in found else {})
    clock = next((name for name in ("time", "frame") if name in found), None)
    angle = not points and "angle" in found
    if angle:
        points = {"": {"x": found["angle"]}}
    if not points or (clock is None and frame_rate is None):
        titles = ", ".join(filter(None, table.titles))[:150]
        each = "" if not points else ", or give --frame_rate if each row is a frame"
        raise UserError(
            f"{path.name} has no time or no position: name their columns with --columns.time TITLE --columns.x TITLE{each} "
            f"(titles: {titles})"
        )
    axes = next(iter(points.values()))
    if "z" in axes and "y" not in axes:
        title = table.titles[axes["z"]]
        raise UserError(f"{path.name} has z and no y, which points up: give --columns.y {title!r} if {title!r} is the height")
    used = [(name or "", axis, i) for name, own in points.items() for axis, i in own.items()]
    notes = [*table.notes, *(f"column {i + 1} {table.titles[i]!r} -> {f'{name} {axis}'.strip()}" for name, axis, i in
                             [*([("", clock, found[clock])] if clock else []), *used])]  # fmt: skip
    if clock is None:
        notes.append("no column of time: each row is a frame")
    if not found.keys() & set("xyz") and "displacement" in found and "" in points:
        notes.append("one displacement is taken as horizontal (--columns.y where it points up)")
    t, timed = _times(path, table, found[clock], clock, frame_rate) if clock else (np.arange(len(table.data), dtype=float), False)
    unit, factors = (f"{ANGLE} {table.units[axes['x']]}".strip(), {}) if angle else _unit(path, table, [i for *_, i in used], notes)
    read = {}
    for name, own in points.items():
        x = np.column_stack([factors.get(i, 1.0) * table.data[:, i] for i in own.values()])
        read[name] = x if "x" in own else np.column_stack([np.zeros(len(x)), x])
    ids = _ids(table, found.get("id"), t, next(iter(read.values())), path)
    if ids is None or len(read) > 1:
        seen = {name or _label(path): x for name, x in read.items()}
        return Motion(t, seen, unit, clock != "time", notes, timed)
    return _by_id(path, t, next(iter(read.values())), ids, Motion(t, {}, unit, clock != "time", notes, timed))


def _times(path: Path, table: Table, column: int, clock: str, frame_rate: float | None) -> tuple[np.ndarray, bool]:
    """Return times [s], or numbers in an unknown unit; and whether the unit is known."""
    t = table.data[:, column]
    if clock != "time":
        return t, False
    timecodes = timecode_seconds(_cells(table, column), frame_rate, path.name)
    if timecodes is not None:
        return np.array(timecodes), True
    unit = table.units[column]
    return (t * conversion_factor(unit, "s", f"{path.name}, time"), True) if unit else (t, False)


def _unit(path: Path, table: Table, used: Sequence[int], notes: list[str]) -> tuple[str, dict[int, float]]:
    """Return the unit of positions, and factors that bring columns in different units to metres."""
    units = {table.units[i] for i in used}
    if len(units) == 1:
        return units.pop(), {}
    if "" in units:
        missing = next(table.titles[i] for i in used if not table.units[i])
        others = ", ".join(sorted(units - {""}))
        raise UserError(f"{path.name}: column {missing!r} has no unit and others have ({others}): export all in one unit")
    notes.append(f"axes in different units ({', '.join(sorted(units))}), converted")
    return "m", {i: conversion_factor(table.units[i], "m", f"{path.name}, {table.titles[i]}") for i in used}


def _ids(table: Table, column: int | None, t: np.ndarray, x: np.ndarray, path: Path) -> list[str] | None:
    """Return the name of the point of each row; None where rows are not told apart.

    Raises:
        UserError: Rows with a position have no name.
    """
    cells = _cells(table, column) if column is not None else []
    if not any(cells):
        return None
    placed = np.isfinite(t) & np.isfinite(x).any(axis=1)
    unnamed = sum(1 for cell, here in zip(cells, placed) if here and not cell)
    if unnamed:
        title = table.titles[column or 0]
        raise UserError(f"{path.name}: {unnamed} rows have a position and no name in column {title!r}: give each point a name or number")
    return [f"{float(cell):g}" if is_number(cell) else cell[:40] for cell in cells]


def _by_id(path: Path, t: np.ndarray, x: np.ndarray, ids: Sequence[str], motion: Motion) -> Motion:
    """Return the motion of each point of a table with one row for each point and time."""
    times = np.unique(t[np.isfinite(t)])
    rows: dict[str, list[int]] = {}
    for i, name in enumerate(ids):
        if name and np.isfinite(t[i]):
            rows.setdefault(name, []).append(i)
    points, repeated, moved = {}, 0, 0
    order = sorted(rows, key=lambda name: (0, float(name), "") if is_number(name) else (1, 0.0, name))
    for name in order:
        chosen, values = np.array(rows[name]), np.full((len(times), x.shape[1]), np.nan)
        places = np.searchsorted(times, t[chosen])
        values[places] = x[chosen]
        repeated += len(chosen) - len(np.unique(places))
        moved += int((np.abs(values[places] - x[chosen]) > 0).any(axis=1).sum())
        points[name] = values
    if moved > REPEATED * len(t):
        raise UserError(
            f"{path.name}: {moved} of {len(t)} rows repeat the time of a point at another place: does the table hold several recordings? "
            "Name the column that tells them apart (--columns.recording TITLE), or give each a file"
        )
    notes = [*motion.notes, f"{len(points)} points by id"]
    if repeated:
        notes.append(f"{repeated} rows repeat the time of a point, of which the last counts")
    return motion._replace(t=times, points=points, notes=notes)


def _label(path: Path) -> str:
    return re.sub(r"[^\w-]+", "-", path.stem).strip("-._") or "track"
