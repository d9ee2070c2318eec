"""Convert motions to SI units, and write one point of each as a folder of tracks."""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from neuido.data.files.parsing import naming
from neuido.data.importers.declared_guide import Guide, declared_guide, guided_axes
from neuido.data.importers.plain_motion import ANGLE, REPEATED, Motion
from neuido.data.importers.tables.checked_folder import write_tables
from neuido.data.importers.tables.units import conversion_factor
from neuido.data.measured.held_start import held_rows
from neuido.data.measured.motion_plausibility import lost_positions
from neuido.errors import UserError

LEAST_RUN = 5
"""Rows in order, on average, from which on a file is taken for several recordings one after the other, and not for rows in disorder."""
SCALE_ERROR = 0.01
"""Least relative standard deviation of a length scale. One read from an object in the picture, or of a sensor's calibration, is off by 1 to
2 %, which would look like another gravity."""
EPOCHS = ((1e17, 1e9, "ns"), (1e14, 1e6, "µs"), (1e11, 1e3, "ms"))
"""Unix times since 1973 in smaller units than seconds: from which number on, units in a second, and name."""


class Axes(NamedTuple):
    """What converts positions and times of a tracker to metres with +y up, and to seconds."""

    scale: float | None = None
    """Metres a unit of the positions; None: by the unit of the file."""
    y_down: bool = False
    up: str = "y"
    frame_rate: float | None = None
    """[1/s], where the file counts frames."""


class RecordedMotion(NamedTuple):
    """A motion in SI units."""

    t: np.ndarray
    """Times [s] (T,), increasing from 0."""
    points: dict[str, np.ndarray]
    """Positions [m] of each point by its name, (T, A), +y up; NaN where it was not seen."""
    notes: list[str]
    scale_error: float = 0.0
    """Relative error of the scale; 0 if it is given."""
    angle: bool = False
    """Whether the only coordinate of the only point is an angle [rad]."""
    start: float = 0.0
    """Time of the first frame in the file [s]."""


def in_si(path: Path, motion: Motion, units: Mapping[str, str], axes: Axes) -> RecordedMotion:
    """Convert a motion to SI units, with +y up and increasing times from 0.

    Raises:
        UserError: The unit, scale or frame rate is unknown, or fewer than three frames have a time. The message names the option.
    """
    if not motion.points:
        raise UserError(f"{path.name} contains no positions: name their columns with --columns.x TITLE --columns.y TITLE")
    notes = list(motion.notes)
    clock, order = _times(path, motion, units, axes, notes)
    t = clock - clock[0]
    if motion.unit.partition(" ")[0] == ANGLE:
        unit = units.get("angle") or motion.unit.partition(" ")[2]
        if not unit:
            raise UserError(f"{path.name} has an angle without a unit: give --units.angle deg or rad")
        turned = {name: x[order] * conversion_factor(unit, "rad", f"{path.name}, --units.angle") for name, x in motion.points.items()}
        return RecordedMotion(t, turned, [*notes, f"angle in {unit}"], angle=True)
    unit = units.get("x", motion.unit)
    if axes.scale is not None:
        ratio = axes.scale
    elif unit.lower() in ("px", "pixel", "pixels"):
        raise UserError(f"{path.name} has positions in pixels: give --scale (metres per pixel), and --y_down true if y points down")
    else:
        ratio = conversion_factor(unit, "m", f"{path.name}, --units.x") if unit else 1.0
        notes.append(f"positions in {unit}" if unit else "positions without a unit, taken as metres (--scale)")
    points, lost = {}, 0
    for name, x in motion.points.items():
        x = x[order].copy()
        unseen = lost_positions(x)
        lost += int(unseen.sum())
        x[unseen] = np.nan
        x = x * ratio
        if axes.y_down and x.shape[1] > 1:
            x[:, 1] *= -1
        points[name] = upright(x, axes.up)
    if lost:
        notes.append(f"{lost} positions of exactly 0 or -9999 count as not seen")
    return RecordedMotion(t, points, notes, start=float(clock[0]))


