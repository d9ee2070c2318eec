"""Predictions kept on disk while a diagnosis runs, so that one that was killed goes on where it stopped, to the same answer."""

import contextlib
import functools
import hashlib
import json
import os
from collections.abc import Callable, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

import neuido
from neuido.data.files.writing import atomic_write, make_real_folder, remove
from neuido.discrepancy.problem import Ask, Point, Problem, Rows

CHUNK = 32
"""Points in one stored call: what a kill can cost. It holds with and without a store, so that both compute the same."""
HEAVY, LEAST = 2e8, 4
"""Particle-substeps of one stored call, about a minute or two of a CPU, and the points that one has at the least."""
LIMIT = 2_000_000_000
"""Bytes that a store may take; what comes after is computed again by a run that is resumed."""


class CachedProblem(Problem):
    """A problem whose predictions are kept in a folder, one file a call.

    The key of a call is its points in their order, its recording and its setting: a batch is computed together, and a resumed run asks in
    the same order, so that it gets the same bits. All else is the problem's own.

    Args:
        problem: What predicts.
        folder: Where the files go; it is made. None: nothing is kept.
        limit: Bytes of all files.
        tick: Called with the number of points after every call.
    """

    def __init__(
        self, problem: Problem, folder: str | os.PathLike | None, *, limit: int = LIMIT, tick: Callable[[int], None] | None = None
    ) -> None:
        super().__init__(**{field.name: getattr(problem, field.name) for field in fields(Problem)})
        folder = None if folder is None else Path(folder)
        if folder is not None:
            folder.mkdir(parents=True, exist_ok=True)
            for path in folder.glob(".*.tmp"):  # of a run that was killed
                path.unlink(missing_ok=True)
        used = sum(path.stat().st_size for path in folder.glob("*.npy")) if folder is not None else 0
        self.problem, self.folder, self.limit, self.tick = problem, folder, limit, tick
        self.used, self.found, self.computed = used, 0, 0

    def __getattr__(self, name: str) -> Any:  # for what only one kind of problem has, as `motion`
        if name == "problem":
            raise AttributeError(name)
        return getattr(self.problem, name)

    def predict(self, points: Sequence[Point], recording: int, setting: int = 0) -> np.ndarray:
        (rows,) = self.predict_several([(points, recording, setting)])
        return rows

    def predict_several(self, asks: Sequence[Ask]) -> Rows:
        calls = [self._calls(*ask) for ask in asks]
        with contextlib.closing(self._stored([call for own in calls for call in own])) as rows:
            for ask, own in zip(asks, calls, strict=True):
                yield np.concatenate([np.empty((0, len(self.recordings[ask[1]].y))), *(next(rows) for _ in own)])

    def margin(self, point: Point, setting: int = 0) -> float:
        return self.problem.margin(point, setting)

    def refusal(self, setting: int) -> str:
        return self.problem.refusal(setting)

    def effort(self, recording: int, setting: int = 0) -> float:
        return self.problem.effort(recording, setting)

    def others(self, setting: int) -> list[int]:
        return self.problem.others(setting)

    def quick(self, setting: int) -> int:
        return self.problem.quick(setting)

    def recentred(self, point: Point, setting: int, amounts: Sequence[float]) -> Point:
        return self.problem.recentred(point, setting, amounts)

    @property
    def together(self) -> bool:
        return self.problem.together

    def directions(self, recording: int) -> np.ndarray:
        return self.problem.directions(recording)

    def error(self, residual: np.ndarray, recording: int) -> float:
        return self.problem.error(residual, recording)

    def setting_name(self, setting: int) -> str:
        return self.problem.setting_name(setting)

    def model_after(self, values: Point, effects: Sequence[str]) -> dict[str, Any]:
        return self.problem.model_after(values, effects)

    def _calls(self, points: Sequence[Point], recording: int, setting: int) -> list[Ask]:
        """An ask in the parts in which it is stored."""
        size = CHUNK
        if not self.problem.together:  # each point runs alone: long ones are stored, and told of, in smaller calls
            size = min(max(int(HEAVY / max(self.problem.effort(recording, setting), 1.0)), LEAST), CHUNK)
        return [(points[i : i + size], recording, setting) for i in range(0, len(points), size)]

    def _stored(self, calls: Sequence[Ask]) -> Rows:
        """What is kept of calls; the rest is computed, and kept as it comes."""
        paths = [None if self.folder is None else self.folder / f"{_key(*call)}.npy" for call in calls]
        shapes = [(len(points), len(self.recordings[recording].y)) for points, recording, _ in calls]
        kept = [None if path is None else _load(path, shape) for path, shape in zip(paths, shapes, strict=True)]
        missing = [call for call, rows in zip(calls, kept, strict=True) if rows is None]
        with contextlib.closing(self.problem.predict_several(missing)) as computed:
            for (points, _, _), path, rows in zip(calls, paths, kept, strict=True):
                if rows is not None:
                    self.found += 1
                else:
                    rows = np.asarray(next(computed), dtype=np.float64)
                    self.computed += 1
                    if path is not None:
                        self._keep(path, rows)
                if self.tick is not None:
                    self.tick(len(points))
                yield rows

    def _keep(self, path: Path, values: np.ndarray) -> None:
        with np.errstate(over="ignore"):
            short = values.astype(np.float32)
        stored = short if np.array_equal(short.astype(np.float64), values, equal_nan=True) else values  # the simulators work in float32
        if self.used + stored.nbytes > self.limit:
            return
        with atomic_write(path) as hidden, hidden.open("wb") as stream:
            np.save(stream, stored)
        self.used += stored.nbytes


