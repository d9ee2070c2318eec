"""Marching cubes (Lorensen and Cline 1987) on the cells that the surface crosses, with Warp's table of cases.

Around a body the surface crosses a few percent of the cells, and all work but the comparison with the level is on these.
"""

from typing import NamedTuple

import numpy as np


class Isosurface(NamedTuple):
    """The surface on which a field on grid nodes has one value."""

    vertices: np.ndarray
    """In cells from the first node, (V, 3)."""
    faces: np.ndarray
    """Triangles, (T, 3)."""
    slopes: np.ndarray
    """Gradient of the field at the vertices, per cell, (V, 3)."""


def find_isosurface(field: np.ndarray, level: float) -> Isosurface:
    """Find where a field has the value `level`; it must be below it at the outermost nodes.

    Args:
        field: Values at the nodes, (nx, ny, nz).
        level: The value.
    """
    from warp.geometry import IsoSurfaceMarchingCubes as Tables

    strides = np.array([field.shape[1] * field.shape[2], field.shape[2], 1])
    offsets = np.array(Tables.CUBE_CORNER_OFFSETS)
    ends = offsets[np.array(Tables.EDGE_TO_CORNERS)]  # (12, 2, 3): the nodes of each edge of a cell, the lower first
    first_edge = 3 * (ends[:, 0] @ strides) + (ends[:, 1] - ends[:, 0]).argmax(axis=1)
    cells, cases = _crossed_cells(field >= level, offsets)
    entries = np.array(Tables.CASE_TO_TRI_RANGE)
    begin, count = entries[cases], entries[cases + 1] - entries[cases]
    turn = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
    local = np.array(Tables.TRI_LOCAL_INDICES)[np.repeat(begin, count) + turn]
    edges = 3 * np.repeat(cells, count) + first_edge[local]  # three edges begin at each node
    used = np.zeros(3 * field.size, bool)
    used[edges] = True
    own = np.flatnonzero(used)
    number = np.empty(len(used), np.int32)
    number[own] = np.arange(len(own))
    vertices, slopes = _on_edges(field, level, own, strides)
    return Isosurface(vertices, number[edges].reshape(-1, 3), slopes)


def _crossed_cells(inside: np.ndarray, offsets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the first nodes (M,) of the cells with nodes on both sides, and their cases (M,)."""
    cases = np.zeros([n - 1 for n in inside.shape], np.uint8)
    for bit, (i, j, k) in enumerate(offsets):
        cases |= inside[i : i + cases.shape[0], j : j + cases.shape[1], k : k + cases.shape[2]].view(np.uint8) << bit
    found = np.nonzero((cases != 0) & (cases != 255))
    return np.ravel_multi_index(found, inside.shape), cases[found].astype(np.int64)


def _on_edges(field: np.ndarray, level: float, edges: np.ndarray, strides: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the points (V, 3) where the field has the level on edges 3 node + axis, and its gradients there (V, 3)."""
    values = field.reshape(-1)
    node, axis = edges // 3, edges % 3
    other = node + strides[axis]
    share = (level - values[node]) / (values[other] - values[node]).astype(np.float64)
    vertices = np.stack(np.unravel_index(node, field.shape), axis=1).astype(np.float64)
    vertices[np.arange(len(edges)), axis] += share
    near, far = (np.stack([values[n + step] - values[n - step] for step in strides], axis=1) / 2 for n in (node, other))
    return vertices, near + share[:, None] * (far - near)
