"""Reader of tracker and motion-capture exports: OptiTrack, Vicon, TRC, DeepLabCut, C3D and plain tables."""

import warnings
from pathlib import Path

import numpy as np

from neuido.data.files.delimited import is_number
from neuido.data.files.parsing import parser_errors
from neuido.data.importers.pandas_hdf5 import read_frame
from neuido.data.importers.plain_motion import Motion, read_plain
from neuido.data.importers.tables.titled_tables import read_cells
from neuido.errors import UserError
from neuido.physics.runtime.lazy import import_extra

MIN_LIKELIHOOD = 0.6
"""Smallest likelihood at which a point of DeepLabCut counts as seen."""


def read_motions(path: Path, columns: dict[str, str], frame_rate: float | None = None) -> dict[str, Motion]:
    """Read a tracker export; detect its layout from its content. Return the motion of each recording in it by its name.

    Args:
        path: The file.
        columns: Title of the column of a quantity, for plain tables whose titles are not recognised.
        frame_rate: Frames a second, for timecodes [1/s].

    Raises:
        UserError: The layout is unknown, or the file is malformed.
    """
    if path.suffix.lower() == ".c3d":
        return {"": _c3d(path)}
    if path.suffix.lower() in (".h5", ".hdf5"):
        return {"": _deeplabcut_hdf5(path)}
    rows, _ = read_cells(path)
    layout = layout_of_rows(rows)
    return {"": LAYOUTS[layout](path, rows)} if layout else read_plain(path, columns, frame_rate)


def layout_of_rows(rows: list[list[str]]) -> str:
    """Return the name of the layout of a tracker's export by its first cells, a key of `LAYOUTS`; empty for a plain table."""
    first = [cell.lower() for cell in rows[0]] if rows else []
    if "format version" in first:
        return "optitrack"
    if first and first[0].startswith("pathfiletype"):
        return "trc"
    if first and first[0] in VICON:
        return "vicon"
    if first and first[0] == "no_of_frames":
        return "qualisys"
    return "deeplabcut" if first and first[0] == "scorer" else ""


def _floats(rows: list[list[str]], width: int) -> np.ndarray:
    out = np.full((len(rows), width), np.nan)
    for i, row in enumerate(rows):
        for j, cell in enumerate(row[:width]):
            if is_number(cell):
                out[i, j] = float(cell)
    return out


def _numbers_from(path: Path, rows: list[list[str]], start: int) -> tuple[int, np.ndarray]:
    first = next((i for i in range(start, len(rows)) if rows[i][0] and is_number(rows[i][0]) and len(rows[i]) > 2), None)
    if first is None or len(rows) - first < 3:
        raise UserError(f"{path}: fewer than 3 frames follow the titles")
    return first, _floats(rows[first:], max(len(row) for row in rows[first:]))


def _optitrack(path: Path, rows: list[list[str]]) -> Motion:
    info = dict(zip([cell.lower() for cell in rows[0][::2]], rows[0][1::2]))
    first, data = _numbers_from(path, rows, 1)
    titles, kinds = rows[first - 1], rows[first - 2]
    names = next((row for row in rows[1:first] if len(row) > 1 and "name" in (row[0].lower(), row[1].lower())), None)
    if names is None:
        raise UserError(f"{path}: the row of marker names is missing: export the file with headers")
    points: dict[str, np.ndarray] = {}
    for j in range(2, min(len(titles), len(kinds), len(names)) - 2):
        if kinds[j].lower() == "position" and [t.upper() for t in titles[j : j + 3]] == ["X", "Y", "Z"]:
            points[names[j] or f"point {j}"] = data[:, j : j + 3]
    return Motion(data[:, 1], points, info.get("length units", "m"), False, [f"OptiTrack, {len(points)} points"])


def _trc(path: Path, rows: list[list[str]]) -> Motion:
    if len(rows) < 5:
        raise UserError(f"{path}: a TRC file has five rows of titles, and this one has {len(rows)} rows: export it again")
    info = dict(zip([cell.lower() for cell in rows[1]], rows[2]))
    first, data = _numbers_from(path, rows, 4)
    names = [cell for cell in rows[3][2:] if cell]
    points = {name: data[:, 2 + 3 * i : 5 + 3 * i] for i, name in enumerate(names) if 5 + 3 * i <= data.shape[1]}
    return Motion(data[:, 1], points, info.get("units", "mm"), False, [f"TRC, {len(points)} markers"])


VICON = ("trajectories", "model outputs", "devices", "joints", "segments", "events")
"""Sections of an export of Vicon; trajectories have the markers, and model outputs may have points too."""


def _vicon(path: Path, rows: list[list[str]]) -> Motion:
    starts = [i for i, row in enumerate(rows) if row[0].lower() in VICON]
    section = next((i for i in starts if rows[i][0].lower() == "trajectories"), starts[0])
    rows = rows[section : next((i for i in starts if i > section), None)]
    if len(rows) < 6 or not is_number(rows[1][0]) or not float(rows[1][0]) > 0:
        raise UserError(f"{path}: a Vicon export has the frame rate in its second row; it is missing")
    first, data = _numbers_from(path, rows, 4)
    units, names = rows[first - 1], rows[2]
    points = {name.rpartition(":")[2]: data[:, j : j + 3] for j, name in enumerate(names) if name and j + 3 <= data.shape[1]}
    unit = next((cell for cell in units if cell), "mm")
    return Motion((data[:, 0] - data[0, 0]) / float(rows[1][0]), points, unit, False, [f"Vicon, {float(rows[1][0]):g} Hz"])


