"""From the outline of a deforming body in one video to a diagnosis."""

import cv2
import numpy as np
import pytest
import torch

import neuido
from neuido.data.footage.filming import Filming
from neuido.data.footage.moving_object import DIAMETER_ERROR
from neuido.data.importers import filmed_body
from neuido.data.measured.experiment import read_experiment
from neuido.errors import UserError
from tests.command import run
from tests.data.footage import drawn

MATERIAL = {"kind": "body", "scale": drawn.SCALE, "density": 1000.0, "young": 5e4}
RADIUS = drawn.SCALE * 15.0  # m


@pytest.fixture(scope="module")
def ball(tmp_path_factory):
    """A video of a ball with a radius of 15 px in flight, and its true places."""
    path = tmp_path_factory.mktemp("ball") / "ball.mp4"
    x = drawn.flight(np.arange(16) / 60, v0=(2.5, 2.0), x0=(0.5, 0.8))
    drawn.film(path, (drawn.ball(drawn.scenery(), centre, 15.0) for centre in drawn.pixels(x)))
    return path, x


def test_a_ball_is_a_body_of_revolution(ball, tmp_path):
    path, x = ball
    said = neuido.import_file(path, tmp_path / "out", floor=0.1, **MATERIAL)
    assert any("16 frames, 16 with the object" in line and "revolution" in line for line in said) and any(
        "line of sight" in s for s in said
    )
    (found,) = read_experiment(tmp_path / "out").recordings
    assert found.x is None and found.body is not None and found.video is not None
    assert float(found.body.volume.sum()) == pytest.approx(4 / 3 * np.pi * RADIUS**3, rel=1.5 * DIAMETER_ERROR / 15)
    np.testing.assert_allclose(found.body.x.mean(0), [*x[0], 0.0], atol=0.3 * drawn.SCALE)
    reach = (found.body.x - found.body.x.mean(0)).norm(dim=1).max()
    assert 0.8 * RADIUS < float(reach) < 1.1 * RADIUS
    pixels, _ = neuido.data.cameras.project(found.body.x, found.video.cameras)
    np.testing.assert_allclose(pixels[0].mean(0), drawn.pixels(x[:1])[0], atol=0.3)
    assert torch.allclose(pixels[0, :, 0] * drawn.SCALE, found.body.x[:, 0], atol=0.01 * drawn.SCALE + 0.002)
    (floor,) = found.scene.colliders
    assert floor.point[1] == 0.1


def test_a_thickness_makes_a_slab(ball, tmp_path):
    from neuido.data.importers.machines.testing_machine import Specimen

    neuido.import_file(ball[0], tmp_path / "out", specimen=Specimen(thickness="40 mm"), **MATERIAL)
    body = read_experiment(tmp_path / "out").recordings[0].body
    assert float(body.volume.sum()) == pytest.approx(np.pi * RADIUS**2 * 0.04, rel=1.3 * DIAMETER_ERROR / 15)
    assert float(np.ptp(body.x[:, 2])) < 0.04


def bar(i: int, background: np.ndarray) -> np.ndarray:
    """Draw an oblique bar that falls."""
    out = background.copy()
    for k in range(40):
        out = drawn.ball(out, (100 + k, 60 + k + 3 * i), 5.0)
    return out


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ({"scale": None}, "needs its scale: give --scale"),
        ({"scale": 0.0}, "--scale must be above 0"),
        ({"density": None}, "give --density"),
        ({"point": "mean"}, "--point is for"),
        ({"filming": Filming(start=0.21)}, "frames lie between --start and --end; a diagnosis needs at least 4"),
    ],
)
def test_what_is_missing_is_one_line(ball, tmp_path, options, match):
    with pytest.raises(UserError, match=match):
        neuido.import_file(ball[0], tmp_path / "out", **(MATERIAL | options))
    assert not (tmp_path / "out").exists()


def test_outlines_that_tell_no_body(tmp_path):
    drawn.film(tmp_path / "bar.mp4", (bar(i, drawn.scenery()) for i in range(12)))
    with pytest.raises(UserError, match=r"overlaps with its mirror image by \d+%.*--thickness"):
        neuido.import_file(tmp_path / "bar.mp4", tmp_path / "out", **MATERIAL)
    x = drawn.flight(np.arange(16) / 60, v0=(2.5, 2.0), x0=(0.0, 0.8))
    drawn.film(tmp_path / "late.mp4", (drawn.ball(drawn.scenery(), centre, 15.0) for centre in drawn.pixels(x)))
    with pytest.raises(UserError, match="the body is cut by the border in the first frame"):
        neuido.import_file(tmp_path / "late.mp4", tmp_path / "out", **MATERIAL)
    drawn.film(tmp_path / "still.mp4", (drawn.ball(drawn.scenery(), (100.0, 100.0), 15.0) for _ in range(8)))
    with pytest.raises(UserError, match="the body is not found in the first frame"):
        neuido.import_file(tmp_path / "still.mp4", tmp_path / "out", **MATERIAL)


