"""Zero-shot inference: from a video to a law file, particles and a video, and the law under other conditions."""

import json
from pathlib import Path

import cv2
import pytest
import torch
import yaml
from lightning.pytorch import Trainer, seed_everything

import neuido
from neuido.data.files.score_tables import folder_of
from neuido.data.formats.ply import read_ply_vertices
from neuido.errors import UserError
from neuido.models.inference.law_file import load_law, save_law
from neuido.models.inference.outputs import write_particles
from neuido.models.inference.pipeline import carry_points, infer_latent, render_motion, rollout_latent
from neuido.models.inference.prepared_scene import prepare
from neuido.models.inference.transfer import read_conditions, simulate_condition
from neuido.models.operator.dynamics_operator import IntrinsicDynamicsOperator
from neuido.models.scoring.lpips import Absent
from neuido.models.scoring.motion_scores import score_images, score_motion
from neuido.models.stages.align import AlignModule
from neuido.models.video.encoder import DynamicsEncoder
from neuido.models.video.flow_vae import FlowVAE
from tests.models.visual_samples import TinyScenes, tiny_scene

TWO = """
format: neuido-conditions/1
name: two bodies
frames: 4
bodies:
  - of: tiny-0
    shape: {shape: ball, centre: [0.5, 0.5, 0.5], radius: 0.1, spacing: 0.05, velocity: [0.0, -3.0, 0.0]}
  - of: 1
    velocity: [0.0, 0.0, 0.0]
    shift: [0.0, -0.03, 0.0]
"""


@pytest.fixture(scope="module")
def tools(tmp_path_factory):
    torch.manual_seed(0)
    operator = IntrinsicDynamicsOperator.load()
    encoder = DynamicsEncoder(FlowVAE(8), flow_size=32, width=48)
    encoder.projector.start_near(operator.latents)
    folder = tmp_path_factory.mktemp("scenes")
    scenes = [tiny_scene(folder, f"tiny-{i}", young=young) for i, young in enumerate((5e4, 2e5))]
    return operator, encoder, [prepare(scene, encoder) for scene in scenes]


def test_the_true_law_scores_nearly_perfectly(tools):
    operator, _, (prepared, _) = tools
    from neuido.physics.laws.classical import material

    law = prepared.source.truth.law
    with torch.no_grad():
        steps = (prepared.frames - 1) * prepared.every
        motion = prepared.simulator.rollout(steps, *material(law["elasticity"], law["plasticity"]), every=prepared.every)
        other = rollout_latent(prepared, operator, operator.latents.mean(0))
    absent = Absent("a test")
    for rows, worse in ((score_motion(prepared, motion), score_motion(prepared, other)),):
        assert len(rows) == 5
        assert all(row["cd"] < 0.01 and row["rmse"] < 1e-4 for row in rows)
        assert worse[-1]["cd"] > 10 * rows[-1]["cd"] and worse[-1]["rmse"] > 1e-3
    right, wrong = (score_images(prepared, each, [2], absent) for each in (motion, other))
    assert all(row["psnr"] > 33 and row["ssim"] > 0.98 for row in right)  # Gaussians move with the mean of their particles
    assert wrong[-1]["psnr"] < right[-1]["psnr"] - 3 and wrong[-1]["crop_psnr"] < wrong[-1]["psnr"]
    assert "lpips" not in right[0]


def test_track_carries_points_with_a_motion():
    torch.manual_seed(0)
    rest, points = torch.rand(200, 3), torch.rand(20, 3)
    turn = torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    assert torch.allclose(carry_points(rest, points, (rest + 0.3)[None])[0], points + 0.3, atol=1e-5)
    assert torch.equal(carry_points(rest, rest[:5], (rest @ turn.T)[None])[0].round(decimals=4), (rest[:5] @ turn.T).round(decimals=4))
    assert (carry_points(rest, points, (rest @ turn.T)[None])[0] - points @ turn.T).norm(dim=1).median() < 0.1


def test_law_file(tools, tmp_path):
    operator, encoder, (prepared, _) = tools
    found = infer_latent(encoder, operator, prepared)
    assert 0 < found.seconds < 5
    save_law(tmp_path / "law.safetensors", operator, found.z, {"scene": "tiny-0"})
    with torch.no_grad():
        loaded = prepared.simulator.rollout(40, *load_law(tmp_path / "law.safetensors"), every=20)
        direct = prepared.simulator.rollout(40, *operator.laws(found.z), every=20)
    assert torch.equal(loaded.x, direct.x)
    card = json.loads((tmp_path / "law.json").read_text())
    assert card["scene"] == "tiny-0" and 1e4 < card["modulus"] < 1e7
    with pytest.raises(UserError, match="missing"):
        load_law(tmp_path / "none.safetensors")


