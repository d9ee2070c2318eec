import json
import shutil
import struct

import cv2
import numpy as np
import pytest
import torch

from neuido.data import cameras as convert
from neuido.data.formats import colmap, nerfstudio, neuma, springgaus
from neuido.data.formats.layout import MultiView
from neuido.data.scenes.multiview import SceneViews
from neuido.data.scenes.readers import FORMATS, read_recording
from neuido.errors import UserError
from tests.data import samples

S = samples.Sample()
EXACT, JPEG = 0, 40  # grey levels; a JPEG of so few pixels and so much colour is rough

CASES = {  # writer, format, options of read_recording, names of the views, held out, interval, colours within, has masks
    "nerfstudio": (samples.nerfstudio, "nerfstudio", {}, ("0", "1", "2"), (), 0.02, EXACT, True),
    "blender": (samples.blender, "nerfstudio", {}, ("0", "1", "2"), (2,), 0.02, EXACT, True),
    "neuma": (samples.neuma_synthetic, "neuma", {"frame_interval": 0.02}, ("d_0", "d_1", "e_0"), (2,), 0.02, EXACT, True),
    "neuma-real": (samples.neuma_real, "neuma", {}, ("r_0", "r_1", "r_2"), (), 1 / 120, JPEG, True),
    "pacnerf": (samples.pacnerf, "pacnerf", {}, ("0", "1", "2"), (), 0.02, EXACT, False),
    "pacnerf-segmented": (
        lambda folder, s: samples.pacnerf(folder, s, segmented=True), "pacnerf", {}, ("0", "1", "2"), (), 0.02, EXACT, True,
    ),
    "springgaus": (samples.springgaus_synthetic, "springgaus", {}, ("cam_0", "cam_1", "cam_2"), (), 0.03, EXACT, True),
    "springgaus-real": (samples.springgaus_real, "springgaus", {}, ("C0733", "C0787", "C0801"), (), 1 / 120, JPEG, True),
    "colmap": (samples.colmap, "colmap", {}, ("IMG_0.png", "IMG_1.png", "IMG_2.png"), (), 0.02, EXACT, False),
    "experiment": (samples.experiment, "experiment", {}, ("0", "1", "2"), (), 0.02, EXACT, True),
}  # fmt: skip


def made(tmp_path, case: str) -> MultiView:
    writer, format, options, *_ = CASES[case]
    return read_recording(writer(tmp_path / case, S), format, **options)


@pytest.mark.parametrize("case", CASES)
def test_sample_of_each_format(tmp_path, case):
    writer, format, options, views, held_out, interval, tolerance, masks = CASES[case]
    found = made(tmp_path, case)
    count = 1 if case == "colmap" else S.frame_count
    assert (found.views, found.held_out, found.format) == (views, held_out, format)
    np.testing.assert_allclose(found.times, interval * np.arange(count), atol=1e-12)
    assert (found.cameras.width, found.cameras.height) == (samples.WIDTH, samples.HEIGHT)
    np.testing.assert_allclose(found.cameras.viewmats, S.w2c, atol=1e-6)
    np.testing.assert_allclose(found.cameras.Ks, np.tile(S.K, (3, 1, 1)), atol=1e-4)
    seen, _ = convert.project(torch.tensor(samples.POINT)[None], found.cameras)
    np.testing.assert_allclose(seen[:, 0], S.pixels(), atol=1e-4)

    images, alpha = SceneViews(found, background="black", masked=masks).load(range(3))
    truth = S.images[:, :count] / 255
    if masks:
        np.testing.assert_allclose(alpha, truth[..., 3], atol=1e-6)
        truth[..., :3] *= truth[..., 3:]
    if case != "pacnerf":  # its images have the room behind the object
        np.testing.assert_allclose(images, truth[..., :3], atol=tolerance / 255 + 1e-6)
    assert images.dtype == alpha.dtype == torch.float32


