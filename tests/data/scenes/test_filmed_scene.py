import shutil

import numpy as np
import pytest

from neuido.data.bodies import scene_files as scenes
from neuido.data.files.parsing import read_yaml
from neuido.data.scenes.filmed_scene import (
    Motion,
    Placement,
    SceneSetting,
    read_motion,
    read_setting,
    read_truth,
    write_motion,
    write_setting,
)
from neuido.data.scenes.synthetic import JELLY
from neuido.errors import UserError
from neuido.types import AttachedMass, Box, Plane, Scene, Walls
from tests.data.refused import assert_refused


def test_motion_round_trip(tmp_path):
    assert read_motion(tmp_path) is None
    for motion in (Motion((0.1, -2.0, 1e-7), (0.0, 3.0, 0.0), (0.5, 0.25, 0.5)), Motion((0.0, -1.0, 0.0))):
        write_motion(motion, tmp_path)
        assert read_motion(tmp_path) == motion


def test_setting_round_trip(tmp_path):
    floor = Plane((0.0, 0.1, 0.0), (0.0, 1.0, 0.0), "separate", 0.3)
    mass = AttachedMass(Box((0.0, 0.0, 0.0), (0.1, 0.1, 0.1)), 0.05)
    walls = (Walls("separate", float("inf"), 1.0), None, Walls())
    for i, wall in enumerate(walls):
        scene = Scene(upper=(1.0, 2.0, 1.0), cells=24, dt=2.5e-4, colliders=(floor,), walls=wall, attached_masses=(mass,))
        setting = SceneSetting(f"mine {i}", scene, 1000.0, JELLY, Placement(0.5, (0.1, -0.2, 1e-9), "-z"))
        write_setting(setting, tmp_path / "scene.yaml")
        assert read_setting(tmp_path / "scene.yaml") == setting


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("format: neuido-visual/1", "format: neuido-visual/2", "format = 'neuido-visual/2'"),
        ("scale: 0.5", "scale: 0.0", "placing.scale must be above 0"),
        ("up: z", "up: x", "placing.up = 'x'"),
        ("up: z\n", "up: z\n  turn: 3\n", "unknown key 'turn'"),
        ("grid: 32", "grid: 2", "discretisation.grid"),
        ("young: 100000.0", "young: -1.0", "young"),
        ("name: mine\n", "", "lacks the key 'name'"),
    ],
)
def test_setting_errors(tmp_path, old, new, words):
    path = tmp_path / "scene.yaml"
    write_setting(SceneSetting("mine", Scene(), 1000.0, JELLY, Placement(0.5, up="z")), path)
    assert_refused(read_setting, path, old, new, words)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("format: neuido-motion/2\nvelocity: [0, 0, 0]\n", "format = "),
        ("format: neuido-motion/1\n", "lacks the key 'velocity'"),
        ("format: neuido-motion/1\nvelocity: [0, .nan, 0]\n", "velocity must be a finite number"),
        ("format: neuido-motion/1\nvelocity: [0, 0, 0]\nspin: [0, 0, 0]\n", "unknown key 'spin'"),
    ],
)
def test_motion_errors(tmp_path, text, words):
    (tmp_path / "motion.yaml").write_text(text)
    with pytest.raises(UserError, match=words):
        read_motion(tmp_path)


def test_truth(tmp_path):
    x = np.random.default_rng(0).uniform(size=(7, 5, 3)).astype(np.float32)
    arrays = {"x": x, "x0": x[0], "volume": np.full(5, 1e-3, np.float32), "times": np.arange(7) * 0.01}
    assert read_truth(tmp_path) is None
    np.savez(tmp_path / "truth.npz", **arrays)
    assert read_truth(tmp_path) is None  # no truth.yaml
    scenes_law = {"density": 1000.0, "elasticity": {"law": "sigma", "young": 1e5, "poisson": 0.2}, "plasticity": {"law": "identity"}}
    (tmp_path / "truth.yaml").write_text(f"law: {scenes_law}\n")
    truth = read_truth(tmp_path, frame_step=3, frames=2)
    np.testing.assert_array_equal(truth.x, x[[0, 3]])
    assert truth.times.tolist() == [0.0, 0.03] and truth.law["elasticity"]["law"] == "sigma"
    with pytest.raises(UserError, match="7 frames, but the recording has 8"):
        read_truth(tmp_path, frames=8)
    for wrong in ({"x": x[:, :4]}, {"times": np.arange(6) * 0.01}, {"x": x * np.nan}, {"volume": np.ones((5, 1))}):
        np.savez(tmp_path / "truth.npz", **(arrays | wrong))
        with pytest.raises(UserError, match=r"truth\.npz"):
            read_truth(tmp_path)
    np.savez(tmp_path / "truth.npz", **{key: value for key, value in arrays.items() if key != "x0"})
    with pytest.raises(UserError, match=r"truth\.npz is not a valid archive"):
        read_truth(tmp_path)
    shutil.rmtree(tmp_path)


def test_an_experiment_file_is_a_setting_too(data_root):
    path = data_root / "experiments" / "gel-ball" / "experiment.yaml"
    with pytest.raises(UserError, match="0 recordings with images"):
        read_setting(path)
    take = read_setting(path, recording="take1") if (path.parent / "take1").is_dir() else None
    assert take is None or take.scene == scenes.scene_from_dict(*(read_yaml(path)[key] for key in ("scene", "discretisation")))
