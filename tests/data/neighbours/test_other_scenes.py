"""USD colliders, and the configurations of PhysGaussian and Spring-Gaus, made here in the exact layout, with their numbers."""

import json

import pytest

from neuido.data.bodies.scanlines import enclosed_volume
from neuido.data.neighbours.physgaussian import read_physgaussian
from neuido.data.neighbours.springgaus_config import read_springgaus
from neuido.data.neighbours.usd_scene import read_usd_scene
from neuido.errors import UserError

STAGE = """#usda 1.0
(
    metersPerUnit = 0.01
    upAxis = "Z"
)
def PhysicsScene "physics" { vector3f physics:gravityDirection = (0, 0, -1)
    float physics:gravityMagnitude = 500
}
def Xform "world" {
    double3 xformOp:translate = (0, 0, 100)
    uniform token[] xformOpOrder = ["xformOp:translate"]
    def Cube "table" (prepend apiSchemas = ["PhysicsCollisionAPI", "MaterialBindingAPI"]) {
        double size = 2
        double3 xformOp:scale = (10, 20, 30)
        uniform token[] xformOpOrder = ["xformOp:scale"]
        rel material:binding:physics = </rough>
    }
    def Sphere "ball" (prepend apiSchemas = ["PhysicsCollisionAPI", "PhysicsRigidBodyAPI", "PhysicsMassAPI"]) {
        double radius = 5
        float physics:mass = 2.5
    }
    def Cylinder "roll" (prepend apiSchemas = ["PhysicsCollisionAPI"]) { double radius = 4
        double height = 30
        uniform token axis = "X"
    }
    def Sphere "egg" (prepend apiSchemas = ["PhysicsCollisionAPI"]) { double3 xformOp:scale = (1, 1, 2)
        uniform token[] xformOpOrder = ["xformOp:scale"]
    }
    def Mesh "wedge" (prepend apiSchemas = ["PhysicsCollisionAPI"]) {
        point3f[] points = [(0, 0, 0), (100, 0, 0), (0, 100, 0), (0, 0, 100)]
        int[] faceVertexCounts = [3, 3, 3, 3]
        int[] faceVertexIndices = [0, 2, 1, 0, 1, 3, 1, 2, 3, 2, 0, 3]
    }
    def Cube "off" (prepend apiSchemas = ["PhysicsCollisionAPI"]) {
        bool physics:collisionEnabled = 0
    }
}
def Material "rough" (prepend apiSchemas = ["PhysicsMaterialAPI"]) {
    float physics:dynamicFriction = 0.6
}
def PhysicsFixedJoint "joint" {}
"""


def test_colliders_of_usd(tmp_path):
    pytest.importorskip("pxr")
    (tmp_path / "stage.usda").write_text(STAGE)
    scene = read_usd_scene(tmp_path / "stage.usda")
    assert scene.gravity == pytest.approx((0.0, -5.0, 0.0))
    found = {obstacle.name: obstacle for obstacle in scene.obstacles}
    assert set(found) == {"table", "ball", "roll", "wedge"}
    low, high = found["table"].extent()
    assert (low, high) == (pytest.approx((-0.1, 0.7, -0.2)), pytest.approx((0.1, 1.3, 0.2)))
    assert found["table"].friction == pytest.approx(0.6) and found["roll"].friction == 0.0
    assert found["ball"].radius == pytest.approx(0.05) and found["ball"].mass == 2.5 and found["roll"].mass is None
    low, high = found["roll"].extent()
    assert (low, high) == (pytest.approx((-0.15, 0.96, -0.04)), pytest.approx((0.15, 1.04, 0.04)))
    assert enclosed_volume(found["wedge"].mesh) == pytest.approx(1 / 6)
    assert "egg" in "\n".join(scene.notes) and "joint" in "\n".join(scene.notes)


def test_shapes_without_the_schema_are_colliders_with_a_line(tmp_path):
    pytest.importorskip("pxr")
    (tmp_path / "a.usda").write_text(
        '#usda 1.0\n(metersPerUnit = 1)\ndef Cube "box" {}\ndef Cube "no" {\ntoken visibility = "invisible"\n}\n'
    )
    scene = read_usd_scene(tmp_path / "a.usda")
    assert [obstacle.size for obstacle in scene.obstacles] == [pytest.approx((2, 2, 2))]
    assert scene.gravity == pytest.approx((0.0, -9.81, 0.0)) and "PhysicsCollisionAPI" in scene.notes[0]


