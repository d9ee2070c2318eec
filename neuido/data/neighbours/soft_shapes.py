"""Closed surfaces of the shapes that neighbours name, and of tetrahedra."""

from collections.abc import Sequence

import numpy as np

from neuido.data.bodies.triangle_mesh import TriangleMesh, check_triangles, clean_mesh
from neuido.errors import UserError

SECTORS = 48
"""Sides of the polygon that stands for a circle; its area is 0.3 % less. The mesh is widened to the volume of the round body."""


def box_mesh(half: Sequence[float]) -> TriangleMesh:
    """Return a box around the origin with these half edges [m]."""
    corners = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)]) * np.asarray(half)
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return TriangleMesh(corners, np.array([(q[0], q[i], q[i + 1]) for q in quads for i in (1, 2)]))


def ellipsoid_mesh(half: Sequence[float]) -> TriangleMesh:
    """Return an ellipsoid around the origin with these half axes [m], and its volume."""
    around, down = np.meshgrid(2 * np.pi * np.arange(SECTORS) / SECTORS, np.pi * np.arange(SECTORS // 2 + 1) / (SECTORS // 2))
    points = np.stack([np.sin(down) * np.cos(around), np.sin(down) * np.sin(around), np.cos(down)], axis=-1)
    return _scaled(_rolled(points), np.asarray(half, float), 4 / 3 * np.pi * float(np.prod(half)))


def cylinder_mesh(half: Sequence[float]) -> TriangleMesh:
    """Return an elliptic cylinder along z with these half sizes [m], and its volume."""
    angle = 2 * np.pi * np.arange(SECTORS) / SECTORS
    rim = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    rings = [np.pad(rim * r, ((0, 0), (0, 1)), constant_values=z) for r, z in ((0, 1), (1, 1), (1, -1), (0, -1))]
    return _scaled(_rolled(np.stack(rings)), np.asarray(half, float), 2 * np.pi * float(np.prod(half)))


def tetrahedra_surface(points: np.ndarray, elements: np.ndarray, name: str) -> TriangleMesh:
    """Return the surface of tetrahedra: the triangles that belong to one of them alone.

    Args:
        points: (N, 3) [m].
        elements: (E, 4).
        name: What they are called in error messages.

    Raises:
        UserError: An index is out of range, or there are too many.
    """
    check_triangles(4 * len(elements), len(points), name)
    if len(elements) and (elements.min() < 0 or elements.max() >= len(points)):
        raise UserError(f"{name} is damaged: an element names point {elements.max()} of {len(points)}")
    a, b, c, d = (points[elements[:, i]] for i in range(4))
    inverted = np.einsum("ec,ec->e", np.cross(b - a, c - a), d - a) < 0
    own = np.where(inverted[:, None], elements[:, [1, 0, 2, 3]], elements)
    faces = np.concatenate([own[:, list(corner)] for corner in ((0, 2, 1), (0, 1, 3), (1, 2, 3), (0, 3, 2))])
    _, first, count = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True)
    return clean_mesh(points, faces[first[count == 1]], name)


def _rolled(points: np.ndarray) -> TriangleMesh:
    """Return the surface of rings of points (R, SECTORS, 3) from top to bottom, whose first and last ring are points."""
    rings, sectors = points.shape[:2]
    i, j = np.meshgrid(np.arange(rings - 1), np.arange(sectors), indexing="ij")
    a, b = i * sectors + j, i * sectors + (j + 1) % sectors
    faces = np.concatenate([np.stack([a, a + sectors, b + sectors], -1), np.stack([a, b + sectors, b], -1)]).reshape(-1, 3)
    flat = points.reshape(-1, 3).copy()
    flat[:sectors], flat[-sectors:] = flat[0], flat[-1]
    return clean_mesh(flat, faces, "a round body")


def _scaled(mesh: TriangleMesh, half: np.ndarray, volume: float) -> TriangleMesh:
    vertices = mesh.vertices * half
    a, b, c = (vertices[mesh.faces[:, i]] for i in range(3))
    own = float(np.einsum("tc,tc->", a, np.cross(b, c)) / 6)
    return mesh._replace(vertices=vertices * (volume / own) ** (1 / 3))


def stretched(mesh: TriangleMesh, scale: np.ndarray) -> TriangleMesh:
    """Return a mesh scaled along each axis; a mirror image keeps its outside."""
    faces = mesh.faces[:, ::-1] if np.prod(scale) < 0 else mesh.faces
    return TriangleMesh(mesh.vertices * scale, np.ascontiguousarray(faces))
