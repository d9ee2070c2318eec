"""model_after.yaml goes back: into `neuido replay`, into `neuido diagnose`, and into a rollout of one's own."""

import json

import numpy as np
import pytest
import torch
import yaml

from neuido.data.measured.experiment import read_experiment
from neuido.discrepancy.problems.body import body_problem
from neuido.discrepancy.problems.body_launches import SEGMENT, segment_of
from neuido.discrepancy.problems.declared_model import ready
from neuido.discrepancy.store import CachedProblem
from neuido.errors import UserError
from neuido.physics.laws.classical import FixedCorotated
from neuido.physics.mpm.simulator import Simulator
from tests.command import run
from tests.discrepancy import made

EFFECTS = {"drag_linear.k": 3.0}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("replay") / "block"
    made.experiment(path, EFFECTS, frames=10, side=4, noise=1e-4)
    return path


@pytest.fixture(scope="module")
def after(folder):
    """What a diagnosis that finds the drag leaves behind, as `body.model_after` writes it."""
    problem = body_problem(read_experiment(folder))
    path = folder.parent / "model_after.yaml"
    path.write_text(yaml.safe_dump(problem.model_after({"young": 6e4, **EFFECTS}, ["drag_linear"])))
    return path


def test_simulate_repeats_the_recordings_under_the_model(folder, after, tmp_path, capsys):
    status, _, err = run(capsys, "replay", folder, "--model", after, "--out", tmp_path / "again", "--device", "cpu")
    assert status == 0, err
    measured, again = read_experiment(folder), read_experiment(tmp_path / "again")
    assert again.model["effects"] == EFFECTS
    assert [r.name for r in again.recordings] == [r.name for r in measured.recordings]
    for a, b in zip(again.recordings, measured.recordings, strict=True):
        assert a.noise is None
        assert (a.x - b.x)[b.seen].square().mean().sqrt() < 1.2e-4  # the noise of the measured one
    plain = body_problem(measured).motion({}, 0)
    assert np.abs(again.recordings[0].x.numpy() - plain).max() > 0.01


@pytest.mark.slow
def test_diagnose_of_the_repeated_recordings_answers_none(folder, after, tmp_path, capsys):
    run(capsys, "replay", folder, "--model", after, "--out", tmp_path / "again", "--device", "cpu")
    options = ["--effects", "drag_linear,viscosity_shear", "--draws", "19", "--device", "cpu"]
    status, out, err = run(capsys, "diagnose", tmp_path / "again", "--out", tmp_path / "out", *options)
    assert status == 0, err
    assert out.startswith("Nothing is missing")
    content = json.loads((tmp_path / "out" / "diagnosis.json").read_text())
    assert content["after"]["young"]["value"] == pytest.approx(6e4, rel=0.02)


def test_ready_is_what_the_problem_simulates(folder, after):
    r = read_experiment(folder)["throw"]
    simulator = Simulator(r.scene, r.body, density=1000.0, device="cpu")
    law = ready(after, simulator)
    with torch.no_grad():
        out = simulator.rollout(90, law.elasticity, law.plasticity, effects=law.effects, every=10)
    problem = body_problem(read_experiment(folder, model=yaml.safe_load(after.read_text())))
    np.testing.assert_allclose(out.x[:, r.track].numpy(), problem.motion({}, 0), atol=1e-5)


def test_ready_takes_fields_over_the_body_and_forces_in_time(folder):
    r = read_experiment(folder)["throw"]
    simulator = Simulator([r.scene] * 2, [r.body] * 2, density=1000.0, device="cpu")
    base = {"density": 1000.0, "elasticity": {"law": "fixed_corotated", "young": 6e4, "poisson": 0.3}, "free": ["young"]}
    for effects in ({"stiffness_gradient.x": 0.5}, {"time_force.y0": 2.0, "time_force.y4": -2.0, "time_force.interval": 0.02}):
        law = ready({**base, "effects": effects}, simulator)
        problem = body_problem(read_experiment(folder, model={**base, "plasticity": {"law": "identity"}, "effects": effects}))
        with torch.no_grad():
            out = simulator.rollout(90, law.elasticity, law.plasticity, effects=law.effects, every=10)
        count = len(r.body.x)
        for s in range(2):
            np.testing.assert_allclose(out.x[:, s * count : (s + 1) * count][:, r.track].numpy(), problem.motion({}, 0), atol=1e-5)
    with pytest.raises(UserError, match="interval"):
        ready({**base, "effects": {"time_force.y0": 2.0}}, simulator)


