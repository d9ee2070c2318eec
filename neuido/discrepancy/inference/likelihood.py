"""The likelihood of recordings under a fitted model: noise, nuisances, other settings, and what no setting shows.

For the residual r of a recording where a fit ended,

    r ~ N(0, sigma^2 I + N N^T + s^2 S S^T + D D^T + J P J^T),

with N one prior standard deviation of each nuisance, S smooth patterns of one mean square together, D the differences of the other
settings, and J the slopes by the free parameters, of prior variances P. The amounts of N and S are a recording's own, those of D and J are
shared by all recordings. The scale s of the patterns is common and unknown: densities are computed for many scales at once, and averaged.
It is never below what the settings leave of one another after a refit: that is what simulations differ by, whatever the effects, and none
leads by promising less.

A recording is rotated once into the principal patterns left by noise and nuisances; a density at any scale then costs a few products of
small matrices (Woodbury's identity, and the determinant lemma beside it).

What lies outside the patterns and the nuisances is counted as few data, not row by row: see `share`.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import logsumexp

from neuido.discrepancy.inference.statistics import PartStatistics

SCALES = np.geomspace(1.0, 1000.0, 61)
"""Scales of the patterns that densities are averaged over, in units of what the settings leave of one another: how much more another
solver may differ by is unknown by orders of magnitude, so each counts alike."""


@dataclass(frozen=True, eq=False)
class Rotated:
    """A recording in its principal patterns, whitened by noise and nuisances."""

    constant: float
    """Counted rows times log(2 pi), and the log-determinant of noise and nuisances."""
    strength: np.ndarray
    """(k,) variances of the principal patterns at scale one, over noise and nuisances."""
    along: np.ndarray
    """(k, q + 1) the shared directions and the residual along them."""
    gram: np.ndarray
    """(q + 1, q + 1) their inner products."""


def share(parts: Sequence[PartStatistics]) -> float:
    """Return the share of its rows that a recording counts outside its smooth patterns: as many data as there are patterns.

    Solvers differ by finer structures than the patterns have. Were each of 60,000 rows a datum of its own there, an effect that happens to
    take a hundredth of such a structure would lead by hundreds.
    """
    patterns, rows = parts[0].smooth.shape[1], sum(p.rows for p in parts)
    return 1.0 if not patterns else min(patterns / max(rows - patterns, 1), 1.0)


def rotated(parts: Sequence[PartStatistics], shared: Sequence[np.ndarray], outside: float = 1.0) -> Rotated:
    """Return parts of one recording as one.

    Args:
        parts: Of one recording, with one noise.
        shared: Of each part the directions whose amounts all recordings share, (k, q).
        outside: Share of the rows that are counted of what lies outside the patterns and the nuisances.
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
        recordings: With the same shared directions.
        variances: Prior variances of the shared amounts, (q,).
        scales: Of the patterns, in the unit of the data.
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
    """Return the logarithm of the mean density over scales, of log-densities."""
    total: Any = logsumexp(densities)  # a pair only where signs are asked for
    return float(total) - math.log(len(densities))
