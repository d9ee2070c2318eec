"""Predictions kept by point, so that no step of a diagnosis runs what another one ran, and a count of what each step ran."""

import time
from collections import OrderedDict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np

from neuido.discrepancy.problem import Ask, Point, Problem, Recording

LIMIT = 500_000_000
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

    def __init__(self, problem: Problem, *, limit: int = LIMIT) -> None:
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
