"""The demonstration runs from simulation to picture, here with a run that is too short to learn anything."""

import re
from pathlib import Path

import matplotlib.image
import numpy as np
import pytest
import yaml

import neuido
from neuido.commands.demo import closed_loop as demo_loop
from neuido.commands.demo import demo
from neuido.commands.demo import learned_laws as demo_laws
from neuido.commands.demo.law_from_video import Adapted, SceneResult, VideoResult
from neuido.errors import UserError

TINY = {"instances": 1, "held_out": 0, "particles_per_side": 4, "steps": 60, "device": "cpu", "progress": False}


def test_comparison_measures_matched_particles():
    true = np.zeros((2, 5, 3))
    true[1, :, 1] = -4.0
    shifted = true.copy()
    shifted[1, :, 0] = 3.0
    compared = demo_laws.Comparison("jelly", true, shifted)
    assert compared.rmse == pytest.approx(3.0 / 2**0.5)
    assert compared.path == pytest.approx(4.0 / 2**0.5)


def test_laws(tmp_path, monkeypatch, capsys):
    settings = yaml.safe_load((neuido.configs_root() / "quickstart.yaml").read_text())
    settings["data"]["init_args"] |= {"generate": TINY, "batch_size": 300}
    settings["trainer"] |= {"max_epochs": 1, "accelerator": "cpu", "enable_progress_bar": False}
    path = tmp_path / "tiny.yaml"
    path.write_text(yaml.safe_dump(settings))
    monkeypatch.setattr(demo_laws, "STEPS", 20)
    monkeypatch.setattr(demo_laws, "EVERY", 10)
    monkeypatch.chdir(tmp_path)
    demo.demo(out="out", settings=str(path), parts="laws")
    printed = capsys.readouterr().out
    for name in ("jelly", "plasticine", "sand"):
        row = next(line for line in printed.splitlines() if line.startswith(name))
        figures = [float(word) for word in row.split()[1:] if word != "m"]
        assert len(figures) == 4
        assert np.isfinite(figures).all()
    picture = matplotlib.image.imread(tmp_path / "out" / "demo.png")
    assert picture.std() > 0.05
    check_page(Path("out/report.html"), ("jelly", "plasticine", "sand"), 1)


def check_page(path, words, pictures):
    """The page says these words, holds its pictures itself, and its links lead somewhere."""
    text = path.read_text()
    assert text.startswith("<!doctype html>")
    for word in words:
        assert word in text
    sources = re.findall(r'src="([^"]*)"', text)
    assert len(sources) == pictures
    assert all(source.startswith("data:image/png;base64,iVBOR") for source in sources)
    for link in re.findall(r'href="([^"]*)"', text):
        assert (path.parent / link).is_file()


@pytest.mark.parametrize("parts", ["", "laws,vidoe"])
def test_unknown_parts(parts, tmp_path):
    with pytest.raises(UserError, match="parts"):
        demo.demo(out=str(tmp_path / "out"), parts=parts)
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_loop(tmp_path, monkeypatch):
    """The demonstration's loop with few candidates: the drag is named, the error falls to its floor, the second pass finds nothing."""
    whole = demo_loop.demo_loop
    kept = []

    def short(out):
        kept.append(whole(out, effects="drag_linear,gravity", draws=39, progress=False))
        return kept[0]

    monkeypatch.setattr(demo_loop, "demo_loop", short)
    demo.demo(out=str(tmp_path), parts="loop")
    (result,) = kept
    assert (result.answer, result.effects, result.again) == ("effect", (("drag_linear",),), "none")
    assert result.parameters["drag_linear.k"] == pytest.approx(3.0, rel=0.1)
    assert result.after < 1.3 * result.floor < 0.5 * result.before
    assert matplotlib.image.imread(result.picture).std() > 0.05
    check_page(tmp_path / "report.html", ("drag_linear.k = 3", "effect: linear air drag (drag_linear)", "diagnosis/report.html"), 1)


def test_page_shows_the_scenes(tmp_path):
    """Figures that are missing leave a gap, names are escaped, and every scene has its picture."""
    picture = tmp_path / "prediction.png"
    matplotlib.image.imsave(picture, np.random.default_rng(0).random((4, 4)))
    scenes = (
        SceneResult("a<b", False, {"cd": 1.5, "psnr": 24.25}, 0.0034, picture, picture),
        SceneResult("other", True, {"cd": 2.5}, 0.0125, picture, picture),
    )
    text = demo.video_section(VideoResult(scenes, (1.0, 0.25), tmp_path / "encoder"))
    assert "a&lt;b" in text and "a<b" not in text
    assert all(word in text for word in ("3.4 ms", "12.5 ms", "24.2", "unseen", "2 steps"))
    assert "1 on average in the first half, 0.25 in the second" in text
    assert text.count("data:image/png") == 2
    assert "SSIM" not in text and "adapted" not in text
    adapted = Adapted("other", {"psnr": 21.5}, {"psnr": 23.5, "cd": 1.25}, 6, 7.0, picture)
    text = demo.video_section(VideoResult(scenes, (), tmp_path / "encoder", adapted))
    assert all(word in text for word in ("21.5", "23.5", "1.25", "after 6 steps, 7 s")) and text.count("data:image/png") == 3
