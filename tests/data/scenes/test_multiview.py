import cv2
import numpy as np
import pytest
import torch
from lightning.pytorch import LightningModule, Trainer

from neuido.data.cameras import project
from neuido.data.formats import nerfstudio
from neuido.data.scenes.multiview import MultiViewDataModule, MultiViewDataset, SceneViews
from neuido.data.scenes.readers import read_recording
from neuido.errors import UserError
from neuido.types import Cameras, MultiViewBatch
from tests.data import samples

S = samples.Sample()
TRUTH = S.images / 255


@pytest.fixture
def found(tmp_path):
    return read_recording(samples.nerfstudio(tmp_path / "a", S))


def composed(background: float) -> np.ndarray:
    return TRUTH[..., :3] * TRUTH[..., 3:] + background * (1 - TRUTH[..., 3:])


@pytest.mark.parametrize(("background", "value"), [("white", 1.0), ("black", 0.0)])
def test_background_and_colour_order(found, background, value):
    images, masks = SceneViews(found, background=background).load(range(3))
    assert images.dtype == torch.float32 and images.shape == (3, 4, samples.HEIGHT, samples.WIDTH, 3)
    np.testing.assert_allclose(images, composed(value), atol=1e-6)
    np.testing.assert_allclose(masks, TRUTH[..., 3], atol=1e-6)
    plain, _ = SceneViews(found, background=background, masked=False).load(range(3))
    np.testing.assert_allclose(plain, TRUTH[..., :3], atol=1e-6)


def test_half_transparent_pixels_are_not_premultiplied_in_files(tmp_path):
    one = samples.Sample()
    rgba = np.full((samples.HEIGHT, samples.WIDTH, 4), [200, 100, 50, 51], np.uint8)
    samples.nerfstudio(tmp_path, one)
    samples.png(tmp_path / "images" / "0_000.png", rgba)
    images, masks = SceneViews(read_recording(tmp_path), background="white").load([0], [0])
    np.testing.assert_allclose(images[0, 0, 3, 3], 0.2 * np.array([200, 100, 50]) / 255 + 0.8, atol=0.5 / 255 + 1e-6)
    assert float(masks[0, 0, 3, 3]) == pytest.approx(0.2)


def test_frames_and_views(found):
    scene = SceneViews(found, frame_start=1, frame_step=2, views=["2", "0"], held_out_views=["0"])
    assert scene.frames == [1, 3] and scene.views == ["2", "0"] and scene.held_out == [False, True]
    np.testing.assert_allclose(scene.times, [0, 0.04])
    images, _ = scene.load(range(2))
    np.testing.assert_allclose(images, composed(1.0)[[2, 0]][:, [1, 3]], atol=1e-6)
    np.testing.assert_allclose(scene.cameras.viewmats, S.w2c[[2, 0]], atol=1e-6)
    assert SceneViews(found, frame_count=2).frames == [0, 1]


def test_resize_scales_the_intrinsics(found):
    scene = SceneViews(found, width=12, background="black")
    assert (scene.cameras.width, scene.cameras.height) == (12, 8)
    images, masks = scene.load(range(3))
    blocks = composed(0.0).reshape(3, 4, 8, 2, 12, 2, 3).mean(axis=(3, 5))
    np.testing.assert_allclose(images, blocks, atol=0.51 / 255)
    np.testing.assert_allclose(masks, TRUTH[..., 3].reshape(3, 4, 8, 2, 12, 2).mean(axis=(3, 5)), atol=0.51 / 255)
    seen, _ = project(torch.tensor(samples.POINT)[None], scene.cameras)
    np.testing.assert_allclose(seen[:, 0], S.pixels() / 2, atol=1e-4)
    bigger = SceneViews(found, width=48)
    assert bigger.load([0], [0])[0].shape == (1, 1, 32, 48, 3)


def test_moved_world(found):
    scene = SceneViews(found, up="z", scale=0.5, shift=(0.1, 0.2, 0.3))
    x, y, z = samples.POINT
    seen, _ = project(torch.tensor([[0.5 * x + 0.1, 0.5 * z + 0.2, -0.5 * y + 0.3]]).double(), scene.cameras)
    np.testing.assert_allclose(seen[:, 0], S.pixels(), atol=1e-3)