@pytest.mark.parametrize(
    ("more", "word"),
    [
        (["FOLDER", "--model", "nowhere.yaml"], "nowhere.yaml"),
        (["nowhere"], "nowhere"),
        (["FOLDER", "--device", "abacus"], "abacus"),
    ],
)
def test_wrong_option_is_one_line(more, word, folder, tmp_path, capsys):
    given = [str(folder) if part == "FOLDER" else part for part in more]
    status, _, err = run(capsys, "replay", *given, "--out", tmp_path / "out")
    assert (status, len(err.splitlines())) == (2, 1), err
    assert word in err
    assert not (tmp_path / "out").exists()


def test_a_folder_that_is_there_is_not_overwritten(folder, capsys):
    status, _, err = run(capsys, "replay", folder, "--out", folder)
    assert (status, len(err.splitlines())) == (2, 1)
    assert "is in use" in err and "experiment.yaml" in err


def test_long_recordings_run_in_pieces(folder, monkeypatch):
    """Pieces fit their recording, and what is kept of one of many substeps are its frames: memory does not grow with the substeps."""
    for steps, every in ((32_000, 400), (26_910, 1), (26_911, 1), (90, 10), (5000, 5000)):
        piece = segment_of(steps, every)
        assert steps % piece == 0
        assert piece % every == 0
        assert piece == every or piece <= SEGMENT
    assert segment_of(32_000, 10) == 200
    monkeypatch.setattr("neuido.discrepancy.problems.body_launches.SEGMENT", 30)
    problem = body_problem(read_experiment(folder))
    asked, rollout = [], Simulator.rollout

    def watched(self, steps, *args, **options):
        asked.append((steps, options["segment"]))
        return rollout(self, steps, *args, **options)

    monkeypatch.setattr(Simulator, "rollout", watched)
    problem.predict([{}], 0)
    assert asked == [(90, 30)]
    (simulator,) = problem._simulators.values()
    (cached,) = simulator.cache._rollouts.values()
    assert len(cached.tape.x) == 10


def test_settings_and_recordings_side_by_side_are_those_one_after_the_other(folder):
    problem = body_problem(read_experiment(folder))
    asks = [([{"young": 6e4}, {"young": 7e4}], n, s) for n in range(len(problem.recordings)) for s in range(problem.settings)]
    for ask, rows in zip(asks, problem.predict_several(asks), strict=True):
        np.testing.assert_array_equal(rows, problem.predict(*ask))


def test_long_recordings_are_stored_and_told_of_in_small_calls(folder, tmp_path, monkeypatch):
    problem = body_problem(read_experiment(folder))
    points = [{"young": 6e4 + 100 * i} for i in range(6)]
    for effort, calls in ((1e3, [6]), (1e9, [4, 2])):
        ticks: list[int] = []
        monkeypatch.setattr(type(problem), "effort", lambda self, recording, setting=0, effort=effort: effort)
        cached = CachedProblem(problem, tmp_path / f"{effort:g}", tick=ticks.append)
        rows = cached.predict(points, 0)
        assert ticks == calls
        np.testing.assert_array_equal(rows, problem.predict(points, 0))


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA")
def test_pieces_on_a_gpu_are_the_whole(folder):
    r = read_experiment(folder)["throw"]
    simulator = Simulator(r.scene, r.body, density=1000.0, device="cuda")
    with torch.no_grad():
        whole, pieces = (simulator.rollout(90, FixedCorotated(6e4, 0.3), every=10, segment=segment) for segment in (None, 30))
    torch.testing.assert_close(whole.x, pieces.x, atol=1e-5, rtol=0.0)
