"""Diagnosis of a model whose law was read from video: a neural law in place of a classical one."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

from neuido.data.measured.experiment import read_experiment
from neuido.discrepancy.problems.body import body_problem
from neuido.discrepancy.problems.declared_model import classical, laws_of, ready, with_law
from neuido.models.inference.law_file import load_law, save_law
from neuido.models.operator.dynamics_operator import IntrinsicDynamicsOperator
from neuido.physics.mpm.simulator import Simulator
from tests.command import run
from tests.discrepancy import made

DRAG = {"drag_linear.k": 3.0}
FACTOR = 0.7


@pytest.fixture(scope="module")
def law(tmp_path_factory) -> Path:
    """The law file of NCLaw's jelly, as `neuido predict` writes it."""
    path = tmp_path_factory.mktemp("law") / "jelly.safetensors"
    operator = IntrinsicDynamicsOperator.load()
    save_law(path, operator, operator.latent("jelly"))
    return path


@pytest.fixture(scope="module")
def folder(law, tmp_path_factory) -> Path:
    """A block of that law, 0.7 times as stiff, with drag."""
    path = tmp_path_factory.mktemp("neural") / "block"
    elastic, plastic = load_law(law)
    made.experiment(path, DRAG, frames=12, side=4, noise=2e-4, laws=(elastic.scaled(torch.tensor([FACTOR])), plastic))
    return path


@pytest.mark.parametrize("weights", ["pretrained", "pretrained-objective"])
def test_scaled_law_has_the_scaled_stress(weights):
    operator = IntrinsicDynamicsOperator.load(weights)
    elastic, _ = operator.laws(operator.latent("jelly").detach())
    F = torch.eye(3) + 0.1 * torch.randn(5, 3, 3, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(elastic.scaled(torch.tensor([FACTOR]))(F), FACTOR * elastic(F), rtol=1e-4, atol=1e-2)
    assert float(elastic.scaled(torch.tensor([1.0, 2.0])).modulus()[1]) == pytest.approx(2 * float(elastic.modulus()), rel=1e-5)


def test_typical_sizes_are_those_of_the_law(law, folder):
    young = classical(with_law(read_experiment(folder), str(law))).model["elasticity"]["young"]
    assert young == pytest.approx(1e5, rel=0.1)  # NCLaw's jelly


@pytest.mark.slow
def test_drag_on_a_neural_law_is_named_and_the_model_goes_back(law, folder, tmp_path, capsys):
    out = tmp_path / "out"
    options = ["--effects", "drag_linear,viscosity_shear", "--draws", "19", "--device", "cpu"]
    status, line, err = run(capsys, "diagnose", folder, "--law", law, "--out", out, *options)
    assert status == 0, err
    assert line.startswith("The model lacks linear air drag: k = ")
    content = json.loads((out / "diagnosis.json").read_text())
    assert content["effects"][0]["parameters"]["k"]["value"] == pytest.approx(3.0, rel=0.1)
    assert content["after"]["stiffness"]["value"] == pytest.approx(FACTOR, rel=0.1)
    assert {r["name"] for r in content["rejected"]} >= {"viscosity_shear", "yield", "hardening"}
    model = yaml.safe_load((out / "model_after.yaml").read_text())
    assert model["law"]["file"] == "law.safetensors"
    assert model["free"] == ["stiffness"]

    r = read_experiment(folder)["drop"]
    simulator = Simulator(r.scene, r.body, density=1000.0, device="cpu")
    found = ready(out / "model_after.yaml", simulator)
    with torch.no_grad():
        moved = simulator.rollout(110, found.elasticity, found.plasticity, effects=found.effects, every=10)
    left = (moved.x[:, r.track] - r.x)[r.seen]
    assert float(left.square().mean().sqrt()) < 4e-4

    status, _, err = run(capsys, "replay", folder, "--model", out / "model_after.yaml", "--out", tmp_path / "again")
    assert status == 0, err
    again = read_experiment(tmp_path / "again")
    assert Path(again.model["law"]["file"]) == tmp_path / "again" / "law.safetensors"
    np.testing.assert_allclose(again["drop"].x.numpy(), moved.x[:, r.track].numpy(), atol=1e-5)
    assert np.abs(body_problem(again).predict([{}], 1)[0] - body_problem(again).recordings[1].y).max() < 1e-5


def test_laws_of_several_points_are_rows(law, folder):
    model = with_law(read_experiment(folder), str(law)).model
    elastic, _ = laws_of(model, [{"stiffness": 1.0}, {"stiffness": 2.0}, {}])
    assert elastic.modulus().tolist() == pytest.approx([float(elastic.modulus()[0]) * f for f in (1, 2, 1)], rel=1e-5)


@pytest.mark.parametrize(
    ("given", "word"),
    [
        ({"file": "nowhere.safetensors"}, "nowhere.safetensors"),
        ({"file": "experiment.yaml"}, "experiment.yaml"),
        ({"file": "x", "colour": 1}, "colour"),
        ({"file": 3}, "file"),
        ({"stiffness": 1.0}, "file"),
        ({"file": "x", "stiffness": -1.0}, "stiffness"),
        ("jelly", "law"),
    ],
)
def test_wrong_law_in_the_folder_is_one_line(given, word, tmp_path, capsys):
    made.experiment(tmp_path / "block", {}, frames=5, side=4)
    path = tmp_path / "block" / "experiment.yaml"
    content = yaml.safe_load(path.read_text())
    content["model"]["law"] = given
    path.write_text(yaml.safe_dump(content))
    status, _, err = run(capsys, "diagnose", tmp_path / "block", "--out", tmp_path / "out", "--device", "cpu")
    assert (status, len(err.splitlines())) == (2, 1), err
    assert word in err


def test_wrong_law_option_is_one_line(folder, tmp_path, capsys):
    (tmp_path / "a.safetensors").write_bytes(b"nothing")
    made.track(tmp_path / "balls")
    for where, law, word in (
        (folder, "nowhere.safetensors", "nowhere.safetensors"),
        (folder, tmp_path / "a.safetensors", "a.safetensors"),
        (tmp_path / "balls", "nowhere.safetensors", "experiments"),
    ):
        status, _, err = run(capsys, "diagnose", where, "--law", law, "--out", tmp_path / "out", "--device", "cpu")
        assert (status, len(err.splitlines())) == (2, 1), err
        assert word in err
