"""Inside and outside of a closed mesh on a fine lattice, by winding numbers along lines of it."""

from typing import NamedTuple

import numpy as np

from neuido.data.bodies.triangle_mesh import TriangleMesh
from neuido.errors import UserError

SHIFTS = ((0.4503, 0.5381), (0.5549, 0.4457), (0.4721, 0.5697), (0.5233, 0.4611))
"""Places of the lines in their cells; numbers without a pattern, since a line through an edge or a vertex could miss both neighbours. The
next is taken where that happens."""
PAIRS = 1 << 22
"""Number of pairs of a triangle and a line that are looked at together."""


class Inside(NamedTuple):
    """A lattice of cells and which of their centres lie inside a mesh."""

    inside: np.ndarray
    """(X, Y, Z) bool."""
    lower: np.ndarray
    """Lower corner of the lattice [m], (3,)."""
    edges: np.ndarray
    """Edges of a cell [m], (3,)."""
    volume: float
    """Volume inside [m^3]; lines are followed exactly, and between lines the cross-section counts as constant."""
    overlaps: bool
    """Whether parts of the mesh overlap, so that its signed volume counts places twice."""


def enclosed_volume(mesh: TriangleMesh) -> float:
    """Return the signed volume of a closed mesh [m^3]; negative where its outside is inside."""
    a, b, c = (mesh.vertices[mesh.faces[:, i]] - mesh.vertices.mean(axis=0) for i in range(3))
    return float(np.einsum("tc,tc->", a, np.cross(b, c)) / 6)


def open_edges(faces: np.ndarray) -> int:
    """Count the edges that the triangles (T, 3) run along more often in one direction than in the other; a closed mesh has none."""
    ends = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).astype(np.int64)
    forward = ends[:, 0] < ends[:, 1]
    edge = np.sort(ends, axis=1) @ np.array([int(faces.max()) + 1, 1])
    _, which = np.unique(edge, return_inverse=True)
    balance = np.bincount(which, weights=np.where(forward, 1.0, -1.0))
    return int((balance != 0).sum())


def find_inside(mesh: TriangleMesh, lower: np.ndarray, shape: tuple[int, ...], edges: np.ndarray) -> Inside:
    """Find which cells of a lattice have their centre inside a closed mesh: where the winding number is not zero.

    Args:
        mesh: A mesh without open edges.
        lower: Lower corner of the lattice [m], (3,); the mesh lies within the lattice.
        shape: Cells along each axis.
        edges: Edges of a cell [m], (3,).

    Raises:
        UserError: No placement of the lines meets the mesh cleanly.
    """
    for shift in SHIFTS:
        line, x, turn = _crossings(mesh, lower, shape, edges, shift)
        if not len(line):
            return Inside(np.zeros(shape, bool), lower, edges, 0.0, False)
        if not np.bincount(line, weights=turn).any():
            break
    else:
        raise UserError("the mesh cannot be filled: its triangles meet at places that rounding cannot tell apart; simplify the mesh")
    order = np.lexsort((x, line))
    line, x, turn = line[order], x[order], turn[order]
    winding = np.cumsum(turn)  # zero after the last crossing of each line
    volume = float((np.diff(x) * (winding[:-1] != 0)).sum() * edges[1] * edges[2])
    first = np.clip(np.ceil((x - lower[0]) / edges[0] - 0.5), 0, shape[0]).astype(np.int64)
    steps = np.zeros((shape[1] * shape[2], shape[0] + 1), np.int16)
    np.add.at(steps, (line, first), turn.astype(np.int16))
    inside = np.cumsum(steps, axis=1, dtype=np.int16)[:, :-1] != 0
    overlaps = bool(winding.max() > 1 or winding.min() < -1 or (winding.max() > 0 and winding.min() < 0))
    return Inside(np.ascontiguousarray(inside.reshape(shape[1], shape[2], shape[0]).transpose(2, 0, 1)), lower, edges, volume, overlaps)


def _crossings(
    mesh: TriangleMesh, lower: np.ndarray, shape: tuple[int, ...], edges: np.ndarray, shift: tuple[float, float]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return where lines along x cross the triangles: the line (N,), x [m] (N,), and by how much the winding number changes there (N,).

    Line j * Z + k has y = lower + (j + shift) times the edge, and z alike. The side on which a line passes an edge is computed in the same
    way for both triangles of the edge, so that it crosses exactly one of them, whatever the rounding.
    """
    corners = mesh.vertices[mesh.faces]
    low = [np.ceil((corners[:, :, a].min(1) - lower[a]) / edges[a] - s).astype(np.int64) for a, s in zip((1, 2), shift)]
    high = [np.floor((corners[:, :, a].max(1) - lower[a]) / edges[a] - s).astype(np.int64) for a, s in zip((1, 2), shift)]
    low = [np.clip(l, 0, shape[a]) for a, l in zip((1, 2), low)]
    high = [np.clip(h, -1, shape[a] - 1) for a, h in zip((1, 2), high)]
    wide, deep = (np.maximum(h - l + 1, 0) for l, h in zip(low, high))
    met = np.flatnonzero(wide * deep)
    parts = []
    ends = np.cumsum((wide * deep)[met])
    start = 0
    while start < len(met):
        stop = max(start + 1, int(np.searchsorted(ends, (ends[start - 1] if start else 0) + PAIRS, side="right")))
        own = met[start:stop]
        count = (wide * deep)[own]
        which = np.repeat(own, count)
        rank = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
        j, k = low[0][which] + rank // deep[which], low[1][which] + rank % deep[which]
        parts.append(_crossed(mesh, which, j, k, lower, shape, edges, shift))
        start = stop
    if not parts:
        return np.empty(0, np.int64), np.empty(0), np.empty(0)
    return tuple(np.concatenate(column) for column in zip(*parts))  # type: ignore[return-value]


def _crossed(mesh, which, j, k, lower, shape, edges, shift):
    y, z = lower[1] + (j + shift[0]) * edges[1], lower[2] + (k + shift[1]) * edges[2]
    faces = mesh.faces[which]
    areas, left = [], []
    for a, b in ((1, 2), (2, 0), (0, 1)):  # opposite to vertex 0, 1, 2
        p, q = faces[:, a], faces[:, b]
        turned = p > q
        p, q = mesh.vertices[np.where(turned, q, p)], mesh.vertices[np.where(turned, p, q)]
        area = (q[:, 1] - p[:, 1]) * (z - p[:, 2]) - (q[:, 2] - p[:, 2]) * (y - p[:, 1])
        left.append((area > 0) ^ turned)
        areas.append(np.where(turned, -area, area))
    every, none = left[0] & left[1] & left[2], ~(left[0] | left[1] | left[2])
    hit = np.flatnonzero(every | none)
    weight = np.abs(np.stack(areas)[:, hit])
    total = weight.sum(axis=0)
    weight = np.where(total > 0, weight / np.where(total > 0, total, 1), 1 / 3)
    x = np.einsum("at,ta->t", weight, mesh.vertices[faces[hit], 0])
    return j[hit] * shape[2] + k[hit], x, np.where(every[hit], -1.0, 1.0)


def lattice_around(mesh: TriangleMesh, spacing: float) -> tuple[np.ndarray, tuple[int, ...], np.ndarray]:
    """Return the lattice of cells that fills the box around a mesh: its lower corner [m], (3,), cells along each axis, and edges [m], (3,).

    The edges are about `spacing`, rounded so that whole cells fill the box.
    """
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    cells = tuple(max(1, round(extent / spacing)) for extent in (high - low).tolist())
    return low, cells, (high - low) / cells
