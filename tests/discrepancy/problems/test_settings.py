"""What the other settings of the discretisation say of the data: directions that a prediction may hold, one amount for all recordings."""

from pathlib import Path

import numpy as np
import pytest

from neuido.commands.demo.closed_loop import ELASTIC, record
from neuido.data.undeclared.motion import Solver, simulate_motion
from neuido.discrepancy.inference import discretisation, floors
from neuido.discrepancy.inference.bootstrap import gain
from neuido.discrepancy.inference.floors import REACH, Floor, Part
from neuido.discrepancy.inference.search import base_fits, next_effect
from neuido.discrepancy.inference.search.attribution import diagnose
from neuido.discrepancy.problems.body import body_problem
from neuido.discrepancy.workflow import restricted
from tests.discrepancy.inference.test_decisions import FALLS, over
from tests.discrepancy.inference.test_rounds import NOISE, Line, T

N = len(T)
WHOLE = np.ones(N, bool)
PARTS = [Part(0, WHOLE, True, "one"), Part(1, WHOLE, False, "two")]


def floor(rng: np.random.Generator, *, noise: float = NOISE) -> Floor:
    """Two settings that differ by a wave and by a line, and a nuisance, in two recordings."""
    D = {n: np.stack([np.sin((20 + 9 * n) * T), T], axis=1) for n in (0, 1)}
    return Floor(
        {0: noise, 1: noise},
        {n: np.full(N, 1 / noise) for n in D},
        D,
        {n: np.sqrt(np.mean(d**2, axis=1)) for n, d in D.items()},
        {n: rng.normal(size=(N, 1)) for n in D},
    )


def test_amounts_are_those_of_the_fitted_recordings():
    rng = np.random.default_rng(0)
    f = floor(rng)
    true = np.array([-1.2, 0.4])
    residuals = {n: f.differences[n] @ true + 2.0 * f.nuisances[n][:, 0] + NOISE * rng.normal(size=N) for n in (0, 1)}
    amounts = f.amounts(residuals, PARTS)
    assert amounts == pytest.approx(true, abs=0.01)
    assert f.amounts(residuals | {1: 5.0 * residuals[1]}, PARTS) == pytest.approx(amounts)  # what is held out has no say
    left = f.settle(residuals[1] - f.differences[1] @ amounts, PARTS[1])
    assert np.std(left) == pytest.approx(NOISE, rel=0.2)
    # and no more of a setting than another grid would be off by
    assert f.amounts({n: 9.0 * f.differences[n] @ true for n in (0, 1)}, PARTS) == pytest.approx([-REACH, REACH], abs=1e-6)
    assert f.without(0).amounts(residuals, PARTS)[0] == 0.0


def test_whitened_residuals_leave_the_differences_out():
    rng = np.random.default_rng(1)
    f = floor(rng)
    whiten = f.whitener(PARTS)
    noise = NOISE * rng.normal(size=N)
    assert np.sum(whiten(noise, 0) ** 2) == pytest.approx(N, rel=0.3)
    assert np.sum(whiten(noise + f.differences[0] @ [0.7, -0.5], 0) ** 2) == pytest.approx(np.sum(whiten(noise, 0) ** 2), rel=0.05)
    assert np.sum(whiten(noise + 0.1 * np.cos(55 * T), 0) ** 2) > 20 * N
    both = np.stack([noise, T], axis=1)
    np.testing.assert_allclose(whiten(both, 0), np.stack([whiten(noise, 0), whiten(T, 0)], axis=1), atol=1e-12)