def filmed_slab(path, effects: dict[str, float]) -> None:
    """Film a soft slab that is thrown through air, from the side: 160 x 120 px of 1 cm, 16 frames, one every 24 ms."""
    from neuido.data.scenes.synthetic import surround_with_gaussians
    from neuido.models.render.splatting import rasterize
    from neuido.physics.effects.parameters import Effects
    from neuido.physics.laws.classical import material
    from neuido.physics.mpm.simulator import Simulator
    from neuido.types import Body, Scene

    n = 7
    grid = 0.04 * (np.stack(np.meshgrid(*[np.arange(n)] * 3, indexing="ij"), -1).reshape(-1, 3) - 3.0)
    x = torch.from_numpy(grid + np.array([0.35, 0.85, 0.0])).float()
    body = Body(x, torch.tensor([1.6, 0.6, 0.0]).expand_as(x).contiguous(), torch.full((len(x),), 0.04**3))
    scene = Scene(lower=(0.0, 0.0, -0.6), upper=(1.6, 1.2, 0.6), cells=20, dt=1e-3, gravity=(0.0, -9.81, 0.0))
    simulator = Simulator(scene, body, density=1000.0, device="cpu")
    laws = material({"law": "fixed_corotated", "young": 6e4, "poisson": 0.3}, {"law": "identity"})
    with torch.no_grad():
        out = simulator.rollout(24 * 15, *laws, every=24, effects=Effects.of(effects))
    dense = surround_with_gaussians(body, 27, seed="slab")
    means, covariances = dense.at(out.x, out.F)
    alphas = rasterize(means, covariances, torch.full((means.shape[1],), 0.9), dense.colour, *filmed_body._camera(160, 120, 0.01))[1][:, 0]
    background, colour = drawn.scenery(size=(160, 120)), np.array([240, 235, 20], np.float32)
    frames = (background * (1 - a) + colour * a for a in alphas.numpy()[..., None])
    drawn.film(path, frames, times=[0.024 * i for i in range(16)])
    cv2.imwrite(str(path.with_suffix(".png")), background[..., ::-1].round().astype(np.uint8))


@pytest.mark.slow
def test_from_a_video_of_a_body_to_the_missing_effect(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(filmed_body, "PARTICLES", 150)  # so that it is quick
    filmed_slab(tmp_path / "slab.mp4", {"drag_linear.k": 3.0})
    options = ["--kind", "body", "--scale", "0.01", "--thickness", "280 mm", "--density", "1000", "--young", "5e4"]
    status, _, err = run(capsys, "import", tmp_path / "slab.mp4", *options, "--out", tmp_path / "slab")
    assert status == 2 and "outlines differ in area by a factor of" in err  # the slab covers what is behind it in half of the frames
    options += ["--background", str(tmp_path / "slab.png")]
    assert run(capsys, "import", tmp_path / "slab.mp4", *options, "--out", tmp_path / "slab")[0] == 0
    status, out, err = run(capsys, "check", tmp_path / "slab")
    assert status == 0 and "plausible" in out, err
    few = ["--effects", "drag_linear,viscosity_shear", "--draws", "19", "--solver", "material_points", "--max_effects", "1"]
    status, out, err = run(capsys, "diagnose", tmp_path / "slab", "--out", tmp_path / "answer", "--device", "cpu", *few)
    assert status == 0, err
    assert "The model lacks linear air drag" in out and "tells nothing of the line of sight" in out
    (effect,) = neuido.Diagnosis.read(tmp_path / "answer").effects
    assert effect.name == "drag_linear" and effect.parameters["k"].value == pytest.approx(3.0, rel=0.1)


def test_a_fall_tells_the_scale_and_a_held_start(ball, tmp_path):
    path, _ = ball
    with pytest.raises(UserError, match=r"1e\+03 times model.gravity: the unit is not metres; .*--scale"):
        neuido.import_file(path, tmp_path / "out", **{**MATERIAL, "scale": 1e3 * drawn.SCALE})
    times = np.maximum(np.arange(60) / 60 - 0.1, 0.0)
    held = tmp_path / "held.mp4"
    places = drawn.pixels(drawn.flight(times, v0=(0.4, 0.0), x0=(0.5, 0.9)))
    drawn.film(held, (drawn.ball(drawn.scenery(), centre, 15.0) for centre in places))
    said = neuido.import_file(held, tmp_path / "held", **MATERIAL)
    (line,) = (line for line in said if "held at first" in line)
    assert 0.1 <= float(line.rpartition(" ")[2]) < 0.17
    said = neuido.import_file(held, tmp_path / "later", filming=Filming(start=float(line.rpartition(" ")[2])), **MATERIAL)
    assert not any("held at first" in line for line in said)