@pytest.mark.parametrize("case", CASES)
def test_format_is_found(tmp_path, case):
    writer, format, options, *_ = CASES[case]
    assert read_recording(writer(tmp_path / case, S), **options).format == format


def test_unknown_format(tmp_path):
    (tmp_path / "empty").mkdir()
    with pytest.raises(UserError, match=r"format of .* is unknown"):
        read_recording(tmp_path / "empty")
    with pytest.raises(UserError, match="format = 'kitti'"):
        read_recording(tmp_path / "empty", "kitti")
    with pytest.raises(UserError, match=r"folder .* is missing"):
        read_recording(tmp_path / "nowhere")
    assert set(FORMATS) == {"experiment", "pacnerf", "neuma", "springgaus", "nerfstudio", "colmap"}


# What is wrong is one line that names it.


def edit(path, change) -> None:
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


JSON_FILES = {
    "nerfstudio": "transforms.json",
    "blender": "transforms_train.json",
    "neuma": "data_dynamic.json",
    "neuma-real": "cameras_calib.json",
    "pacnerf": "all_data.json",
    "springgaus": "camera.json",
    "springgaus-real": "dynamic/sequences/bun/0.json",
}


@pytest.mark.parametrize("case", JSON_FILES)
@pytest.mark.parametrize("text", ["", "{", "[]", "[1]", "{}", '{"frames": []}', '"frames"', "[[[" * 5000])
def test_malformed_json(tmp_path, case, text):
    made(tmp_path, case)
    (tmp_path / case / JSON_FILES[case]).write_text(text)
    with pytest.raises(UserError) as caught:
        read_recording(tmp_path / case, CASES[case][1], **CASES[case][2])
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 400


FRAMES = {
    "nerfstudio": lambda c: c["frames"][1],
    "blender": lambda c: c["frames"][1],
    "neuma": lambda c: c[1],
    "pacnerf": lambda c: c[2],
}


@pytest.mark.parametrize("case", FRAMES)
@pytest.mark.parametrize(
    "name", ["../secret.png", "/etc/passwd", "images/../../secret.png", "C:\\secret.png", "\\\\host\\a.png", "", 7, None]
)
def test_images_stay_in_the_folder(tmp_path, case, name):
    made(tmp_path, case)
    samples.png(tmp_path / "secret.png", S.images[0, 0])
    edit(tmp_path / case / JSON_FILES[case], lambda c: FRAMES[case](c).update(file_path=name))
    with pytest.raises(UserError, match=r"leaves the folder|must be the path"):
        read_recording(tmp_path / case, CASES[case][1], **CASES[case][2])


def test_a_link_out_of_the_folder(tmp_path):
    made(tmp_path, "nerfstudio")
    samples.png(tmp_path / "secret.png", S.images[0, 0])
    picture = tmp_path / "nerfstudio" / "images" / "0_001.png"
    picture.unlink()
    picture.symlink_to(tmp_path / "secret.png")
    with pytest.raises(UserError, match="leaves the folder"):
        read_recording(tmp_path / "nerfstudio")


def test_names_in_other_files_stay_in_the_folder(tmp_path):
    made(tmp_path, "springgaus")
    edit(tmp_path / "springgaus" / "camera.json", lambda c: c[0].update(camera="../elsewhere"))
    with pytest.raises(UserError, match="leaves the folder"):
        read_recording(tmp_path / "springgaus")
    made(tmp_path, "springgaus-real")
    edit(tmp_path / "springgaus-real" / JSON_FILES["springgaus-real"], lambda c: c["C0787"].__setitem__(0, "../../x.jpg"))
    with pytest.raises(UserError, match="leaves the folder"):
        read_recording(tmp_path / "springgaus-real")
    made(tmp_path, "colmap")
    file = tmp_path / "colmap" / "sparse" / "0" / "images.bin"
    file.write_bytes(file.read_bytes().replace(b"IMG_0.png", b"../0_.png"))
    with pytest.raises(UserError, match="leaves the folder"):
        read_recording(tmp_path / "colmap")


