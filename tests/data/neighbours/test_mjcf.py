"""Scenes of MuJoCo and robots of URDF, made here in the exact layout, with their numbers."""

import math

import numpy as np
import pytest

from neuido.data.bodies.scanlines import enclosed_volume
from neuido.data.neighbours import poses
from neuido.data.neighbours.mjcf import read_mjcf
from neuido.data.neighbours.urdf import read_urdf
from neuido.errors import UserError

SCENE = """
<mujoco model="Press">
  <include file="floor.xml"/>
  <compiler angle="radian" meshdir="assets" autolimits="true"/>
  <option solver="CG" timestep=".001" gravity="0 0 -5" integrator="implicitfast"/>
  <default>
    <geom friction=".7 .005 .0001"/>
    <default class="small"><geom size=".1" friction=".2 0 0"/></default>
  </default>
  <asset><mesh name="part" file="part.obj" scale="2 2 2"/></asset>
  <worldbody>
    <light pos="0 0 3"/>
    <flexcomp name="A" type="grid" count="4 3 2" spacing=".2 .2 .2" pos="1 2 .5" radius=".005" dim="3" mass="6">
      <contact selfcollide="none"/>
      <elasticity young="1e4" poisson="0.4" damping="0.01"/>
      <pin id="0 1"/>
    </flexcomp>
    <flexcomp name="cloth" type="grid" count="4 3 1" spacing=".2 .2 .2"/>
    <geom name="ball" class="small" type="sphere" pos="0 0 1"/>
    <body pos="0 0 2" euler="0 1.5707963267948966 0">
      <geom name="rod" type="capsule" size=".1" fromto="0 0 0 1 0 0"/>
      <geom name="block" type="box" size=".1 .2 .3" pos="1 0 0"/>
      <geom type="sphere" size="1" contype="0" conaffinity="0"/>
    </body>
    <body name="free" pos="3 0 0"><freejoint/><geom type="cylinder" size=".1 .25" density="300"/></body>
    <body name="arm"><joint type="hinge" axis="0 1 0"/><geom type="mesh" mesh="part" pos="0 0 4"/></body>
  </worldbody>
  <actuator><motor name="m" joint="j"/><motor name="n" joint="j"/></actuator>
</mujoco>
"""
TETRAHEDRON = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n"


def world(text: str) -> str:
    return f"<mujoco><worldbody>{text}</worldbody></mujoco>"


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "scene.xml").write_text(SCENE)
    (tmp_path / "floor.xml").write_text(
        '<mujoco><worldbody><geom name="floor" type="plane" size="0 0 .01" pos="0 0 .1"/></worldbody></mujoco>'
    )
    (tmp_path / "assets").mkdir()
    (tmp_path / "assets" / "part.obj").write_text(TETRAHEDRON)
    return tmp_path


def test_a_scene_of_mujoco(folder):
    pytest.importorskip("trimesh")
    scene = read_mjcf(folder / "scene.xml")
    assert scene.gravity == pytest.approx((0.0, -5.0, 0.0)) and scene.dt == 0.001
    (body,) = scene.bodies  # the cloth is none
    assert enclosed_volume(body.mesh) == pytest.approx(0.6 * 0.4 * 0.2)
    assert body.density == pytest.approx(6 / 0.048) and body.elasticity == {"law": "neo_hookean", "young": 1e4, "poisson": 0.4}
    middle = (body.mesh.vertices.max(axis=0) + body.mesh.vertices.min(axis=0)) / 2
    assert middle == pytest.approx((1.0, 0.5, -2.0))  # z is up there, y here
    assert np.ptp(body.mesh.vertices, axis=0) == pytest.approx((0.6, 0.2, 0.4))
    found = {obstacle.name: obstacle for obstacle in scene.obstacles}
    assert set(found) >= {"floor", "ball", "rod", "block"} and len(scene.obstacles) == 6
    assert found["floor"].rotation[:, 1] == pytest.approx((0, 1, 0)) and found["floor"].position == pytest.approx((0, 0.1, 0))
    assert found["floor"].friction == 0.7 and found["ball"].friction == 0.2 and found["ball"].radius == 0.1
    rod = found["rod"]  # the body turns its x axis to -z, downwards
    assert rod.position == pytest.approx((0.0, 1.5, 0.0)) and rod.length == pytest.approx(1.0)
    assert abs(rod.rotation[1, 1]) == pytest.approx(1.0)
    low, high = rod.extent()
    assert (low, high) == (pytest.approx((-0.1, 0.9, -0.1)), pytest.approx((0.1, 2.1, 0.1)))
    low, high = found["block"].extent()
    assert (low, high) == (pytest.approx((-0.3, 0.9, -0.2)), pytest.approx((0.3, 1.1, 0.2)))
    free = next(obstacle for obstacle in scene.obstacles if obstacle.kind == "cylinder")
    assert free.mass == pytest.approx(300 * math.pi * 0.01 * 0.5)
    part = next(obstacle for obstacle in scene.obstacles if obstacle.kind == "mesh")
    assert enclosed_volume(part.mesh) == pytest.approx(8 / 6) and part.position == pytest.approx((0, 4, 0)) and part.mass is None
    notes = "\n".join(scene.notes)
    for words in (
        "cloth is a shell",
        "damping of A",
        "pins are left out",
        "actuator (2 elements)",
        "arm moves by joints",
        "1 geoms without",
    ):
        assert words in notes
    assert all(f"{folder}/scene.xml:" in note for note in scene.notes)