SAND = {
    "opacity_threshold": 0.1, "rotation_degree": [90.0], "rotation_axis": [2], "sim_area": [-1.0, 2.0, -3.0, 4.0, -5.0, 6.0],
    "substep_dt": 2e-5, "frame_dt": 4e-2, "frame_num": 50, "E": 5e7, "nu": 0.3, "material": "sand", "density": 2000,
    "g": [0.0, 0.0, -9.8], "friction_angle": 30, "n_grid": 200, "grid_lim": 2, "rpic_damping": 0.1,
    "particle_filling": {"n_grid": 100},
    "boundary_conditions": [
        {"type": "bounding_box"},
        {"type": "surface_collider", "point": [1, 0.9, 0.48], "normal": [0.0, 0.0, 1.0], "surface": "sticky", "friction": 0.0,
         "start_time": 0, "end_time": 1e3},
        {"type": "cuboid", "point": [1, 0.8, 0.5], "size": [0.5, 0.1, 0.28], "velocity": [0, 0, 0], "reset": 1},
        {"type": "cuboid", "point": [1, 1, 0.5], "size": [0.5, 0.5, 0.28], "velocity": [0, 0, 1]},
        {"type": "particle_impulse", "force": [-0.18, 0.0, 0.0], "num_dt": 1, "start_time": 0},
    ],
    "mpm_space_vertical_upward_axis": [0, 0, 1], "move_camera": True,
}  # fmt: skip


def physgaussian(tmp_path, **changes):
    (tmp_path / "sand.json").write_text(json.dumps({key: value for key, value in (SAND | changes).items() if value is not None}))
    return read_physgaussian(tmp_path / "sand.json")


def test_a_scene_of_physgaussian(tmp_path):
    scene, placement = physgaussian(tmp_path)
    (body,) = scene.bodies
    assert body.elasticity == {"law": "sigma", "young": 5e7, "poisson": 0.3} and body.density == 2000
    assert body.plasticity == {"law": "drucker_prager", "friction_angle": 30}
    assert scene.gravity == pytest.approx((0.0, -9.8, 0.0))
    assert (scene.domain, scene.cells, scene.dt, scene.steps) == (((0, 0, 0), (2, 2, 2)), 200, 2e-5, 2000 * 50)
    assert scene.walls == {"contact": "separate", "friction": 0.0, "inset": 3.0}
    (plane,) = scene.obstacles
    assert (
        plane.contact == "sticky" and plane.position == pytest.approx((1, 0.48, 1.1)) and plane.rotation[:, 1] == pytest.approx((0, 1, 0))
    )
    ((low, high),) = scene.clamps
    assert (low, high) == (pytest.approx((0.5, 0.22, 1.1)), pytest.approx((1.5, 0.78, 1.3)))
    assert placement.opacity == 0.1 and placement.length == 1.0 and placement.centre == pytest.approx((1, 1, 1))
    # about z by a right angle, x becomes y, which is -z here
    assert placement.rotation @ (1, 0, 0) == pytest.approx((0, 0, -1)) and placement.rotation @ (0, 0, 1) == pytest.approx((0, 1, 0))
    assert placement.area[0] == pytest.approx((-1, -5, -4)) and placement.area[1] == pytest.approx((2, 6, 3))
    notes = "\n".join(scene.notes)
    for words in ("rpic_damping", "particle_filling", "boundary_conditions[3]: a cuboid that moves", "particle_impulse"):
        assert words in notes
    assert "camera" not in notes