@pytest.mark.parametrize("case", FRAMES)
@pytest.mark.parametrize(
    ("matrix", "message"),
    [
        ([[1, 2], [3, 4]], "must have the shape"),
        ("none", "must contain numbers"),
        ([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, float("nan"), 0]], "NaN"),
        ([[1, 0, 0, 0], [0, 2, 0, 0], [0, 0, 1, 0]], "singular values"),
        ([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, -1, 0]], "reflection"),
        ([[1, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]], "must contain numbers"),
        ([[10**400, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]], "must contain numbers"),
    ],
)
def test_a_wrong_pose(tmp_path, case, matrix, message):
    made(tmp_path, case)
    key = "transform_matrix" if case in ("nerfstudio", "blender") else "c2w"
    edit(tmp_path / case / JSON_FILES[case], lambda c: FRAMES[case](c).update({key: matrix}))
    with pytest.raises(UserError, match=f"{key}.*{message}"):
        read_recording(tmp_path / case, CASES[case][1], **CASES[case][2])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c: c.pop("fl_x"), "neither fl_x nor camera_angle_x"),
        (lambda c: c.update(fl_x=-1), "fl_x must be above 0"),
        (lambda c: c.update(fl_y="wide"), "fl_y must be a finite number"),
        (lambda c: c.update(cx=10**400), "cx must be a finite number, got one beyond the range"),
        (lambda c: c.update(w=0), "w must be at least 1"),
        (
            lambda c: c.update(camera_model="OPENCV_FISHEYE"),
            "camera_model = 'OPENCV_FISHEYE' must be one of PINHOLE, .*: undistort the images",
        ),
        (lambda c: c.pop("frames"), "lacks the key 'frames'"),
        (lambda c: c["frames"][3].pop("file_path"), r"frames\[3\] lacks the key 'file_path'"),
        (lambda c: c["frames"][3].pop("transform_matrix"), r"frames\[3\] lacks the key 'transform_matrix'"),
        (lambda c: c["frames"][3].pop("time"), "1 of 12 frames have no time"),
        (lambda c: c["frames"][3].update(time=-1), "time must be at least 0"),
        (lambda c: c["frames"][3].update(time=0.0), "two images"),
        (lambda c: c["frames"][3].update(view=1.5), "view must be a whole number"),
        (lambda c: c["frames"][3].update(w=32), "images of two sizes"),
        (lambda c: c["frames"][3].update(fl_x=9.0), "the lens of view 0 changes"),
        (lambda c: [frame.pop("time") for frame in c["frames"]], "add `time`"),
        (lambda c: c["frames"][3].update(file_path="images/none.png"), "none.png is missing"),
    ],
)
def test_malformed_transforms(tmp_path, change, message):
    made(tmp_path, "nerfstudio")
    edit(tmp_path / "nerfstudio" / "transforms.json", change)
    with pytest.raises(UserError, match=message):
        read_recording(tmp_path / "nerfstudio")


