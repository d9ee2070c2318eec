"""How far chance, the nuisances and the discretisation alone would go: a linear model of the fits and its parametric bootstrap.

All directions (declared parameters, nuisances, discretisation, candidates) are brought to one orthonormal basis, so that a draw
costs a few small products. Fits hold the differences of the settings beside the parameters, with a prior, and the nuisances are taken
out of every recording, as in the errors of a diagnosis. Reference: Westfall and Young, Resampling-Based Multiple Testing, 1993 (the
maximum over candidates).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from neuido.discrepancy.inference.floors import past_nuisances, score

NOISE_ALONE = 1.8
"""Mean squares up to so many times that of the noise are noise."""


@dataclass(frozen=True, eq=False)
class Columns:
    """Directions in the data of one recording, each (n, k)."""

    weight: np.ndarray
    """Of each datum in the fit, one over its standard deviation, (n,)."""
    noise: float
    declared: np.ndarray
    nuisances: np.ndarray
    """Times their prior standard deviations."""
    discretisation: np.ndarray
    """Differences of the settings at the base."""
    smooth: np.ndarray
    """Patterns of an unknown part of it, times its size."""
    candidates: Mapping[str, np.ndarray]


class LinearModel:
    """Fits of the base and of each candidate to draws from the null hypothesis.

    Args:
        fit: Columns of the recordings that are fitted.
        held_out: Of those that are only scored.
        seed: Of the draws.
    """

    def __init__(self, fit: Sequence[Columns], held_out: Sequence[Columns], *, seed: int = 0) -> None:
        self.keys = list(fit[0].candidates)
        self.parts = [_Part(c, True) for c in fit] + [_Part(c, False) for c in held_out]
        self.rng = np.random.default_rng(seed)
        names = [(None, ())] + [(key, (key,)) for key in self.keys]
        self.solvers = {name: _solver([p for p in self.parts if p.fitted], keys) for name, keys in names}

    def draw(self, *, exact: bool = False) -> list[np.ndarray]:
        """One residual of each part under the null, in its basis; `exact`: of noise and nuisances alone."""
        return [p.draw(self.rng, exact) for p in self.parts]

    def errors(self, draw: Sequence[np.ndarray]) -> dict[str | None, np.ndarray]:
        """Mean squares of each part after the fit of the base (None) and of each candidate, (parts,)."""
        out = {}
        fitted = np.concatenate([p.weighted(r) for p, r in zip(self.parts, draw, strict=True) if p.fitted])
        for name, solve in self.solvers.items():
            keys = () if name is None else (name,)
            q = solve @ fitted
            out[name] = np.array([p.square(r - p.design(keys) @ q) for p, r in zip(self.parts, draw, strict=True)])
        return out

    def null(self, data: np.ndarray, count: int = 199, *, exact: bool = False) -> np.ndarray:
        """The largest gain over the candidates in each of `count` draws, weighed as that of the data is; `data` as for `gain`."""
        return np.array([self._largest(self.errors(self.draw(exact=exact)), data) for _ in range(count)])

    def _largest(self, errors: Mapping[str | None, np.ndarray], data: np.ndarray) -> float:
        fitted, noise = [p.fitted for p in self.parts], np.array([p.noise**2 for p in self.parts])
        return max((gain(errors[None], errors[key], fitted, noise, data=data) for key in self.keys), default=0.0)

    def cosine(self, a: str, b: str) -> float:
        """Cosine of two candidates in the fit's metric, the declared parameters projected out (largest over their planes)."""
        parts = [p for p in self.parts if p.fitted]
        base = np.concatenate([p.design(()) * p.scale[:, None] for p in parts])
        A, B = (np.concatenate([p.candidates[k] * p.scale[:, None] for p in parts]) for k in (a, b))
        q, _ = np.linalg.qr(base)
        A, B = (np.linalg.qr(M - q @ (q.T @ M))[0] for M in (A, B))
        return float(np.linalg.svd(A.T @ B, compute_uv=False).max(initial=0.0))


