"""Pixel tracks of calibrated cameras become one motion in metres; what does not belong together is refused in one line."""

import json

import numpy as np
import pytest
from PIL import Image

import neuido
from neuido.data.footage.filming import Filming
from neuido.errors import UserError

pytest.importorskip("pint")
W, H, FOCAL = 640, 480, 600.0
EYES = ((2.0, 0.5, 1.5), (-2.0, 0.6, 1.6), (0.2, 0.8, 2.5))
T = np.arange(31) / 30
FLIGHT = np.stack([0.8 * T - 0.3, 0.2 + 1.5 * T - 4.905 * T**2, 0.1 * T], 1)
K = np.array([[FOCAL, 0, W / 2], [0, FOCAL, H / 2], [0, 0, 1]])
NOISE = 0.3  # px


def pose(eye):
    """The OpenCV world-to-camera matrix of a camera that looks at (0, 0.2, 0)."""
    z = np.array([0.0, 0.2, 0.0]) - eye
    z /= np.linalg.norm(z)
    x = np.cross(z, [0, 1, 0])
    x /= np.linalg.norm(x)
    out = np.eye(4)
    out[:3, :3] = x, np.cross(z, x), z
    out[:3, 3] = -out[:3, :3] @ eye
    return out


@pytest.fixture
def stage(tmp_path):
    """A recording with the cameras of three views, and a function that writes the track of a view."""
    frames = []
    for v, eye in enumerate(EYES):
        Image.new("RGB", (4, 3)).save(tmp_path / f"cam{v}.png")
        matrix = np.linalg.inv(pose(eye)) @ np.diag([1, -1, -1, 1])
        frames.append({"file_path": f"cam{v}.png", "transform_matrix": matrix.tolist()})
    lens = {"fl_x": FOCAL, "fl_y": FOCAL, "cx": W / 2, "cy": H / 2, "w": W, "h": H}
    (tmp_path / "transforms.json").write_text(json.dumps({**lens, "frames": frames}))
    rng = np.random.default_rng(0)

    def view(v, *, lost=(), stray=(), late=0.0, name=None, y_up=False):
        seen = (pose(EYES[v])[:3, :3] @ FLIGHT.T + pose(EYES[v])[:3, 3:]).T @ K.T
        seen = seen[:, :2] / seen[:, 2:] + NOISE * rng.standard_normal((len(T), 2))
        seen[list(stray)] += 60
        if y_up:
            seen[:, 1] = H - seen[:, 1]
        rows = [f"{t + late:.6f}," + ("," if i in lost else ",".join(f"{value:.3f}" for value in seen[i])) for i, t in enumerate(T)]
        path = tmp_path / (name or f"cam{v}.csv")
        path.write_text("\n".join(["t (s),x (px),y (px)", *rows, ""]))
        return path

    view.folder = str(tmp_path)
    return view


def imported(stage, files, out, *, offsets=None, **options):
    return neuido.import_file(files, out, filming=Filming(cameras=stage.folder, offsets=offsets), mass=0.05, diameter=0.05, **options)


@pytest.mark.parametrize("count", [2, 3])
def test_lines_of_sight_meet_at_the_point(stage, tmp_path, count):
    said = imported(stage, [stage(v) for v in range(count)], tmp_path / "out")
    (track,) = neuido.read_tracks(tmp_path / "out").recordings
    assert np.sqrt(np.mean((track.x - FLIGHT) ** 2)) < 2e-3  # m; a pixel is 4 mm wide there
    np.testing.assert_allclose(track.t, T, atol=1e-6)
    assert any(f"{count} views, reprojection error 0." in line for line in said)


def test_outliers_and_gaps(stage, tmp_path):
    said = imported(stage, [stage(0), stage(1, stray=(7, 9)), stage(2, lost=(3, 4))], tmp_path / "three")
    (track,) = neuido.read_tracks(tmp_path / "three").recordings
    assert len(track.t) == 31 and np.abs(track.x - FLIGHT).max() < 8e-3
    assert any("2 pixel positions are outliers and left out" in line for line in said)
    said = imported(stage, [stage(0), stage(1, stray=(7,))], tmp_path / "two")
    (track,) = neuido.read_tracks(tmp_path / "two").recordings
    np.testing.assert_allclose(track.t, np.delete(T, 7), atol=1e-6)


def test_clocks(stage, tmp_path):
    with pytest.raises(UserError, match=r"the views share 0 frames \(cam0\.csv 0 to 1 s, cam1\.csv 12 to 13 s\): give --offsets"):
        imported(stage, [stage(0), stage(1, late=12.0)], None)
    said = imported(stage, [stage(0), stage(1, late=12.01)], tmp_path / "out", offsets=[0.0, -12.0])
    assert any(line.startswith("odd: ") or "odd: the reprojection error is large" in line for line in said)
    assert any("pixel positions are interpolated in time to the frames of cam0.csv" in line for line in said)
    imported(stage, [stage(0), stage(1, late=12.0)], tmp_path / "right", offsets=[0.0, -12.0])
    assert np.abs(neuido.read_tracks(tmp_path / "right").recordings[0].x - FLIGHT).max() < 8e-3


def test_what_does_not_belong_together(stage, tmp_path):
    both = lambda: [stage(0), stage(1)]  # noqa: E731
    for files, options, words in (
        (lambda: [stage(1, name="cam0.csv"), stage(0, name="cam1.csv")], {}, "lines of sight miss each other by"),
        (lambda: [stage(0, y_up=True), stage(1, y_up=True)], {}, "does y point down from the upper left corner"),
        (lambda: [stage(0)], {}, "of one view give --scale instead"),
        (lambda: [stage(0), stage(1, name="side.csv")], {}, r"no view 'side' for side\.csv: it has cam0, cam1, cam2"),
        (both, {"offsets": [0.0]}, "--offsets has 1 numbers for 2 views"),
        (both, {"up": "x"}, "--up x must be y or z"),
    ):
        with pytest.raises(UserError, match=words):
            imported(stage, files(), tmp_path / "out", **options)
        assert not (tmp_path / "out").exists()
    with pytest.raises(UserError, match="--cameras board is for videos"):
        neuido.import_file([stage(0), stage(1)], None, filming=Filming(cameras="board"))