def test_materials_of_physgaussian(tmp_path):
    assert physgaussian(tmp_path, material="jelly")[0].bodies[0].elasticity["law"] == "fixed_corotated"
    scene, _ = physgaussian(tmp_path, material="metal", yield_stress=1e4, sim_area=None, rotation_degree=None, rotation_axis=None)
    assert scene.bodies[0].plasticity == {"law": "von_mises", "yield_stress": 1e4}
    assert "viscoplasticity" in "\n".join(physgaussian(tmp_path, material="foam")[0].notes)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"material": "rubber"}, "rubber"),
        ({"material": "metal"}, "needs yield_stress"),
        ({"E": "stiff"}, "E must be"),
        ({"E": -1}, "E must"),
        ({"nu": -0.1}, "nu must"),
        ({"n_grid": 0}, "n_grid"),
        ({"frame_num": 1e99}, "frame_num"),
        ({"g": -9.8}, "g must be three numbers"),
        ({"sim_area": [1, 2]}, "six numbers"),
        ({"rotation_axis": [3]}, "axes 0, 1 or 2"),
        ({"boundary_conditions": {"a": 1}}, "must be a list"),
        ({"boundary_conditions": [3]}, "mapping"),
        ({"boundary_conditions": [{"type": "surface_collider", "point": [1, 1, 1], "normal": [0, 0, 0]}]}, "zero"),
    ],
)
def test_wrong_configurations_are_refused_in_a_line(tmp_path, changes, words):
    with pytest.raises(UserError, match=words) as caught:
        physgaussian(tmp_path, **changes)
    assert "\n" not in str(caught.value) and "sand.json" in str(caught.value)


TORUS = """
DEFAULT: config/mpm_synthetic/default.yaml
DATA:
  TYPE: MPM_Synthetic
  OBJ_NAME: torus
  FRAME_ALL: 30
  XYZ_MIN: [0.3, 0.4, 0.3]
  XYZ_MAX: [0.7, 0.8, 0.7]
  BC: [[[0, 0.3, 0], [0, 1, 0]]]
  DT: 0.03
  GLOBAL_M: 1
  GLOBAL_K: 1000
"""
BASE = "VELOCITY: {G: [0, -9.8, 0], INIT_VELOCITY: [0, 0, 0]}\nDYNAMIC: {N_STEP: 100, G: [0, -9.7, 0]}\n"


def springgaus(tmp_path, text=TORUS):
    folder = tmp_path / "config" / "mpm_synthetic"
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "default.yaml").write_text(BASE)
    (folder / "torus.yaml").write_text(text)
    return read_springgaus(folder / "torus.yaml")


def test_a_configuration_of_spring_gaus(tmp_path):
    scene, placement = springgaus(tmp_path)
    assert (
        scene.name == "torus" and scene.gravity == pytest.approx((0, -9.7, 0)) and scene.dt == pytest.approx(3e-4) and scene.steps == 3000
    )
    (plane,) = scene.obstacles
    assert plane.position == pytest.approx((0, 0.3, 0)) and plane.rotation[:, 1] == pytest.approx((0, 1, 0))
    assert placement.area[0] == pytest.approx((0.3, 0.4, 0.3)) and placement.area[1] == pytest.approx((0.7, 0.8, 0.7))
    assert "young" not in scene.bodies[0].elasticity and "GLOBAL_K" in "\n".join(scene.notes)
    turned = TORUS.replace("[[0, 0.3, 0], [0, 1, 0]]", "[[0, 0, -0.01], [0, 0, -1]]").replace("DT: 0.03", "FREQ: 120")
    scene, placement = springgaus(tmp_path, turned.replace("DEFAULT: config/mpm_synthetic/default.yaml", "DYNAMIC: {G: [0, 0, 9.8]}"))
    assert scene.gravity == pytest.approx((0, -9.8, 0)) and scene.dt == pytest.approx(1 / 12000)
    assert scene.obstacles[0].position == pytest.approx((0, 0.01, 0))
    assert placement.area[0][1] == pytest.approx(-0.7) and placement.area[1][1] == pytest.approx(-0.3)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("config/mpm_synthetic/default.yaml", "../../../../etc/passwd", "leaves"),
        ("config/mpm_synthetic/default.yaml", "none.yaml", "none of the 3 folders"),
        ("[[[0, 0.3, 0], [0, 1, 0]]]", "3", "list of"),
        ("[0, 1, 0]]", "[0, 0, 0]]", "zero"),
        ("DT: 0.03", "DT: 0", "DT must"),
        ("XYZ_MIN: [0.3, 0.4, 0.3]", "XYZ_MIN: [0.9, 0.4, 0.3]", "below"),
        ("BC:", "BX:", "DATA.BC"),
        ("FRAME_ALL: 30", "FRAME_ALL: !!python/object/apply:os.system [ls]", "not valid YAML"),
    ],
)
def test_wrong_settings_are_refused_in_a_line(tmp_path, old, new, words):
    assert old in TORUS
    with pytest.raises(UserError, match=words) as caught:
        springgaus(tmp_path, TORUS.replace(old, new))
    assert "\n" not in str(caught.value) and "torus.yaml" in str(caught.value)
