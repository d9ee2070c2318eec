"""Closed meshes of colliders from the meshes of robots and stages, which often have holes: their programs take the convex hull."""

import numpy as np

from neuido.data.bodies.mesh_filling import closed_mesh
from neuido.data.bodies.triangle_mesh import TriangleMesh, clean_mesh
from neuido.data.neighbours.neighbour_scene import NeighbourScene
from neuido.errors import UserError

HOLES = 0.1
"""Largest area of the closed holes, over that of the mesh: a sheet, which has no inside, needs as much again to be closed."""


def collision_mesh(mesh: TriangleMesh, name: str, place: str, scene: NeighbourScene, *, concave: bool = False) -> TriangleMesh | None:
    """Return a closed mesh of a collider; None, with a note, where there is none.

    A mesh with holes is closed where they are small. Another becomes its convex hull, which MuJoCo, PyBullet and PhysX take for every mesh.

    Args:
        mesh: The mesh of the file.
        name: Name of the collider.
        place: Where it stands, for notes.
        scene: Takes the notes.
        concave: Whether the file says that the mesh is not to be replaced by its hull.
    """
    try:
        return closed_mesh(mesh, name)
    except UserError:
        pass
    try:
        closed = closed_mesh(mesh, name, repair=True)
        if _area(closed) <= (1 + HOLES) * _area(mesh):
            scene.note(place, f"the mesh of {name} is not watertight: its holes are closed")
            return closed
    except UserError:
        pass
    hull = None if concave else convex_hull(mesh, name)
    if hull is None:
        why = "is open, and is not to be replaced by its convex hull" if concave else "is flat"
        scene.note(place, f"the mesh of {name} {why}: it has no inside and is left out; a plane, a box or a height field would do")
    else:
        scene.note(place, f"the mesh of {name} is not watertight: its convex hull is taken")
    return hull


def convex_hull(mesh: TriangleMesh, name: str) -> TriangleMesh | None:
    """Return the convex hull of a mesh, its outside out; None where it is flat."""
    from scipy.spatial import ConvexHull, QhullError

    try:
        hull = ConvexHull(mesh.vertices)
    except (QhullError, ValueError):
        return None
    faces = hull.simplices.copy()
    a, b, c = (mesh.vertices[faces[:, i]] for i in range(3))
    inwards = np.einsum("ni,ni->n", np.cross(b - a, c - a), hull.equations[:, :3]) < 0
    faces[inwards] = faces[inwards][:, ::-1]
    return closed_mesh(clean_mesh(mesh.vertices, faces, name), name)


def _area(mesh: TriangleMesh) -> float:
    a, b, c = (mesh.vertices[mesh.faces[:, i]] for i in range(3))
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())