def test_images_are_read_when_wanted(found, monkeypatch):
    asked = []
    plain = cv2.imread
    monkeypatch.setattr(cv2, "imread", lambda path, *rest: asked.append(path) or plain(path, *rest))
    scene = SceneViews(found)
    assert asked == []
    scene.load([1], [2])
    assert [path.rsplit("/", 1)[1] for path in asked] == ["1_002.png"]
    scene.load([1], [2, 3])
    assert len(asked) == 2
    free = SceneViews(found, cache=False)
    assert torch.equal(free.load([1], [2])[0], scene.load([1], [2])[0]) and torch.equal(free.load([1], [2])[0], free.load([1], [2])[0])
    assert len(asked) == 5


def test_mask_from_the_empty_scene(tmp_path):
    images, masks = SceneViews(read_recording(samples.pacnerf(tmp_path, S)), background="black").load(range(3))
    truth = TRUTH[..., 3]
    both, either = (masks.numpy() * truth).sum(), np.maximum(masks.numpy(), truth).sum()
    assert both / either > 0.9  # a rough mask, on a blob of some 70 pixels
    assert float(images[masks == 0].max()) == 0


def test_undistortion(tmp_path):
    """A grid of dots, drawn where a distorting lens sees it, comes out where the pinhole sees it."""
    width, height, K = 160, 120, np.array([[120.0, 0, 83.0], [0, 118.0, 58.0], [0, 0, 1]])
    lens = np.array([-0.25, 0.08, 0.002, -0.003, 0.0])
    rays = np.array([[x, y, 1.0] for x in (-0.45, 0.0, 0.4) for y in (-0.3, 0.05, 0.3)])
    ideal = rays[:, :2] * K[[0, 1], [0, 1]] + K[:2, 2]
    bent = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), K, lens)[0][:, 0]
    assert np.abs(bent - ideal).max() > 2
    rows, columns = np.mgrid[:height, :width] + 0.5  # pixel centres
    image = sum(np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / 8) for x, y in bent)
    picture = np.tile(np.rint(255 * image)[..., None], 3).astype(np.uint8)
    cameras = Cameras(torch.eye(4)[None], torch.from_numpy(K).float()[None], width, height)
    nerfstudio.write(tmp_path, cameras, torch.zeros(1), [[picture]])
    file = tmp_path / "transforms.json"
    keys = ", ".join(f'"{key}": {value}' for key, value in zip(("k1", "k2", "p1", "p2", "k3"), lens))
    file.write_text(file.read_text().replace('"camera_model"', keys + ', "camera_model"', 1))
    out = SceneViews(read_recording(tmp_path), background="black").load([0])[0][0, 0, ..., 0].numpy()
    for x, y in ideal:
        window = np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / 40) * out
        centre = np.array([(window * columns).sum(), (window * rows).sum()]) / window.sum()
        np.testing.assert_allclose(centre, [x, y], atol=0.1)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"background": "grey"}, "background = 'grey'"),
        ({"up": "x"}, "up = 'x'"),
        ({"frame_start": 4}, "has 4 frames"),
        ({"frame_count": 5}, "leave 4, fewer than frame_count = 5"),
        ({"frame_count": 0}, "frame_count must be at least 1"),
        ({"frame_step": 0}, "frame_step must be at least 1"),
        ({"views": ["7"]}, "views has the unknown view '7'"),
        ({"views": ["1", "1"]}, "lists a view twice"),
        ({"held_out_views": ["d_0"]}, "held_out_views has the unknown view 'd_0'"),
        ({"width": 0}, "width must be at least 1"),
        ({"scale": "much"}, "scale must be a finite number"),
        ({"shift": [1, 2]}, "shift must have the shape"),
    ],
)
def test_options_that_do_not_fit(found, options, message):
    with pytest.raises(UserError, match=message):
        SceneViews(found, **options)


def test_a_view_with_a_hole(tmp_path):
    folder = samples.nerfstudio(tmp_path, S)
    file = folder / "transforms.json"
    file.write_text(file.read_text().replace('"time": 0.02, "view": 1', '"time": 0.03, "view": 1'))
    with pytest.raises(UserError, match=r"view 0 has no image at 0\.03 s"):
        SceneViews(read_recording(folder))


