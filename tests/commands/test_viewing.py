"""`neuido render` and `neuido view`: files that play everywhere, pages that are built, and one line for each misuse."""

import numpy as np
import pytest
import torch

from neuido import Frames
from tests.command import run
from tests.commands.test_simulate import SCENE


@pytest.fixture(scope="module")
def motion(tmp_path_factory):
    path = tmp_path_factory.mktemp("motion") / "drop.npz"
    x = torch.rand(1, 60, 3) * 0.2 - torch.arange(5)[:, None, None] * torch.tensor([0.0, 0.05, 0.0])
    v = torch.ones_like(x)
    eye = torch.eye(3).expand(5, 60, 3, 3).contiguous()
    Frames(x, v, torch.zeros_like(eye), eye, dt=0.01).save(path)
    return path


@pytest.mark.parametrize(("name", "codec"), [("clip.mp4", "h264"), ("clip.webm", "vp9")])
def test_videos_play_everywhere(motion, tmp_path, capsys, name, codec):
    av = pytest.importorskip("av", reason="PyAV is not installed: pip install neuido[video]")
    out = tmp_path / name
    status, printed, err = run(capsys, "render", motion, "--out", out, "--width", 128, "--height", 96)
    assert status == 0, err
    assert "5 frames of 128 x 96 px, coloured by speed" in printed and f"results in {out}" in printed
    with av.open(str(out)) as video:
        stream = video.streams.video[0]
        assert (stream.codec_context.name, stream.width, stream.height) == (codec, 128, 96)
        assert stream.pix_fmt == "yuv420p"
        images = [frame.to_ndarray(format="rgb24").astype(int) for frame in video.decode(stream)]
    assert len(images) == 5 and np.abs(images[0] - images[4]).mean() > 1
    if codec == "h264":
        content = out.read_bytes()
        assert content.index(b"moov") < content.index(b"mdat")  # it plays before it is loaded


def test_pictures(motion, tmp_path, capsys):
    import cv2

    status, printed, err = run(capsys, "render", motion, "--out", tmp_path / "a.png", "--frame", -1, "--colour", "strain", "--width", 80)
    assert status == 0, err
    assert cv2.imread(str(tmp_path / "a.png")).shape == (600, 80, 3) and "1 frame of" in printed
    status, _, err = run(capsys, "render", motion, "--out", tmp_path / "b.png", "--every", 2, "--width", 64, "--height", 48, "--eye",
                         "[1, 1, 1]", "--look_at", "[0, 0, 0]")  # fmt: skip
    assert status == 0, err
    assert sorted(path.name for path in tmp_path.glob("b*")) == ["b_0000.png", "b_0001.png", "b_0002.png"]


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["{motion}", "--out", "clip.gif"], "its ending must be"),
        (["{motion}", "--out", "clip.mp4", "--width", "101"], "even numbers"),
        (["{motion}", "--out", "clip.mp4", "--frame_rate", "0"], "frame_rate is 0"),
        (["{motion}", "--out", "a.png", "--colour", "sped"], "did you mean 'speed'?"),
        (["{motion}", "--out", "a.png", "--frame", "9"], "5 frames"),
        (["{motion}", "--out", "a.png", "--eye", "[1, 2]"], "three numbers"),
        (["{motion}", "--out", "a.png", "--every", "0"], "every is 0"),
        (["{scene}", "--out", "a.png"], "neuido simulate"),
    ],
)
def test_a_mistake_of_render_is_one_line(motion, tmp_path, capsys, monkeypatch, words, told):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "ball.yaml").write_text(SCENE)
    status, _, err = run(capsys, "render", *(word.format(motion=motion, scene=tmp_path / "ball.yaml") for word in words))
    assert status == 2 and told in err and err.count("\n") == 1, err
    assert not list(tmp_path.glob("*.png")) + list(tmp_path.glob("*.mp4"))


def test_a_page_is_built(motion, capsys):
    pytest.importorskip("viser", reason="viser is not installed: pip install neuido[viewer]")
    status, printed, err = run(capsys, "view", motion, "--once", "true", "--port", 8901)
    assert status == 0, err
    assert printed.startswith("drop is at http://localhost:89") and printed.count("\n") == 1


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["{motion}", "--law", "a.safetensors"], "law belongs to a scene file"),
        (["{motion}", "--port", "0"], "port is 0"),
        (["{motion}", "--colour", "sped"], "did you mean 'speed'?"),
        (["{scene}", "--latents", "[a]"], "must be two names"),
        (["absent.npz"], "absent.npz is missing"),
    ],
)
def test_a_mistake_of_view_is_one_line(motion, tmp_path, capsys, words, told):
    pytest.importorskip("viser", reason="viser is not installed: pip install neuido[viewer]")
    (tmp_path / "ball.yaml").write_text(SCENE)
    status, _, err = run(capsys, "view", *(word.format(motion=motion, scene=tmp_path / "ball.yaml") for word in words), "--once", "true")
    assert status == 2 and told in err and err.count("\n") == 1, err


@pytest.mark.parametrize("command", ["view", "render"])
def test_a_missing_extra_is_named(motion, tmp_path, capsys, monkeypatch, command):
    import sys

    monkeypatch.setitem(sys.modules, "viser", None)
    monkeypatch.setitem(sys.modules, "av", None)
    words = ["--once", "true"] if command == "view" else ["--out", tmp_path / "a.mp4"]
    status, _, err = run(capsys, command, motion, *words)
    assert status == 2 and "pip install 'neuido[viewer]'" in err and err.count("\n") == 1
