import csv
import json
import shutil
import signal
import subprocess
import sys
import time

import cv2
import numpy as np
import pytest
import torch

from neuido.commands.main import main
from neuido.commands.reconstruct import reconstruct
from neuido.data import cameras as convert
from neuido.data.formats import nerfstudio
from neuido.data.scenes.film_options import Film
from neuido.data.scenes.filmed_scene import load_views, load_visual_scene, read_body, read_setting, read_truth
from neuido.data.scenes.masks import masks_from_background
from neuido.data.scenes.synthetic import make_scenes
from neuido.errors import UserError
from neuido.models.reconstruct.gaussian_fit import ReconstructModule
from neuido.models.render.gaussians import bind, load_gaussians
from neuido.models.render.splatting import rasterize
from neuido.models.scoring.metrics import chamfer_distance
from neuido.physics.laws.classical import material
from neuido.physics.mpm.simulator import Simulator

BOX = {
    "name": "Box",
    "scene": {"domain": [[0, 0, 0], [1, 1, 1]], "gravity": [0, -9.8, 0]},
    "discretisation": {"grid": 16, "dt": 2e-3},
    "model": {"density": 1200.0, "elasticity": {"law": "fixed_corotated", "young": 5e4, "poisson": 0.3}},
    "body": {"shape": "box", "lower": [0.3, 0.1, 0.36], "upper": [0.7, 0.38, 0.64], "spacing": 0.03, "jitter": 0.5},
    "velocity": [0.2, -1.5, 0.0],
    "angular_velocity": [0.0, 0.0, 2.0],
}
FILM = Film(views=7, held_out=(2,), width=64, height=64, frames=3, substeps=10, density=3, angle=26.0, target=(0.5, 0.25, 0.5))
SMALL = {"steps": 150, "start": 500, "gaussians": 900, "particles": 900, "resolution": 64, "views": 3, "device": "cpu", "progress": False}


@pytest.fixture(scope="module")
def box(tmp_path_factory):
    """A filmed box, reconstructed in its folder."""
    (folder,) = make_scenes([BOX], FILM, tmp_path_factory.mktemp("scenes"), draw=rasterize, device="cpu", progress=False)
    reconstruct(str(folder), **SMALL)
    return folder


def report(folder) -> dict:
    return json.loads((folder / "report.json").read_text())


@pytest.mark.slow
def test_figures(box):
    figures = report(box / "reconstruction")
    assert figures["psnr_held_out"] > 27 and figures["psnr_train"] > figures["psnr_held_out"]
    assert figures["ssim_held_out"] > 0.95
    assert abs(figures["volume_error"]) < 0.2
    assert figures["chamfer_1e4"] < 1.2 * figures["chamfer_floor_1e4"]
    assert figures["particles"] == pytest.approx(900, rel=0.05)
    assert 500 < figures["gaussians"] <= 900


def test_files_are_what_stage_two_reads(box):
    visual = load_visual_scene(box)
    truth = read_truth(box)
    assert visual.name == "Box" and visual.density == 1200.0 and visual.scene.cells == 16
    assert visual.model["elasticity"]["young"] == 1e5  # the declared one
    assert visual.truth.law["elasticity"]["young"] == 5e4
    assert visual.batch.images.shape == (7, 3, 64, 64, 3) and visual.batch.held_out.nonzero().tolist() == [[2]]
    assert len(visual.truth.x) == len(visual.batch.times) == 3
    assert visual.body.x.shape != truth.x0.shape or not torch.equal(visual.body.x, truth.x0)
    assert float(chamfer_distance(visual.body.x, truth.x0)) < 2e-3
    # the velocity that is known: that of the true body's motion
    v = torch.tensor([0.2, -1.5, 0.0]) + torch.linalg.cross(torch.tensor([[0.0, 0.0, 2.0]]), visual.body.x - truth.x0.mean(0))
    torch.testing.assert_close(visual.body.v, v, rtol=0, atol=1e-4)
    gaussians = load_gaussians(visual.gaussians, device="cpu")
    binding = bind(gaussians, visual.body.x)
    assert float((binding.rest - gaussians.means).norm(dim=1).max()) < 0.1
    # it moves as the truth does, under the true law
    simulator = Simulator(visual.scene, visual.body, density=visual.density, device="cpu")
    with torch.no_grad():
        x = simulator.rollout(20, *material(truth.law["elasticity"], truth.law["plasticity"]), every=10).x
    assert 1e4 * float(chamfer_distance(x[-1], truth.x[-1])) < 12
    fewer = load_visual_scene(box, frame_step=2, views=["0", "2"], width=32)
    assert fewer.batch.images.shape == (2, 2, 32, 32, 3) and len(fewer.truth.x) == 2


