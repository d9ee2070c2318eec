import json
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from neuido.data.bodies import scene_files as scenes
from neuido.data.cameras import project
from neuido.data.files.parsing import read_yaml
from neuido.data.measured.experiment import read_experiment
from neuido.data.scenes import filmed_scene as visual
from neuido.data.scenes import synthetic
from neuido.data.scenes.film_options import Film
from neuido.data.scenes.synthetic import make_scenes, plan_scene
from neuido.errors import UserError
from neuido.models.render.splatting import rasterize
from neuido.physics.laws.classical import material
from neuido.physics.mpm.simulator import Simulator

BALL = {
    "name": "Ball",
    "scene": {"domain": [[0, 0, 0], [1, 1, 1]], "gravity": [0, -9.8, 0]},
    "discretisation": {"grid": 16, "dt": 2e-3},
    "model": {"density": 1000.0, "elasticity": {"law": "fixed_corotated", "young": 5e4, "poisson": 0.3}},
    "body": {"shape": "ball", "centre": [0.5, 0.3, 0.5], "radius": 0.2, "spacing": 0.05},
    "velocity": [0.2, -1.5, 0.0],
    "angular_velocity": [0.0, 0.0, 3.0],
}
FILM = Film(views=4, held_out=(1,), width=48, height=40, frames=5, substeps=10, density=2, angle=28.0)
LISTS = ("six", "ten_elastic", "six_small", "ten_small")


def make(out, entries=(BALL,), film=FILM):
    return make_scenes(list(entries), film, out, draw=rasterize, device="cpu", progress=False)


def contents(folder) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


@pytest.fixture(scope="module")
def ball(tmp_path_factory):
    return make(tmp_path_factory.mktemp("scenes"))[0]


def test_layout(ball):
    images = sorted(path.name for path in (ball / "drop" / "images").iterdir())
    assert images == [f"{v}_{t:03d}.png" for v in range(4) for t in range(5)]
    experiment = read_experiment(ball)
    (recording,) = experiment.recordings
    assert recording.frame_interval == pytest.approx(0.02) and recording.body is None
    assert recording.video.held_out == (1,)
    assert experiment.model["elasticity"]["young"] == 1e5  # the declared model, not the true one
    assert "5.0e+4" not in (ball / "experiment.yaml").read_text() and "50000" not in (ball / "experiment.yaml").read_text()
    index = json.loads((ball.parent / "index.json").read_text())
    assert index["scenes"][0]["law"]["elasticity"]["young"] == 5e4


def test_truth_is_the_simulation(ball):
    truth = visual.read_truth(ball)
    assert truth.x.shape[0] == 5 and truth.times.tolist() == pytest.approx([0, 0.02, 0.04, 0.06, 0.08])
    assert float(truth.volume.sum()) == pytest.approx(4 / 3 * np.pi * 0.2**3, rel=1e-5)
    motion = visual.read_motion(ball)
    body = scenes.body_from_dict(BALL["body"], None)
    spin = torch.tensor(motion.angular_velocity)
    v = torch.tensor(motion.velocity) + torch.linalg.cross(spin.expand_as(body.x), body.x - torch.tensor(motion.centre))
    scene = scenes.scene_from_dict(BALL["scene"], BALL["discretisation"])
    simulator = Simulator(scene, body._replace(v=v), density=1000.0, device="cpu")
    with torch.no_grad():
        x = simulator.rollout(40, *material(truth.law["elasticity"], truth.law["plasticity"]), every=10).x
    torch.testing.assert_close(truth.x, x, rtol=0, atol=1e-5)
    assert float((truth.x[-1] - truth.x[0]).norm(dim=1).max()) > 0.1