def test_gain_is_the_held_out_one_where_the_fitted_recordings_are_noise():
    fitted, noise = [True, False], np.full(2, NOISE**2)
    assert gain(np.array([9.0, 16.0]) * noise, noise, fitted, noise) == pytest.approx(np.log(3.0))
    assert gain(np.array([1.3, 16.0]) * noise, noise, fitted, noise) == pytest.approx(np.log(4.0))
    assert gain(np.array([1.3, 16.0]) * noise, np.array([2.5, 1.0]) * noise, fitted, noise) < 0
    # a draw is at the noise in any case: it is weighed as the data are
    draw = np.array([1.3, 16.0]) * noise
    assert gain(draw, noise, fitted, noise, data=np.array([9.0, 16.0]) * noise) == pytest.approx(0.5 * np.log(1.3))
    assert gain(draw, noise, fitted, noise, data=draw) == pytest.approx(np.log(4.0))
    assert gain(np.array([4.0]), np.array([1.0]), [True], np.ones(1)) == pytest.approx(np.log(2.0))
    # one recording that stays far off does not hide what the other one shows
    before, after = np.array([16.0, 16.0, 400.0]), np.array([1.0, 1.0, 400.0])
    assert gain(before, after, [True, False, False], 0.1 * np.ones(3)) == pytest.approx(np.log(2.0))


def test_a_fit_is_weighed_by_no_more_than_is_left():
    search = next_effect.new_search(Line(lambda t: 3.0 * t))
    start = base_fits.base_fit(search)
    assert np.allclose(start.floor.weight[0], 1 / NOISE, rtol=0.05)  # nothing but noise is left
    wide = discretisation.floor_at(search.lab, start.fit.point)
    assert wide.weight[0].min() < 0.1 / NOISE
    assert np.allclose(discretisation.sharpened(search.lab, wide, np.full(2, 1e3)).weight[0], wide.weight[0])


class Bent(Line):
    """Data of a fourth of the step where the suggested one and half of it are at hand: an error as the step's square, which goes with a."""

    def __init__(self, **options) -> None:
        super().__init__(lambda t: 3.0 * t + (1 / 16) * 0.3 * 3.0 * np.sin(25 * t), **options)
        self.__dict__["candidates"] = ()

    def predict(self, points, recording, setting=0):
        rows = super().predict(points, recording, 0)
        size = np.array([p.get("a", 1.0) for p in points])[:, None] * 0.3 * (1.0, 0.25)[setting]
        return rows + size * np.sin(25 * T)


def test_a_prediction_goes_on_to_a_finer_step(monkeypatch):
    found = diagnose(Bent())
    assert found.answer == "none"
    assert found.errors["after"]["two"] == pytest.approx(NOISE, rel=0.2)
    assert found.one_setting["after"]["two"] > 0.3
    assert found.amounts["after"] == pytest.approx([-1.25], abs=0.05)  # (1 - 1/16) / (1 - 1/4)
    low, high = found.intervals["a"]
    assert low < 3.0 < high
    monkeypatch.setattr(floors.Floor, "amounts", lambda self, residuals, parts: np.zeros(1))
    assert diagnose(Bent()).errors["after"]["two"] > 0.1


@pytest.mark.parametrize("effect", ["", "viscosity_shear"])
@pytest.mark.slow
def test_a_body_on_a_finer_grid(effect, tmp_path: Path):
    """Half as many cells again and half the step: where a fit to one setting cannot tell the grid from a viscosity."""
    experiment = record(tmp_path / "block", {}, launches=FALLS, scene=over(0.2), frames=13)
    problem = restricted(body_problem(experiment), "viscosity_shear,drag_linear")
    solver = Solver("finer", 20, 5e-4)
    bodies = [r.body for r in experiment.recordings]
    truth = {"viscosity_shear.eta": 150.0} if effect else {}
    motion = simulate_motion(solver, experiment.scene, bodies, ELASTIC, truth, seconds=0.12, interval=0.01)
    rng = np.random.default_rng(3)
    for r, own, x in zip(experiment.recordings, problem.recordings, motion.x, strict=True):
        seen = r.seen.numpy()[1:]
        own.y[:] = (x[1:, r.track.numpy()] + own.noise * rng.standard_normal((12, len(r.track), 3)))[seen].reshape(-1)
    found = diagnose(problem, draws=39, most=1)
    assert [t.candidate.name for t in found.effects] == ([effect] if effect else [])
    assert found.errors["after"]["b"] < 0.6 * found.one_setting["after"]["b"]
    if effect:
        assert found.after["viscosity_shear.eta"] == pytest.approx(150.0, rel=0.15)
        assert found.errors["before"]["b"] > 3 * found.errors["after"]["b"]
    assert len(found.amounts["after"]) == len(problem.others(found.setting))
