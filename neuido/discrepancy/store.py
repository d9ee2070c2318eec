"""Predictions kept in memory and on disk, what each step ran, and the work and the time that a diagnosis may take."""

import contextlib
import functools
import hashlib
import io
import json
import math
import os
import time
import warnings
from collections import OrderedDict
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

import neuido
from neuido.data.files.writing import make_real_folder, remove, write_bytes
from neuido.discrepancy.problems.problem import Ask, Point, Problem, Recording, Rows
from neuido.errors import shortened

IN_MEMORY = 500_000_000
"""Bytes of the predictions that are kept; the one that was used longest ago goes first."""


@dataclass
class Work:
    """What one step of a diagnosis asked for."""

    simulations: int = 0
    """Points times recordings that were run."""
    reused: int = 0
    """Those that were there already."""
    effort: float = 0.0
    """`Problem.effort` of the runs: particle-substeps of a body."""
    seconds: float = 0.0


class Memo:
    """The predictions of a problem, each computed once while there is room for it.

    Args:
        problem: What predicts.
        limit: Bytes that are kept.

    Attributes:
        work: What each step ran, by its name; see `during`.
    """

    def __init__(self, problem: Problem, *, limit: int = IN_MEMORY) -> None:
        self.problem, self.limit = problem, limit
        self.work: dict[str, Work] = {}
        self._step = "other"
        self._kept: OrderedDict[tuple, np.ndarray] = OrderedDict()
        self._size = 0

    @property
    def recordings(self) -> tuple[Recording, ...]:
        return self.problem.recordings

    @property
    def simulations(self) -> int:
        """Points times recordings that were run so far."""
        return sum(w.simulations for w in self.work.values())

    @property
    def effort(self) -> float:
        """Work so far, in the unit of `Problem.effort`."""
        return sum(w.effort for w in self.work.values())

    @property
    def pace(self) -> float:
        """Seconds that a run has taken so far, mean."""
        return sum(w.seconds for w in self.work.values()) / max(self.simulations, 1)

    @contextmanager
    def during(self, step: str) -> Iterator[None]:
        """Runs count for this step while it is open, unless an outer one is open already."""
        before = self._step
        self._step = step if before == "other" else before
        try:
            yield
        finally:
            self._step = before

    def predict(self, points: Sequence[Point], recording: int, setting: int = 0) -> np.ndarray:
        """As `Problem.predict`."""
        (rows,) = self.predict_several([(points, recording, setting)])
        return rows

    def predict_several(self, asks: Sequence[Ask]) -> list[np.ndarray]:
        """As `Problem.predict_several`, all at once."""
        keys = [[(n, s, tuple(sorted(point.items()))) for point in points] for points, n, s in asks]
        found = {key: self._kept[key] for own in keys for key in own if key in self._kept}
        missing: dict[tuple[int, int], dict[tuple, Point]] = {}
        for (points, n, s), own in zip(asks, keys, strict=True):
            missing.setdefault((n, s), {}).update((key, point) for key, point in zip(own, points, strict=True) if key not in found)
        missing = {of: own for of, own in missing.items() if own}
        work = self.work.setdefault(self._step, Work())
        run = sum(len(own) for own in missing.values())
        work.reused += sum(len(own) for own in keys) - run
        if run:
            begun = time.monotonic()
            answers = list(self.problem.predict_several([(list(own.values()), *of) for of, own in missing.items()]))
            work.seconds += time.monotonic() - begun
            work.simulations += run
            work.effort += sum(len(own) * self.problem.effort(*of) for of, own in missing.items())
            for own, rows in zip(missing.values(), answers, strict=True):
                found |= dict(zip(own, rows, strict=True))
        for key in dict.fromkeys(key for own in keys for key in own):
            self._keep(key, found[key])
        return [
            np.stack([found[key] for key in own]) if own else np.empty((0, len(self.recordings[n].y)))
            for own, (_, n, _) in zip(keys, asks, strict=True)
        ]

    def _keep(self, key: tuple, row: np.ndarray) -> None:
        if key not in self._kept:
            self._kept[key] = row.copy()  # not a view that keeps its whole batch alive
            self._size += row.nbytes
        self._kept.move_to_end(key)
        while self._size > self.limit and len(self._kept) > 1:
            self._size -= self._kept.popitem(last=False)[1].nbytes


