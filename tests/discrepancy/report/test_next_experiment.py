"""The next experiment: distances against closed forms, and a catalogue whose best change is known."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from neuido.data.measured.experiment import read_experiment
from neuido.data.measured.track import read_tracks
from neuido.data.undeclared import Case, make_undeclared
from neuido.discrepancy.inference import floors
from neuido.discrepancy.inference.floors import Floor, Round, Stand, Trial
from neuido.discrepancy.inference.least_squares import Fit
from neuido.discrepancy.inference.search.attribution import Diagnosis
from neuido.discrepancy.problems.body import body_problem
from neuido.discrepancy.problems.tracks.track_problem import TrackProblem
from neuido.discrepancy.report import next_experiment
from tests.discrepancy import made


def diagnosis(problem, points: dict[str, dict[str, float]]) -> Diagnosis:
    """One whose class has members with these points."""
    trials = []
    for name, point in points.items():
        c = next(c for c in problem.candidates if c.name == name)
        fit = Fit(point, tuple(point), 1.0, np.empty(0), 1, True)
        trials.append(Trial(c, Stand(fit, None, np.ones(2)), 1.0))
    floor = Floor({}, {}, {}, {})
    step = Round({}, np.ones(2), trials, trials[0], trials, 0.005, floor, np.ones(2))
    point = trials[0].fit.point
    return Diagnosis(problem, "class", [step], {}, point, floors.split(problem), {}, {}, {}, {}, {}, {}, {}, 0, {})


def test_distance_is_half_the_whitened_square_after_a_refit():
    rng = np.random.default_rng(0)
    a, b = rng.standard_normal((2, 50))
    sigma = np.full(50, 0.5)
    none = [np.empty((50, 0))] * 2
    odds, pair = next_experiment._nearest(np.stack([a, b]), none, sigma)
    assert odds == pytest.approx(0.5 * np.sum((a - b) ** 2) / 0.25 / next_experiment.RUNS)
    assert pair == (0, 1)
    known = [1e3 * (a - b)[:, None], np.empty((50, 0))]  # one rival can imitate the other: nothing tells them apart
    assert next_experiment._nearest(np.stack([a, b]), known, sigma)[0] < 1e-3
    held = [1e-3 * (a - b)[:, None], np.empty((50, 0))]  # its parameter is known too well for that
    assert next_experiment._nearest(np.stack([a, b]), held, sigma)[0] > 0.9 * odds


def test_nearest_pair_counts():
    rows = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 9.0]])
    odds, pair = next_experiment._nearest(rows, [np.empty((2, 0))] * 3, np.ones(2))
    assert pair == (0, 1)
    assert odds == pytest.approx(0.5 / next_experiment.RUNS)


@pytest.fixture(scope="module")
def body(tmp_path_factory):
    folder = tmp_path_factory.mktemp("body") / "block"
    made.experiment(folder, {}, frames=8)
    return body_problem(read_experiment(folder))


def test_spin_tells_a_pull_to_a_place_from_a_lift(body):
    """A steady pull and a lift that grows with speed, alike in the launch that was recorded, differ when the speed changes."""
    points = {"uniform_acceleration": {"uniform_acceleration.x": -1.2}, "drag_linear": {"drag_linear.k": 1.5}}
    found = next_experiment.propose(diagnosis(body, points))
    assert found["tells_apart"] == ["uniform_acceleration", "drag_linear"]
    assert found["expected_log_odds"] > 0
    assert all(o["expected_log_odds"] <= found["expected_log_odds"] for o in found["others"])
    assert found["change"] in [name for name, _ in next_experiment.changes(body.measured[0], 1000.0)]


def test_nothing_to_tell_apart(body):
    d = diagnosis(body, {"drag_linear": {"drag_linear.k": 1.5}})
    assert next_experiment.propose(d) is None


def test_rivals_that_a_longer_step_does_not_bear_are_told_apart_with_the_suggested_one(body):
    quick = body.quick(0)
    assert quick != 0
    viscous = {"viscosity_shear.eta": 100.0}
    while body.margin(viscous, quick) >= 0.0:
        viscous = {name: 1.2 * eta for name, eta in viscous.items()}
    assert body.margin(viscous) > 0.0
    d = diagnosis(body, {"viscosity_shear": viscous, "drag_linear": {"drag_linear.k": 1.5}})
    assert not np.isfinite(body.predict([viscous], 0, quick)).all()
    assert next_experiment.propose(d)["tells_apart"] == ["viscosity_shear", "drag_linear"]


def test_a_change_has_margins_of_its_own(body):
    """What was made for the steps of both recordings was kept for the changed one: a motion of elements that failed had no margin."""
    elements = body.solvers[1]
    margin = body.margin({}, elements)
    _, changed, _ = next(next_experiment._bodies(body, {}, elements))
    assert len(changed.measured) < len(body.measured)
    assert changed.margin({}, elements) == pytest.approx(margin)


def test_changes_do_what_they_say(body):
    r = body.measured[0]
    found = dict(next_experiment.changes(r, 1000.0))
    mean = r.body.v.mean(dim=0)
    torch.testing.assert_close(found["launch it at twice the speed"].body.v.mean(dim=0), 2 * mean)
    mirrored = found["spin it the other way round"].body.v
    torch.testing.assert_close(mirrored - mean, mean - r.body.v, atol=1e-5, rtol=1e-5)
    turned = found["turn the body by 90 degrees about x before the launch"]
    torch.testing.assert_close(turned.body.x.mean(dim=0), r.body.x.mean(dim=0))
    apart = [torch.cdist(x.double(), x.double()) for x in (turned.body.x, r.body.x)]
    torch.testing.assert_close(*apart, atol=1e-6, rtol=1e-5)
    assert not torch.allclose(turned.body.x, r.body.x)
    loaded = next(c for name, c in found.items() if name.startswith("attach"))
    assert loaded.scene.attached_masses[-1].mass == pytest.approx(0.5 * 27.0, rel=1e-3)
    assert found["give the floor a friction of 0.6"].scene.colliders[0].friction == 0.6


def test_unreachable_orientation_is_left_out(body):
    r = body.measured[0]
    long = r.body.x.clone()
    long[:, 0] = 0.5 + 3.0 * (long[:, 0] - 0.5)  # upright it would stand below the floor
    low = replace(r, body=r.body._replace(x=long - torch.tensor([0.0, 0.2, 0.0])))
    assert next_experiment._turned(low, 2) is None


def test_tracks(tmp_path):
    made.track(tmp_path / "balls")
    problem = TrackProblem(read_tracks(tmp_path / "balls"), "ball-0")
    d = diagnosis(problem, {"drag_quadratic": {"drag_quadratic.k": 0.12}, "drag_linear": {"drag_linear.k": 0.9}})
    found = next_experiment.propose(d)
    assert set(found["tells_apart"]) == {"drag_quadratic", "drag_linear"}
    assert found["expected_log_odds"] > 1


def test_material_tests(tmp_path):
    from neuido.discrepancy.problems.specimens.material import MaterialProblem

    made.material_test(tmp_path / "rubber")
    problem = MaterialProblem(tmp_path / "rubber")
    d = diagnosis(problem, {"strain_stiffening": {"strain_stiffening.k": 0.05}, "second_invariant": {"second_invariant.c": 0.3}})
    found = next_experiment.propose(d)
    assert set(found["tells_apart"]) == {"strain_stiffening", "second_invariant"}
    assert "stretch" in found["change"] or "shear" in found["change"]


@pytest.mark.parametrize(
    ("kind", "rival", "word"),
    [
        ("bingham", {"power_law": {"power_law.n": -0.4, "power_law.reference": 1.0}}, "shear rates"),
        ("thixotropy", {"power_law": {"power_law.n": -0.3, "power_law.reference": 1.0}}, "shear rates"),
        ("hysteresis", {"viscosity_shear": {"viscosity_shear.eta": 100.0}}, "frequencies"),
    ],
)
def test_curves_of_a_rheometer_are_told_apart_at_other_rates(tmp_path, kind, rival, word):
    """A fluid has no elasticity, so that a stretch of it cannot be proposed."""
    from neuido.data.measured.material_test import read_material_tests
    from neuido.discrepancy.problems.specimens.material import MaterialProblem

    for seed in range(20):
        make_undeclared(seed, tmp_path / str(seed), case=Case(measured="material_test", kind=kind), device="cpu", progress=False)
        if read_material_tests(tmp_path / str(seed)).tests[0].mode in ("flow_curve", "oscillation"):
            break
    problem = MaterialProblem(tmp_path / str(seed))
    start = next(c for c in problem.candidates if c.name == kind).starts[-1]
    found = next_experiment.propose(diagnosis(problem, {kind: dict(start), **rival}))
    assert set(found["tells_apart"]) == {kind, *rival}
    assert word in found["change"] and found["expected_log_odds"] > 0
