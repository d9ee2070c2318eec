"""`neuido simulate SCENE --out FOLDER`: a scene file is run, and what cannot be run is one line."""

import numpy as np
import pytest
import torch

from neuido.data.bodies.scene_files import load_scene
from neuido.physics.laws.classical import material
from neuido.physics.mpm.simulator import Simulator
from tests.command import run

SCENE = """
format: neuido-scene/1
name: little-ball
scene:
  domain: [[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]]
  gravity: [0.0, -9.8, 0.0]
model:
  density: 1000.0
  elasticity: {law: fixed_corotated, young: 3.0e+4, poisson: 0.2}
body: {shape: ball, centre: [0.5, 0.5, 0.5], radius: 0.12, spacing: 0.04, velocity: [0.0, -2.0, 0.0]}
discretisation: {grid: 16, dt: 1.0e-3}
steps: 30
"""


@pytest.fixture
def scene(tmp_path):
    path = tmp_path / "ball.yaml"
    path.write_text(SCENE)
    return path


def test_a_scene_file_is_run(scene, tmp_path, capsys):
    out = tmp_path / "out"
    status, printed, err = run(capsys, "simulate", scene, "--out", out, "--steps", 20, "--every", 5, "--device", "cpu")
    assert status == 0, err
    assert "simulated little-ball" in printed and "20 substeps" in printed and "fixed_corotated (young 30000.0, poisson 0.2)" in printed
    assert f"results in {out}: frames.npz" in printed
    setup = load_scene(scene)
    frames = Simulator(setup.scene, setup.body, density=1000.0, device="cpu").rollout(
        20, *material(setup.info["elasticity"], setup.info["plasticity"]), every=5
    )
    with np.load(out / "frames.npz") as saved:
        assert torch.equal(torch.from_numpy(saved["x"]), frames.x)
        assert np.allclose(saved["times"], [0.0, 0.005, 0.01, 0.015, 0.02])
    assert len(list((out / "ply").glob("frame_*.ply"))) == 5


def test_a_scene_runs_by_its_name_and_for_its_own_steps(scene, tmp_path, capsys):
    status, printed, err = run(capsys, "simulate", "nclaw-cube", "--out", tmp_path / "cube", "--steps", 4, "--device", "cpu")
    assert status == 0, err
    assert "simulated nclaw-cube: 1000 particles, 4 substeps" in printed
    status, printed, _ = run(capsys, "simulate", scene, "--out", tmp_path / "own", "--device", "cpu")
    assert status == 0 and "30 substeps" in printed and "31 frames" in printed


def test_help_of_a_scene(capsys, scene):
    status, printed, _ = run(capsys, "simulate", scene, "--help")
    assert status == 0 and "--law" in printed and "--instances" not in printed


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["{scene}", "--out", "{scene}"], ["is a file"]),
        (["{scene}", "--out", "{used}"], ["is in use", "mine.txt"]),
        (["{scene}", "--out", "{new}", "--steps", "10", "--every", "3"], ["every is 3"]),
        (["{scene}", "--out", "{new}", "--steps", "0"], ["steps is 0"]),
        (["{scene}", "--out", "{new}", "--law", "absent.safetensors"], ["absent.safetensors", "neuido predict"]),
        (["bouncy-bal", "--out", "{new}"], ["bouncy-bal", "bouncy-ball"]),
        (["six_small", "--out", "{new}"], ["several scenes", "neuido scenes --config six_small"]),
        (["absent.yaml", "--out", "{new}"], ["the scene file absent.yaml is missing"]),
        (["{scene}", "--out", "{new}", "--stepz", "3"], ["--stepz", "did you mean 'steps'?"]),
    ],
)
def test_what_cannot_be_run_is_one_line(words, told, scene, tmp_path, capsys):
    used = tmp_path / "used"
    used.mkdir()
    (used / "mine.txt").write_text("kept")
    names = {"scene": scene, "used": used, "new": tmp_path / "new"}
    status, printed, err = run(capsys, "simulate", *(word.format(**names) for word in words))
    assert status == 2 and printed == "" and err.count("\n") == 1
    for part in told:
        assert part in err
    assert not (tmp_path / "new").exists()
    assert scene.read_text() == SCENE and (used / "mine.txt").read_text() == "kept"


def test_a_body_that_collapses_is_told_of_or_refused(scene, tmp_path, capsys):
    """A fixed-corotated body that hits faster than its own wave is crushed to nothing: half its wave modulus is all the work it takes."""
    scene.write_text(SCENE.replace("-2.0", "-6.0").replace("3.0e+4", "3.0e+3").replace("steps: 30", "steps: 300"))
    status, printed, err = run(capsys, "simulate", scene, "--out", tmp_path / "told", "--device", "cpu")
    assert status == 0, err
    assert "note: scene 0:" in printed and "det F" in printed
    status, _, err = run(capsys, "simulate", scene, "--out", tmp_path / "refused", "--device", "cpu", "--on_inversion", "error")
    assert status == 2 and "det F" in err and "on_inversion" in err and not (tmp_path / "refused").exists()
    scene.write_text(scene.read_text() + "on_inversion: error\n")
    status, _, err = run(capsys, "simulate", scene, "--out", tmp_path / "refused", "--device", "cpu")
    assert status == 2 and "det F" in err and not (tmp_path / "refused").exists()
    scene.write_text(scene.read_text().replace("on_inversion: error", "on_inversion: maybe"))
    status, _, err = run(capsys, "simulate", scene, "--out", tmp_path / "refused", "--device", "cpu")
    assert status == 2 and "on_inversion must be report or error" in err