CHUNK = 32
"""Points in one stored call: what a kill can cost. It holds with and without a store, so that both compute the same."""
HEAVY, FEWEST = 2e8, 4
"""Particle-substeps of one stored call, about a minute or two of a CPU, and the points that one has at the least."""
ON_DISK = 2_000_000_000
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
        self, problem: Problem, folder: str | os.PathLike | None, *, limit: int = ON_DISK, tick: Callable[[int], None] | None = None
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
            size = min(max(int(HEAVY / max(self.problem.effort(recording, setting), 1.0)), FEWEST), CHUNK)
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
        content = io.BytesIO()
        np.save(content, stored)
        write_bytes(path, content.getvalue() + hashlib.sha256(content.getvalue()).digest())
        self.used += stored.nbytes


def _key(points: Sequence[Point], recording: int, setting: int) -> str:
    rows = [sorted((name, float(value).hex()) for name, value in point.items()) for point in points]
    return hashlib.sha256(json.dumps([rows, recording, setting]).encode()).hexdigest()[:40]


def _load(path: Path, shape: tuple[int, ...]) -> np.ndarray | None:
    if not path.is_file():
        return None
    try:
        content = path.read_bytes()
        if hashlib.sha256(content[:-32]).digest() != content[-32:]:
            raise ValueError("its digest does not agree")
        values = np.load(io.BytesIO(content[:-32]), allow_pickle=False)
        if values.shape != shape:
            raise ValueError(f"it has the shape {values.shape}, not {shape}")
    except Exception as error:  # numpy's answers to a file that is cut short or damaged are of several types
        warnings.warn(f"{path} is left aside and computed again: {shortened(str(error))}", stacklevel=2)
        return None
    return values.astype(np.float64)


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


SEARCH = 0.8
"""Share of the time at which a search is stopped, at the most; the rest is for the last fit, the intervals and the report."""
LEAST_SEARCH = 0.6
"""The same at the least."""
AFTER = 200
"""Simulations that follow it: what was begun is weighed, the best is fitted to its end, and its intervals are taken."""


class Budget:
    """The work that a search may take, and the time after which it is stopped.

    Its work decides what a search does, and is the same on a fast machine and a slow one. The time decides nothing but that a search is cut
    off. What follows the search (the last fit, intervals) is little and is no part of the work.

    Args:
        work: Of the search, in the unit of `spent`; infinite: as much as it takes.
        spent: The work so far.
        seconds: From now on; infinite: as long as it takes.
        clock: Seconds on a clock that never goes back.
        pace: Seconds that a simulation has taken so far; where one is slow the search is stopped earlier.

    Attributes:
        left_out: What the search has not done, in words.
        cut: Whether a step or a fit ended early, so that more work could change the answer.
        ended_by: What ended it: `effort`, `time`, or empty where nothing did.
    """

    def __init__(
        self,
        work: float = math.inf,
        *,
        spent: Callable[[], float] = lambda: 0.0,
        seconds: float = math.inf,
        clock: Callable[[], float] = time.monotonic,
        pace: Callable[[], float] = lambda: 0.0,
    ) -> None:
        self.work, self.spent = work, spent
        self.clock, self.begun, self.seconds, self.pace = clock, clock(), seconds, pace
        self.concluding = False
        self.left_out: list[str] = []
        self.cut = False
        self.ended_by = ""

    @property
    def share(self) -> float:
        """Share of the time that counts: that of the search, or all of it."""
        if self.concluding or math.isinf(self.seconds):
            return 1.0
        return min(max(1.0 - AFTER * self.pace() / max(self.seconds, 1e-9), LEAST_SEARCH), SEARCH)

    @property
    def over(self) -> bool:
        """Whether the work of the search is done or the time is up; nothing is noted."""
        return bool(self._end(1.0))

    def ends(self, share: float = 1.0) -> bool:
        """Whether something ends here, since this share of the work is done or the time is up; the search counts as cut off then.

        An infinite share never ends.
        """
        end = self._end(share)
        if end:
            self.cut, self.ended_by = True, "time" if "time" in (end, self.ended_by) else end
        return bool(end)

    def _end(self, share: float) -> str:
        if math.isinf(share):
            return ""
        if self.clock() - self.begun > self.share * self.seconds:
            return "time"
        return "effort" if not self.concluding and self.spent() > share * self.work else ""

    def skips(self, what: str, until: float = 1.0) -> bool:
        """Whether there is nothing left for a step, or it is past this share of the work; which is noted then."""
        if not self.ends(until):
            return False
        if what not in self.left_out:
            self.left_out.append(what)
        return True

    def conclude(self) -> None:
        """End the search: from here on the whole time counts, and no work."""
        self.concluding = True
