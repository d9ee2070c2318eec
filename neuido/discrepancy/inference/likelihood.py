"""Likelihood of recordings under a fitted model with noise, nuisances, and errors of the simulation.

The residual r of a recording where a fit ended is Gaussian:

    r ~ N(0, sigma^2 I + N N^T + s^2 S S^T + D D^T + J P J^T),

* sigma: standard deviation of the noise.
* N: change of the data by one prior standard deviation of each nuisance; the amounts differ between recordings.
* S: smooth patterns of mean square one, for errors of the simulation that no setting shows; the amounts differ between recordings.
* s: scale of S. It is unknown, and the same for all recordings. Densities are averaged over many scales (`SCALES`), the least of which is
  what the settings differ by after a refit of the declared model (`evidence.unseen`).
* D: differences between the other settings and the one in use; the amounts are the same for all recordings.
* J: slopes by the free parameters, with prior variances P; the amounts are the same for all recordings.

A recording is rotated once into its principal patterns. A density at any scale then costs a few products of small matrices (Woodbury's
identity and the matrix determinant lemma).

Rows outside the patterns and nuisances do not count one by one, but as few data: see `share`.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import logsumexp

from neuido.discrepancy.inference.statistics import PartStatistics

SCALES = np.geomspace(1.0, 1000.0, 61)
"""Scales of the smooth patterns that densities are averaged over, in units of the least scale. The error of the simulation is unknown by
orders of magnitude, so each of them counts alike."""


@dataclass(frozen=True, eq=False)
class Rotated:
    """A recording in its principal patterns, whitened by noise and nuisances; q is the number of directions shared by all recordings."""

    constant: float
    """Counted rows times log(2 pi), plus the log-determinant of the covariance of noise and nuisances."""
    strength: np.ndarray
    """(k,), variances of the principal patterns at scale one, relative to noise and nuisances."""
    along: np.ndarray
    """(k, q + 1), shared directions and residual (last column), projected on the principal patterns."""
    gram: np.ndarray
    """(q + 1, q + 1), inner products of shared directions and residual."""


def share(parts: Sequence[PartStatistics]) -> float:
    """Return the weight of the rows of a recording outside its smooth patterns; together they count as many data as there are patterns.

    Solvers also differ by structures finer than the patterns. If each of some 60,000 rows counted as an independent datum, an effect that
    happens to explain one per cent of such a structure would lead by hundreds.

    Args:
        parts: All parts of one recording.
    """
    patterns, rows = parts[0].smooth.shape[1], sum(p.rows for p in parts)
    return 1.0 if not patterns else min(patterns / max(rows - patterns, 1), 1.0)


def rotated(parts: Sequence[PartStatistics], shared: Sequence[np.ndarray], outside: float = 1.0) -> Rotated:
    """Join parts of one recording, and rotate them into their principal patterns.

    Args:
        parts: Parts of one recording, with the same noise.
        shared: Directions of each part whose amounts are the same for all recordings, (k, q).
        outside: Weight of the rows outside the patterns and nuisances: `share`.
    """
    noise, rows = parts[0].noise, sum(p.rows for p in parts)
    smooth, nuisances, residual = (np.concatenate([getattr(p, name) for p in parts]) for name in ("smooth", "nuisances", "residual"))
    columns = np.concatenate([np.concatenate(shared), residual[:, None]], axis=1) / noise
    inside, sizes, _ = np.linalg.svd(np.concatenate([smooth, nuisances], axis=1), full_matrices=False)
    inside = inside[:, sizes > 1e-10 * max(sizes.max(initial=0.0), 1e-300)]
    along = inside @ (inside.T @ columns)
    columns = along + math.sqrt(outside) * (columns - along)
    counted = inside.shape[1] + outside * (rows - inside.shape[1])
    U, widths, _ = np.linalg.svd(nuisances / noise, full_matrices=False)
    shrink = 1.0 - 1.0 / np.sqrt(1.0 + widths**2)

    def whitened(M: np.ndarray) -> np.ndarray:
        return M - U @ (shrink[:, None] * (U.T @ M))

    columns = whitened(columns)
    V, strength, _ = np.linalg.svd(whitened(smooth / noise), full_matrices=False)
    constant = counted * math.log(2.0 * math.pi * noise**2) + float(np.sum(np.log1p(widths**2)))
    return Rotated(constant, strength**2, V.T @ columns, columns.T @ columns)


def log_densities(recordings: Sequence[Rotated], variances: np.ndarray, scales: np.ndarray) -> np.ndarray:
    """Return the log-density of the residuals of several recordings at each scale of the patterns, (len(scales),).

    Args:
        recordings: Recordings with the same q shared directions.
        variances: Prior variances of the amounts of the shared directions, (q,).
        scales: Scales of the patterns, in the unit of the data.
    """
    q = len(variances)
    gram = np.zeros((len(scales), q + 1, q + 1))
    out = np.zeros(len(scales))
    for r in recordings:
        grown = scales[:, None] ** 2 * r.strength  # (g, k)
        gram += r.gram - np.einsum("gk,ki,kj->gij", grown / (1.0 + grown), r.along, r.along)
        out -= 0.5 * (r.constant + np.log1p(grown).sum(axis=1))
    root = np.sqrt(variances)
    B = np.eye(q) + root[:, None] * gram[:, :q, :q] * root
    b = root * gram[:, :q, q]
    taken = np.einsum("gi,gi->g", b, np.linalg.solve(B, b[..., None])[..., 0]) if q else 0.0
    _, logdet = np.linalg.slogdet(B) if q else (1.0, 0.0)
    return out - 0.5 * (logdet + gram[:, q, q] - taken)


def log_mean(densities: np.ndarray) -> float:
    """Return the logarithm of the mean of densities, given their logarithms (one for each scale)."""
    total: Any = logsumexp(densities)  # typed as a pair, which it is only with return_sign
    return float(total) - math.log(len(densities))