def test_a_body_that_leaves_is_refused_clamped_or_deleted(scene, tmp_path, capsys):
    scene.write_text(SCENE.replace("-2.0", "-6.0").replace("steps: 30", "steps: 120").replace("scene:\n", "scene:\n  walls: null\n", 1))
    status, _, err = run(capsys, "simulate", scene, "--out", tmp_path / "refused", "--device", "cpu")
    assert status == 2 and "left the domain" in err and "on_leave" in err and not (tmp_path / "refused").exists()
    status, printed, err = run(capsys, "simulate", scene, "--out", tmp_path / "gone", "--device", "cpu", "--on_leave", "delete")
    assert status == 0 and "note: scene 0:" in printed and "left the domain and were deleted" in printed, err
    scene.write_text(scene.read_text() + "on_leave: clamp\n")
    status, printed, err = run(capsys, "simulate", scene, "--out", tmp_path / "clamped", "--device", "cpu")
    assert status == 0 and "were clamped" in printed, err


BODIES = """
format: neuido-scene/1
name: two-blocks
scene:
  domain: [[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]]
  gravity: [0.0, -9.8, 0.0]
bodies:
  - name: clay
    model:
      density: 1500.0
      elasticity: {law: sigma, young: 3.0e+4, poisson: 0.2}
      plasticity: {law: von_mises, yield_stress: 500.0}
    body: {shape: box, lower: [0.3, 0.1, 0.3], upper: [0.6, 0.3, 0.6], spacing: 0.05}
  - name: rubber
    model:
      density: 1000.0
      elasticity: {law: neo_hookean, young: 2.0e+4, poisson: 0.3}
    body: {shape: box, lower: [0.4, 0.3, 0.4], upper: [0.5, 0.4, 0.5], spacing: 0.05, velocity: [0.0, -1.0, 0.0]}
contact: {kind: separate, friction: [[clay, rubber, 0.4]]}
discretisation: {grid: 16, dt: 1.0e-3}
steps: 20
"""


def test_a_scene_of_several_bodies_is_run(tmp_path, capsys):
    path, out = tmp_path / "blocks.yaml", tmp_path / "out"
    path.write_text(BODIES)
    status, printed, err = run(capsys, "simulate", path, "--out", out, "--every", 10, "--device", "cpu")
    assert status == 0, err
    assert "law of clay: sigma (young 30000.0, poisson 0.2), von_mises (yield_stress 500.0); density 1500 kg/m^3" in printed
    assert "law of rubber: neo_hookean" in printed
    setup = load_scene(path)
    assert setup.body is None
    frames = Simulator(setup.scene, device="cpu").rollout(20, every=10)
    with np.load(out / "frames.npz") as saved:
        assert torch.equal(torch.from_numpy(saved["x"]), frames.x)
        assert saved["body_names"].tolist() == ["clay", "rubber"]
        assert np.array_equal(saved["body"], frames.body.numpy())


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("name: rubber", "name: clay", "bodies[1]: name = 'clay' is that of another body"),
        ("shape: box, lower: [0.4", "shape: bix, lower: [0.4", "bodies[1]: body.shape = 'bix' is unknown"),
        ("density: 1000.0", "density: -1.0", "bodies[1]: model.density"),
        ("kind: separate", "kind: glue", "contact.kind = 'glue' is unknown: choose from sticky, separate"),
        ("[clay, rubber, 0.4]", "[clay, wood, 0.4]", "contact.friction[0] must be [name, name, coefficient] of the bodies clay, rubber"),
        ("[clay, rubber, 0.4]", "[clay, rubber, -0.4]", "contact.friction[0]"),
        ("upper: [0.5, 0.4, 0.5]", "upper: [0.5, 1.4, 0.5]", "bodies[1]:"),
        ("name: two-blocks", "name: two-blocks\nbody: {shape: cube}", "unknown key 'body'"),
    ],
)
def test_a_body_that_does_not_fit_is_one_line(old, new, message, tmp_path, capsys):
    path = tmp_path / "blocks.yaml"
    path.write_text(BODIES.replace(old, new))
    status, _, err = run(capsys, "simulate", path, "--out", tmp_path / "out", "--device", "cpu")
    assert status == 2
    assert message in err and str(path) in err
    assert not (tmp_path / "out").exists()