def _qualisys(path: Path, rows: list[list[str]]) -> Motion:
    """Read an export of Qualisys: its header ends with the names of the markers, and titles may stand below them."""
    info = {row[0].upper(): row[1:] for row in rows if row[0].isupper()}
    rate, names = next(iter(info.get("FREQUENCY", [])), ""), [name for name in info.get("MARKER_NAMES", []) if name]
    if not is_number(rate) or not float(rate) > 0 or not names:
        raise UserError(f"{path}: an export of Qualisys has FREQUENCY and MARKER_NAMES in its header: export it again")
    head = next(i for i, row in enumerate(rows) if row[0].upper() == "MARKER_NAMES") + 1
    titled = head < len(rows) and not is_number(rows[head][0])
    first, data = _numbers_from(path, rows, head + titled)
    before = data.shape[1] - 3 * len(names)  # columns of frame and time
    if before < 0:
        raise UserError(f"{path}: {len(names)} markers need {3 * len(names)} columns, and there are {data.shape[1]}: export positions (3D)")
    points = {name: data[:, before + 3 * i : before + 3 * i + 3] for i, name in enumerate(names)}
    points = {name: np.where((x == 0).all(1, keepdims=True), np.nan, x) for name, x in points.items()}
    notes = [f"Qualisys, {len(points)} markers, {float(rate):g} Hz, positions in mm"]
    return Motion(np.arange(len(data)) / float(rate), points, "mm", False, notes)


def _deeplabcut(path: Path, rows: list[list[str]]) -> Motion:
    first, data = _numbers_from(path, rows, 3)
    named = [row for row in rows[1 : first - 1] if row[0].lower() in ("individuals", "bodyparts")]
    if rows[first - 1][0].lower() != "coords" or not named:
        raise UserError(f"{path}: an export of DeepLabCut has rows bodyparts and coords above its numbers: export it again")
    names = ["-".join(filter(None, cells)) for cells in zip(*(row[1:] for row in named))]
    return _poses(data[:, 0], names, rows[first - 1][1:], data[:, 1:])


def _deeplabcut_hdf5(path: Path) -> Motion:
    names, frames, data = read_frame(path)
    if any(len(name) < 3 for name in names):
        raise UserError(f"{path}: its columns have no scorer, body part and coordinate: is it of DeepLabCut?")
    order = np.argsort(frames, kind="stable")
    return _poses(frames[order], ["-".join(name[1:-1]) for name in names], [name[-1] for name in names], data[order])


def _poses(frames: np.ndarray, parts: list[str], kinds: list[str], data: np.ndarray) -> Motion:
    """Return the points of body parts from columns x, y, likelihood each."""
    points = {}
    for j in range(min(len(kinds), data.shape[1]) - 2):
        if [kind.lower() for kind in kinds[j : j + 3]] == ["x", "y", "likelihood"]:
            points[parts[j]] = np.where(data[:, j + 2 : j + 3] < MIN_LIKELIHOOD, np.nan, data[:, j : j + 2])
    notes = [f"DeepLabCut, {len(points)} body parts, points of likelihood below {MIN_LIKELIHOOD} count as not seen"]
    return Motion(frames, points, "pixel", True, notes)


def _c3d(path: Path) -> Motion:
    c3d = import_extra("c3d", path.name)
    with parser_errors(path, "C3D file"), path.open("rb") as file, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        reader = c3d.Reader(file)
        labels = [label.strip() for label in reader.point_labels]
        rate, given = float(reader.point_rate), reader.get("POINT:UNITS")
        unit = given.string_value.strip("\0 ") if given is not None else ""
        frames = [points[:, :4].copy() for _, points, _ in reader.read_frames(copy=False)]
        declared = reader.last_frame - reader.first_frame + 1
    if len(frames) < declared or not frames:
        raise UserError(f"{path} is truncated: it states {declared} frames and has {len(frames)}")
    if not rate > 0.0:
        raise UserError(f"{path}: the rate of the points is {rate:g} Hz and must be positive")
    data = np.asarray(frames, dtype=float)
    x = np.where(data[..., 3:] < 0.0, np.nan, data[..., :3])  # a negative residual marks a point that was not seen
    points = {name: x[:, i].copy() for i, name in enumerate(labels[: x.shape[1]]) if name}
    return Motion(np.arange(len(x)) / rate, points, unit or "mm", False, [f"C3D, {len(points)} markers, {rate:g} Hz"])


LAYOUTS = {"qualisys": _qualisys, "optitrack": _optitrack, "trc": _trc, "vicon": _vicon, "deeplabcut": _deeplabcut}
"""Reader of each layout that is told by the first cells."""
