"""Read the results of runs for tables and figures: scores, scores by time step, logged curves and videos."""

import math
import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeGuard

from neuido.data.files.score_tables import folder_of, read_rows
from neuido.data.files.sweep_run import read_status
from neuido.errors import UserError


class Entry(NamedTuple):
    """One line of the tables of a report: a run, or one score table of a run."""

    label: str
    root: Path
    """Folder of the run; logs lie below it."""
    scores: Path | None
    """Folder of scores.csv; None if the run has no scores."""
    rows: list[dict[str, Any]]
    """Rows of scores.csv, one per scene."""
    parameters: dict[str, Any]
    """Parameters of the run, if it belongs to a sweep."""
    stage: str = ""
    """`before` or `after` fitting, or a later `test`; empty if the scores have no stage."""
    last: bool = True
    """Whether `stage` is the last stage of the run."""

    def row_of(self, scene: str) -> dict[str, Any]:
        """Return the row of a scene; empty if there is none."""
        return next((row for row in self.rows if str(row.get("scene")) == scene), {})

    def folder(self, scene: str) -> Path | None:
        """Return the folder with the results of a scene; None if the run has no scores."""
        return None if self.scores is None else folder_of(self.scores, scene)

    def by_frame(self, scene: str) -> list[dict[str, Any]]:
        """Read particles.csv of a scene, one row per time step; empty if there is none."""
        folder = self.folder(scene)
        if folder is None:
            return []
        path = (folder_of(folder, self.stage) if self.stage else folder) / "particles.csv"  # a stage stands in a file, and may be no path
        return read_rows(path) if os.path.isfile(path) else []  # unlike Path.is_file, this takes a name that is too long

    def videos(self, scene: str) -> list[Path]:
        """List the videos of a scene; only the last stage of a run has videos."""
        folder = self.folder(scene)
        return sorted(folder.glob("*.mp4")) if folder and os.path.isdir(folder) and self.last else []


def open_runs(given: Sequence[str]) -> list[Entry]:
    """Open the results of runs; return their entries in the given order.

    Args:
        given: Folders of runs, results or sweeps; each finished run of a sweep is an entry. `label=folder` names an entry.

    Raises:
        UserError: A folder is missing, or has neither scores nor logs.
    """
    entries: list[Entry] = []
    for one in given:
        label, folder = labelled(one)
        if not folder.is_dir():
            raise UserError(f"runs: the folder {folder} is missing")
        sweep = sorted(each for each in folder.iterdir() if read_status(each).get("status") == "done")
        found = [entry for each in sweep or [folder] for entry in _entries(each, label, read_status(each).get("parameters", {}))]
        if not found:
            raise UserError(f"runs: {folder} has neither scores.csv, test.csv nor metrics.csv: run `neuido fit` or `neuido test` first")
        entries += found
    return _distinct(entries)


def labelled(given: str) -> tuple[str, Path]:
    """Return the label and the folder of `label=folder`; an empty label of a folder alone, whose path may hold a `=`."""
    label, _, path = given.rpartition("=") if not Path(given).exists() else ("", "", given)
    return label, Path(path).expanduser()


def _entries(folder: Path, label: str, parameters: dict[str, Any]) -> list[Entry]:
    own = f"{label} {folder.name}".strip() if parameters else label or _name(folder)
    found = tables(folder)
    if not found:
        return [Entry(own, folder, None, [], parameters)] if logs(folder) else []
    out = []
    for place, rows in found.items():
        name = own if len(found) == 1 else f"{own}, {place.relative_to(folder)}"
        stages = list(dict.fromkeys(str(row.get("stage", "")) for row in rows))
        for stage in stages:
            part = [row for row in rows if str(row.get("stage", "")) == stage]
            title = f"{name}, {stage}" if len(stages) > 1 else name
            out.append(Entry(title, folder, place, part, parameters, stage, stage == stages[-1]))
    return out


def tables(folder: Path) -> dict[Path, list[dict[str, Any]]]:
    """Read scores.csv and test.csv below a folder; return the rows by folder. test.csv has the scores of a later `neuido test`."""
    paths = sorted({*folder.rglob("scores.csv"), *folder.rglob("test.csv")}, key=lambda path: (path.parent, path.name))
    return {place: [row for path in paths if path.parent == place for row in _scenes(path)] for place in {p.parent: 0 for p in paths}}


def _scenes(path: Path) -> list[dict[str, Any]]:
    rows = read_rows(path)
    if any("scene" not in row for row in rows):
        raise UserError(f"{path}: a row has no scene; `neuido fit` and `neuido test` write such tables")
    return rows


def _name(folder: Path) -> str:
    whole = folder.resolve()
    return whole.parent.name if whole.name == "results" else whole.name


def _distinct(entries: list[Entry]) -> list[Entry]:
    """Prefix repeated labels with the name of the parent folder."""
    labels = [entry.label for entry in entries]
    return [
        entry._replace(label=f"{entry.root.resolve().parent.name}/{entry.label}") if labels.count(entry.label) > 1 else entry
        for entry in entries
    ]


def logs(root: Path) -> list[Path]:
    """List the metrics.csv files below a folder by version number, the newest last: version_10 after version_9."""
    return sorted(root.rglob("metrics.csv"), key=_numbered)


def _numbered(path: Path) -> list[tuple[str, int]]:
    """Return a sort key that compares numbers in a path as numbers."""
    return [(text, int(number or 0)) for text, number in re.findall(r"([^0-9]*)([0-9]*)", path.as_posix())]


def logged_curves(root: Path) -> dict[str, list[tuple[float, float]]]:
    """Read (step, value) of each logged column from the metrics.csv files below a folder; for a repeated column, the newest file counts."""
    out: dict[str, list[tuple[float, float]]] = {}
    for path in logs(root):
        own: dict[str, list[tuple[float, float]]] = {}
        for row in read_rows(path):
            step = row.get("step")
            for name, value in row.items():
                if name not in ("step", "epoch") and _drawn(step) and _drawn(value):
                    own.setdefault(name, []).append((step, value))
        out |= own
    return out


def _drawn(value: Any) -> TypeGuard[float]:
    """Whether a cell is a number that an axis can show."""
    return isinstance(value, float) and abs(value) < 1e100


def figures(rows: Sequence[dict[str, Any]], name: str) -> list[float]:
    """Return a column of a table as numbers, NaN where a cell holds none that an axis can show."""
    return [value if _drawn(value) else math.nan for value in (row.get(name) for row in rows)]


def scenes_of(entries: Sequence[Entry]) -> list[str]:
    """List the names of all scenes, in order of appearance."""
    return list(dict.fromkeys(str(row["scene"]) for entry in entries for row in entry.rows if "scene" in row))


def mean(values: Sequence[Any]) -> float:
    """Return the mean of numbers; NaN if there is none or one is not a finite float."""
    return sum(values) / len(values) if values and all(isinstance(v, float) and math.isfinite(v) for v in values) else math.nan
