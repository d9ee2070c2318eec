"""Clips of one motion on a common clock: a flash that all see, a clap that all hear, or given offsets."""

import numpy as np
import pytest

from neuido.data.footage.synchronisation import start_times
from neuido.data.footage.video_frames import read_clip
from neuido.errors import UserError
from tests.data.footage import drawn

SMALL = 64, 48


def clip(path, *, flash=None, sound=None, count=30):
    images = [drawn.scenery(size=SMALL) + (60 if i == flash else 0) for i in range(count)]
    return read_clip(drawn.film(path, images, rate=50, sound=sound))


def test_a_flash_that_all_see(tmp_path):
    clips = [clip(tmp_path / "a.mp4", flash=8), clip(tmp_path / "b.mp4", flash=19)]
    late, words = start_times(clips, "flash", None)
    np.testing.assert_allclose(late, [0.0, (8 - 19) / 50], atol=1e-6)
    assert "b.mp4 -0.2200 s" in words
    with pytest.raises(UserError, match=r"c.mp4 has no flash: .*--offsets"):
        start_times([clips[0], clip(tmp_path / "c.mp4")], "flash", None)


def test_a_clap_that_all_hear(tmp_path, monkeypatch):
    rng = np.random.default_rng(0)
    clips = []
    for name, at in (("a", 0.120), ("b", 0.3437)):
        sound = 0.01 * rng.standard_normal(10240)  # ten blocks of the codec, 0.64 s at 16 kHz
        start = round(at * 16000)
        sound[start : start + 800] += 0.8 * rng.standard_normal(800) * np.exp(-np.arange(800) / 200)
        clips.append(clip(tmp_path / f"{name}.mp4", sound=sound))
    late, _ = start_times(clips, "audio", None)
    np.testing.assert_allclose(late, [0.0, 0.120 - 0.3437], atol=3e-3)
    with pytest.raises(UserError, match=r"c.mp4 has no sound: .*--synchronise flash"):
        start_times([clips[0], clip(tmp_path / "c.mp4")], "audio", None)
    quiet = clip(tmp_path / "d.mp4", sound=0.01 * rng.standard_normal(10240))
    with pytest.raises(UserError, match=r"d.mp4 has no clap"):
        start_times([clips[0], quiet], "audio", None)
    monkeypatch.setenv("NEUIDO_MAX_ARRAY_ELEMENTS", "5000")
    with pytest.raises(UserError, match=r"a.mp4 has \d+ samples of sound, more than the limit of 5000"):
        start_times(clips, "audio", None)


def test_given_offsets(tmp_path):
    clips = [clip(tmp_path / "a.mp4", count=4), clip(tmp_path / "b.mp4", count=4)]
    assert start_times(clips, "none", [0.0, 0.25])[0].tolist() == [0.0, 0.25]
    assert start_times(clips, "none", None)[0] == pytest.approx([-clip.times[0] for clip in clips])
    for method, offsets, match in (
        ("none", [0.1], "1 numbers for 2 clips"),
        ("none", [0.1, float("nan")], "one finite number"),
        ("flash", [0.0, 0.1], "not both"),
        ("wave", None, "--synchronise wave is unknown"),
    ):
        with pytest.raises(UserError, match=match):
            start_times(clips, method, offsets)
