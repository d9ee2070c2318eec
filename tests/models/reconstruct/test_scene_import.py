"""`neuido import` of scenes of other programs: the folder is read and simulated, and what is missing is one line."""

import json

import numpy as np
import pytest
import torch

from neuido.data.bodies.scene_files import load_scene
from neuido.data.neighbours import poses
from neuido.errors import UserError
from neuido.models.reconstruct.scene_import import import_scene
from neuido.models.render.gaussians import save_gaussians
from neuido.types import Gaussians
from tests.command import run

JELLY = """
<mujoco model="jelly"><option timestep="1e-4"/><worldbody>
  <geom name="floor" type="plane" size="1 1 .1" friction=".4"/>
  <flexcomp name="soft" type="grid" count="5 5 5" spacing=".05 .05 .05" pos="0 0 .15" dim="3" mass="2">
    <elasticity young="5e4" poisson="0.3"/>
  </flexcomp>
</worldbody></mujoco>
"""
TETRAHEDRON = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n"


@pytest.fixture
def ball(tmp_path):
    """A shell of opaque Gaussians of radius 1 around (5, 5, 5), faint ones around it, and opaque ones far away."""
    generator = torch.Generator().manual_seed(0)
    directions = torch.nn.functional.normalize(torch.randn(3000, 3, generator=generator), dim=1)
    faint, far = directions[:200] * 3 + 5, torch.full((20, 3), 50.0)
    means = torch.cat([directions + 5, faint, far])
    opacities = torch.cat([torch.full((3000,), 0.9), torch.full((200,), 0.01), torch.full((20,), 0.9)])
    covariances = (0.07**2 * torch.eye(3)).expand(len(means), 3, 3)
    save_gaussians(tmp_path / "ball.ply", Gaussians(means, covariances, opacities, torch.zeros(len(means), 1, 3)))
    return tmp_path / "ball.ply"


def test_a_scene_of_mujoco_is_imported_and_simulated(tmp_path, capsys):
    (tmp_path / "jelly.xml").write_text(JELLY)
    out = tmp_path / "jelly"
    status, printed, err = run(capsys, "import", tmp_path / "jelly.xml", "--out", out, "--particles", 300)
    assert status == 0 and "body soft: a mesh of 0.008 m^3, 250 kg/m^3" in printed and f"results in {out}" in printed, err
    setup = load_scene(out / "scene.yaml")
    assert float(setup.body.volume.sum()) == pytest.approx(0.008, rel=1e-5) and len(setup.body.skin.vertices) == 8
    assert setup.info["density"] == 250 and setup.scene.colliders[0].friction == 0.4
    assert setup.scene.dt == 1e-4 and setup.scene.lower[1] < 0  # the floor lies in the domain
    status, printed, err = run(capsys, "simulate", out / "scene.yaml", "--out", tmp_path / "run", "--steps", 20, "--device", "cpu")
    assert status == 0 and "simulated jelly" in printed, err


def test_gaussians_become_a_body(ball, tmp_path):
    lines = import_scene(ball, tmp_path / "out", particles=1000, young=1e5, scale=0.1, opacity_threshold=0.02)
    assert any("3000 Gaussians" in line for line in lines)  # neither the faint ones nor those far away
    body = load_scene(tmp_path / "out" / "scene.yaml").body
    radius = (body.x - 0.5).norm(dim=1)
    assert len(body.x) == pytest.approx(1000, rel=0.15)
    assert radius.max() < 0.125 and (radius < 0.055).float().mean() > 0.08  # filled, not a shell
    assert float(body.volume.sum()) == pytest.approx(4 / 3 * np.pi * 0.112**3, rel=0.15)  # opacity one half lies 1.7 sigma outside


def test_a_region_cuts_the_body_out_of_a_scene(ball, tmp_path):
    lines = import_scene(ball, tmp_path / "out", particles=500, young=1e5, region=[4.9, 7, 3, 7, 3, 7])
    body = load_scene(tmp_path / "out" / "scene.yaml").body
    assert body.x[:, 0].min() > 4.5 and body.x[:, 0].max() > 5.8
    assert any("taken as metres" in line and "1.1 x 2 x 2 m" in line for line in lines)
    for region, words in (
        ([0, 1, 0, 1, 0, 1], "holds none of its Gaussians, which span"),
        ([1, 0, 0, 1, 0, 1], "six numbers"),
        ([0, 1], "six numbers"),
    ):
        with pytest.raises(UserError, match=words):
            import_scene(ball, None, young=1e5, region=region)


def test_a_floor_that_reaches_far_leaves_the_body_its_cells(tmp_path):
    floor = '<link name="base"><collision><origin xyz="0 0 -5"/><geometry><box size="300 300 10"/></geometry></collision></link>'
    far = '<link name="far"><collision><origin xyz="900 0 0"/><geometry><sphere radius="1"/></geometry></collision></link>'
    (tmp_path / "plane.urdf").write_text(f'<robot name="plane">{floor}{far}</robot>')
    (tmp_path / "body.obj").write_text(TETRAHEDRON)
    notes = "\n".join(import_scene([tmp_path / "plane.urdf", tmp_path / "body.obj"], tmp_path / "out", young=1e4, particles=400))
    scene = load_scene(tmp_path / "out" / "scene.yaml").scene
    spacing = (1 / 6 / 400) ** (1 / 3)
    assert scene.upper[0] - scene.lower[0] < 50 and (scene.upper[0] - scene.lower[0]) / scene.cells < 2.1 * spacing
    assert "within the collider base" in notes and "(far) are farther than" in notes


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 9\n", "git lfs pull"),
        (b"ply\nformat binary_little_endian 1.0\nelement chunk 1\nproperty float min_x\nelement vertex 1\n"
         b"property uint packed_position\nend_header\n" + bytes(8), "compressed"),
    ],
)  # fmt: skip
def test_files_that_hold_no_gaussians_say_what_they_are(tmp_path, content, words):
    (tmp_path / "splats.ply").write_bytes(content)
    with pytest.raises(UserError, match=words):
        import_scene(tmp_path / "splats.ply", None, young=1e5)


