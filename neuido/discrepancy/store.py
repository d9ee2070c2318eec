"""Predictions stored in memory and on disk, counts of the simulations of each step, and the budget of a search."""

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

from neuido.data.files.writing import make_real_folder, remove, write_bytes
from neuido.discrepancy.problems.problem import Ask, Parameter, Point, Problem, Recording, Rows
from neuido.errors import shortened
from neuido.installation import __version__

IN_MEMORY = 500_000_000
"""Largest size of the predictions in memory [bytes]. The one that was used longest ago is dropped first."""


@dataclass
class Work:
    """Counts of the simulations of one step of a diagnosis."""

    simulations: int = 0
    """Number of simulations (one parameter set and one recording each)."""
    reused: int = 0
    """Number of predictions that were in memory already."""
    effort: float = 0.0
    """Cost of the simulations, in the unit of `Problem.effort` (particle-substeps of a body)."""
    seconds: float = 0.0


class Memo:
    """Predictions of a problem in memory, each computed once while there is room.

    Args:
        problem: The problem that predicts.
        limit: Largest size of the stored predictions [bytes].

    Attributes:
        work: Counts of the simulations of each step, by its name (`during`).
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
        """Number of simulations so far."""
        return sum(w.simulations for w in self.work.values())

    @property
    def effort(self) -> float:
        """Cost of the simulations so far, in the unit of `Problem.effort`."""
        return sum(w.effort for w in self.work.values())

    @property
    def pace(self) -> float:
        """Mean time of a simulation so far [s]."""
        return sum(w.seconds for w in self.work.values()) / max(self.simulations, 1)

    @contextmanager
    def during(self, step: str) -> Iterator[None]:
        """Count simulations for a step while its context is open; steps inside count for the outermost one."""
        before = self._step
        self._step = step if before == "other" else before
        try:
            yield
        finally:
            self._step = before

    def predict(self, points: Sequence[Point], recording: int, setting: int = 0) -> np.ndarray:
        """Predict like `Problem.predict`, from memory where possible."""
        (rows,) = self.predict_several([(points, recording, setting)])
        return rows

    def predict_several(self, asks: Sequence[Ask]) -> list[np.ndarray]:
        """Predict like `Problem.predict_several`, from memory where possible, and return all at once."""
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
            self._kept[key] = row.copy()  # a view would keep its whole batch in memory
            self._size += row.nbytes
        self._kept.move_to_end(key)
        while self._size > self.limit and len(self._kept) > 1:
            self._size -= self._kept.popitem(last=False)[1].nbytes


CHUNK = 32
"""Largest number of parameter sets per stored file, which an interrupted run may lose. Runs without a folder use it too: equal results."""
HEAVY, FEWEST = 2e8, 4
"""Particle-substeps per stored file, about a minute or two of a CPU, and the least number of its parameter sets."""
ON_DISK = 2_000_000_000
"""Largest size of the stored files [bytes]. Later predictions are not stored, and a resumed run computes them again."""


class CachedProblem(Problem):
    """A problem whose predictions are stored in a folder, a file for each call of `predict`.

    The name of a file is a hash of the parameter sets in their order, the recording and the setting. A resumed run makes the same calls
    in the same order, so that it gets the same bits. Everything else is passed on to the problem.

    Args:
        problem: The problem that predicts.
        folder: Folder for the files, made where missing. None: nothing is stored.
        limit: Largest size of all files [bytes].
        tick: Function that is called with the number of parameter sets after every call.
    """

    def __init__(
        self, problem: Problem, folder: str | os.PathLike | None, *, limit: int = ON_DISK, tick: Callable[[int], None] | None = None
    ) -> None:
        super().__init__(**{field.name: getattr(problem, field.name) for field in fields(Problem)})
        folder = None if folder is None else Path(folder)
        if folder is not None:
            folder.mkdir(parents=True, exist_ok=True)
            for path in folder.glob(".*.tmp"):  # left by an interrupted run
                path.unlink(missing_ok=True)
        used = sum(path.stat().st_size for path in folder.glob("*.npy")) if folder is not None else 0
        self.problem, self.folder, self.limit, self.tick = problem, folder, limit, tick
        self.used, self.found, self.computed = used, 0, 0

    def __getattr__(self, name: str) -> Any:  # for what only some kinds of problems have, such as `motion`
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

    def bears(self, point: Point, setting: int) -> bool:
        return self.problem.bears(point, setting)

    def shown(self, point: Point, p: Parameter) -> tuple[float, float]:
        return self.problem.shown(point, p)

    def instrument_errors(self, point: Point, recording: int) -> np.ndarray:
        return self.problem.instrument_errors(point, recording)

    def effort(self, recording: int, setting: int = 0) -> float:
        return self.problem.effort(recording, setting)

    def noise_with(self, point: Point, recording: int) -> float | None:
        return self.problem.noise_with(point, recording)

    def others(self, setting: int) -> list[int]:
        return self.problem.others(setting)

    def quick(self, setting: int) -> int:
        return self.problem.quick(setting)

    def early(self, setting: int, share: float) -> int:
        return self.problem.early(setting, share)

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
        """Divide a request into the calls that are stored as one file each."""
        size = CHUNK
        if not self.problem.together:  # parameter sets are simulated one by one: long simulations are stored in smaller calls
            size = min(max(int(HEAVY / max(self.problem.effort(recording, setting), 1.0)), FEWEST), CHUNK)
        return [(points[i : i + size], recording, setting) for i in range(0, len(points), size)]

    def _stored(self, calls: Sequence[Ask]) -> Rows:
        """Yield the predictions of each call, from its file where there is one; others are computed and stored at once."""
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
        stored = short if np.array_equal(short.astype(np.float64), values, equal_nan=True) else values  # mostly exact in float32
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
    except Exception as error:  # NumPy raises several types for a truncated or damaged file
        warnings.warn(f"{path} is left aside and computed again: {shortened(str(error))}", stacklevel=2)
        return None
    return values.astype(np.float64)


def plan_of(folder: str | os.PathLike, options: dict[str, Any], *, out: Path) -> str:
    """Return a hash that names a run: of its options and of every file in the measured folder except those in `out`."""
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
"""Parts of the package on which predictions depend."""


@functools.cache
def code_digest() -> str:
    """Return a hash of the sources on which predictions depend, so that those of other code are not reused."""
    root = Path(__file__).parents[1]
    digest = hashlib.sha256(__version__.encode())
    for name in RELEVANT:
        place = root / name
        for path in sorted(place.rglob("*.py")) if place.is_dir() else [place]:
            digest.update(str(path.relative_to(root)).encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()


def outdated(out: Path, plan: str) -> list[str]:
    """Return the names (`plan_of`) of other runs whose predictions are in `out`: of other data, options or code."""
    root = out / ".work"
    return sorted(path.name for path in root.iterdir() if path.name != plan) if root.is_dir() else []


def workplace(out: Path, plan: str, *, resume: bool) -> Path:
    """Make the folder in `out` for the predictions of the run named `plan`; remove those of other runs, and its own unless `resume`."""
    root = make_real_folder(out / ".work", "the folder of predictions")
    for other in root.iterdir():
        if other.name != plan or not resume:
            remove(other)
    return make_real_folder(root / plan, "the folder of predictions")


def clear(out: Path) -> None:
    """Remove the stored predictions from `out`, which only a resumed run needs."""
    remove(out / ".work")


SEARCH = 0.8
"""Largest share of the time limit for the search. The rest is for the last fit, the intervals and the report."""
LEAST_SEARCH = 0.6
"""Least share of the time limit for the search."""
AFTER = 200
"""Number of simulations expected after the search: for open decisions, the last fit and its intervals."""


def own_clock() -> Callable[[], float]:
    """Return a clock [s] from now on that stands still while other processes have the processor, so that their work ends no search."""
    begun, used = time.monotonic(), time.process_time()
    return lambda: min(time.monotonic() - begun, time.process_time() - used)


class Budget:
    """The work that a search may do, and its time limit.

    The work decides what a search does, and is the same on fast and slow machines. The time limit only cuts a search off. What follows the
    search (last fit, intervals) is short and is not counted.

    Args:
        work: Work of the search, in the unit of `spent`. Infinite: no limit.
        spent: Function that returns the work so far.
        seconds: Time limit from now on [s]. Infinite: no limit.
        clock: Monotonic clock [s].
        pace: Function that returns the mean time of a simulation so far [s]. The slower it is, the earlier the search stops.

    Attributes:
        left_out: Steps that the search has not done, in words.
        cut: Whether a step or a fit ended early, so that more work could change the answer.
        ended_by: What ended the search: `effort` or `time`; empty where nothing did.
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
        """Share of the time limit that is available now: that of the search, or all of it after `conclude`."""
        if self.concluding or math.isinf(self.seconds):
            return 1.0
        return min(max(1.0 - AFTER * self.pace() / max(self.seconds, 1e-9), LEAST_SEARCH), SEARCH)

    @property
    def over(self) -> bool:
        """Whether the work is spent or the time is up; unlike `ends` it does not mark the search as cut off."""
        return bool(self._end(1.0))

    def ends(self, share: float = 1.0) -> bool:
        """Return whether this share of the work is spent or the time is up, and if so mark the search as cut off.

        An infinite share is never spent.
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
        """Return whether a step must be skipped because this share of the work is spent or the time is up, and if so note its name."""
        if not self.ends(until):
            return False
        if what not in self.left_out:
            self.left_out.append(what)
        return True

    def conclude(self) -> None:
        """End the search: from now on the whole time limit counts, and the work is not limited."""
        self.concluding = True
