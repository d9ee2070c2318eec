"""Robots and stages as others publish them: meshes with holes, sheets, Bullet's planes and deformables, approximations of USD."""

import numpy as np
import pytest

from neuido.data.bodies.scanlines import enclosed_volume
from neuido.data.bodies.triangle_mesh import TriangleMesh
from neuido.data.neighbours.neighbour_scene import NeighbourScene, Obstacle, SoftBody
from neuido.data.neighbours.overlaps import note_overlaps
from neuido.data.neighbours.poses import from_rpy
from neuido.data.neighbours.urdf import read_urdf
from neuido.data.neighbours.usd_scene import read_usd_scene
from neuido.errors import UserError

CORNERS = [(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)]
QUADS = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]


def obj(vertices, quads):
    lines = [f"v {x} {y} {z}" for x, y, z in vertices]
    return "\n".join([*lines, *(f"f {a + 1} {b + 1} {c + 1} {d + 1}" for a, b, c, d in quads)])


def grid(n, height):
    """A sheet of n x n quads over the unit square."""
    points = [(i / n, j / n, height(i / n, j / n)) for i in range(n + 1) for j in range(n + 1)]
    return points, [
        (i * (n + 1) + j, (i + 1) * (n + 1) + j, (i + 1) * (n + 1) + j + 1, i * (n + 1) + j + 1) for i in range(n) for j in range(n)
    ]


def robot(tmp_path, collision, link="", more=""):
    (tmp_path / "robot.urdf").write_text(
        f'\n<?xml version="1.0"?>\n<robot name="r"><link name="base">{link}<collision{collision}</collision></link>{more}</robot>'
    )
    return read_urdf(tmp_path / "robot.urdf")


MESH = '><geometry><mesh filename="part.obj"/></geometry>'


def test_a_small_hole_is_closed_and_told(tmp_path):
    pytest.importorskip("trimesh")
    sides = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4)]
    tall = [(x, y, 8 * z) for x, y, z in CORNERS]  # an open box, eight times as tall as wide: the missing top is 3 % of it
    (tmp_path / "part.obj").write_text(obj(tall, sides))
    scene = robot(tmp_path, MESH)
    assert enclosed_volume(scene.obstacles[0].mesh) == pytest.approx(8.0)
    assert "its holes are closed" in "\n".join(scene.notes)


@pytest.mark.parametrize(
    ("height", "attribute", "left", "words"),
    [
        (lambda x, y: x * (1 - x), "", True, "convex hull is taken"),
        (lambda x, y: x * (1 - x), ' concave="yes"', False, "not to be replaced"),
        (lambda x, y: 0.0, "", False, "flat"),
    ],
)
def test_a_sheet_becomes_its_hull_or_is_left_out(tmp_path, height, attribute, left, words):
    pytest.importorskip("trimesh")
    (tmp_path / "part.obj").write_text(obj(*grid(8, height)))
    scene = robot(tmp_path, attribute + MESH)
    assert len(scene.obstacles) == left and words in "\n".join(scene.notes)
    if left:  # the area under the parabola's polygon
        heights = [height(i / 8, 0) for i in range(9)]
        assert enclosed_volume(scene.obstacles[0].mesh) == pytest.approx(np.trapezoid(heights, dx=1 / 8))


def test_planes_friction_and_deformables_of_bullet(tmp_path):
    contact = '<contact><lateral_friction value="1.3"/></contact><inertial><mass value="2"/></inertial>'
    soft = """<deformable name="torus"><inertial><mass value="3"/></inertial><friction value="0.5"/>
        <neohookean mu="180" lambda="600" damping="0.01"/><visual filename="torus.vtk"/></deformable>"""
    scene = robot(tmp_path, '><geometry><plane normal="0 0 1"/></geometry>', contact, soft)
    (plane,) = scene.obstacles
    assert plane.kind == "plane" and plane.rotation[:, 1] == pytest.approx((0, 1, 0)) and plane.friction == 1.3
    (body,) = scene.bodies
    assert body.mass == 3 and body.elasticity["young"] == pytest.approx(180 * (1800 + 360) / 780)
    assert body.elasticity["poisson"] == pytest.approx(600 / 1560)
    notes = "\n".join(scene.notes)
    for words in ("damping of torus", "friction of the deformable", "torus.vtk", "masses of the links"):
        assert words in notes
    assert "state no friction" not in notes


def test_friction_that_nobody_states_is_told_and_gazebos_is_read(tmp_path):
    box = '><geometry><box size="1 1 1"/></geometry>'
    scene = robot(tmp_path, box)
    assert scene.obstacles[0].friction == 1.0 and "state no friction" in "\n".join(scene.notes)
    scene = robot(tmp_path, box, more='<gazebo reference="base"><mu1 value="0.2"/></gazebo>')
    assert scene.obstacles[0].friction == 0.2 and "state no friction" not in "\n".join(scene.notes)


