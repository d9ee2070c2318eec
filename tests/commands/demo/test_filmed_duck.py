"""The duck of the demonstration: a film that a browser plays, the law within its interval, and pictures that show the body."""

import importlib.util

import matplotlib.image
import pytest
import torch

from neuido.commands.demo import demo
from neuido.commands.demo.filmed_duck import INTERVAL, TRUE_YOUNG, Reading, duck, show

HAS_AV = importlib.util.find_spec("av") is not None


def test_duck_is_one_coloured_body():
    body, colour = duck(0.03, centre=(0.4, 0.3, 0.5), velocity=(0.0, -1.0, 0.0))
    assert 300 < len(body.x) == len(colour) < 700
    assert float(body.volume.sum()) == pytest.approx(0.0125, rel=0.25)
    head, beak = body.x[:, 1] > 0.42, (colour[:, 1] - 0.42).abs() < 1e-6
    assert head.any() and body.x[beak][:, 0].min() > body.x[:, 0].mean()  # it looks along x


def test_film_is_h264_of_512_px_and_more(tmp_path):
    images = torch.rand(6, 512, 512, 3, generator=torch.Generator().manual_seed(0))
    result = Reading(5e4, 2e4, 1e5, TRUE_YOUNG, 0.01, 1.0, tmp_path / "duck.mp4", tmp_path / "duck.png")
    show(result, images, images)
    assert matplotlib.image.imread(result.picture).shape[:2] == (1024, 2048)
    if HAS_AV:
        import av

        with av.open(str(result.video)) as film:
            stream = film.streams.video[0]
            assert (stream.codec_context.name, stream.width, stream.height, stream.pix_fmt) == ("h264", 1024, 512, "yuv420p")
            assert sum(1 for _ in film.decode(stream)) == 6
    section = demo.reading_section(result)
    assert "20 to 100" in section and 'src="data:video/mp4;base64,' in section and "<img" in section


@pytest.mark.slow
def test_reading_holds_the_truth(tmp_path, monkeypatch):
    demo.demo(out=str(tmp_path), parts="reading")
    text = (tmp_path / "report.html").read_text()
    young = float(text.split("that was read [kPa]</td>")[1].split(">")[1].split("<")[0])
    assert INTERVAL[0] < TRUE_YOUNG / 1e3 / young < INTERVAL[1] and young < 4 * TRUE_YOUNG / 1e3
    assert (tmp_path / "reading" / "duck.mp4").stat().st_size > 30_000
