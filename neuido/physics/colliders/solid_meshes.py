"""Triangle meshes of solid colliders, for pictures and files; in the axes of the collider."""

from typing import Any, NamedTuple

import numpy as np

from neuido.physics.colliders.solids import Capsule, Cuboid, Cylinder, HeightField, MeshCollider, Sphere

AROUND, ALONG = 32, 16
"""Corners around an axis, and rings from pole to pole."""


class SolidMesh(NamedTuple):
    """The surface of a collider in its own axes."""

    vertices: np.ndarray
    """Position [m], (V, 3)."""
    faces: np.ndarray
    """Vertices of the triangles, counter-clockwise seen from outside, (T, 3)."""


def mesh_of(shape: Any) -> SolidMesh | None:
    """Return the surface of a collider; None of a half-space, which has no end, and of a grip.

    Args:
        shape: A collider; of a height field its upper side alone.
    """
    if isinstance(shape, MeshCollider):
        return SolidMesh(np.asarray(shape.vertices, np.float64), np.asarray(shape.faces))
    if isinstance(shape, HeightField):
        return _height_field(np.asarray(shape.heights, np.float64), shape.size)
    if isinstance(shape, Cuboid):
        corners = np.array([[(i >> axis) & 1 for axis in range(3)] for i in range(8)]) - 0.5
        sides = [(0, 4, 6, 2), (1, 3, 7, 5), (0, 1, 5, 4), (2, 6, 7, 3), (0, 2, 3, 1), (4, 5, 7, 6)]
        faces = np.array([face for a, b, c, d in sides for face in ((a, b, c), (a, c, d))])
        return SolidMesh(corners * np.asarray(shape.size), faces)
    angles = np.linspace(0.5 * np.pi, -0.5 * np.pi, ALONG + 1)
    if isinstance(shape, Sphere):
        return _turned(shape.radius * np.cos(angles), shape.radius * np.sin(angles))
    if isinstance(shape, Capsule):
        half = ALONG // 2
        shift = np.repeat([0.5 * shape.length, -0.5 * shape.length], [half + 1, half + 1])
        both = np.concatenate([angles[: half + 1], angles[half:]])
        return _turned(shape.radius * np.cos(both), shape.radius * np.sin(both) + shift)
    if isinstance(shape, Cylinder):
        return _turned(shape.radius * np.array([0.0, 1.0, 1.0, 0.0]), 0.5 * shape.length * np.array([1.0, 1.0, -1.0, -1.0]))
    return None


def _turned(radii: np.ndarray, heights: np.ndarray) -> SolidMesh:
    """Return the surface of a profile turned about the y axis, from its upper pole to its lower one."""
    turn = 2.0 * np.pi * np.arange(AROUND) / AROUND
    rings = [np.stack([r * np.cos(turn), np.full(AROUND, y), r * np.sin(turn)], axis=1) for r, y in zip(radii[1:-1], heights[1:-1])]
    vertices = np.concatenate([[[0.0, heights[0], 0.0]], *rings, [[0.0, heights[-1], 0.0]]])
    here, after = np.arange(AROUND), (np.arange(AROUND) + 1) % AROUND
    last = len(vertices) - 1
    faces = [np.stack([np.zeros_like(here), 1 + after, 1 + here], axis=1)]
    for k in range(len(rings) - 1):
        a, b, c, d = (1 + k * AROUND + here, 1 + k * AROUND + after, 1 + (k + 1) * AROUND + here, 1 + (k + 1) * AROUND + after)
        faces += [np.stack([a, b, c], axis=1), np.stack([b, d, c], axis=1)]
    first = 1 + (len(rings) - 1) * AROUND
    return SolidMesh(vertices, np.concatenate([*faces, np.stack([first + here, first + after, np.full_like(here, last)], axis=1)]))


def _height_field(heights: np.ndarray, size: tuple[float, float]) -> SolidMesh:
    """Return the surface of a lattice of heights, centred about the local origin."""
    nx, nz = heights.shape
    x, z = np.meshgrid(*(np.linspace(-0.5, 0.5, n) * length for n, length in zip((nx, nz), size)), indexing="ij")
    index = np.arange(nx * nz).reshape(nx, nz)
    a, b, c, d = (part.reshape(-1) for part in (index[:-1, :-1], index[1:, :-1], index[:-1, 1:], index[1:, 1:]))
    faces = np.concatenate([np.stack([a, c, b], axis=1), np.stack([b, c, d], axis=1)])
    return SolidMesh(np.stack([x, heights, z], axis=-1).reshape(-1, 3), faces)