def test_dataset_parts(tmp_path):
    scene = SceneViews(read_recording(samples.blender(tmp_path, S)))
    sizes = {part: len(MultiViewDataset([scene], part)[0].images) for part in ("train", "held_out", "all")}
    assert sizes == {"train": 2, "held_out": 1, "all": 3}
    batch = MultiViewDataset([scene], "all", first=5)[0]
    assert batch.scene == 5 and batch.held_out.tolist() == [False, False, True] and batch.background.tolist() == [1, 1, 1]
    held_out = MultiViewDataset([scene], "held_out")[0]
    np.testing.assert_allclose(held_out.images, composed(1.0)[2:], atol=1e-6)
    np.testing.assert_allclose(held_out.cameras.viewmats, S.w2c[2:], atol=1e-6)
    whole = SceneViews(read_recording(samples.nerfstudio(tmp_path / "b", S)))
    assert len(MultiViewDataset([whole], "held_out")[0].images) == 3


class Seen(LightningModule):
    def __init__(self):
        super().__init__()
        self.weight = torch.nn.Parameter(torch.zeros(1))
        self.order: list[tuple[int, int, str]] = []
        self.scored: list[tuple[str, int, int]] = []

    def training_step(self, batch: MultiViewBatch, index: int):
        assert isinstance(batch, MultiViewBatch) and isinstance(batch.cameras, Cameras)
        self.order.append((self.current_epoch, batch.scene, batch.name))
        return (batch.images.mean() - self.weight).square().sum()

    def validation_step(self, batch, index):
        self.scored.append(("val", batch.scene, len(batch.images)))

    def test_step(self, batch, index):
        self.scored.append(("test", batch.scene, len(batch.images)))

    def configure_optimizers(self):
        return torch.optim.SGD(self.parameters(), lr=0.1)


def trained(data, tmp_path, epochs=3, **options) -> tuple[Seen, Trainer]:
    model = Seen()
    trainer = Trainer(
        max_epochs=epochs, accelerator="cpu", logger=False, enable_checkpointing=False, enable_progress_bar=False,
        enable_model_summary=False, num_sanity_val_steps=0, default_root_dir=tmp_path, **options,
    )  # fmt: skip
    trainer.fit(model, data)
    return model, trainer


@pytest.mark.filterwarnings("ignore:.*does not have many workers.*")
def test_datamodule_with_a_trainer(tmp_path):
    scenes = [str(samples.nerfstudio(tmp_path / name, S)) for name in ("a", "b", "c")]
    unseen = samples.neuma_synthetic(tmp_path / "n", S)

    def data(**options) -> MultiViewDataModule:
        given = [{"path": scenes[0], "held_out_views": [1]}, *scenes[1:]]
        return MultiViewDataModule(given, unseen=[{"path": str(unseen), "frame_interval": 0.02}], frame_count=2, width=12, **options)

    model, trainer = trained(data(), tmp_path)
    orders = [[scene for e, scene, _ in model.order if e == epoch] for epoch in range(3)]
    assert all(sorted(order) == [0, 1, 2] for order in orders) and len({tuple(order) for order in orders}) > 1
    assert {(scene, name) for _, scene, name in model.order} == {(0, "a"), (1, "b"), (2, "c")}
    assert model.scored[:3] == [("val", 0, 1), ("val", 1, 3), ("val", 2, 3)]
    model.scored.clear()
    trainer.test(model, data(), verbose=False)
    assert model.scored == [("test", 0, 3), ("test", 1, 3), ("test", 2, 3), ("test", 3, 3)]
    assert trained(data(), tmp_path)[0].order == model.order
    assert trained(data(seed=4), tmp_path)[0].order != model.order


@pytest.mark.parametrize(
    ("scenes", "message"),
    [
        ([], "scenes is empty"),
        ([{"format": "auto"}], r"scenes\[0\] lacks the key 'path'"),
        ([{"path": "{a}", "colour": 1}], r"unknown key 'colour' in scenes\[0\]"),
        (["{a}", "{a}/none"], r"scenes\[1\]: the folder .* is missing"),
        ([{"path": "{a}", "held_out_views": ["0", "1", "2"]}], "has no training view"),
    ],
)
def test_datamodule_refuses(tmp_path, scenes, message):
    folder = samples.nerfstudio(tmp_path / "a", S)

    def filled(given):
        if isinstance(given, str):
            return given.replace("{a}", str(folder))
        return {key: filled(value) if key == "path" else value for key, value in given.items()}

    with pytest.raises(UserError, match=message):
        MultiViewDataModule([filled(given) for given in scenes]).setup()
