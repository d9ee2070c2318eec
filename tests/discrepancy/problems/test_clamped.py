"""Bodies with clamps that move and forces that were measured, as a problem and diagnosed."""

import numpy as np
import pytest
import yaml

import neuido
from neuido.data.measured.experiment import read_experiment, write_experiment
from neuido.data.undeclared import Case, make_undeclared
from neuido.discrepancy.applied_model import replay
from neuido.discrepancy.problems.clamped import clamped_problem
from neuido.errors import UserError


def made(folder, kind, seed, **options):
    """A made bar; return its folder and its key."""
    key = make_undeclared(seed, str(folder), case=Case(measured="driven", kind=kind, **options), device="cpu", progress=False)
    return folder, yaml.safe_load(key.read_text())


@pytest.fixture(scope="module")
def bar(tmp_path_factory):
    """A problem without an effect, and the true modulus."""
    folder, key = made(tmp_path_factory.mktemp("made") / "bar", "none", 3, seconds=0.12)
    return clamped_problem(read_experiment(folder)), key["material"]["young"]


def test_the_truth_leaves_noise_in_points_and_forces(bar):
    problem, young = bar
    for n, own in enumerate(problem.recordings):
        left = (problem.predict([{"young": young}], n)[0] - own.y) / own.noise
        count = problem.coordinates(n)
        assert [s.name for s in problem.series[n]] == ["lower_x", "lower_y", "upper_x", "upper_y"]
        for part in (left[:count], left[count:]):
            assert np.mean(part**2) == pytest.approx(1.0, abs=4 * np.sqrt(2 / len(part)))


def test_a_force_tells_the_modulus(bar):
    """Forces change in proportion to the modulus, which the points alone hardly tell, since the path is given."""
    problem, young = bar
    count = problem.coordinates(0)
    rows = problem.predict([{"young": young}, {"young": 1.1 * young}], 0)
    by_points, by_forces = (np.sqrt(np.mean(d**2)) / problem.recordings[0].noise for d in np.split(rows[1] - rows[0], [count]))
    assert by_forces > 2 and by_forces > by_points


def test_errors_of_the_instruments(bar):
    problem, young = bar
    r, count = problem.recordings[0], problem.coordinates(0)
    plain, scaled, shifted, longer = problem.predict(
        [{"young": young}, {"young": young, "force_scale_upper:pull1": 0.02}, {"young": young, "force_zero_lower_y:pull1": 0.5},
         {"young": young, "path_scale:pull1": 0.01}], 0)  # fmt: skip
    sizes = [len(s.values) for s in problem.series[0]]
    lower_x, lower_y, upper_x, upper_y = np.split(np.arange(count, len(plain)), np.cumsum(sizes)[:-1])
    upper = np.concatenate([upper_x, upper_y])
    np.testing.assert_allclose(scaled[upper], 1.02 * plain[upper], rtol=1e-6)
    np.testing.assert_allclose(np.delete(scaled, upper), np.delete(plain, upper), rtol=1e-12)
    np.testing.assert_allclose(shifted[lower_y] - plain[lower_y], 0.5 * r.noise / problem.series[0][1].noise, rtol=1e-6)
    assert np.abs(longer[:count] - plain[:count]).max() > 1e-4
    assert {p.name for p in problem.nuisances} >= {"force_scale_upper:pull1", "force_zero_lower_y:pull2", "path_scale:pull1"}


def test_settings_and_directions_fit_the_data(bar):
    problem, _ = bar
    assert [problem.setting_name(s) for s in range(problem.settings)][-1] == "colliders 0.5 cells higher" and problem.solvers == (0,)
    for n, own in enumerate(problem.recordings):
        patterns = problem.directions(n)
        assert len(patterns) == len(own.y)
        assert np.mean(np.sum(patterns**2, axis=1)) == pytest.approx(1.0)


def test_noise_that_is_not_stated_is_estimated(bar, tmp_path):
    experiment = read_experiment(bar[0].experiment.folder)
    write_experiment(experiment, tmp_path / "bar")
    content = yaml.safe_load((tmp_path / "bar" / "experiment.yaml").read_text())
    for r in content["recordings"]:
        r.pop("noise")
        for own in r["clamps"].values():
            own.pop("noise", None)
    (tmp_path / "bar" / "experiment.yaml").write_text(yaml.safe_dump(content))
    found = clamped_problem(read_experiment(tmp_path / "bar"))
    assert found.recordings[0].noise is None
    for s, true in zip(found.series[0], bar[0].series[0], strict=True):
        assert 0.3 < s.noise / true.noise < 5
    assert found.scales[0] == pytest.approx(bar[0].scales[0], rel=0.5)


def test_a_replay_has_its_forces(bar, tmp_path):
    problem, young = bar
    model = problem.model_after({"young": young}, [])
    (tmp_path / "model.yaml").write_text(yaml.safe_dump({"model": model}))
    replay(problem.experiment.folder, tmp_path / "out", model=str(tmp_path / "model.yaml"), device="cpu", progress=False)
    again = read_experiment(tmp_path / "out")
    for r, s in zip(again.recordings, problem.series, strict=True):
        (means, _) = r.clamps[1].force.means(s[3].edges)
        seen = means[:, 1]
        known = np.isfinite(seen)
        assert known.sum() > 5
        assert np.sqrt(np.mean((seen - s[3].values)[known] ** 2)) < 0.05 * s[3].largest


def test_finite_elements_are_refused(bar):
    with pytest.raises(UserError, match="it moves no clamps and has no forces on them"):
        neuido.diagnose(bar[0].experiment.folder, solver="finite_elements", device="cpu")


ASKED = "viscosity_shear,strain_stiffening,drag_linear"


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "seed"), [("none", 1), ("viscosity_shear", 2)])
def test_a_made_case(kind, seed, tmp_path):
    folder, key = made(tmp_path / "case", kind, seed)
    found = neuido.diagnose(folder, effects=ASKED, device="cpu", effort="quick", draws=39, minutes=0)
    if kind == "none":
        assert found.answer == "none" and not found.effects
        return
    assert found.answer in ("effect", "class") and kind in (found.effects[0].name, *found.effects[0].alternatives)
    eta = found.effects[0].parameters["eta"].value
    assert eta == pytest.approx(key["undeclared"][0]["parameters"]["eta"], rel=0.05)
    assert found.error.after < 0.3 * found.error.before