def test_other_formats_say_what_is_missing(tmp_path):
    made(tmp_path, "neuma")
    with pytest.raises(UserError, match="give frame_interval"):
        read_recording(tmp_path / "neuma")
    ball = samples.neuma_synthetic(tmp_path / "BouncyBall", S)
    assert float(read_recording(ball).times[1]) == 1e-3

    made(tmp_path, "pacnerf")
    edit(tmp_path / "pacnerf" / "all_data.json", lambda c: c.pop())
    with pytest.raises(UserError, match="camera 2 lacks frame 3"):
        read_recording(tmp_path / "pacnerf")
    edit(tmp_path / "pacnerf" / "all_data.json", lambda c: c[3].update(file_path="data/frame.png"))
    with pytest.raises(UserError, match="must have the form"):
        read_recording(tmp_path / "pacnerf")

    made(tmp_path, "neuma-real")
    edit(tmp_path / "neuma-real" / "cameras_calib.json", lambda c: c.pop("r_1"))
    with pytest.raises(UserError, match="lacks the view 'r_1'"):
        read_recording(tmp_path / "neuma-real")
    (tmp_path / "neuma-real" / "sparse" / "0" / "cameras.bin").unlink()
    with pytest.raises(UserError, match=r"cameras.bin is missing"):
        read_recording(tmp_path / "neuma-real")

    made(tmp_path, "springgaus")
    (tmp_path / "springgaus" / "cam_1" / "002.png").unlink()
    with pytest.raises(UserError, match="camera cam_1 lacks frame 2"):
        read_recording(tmp_path / "springgaus")

    real = samples.springgaus_real(tmp_path / "real", S)
    (real / "dynamic" / "videos_masks" / "C0787" / "C0787_101.png").unlink()
    with pytest.raises(UserError, match=r"C0787_101.png is missing"):
        read_recording(real)
    samples.dump(real / "dynamic" / "sequences" / "dog" / "1.json", {"C0733": ["a.jpg"]})
    with pytest.raises(UserError, match="choose from bun/0, dog/1"):
        read_recording(real)


@pytest.mark.parametrize("file", ["cameras.bin", "images.bin"])
def test_colmap_cut_short_anywhere(tmp_path, file):
    made(tmp_path, "colmap")
    path = tmp_path / "colmap" / "sparse" / "0" / file
    whole = path.read_bytes()
    for length in range(0, len(whole), 7):
        path.write_bytes(whole[:length])
        with pytest.raises(UserError, match="truncated"):
            read_recording(tmp_path / "colmap")


def test_colmap_with_what_it_cannot_mean(tmp_path):
    made(tmp_path, "colmap")
    cameras = tmp_path / "colmap" / "sparse" / "0" / "cameras.bin"
    cameras.write_bytes(struct.pack("<QiiQQ", 1, 1, 5, 24, 16) + struct.pack("<8d", *8 * [1.0]))
    with pytest.raises(UserError, match="not a pinhole"):
        read_recording(tmp_path / "colmap")
    cameras.write_bytes(struct.pack("<QiiQQ8d", 1, 1, 4, 24, 16, 30, 31, 12, 8, 0.1, 0.2, 0.3, 0.4))
    found = read_recording(tmp_path / "colmap")
    assert found.distortion is not None and found.distortion[0].tolist() == [0.1, 0.2, 0.3, 0.4, 0.0]
    assert found.cameras.Ks[0].diagonal().tolist() == [30, 31, 1]
    images = tmp_path / "colmap" / "sparse" / "0" / "images.bin"
    images.write_bytes(struct.pack("<Q", 2**60))
    with pytest.raises(UserError, match="truncated"):
        read_recording(tmp_path / "colmap")


# What a format can do besides.


def test_transforms_without_view_are_grouped_by_pose(tmp_path):
    made(tmp_path, "nerfstudio")
    file = tmp_path / "nerfstudio" / "transforms.json"
    edit(file, lambda c: [frame.pop("view") for frame in c["frames"]])
    assert [len(row) for row in read_recording(file).images] == [4, 4, 4]
    edit(file, lambda c: [frame.pop("time") for frame in c["frames"]])
    found = read_recording(file, frame_interval=0.5)
    assert found.times.tolist() == [0, 0.5, 1.0, 1.5] and found.images[1][2].name == "1_002.png"
    edit(file, lambda c: c.update(frames=c["frames"][::4]))
    assert len(read_recording(file).times) == 1 and len(read_recording(file).views) == 3