def test_images_show_the_particles(ball):
    truth, batch = visual.read_truth(ball), visual.load_views(ball)
    assert batch.images.shape == (4, 5, 40, 48, 3) and batch.held_out.tolist() == [False, True, False, False]
    torch.testing.assert_close(batch.times, truth.times)
    for t in (0, 4):
        pixels, _ = project(truth.x[t], batch.cameras)
        for v in range(4):
            weight = batch.masks[v, t]
            rows, columns = torch.meshgrid(torch.arange(40) + 0.5, torch.arange(48) + 0.5, indexing="ij")
            middle = torch.stack([(columns * weight).sum(), (rows * weight).sum()]) / weight.sum()
            assert float((middle - pixels[v].mean(0)).norm()) < 0.6  # px
            j, i = pixels[v].T.long()
            assert float((weight[i, j] > 0.3).float().mean()) > 0.97
    assert float((batch.masks > 0.5).float().mean()) < 0.4


def test_gaussians_follow_a_deformation():
    body = scenes.body_from_dict(BALL["body"], None)
    dense = synthetic.surround_with_gaussians(body, 3, seed="a")
    F = torch.tensor([[1.2, 0.3, 0.0], [0.0, 0.9, 0.0], [0.1, 0.0, 1.0]])
    means, covariances = dense.at((body.x @ F.T)[None], F.expand(1, len(body.x), 3, 3))
    start, round_ = dense.at(body.x[None], torch.eye(3).expand(1, len(body.x), 3, 3))
    assert means.shape == (1, 3 * len(body.x), 3)
    torch.testing.assert_close(means, start @ F.T)
    torch.testing.assert_close(covariances, F @ round_ @ F.T)
    assert dense.colour.std(0).min() > 0.05 and dense.colour.min() >= 0 and dense.colour.max() <= 1
    assert torch.equal(dense.colour, synthetic.surround_with_gaussians(body, 3, seed="a").colour)
    assert not torch.equal(dense.colour, synthetic.surround_with_gaussians(body, 3, seed="b").colour)


def test_same_bytes_again_and_whole_scenes_are_kept(ball, tmp_path):
    again = make(tmp_path)[0]
    assert contents(again) == contents(ball)
    before = (again / "drop" / "images" / "0_000.png").stat().st_mtime_ns
    make(tmp_path)
    assert (again / "drop" / "images" / "0_000.png").stat().st_mtime_ns == before
    with pytest.raises(UserError, match="holds other scenes"):
        make(tmp_path, film=replace(FILM, width=50))


@pytest.mark.slow
def test_killed_run_goes_on(ball, tmp_path):
    entries = [{**BALL, "name": f"Ball-{i}", "split": "unseen" if i else "train"} for i in range(40)]
    config = tmp_path / "scenes.json"
    config.write_text(json.dumps({"scenes": entries, "film": {**vars(FILM)}, "device": "cpu"}))
    out = tmp_path / "out"
    command = [sys.executable, "-m", "neuido", "scenes", "--config", str(config), "--out", str(out), "--progress", "false"]
    process = subprocess.Popen(command, stderr=subprocess.PIPE)
    while not (out / "Ball-1").exists():
        assert process.poll() is None, process.stderr.read()
        time.sleep(0.02)
    process.send_signal(signal.SIGKILL)
    process.wait()
    process.stderr.close()
    done = [path for path in out.iterdir() if path.is_dir() and not path.name.startswith(".")]
    assert 2 <= len(done) < 40
    for path in done:
        assert len(read_experiment(path)["drop"].video.images) == 4
    assert not (out / "index.json").exists()
    # the rest of them would only take time: finish with the plan cut to those that are there and one more
    kept = [entry for entry in entries if (out / entry["name"]).is_dir()] + [next(e for e in entries if not (out / e["name"]).is_dir())]
    plan = json.loads((out / "plan.json").read_text())
    (out / "plan.json").write_text(json.dumps({**plan, "scenes": kept}))
    paths = make(out, kept)
    assert len(paths) == len(done) + 1 and (out / "index.json").is_file()
    assert contents(paths[-1] / "drop").keys() == contents(ball / "drop").keys()
    assert not list(out.glob(".Ball*"))
    shutil.rmtree(out)


