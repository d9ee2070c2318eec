"""Bodies that begin inside a collider: a second file stands where its own coordinates put it, which the scene did not know."""

import numpy as np

from neuido.data.neighbours.neighbour_scene import NeighbourScene, Obstacle, SoftBody

SAMPLES = 200
"""Points of a body that are looked at."""
TRIANGLES = 50_000
"""Largest mesh of a collider that is looked at."""


def note_overlaps(scene: NeighbourScene) -> None:
    """Add a line for each body of which points lie inside a collider."""
    for body in scene.bodies:
        points = _points(body)
        names = [obstacle.name for obstacle in scene.obstacles if _inside(obstacle, points).any()]
        if names:
            scene.note("", f"the body {body.name} begins inside {', '.join(names[:3])}{', ...' if len(names) > 3 else ''}: move its file")


def _points(body: SoftBody) -> np.ndarray:
    x = body.particles["x"] if body.particles is not None else body.mesh.vertices  # type: ignore[union-attr]
    return x[:: max(1, len(x) // SAMPLES)]


def _inside(obstacle: Obstacle, points: np.ndarray) -> np.ndarray:
    """Return which points (N, 3) lie inside a collider."""
    own = (points - obstacle.position) @ obstacle.rotation
    if obstacle.kind == "plane":
        return own[:, 1] < 0
    if obstacle.kind == "sphere":
        return np.linalg.norm(own, axis=1) < obstacle.radius
    if obstacle.kind == "cuboid":
        return (np.abs(own) < np.array(obstacle.size) / 2).all(axis=1)
    if obstacle.kind in ("cylinder", "capsule"):
        beyond = np.maximum(np.abs(own[:, 1]) - obstacle.length / 2, 0.0)
        across = np.hypot(own[:, 0], own[:, 2])
        return (np.hypot(across, beyond) < obstacle.radius) & ((obstacle.kind == "capsule") | (beyond == 0))
    mesh = obstacle.mesh
    if mesh is None or len(mesh.faces) > TRIANGLES:
        return np.zeros(len(own), bool)
    near = ((own > mesh.vertices.min(axis=0)) & (own < mesh.vertices.max(axis=0))).all(axis=1)
    out = np.zeros(len(own), bool)
    out[near] = [abs(_winding(mesh.vertices[mesh.faces] - point)) > 0.5 for point in own[near]]
    return out


def _winding(corners: np.ndarray) -> float:
    """Return the winding number of triangles (T, 3, 3) around the origin (van Oosterom and Strackee 1983)."""
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    la, lb, lc = (np.linalg.norm(each, axis=1) for each in (a, b, c))
    volume = np.einsum("ni,ni->n", a, np.cross(b, c))
    below = la * lb * lc + (a * b).sum(1) * lc + (b * c).sum(1) * la + (c * a).sum(1) * lb
    return float(np.arctan2(volume, below).sum() / (2 * np.pi))