def gain(before: np.ndarray, after: np.ndarray, fitted: Sequence[bool], noise: np.ndarray, *, data: np.ndarray | None = None) -> float:
    """Logarithm of the ratio of errors, before over after: the smaller of those of the fitted and of the held-out recordings.

    Each is the geometric mean over its recordings, as in the score: where one is far off whatever the effect, the others still count. Of
    the held-out ones alone where the fitted ones are at the noise before and after: the declared parameters have taken the effect in
    there, and what they predict of the others says so. All arguments but `fitted` are mean squares of the parts.

    Args:
        before: Of the base.
        after: With an effect.
        fitted: Which parts are fitted.
        noise: Of the noise.
        data: Of the base with the data themselves, where `before` is of a draw, which is at the noise whatever the data are.
    """
    own = np.array(fitted)
    if own.all():
        return ratio(before, after, own)
    seen = [before, after] if data is None else [before, after, data]
    if own.any() and not max(squares[own].mean() for squares in seen) < NOISE_ALONE * noise[own].mean():
        return min(ratio(before, after, own), ratio(before, after, ~own))
    return ratio(before, after, ~own)


def ratio(before: np.ndarray, after: np.ndarray, group: np.ndarray) -> float:
    """Logarithm of the ratio of errors, before over after, of a group of the parts; of their mean squares."""
    return 0.5 * (score(np.minimum(before[group], 1e300)) - score(np.minimum(after[group], 1e300)))


class _Part:
    """Columns of one recording in an orthonormal basis of their span; what is outside is noise alone."""

    def __init__(self, columns: Columns, fitted: bool) -> None:
        self.fitted = fitted
        everything = np.concatenate(
            [columns.declared, columns.nuisances, columns.discretisation, columns.smooth, *columns.candidates.values()], axis=1
        )
        values, vectors = np.linalg.eigh(everything.T @ everything)
        keep = values > 1e-10 * max(values.max(initial=0.0), 1e-300)
        basis = (everything @ vectors[:, keep]) / np.sqrt(values[keep])
        self.count, self.noise = len(everything), columns.noise
        self.outside = max(self.count - basis.shape[1], 0)
        self.nuisances, self.smooth = basis.T @ columns.nuisances, basis.T @ columns.smooth
        self.past = past = past_nuisances(self.nuisances, self.noise)
        self.discretisation = basis.T @ columns.discretisation
        self.declared = past(basis.T @ columns.declared)
        self.settings = past(self.discretisation)
        self.candidates = {key: past(basis.T @ value) for key, value in columns.candidates.items()}
        # the weights vary slowly over the data: in the basis each direction gets its own mean weight
        self.scale = np.sqrt(np.maximum((basis**2).T @ columns.weight**2, 1e-300))

    def design(self, keys: Sequence[str]) -> np.ndarray:
        """What a fit moves, the amounts of the settings' differences last."""
        return np.concatenate([self.declared, *(self.candidates[key] for key in keys), self.settings], axis=1)

    def weighted(self, r: np.ndarray) -> np.ndarray:
        return r[: len(self.scale)] * self.scale

    def draw(self, rng: np.random.Generator, exact: bool = False) -> np.ndarray:
        k = len(self.scale)
        r = self.noise * rng.standard_normal(k)
        for columns in (self.nuisances,) if exact else (self.nuisances, self.discretisation, self.smooth):
            r = r + columns @ rng.standard_normal(columns.shape[1])
        self.rest = self.noise**2 * (rng.chisquare(self.outside) if self.outside else 0.0)
        return self.past(r)

    def square(self, r: np.ndarray) -> float:
        """Mean square over all data of the recording."""
        return (float(r @ r) + self.rest) / self.count


def _solver(parts: Sequence[_Part], keys: Sequence[str]) -> np.ndarray:
    A = np.concatenate([p.design(keys) * p.scale[:, None] for p in parts])
    amounts = parts[0].settings.shape[1]
    prior = np.eye(A.shape[1])[A.shape[1] - amounts :]
    return np.linalg.pinv(np.concatenate([A, prior]), rcond=1e-8)[:, : len(A)]
