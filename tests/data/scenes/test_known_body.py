"""Filmed experiments whose body is known need no reconstruction."""

import numpy as np
import pytest
import torch

from neuido.data.bodies.scene_files import VARIABLE
from neuido.data.scenes.filmed_scene_module import VisualDataModule
from neuido.data.scenes.known_body import crop_images, load_known_body
from neuido.errors import UserError
from neuido.models.inference.pipeline import render_motion
from neuido.models.inference.prepared_scene import prepare
from neuido.models.scoring.motion_scores import intersection_over_union
from neuido.types import ParticleState
from tests.data.samples import Sample, experiment


@pytest.fixture
def folder(tmp_path):
    return experiment(tmp_path / "soft-cube", Sample())


def test_body_images_and_scene(folder):
    scene = load_known_body(folder, dt=2.5e-4)
    assert scene.name == "soft-cube" and scene.scene.dt == 2.5e-4 and scene.scene.clamps
    assert len(scene.body.x) == 125 and torch.all(scene.body.v == 0.1)
    assert scene.gaussians is None and scene.truth is None and scene.density == 1000.0
    assert scene.batch.images.shape[:2] == scene.batch.masks.shape[:2]


def test_a_crop_moves_the_camera(folder):
    batch = load_known_body(folder).batch
    part = crop_images(batch, [3, 5, 20, 15])
    assert part.images.shape[2:] == (10, 17, 3) and (part.cameras.width, part.cameras.height) == (17, 10)
    assert torch.equal(part.images, batch.images[:, :, 5:15, 3:20]) and torch.equal(part.masks, batch.masks[:, :, 5:15, 3:20])
    assert torch.allclose(batch.cameras.Ks[:, :2, 2] - part.cameras.Ks[:, :2, 2], torch.tensor([3.0, 5.0]).to(part.cameras.Ks))
    assert torch.equal(part.cameras.viewmats, batch.cameras.viewmats)


def test_particles_cover_what_the_body_covers(folder):
    """The drawn silhouette of a cube of particles against the same cube finely sampled, cut out of the image or not."""
    source = load_known_body(folder)
    prepared = prepare(source, None)
    state = prepared.simulator.state
    alphas = render_motion(prepared, ParticleState(*(t[None] for t in state)), [0])[1][0]
    part = prepare(
        source._replace(batch=crop_images(source.batch, [2, 4, source.batch.images.shape[3], source.batch.images.shape[2]])), None
    )
    again = render_motion(part, ParticleState(*(t[None] for t in state)), [0])[1][0]
    assert torch.allclose(again, alphas[:, 4:, 2:], atol=1e-4)
    side = float(source.body.volume.mean()) ** (1 / 3)
    lower, upper = source.body.x.amin(0) - side / 2, source.body.x.amax(0) + side / 2
    axes = [torch.linspace(float(a), float(b), 60) for a, b in zip(lower, upper)]
    grid = torch.stack(torch.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    camera = prepared.views([0])
    seen = grid @ camera.viewmats[0, :3, :3].T + camera.viewmats[0, :3, 3]
    pixels = (seen @ camera.Ks[0].T)[:, :2] / seen[:, 2:]
    mask = torch.zeros(camera.height, camera.width)
    inside = (pixels >= 0).all(1) & (pixels[:, 0] < camera.width) & (pixels[:, 1] < camera.height)
    mask[pixels[inside, 1].long(), pixels[inside, 0].long()] = 1.0
    assert float(intersection_over_union(alphas, mask[None])) > 0.85


def test_the_data_module_finds_it(folder, monkeypatch):
    given = {"path": folder.name, "body": "particles", "dt": 2.5e-4, "crop": [0, 0, 8, 8]}
    monkeypatch.setenv(VARIABLE, str(folder.parent))
    (scene,) = VisualDataModule([given]).scenes
    assert scene.scene.dt == 2.5e-4 and scene.batch.images.shape[2:4] == (8, 8)
    (scene,) = VisualDataModule([given], root=str(folder.parent)).scenes
    monkeypatch.delenv(VARIABLE)
    with pytest.raises(UserError, match="soft-cube"):
        _ = VisualDataModule([given]).scenes


@pytest.mark.parametrize(
    ("options", "word"),
    [
        ({"recording": "loaded"}, "transforms.json"),
        ({"recording": "none"}, "none"),
        ({"dt": -1.0}, "dt"),
        ({"crop": [0, 0, 5000, 8]}, "crop"),
        ({"crop": [4, 0, 4, 8]}, "crop"),
        ({"crop": [0, 0, 8]}, "crop"),
        ({"crop": [0, 0, 8.5, 8]}, "crop"),
    ],
)
def test_impossible_options_are_named(folder, options, word):
    with pytest.raises(UserError, match=word):
        load_known_body(folder, **options)


def test_a_body_that_is_missing_is_named(folder):
    (folder / "drop" / "particles.npz").unlink()
    with pytest.raises(UserError, match=r"particles\.npz"):
        load_known_body(folder)


@pytest.mark.parametrize(("key", "value"), [("body", "mesh"), ("reconstruction", "x"), ("colour", "red")])
def test_wrong_keys_are_named(folder, key, value):
    given = {"path": str(folder), "body": "particles", key: value}
    with pytest.raises(UserError, match=key):
        _ = VisualDataModule([given]).scenes


def test_the_silicone_video():
    from neuido.data.bodies.scene_files import data_root

    try:
        folder = data_root() / "measured" / "silicone-video"
    except UserError:
        pytest.skip("NEUIDO_DATA is not set")
    if not folder.is_dir():
        pytest.skip(f"{folder} is missing")
    prepared = prepare(load_known_body(folder, dt=1.2e-4, crop=[120, 90, 298, 330]), None)
    assert prepared.frames == 13 and prepared.recorded_frames[0] == 0 and len(prepared.recorded_frames) == 13
    times = np.array(prepared.recorded_frames) * prepared.every * 1.2e-4
    assert np.abs(times - prepared.source.batch.times.numpy()).max() < 4e-4
    alphas = render_motion(prepared, ParticleState(*(t[None] for t in prepared.simulator.state)), [0])[1][:, 0]
    assert float(intersection_over_union(alphas, prepared.silhouettes([0], 1)[:, 0])) > 0.93  # what the given start covers of frame 0
