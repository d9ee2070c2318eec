"""Recordings whose cameras have a pose for each frame."""

import json

import numpy as np
import pytest
import torch

from neuido.data import cameras as convert
from neuido.data.formats import nerfstudio
from neuido.data.scenes.multiview import SceneViews
from neuido.data.scenes.readers import read_recording
from neuido.data.scenes.view_geometry import mean_misfit, triangulate, view_delays
from neuido.errors import UserError
from neuido.types import Cameras
from tests.data import samples

FRAMES = 4
S = samples.Sample()


def turning(views: int = 3, step: float = 9.0) -> Cameras:
    """Cameras that turn about the body by `step` degrees a frame, (V, T, 4, 4)."""
    own = [convert.orbit(views, width=samples.WIDTH, height=samples.HEIGHT, start=step * t) for t in range(FRAMES)]
    return own[0]._replace(viewmats=torch.stack([each.viewmats for each in own], 1))


def recorded(folder, views: int = 3):
    times = torch.arange(FRAMES, dtype=torch.float64) * 0.1
    nerfstudio.write(folder, turning(views), times, S.images[:views])
    return read_recording(folder)


def edit(folder, change) -> None:
    content = json.loads((folder / "transforms.json").read_text())
    change(content)
    (folder / "transforms.json").write_text(json.dumps(content))


def test_written_poses_are_read_and_placed(tmp_path):
    found, true = recorded(tmp_path), turning()
    assert found.cameras.moving and found.cameras.viewmats.shape == (3, FRAMES, 4, 4)
    torch.testing.assert_close(found.cameras.viewmats, true.viewmats, atol=1e-6, rtol=0)
    scene = SceneViews(
        found, frame_start=1, frame_step=2, width=samples.WIDTH // 2, scale=2.0, shift=(1.0, 0.0, -0.5), up="z", views=["2", "0"]
    )
    assert scene.cameras.viewmats.shape == (2, 2, 4, 4)
    point = torch.tensor([[0.4, 0.5, 0.6]])
    placed = 2.0 * torch.tensor([[point[0, 0], point[0, 2], -point[0, 1]]]) + torch.tensor([[1.0, 0.0, -0.5]])
    for k, frame in enumerate((1, 3)):
        wanted, depth = convert.project(point, true.at(frame))
        pixels, own = convert.project(placed, scene.cameras.at(k))
        torch.testing.assert_close(pixels, wanted[[2, 0]] / 2, atol=1e-3, rtol=0)
        torch.testing.assert_close(own, 2 * depth[[2, 0]])


def test_fixed_cameras_have_one_pose(tmp_path):
    cameras = turning().at(0)
    nerfstudio.write(tmp_path, cameras, torch.arange(FRAMES, dtype=torch.float64), S.images)
    found = read_recording(tmp_path)
    assert not found.cameras.moving and found.cameras.at(2) is found.cameras
    edit(tmp_path, lambda c: c["frames"][1]["transform_matrix"][0].__setitem__(3, c["frames"][1]["transform_matrix"][0][3] + 1e-7))
    assert not read_recording(tmp_path).cameras.moving


def test_one_video_and_folders_of_videos_without_views(tmp_path):
    recorded(tmp_path / "one", views=1)
    edit(tmp_path / "one", lambda c: [frame.pop("view") for frame in c["frames"]])
    found = read_recording(tmp_path / "one")
    assert found.views == ("0",) and found.cameras.viewmats.shape == (1, FRAMES, 4, 4) and None not in found.images[0]

    recorded(tmp_path / "two", views=2)
    folder = tmp_path / "two"

    def apart(content) -> None:
        for frame in content["frames"]:
            name = f"images/{frame.pop('view')}/{frame['file_path'][-7:]}"
            (folder / name).parent.mkdir(exist_ok=True)
            (folder / frame["file_path"]).rename(folder / name)
            frame["file_path"] = name

    edit(folder, apart)
    found = read_recording(folder)
    assert found.views == ("0", "1") and found.cameras.moving and found.images[1][2].parent.name == "1"
    edit(folder, lambda c: c.update(test_filenames=[f["file_path"] for f in c["frames"][FRAMES:]]))
    assert read_recording(folder).held_out == (1,)


