"""Parametric bootstrap of the null hypothesis: how much could a candidate lower the error if no effect were missing?

Noise, nuisances and discretisation error are drawn at random. Each draw is fitted by a linear model, with and without each candidate.
All directions (declared parameters, nuisances, discretisation, candidates) are expressed in one orthonormal basis, so that a draw costs
a few small matrix products. As in the errors of a diagnosis, a fit also finds the amounts of the differences between settings, with a
prior, and the nuisances are projected out of every recording. Source: Westfall and Young, Resampling-Based Multiple Testing, 1993 (the
maximum over candidates).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from neuido.discrepancy.inference.floors import project_out_nuisances, scores

NOISE_ALONE = 1.8
"""Errors count as noise while their mean square is at most this many times that of the noise."""


@dataclass(frozen=True, eq=False)
class Columns:
    """Directions in the data of one recording: each is an array (n, k) of k columns for n data, in the unit of the data."""

    weight: np.ndarray
    """Weight of each datum in the fit, one over its standard deviation, (n,)."""
    noise: float
    """Standard deviation of the noise."""
    declared: np.ndarray
    """Slopes of the declared parameters."""
    nuisances: np.ndarray
    """Effect of one prior standard deviation of each nuisance."""
    discretisation: np.ndarray
    """Differences between the other settings and the one in use, where the base fit ended."""
    smooth: np.ndarray
    """Smooth patterns of the discretisation error that no setting shows, of its expected size."""
    candidates: Mapping[str, np.ndarray]
    """Directions of each candidate effect, by its key."""


class LinearModel:
    """Linear fits of the base model, with and without each candidate, to draws from the null hypothesis.

    Args:
        fit: Columns of the recordings that are fitted.
        held_out: Columns of the recordings that are only scored.
        seed: Seed of the random draws.
    """

    def __init__(self, fit: Sequence[Columns], held_out: Sequence[Columns], *, seed: int = 0) -> None:
        self.keys = list(fit[0].candidates)
        self.parts = [_Part(c, True) for c in fit] + [_Part(c, False) for c in held_out]
        self.rng = np.random.default_rng(seed)
        names = [(None, ())] + [(key, (key,)) for key in self.keys]
        self.solvers = {name: _solver([p for p in self.parts if p.fitted], keys) for name, keys in names}

    def null(self, data: np.ndarray, count: int = 199, *, exact: bool = False) -> np.ndarray:
        """Return the largest `gain` over all candidates in each of `count` draws from the null hypothesis, (count,).

        Args:
            data: Mean squares of the parts that the base leaves of the measured data, as in `gain`.
            count: Number of draws.
            exact: Whether to draw noise and nuisances alone, and no discretisation error.
        """
        errors = self._errors([[p.draw(self.rng, exact) for p in self.parts] for _ in range(count)])
        fitted, noise = [p.fitted for p in self.parts], np.array([p.noise**2 for p in self.parts])
        gains = [_gains(errors[None], errors[key], fitted, noise, data) for key in self.keys]
        return np.max(gains, axis=0) if gains else np.zeros(count)

    def _errors(self, draws: Sequence[Sequence[tuple[np.ndarray, float]]]) -> dict[str | None, np.ndarray]:
        """Fit draws, and return the mean squares (draws, parts) that the base (key None) and each candidate leave."""
        residuals = [np.stack([r for r, _ in own]) for own in zip(*draws, strict=True)]  # (draws, k) for each part
        outside = [np.array([rest for _, rest in own]) for own in zip(*draws, strict=True)]
        weighted = np.concatenate([p.weighted(r) for p, r in zip(self.parts, residuals, strict=True) if p.fitted], axis=1)
        out = {}
        for name, solve in self.solvers.items():
            amounts, keys = weighted @ solve.T, () if name is None else (name,)
            left = [r - amounts @ p.design(keys).T for p, r in zip(self.parts, residuals, strict=True)]
            squares = [((r * r).sum(1) + rest) / p.count for p, r, rest in zip(self.parts, left, outside, strict=True)]
            out[name] = np.stack(squares, axis=1)
        return out

    def cosine(self, a: str, b: str) -> float:
        """Return the cosine between two candidates, after the directions of the base fit are projected out.

        Data are weighted as in the fit. A candidate of several parameters spans a plane; the largest cosine of two planes counts.
        """
        parts = [p for p in self.parts if p.fitted]
        base = np.concatenate([p.design(()) * p.scale[:, None] for p in parts])
        A, B = (np.concatenate([p.candidates[k] * p.scale[:, None] for p in parts]) for k in (a, b))
        q, _ = np.linalg.qr(base)
        A, B = (np.linalg.qr(M - q @ (q.T @ M))[0] for M in (A, B))
        return float(np.linalg.svd(A.T @ B, compute_uv=False).max(initial=0.0))


def gain(before: np.ndarray, after: np.ndarray, fitted: Sequence[bool], noise: np.ndarray, *, data: np.ndarray | None = None) -> float:
    """Return the logarithm of the error before over the error after: the smaller one of fitted and held-out recordings.

    Each of the two is a geometric mean over recordings, as in `score`, so that one recording that no effect explains does not hide the
    others. If the fitted recordings are at the noise before and after, only the held-out ones count: the declared parameters then stand
    in for the effect where they were fitted, and only other recordings show it. All arguments except `fitted` are mean squares of the
    parts, (parts,).

    Args:
        before: What the base leaves.
        after: What the fit with an effect leaves.
        fitted: Which parts are fitted.
        noise: The noise.
        data: What the base leaves of the measured data, if `before` belongs to a draw. A draw is always near the noise, the data may not.
    """
    return float(_gains(before, after, fitted, noise, data))


def _gains(before: np.ndarray, after: np.ndarray, fitted: Sequence[bool], noise: np.ndarray, data: np.ndarray | None) -> np.ndarray:
    """Return `gain` of several draws at once, (...,), from mean squares (..., parts)."""
    own = np.array(fitted)
    if own.all():
        return ratio(before, after, own)
    held_out = ratio(before, after, ~own)
    if not own.any():
        return held_out
    seen = [before, after] if data is None else [before, after, data]
    largest = np.max(np.broadcast_arrays(*(squares[..., own].mean(-1) for squares in seen)), axis=0)
    noisy = largest < NOISE_ALONE * noise[own].mean()
    return np.where(noisy, held_out, np.minimum(ratio(before, after, own), held_out))


def ratio(before: np.ndarray, after: np.ndarray, group: np.ndarray) -> np.ndarray:
    """Return the logarithm of the error before over the error after, for a group of parts given by a mask; arguments are mean squares."""
    return 0.5 * (scores(np.minimum(before[..., group], 1e300)) - scores(np.minimum(after[..., group], 1e300)))


class _Part:
    """Columns of one recording in an orthonormal basis of their span. Outside of this span the data hold only noise."""

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
        self.project = project = project_out_nuisances(self.nuisances, self.noise)
        self.discretisation = basis.T @ columns.discretisation
        self.declared = project(basis.T @ columns.declared)
        self.settings = project(self.discretisation)
        self.candidates = {key: project(basis.T @ value) for key, value in columns.candidates.items()}
        # weights vary slowly over the data, so a mean weight for each direction of the basis is enough
        self.scale = np.sqrt(np.maximum((basis**2).T @ columns.weight**2, 1e-300))

    def design(self, keys: Sequence[str]) -> np.ndarray:
        """Return the columns of the linear fit (k, q): declared parameters, candidates, differences between settings (in this order)."""
        return np.concatenate([self.declared, *(self.candidates[key] for key in keys), self.settings], axis=1)

    def weighted(self, r: np.ndarray) -> np.ndarray:
        """Return residuals (..., k) times the weight of each direction."""
        return r * self.scale

    def draw(self, rng: np.random.Generator, exact: bool = False) -> tuple[np.ndarray, float]:
        """Draw a residual (k,) under the null hypothesis, with the nuisances projected out, and the sum of squares outside of the basis.

        With `exact`, only noise and nuisances are drawn, and no discretisation error.
        """
        k = len(self.scale)
        r = self.noise * rng.standard_normal(k)
        for columns in (self.nuisances,) if exact else (self.nuisances, self.discretisation, self.smooth):
            r = r + columns @ rng.standard_normal(columns.shape[1])
        return self.project(r), self.noise**2 * (rng.chisquare(self.outside) if self.outside else 0.0)


def _solver(parts: Sequence[_Part], keys: Sequence[str]) -> np.ndarray:
    """Return the matrix that maps the weighted residuals of the fitted parts to the fitted amounts; those of settings have a prior."""
    A = np.concatenate([p.design(keys) * p.scale[:, None] for p in parts])
    amounts = parts[0].settings.shape[1]
    prior = np.eye(A.shape[1])[A.shape[1] - amounts :]
    return np.linalg.pinv(np.concatenate([A, prior]), rcond=1e-8)[:, : len(A)]