@pytest.mark.parametrize("name", LISTS)
def test_lists_of_scenes(name, request):
    import neuido

    content = read_yaml(neuido.configs_root() / "scenes" / f"{name}.yaml")
    root = None if name.endswith("small") else request.getfixturevalue("data_root")
    film = Film(**{key: tuple(value) if isinstance(value, list) else value for key, value in content["film"].items()})
    plans = [plan_scene(entry, film, data_root=root) for entry in content["scenes"]]
    assert len(plans) == (6 if name.startswith("six") else 10)
    assert len({plan.name for plan in plans}) == len(plans)
    if name.startswith("ten"):
        young = [plan.law["elasticity"]["young"] for plan in plans]
        unseen = [E for plan, E in zip(plans, young) if plan.split == "unseen"]
        assert len(set(young)) == 10 and len(unseen) == 2
        assert min(young) < min(unseen) and max(unseen) < max(young) and max(unseen) / min(unseen) >= 2
        assert {plan.law["elasticity"]["law"] for plan in plans} == {"fixed_corotated"}
    else:
        assert {plan.law["plasticity"]["law"] for plan in plans} == {"identity", "von_mises", "drucker_prager"}


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"name": "../x"}, "name must consist of letters"),
        ({"base": "bouncy-bull"}, "base = 'bouncy-bull' is unknown"),
        ({"colour": 1}, "unknown key 'colour'"),
        ({"split": "test"}, "split = 'test'"),
        ({"substeps": 0}, "substeps must be"),
        ({"shift": [0, 0.6, 0]}, "outside scene.domain"),
        ({"velocity": [0, 0]}, "velocity must be three numbers"),
        ({"discretisation": {"grid": 16, "dt": 0.05}}, "dt is 0.05"),
        ({"model": {"density": 1000.0, "elasticity": {"law": "fixed_corotated", "young": -1.0, "poisson": 0.3}}}, "young"),
    ],
)
def test_errors(change, words):
    with pytest.raises(UserError, match=words):
        plan_scene({**BALL, **change}, FILM)


def test_film_errors_and_mixed_options(tmp_path):
    with pytest.raises(UserError, match=r"film\.held_out"):
        make(tmp_path, film=replace(FILM, held_out=(0, 1, 2, 3)))
    with pytest.raises(UserError, match=r"film\.frames"):
        make(tmp_path, film=replace(FILM, frames=0))
    assert not list(tmp_path.iterdir())


def test_velocity_of_a_body_is_read_off():
    given = {key: value for key, value in BALL.items() if "velocity" not in key}
    given["body"] = {**BALL["body"], "velocity": [0.0, -1.0, 0.5], "angular_velocity": [1.0, 0.0, -2.0]}
    plan = plan_scene(given, FILM)
    assert plan.motion.velocity == pytest.approx((0.0, -1.0, 0.5), abs=1e-5)
    assert plan.motion.angular_velocity == pytest.approx((1.0, 0.0, -2.0), abs=1e-5)
    torch.testing.assert_close(plan.body.v, scenes.body_from_dict(given["body"], None).v, rtol=0, atol=1e-4)


def test_preview(ball):
    image = cv2.imread(str(ball / "preview.png"))
    assert image.shape == (320, 1280, 3) and (image.reshape(-1, 3).min(1) < 128).mean() > 0.02


def test_the_declared_model_may_have_its_former_name():
    model = {**BALL["model"], "plasticity": {"law": "identity"}}
    plans = [plan_scene({**BALL, name: model}, FILM) for name in ("declared", "belief")]
    assert plans[0].declared == plans[1].declared == scenes.model_from_dict(model) != plan_scene(BALL, FILM).declared
    with pytest.raises(UserError, match="are both given"):
        plan_scene({**BALL, "declared": model, "belief": model}, FILM)