def test_what_bullet_has_alone_is_left_out_with_a_line_and_macros_are_named(tmp_path):
    scene = robot(tmp_path, '><geometry><cdf filename="toy.cdf"/></geometry>')
    assert not scene.obstacles and "cdf of base" in "\n".join(scene.notes)
    with pytest.raises(UserError, match="expand it with xacro"):
        robot(tmp_path, '><origin xyz="$(optenv X 0 0 0)"/><geometry><box size="1 1 1"/></geometry>')


STAGE = """#usda 1.0
(metersPerUnit = 1
upAxis = "Y")
def Xform "part" {
def Mesh "wedge" (prepend apiSchemas = ["PhysicsCollisionAPI", "PhysicsMeshCollisionAPI"]) {
    uniform token physics:approximation = "KIND"
    point3f[] points = [(0, 0, 0), (3, 0, 0), (0, 2, 0), (0, 0, 1), (0.3, 0.2, 0.1)]
    int[] faceVertexCounts = [3, 3, 3, 3, 3, 3]
    int[] faceVertexIndices = [0, 2, 1, 0, 1, 3, 0, 3, 2, 1, 2, 4, 2, 3, 4, 3, 1, 4]
}
}
def "copy" (references = </part>) { double3 xformOp:translate = (5, 0, 0)
    uniform token[] xformOpOrder = ["xformOp:translate"]
}
def PhysicsRevoluteJoint "a" {}
def PhysicsRevoluteJoint "b" {}
"""


@pytest.mark.parametrize(
    ("kind", "size"),
    [("none", 0.3), ("convexHull", 1.0), ("convexDecomposition", 0.3), ("boundingCube", 6.0), ("boundingSphere", 14**0.5 / 2)],
)
def test_colliders_of_usd_take_the_shape_that_the_file_asks_for(tmp_path, kind, size):
    """A tetrahedron of volume 1, and 0.3 with its dent; its copy refers to the file itself."""
    pytest.importorskip("pxr")
    (tmp_path / "stage.usda").write_text(STAGE.replace("KIND", kind))
    scene = read_usd_scene(tmp_path / "stage.usda")
    own, copy = scene.obstacles
    found = own.radius if own.kind == "sphere" else np.prod(own.size) if own.kind == "cuboid" else enclosed_volume(own.mesh)
    assert found == pytest.approx(size)
    assert copy.extent()[0] - own.extent()[0] == pytest.approx((5, 0, 0))
    assert [note for note in scene.notes if "joints" in note] == ["stage.usda: joints have no counterpart and are left out (2: /a, /b)"]


def test_a_tetrahedral_mesh_of_usd_is_a_body(tmp_path):
    pytest.importorskip("pxr")
    (tmp_path / "stage.usda").write_text("""#usda 1.0
(metersPerUnit = 0.01
upAxis = "Z")
def TetMesh "jelly" (prepend apiSchemas = ["MaterialBindingAPI"]) {
    point3f[] points = [(0, 0, 0), (10, 0, 0), (0, 10, 0), (0, 0, 30)]
    int4[] tetVertexIndices = [(0, 1, 2, 3)]
    rel material:binding:physics = </gel>
}
def Material "gel" (prepend apiSchemas = ["PhysicsVolumeDeformableMaterialAPI"]) {
    float physics:density = 40
    float omniphysics:youngsModulus = 300000
}
""")
    scene = read_usd_scene(tmp_path / "stage.usda")
    (body,) = scene.bodies
    assert not scene.obstacles and body.density == 40 and body.elasticity == {"law": "neo_hookean", "young": 300000}
    assert enclosed_volume(body.mesh) == pytest.approx(5e-4) and np.ptp(body.mesh.vertices, axis=0) == pytest.approx((0.1, 0.3, 0.1))


@pytest.mark.parametrize(
    ("kind", "inside", "outside"),
    [
        ("plane", (0, -0.1, 0), (0, 0.1, 0)),
        ("sphere", (0, 0.4, 0), (0.4, 0.4, 0)),
        ("cuboid", (0.4, 0.9, 0.1), (0.4, 0.9, 0.3)),
        ("cylinder", (0.3, 0.9, 0.3), (0.3, 1.1, 0.3)),
        ("capsule", (0.1, 1.4, 0.1), (0.4, 1.4, 0.4)),
        ("mesh", (0.2, 0.2, 0.2), (0.9, 0.9, 0.9)),
    ],
)
def test_a_body_that_begins_inside_a_collider_is_told(kind, inside, outside):
    turned, at = from_rpy((0.3, -0.4, 1.2)), np.array([1.0, 2.0, 3.0])
    tetrahedron = TriangleMesh(2.0 * np.eye(4, 3, k=-1), np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]]))
    scene = NeighbourScene("s", "s", obstacles=[Obstacle(kind, "wall", at, turned, 0.5, 2.0, (1.0, 2.0, 0.4), tetrahedron)])
    for point, told in ((inside, 1), (outside, 0)):
        scene.bodies, scene.notes = [SoftBody("ball", particles={"x": (turned @ np.array(point) + at)[None]})], []
        note_overlaps(scene)
        assert len(scene.notes) == told and all("ball begins inside wall" in note for note in scene.notes)
