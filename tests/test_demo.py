"""The demonstration runs from simulation to picture, here with a run that is too short to learn anything."""

import matplotlib.image
import numpy as np
import pytest
import yaml

import neuido
from neuido import demo

TINY = {"instances": 1, "held_out": 0, "particles_per_side": 4, "steps": 60, "device": "cpu", "progress": False}


def test_comparison_measures_matched_particles():
    true = np.zeros((2, 5, 3))
    true[1, :, 1] = -4.0
    shifted = true.copy()
    shifted[1, :, 0] = 3.0
    compared = demo.Comparison("jelly", true, shifted)
    assert compared.rmse == pytest.approx(3.0 / 2**0.5)
    assert compared.path == pytest.approx(4.0 / 2**0.5)


def test_demo(tmp_path, monkeypatch, capsys):
    settings = yaml.safe_load((neuido.configs_root() / "quickstart.yaml").read_text())
    settings["data"]["init_args"] |= {"generate": TINY, "batch_size": 300}
    settings["trainer"] |= {"max_epochs": 1, "accelerator": "cpu", "enable_progress_bar": False}
    path = tmp_path / "tiny.yaml"
    path.write_text(yaml.safe_dump(settings))
    monkeypatch.setattr(demo, "STEPS", 20)
    monkeypatch.setattr(demo, "EVERY", 10)
    monkeypatch.chdir(tmp_path)
    demo.demo(out="out", settings=str(path))
    printed = capsys.readouterr().out
    for name in ("jelly", "plasticine", "sand"):
        row = next(line for line in printed.splitlines() if line.startswith(name))
        figures = [float(word) for word in row.split()[1:] if word != "m"]
        assert len(figures) == 4
        assert np.isfinite(figures).all()
    picture = matplotlib.image.imread(tmp_path / "out" / "demo.png")
    assert picture.std() > 0.05