def test_tetrahedra_become_a_surface(tmp_path):
    points = "0 0 0 1 0 0 0 1 0 0 0 1 1 1 1"
    (tmp_path / "a.xml").write_text(f"""<mujoco><worldbody><body><flexcomp name="t" type="direct" dim="3" mass="2" point="{points}"
      element="0 1 2 3 1 2 3 4"><elasticity young="1e5" poisson="0.2"/></flexcomp></body></worldbody></mujoco>""")
    (body,) = read_mjcf(tmp_path / "a.xml").bodies
    assert len(body.mesh.faces) == 6
    assert body.density == pytest.approx(2 / (1 / 6 + 1 / 3))


@pytest.mark.parametrize(("kind", "volume"), [("cylinder", math.pi * 0.1**2 * 0.2), ("ellipsoid", 4 / 3 * math.pi * 0.1**3)])
def test_round_bodies_have_their_volume(tmp_path, kind, volume):
    (tmp_path / "a.xml").write_text(
        f"""<mujoco><worldbody><flexcomp type="{kind}" count="5 5 5" spacing=".05 .05 .05"/></worldbody></mujoco>"""
    )
    (body,) = read_mjcf(tmp_path / "a.xml").bodies
    assert enclosed_volume(body.mesh) == pytest.approx(volume, rel=1e-6)
    assert "young" not in body.elasticity


WRONG = {
    "no XML": ("<mujoco><a></mujoco>", "not valid XML"),
    "another root": ("<robot/>", "not mujoco"),
    "entities": ('<!DOCTYPE m [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;&a;">]><mujoco>&b;</mujoco>', "document type or an entity"),
    "a file elsewhere": ('<!DOCTYPE m SYSTEM "file:///etc/passwd"><mujoco/>', "document type or an entity"),
    "an include elsewhere": ('<mujoco><include file="../other.xml"/></mujoco>', "leaves"),
    "an include of itself": ('<mujoco><include file="a.xml"/></mujoco>', "includes itself"),
    "a mesh elsewhere": (
        '<mujoco><asset><mesh name="m" file="/etc/passwd"/></asset><worldbody><geom mesh="m"/></worldbody></mujoco>',
        "leaves",
    ),
    "no such mesh": (world('<geom type="mesh" mesh="m"/>'), "not among the assets"),
    "words for numbers": (world('<geom size="big"/>'), "finite number"),
    "infinity": (world('<geom size="inf"/>'), "finite number"),
    "a size short": (world('<geom type="box" size="1 1"/>'), "needs 3 positive sizes"),
    "a negative size": (world('<geom size="-1"/>'), "positive sizes"),
    "no class": (world('<geom class="c" size="1"/>'), "unknown"),
    "too deep": (world("<body>" * 300 + "</body>" * 300), "inside one another"),
    "no step": ('<mujoco><option timestep="0"/></mujoco>', "positive"),
    "an index outside": (world('<flexcomp type="direct" dim="3" point="0 0 0 1 0 0 0 1 0 0 0 1" element="0 1 2 9"/>'), "damaged"),
}


@pytest.mark.parametrize("name", WRONG)
def test_hostile_scenes_are_refused_in_a_line(tmp_path, name):
    text, words = WRONG[name]
    (tmp_path / "other.xml").write_text("<mujoco/>")
    folder = tmp_path / "in"
    folder.mkdir()
    (folder / "a.xml").write_text(text)
    with pytest.raises(UserError, match=words) as caught:
        read_mjcf(folder / "a.xml")
    assert "\n" not in str(caught.value) and "a.xml" in str(caught.value)


