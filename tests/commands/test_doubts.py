"""Matter that collapses is told of by every command that simulates, beside `simulate`."""

import json

import pytest
import yaml

from neuido.data.trajectories import generation
from neuido.discrepancy import diagnose
from tests.command import run
from tests.discrepancy import made
from tests.faults.targets import FILM

SOFT = {"law": "fixed_corotated", "young": 3e3, "poisson": 0.2}
"""Crushed to nothing by a fall at 6 m/s: half its wave modulus is all the work it takes."""


def test_trajectories(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(generation, "SEGMENT", 40)
    families = '{"elastic": {"young": [3000.0, 3001.0], "poisson": [0.2, 0.2001]}}'
    throw = {"particles_per_side": 4, "velocity": "[0.0, -8.0, 0.0]", "steps": 240, "record_every": 40, "cells": 12, "dt": 1e-3}
    words = [word for key, value in throw.items() for word in (f"--setup.{key}", value)]
    options = ["--families", families, "--instances", 2, "--held_out", 0, "--batch", 2, "--device", "cpu"]
    status, printed, err = run(capsys, "trajectories", "--out", tmp_path / "out", *options, *words)
    assert status == 0, err
    (line,) = [line for line in printed.splitlines() if line.startswith("note: ")]  # instance 0 is a published material, and stiffer
    assert line.startswith("note: elastic-001: ") and "of 64 particles" in line and "det F" in line
    assert float(line.partition(" s; ")[0].rpartition(" at ")[2]) > 0.04  # of the whole, and not of a segment of 40 substeps


def test_scenes(tmp_path, capsys):
    entry = {
        "name": "Ball",
        "scene": {"domain": [[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]], "gravity": [0.0, -9.8, 0.0], "walls": {"contact": "separate"}},
        "model": {"density": 1000.0, "elasticity": SOFT},
        "body": {"shape": "ball", "centre": [0.5, 0.3, 0.5], "radius": 0.15, "spacing": 0.06, "velocity": [0.0, -6.0, 0.0]},
        "discretisation": {"grid": 12, "dt": 1e-3},
        "substeps": 60,
    }
    (tmp_path / "scenes.yaml").write_text(yaml.safe_dump({"scenes": [entry], "film": FILM, "device": "cpu"}))
    status, printed, err = run(capsys, "scenes", "--config", tmp_path / "scenes.yaml", "--out", tmp_path / "out")
    assert status == 0, err
    assert "note: Ball: " in printed and "det F" in printed


@pytest.fixture(scope="module")
def crushed(tmp_path_factory):
    """An experiment whose declared model is far too soft for its impact."""
    folder = tmp_path_factory.mktemp("crushed") / "block"
    made.experiment(folder, {}, frames=28, side=4)
    content = yaml.safe_load((folder / "experiment.yaml").read_text())
    content["model"]["elasticity"]["young"] = 60.0
    content["model"]["free"] = []
    (folder / "experiment.yaml").write_text(yaml.safe_dump(content))
    return folder


def test_replay(crushed, tmp_path, capsys):
    status, printed, err = run(capsys, "replay", crushed, "--out", tmp_path / "out", "--device", "cpu")
    assert status == 0, err
    assert "note: throw: " in printed and "det F" in printed


@pytest.mark.slow
def test_diagnose(crushed, tmp_path):
    options = {
        "effects": ["gravity"],
        "draws": 19,
        "max_effects": 1,
        "device": "cpu",
        "progress": False,
        "solver": "material_points",
        "minutes": 0.05,
    }
    found = diagnose(crushed, out=tmp_path / "out", **options)
    content = json.loads((tmp_path / "out" / "diagnosis.json").read_text())
    assert any(line.startswith("before: ") and "det F" in line for line in content["doubts"]["throw"])
    assert "The prediction of throw is doubtful" in found.summary()
    assert "The prediction of throw is doubtful" in (tmp_path / "out" / "report.html").read_text()