def test_monocular_recordings_are_one_camera_that_moves(tmp_path):
    """D-NeRF's: one image for each time, from another pose each."""
    made(tmp_path, "nerfstudio")
    shutil.copytree(tmp_path / "nerfstudio", tmp_path / "nerfstudio-whole")
    file = tmp_path / "nerfstudio" / "transforms.json"
    edit(file, lambda c: c.update(frames=[{k: v for k, v in c["frames"][i].items() if k != "view"} for i in (0, 5, 10)]))
    whole, found = read_recording(tmp_path / "nerfstudio-whole"), read_recording(file)
    assert [path and path.name for path in found.images[0]] == ["0_000.png", "1_001.png", "2_002.png"] and len(found.images) == 1
    torch.testing.assert_close(found.cameras.viewmats[0], whole.cameras.viewmats)
    edit(file, lambda c: [frame.update(view=i) for i, frame in enumerate(c["frames"])])
    found = read_recording(file)
    assert [[path is not None for path in row] for row in found.images] == [[v == t for t in range(3)] for v in range(3)]


def test_full_lens_of_nerfstudio(tmp_path):
    made(tmp_path, "nerfstudio")
    file = tmp_path / "nerfstudio" / "transforms.json"
    edit(file, lambda c: c.update(fl_x=31.0, fl_y=29.0, cx=11.0, cy=9.5, k1=0.1, p2=0.01))
    edit(file, lambda c: c["frames"][-1].update(mask_path="images/0_000.png"))
    found = read_recording(file)
    np.testing.assert_allclose(found.cameras.Ks[1], [[31, 0, 11], [0, 29, 9.5], [0, 0, 1]])
    assert found.distortion is not None and found.distortion[2].tolist() == [0.1, 0, 0, 0.01, 0]
    assert found.masks is not None and found.masks[0][0] is None and found.masks[2][3].name == "0_000.png"


def test_nerfstudio_write_and_read(tmp_path):
    cameras = convert.orbit(3, width=samples.WIDTH, height=samples.HEIGHT, elevations=(10, 50))
    cameras = cameras._replace(Ks=cameras.Ks + torch.tensor([[0, 0, 1.5], [0, 2.0, -0.5], [0, 0, 0]]))
    times = torch.tensor([0.0, 0.035805, 0.068422, 0.1], dtype=torch.float64)
    nerfstudio.write(tmp_path, cameras, times, S.images, views=["0", "3", "12"], held_out=[1])
    found = read_recording(tmp_path)
    assert found.views == ("0", "3", "12") and found.held_out == (1,)
    assert torch.equal(found.times, times)
    torch.testing.assert_close(found.cameras.viewmats, cameras.viewmats, atol=1e-6, rtol=0)
    assert torch.equal(found.cameras.Ks, cameras.Ks)
    images, alpha = SceneViews(found, background="black", masked=False).load(range(3))
    assert np.array_equal(np.rint(255 * images.numpy()), S.images[..., :3]) and np.array_equal(alpha, S.images[..., 3] / 255)
    content = json.loads((tmp_path / "transforms.json").read_text())
    assert {"file_path", "transform_matrix", "time", "view"} <= set(content["frames"][0]) and len(content["test_filenames"]) == 4
    with pytest.raises(UserError, match="whole numbers"):
        nerfstudio.write(tmp_path, cameras, times, S.images, views=["a", "b", "c"])
    with pytest.raises(UserError, match="uint8"):
        nerfstudio.write(tmp_path, cameras, times, S.images / 255)


def test_pacnerf_of_gic(tmp_path):
    folder = samples.pacnerf(tmp_path / "torus", S, segmented=True)
    (folder / "transforms_test.json").write_text("{}")
    found = read_recording(folder)
    assert found.format == "pacnerf" and found.held_out == (0,)
    assert found.images[1][2].name == "a_1_2.png"
    assert [path.name for path in found.backgrounds] == ["r_0_-1.png", "r_1_-1.png", "r_2_-1.png"]