ROBOT = """
<robot name="gripper">
  <link name="base"><collision><origin xyz="0 0 .5"/><geometry><box size="1 2 3"/></geometry></collision><visual/></link>
  <link name="finger">
    <collision name="pad">
      <origin xyz="0 0 .1" rpy="0 1.5707963267948966 0"/><geometry><cylinder radius=".1" length=".4"/></geometry>
    </collision>
    <collision><geometry><sphere radius=".2"/></geometry></collision>
    <collision name="tip"><geometry><mesh filename="package://robot/meshes/tip.obj" scale=".1 .1 .1"/></geometry></collision>
  </link>
  <joint name="slide" type="prismatic">
    <parent link="base"/><child link="finger"/><origin xyz="1 0 0" rpy="0 0 1.5707963267948966"/><axis xyz="1 0 0"/>
  </joint>
  <transmission name="t"/>
</robot>
"""


def test_a_robot(tmp_path):
    pytest.importorskip("trimesh")
    (tmp_path / "meshes").mkdir()
    (tmp_path / "meshes" / "tip.obj").write_text(TETRAHEDRON)
    (tmp_path / "gripper.urdf").write_text(ROBOT)
    scene = read_urdf(tmp_path / "gripper.urdf")
    found = {obstacle.name: obstacle for obstacle in scene.obstacles}
    assert set(found) == {"base", "pad", "finger 1", "tip"}
    low, high = found["base"].extent()
    assert (low, high) == (pytest.approx((-0.5, -1.0, -1.0)), pytest.approx((0.5, 2.0, 1.0)))
    pad = found["pad"]  # along x of the finger, which is y of the base and -z here
    assert pad.position == pytest.approx((1.0, 0.1, 0.0)) and abs(pad.rotation[2, 1]) == pytest.approx(1.0)
    assert found["finger 1"].position == pytest.approx((1.0, 0.0, 0.0)) and found["finger 1"].radius == 0.2
    assert enclosed_volume(found["tip"].mesh) == pytest.approx(1e-3 / 6)
    notes = "\n".join(scene.notes)
    assert "slide" in notes and "transmission" in notes


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('link="finger"/><origin', 'link="thumb"/><origin', "thumb"),
        ("package://robot/meshes/tip.obj", "package://robot/../../tip.obj", "leaves"),
        ("package://robot/meshes/tip.obj", "none.obj", "missing"),
        ('radius=".2"', 'radius="-2"', "positive"),
        ('size="1 2 3"', 'size="1 2"', "3 finite numbers"),
        ('<transmission name="t"/>', '<joint name="k" type="fixed"><parent link="finger"/><child link="base"/></joint>', "circle"),
    ],
)
def test_wrong_robots_are_refused_in_a_line(tmp_path, old, new, words):
    pytest.importorskip("trimesh")
    (tmp_path / "meshes").mkdir()
    (tmp_path / "meshes" / "tip.obj").write_text(TETRAHEDRON)
    assert old in ROBOT
    (tmp_path / "gripper.urdf").write_text(ROBOT.replace(old, new))
    with pytest.raises(UserError, match=words) as caught:
        read_urdf(tmp_path / "gripper.urdf")
    assert "\n" not in str(caught.value) and "gripper.urdf" in str(caught.value)


def test_rotations_agree_with_scipy():
    from scipy.spatial.transform import Rotation

    generator = np.random.default_rng(0)
    for _ in range(20):
        angles, vector = generator.uniform(-3, 3, 3), generator.normal(size=3)
        assert poses.from_euler(angles, "xyz") == pytest.approx(Rotation.from_euler("XYZ", angles).as_matrix())  # its capitals turn with
        assert poses.from_rpy(angles) == pytest.approx(Rotation.from_euler("xyz", angles).as_matrix())
        rotation = poses.about_axis(vector.tolist(), float(angles[0]))
        assert rotation == pytest.approx(Rotation.from_rotvec(vector / np.linalg.norm(vector) * angles[0]).as_matrix())
        assert poses.from_quaternion(poses.to_quaternion(rotation)) == pytest.approx(rotation)
        turn = poses.turn_between(vector, angles)
        assert turn @ vector / np.linalg.norm(vector) == pytest.approx(angles / np.linalg.norm(angles))
    assert poses.turn_between((0, 0, 1), (0, 0, -1)) @ (0, 0, 1) == pytest.approx((0, 0, -1))
