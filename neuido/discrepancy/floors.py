"""What is fitted, what is held out, and what noise, nuisances and discretisation do to each."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from neuido.discrepancy.fit import Covariance
from neuido.discrepancy.problem import Problem

BOUND = 2.5
"""Prior standard deviations that a nuisance may move by."""


@dataclass(frozen=True, eq=False)
class Part:
    """The rows of a recording that are fitted, or that are only scored."""

    recording: int
    rows: np.ndarray
    fitted: bool
    name: str


@dataclass(frozen=True, eq=False)
class Floor:
    """What noise and discretisation do to each recording at one point."""

    noise: dict[int, float]
    weight: dict[int, np.ndarray]
    """One over the standard deviation of each datum."""
    differences: dict[int, np.ndarray]
    """Of the other settings to the one in use, (n, k)."""
    spread: dict[int, np.ndarray]
    """Root mean square of the discretisation error of each datum."""
    nuisances: dict[int, np.ndarray] = field(default_factory=dict)
    """What one prior standard deviation of each nuisance does, (n, k); empty: they are held."""

    def whitener(self, parts: Sequence[Part]) -> Callable[[np.ndarray, int], np.ndarray]:
        """Residuals of the fitted rows in units of their standard deviation, the nuisances marginalised."""
        rows = {p.recording: p.rows for p in parts if p.fitted}
        covariance = {
            n: Covariance.of(1.0, (self.nuisances[n] * self.weight[n][:, None])[own]) for n, own in rows.items() if n in self.nuisances
        }

        def whiten(r: np.ndarray, n: int) -> np.ndarray:
            weighted = (r * self.weight[n])[rows[n]]
            return covariance[n].whiten(weighted) if n in covariance else weighted

        return whiten

    def settle(self, r: np.ndarray, part: Part) -> np.ndarray:
        """A residual (n,) with the nuisances of its recording at their most probable values."""
        N = self.nuisances.get(part.recording)
        if N is None or not N.shape[1]:
            return r
        A, b = N[part.rows], r[part.rows]
        w = self.noise[part.recording]
        normal, right = A.T @ A / w**2 + np.eye(A.shape[1]), A.T @ b / w**2
        values, free = np.zeros(len(right)), np.ones(len(right), bool)
        while free.any():  # thousands of correlated data would outweigh any prior: beyond its bounds a nuisance is held there
            values[free] = np.linalg.solve(normal[np.ix_(free, free)], right[free] - normal[np.ix_(free, ~free)] @ values[~free])
            beyond = free & (np.abs(values) > BOUND)
            if not beyond.any():
                break
            values[beyond] = np.clip(values[beyond], -BOUND, BOUND)
            free &= ~beyond
        return r - N @ values


def split(problem: Problem) -> list[Part]:
    """What is fitted and what is held out: whole recordings where there are some, else the last 40 % of the time."""
    roles = problem.roles
    whole = {n: np.ones(len(r.y), bool) for n, r in enumerate(problem.recordings)}
    names = {n: r.name for n, r in enumerate(problem.recordings)}
    if roles["held_out"]:
        return [Part(n, whole[n], True, names[n]) for n in roles["fit"]] + [Part(n, whole[n], False, names[n]) for n in roles["held_out"]]
    parts = []
    for fitted in (True, False):
        for n in roles["fit"]:
            t = problem.recordings[n].times
            early = t <= t.min() + 0.6 * np.ptp(t)
            parts.append(Part(n, early if fitted else ~early, fitted, names[n] if fitted else f"{names[n]} (last 40 %)"))
    return parts


def over_time(size: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Root mean square of a size over all data of one time."""
    _, index = np.unique(times, return_inverse=True)
    total = np.bincount(index, size**2) / np.bincount(index)
    return np.sqrt(total)[index]