def test_springgaus_stills(tmp_path):
    folder = samples.springgaus_real(tmp_path / "real_capture", S)
    found = springgaus.read_static(folder, "bun")
    assert found.views == ("IMG_0.JPG", "IMG_1.JPG", "IMG_2.JPG") and len(found.times) == 1
    np.testing.assert_allclose(found.cameras.viewmats, S.w2c, atol=1e-6)
    assert found.masks[2][0].name == "IMG_2.png"
    with pytest.raises(UserError, match="leaves the folder"):
        springgaus.read_static(folder, "../../../x")


def test_colmap_sorts_by_name(tmp_path):
    images = colmap.read_images(samples.colmap(tmp_path, S) / "sparse" / "0" / "images.bin")
    assert [image.name for image in images] == ["IMG_0.png", "IMG_1.png", "IMG_2.png"]


def test_neuma_assets(tmp_path):
    x, v = torch.rand(5, 3), torch.tensor([0.0, -1.94, 0.0])
    torch.save({"init_x": x, "init_v": v.expand(5, 3).clone()}, tmp_path / "init.pt")
    weights = torch.tensor([[0, 0.5, 0, 0, 0.5], [0, 0, 0, 0, 0], [0, 0, 0, 1, 0]]).to_sparse()
    bindings = {"bindings_ind": weights.indices(), "bindings_val": weights.values(), "bindings_size": weights.size()}
    torch.save(bindings | {"n_particles": torch.tensor([2, 0, 1])}, tmp_path / "bindings.pt")
    np.savez(tmp_path / "particles.npz", p_x=x.numpy(), vol=np.full(5, 1e-5))
    (tmp_path / "kernels.ply").write_bytes(b"ply\n")
    found = neuma.read_assets(tmp_path)
    assert torch.equal(found.x, x) and torch.equal(found.v, v.expand(5, 3))
    assert torch.equal(found.bindings.to_dense(), weights.to_dense())
    assert torch.equal(found.volume, torch.full((5,), 1e-5)) and found.gaussians == tmp_path / "kernels.ply" and found.particles is None
    assert neuma.read_assets(tmp_path.parent).x is None


class Harmful:
    def __reduce__(self):
        return print, ("run while unpickling",)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("init.pt", {"init_x": torch.rand(5, 3)}, "lacks the entry 'init_v'"),
        ("init.pt", {"init_x": torch.rand(5, 3), "init_v": torch.rand(4, 3)}, r"must be finite \(P, 3\)"),
        ("init.pt", {"init_x": torch.full((5, 3), torch.nan), "init_v": torch.rand(5, 3)}, "must be finite"),
        ("init.pt", {"init_x": Harmful(), "init_v": 0}, "not a torch.save file of tensors"),
        ("init.pt", None, "not a torch.save file of tensors"),
        (
            "bindings.pt",
            {"bindings_ind": torch.tensor([[0], [7]]), "bindings_val": torch.ones(1), "bindings_size": (3, 5)},
            "outside bindings_size",
        ),
        ("bindings.pt", {"bindings_ind": torch.tensor([0]), "bindings_val": torch.ones(1), "bindings_size": (3, 5)}, "do not match"),
    ],
)
def test_malformed_assets(tmp_path, name, content, message):
    if content is None:
        (tmp_path / name).write_bytes(b"no archive")
    else:
        torch.save(content, tmp_path / name)
    with pytest.raises(UserError, match=message):
        neuma.read_assets(tmp_path)


def test_a_broken_image(tmp_path):
    found = made(tmp_path, "nerfstudio")
    (tmp_path / "nerfstudio" / "images" / "1_002.png").write_bytes(b"no image")
    with pytest.raises(UserError, match=r"1_002.png is not an image"):
        SceneViews(found).load([1])
    cv2.imwrite(str(tmp_path / "nerfstudio" / "images" / "1_002.png"), np.zeros((10, 10, 3), np.uint8))
    with pytest.raises(UserError, match="10 x 10 pixels, but its camera has 24 x 16"):
        SceneViews(found).load([1])