def _key(points: Sequence[Point], recording: int, setting: int) -> str:
    rows = [sorted((name, float(value).hex()) for name, value in point.items()) for point in points]
    return hashlib.sha256(json.dumps([rows, recording, setting]).encode()).hexdigest()[:40]


def _load(path: Path, shape: tuple[int, ...]) -> np.ndarray | None:
    if not path.is_file():
        return None
    try:
        values = np.load(path, allow_pickle=False)
    except (ValueError, EOFError, OSError):  # numpy's answers to a file that is cut short
        return None
    return values.astype(np.float64) if values.shape == shape else None


def plan_of(folder: str | os.PathLike, options: dict[str, Any], *, out: Path) -> str:
    """A name for what a run computes: its options and the bytes of every file of the measured folder, apart from those in `out`."""
    digest = hashlib.sha256(json.dumps(options, sort_keys=True).encode())
    folder = Path(folder)
    inside = (p for p in folder.rglob("*") if p.is_file() and not p.resolve().is_relative_to(out.resolve()))
    for path in sorted(inside):
        digest.update(str(path.relative_to(folder)).encode())
        with path.open("rb") as stream:
            while block := stream.read(1 << 20):
                digest.update(block)
    return digest.hexdigest()[:16]


RELEVANT = ("errors.py", "types.py", "data", "discrepancy", "models", "physics")
"""Parts of the package that predictions come from."""


@functools.cache
def code_digest() -> str:
    """Return a digest of the sources that predictions come from: those of another version, or changed by hand, are not to be reused."""
    root = Path(neuido.__file__).parent
    digest = hashlib.sha256(neuido.__version__.encode())
    for name in RELEVANT:
        place = root / name
        for path in sorted(place.rglob("*.py")) if place.is_dir() else [place]:
            digest.update(str(path.relative_to(root)).encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()


def outdated(out: Path, plan: str) -> list[str]:
    """Return the plans whose predictions are kept in `out` and are of other data, options or code than `plan`."""
    root = out / ".work"
    return sorted(path.name for path in root.iterdir() if path.name != plan) if root.is_dir() else []


def workplace(out: Path, plan: str, *, resume: bool) -> Path:
    """The folder of a plan's predictions in `out`; those of other plans go, and its own too where nothing is to be resumed."""
    root = make_real_folder(out / ".work", "the folder of predictions")
    for other in root.iterdir():
        if other.name != plan or not resume:
            remove(other)
    return make_real_folder(root / plan, "the folder of predictions")


def clear(out: Path) -> None:
    """Remove what only a resumed run would need."""
    remove(out / ".work")