def upright(x: np.ndarray, up: str) -> np.ndarray:
    """Return positions (T, A) with +y up, of which `up` points up."""
    return np.stack([x[:, 0], x[:, 2], -x[:, 1]], 1) if up == "z" and x.shape[1] == 3 else x


def write_tracks(
    takes: Mapping[str, tuple[Path, RecordedMotion]],
    out: str | os.PathLike | None,
    *,
    roles: Mapping[str, str],
    point: str | None,
    mass: float | None,
    diameter: float | None,
    guide: Guide,
    floor: float | None = None,
) -> list[str]:
    """Write one point of each file as a folder `neuido-track/1`; return the lines of the summary.

    Args:
        takes: File and motion in SI units of each recording by its name.
        out: The folder to create. None: check the content and write nothing.
        roles: `fit` or `held_out` of each recording.
        point: Name of the point to follow, or `mean`.
        mass: Of the body [kg].
        diameter: Of the body [m].
        guide: What guides the body.
        floor: Height of the tracked point when the body touches the floor that it bounces from [m].

    Raises:
        UserError: Something is missing.
    """
    from neuido.data.measured.track import read_tracks

    summary, tables, recordings, scale_error = [], {}, [], SCALE_ERROR
    model, said = declared_guide(guide, floor=floor, mass=mass)
    for name, (path, (t, points, notes, error, angle, _)) in takes.items():
        with naming(path):
            x = one_point(points, point, path)
        if angle and guide.type not in ("pendulum", "axis"):
            raise UserError(f"{path.name} has an angle: give --guide pendulum and its length, as --length '0.8 m', or --guide axis")
        scale_error = max(scale_error, error)
        summary += [f"{path.name}: {note}" for note in notes]
        seen = np.isfinite(x).all(axis=1)
        if seen.sum() < 3:
            raise UserError(f"{path.name}: the point is seen in {seen.sum()} frames; at least 3 are needed")
        if not seen.all():
            summary.append(f"{path.name}: {int((~seen).sum())} frames without the point are left out")
        names = ["angle"] if angle else list("xyz"[: x.shape[1]])
        still = [axis for a, axis in enumerate(names) if np.ptp(x[seen, a]) == 0]
        if len(still) == len(names):
            raise UserError(f"{path.name}: the point is at the same place in all {seen.sum()} frames: name the right columns, or --point")
        if still:
            summary.append(f"{path.name}: {', '.join(still)} does not change and is left out")
        if guide.type == "none":
            held = held_rows(t[seen], x[seen], [model["gravity"]["xyz".index(axis)] for axis in names])
            if held:
                first, after = t[seen][[0, held]]
                summary.append(
                    f"{path.name}: held at first, since it keeps its height for longer than a free body can: the {held} frames before "
                    f"{after - first:.4g} s are left out"
                )
                seen[np.flatnonzero(seen)[:held]] = False
        kept, left = guided_axes(guide.type, x[seen], names)
        if left:
            summary.append(f"{path.name}: {left}")
        kept = [axis for axis in kept if axis not in still]
        tables[name] = {"t": t[seen] - t[seen][0], **{axis: x[seen, names.index(axis)] for axis in kept}}
        recordings.append({"name": name, "body": "body", "file": f"{name}.csv", "columns": {key: key for key in ("t", *kept)},
                           "role": roles[name]})  # fmt: skip
    figures = {key: value for key, value in (("mass", mass), ("diameter", diameter)) if value is not None}
    summary += said
    if len(figures) < 2 and guide.type == "none":
        summary.append("mass or diameter of the body is unknown (--mass in kg, --diameter in m): forces are reported per unit mass")
    content = {"format": "neuido-track/1", "name": next(iter(takes)), "model": model, "bodies": {"body": figures},
               "recordings": recordings}  # fmt: skip
    if not any(take.angle for _, take in takes.values()):
        content["nuisances"] = {"length_scale": float(f"{scale_error:.2g}")}
        summary.append(f"the length scale is taken to be known to {100 * scale_error:.2g} % (nuisances of track.yaml)")
    return summary + write_tables(out, "track.yaml", content, tables, read_tracks)