def test_log_and_picture(box):
    with (box / "reconstruction" / "log" / "version_0" / "metrics.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert float(rows[-1]["loss"]) < 0.5 * float(rows[0]["loss"])
    assert int(float(rows[-1]["gaussians"])) > int(float(rows[0]["gaussians"]))
    image = cv2.imread(str(box / "reconstruction" / "comparison.png"))
    assert image.shape == (3 * 320, 4 * 320, 3)
    recorded, rendered = image[:320, :320].astype(float), image[:320, 320:640].astype(float)
    assert np.abs(recorded - rendered).mean() < 6 and (recorded.min(2) < 128).mean() > 0.05
    assert not (box / "reconstruction" / "resume.ckpt").exists()


def test_done_is_done_and_other_options_are_refused(box, capsys):
    before = (box / "reconstruction" / "gaussians.ply").stat().st_mtime_ns
    reconstruct(str(box), **SMALL)
    assert (box / "reconstruction" / "gaussians.ply").stat().st_mtime_ns == before
    printed = capsys.readouterr().out
    assert "held out: PSNR" in printed and printed.splitlines()[-1].startswith(f"results in {box}")
    with pytest.raises(UserError, match="other options"):
        reconstruct(str(box), **{**SMALL, "steps": 151})


@pytest.mark.slow
def test_killed_run_ends_as_one_that_was_not(box, tmp_path):
    options = [f"--{key}={str(value).lower() if isinstance(value, bool) else value}" for key, value in SMALL.items()]
    command = [sys.executable, "-m", "neuido", "reconstruct", str(box), "--out", str(tmp_path), "--save_every=40", *options]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
    while not (tmp_path / "resume.ckpt").exists():
        assert process.poll() is None, process.stderr.read()
        time.sleep(0.02)
    process.send_signal(signal.SIGKILL)
    process.wait()
    process.stderr.close()
    assert not (tmp_path / "report.json").exists() and not (tmp_path / "body.npz").exists()
    step = torch.load(tmp_path / "resume.ckpt", weights_only=True)["global_step"]
    assert 0 < step < 150
    reconstruct(str(box), out=str(tmp_path), save_every=40, **SMALL)
    for name in ("gaussians.ply", "body.npz", "report.json"):
        assert (tmp_path / name).read_bytes() == (box / "reconstruction" / name).read_bytes(), name


@pytest.mark.slow
def test_own_video(box, tmp_path, capsys):
    """A Nerfstudio folder in a unit and place of its own, no masks, through the command line."""
    batch, scale, shift = load_views(box), 0.5, (0.1, -0.05, 0.2)
    moved = convert.move(batch.cameras, scale=1 / scale, shift=tuple(-s / scale for s in shift))
    images = batch.images.mul(255).round().byte().numpy()  # on white
    nerfstudio.write(tmp_path / "video", moved, batch.times, images)
    options = [f"--{key}={str(value).lower() if isinstance(value, bool) else value}" for key, value in SMALL.items()]
    place = ["--scale", str(scale), "--shift", json.dumps(list(shift)), "--velocity", "[0.2, -1.5, 0.0]"]
    with pytest.raises(SystemExit) as stop:
        main(["reconstruct", str(tmp_path / "video"), *place, *options])
    assert stop.value.code == 0, capsys.readouterr().err
    visual = load_visual_scene(tmp_path / "video")
    truth = read_truth(box)
    assert visual.truth is None and visual.density == 1000.0
    torch.testing.assert_close(visual.batch.cameras.viewmats, batch.cameras.viewmats, rtol=0, atol=1e-5)
    assert float((visual.batch.masks - batch.masks).abs().mean()) < 0.01
    assert visual.batch.background.tolist() == [1.0, 1.0, 1.0]
    assert float(visual.body.volume.sum() / truth.volume.sum()) == pytest.approx(1.0, abs=0.2)
    torch.testing.assert_close(visual.body.x.mean(0), truth.x0.mean(0), rtol=0, atol=0.01)
    torch.testing.assert_close(visual.body.v[0], torch.tensor([0.2, -1.5, 0.0]))
    setting = read_setting(tmp_path / "video" / "reconstruction" / "scene.yaml")
    assert setting.placing.scale == scale and setting.placing.shift == shift


def test_background_must_be_plain():
    noise = torch.rand(2, 1, 16, 16, 3, generator=torch.Generator().manual_seed(0))
    with pytest.raises(UserError, match="give an alpha channel"):
        masks_from_background(noise)
    plain = torch.full((2, 1, 16, 16, 3), 0.25)
    plain[:, :, 4:9, 5:9] = torch.tensor([0.9, 0.2, 0.2])
    colour, masks = masks_from_background(plain)
    assert colour.tolist() == [0.25, 0.25, 0.25] and masks.sum().item() == 2 * 20


def test_errors(box, tmp_path):
    def fails(words, folder=box, **changes):
        with pytest.raises(UserError, match=words):
            reconstruct(str(folder), **{"out": str(tmp_path / "out"), **SMALL, **changes})

    fails("the folder .* is missing", tmp_path / "none")
    fails("scale, shift and up are not for experiments", scale=2.0)
    fails("filling|method = 'grid'", filling="grid", steps=2)
    fails("recording = 'throw'", recording="throw")
    copy = shutil.copytree(box, tmp_path / "copy")
    with pytest.raises(UserError, match="run `neuido reconstruct"):
        load_visual_scene(copy, reconstruction=tmp_path / "nowhere")
    (copy / "reconstruction" / "body.npz").write_bytes(b"PK\x03\x04")
    with pytest.raises(UserError, match=r"body\.npz is not a valid archive"):
        load_visual_scene(copy)
    np.savez(copy / "reconstruction" / "body.npz", x0=np.zeros((4, 3)), v0=np.zeros((5, 3)), volume=np.ones(4))
    with pytest.raises(UserError, match="the same length"):
        read_body(copy / "reconstruction" / "body.npz")
    text = (copy / "reconstruction" / "scene.yaml").read_text()
    (copy / "reconstruction" / "scene.yaml").write_text(text + "colour: red\n")
    with pytest.raises(UserError, match="unknown key 'colour'"):
        load_visual_scene(copy)
    with pytest.raises(UserError, match="max_gaussians = 3"):
        ReconstructModule(initial_gaussians=4, max_gaussians=3)
    assert not (tmp_path / "out" / "report.json").exists()
