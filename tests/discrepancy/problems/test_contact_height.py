"""Where a grid lets a body touch the floor: a lift of the colliders, how fits follow it, and what it must not move."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from neuido.discrepancy.inference.search import base_fits, next_effect
from neuido.discrepancy.inference.search.attribution import diagnose
from neuido.discrepancy.problems.body import body_problem
from neuido.discrepancy.problems.settings import CONTACT_HEIGHT, SETTINGS
from neuido.discrepancy.report import answer_content
from neuido.discrepancy.workflow import restricted, solved_by
from neuido.types import Box
from tests.discrepancy import made

LIFTED = [i for i, s in enumerate(SETTINGS) if s.lift]
PLAIN = {i: SETTINGS.index(replace(SETTINGS[i], lift=0.0)) for i in LIFTED}


@pytest.fixture(scope="module")
def experiment(tmp_path_factory):
    return made.experiment(tmp_path_factory.mktemp("lift") / "block", {}, frames=28)


@pytest.fixture(scope="module")
def problem(experiment):
    return body_problem(experiment)


@pytest.mark.parametrize("lifted", LIFTED, ids=lambda i: SETTINGS[i].name)
def test_a_lift_moves_what_touches_and_nothing_that_flies(lifted, problem):
    scene = problem.measured[0].scene
    plain, higher = (problem.motion({}, 0, s)[..., 1] for s in (PLAIN[lifted], lifted))
    flight = plain.min(axis=1) > 0.1 + 2.5 * scene.dx
    assert flight[:5].all() and not flight.all()
    assert np.abs(higher - plain)[:5].max() < 0.005 * scene.dx, "but for where its particles lie in their cells"
    lowest = higher.min() - plain.min()
    assert lowest == pytest.approx(0.5 * scene.dx, rel=0.35)


def test_a_contact_height_is_the_lift_of_a_setting(problem):
    (lifted,) = LIFTED
    height = SETTINGS[lifted].lift * problem.measured[0].scene.dx
    rows = [problem.predict([point], 1, s) for point, s in (({CONTACT_HEIGHT: height}, 0), ({}, lifted))]
    np.testing.assert_allclose(*rows, atol=1e-6)


def test_a_place_in_space_stays_where_it_is(problem):
    """A pull to a place acts from the start on, before anything is touched."""
    pull = {"position_force.k": 12.0, "position_force.x": 0.5, "position_force.y": 0.2, "position_force.z": 0.5}
    plain, higher = (problem.motion(pull | height, 1)[:5] for height in ({}, {CONTACT_HEIGHT: 0.03}))
    np.testing.assert_allclose(higher, plain, atol=2e-4)
    assert np.abs(plain - problem.motion({}, 1)[:5]).max() > 1e-3


def test_which_settings_are_directions(experiment, problem):
    names = [SETTINGS[s].name for s in problem.others(0)]
    assert names == ["0.5 of the step", "1.2 times the cells, 0.5 of the step", "colliders 0.5 cells higher"]
    elements = problem.solvers[1]
    names = [SETTINGS[s].name for s in problem.others(elements)]
    assert len(names) == 6 and names[4:] == ["finite elements, 0.6 a particle", "finite elements, 6 a cell"]
    assert not any(SETTINGS[s].lift for s in problem.others(elements))

    def changed(**parts):
        recordings = tuple(replace(r, scene=replace(r.scene, **parts)) for r in experiment.recordings)
        return body_problem(replace(experiment, recordings=recordings))

    held = Box((0.3, 0.3, 0.3), (0.7, 0.45, 0.7))
    for other in (changed(colliders=()), changed(clamps=(held,))):
        assert [SETTINGS[s].name for s in other.others(0)][1] == "0.85 times the cells"
        assert not any(SETTINGS[s].lift for s in (*other.others(0), *other.others(elements)))
        assert other.recentred({}, 0, [0.0, 1.0, 1.0]) == {}


def test_the_height_goes_where_the_amounts_lead(problem):
    dx = problem.measured[0].scene.dx
    assert problem.recentred({}, 0, [0.3, -1.0, 0.05]) == {}, "too little to be worth another fit"
    assert problem.recentred({"young": 1.0}, 0, [0.0, 0.0, -1.0]) == {"young": 1.0, CONTACT_HEIGHT: pytest.approx(0.5 * dx)}
    assert problem.recentred({CONTACT_HEIGHT: 0.7 * dx}, 0, [0.0, 0.0, -3.0])[CONTACT_HEIGHT] == pytest.approx(0.8 * dx)


@pytest.mark.parametrize("effect", ["", "viscosity_shear"])
@pytest.mark.slow
def test_a_floor_that_is_elsewhere_is_no_effect(effect, experiment):
    """The floor lies 0.4 cells higher than it is declared: where the height is held, the modulus and a viscosity take its place."""
    problem = restricted(solved_by(body_problem(experiment), "material_points"), "viscosity_shear,drag_linear,restitution")
    height = 0.4 * problem.measured[0].scene.dx
    truth = {"young": 6e4, CONTACT_HEIGHT: height} | ({"viscosity_shear.eta": 90.0} if effect else {})
    rng = np.random.default_rng(3)
    for n, own in enumerate(problem.recordings):
        own.y[:] = problem.predict([truth], n)[0] + own.noise * rng.standard_normal(len(own.y))
    start = base_fits.base_fit(next_effect.new_search(problem))
    found = diagnose(problem, draws=39, most=1)
    assert [t.candidate.name for t in found.effects] == ([effect] if effect else [])
    assert found.after[CONTACT_HEIGHT] == pytest.approx(height, rel=0.2)
    assert found.after["young"] == pytest.approx(6e4, rel=0.03)
    assert found.errors["after"]["drop"] < 1.15 * problem.recordings[1].noise * 3**0.5
    if effect:
        assert found.after["viscosity_shear.eta"] == pytest.approx(90.0, rel=0.1)
    else:
        assert start.fit.point[CONTACT_HEIGHT] == pytest.approx(height, rel=0.2)
    told = answer_content._settings(found)["contact_height"]
    assert told == {"before": found.before.get(CONTACT_HEIGHT, 0.0), "after": found.after[CONTACT_HEIGHT], "unit": "m"}
    assert CONTACT_HEIGHT not in str(problem.model_after(found.after, [effect]))


def test_bodies_that_are_lifted_start_where_they_are_seen(problem):
    frames = problem._moved({CONTACT_HEIGHT: 0.02}, 0)
    torch.testing.assert_close(frames.x[0, 0], problem.measured[0].body.x, atol=1e-6, rtol=0.0)
