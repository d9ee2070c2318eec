"""Reconstructed surface of particles: marching cubes on their smoothed number density, frame by frame.

The volume of each particle, which changes with det F, is spread over the nodes of a regular grid, the grid is smoothed by a Gaussian, and
the surface is where half of the volume is filled. There an evenly filled half-space has its boundary, half a spacing outside its outermost
particles.
"""

import math

import numpy as np

from neuido.data.progress import Progress
from neuido.errors import UserError
from neuido.export.exchange import NEAREST_SAMPLED, PALETTE, Exchange, Part, Surface
from neuido.export.marching_cubes import find_isosurface

SMOOTHING = 0.6
"""Standard deviation of the Gaussian in spacings of the particles; of a cubic lattice it leaves a ripple of exp(-(2 pi 0.6)^2/2), 0.1 %."""
CELLS_PER_SPACING = 2.0
"""Cells of the grid per spacing of the particles."""
REACH = 4.0
"""Width of the margin around the particles, in standard deviations."""
MOST_NODES = 1 << 25
"""Largest number of grid nodes of a frame; beyond it cells become larger (a frame then takes about 0.5 GB)."""
NEIGHBOUR, QUARTILE = 6, 0.25
"""The lower quartile of the distance to the sixth neighbour is the spacing: exactly on a cubic lattice, and within 1 % of the cube root of
the volume per particle in a random filling, where (4/3) pi r^3 has a gamma distribution of shape six with the lower quartile 4.22."""
RATIOS = (0.2, 5.0)
"""Bounds of the volume ratio that weighs a particle [-]."""


def reconstruct_surface(made: Exchange, part: Part, number: int = 0, *, spacing: float | None = None, progress: bool = False) -> Surface:
    """Reconstruct the surface of a body in every frame.

    Args:
        made: The motion.
        part: The body.
        number: Its number, which selects the colour.
        spacing: Distance between neighbouring particles [m]; found in the first frame where absent.
        progress: Whether progress is shown on stderr.

    Raises:
        UserError: Fewer than four particles, a spacing that is not positive, or one at which they touch nowhere.
    """
    x = made.x[:, part.index].astype(np.float64)
    if x.shape[1] < 4:
        raise UserError(f"{part.name} has {x.shape[1]} particles; a surface needs four at least")
    spacing = _spacing(x[0]) if spacing is None else spacing
    if not spacing > 0:
        raise UserError(f"surface_spacing is {spacing:g}; it must be a positive length in m")
    name = "surface" if len(made.parts) == 1 else f"{part.name}_surface"
    out = Surface(name, [], [], [], colour=PALETTE[number % len(PALETTE)])
    with Progress(f"reconstructing the {name}", made.frames, unit="frames", shown=progress) as work:
        for k, points in enumerate(x):
            _add_frame(out, points, None if made.F is None else made.F[k, part.index], spacing)
            work.update()
    if not any(len(faces) for faces in out.faces):
        raise UserError(f"{part.name}: its particles lie too far apart for a surface_spacing of {spacing:.3g} m; give a larger one")
    return out


def _add_frame(out: Surface, points: np.ndarray, F: np.ndarray | None, spacing: float) -> None:
    """Append the surface of a frame."""
    ratio = np.ones(len(points)) if F is None else np.linalg.det(F.astype(np.float64))
    lower, cell, density = _density(points, ratio.clip(*RATIOS), spacing)
    vertices, faces, slopes = find_isosurface(density, 0.5 * (cell / spacing) ** 3)
    normals = -slopes / np.maximum(np.linalg.norm(slopes, axis=1, keepdims=True), 1e-30)
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    if float(np.einsum("ni,ni->", np.cross(b - a, c - a), normals[faces[:, 0]])) < 0:
        faces = faces[:, ::-1]  # anticlockwise as seen from outside
    out.vertices.append((lower + cell * vertices).astype(np.float32))  # type: ignore[attr-defined]
    out.faces.append(np.ascontiguousarray(faces, np.int32))  # type: ignore[attr-defined]
    out.normals.append(normals.astype(np.float32))  # type: ignore[attr-defined]


def _spacing(x: np.ndarray) -> float:
    from scipy.spatial import KDTree

    asked = x[:: max(1, len(x) // NEAREST_SAMPLED)]
    nearest = min(NEIGHBOUR, len(x) - 1) + 1
    return float(np.quantile(np.asarray(KDTree(x).query(asked, k=nearest)[0])[:, -1], QUARTILE))


def _density(x: np.ndarray, ratio: np.ndarray, spacing: float) -> tuple[np.ndarray, float, np.ndarray]:
    """Return lower corner [m], cell [m] and the smoothed sum of `ratio` per cell at the nodes (nx, ny, nz) float32."""
    from scipy.ndimage import gaussian_filter

    smoothing = SMOOTHING * spacing
    low, high = x.min(axis=0) - REACH * smoothing, x.max(axis=0) + REACH * smoothing
    cell = max(spacing / CELLS_PER_SPACING, float(np.prod(high - low) / MOST_NODES) ** (1 / 3))
    nodes = tuple(math.ceil(size / cell) + 2 for size in high - low)
    place = (x - low) / cell
    base = np.floor(place).astype(np.int64)
    part = place - base
    near = np.stack([1 - part, part])
    first, row = np.ravel_multi_index(base.T, nodes), nodes[2]
    places, weights = [], []
    for i, j, k in np.ndindex(2, 2, 2):
        places.append(first + (i * nodes[1] + j) * row + k)
        weights.append(ratio * near[i, :, 0] * near[j, :, 1] * near[k, :, 2])
    density = np.bincount(np.concatenate(places), np.concatenate(weights), math.prod(nodes))
    return low, cell, gaussian_filter(density.reshape(nodes).astype(np.float32), smoothing / cell, truncate=REACH, mode="constant")