def test_colmap_images_of_videos(tmp_path):
    cameras = turning(1)
    names = [f"frame_{n:04d}.png" for n in (7, 8, 10, 11)]  # COLMAP could not place 9
    (tmp_path / "sparse/0").mkdir(parents=True)
    K = cameras.Ks[0]
    (tmp_path / "sparse/0/cameras.txt").write_text(f"1 PINHOLE {samples.WIDTH} {samples.HEIGHT} {K[0, 0]} {K[1, 1]} {K[0, 2]} {K[1, 2]}\n")
    rows = []
    for t, name in enumerate(names):
        q, x = convert.to_quaternion(cameras.viewmats[0, t].double())
        rows.append(" ".join(str(float(n)) for n in (*q, *x)))
        nerfstudio.write_image(tmp_path / "images" / name, S.images[0][t])
    lines = "".join(f"{t + 1} {row} 1 {name}\n\n" for t, (row, name) in enumerate(zip(rows, names)))
    (tmp_path / "sparse/0/images.txt").write_text(lines)
    assert len(read_recording(tmp_path).views) == 4 and not read_recording(tmp_path).cameras.moving
    found = read_recording(tmp_path, frame_interval=0.5)
    assert found.views == ("1",) and found.times.tolist() == [0.0, 0.5, 1.5, 2.0]
    torch.testing.assert_close(found.cameras.viewmats[0], cameras.viewmats[0], atol=1e-5, rtol=0)
    (tmp_path / "sparse/0/images.txt").write_text(lines.replace("frame_0008", "frame"))
    (tmp_path / "images/frame_0008.png").rename(tmp_path / "images/frame.png")
    with pytest.raises(UserError, match=r"frame\.png has no number in its name"):
        read_recording(tmp_path, frame_interval=0.5)


def test_rays_of_turning_cameras_meet_where_those_of_fixed_ones_do():
    times = np.arange(FRAMES) * 0.1
    x = np.array([0.5, 0.6, 0.5]) + times[:, None] * np.array([0.3, -0.4, 0.2])
    whole = np.ones((3, FRAMES), bool)
    found = []
    for cameras in (turning(), turning().at(0)):
        seen = [convert.project(torch.from_numpy(x[t : t + 1]), cameras.at(t))[0][:, 0] for t in range(FRAMES)]
        centres = torch.stack(seen, 1).numpy()
        found.append(triangulate(centres, whole, cameras))
        assert mean_misfit(found[-1], centres, whole, cameras) < 1e-4
        assert not view_delays(centres, whole, cameras, times).any()
    np.testing.assert_allclose(found[0], x, atol=1e-6)
    np.testing.assert_allclose(found[0], found[1], atol=1e-6)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c: c["frames"][2].pop("transform_matrix"), r"frames\[2\] lacks the key .transform_matrix"),
        (lambda c: c["frames"][2].update(fl_x=99.0), "the lens of view 0 changes between 0_000.png and 0_002.png: film without zoom"),
        (lambda c: c["frames"][2].pop("time"), "1 of 12 frames have no time"),
        (lambda c: c["frames"][2].update(time=0.1), "view 0 has two images at 0.1 s"),
    ],
)
def test_what_is_wrong_is_one_line(tmp_path, change, message):
    recorded(tmp_path)
    edit(tmp_path, change)
    with pytest.raises(UserError, match=message):
        read_recording(tmp_path)


def test_times_that_do_not_match(tmp_path):
    recorded(tmp_path)
    edit(tmp_path, lambda c: [frame.update(time=frame["time"] + 0.05) for frame in c["frames"][:FRAMES]])
    with pytest.raises(UserError, match=r"view 1 has no image at 0\.05 s|view 0 has no image at 0 s"):
        SceneViews(read_recording(tmp_path))


def test_stages_that_need_fixed_cameras_say_so(tmp_path):
    from neuido.data.footage.known_cameras import recorded_cameras
    from neuido.models.video.flow import pixel_length

    found = recorded(tmp_path)
    with pytest.raises(UserError, match=r"cameras that move .*optical flow would hold their motion too"):
        pixel_length(found.cameras, torch.zeros(3))
    with pytest.raises(UserError, match=r"cameras that move .*one pose for each view"):
        recorded_cameras(tmp_path, [])