def one_point(points: Mapping[str, np.ndarray], point: str | None, path: Path) -> np.ndarray:
    """Select the point to track by name; `mean` is the mean of all points.

    Raises:
        UserError: There are several points and none is chosen, or none has this name.
    """
    if point == "mean":
        return np.mean(list(points.values()), axis=0)
    if point is None and len(points) == 1:
        return next(iter(points.values()))
    if point is None or point not in points:
        raise UserError(
            f"{path.name} has the points {', '.join(list(points)[:12])}: select one with --point NAME, or give --point mean or --kind body"
        )
    return points[point]


def _times(path: Path, motion: Motion, units: Mapping[str, str], axes: Axes, notes: list[str]) -> tuple[np.ndarray, np.ndarray]:
    """Return increasing times [s], and the rows that they belong to; append what was done to `notes`."""
    t = motion.t
    if motion.frames:
        if axes.frame_rate is None:
            raise UserError(f"{path.name} has frame numbers and no times: give --frame_rate (frames per second)")
        t = t / axes.frame_rate
    elif "time" in units:
        t = t * conversion_factor(units["time"], "s", "--units.time")
    elif not motion.timed and np.isfinite(t).any():
        for least, count, name in EPOCHS:
            if float(np.nanmedian(t)) > least:
                t = t / count
                notes.append(f"times are Unix times in {name}")
                break
    _check_repeats(path, t, motion.points, axes.frame_rate)
    order = np.argsort(t, kind="stable")
    order = order[np.isfinite(t[order])]
    kept = order[np.concatenate([[True], np.diff(t[order]) > 0])] if len(order) else order
    if len(kept) < 3:
        raise UserError(f"{path.name} has {len(kept)} frames with distinct times; at least 3 are needed")
    if (np.diff(order) < 0).any():
        notes.append("rows sorted by time")
    if len(kept) < len(t):
        notes.append(f"{len(t) - len(kept)} rows with a missing or repeated time are left out")
    t = t[kept]
    if t[0] != 0:
        notes.append(f"times start at {t[0]:.10g} s, which becomes 0 s")
    steps = np.diff(t)
    if steps.max() > 3 * np.median(steps):
        row = int(np.argmax(steps))
        notes.append(f"a gap of {steps.max():.3g} s after {t[row] - t[0]:.4g} s; frames are {np.median(steps):.3g} s apart")
    return t, kept


def _check_repeats(path: Path, t: np.ndarray, points: Mapping[str, np.ndarray], frame_rate: float | None) -> None:
    """Check that rows are those of one recording, with a clock that tells them apart.

    Raises:
        UserError: The times start again within the file, or many rows have the time of another and another place.
    """
    x = np.column_stack(list(points.values()))
    rows = np.flatnonzero(np.isfinite(t) & np.isfinite(x).any(axis=1))
    seen = np.isfinite(x)  # beside the places, so that one which was not seen is no copy of one at zero
    _, first = np.unique(np.column_stack([t, seen, np.where(seen, x, 0.0)])[rows], axis=0, return_index=True)
    rows = rows[np.sort(first)]  # without copies
    back = np.flatnonzero(np.diff(t[rows]) < 0) + 1
    parts = np.split(t[rows], back)
    if len(back) and len(rows) >= LEAST_RUN * len(parts):
        spans = sorted((float(part.min()), float(part.max())) for part in parts)
        if any(low < end for (_, end), (low, _) in zip(spans, spans[1:])):
            raise UserError(
                f"{path.name}: the times start again at data row {rows[back[0]]}: does it hold several recordings? "
                "Name the column that tells them apart (--columns.recording TITLE), or give each a file"
            )
    repeated = len(rows) - len(np.unique(t[rows]))
    if repeated > max(REPEATED * len(rows), 4):
        raise UserError(
            f"{path.name}: {repeated} of {len(rows)} rows have the time of another row and another place: the clock is too coarse; export "
            "times with more digits, or give --columns.frame TITLE and --frame_rate"
        )
