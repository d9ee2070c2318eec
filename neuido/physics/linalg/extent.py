"""Extent of a set of points along its principal axes."""

import numpy as np

FLAT = 1e-5
"""Extent, as a share of the largest, below which points have none along an axis."""
PLACES = ("are all in one place", "lie on a line", "lie in a plane")


def principal_extents(x: np.ndarray) -> np.ndarray:
    """Return the extents of points along their principal axes, largest first.

    An extent below `FLAT` times the largest, or within the rounding of float32 coordinates, is returned as zero.

    Args:
        x: Points [m], (P, 3), at least one.

    Returns:
        Extents [m], (3,).
    """
    x = np.asarray(x, dtype=np.float64)
    d = x - x.mean(axis=0)
    extents = np.sort(np.ptp(d @ np.linalg.svd(d.T @ d)[2].T, axis=0))[::-1]
    smallest = max(FLAT * extents[0], 4 * np.finfo(np.float32).eps * np.abs(x).max())
    return np.where(extents > smallest, extents, 0.0)


def without_volume(x: np.ndarray) -> str:
    """Return how points fail to span a volume, such as "lie in a plane"; an empty string where they span one.

    Args:
        x: Points [m], (P, 3), at least one.
    """
    dimensions = int((principal_extents(x) > 0).sum())
    return "" if dimensions == 3 else PLACES[dimensions]


def box_axes(x: np.ndarray) -> np.ndarray:
    """Find the axes of the smallest box around points, by rotations about one axis at a time from several starts.

    Args:
        x: Points [m], (P, 3).

    Returns:
        The axes as orthonormal rows, (3, 3).
    """
    generator = np.random.default_rng(0)
    d = x - x.mean(axis=0)
    starts = [np.eye(3), np.linalg.svd(d.T @ d)[2], *(np.linalg.qr(generator.standard_normal((3, 3)))[0] for _ in range(6))]
    if len(d) > 4000:  # the box depends on the outermost points alone
        directions = generator.standard_normal((2000, 3))
        d = d[np.unique(np.argmax(d @ directions.T, axis=0))]
    best, smallest = np.eye(3), np.inf
    for axes in starts:
        width = np.pi / 4
        for _ in range(24):
            for a in range(3):
                i, j = (a + 1) % 3, (a + 2) % 3
                angle = np.linspace(-width, width, 61)
                u, v = d @ axes[i], d @ axes[j]
                area = np.ptp(np.outer(np.cos(angle), u) + np.outer(np.sin(angle), v), axis=1)
                area = area * np.ptp(np.outer(np.cos(angle), v) - np.outer(np.sin(angle), u), axis=1)
                t = angle[np.argmin(area)]
                axes = axes.copy()
                axes[[i, j]] = np.cos(t) * axes[i] + np.sin(t) * axes[j], np.cos(t) * axes[j] - np.sin(t) * axes[i]
            width = max(0.7 * width, 1e-4)
        size = np.prod(np.ptp(d @ axes.T, axis=0))
        if size < smallest * (1 - 1e-6):
            best, smallest = axes, size
    return best