def test_gaussians_are_placed_as_physgaussian_does(ball, tmp_path):
    settings = {"material": "jelly", "E": 2e4, "nu": 0.3, "density": 200, "n_grid": 32, "grid_lim": 2, "substep_dt": 1e-4, "frame_dt": 1e-2,
                "frame_num": 2, "g": [0, 0, -9.8], "opacity_threshold": 0.02, "sim_area": [0, 10, 0, 10, 0, 10],
                "boundary_conditions": [
                    {"type": "bounding_box"},
                    {"type": "cuboid", "point": [1, 1, 0.5], "size": [0.5, 0.5, 0.1], "velocity": [0, 0, 0]},
                    {"type": "cuboid", "point": [1.9, 1, 1], "size": [0.01, 0.1, 0.1], "velocity": [0, 0, 0]}]}  # fmt: skip
    (tmp_path / "config.json").write_text(json.dumps(settings))
    with pytest.raises(UserError, match="second file"):
        import_scene(tmp_path / "config.json", None)
    lines = import_scene([tmp_path / "config.json", ball], tmp_path / "out", particles=1500)
    setup = load_scene(tmp_path / "out" / "scene.yaml")
    x = setup.body.x
    assert ((x.amax(0) + x.amin(0)) / 2).tolist() == pytest.approx([1.0, 1.0, 1.0], abs=0.03)
    assert float((x.amax(0) - x.amin(0)).max()) == pytest.approx(1.0, abs=0.2)  # the largest side of the centres has unit length
    assert setup.scene.cells == 32 and setup.info["steps"] == 200 and setup.info["density"] == 200
    assert len(setup.scene.clamps) == 1 and "holds no particle" in "\n".join(lines)


def test_a_mesh_falls_on_a_robot(tmp_path):
    pytest.importorskip("trimesh")
    table = '<collision><origin xyz="0 0 -.5"/><geometry><box size="2 2 .2"/></geometry></collision>'
    (tmp_path / "table.urdf").write_text(f'<robot name="t"><link name="top">{table}</link></robot>')
    (tmp_path / "part.obj").write_text(TETRAHEDRON)
    with pytest.raises(UserError, match="no deformable body"):
        import_scene(tmp_path / "table.urdf", None, young=1e5)
    with pytest.raises(UserError, match="--young"):
        import_scene([tmp_path / "table.urdf", tmp_path / "part.obj"], None)
    lines = import_scene([tmp_path / "table.urdf", tmp_path / "part.obj"], tmp_path / "out", young=1e5, particles=200)
    assert "poisson of part is taken as 0.3" in "\n".join(lines)
    (table,) = load_scene(tmp_path / "out" / "scene.yaml").scene.colliders
    assert table.name == "top" and table.size == (2.0, 2.0, 0.2)
    assert table.position == pytest.approx((0.0, -0.5, 0.0))
    upright = poses.from_quaternion(table.rotation)
    assert abs(upright[1, 2]) == pytest.approx(1.0)  # its third edge stands upright


def test_two_bodies_stay_two(tmp_path):
    pytest.importorskip("trimesh")
    soft = '<flexcomp name="{}" type="grid" count="3 3 3" spacing=".1 .1 .1" pos="0 0 {}" dim="3" mass="{}">'
    soft += '<elasticity young="{}" poisson="0"/></flexcomp>'
    text = soft.format("low", 0.2, 4, 1e4) + soft.format("high", 0.6, 8, 5e4)
    (tmp_path / "two.xml").write_text(f"<mujoco><worldbody>{text}</worldbody></mujoco>")
    lines = import_scene(tmp_path / "two.xml", tmp_path / "out", particles=60)
    assert any(line.startswith("body low") for line in lines) and any(line.startswith("body high") for line in lines)
    low, high = load_scene(tmp_path / "out" / "scene.yaml").scene.bodies
    assert (low.name, high.name) == ("low", "high") and (low.density, high.density) == (pytest.approx(500), pytest.approx(1000))
    assert float(low.volume.sum()) == pytest.approx(0.008, rel=1e-5)
    assert high.x.mean(0).tolist() == pytest.approx([0.0, 0.6, 0.0], abs=0.01)


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["{jelly}", "--out", "{new}", "--columns.force", "F"], "--columns is not for scenes"),
        (["{jelly}", "--out", "{new}", "--particles", "2"], "--particles 2"),
        (["{jelly}", "{jelly}", "--out", "{new}"], "bodies of its own"),
        (["{jelly}", "{jelly}", "{jelly}", "--out", "{new}"], "one file, or two"),
        (["{none}", "--out", "{new}"], "missing"),
        (["{table}", "--out", "{new}", "--particles", "20"], "for scenes alone"),
        (["{jelly}", "--out", "{new}", "--young", "-1"], "--young"),
        (["{jelly}", "--out", "{here}"], "exists already"),
    ],
)
def test_what_cannot_be_imported_is_one_line(words, told, tmp_path, capsys):
    names = {"jelly": tmp_path / "jelly.xml", "none": tmp_path / "none.xml", "table": tmp_path / "table.csv", "new": tmp_path / "new",
             "here": tmp_path}  # fmt: skip
    names["jelly"].write_text(JELLY)
    names["table"].write_text("t,x\n0,0\n")
    status, printed, err = run(capsys, "import", *(word.format(**names) for word in words))
    assert status == 2 and told in err and err.count("\n") == 1, err
    assert not (tmp_path / "new").exists()
