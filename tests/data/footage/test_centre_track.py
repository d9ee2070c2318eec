"""A ball in drawn videos of one fixed camera: its track in metres, and from there to the effect that is missing."""

import cv2
import numpy as np
import pytest
import yaml

import neuido
from neuido.data.footage.filming import Filming
from neuido.errors import UserError
from tests.command import run
from tests.data.footage import drawn

PIXEL = drawn.SCALE
COUNT = 24


@pytest.fixture(scope="module")
def throw(tmp_path_factory):
    path = tmp_path_factory.mktemp("throw") / "throw.mp4"
    return path, drawn.throw(path, count=COUNT)


def track_of(folder):
    (track,) = neuido.read_tracks(folder).recordings
    return track


def test_a_throw_becomes_a_track(throw, tmp_path):
    path, x = throw
    said = neuido.import_file(path, tmp_path / "out", scale=PIXEL, filming=Filming(picture=str(tmp_path / "sheet.png")))
    track = track_of(tmp_path / "out")
    np.testing.assert_allclose(track.t, np.arange(COUNT) / 60, atol=1e-6)
    assert np.abs(track.x - x).max() < 0.3 * PIXEL and np.sqrt(np.mean((track.x - x) ** 2)) < 0.12 * PIXEL
    assert any(f"found in {COUNT} frames" in line for line in said) and cv2.imread(str(tmp_path / "sheet.png")).shape == (240, 1920, 3)


def test_the_diameter_gives_the_scale(throw, tmp_path):
    path, x = throw
    neuido.import_file(path, tmp_path / "out", diameter=2 * drawn.RADIUS * PIXEL)
    given = yaml.safe_load((tmp_path / "out" / "track.yaml").read_text())["nuisances"]["length_scale"]
    found = np.ptp(track_of(tmp_path / "out").x[:, 0]) / np.ptp(x[:, 0]) - 1
    assert abs(found) < given < 0.06


def test_slow_motion_and_a_part_of_the_clip_by_the_command(throw, tmp_path, capsys):
    path, _ = throw
    part = ["--scale", PIXEL, "--frame_rate", 240, "--start", 0.025, "--end", 0.075, "--picture", tmp_path / "sheet.png"]
    status, out, err = run(capsys, "import", path, *part, "--out", tmp_path / "out")
    assert (status, err) == (0, "") and "240 frames/s as given" in out and (tmp_path / "sheet.png").is_file()
    np.testing.assert_allclose(track_of(tmp_path / "out").t, np.arange(13) / 240, atol=1e-6)


def test_times_of_a_variable_frame_rate_are_those_of_the_file(tmp_path):
    t = np.cumsum([0, *np.tile([0.02, 0.03, 0.025], 6)])
    background = drawn.scenery()
    drawn.film(tmp_path / "a.mp4", (drawn.ball(background, c) for c in drawn.pixels(drawn.flight(t))), times=t)
    neuido.import_file(tmp_path / "a.mp4", tmp_path / "out", scale=PIXEL)
    np.testing.assert_allclose(track_of(tmp_path / "out").t, t, atol=1e-4)


def test_frames_in_which_the_object_leaves_the_picture_are_left_out(tmp_path):
    x = drawn.throw(tmp_path / "a.mp4", count=20, v0=(-1.0, 3.0), x0=(0.2, 0.5))
    said = neuido.import_file(tmp_path / "a.mp4", tmp_path / "out", scale=PIXEL)
    whole = x[:, 0] > drawn.RADIUS * PIXEL
    assert len(track_of(tmp_path / "out").t) == pytest.approx(whole.sum(), abs=1) and any("cut by the border" in line for line in said)


def still(i, image):
    return drawn.scenery()


def rival(i, image):
    return drawn.ball(image, (300 - 8 * i, 30 + 8 * i), 9.0, (20, 20, 220))


@pytest.mark.parametrize(
    ("change", "options", "match"),
    [
        (still, {"scale": PIXEL}, "something moves in 0 of 24 frames.*--background"),
        (rival, {"scale": PIXEL}, "two things of similar size differ from the background"),
        (None, {}, "give --scale .metres per pixel., or --diameter"),
        (None, {"scale": PIXEL, "filming": Filming(start=3.0)}, "0 frames lie between --start 3 and --end 0.383 s"),
        (None, {"scale": PIXEL, "kind": "material"}, "--kind material is not for videos"),
        (None, {"scale": PIXEL, "frame_rate": -1.0}, "--frame_rate must be above 0"),
        (None, {"scale": PIXEL, "floor": 0.0}, "--floor belongs to --guide bounce, and the track is that of a free flight"),
        (None, {"scale": PIXEL, "filming": Filming(offsets=[0.1])}, "--offsets is for clips of several cameras .*holds a video"),
        (None, {"mass": 0.057, "filming": Filming(cameras="board")}, "--mass is for .*holds clips of several cameras"),
        (None, {"scale": 0.0, "filming": Filming(cameras="board")}, "--scale must be above 0"),
        (None, {"frame_rate": 240.0, "filming": Filming(cameras="board", synchronise="audio")}, "--synchronise audio goes by the clock"),
    ],
)
def test_what_a_video_cannot_tell(throw, tmp_path, change, options, match):
    path = throw[0]
    if change is not None:
        path = tmp_path / "a.mp4"
        drawn.throw(path, count=COUNT, change=change)
    with pytest.raises(UserError, match=match):
        neuido.import_file(path, tmp_path / "out", **options)
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_from_videos_to_the_missing_effect(tmp_path, capsys):
    for i, (v0, x0) in enumerate([((3.5, 4.0), (0.2, 0.5)), ((2.5, 4.8), (0.2, 0.4)), ((4.0, 3.0), (0.2, 0.9))]):
        drawn.throw(tmp_path / f"throw{i}.mp4", count=40, drag=0.25, seed=i, v0=v0, x0=x0)
    neuido.import_file(sorted(tmp_path.glob("*.mp4")), tmp_path / "out", scale=PIXEL, mass=0.05, diameter=2 * drawn.RADIUS * PIXEL)
    found = neuido.diagnose(tmp_path / "out", out=tmp_path / "answer", progress=False)
    (effect,) = found.effects
    assert effect.name == "drag_quadratic" and effect.parameters["k"].value == pytest.approx(0.25, rel=0.03)
