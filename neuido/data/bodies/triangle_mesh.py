"""A surface of triangles, and how it is cleaned."""

from typing import NamedTuple

import numpy as np

from neuido.errors import UserError
from neuido.physics.runtime.limits import check_limit


class TriangleMesh(NamedTuple):
    """A surface of triangles."""

    vertices: np.ndarray
    """Position [m], (V, 3) float64; no two are equal, and each belongs to a triangle."""
    faces: np.ndarray
    """Vertices of the triangles, anticlockwise as seen from outside, (T, 3) int64; the three of a triangle differ."""


def clean_mesh(vertices: np.ndarray, faces: np.ndarray, name: str) -> TriangleMesh:
    """Return a mesh with equal vertices merged, and without triangles that have an edge of no length or vertices of no triangle.

    Args:
        vertices: (V, 3).
        faces: (T, 3).
        name: What the mesh is called in error messages.

    Raises:
        UserError: A position is not finite, an index is out of range, or no triangle is left.
    """
    vertices, faces = np.asarray(vertices, np.float64).reshape(-1, 3), np.asarray(faces, np.int64).reshape(-1, 3)
    if not len(faces):
        raise UserError(f"{name} has no triangles: export a mesh with faces (points alone are no mesh)")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise UserError(f"{name} is damaged: a triangle names vertex {faces.max() if faces.min() >= 0 else faces.min()} of {len(vertices)}")
    if not np.isfinite(vertices[faces.ravel()]).all():
        raise UserError(f"{name} contains a vertex with a NaN or an infinity")
    order = np.lexsort(vertices.T)
    new = np.ones(len(vertices), bool)
    new[1:] = (vertices[order[1:]] != vertices[order[:-1]]).any(axis=1)
    merged = np.empty(len(vertices), np.int64)
    merged[order] = np.cumsum(new) - 1
    faces, vertices = merged[faces], vertices[order[new]]
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
    if not len(faces):
        raise UserError(f"{name} has no triangle with an area: its triangles are points or lines")
    used, faces = np.unique(faces, return_inverse=True)
    return TriangleMesh(np.ascontiguousarray(vertices[used]), faces.reshape(-1, 3))


def check_triangles(triangles: int, vertices: int, name: str) -> None:
    """Raise UserError where a mesh has more triangles or vertices than `NEUIDO_MAX_TRIANGLES`."""
    check_limit(max(triangles, vertices), "NEUIDO_MAX_TRIANGLES", f"{name} has {triangles} triangles and {vertices} vertices")
