"""What runs have left on disk, for tables and figures: scores, scores by time step, logged curves, videos."""

import csv
import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from neuido.data.files.score_tables import folder_of, read_rows
from neuido.data.files.sweep_run import read_status
from neuido.errors import UserError


class Entry(NamedTuple):
    """One line of the tables: a run, or one of the score tables of a run."""

    label: str
    root: Path
    """The folder that was given: logs are somewhere below it."""
    scores: Path | None
    """The folder of scores.csv; none where there is none."""
    rows: list[dict[str, Any]]
    """scores.csv, a row a scene."""
    parameters: dict[str, Any]
    """Of a run of a sweep."""
    stage: str = ""
    """`before` or `after` fitting, or a later `test`, where the scores say so."""
    last: bool = True
    """Whether it is the last stage of its run."""

    def of(self, scene: str) -> dict[str, Any]:
        """Return the row of a scene; empty where there is none."""
        return next((row for row in self.rows if str(row.get("scene")) == scene), {})

    def folder(self, scene: str) -> Path | None:
        """Return the folder of a scene's results."""
        return None if self.scores is None else folder_of(self.scores, scene)

    def by_frame(self, scene: str) -> list[dict[str, Any]]:
        """Return the rows of a scene's particles.csv, one for each time step."""
        path = (self.folder(scene) or Path()) / self.stage / "particles.csv"
        return read_rows(path) if self.scores is not None and path.is_file() else []

    def videos(self, scene: str) -> list[Path]:
        """Return the videos of a scene: of what came out of a run."""
        folder = self.folder(scene)
        return sorted(folder.glob("*.mp4")) if folder and folder.is_dir() and self.last else []


def open_runs(given: Sequence[str]) -> list[Entry]:
    """Return the entries of some runs, in order.

    Args:
        given: Folders, each of a run, of results, or of a sweep, whose finished runs then count one by one; `label=folder` gives it a name.

    Raises:
        UserError: A folder that is missing, or that holds neither scores nor logs.
    """
    entries: list[Entry] = []
    for one in given:
        label, _, path = one.rpartition("=") if "=" in one and not Path(one).exists() else ("", "", one)
        folder = Path(path).expanduser()
        if not folder.is_dir():
            raise UserError(f"runs: there is no folder {folder}")
        sweep = sorted(each for each in folder.iterdir() if read_status(each).get("status") == "done")
        found = [entry for each in sweep or [folder] for entry in _entries(each, label, read_status(each).get("parameters", {}))]
        if not found:
            raise UserError(f"runs: {folder} holds neither scores.csv, test.csv nor metrics.csv: run `neuido fit` or `neuido test` first")
        entries += found
    return _distinct(entries)


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
    """Return the scores below a folder by where they are: rows of scores.csv, and of test.csv, in which a finished fit was scored again."""
    paths = sorted({*folder.rglob("scores.csv"), *folder.rglob("test.csv")}, key=lambda path: (path.parent, path.name))
    return {place: [row for path in paths if path.parent == place for row in read_rows(path)] for place in {p.parent: 0 for p in paths}}


def _name(folder: Path) -> str:
    whole = folder.resolve()
    return whole.parent.name if whole.name == "results" else whole.name


def _distinct(entries: list[Entry]) -> list[Entry]:
    """Add the parent folder to labels that come twice."""
    labels = [entry.label for entry in entries]
    return [
        entry._replace(label=f"{entry.root.resolve().parent.name}/{entry.label}") if labels.count(entry.label) > 1 else entry
        for entry in entries
    ]


def logs(root: Path) -> list[Path]:
    """Return the metrics.csv files below a folder, the newest last: version_10 after version_9, whatever the clock says."""
    return sorted(root.rglob("metrics.csv"), key=_numbered)


def _numbered(path: Path) -> list[tuple[str, int]]:
    """Return a path as a key to sort by, its numbers as numbers."""
    return [(text, int(number or 0)) for text, number in re.findall(r"([^0-9]*)([0-9]*)", path.as_posix())]


def logged_curves(root: Path) -> dict[str, list[tuple[float, float]]]:
    """Return (step, value) of each logged column; of a column in several files the newest counts."""
    out: dict[str, list[tuple[float, float]]] = {}
    for path in logs(root):
        own: dict[str, list[tuple[float, float]]] = {}
        with path.open(newline="") as file:
            for row in csv.DictReader(file):
                for name, text in row.items():
                    if name not in ("step", "epoch", None) and text and row.get("step"):
                        own.setdefault(name, []).append((float(row["step"]), float(text)))
        out |= own
    return out


def scenes_of(entries: Sequence[Entry]) -> list[str]:
    """Return the names of all scenes, in the order in which they come."""
    return list(dict.fromkeys(str(row["scene"]) for entry in entries for row in entry.rows if "scene" in row))


def mean(values: Sequence[Any]) -> float:
    """Return the mean of numbers; NaN where one is missing."""
    return sum(values) / len(values) if values and all(isinstance(v, float) and math.isfinite(v) for v in values) else math.nan
