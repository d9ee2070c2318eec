"""What can be viewed is read, and what cannot is one line."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from neuido import Frames, UserError
from neuido.models import attach_gaussians, save_gaussians
from neuido.viewer.sources import read_content
from tests.command import run
from tests.commands.test_simulate import SCENE


def frames(count: int = 4, points: int = 30) -> Frames:
    x = torch.rand(1, points, 3) + torch.arange(count)[:, None, None] * 0.1
    eye = torch.eye(3).expand(count, points, 3, 3).contiguous()
    return Frames(x, torch.ones_like(x), torch.zeros_like(eye), eye, dt=0.02)


def test_a_rollout_has_its_times_and_quantities(tmp_path):
    frames().save(tmp_path / "a.npz")
    content = read_content(tmp_path / "a.npz")
    assert content.frames == 4 and content.times[-1] == pytest.approx(0.06) and content.timed
    assert content.quantities()[0] == "speed" and "strain" in content.quantities() and "von Mises stress" not in content.quantities()
    assert np.allclose(content.motions[0].quantities["speed"].values(0), np.sqrt(3))


def test_a_folder_of_simulate_has_floor_gravity_and_stress(tmp_path, capsys):
    (tmp_path / "ball.yaml").write_text(SCENE)
    status, _, err = run(capsys, "simulate", tmp_path / "ball.yaml", "--out", tmp_path / "out", "--steps", 10, "--device", "cpu")
    assert status == 0, err
    content = read_content(tmp_path / "out")
    assert content.gravity == (0.0, -9.8, 0.0) and len(content.planes) == 1 and content.title == "out"
    stress = content.motions[0].quantities["von Mises stress"]
    assert stress.values(0).max() == pytest.approx(0.0, abs=1e-2) and stress.values(9).shape == stress.values(0).shape


def test_bodies_have_their_laws_and_colliders_their_surfaces(tmp_path, capsys):
    model = "{density: 1000.0, elasticity: {law: fixed_corotated, young: %s, poisson: 0.2}}"
    text = SCENE[: SCENE.index("model:")] + "bodies:\n" + "".join(
        f"  - {{name: {name}, model: {model % young}, body: {{shape: ball, centre: [{x}, 0.4, 0.5], radius: 0.12, spacing: 0.04}}}}\n"
        for name, young, x in (("soft", "1.0e+4", 0.3), ("hard", "4.0e+4", 0.7))
    ) + SCENE[SCENE.index("discretisation:") :]  # fmt: skip
    text = text.replace("gravity:", "colliders: [{kind: sphere, radius: 0.1, position: [0.3, 0.15, 0.5], contact: separate}]\n  gravity:")
    (tmp_path / "two.yaml").write_text(text)
    status, _, err = run(capsys, "simulate", tmp_path / "two.yaml", "--out", tmp_path / "out", "--steps", 40, "--device", "cpu")
    assert status == 0, err
    content = read_content(tmp_path / "out")
    motion = content.motions[0]
    assert len(content.surfaces) == 1 and np.ptp(content.surfaces[0].vertices(0), axis=0) == pytest.approx([0.2, 0.2, 0.2], abs=0.01)
    assert set(motion.body) == {0, 1}
    hard = motion.body == 1
    strained = motion.F[-1] @ np.diag([1.1, 1.0, 1.0])
    assert np.linalg.norm(motion.stress(strained)[hard]) > 3 * np.linalg.norm(motion.stress(strained)[~hard])


def test_several_scenes_stand_apart(tmp_path):
    arrays = {"x": np.random.default_rng(0).random((2, 20, 3)).astype(np.float32), "scene": np.repeat([0, 1], 10).astype(np.int32)}
    np.savez(tmp_path / "two.npz", **arrays)
    motion = read_content(tmp_path / "two.npz").motions[0]
    assert motion.x[0, :10, 0].max() < motion.x[0, 10:, 0].min() and len({tuple(c) for c in motion.colours(0, "body")}) == 2


def test_point_clouds_and_gaussians_of_frames(tmp_path):
    frames().save(tmp_path / "run" / "particles" / "frame.ply")
    content = read_content(tmp_path / "run")
    assert content.frames == 4 and not content.timed and "speed" in content.quantities() and content.title == "run"
    made = attach_gaussians(torch.rand(40, 3), torch.full((40,), 1e-3), torch.rand(40, 3))
    save_gaussians(tmp_path / "splats.ply", made)
    splats = read_content(tmp_path / "splats.ply")
    assert len(splats.gaussians) == 1 and splats.gaussians[0].means.shape == (40, 3) and not splats.motions


def test_predictions_of_several_scenes(tmp_path):
    for name in ("duck", "cat"):
        frames().save(tmp_path / "runs" / name / "particles" / "f.ply")
    (tmp_path / "runs" / "duck" / "particles" / "times.csv").write_text("frame,time [s]\n0,0\n1,0.01\n2,0.02\n3,0.03\n")
    assert read_content(tmp_path / "runs", "duck").times == pytest.approx([0.0, 0.01, 0.02, 0.03])
    assert read_content(tmp_path / "runs").notes == ["one of 2: --recording chooses from cat, duck"]
    assert not read_content(tmp_path / "runs", "duck").notes
    with pytest.raises(UserError, match=r"recording = 'dck'.*duck"):
        read_content(tmp_path / "runs", "dck")


def broken(folder: Path, name: str) -> Path:
    made = {
        "absent": lambda path: path,
        "text.txt": lambda path: path.write_text("hello"),
        "empty": lambda path: path.mkdir(),
        "bad.npz": lambda path: path.write_bytes(b"PK\x03\x04 cut"),
        "flat.npz": lambda path: np.savez(path, x=np.zeros((3, 2))),
        "nothing.npz": lambda path: np.savez(path, y=np.zeros(3)),
        "times.npz": lambda path: np.savez(path, x=np.zeros((2, 5, 3), np.float32), times=np.array([1.0, 0.0])),
        "bad.ply": lambda path: path.write_bytes(b"ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nend_header\n1\n2\n"),
        "picture.png": lambda path: path.write_bytes(b"\x89PNG"),
    }
    made[name](folder / name)
    return folder / name


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("absent", "is missing"),
        ("text.txt", "cannot be viewed"),
        ("empty", "nothing that can be viewed"),
        ("bad.npz", "bad.npz"),
        ("flat.npz", r"shape \(3, 2\)"),
        ("nothing.npz", "lacks the array 'x'"),
        ("times.npz", "must be finite and increase"),
        ("bad.ply", "lack the column y"),
        ("picture.png", "cannot be viewed"),
    ],
)
def test_what_cannot_be_read_is_one_line(tmp_path, name, told):
    with pytest.raises(UserError, match=told) as failed:
        read_content(broken(tmp_path, name))
    assert "\n" not in str(failed.value)


def test_a_diagnosis_stands_side_by_side_with_its_residual(tmp_path):
    from tests.discrepancy.report.report_content import content as diagnosis
    from tests.discrepancy.report.report_content import motion

    (tmp_path / "predicted").mkdir()
    for name, arrays in motion().items():
        np.savez(tmp_path / "predicted" / f"{name}.npz", **arrays)
    (tmp_path / "diagnosis.json").write_text(json.dumps(diagnosis()))
    content = read_content(tmp_path, "throw")
    assert [each.name for each in content.motions] == ["before", "after"]
    assert content.motions[1].shift.any() and content.gravity == (0.0, -9.81, 0.0) and len(content.planes) == 1
    arrays = motion()["throw"]
    expected = np.linalg.norm(arrays["before"][-1] - arrays["measured"][-1], axis=1)
    assert np.allclose(content.motions[0].quantities["residual"].values(len(arrays["t"]) - 1), expected, rtol=1e-4, equal_nan=True)
    assert content.quantities()[0] == "residual"
    with pytest.raises(UserError, match="recording = 'x'"):
        read_content(tmp_path, "x")
