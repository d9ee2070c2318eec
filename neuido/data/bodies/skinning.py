"""Bind the vertices of a mesh to particles by moving least squares."""

import numpy as np
import torch
from torch import Tensor

from neuido.errors import UserError
from neuido.types import Skin

NEIGHBOURS = 16
"""Particles that a vertex is bound to; a vertex on a face of a lattice has 13 within two spacings."""
FLAT = 1e-3
"""Spread of neighbours in a direction, over the largest one and squared, below which they lie in a plane or on a line. Their affine map
leaves this direction out, where it would magnify the noise of the positions more than thirtyfold."""
CHUNK = 1 << 16


def bind_skin(vertices: Tensor | np.ndarray, faces: Tensor | np.ndarray, x: Tensor | np.ndarray, *, neighbours: int = NEIGHBOURS) -> Skin:
    """Bind a surface mesh to particles, so that it follows each affine motion of them exactly.

    The weights are those of moving least squares: the affine map that fits the motion of the nearest particles, with weights that
    fall to zero at the farthest of them, moves the vertex. It needs positions alone, so that it serves plastic and granular matter too.

    Args:
        vertices: Vertices at rest [m], (V, 3).
        faces: Triangles, (T, 3).
        x: Particles at rest [m], (P, 3).
        neighbours: Particles that a vertex is bound to.

    Raises:
        UserError: A shape does not fit, or there are no particles.
    """
    from scipy.spatial import KDTree

    at, points = (np.asarray(torch.as_tensor(part).detach().cpu(), np.float64) for part in (vertices, x))
    if at.ndim != 2 or at.shape[1] != 3 or points.ndim != 2 or points.shape[1] != 3 or not len(points):
        raise UserError(f"a skin needs vertices (V, 3) and particles (P, 3), got {at.shape} and {points.shape}")
    if not 1 <= neighbours:
        raise UserError(f"neighbours must be at least 1, got {neighbours}")
    k = min(neighbours, len(points))
    distance, index = KDTree(points).query(at, k=k)
    distance, index = distance.reshape(-1, k), index.reshape(-1, k)
    weights = np.empty((len(at), k))
    for start in range(0, len(at), CHUNK):
        part = slice(start, start + CHUNK)
        weights[part] = _affine_weights(at[part], points[index[part]], distance[part])
    as_tensor = torch.as_tensor
    return Skin(as_tensor(at), as_tensor(np.asarray(torch.as_tensor(faces).cpu(), np.int64)), as_tensor(index), as_tensor(weights))


def _affine_weights(at: np.ndarray, near: np.ndarray, distance: np.ndarray) -> np.ndarray:
    """Return the weights (V, k) of neighbours (V, k, 3) at the distances (V, k) whose sums are 1 and, unless they are flat, the points."""
    reach = 1.05 * distance[:, -1:] + np.finfo(np.float64).tiny  # so that the farthest, which may be one of several, has a weight too
    own = (1 - (distance / reach) ** 2) ** 2
    own /= own.sum(axis=1, keepdims=True)
    centre = np.einsum("vk,vkc->vc", own, near)
    apart = near - centre[:, None]
    spread, axes = np.linalg.eigh(np.einsum("vk,vkc,vkd->vcd", own, apart, apart))
    inverse = np.where(spread > FLAT * spread[:, -1:], 1 / np.where(spread > 0, spread, 1), 0)
    slope = np.einsum("vca,va,vda,vd->vc", axes, inverse, axes, at - centre)
    return own * (1 + np.einsum("vkc,vc->vk", apart, slope))
