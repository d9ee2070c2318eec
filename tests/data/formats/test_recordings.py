"""Recordings as other tools write them: lenses, layouts, masks, sizes and clocks, from made samples."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from neuido.data import cameras as convert
from neuido.data.files.values import path_inside
from neuido.data.formats import colmap, nerfstudio
from neuido.data.scenes.filmed_scene import load_views
from neuido.data.scenes.multiview import SceneViews
from neuido.data.scenes.readers import read_recording
from neuido.errors import UserError

WIDTH, HEIGHT = 31, 20


def ellipse(width: int = WIDTH, height: int = HEIGHT) -> np.ndarray:
    i, j = np.mgrid[:height, :width]
    return ((i / height - 0.5) ** 2 + (j / width - 0.5) ** 2 < 0.06).astype(np.uint8)


def folder(path: Path, *, views: int = 3, frames: int = 1, root=None, each=lambda v, t: {}, size=lambda v: (WIDTH, HEIGHT)) -> Path:
    """A Nerfstudio recording of a dark object before white."""
    (path / "images").mkdir(parents=True, exist_ok=True)
    entries = []
    for v in range(views):
        pose = convert.to_opengl(convert.look_at((2.0 * np.cos(v), 0.5, 2.0 * np.sin(v)), (0.0, 0.0, 0.0))).tolist()
        for t in range(frames):
            image = np.where(ellipse(*size(v))[..., None] > 0, 60, 255).astype(np.uint8).repeat(3, axis=2)
            cv2.imwrite(str(path / "images" / f"{v}_{t}.png"), image)
            entries.append({"file_path": f"images/{v}_{t}.png", "transform_matrix": pose, **each(v, t)})
    (path / "transforms.json").write_text(json.dumps({"fl_x": 40.0, **(root or {}), "frames": entries}))
    return path


def test_angles_of_view_of_both_sides(tmp_path):
    angles = {"camera_angle_x": 2 * np.arctan(WIDTH / 2 / 25), "camera_angle_y": 2 * np.arctan(HEIGHT / 2 / 35)}
    found = read_recording(folder(tmp_path, each=lambda v, t: angles))  # a frame's angles come before the file's fl_x
    assert torch.allclose(found.cameras.Ks[0], torch.tensor([[25.0, 0, WIDTH / 2], [0, 35.0, HEIGHT / 2], [0, 0, 1]]), atol=1e-4)


@pytest.mark.parametrize("key", ["is_fisheye", "k4", "k5", "s1", "b1"])
@pytest.mark.parametrize("frame", [False, True])
def test_terms_of_lenses_that_are_not_applied(tmp_path, key, frame):
    extra = {key: True if key == "is_fisheye" else 0.3}
    with pytest.raises(UserError, match=rf"frames\[0\].{key} = .*undistort the images first"):
        read_recording(folder(tmp_path, root={} if frame else extra, each=lambda v, t: extra if frame else {}))
    absent = {key: False if key == "is_fisheye" else 0.0}
    assert read_recording(folder(tmp_path, root=absent)).distortion is None


@pytest.mark.parametrize(
    ("key", "value"),
    [("fisheye_crop_radius", 100.0), ("lens", "fisheye"), ("distortion_model", "OPENCV_FISHEYE"), ("projection", "Equirectangular"),
     ("ftheta_p0", 0.1), ("rolling_shutter", [0.0, 0.0, 0.01, 0.0]), ("rolling_shutter", True)],
)  # fmt: skip
@pytest.mark.parametrize("frame", [False, True])
def test_lenses_by_other_keys(tmp_path, key, value, frame):
    with pytest.raises(UserError, match=rf"frames\[0\].{key} = .* not supported"):
        read_recording(folder(tmp_path, root={} if frame else {key: value}, each=lambda v, t: {key: value} if frame else {}))
    absent = {"fisheye_crop_radius": 0, "lens": "pinhole", "rolling_shutter": [0, 0, 0, 0], "distortion_model": "radial"}
    assert len(read_recording(folder(tmp_path, root=absent)).views) == 3


def test_list_of_distortion_parameters(tmp_path):
    found = read_recording(folder(tmp_path, root={"distortion_params": [0.1, 0.2, 0.3, 0.0, 0.4, 0.5]}))
    assert found.distortion[0].tolist() == [0.1, 0.2, 0.4, 0.5, 0.3]
    for values, match in (([0.1, 0, 0, 0.2, 0, 0], "k4 = 0.2"), ([0.1], "shape"), ("x", "must contain numbers")):
        with pytest.raises(UserError, match=match):
            read_recording(folder(tmp_path, root={"distortion_params": values}))
    with pytest.raises(UserError, match="contradicts distortion_params"):
        read_recording(folder(tmp_path, root={"distortion_params": [0.1, 0, 0, 0, 0, 0], "k1": 0.2}))


def test_transposed_matrix(tmp_path):
    path = folder(tmp_path)
    content = json.loads((path / "transforms.json").read_text())
    content["frames"][1]["transform_matrix"] = np.array(content["frames"][1]["transform_matrix"]).T.tolist()
    (path / "transforms.json").write_text(json.dumps(content))
    with pytest.raises(UserError, match=r"frames\[1\].transform_matrix has the last row .*, not 0, 0, 0, 1: .*write it row by row"):
        read_recording(path)


def test_windows_separators_and_byte_order_mark(tmp_path):
    path = folder(tmp_path, each=lambda v, t: {"file_path": f"images\\{v}_{t}.png"})
    (path / "transforms.json").write_bytes(b"\xef\xbb\xbf" + (path / "transforms.json").read_bytes())
    assert [row[0].name for row in read_recording(path).images] == ["0_0.png", "1_0.png", "2_0.png"]
    for name in ("..\\a.png", "C:\\a.png", "\\\\host\\a.png", "images\\..\\..\\a.png"):
        with pytest.raises(UserError, match="leaves the folder"):
            path_inside(path, name, "it")


@pytest.mark.parametrize("width", [4, 7, 13, 29, 31, 45])
def test_any_width(tmp_path, width):
    batch = load_views(folder(tmp_path), width=width)
    assert batch.images.shape == (3, 1, round(HEIGHT * width / WIDTH), width, 3)
    assert batch.masks.mean(dim=(1, 2, 3)).tolist() == pytest.approx([float(ellipse().mean())] * 3, abs=0.03)


def masks_of(name):
    mask = ellipse()
    if name == "palette":
        from PIL import Image

        image = Image.fromarray(mask * 3)
        image.putpalette([0, 0, 0, 9, 9, 9, 9, 9, 9, 128, 0, 0])
        return image
    if name == "alpha":
        return np.dstack([np.full((HEIGHT, WIDTH, 3), 200, np.uint8), 255 * mask])
    return {"ones": mask, "full": 255 * mask, "label": 7 * mask, "wide": 257 * mask.astype(np.uint16) * 255, "deep": mask.astype(np.uint16),
            "colour": np.dstack([0 * mask, 0 * mask, 128 * mask])}[name]  # fmt: skip


@pytest.mark.parametrize("name", ["ones", "full", "label", "wide", "deep", "colour", "palette", "alpha"])
def test_encodings_of_masks(tmp_path, name):
    path = folder(tmp_path, each=lambda v, t: {"mask_path": f"{v}.png"})
    for v in range(3):
        mask = masks_of(name)
        mask.save(path / f"{v}.png") if name == "palette" else cv2.imwrite(str(path / f"{v}.png"), mask)
    _, masks = SceneViews(read_recording(path)).load(range(3))
    assert masks.mean(dim=(1, 2, 3)).tolist() == pytest.approx([float(ellipse().mean())] * 3, abs=1e-6)


def test_labels_of_several_objects_are_no_mask(tmp_path):
    path = folder(tmp_path, each=lambda v, t: {"mask_path": "m.png"})
    cv2.imwrite(str(path / "m.png"), ellipse() + (np.arange(WIDTH) > 20))
    with pytest.raises(UserError, match=r"m.png has the values 0, 1, 2: labels of several objects"):
        SceneViews(read_recording(path)).load([0])


@pytest.mark.parametrize("k1", [-0.3, 0.0, 0.2])
def test_mask_is_found_before_undistortion(tmp_path, k1):
    batch = load_views(folder(tmp_path, root={"k1": k1}))
    assert float(batch.masks.mean()) == pytest.approx(float(ellipse().mean()), rel=0.25)
    assert float(batch.masks[..., 0, :].max()) == float(batch.masks[..., 0].max()) == 0  # no rim counts as the object
    assert batch.background.tolist() == pytest.approx([1.0] * 3)


def test_each_image_has_its_own_way_to_a_mask(tmp_path):
    path = folder(tmp_path, each=lambda v, t: {"mask_path": "m.png"} if v == 0 else {})
    cv2.imwrite(str(path / "m.png"), 255 * ellipse())
    batch = load_views(path)
    assert batch.masks.mean(dim=(1, 2, 3)).tolist() == pytest.approx([float(ellipse().mean())] * 3, abs=0.01)


def test_sizes_that_differ_per_view(tmp_path):
    path = folder(tmp_path, size=lambda v: (WIDTH * (1 + (v == 1)), HEIGHT * (1 + (v == 1))))
    found = read_recording(path)
    assert (found.cameras.width, found.cameras.height) == (WIDTH, HEIGHT)
    assert found.cameras.Ks[:, 0, 0].tolist() == [40.0, 20.0, 40.0]
    masks = load_views(path).masks
    assert masks.mean(dim=(1, 2, 3)).tolist() == pytest.approx([float(ellipse().mean())] * 3, abs=0.01)
    with pytest.raises(UserError, match="crop the images of all views to one aspect ratio"):
        read_recording(folder(tmp_path, size=lambda v: (WIDTH, HEIGHT) if v else (HEIGHT, WIDTH)))


def test_shutters_that_differ_by_milliseconds(tmp_path):
    found = read_recording(folder(tmp_path, frames=4, each=lambda v, t: {"view": v, "time": t / 30 + 0.003 * v}))
    assert [len(row) for row in found.images] == [4, 4, 4] and None not in found.images[2]
    assert torch.allclose(found.times, torch.arange(4).double() / 30 + 0.003, atol=1e-9)


def model(path: Path, lines: str, *, names=("a.png", "b.png"), place: str = "sparse") -> Path:
    (path / "images").mkdir(parents=True)
    (path / place).mkdir(parents=True, exist_ok=True)
    for name in names:
        cv2.imwrite(str(path / "images" / name), np.where(ellipse()[..., None] > 0, 60, 255).astype(np.uint8).repeat(3, axis=2))
    (path / place / "cameras.txt").write_text(f"# Camera list\n{lines}\n")
    poses = "\n".join(f"{i} 1 0 0 {0.1 * i} 0 0 {i} 1 {name}\n" for i, name in enumerate(names, 1))
    (path / place / "images.txt").write_text(f"# Image list\n{poses}")
    return path


@pytest.mark.parametrize("place", ["sparse/0", "sparse", "."])
def test_colmap_text_in_each_layout(tmp_path, place):
    found = read_recording(model(tmp_path / "m", f"1 PINHOLE {WIDTH} {HEIGHT} 40 41 15 10", place=place))
    assert found.format == "colmap" and found.views == ("a.png", "b.png")
    assert found.cameras.Ks[0].tolist() == [[40, 0, 15], [0, 41, 10], [0, 0, 1]]
    assert found.cameras.viewmats[1, 2, 3] == 2 and float(found.cameras.viewmats[0, :3, :3].det()) == pytest.approx(1)


@pytest.mark.parametrize(
    ("line", "match"),
    [
        (f"1 OPENCV_FISHEYE {WIDTH} {HEIGHT} 40 41 15 10 0 0 0 0", "camera model OPENCV_FISHEYE, not a pinhole"),
        (f"1 PINHOLE {WIDTH} {HEIGHT} 40 41 15", "line 2: PINHOLE has 4 parameters, got 3"),
        (f"1 PINHOLE {WIDTH} x 40 41 15 10", "line 2 must have the form CAMERA_ID MODEL"),
        ("1", "line 2 must have the form CAMERA_ID MODEL"),
        ("", "contains no camera"),
        (f"2 PINHOLE {WIDTH} {HEIGHT} 40 41 15 10", "refers to camera 1, which is not in cameras.txt"),
        (f"1 PINHOLE {WIDTH} {HEIGHT} nan 41 15 10", "focal lengths"),
        ("1 PINHOLE 9999999 9999999 40 41 15 10", "NEUIDO_MAX_IMAGE_PIXELS"),
    ],
)
def test_malformed_colmap_text(tmp_path, line, match):
    with pytest.raises(UserError, match=match):
        read_recording(model(tmp_path / "m", line))


@pytest.mark.parametrize("ending", [".png.png", ".png"])
def test_colmap_masks(tmp_path, ending):
    path = model(tmp_path / "m", f"1 SIMPLE_PINHOLE {WIDTH} {HEIGHT} 40 15 10")
    (path / "masks").mkdir()
    for name in ("a", "b"):
        cv2.imwrite(str(path / "masks" / f"{name}{ending}"), 255 * ellipse())
    assert float(load_views(path).masks.mean()) == pytest.approx(float(ellipse().mean()), abs=1e-6)


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    key=st.sampled_from(["fl_x", "fl_y", "cx", "cy", "k1", "k4", "w", "h", "camera_angle_x", "is_fisheye", "camera_model", "time", "view",
                         "mask_path", "file_path", "transform_matrix", "distortion_params"]),
    value=st.recursive(
        st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5), lambda x: st.lists(x, max_size=4), max_leaves=6
    ),
    frame=st.booleans(),
)  # fmt: skip
def test_any_value_of_a_key_is_read_or_one_line(tmp_path, key, value, frame):
    path = folder(tmp_path, root={} if frame else {key: value}, each=lambda v, t: {key: value} if frame and v == 1 else {})
    try:
        found = nerfstudio.read(path)
        assert torch.isfinite(found.cameras.Ks).all() and (found.cameras.Ks[:, 0, 0] > 0).all()
        message = ""
    except UserError as error:
        message = str(error)
    assert "\n" not in message


@settings(max_examples=60, deadline=None)
@given(
    q=st.lists(st.floats(-1, 1), min_size=4, max_size=4).filter(lambda q: np.linalg.norm(q) > 0.1),
    t=st.lists(st.floats(-10, 10), min_size=3, max_size=3),
)
@example(q=[0.6001945029602779, 0.4296875, 0.427734375, 0.0859375], t=[0.0, 0.0, 0.0])  # an entry of 4e-5, where others cancel
def test_colmap_text_keeps_poses(tmp_path_factory, q, t):
    path = tmp_path_factory.mktemp("colmap") / "images.txt"
    path.write_text(f"1 {' '.join(map(repr, q + t))} 1 a name with spaces.jpg\n\n")
    (image,) = colmap.read_images(path)
    assert image.name == "a name with spaces.jpg"
    assert torch.allclose(
        image.viewmat, convert.from_quaternion(torch.tensor(q, dtype=torch.float64), torch.tensor(t, dtype=torch.float64))
    )


LENS = st.fixed_dictionaries({"fl_x": st.floats(10, 500), "fl_y": st.floats(10, 500), "cx": st.floats(1, 30), "cy": st.floats(1, 19)},
                             optional={key: st.floats(-0.5, 0.5) for key in ("k1", "k2", "p1", "p2", "k3")})  # fmt: skip


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    lens=LENS,
    frame=st.booleans(),
    rows=st.sampled_from([3, 4]),
    scale=st.floats(0.3, 3),
    separator=st.sampled_from(["/", "\\"]),
    mark=st.booleans(),
)
def test_any_lens_and_pose_is_read_as_it_was_written(tmp_path, lens, frame, rows, scale, separator, mark):
    path = folder(tmp_path, root={} if frame else lens, each=lambda v, t: lens if frame else {})
    file = path / "transforms.json"
    content = json.loads(file.read_text())
    poses = [np.array(entry["transform_matrix"]) for entry in content["frames"]]
    for entry, pose in zip(content["frames"], poses):
        pose = pose.copy()
        pose[:3, :3] *= scale  # a scaled rotation shows the same image
        entry["transform_matrix"] = pose[:rows].tolist()
        entry["file_path"] = entry["file_path"].replace("/", separator)
    file.write_bytes((b"\xef\xbb\xbf" if mark else b"") + json.dumps(content).encode())
    found = nerfstudio.read(path)
    K = [[lens["fl_x"], 0, lens["cx"]], [0, lens["fl_y"], lens["cy"]], [0, 0, 1]]
    assert torch.allclose(found.cameras.Ks[1], torch.tensor(K), rtol=1e-5)
    given_lens = [lens.get(key, 0.0) for key in ("k1", "k2", "p1", "p2", "k3")]
    assert (found.distortion is None and not any(given_lens)) or found.distortion[2].tolist() == given_lens
    assert np.allclose(convert.to_opengl(found.cameras.viewmats.double()).numpy(), poses, atol=1e-5)
