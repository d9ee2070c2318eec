"""The meshes of solids enclose their volumes, with the normals outwards."""

import numpy as np
import pytest

from neuido.physics.colliders.solid_meshes import mesh_of
from neuido.physics.colliders.solids import Capsule, Cuboid, Cylinder, HalfSpace, HeightField, Sphere


def volume(vertices, faces):
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return float(np.einsum("ni,ni->n", a, np.cross(b, c)).sum() / 6)


@pytest.mark.parametrize(
    ("shape", "expected", "coarse"),
    [
        (Cuboid(size=(1.0, 2.0, 3.0)), 6.0, 1e-12),
        (Sphere(radius=0.5), np.pi / 6, 0.03),
        (Cylinder(radius=0.5, length=2.0), np.pi / 2, 0.01),
        (Capsule(radius=0.5, length=2.0), np.pi / 2 + np.pi / 6, 0.02),
    ],
)
def test_volume(shape, expected, coarse):
    assert volume(*mesh_of(shape)) == pytest.approx(expected, rel=coarse)


def test_a_height_field_faces_up():
    heights = np.array([[0.0, 0.1, 0.0], [0.2, 0.3, 0.1]])
    vertices, faces = mesh_of(HeightField(heights=heights, size=(2.0, 1.0)))
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    assert (np.cross(b - a, c - a)[:, 1] > 0).all()
    assert np.ptp(vertices[:, 0]) == 2.0 and np.ptp(vertices[:, 2]) == 1.0 and vertices[:, 1].max() == 0.3


def test_a_half_space_has_none():
    assert mesh_of(HalfSpace()) is None