def test_predict_writes_law_particles_and_video(tools, tmp_path):
    seed_everything(0)
    encoder = tools[1]
    encoder.save(tmp_path / "encoder.safetensors")
    (tmp_path / "two.yaml").write_text(TWO)
    model = AlignModule(
        init_from=str(tmp_path / "encoder.safetensors"), out=str(tmp_path / "out"), condition_files=[str(tmp_path / "two.yaml")]
    )
    options = {"logger": False, "enable_checkpointing": False, "enable_progress_bar": False, "enable_model_summary": False}
    answers = Trainer(accelerator="cpu", **options).predict(model, TinyScenes(str(tmp_path)))
    assert [Path(answer["folder"]).name for answer in answers] == ["tiny-0", "tiny-1"]
    folder = tmp_path / "out" / "tiny-0"
    assert len(list((folder / "particles").glob("*.ply"))) == 6
    vertices = read_ply_vertices(folder / "particles" / "005.ply")
    assert len(vertices) == len(tools[2][0].source.body.x)
    video = cv2.VideoCapture(str(folder / "prediction.mp4"))
    assert video.get(cv2.CAP_PROP_FRAME_COUNT) == 6 and video.get(cv2.CAP_PROP_FRAME_WIDTH) == 64  # recorded and predicted, side by side
    sheet = cv2.imread(str(folder / "prediction.png"))
    assert sheet.shape[0] == 64 and sheet.std() > 5
    assert load_law(folder / "law.safetensors")
    assert len(list((tmp_path / "out" / "condition-two-bodies" / "particles").glob("*.ply"))) == 4
    assert cv2.VideoCapture(str(tmp_path / "out" / "condition-two-bodies" / "video.mp4")).get(cv2.CAP_PROP_FRAME_COUNT) == 4


def test_two_bodies_meet(tools, tmp_path):
    operator, encoder, prepared = tools
    (tmp_path / "two.yaml").write_text(TWO.replace("frames: 4", "frames: 6"))
    known = [(each, operator.laws(operator.latent("jelly"))) for each in prepared]
    both = read_conditions(tmp_path / "two.yaml")
    motion, gaussians, first = simulate_condition(both, known)
    assert motion.x.shape[1] == gaussians.means.shape[1] and len(gaussians.opacities) == motion.x.shape[1]
    flowless = [(each._replace(volume=None), laws) for each, laws in known]  # a method need not have flow
    lower_alone, *_ = simulate_condition(both._replace(bodies=both.bodies[1:]), flowless)
    count = len(lower_alone.x[0])
    pressed = motion.x[-1, -count:, 1].max() - lower_alone.x[-1, :, 1].max()
    assert pressed < -0.005  # the ball pushes the lower body's top down
    with torch.no_grad():
        images, _ = render_motion(prepared[0], rollout_latent(prepared[0], operator, operator.latent("jelly")), [0])
    assert images.shape == (6, 1, 32, 32, 3) and first is prepared[0]


def test_the_conditions_that_come_with_neuido_are_read():
    for path in (neuido.configs_root() / "conditions").glob("*.yaml"):
        assert read_conditions(path).name == path.stem == read_conditions(path.stem).name
        yaml.safe_load(path.read_text())


@pytest.mark.parametrize(
    ("change", "word"),
    [
        (("of: 1", "of: 7"), "scene number 7"),
        (("of: tiny-0", "of: nobody"), "nobody"),
        (("[0.0, -0.03, 0.0]", "[0.0, 0.2, 0.0]"), "apart"),
        (("name: two bodies", "colour: red"), "colour"),
        (("radius: 0.1", "radius: -1.0"), "radius"),
    ],
)
def test_impossible_conditions_are_named(tools, tmp_path, change, word):
    operator, _, prepared = tools
    path = tmp_path / "two.yaml"
    path.write_text(TWO.replace(*change))
    with pytest.raises(UserError, match=word):
        simulate_condition(read_conditions(path), [(each, operator.laws(operator.latent("jelly"))) for each in prepared])


def test_names_stay_inside(tmp_path):
    assert folder_of(tmp_path, "../../etc/passwd").parent == tmp_path
    assert folder_of(tmp_path, "..").parent == tmp_path


def test_a_shorter_sequence_replaces_a_longer_one(tools, tmp_path):
    operator, _, (prepared, _) = tools
    with torch.no_grad():
        write_particles(tmp_path, rollout_latent(prepared, operator, operator.latent("jelly")))
        write_particles(tmp_path, rollout_latent(prepared, operator, operator.latent("jelly"), 3))
    assert sorted(path.name for path in tmp_path.glob("*.ply")) == ["000.ply", "001.ply", "002.ply"]


@pytest.mark.parametrize("rate", [15, 24, 29.97, 30, 48, 50, 60, 90, 120, 240])
def test_step_adapts_to_the_frame_rate(rate):
    from neuido.models.inference.prepared_scene import fitting_step, frame_substeps

    times = torch.arange(5, dtype=torch.float64) / rate
    dt = fitting_step(times, 5e-4)
    every, picks = frame_substeps(times, dt, "video")
    assert 2.5e-4 < dt <= 5e-4 * 1.001 and picks is None and every * dt == pytest.approx(1 / rate, rel=1e-3)
