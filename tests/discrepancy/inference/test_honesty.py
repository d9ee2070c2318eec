"""What a diagnosis must not say: a verdict that rests on the clock, an assumed noise, a bound, or a recording it has looked at."""

import json
import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import yaml
from scipy.stats import norm

from neuido.data.measured.material_test import read_material_tests
from neuido.data.measured.track import read_tracks
from neuido.discrepancy import store
from neuido.discrepancy.inference import directions, discretisation, power
from neuido.discrepancy.inference.laboratory import Laboratory
from neuido.discrepancy.inference.least_squares import levenberg_marquardt, run
from neuido.discrepancy.inference.search.attribution import diagnose
from neuido.discrepancy.inference.search.intervals import findings
from neuido.discrepancy.problems.noise import FALLS, correlation, surface
from neuido.discrepancy.problems.problem import Candidate, Parameter, Problem, Recording
from neuido.discrepancy.problems.specimens.material import MaterialProblem
from neuido.discrepancy.problems.tracks.track_problem import TrackProblem, track_problems
from neuido.discrepancy.report import answer, answer_content
from neuido.errors import UserError
from tests.discrepancy import made

T = np.linspace(0.0, 1.0, 60)
SIGMA = 0.01


class Line(Problem):
    """y = young v t + k v t^2 in recordings with v = 1, 2, ..., whose last roles are as given; what it cannot say is added to the data."""

    def __init__(self, truth, roles=("fit", "fit", "held_out"), *, beside=0.0, origin=0.0, unit=1.0, noise=SIGMA, order=None, low=0.1):
        self.factor = unit
        k = Parameter("drag_linear.k", "1/s", 0.0, 0.3, -20.0, 20.0)
        candidates = (Candidate("drag_linear", (k,), ({k.name: 0.3},), "flight"),)
        young = Parameter("young", "Pa", 1.0, 0.1, low, 1e3, log=True)
        super().__init__("line", "rmse", "m", (young,), (), candidates, ())
        rng = np.random.default_rng(0)
        recordings = []
        for i, role in enumerate(roles):
            y = self.curve(truth, i) + beside * np.sin(14 * T) + SIGMA * rng.standard_normal(len(T))
            rows = np.arange(len(T)) if order is None else order
            made = Recording(f"r{i}", role, unit * (origin + y)[rows], noise, np.zeros(len(T), int), T[rows])
            recordings.append(made)
        self.origin, self.rows = origin, np.arange(len(T)) if order is None else order
        object.__setattr__(self, "recordings", tuple(recordings))

    def __setattr__(self, name, value):
        object.__setattr__(self, name, value)

    def curve(self, p, i):
        return p.get("young", 1.0) * (1 + i) * T + p.get("drag_linear.k", 0.0) * (1 + i) * T**2

    def predict(self, points, recording, setting=0):
        rows = [self.factor * (self.origin + self.curve(p, recording))[self.rows] for p in points]
        return np.array(rows).reshape(len(points), len(T))

    def model_after(self, values, effects):
        return {"young": values["young"]}


def content(found, tmp_path):
    answer.write(tmp_path, [(found, 0.0)], kind="experiment", device="cpu")
    return json.loads((tmp_path / "diagnosis.json").read_text())


@pytest.mark.slow
def test_what_is_left_beside_a_named_effect_is_told(tmp_path):
    told = content(diagnose(Line({"young": 1.5, "drag_linear.k": 3.0}, beside=0.15), draws=39), tmp_path)
    assert told["answer"] == "effect" and told["error"]["left_over_floor"] > 3.0
    assert "and something more that no effect here explains" in (tmp_path / "report.html").read_text()
    clean = content(diagnose(Line({"young": 1.5, "drag_linear.k": 3.0}), draws=39), tmp_path)
    assert clean["answer"] == "effect" and clean["error"]["left_over_floor"] < 1.3
    assert "Something more" not in (tmp_path / "report.html").read_text()
    assert clean["effects"][0]["p_value_of"] and "without the search" in clean["effects"][0]["p_value_of"]


def test_a_recording_is_sealed_until_the_answer_is_there(tmp_path):
    """Of two that are held out one validates and one tests: whatever the latter holds, the search is the same."""
    roles = ("fit", "held_out", "held_out")
    problem = Line({"young": 1.5, "drag_linear.k": 3.0}, roles)
    found = diagnose(problem, draws=39)
    told = content(found, tmp_path)
    error = told["error"]["after"]
    assert found.answer == "effect" and [p.name for p in found.parts] == ["r0", "r1"] and [p.name for p in found.sealed] == ["r2"]
    assert error["validation"] == pytest.approx(error["by_recording"]["r1"]) and error["test"] == pytest.approx(error["by_recording"]["r2"])
    assert error["test"] == pytest.approx(SIGMA, rel=0.4)
    last = problem.recordings[2]
    object.__setattr__(problem, "recordings", (*problem.recordings[:2], replace(last, y=last.y + 5.0 * T)))
    other = diagnose(problem, draws=39)
    assert other.after == found.after and answer.trace(other) == answer.trace(found)
    assert answer_content.errors(other, "after")["test"] > 1.0
    single = answer_content.errors(diagnose(Line({"young": 1.5}), draws=39), "after")
    assert single["test"] is None and single["validation"] == single["held_out"]


def test_the_largest_compatible_size_is_told(tmp_path):
    """Also where nothing but noise is left, and nothing was looked for; of an effect that is there, no smaller than it."""
    told = content(diagnose(Line({"young": 1.5}), draws=39), tmp_path)
    (size,) = told["power"]
    assert (size["name"], size["parameter"], size["unit"], size["largest"]) == ("drag_linear", "k", "1/s", 20.0)
    t = np.concatenate([(1 + i) * T for i in range(2)])
    bend = np.concatenate([(1 + i) * T**2 for i in range(2)])
    alone = bend - t * (t @ bend) / (t @ t)
    deviation = SIGMA / np.linalg.norm(alone)  # of the size that a straight line does not make up for
    assert deviation < size["up_to"] < 4.0 * deviation
    there = diagnose(Line({"young": 1.5, "drag_linear.k": 0.02}), draws=39)
    assert there.answer == "none" and there.power[0].up_to > 0.02
    ripple = diagnose(Line({"young": 1.5}, beside=0.02), draws=39)
    assert ripple.power[0].up_to > size["up_to"]  # what is left above the noise is no smaller an uncertainty


def test_a_compatible_size_is_exceeded_in_one_of_ten():
    rng = np.random.default_rng(3)
    n, reps = 30, 1000
    B, S = np.cos(3 * np.linspace(0, 1, n))[:, None], 0.5 * np.sin(5 * np.linspace(0, 1, n))[:, None]
    both, one = Parameter("a.b", "m", 0.0, 1.0, -9.0, 9.0), Parameter("a.b", "m", 0.0, 1.0, 0.0, 9.0)
    means, deviations = [], []
    for _ in range(reps):
        (mean,), (deviation,) = power.amounts(B, S[:, 0] * rng.normal() + rng.normal(size=n), S)
        means.append(mean)
        deviations.append(deviation)
    assert np.std(means) == pytest.approx(deviations[0], rel=0.05)
    for p in (both, one):
        assert power.bound(p, 0.0, 2.0) == pytest.approx(2.0 * norm.ppf(0.95))
        assert power.bound(p, 50.0, 2.0) == pytest.approx(50.0 + 2.0 * norm.ppf(0.9), rel=1e-3)
    assert 0.0 < power.bound(one, -5.0, 1.0) < power.bound(one, 0.0, 1.0) < power.bound(both, -5.0, 1.0)
    assert power.bound(one, 0.0, math.inf) == math.inf
    draws = rng.normal(size=(300, 2))  # a size of either sign, and a measurement of it
    inside = [abs(50.0 * a) < power.bound(both, 50.0 * a + e, 1.0) for a, e in draws]
    assert np.mean(inside) == pytest.approx(0.9, abs=0.05)


def test_a_compatible_size_allows_for_data_that_err_alike():
    """Also of a residual whose error is slow: its neighbouring data are hardly independent."""
    rng = np.random.default_rng(5)
    n, reps, alike = 120, 200, 0.8
    p = Parameter("a.b", "m", 0.0, 1.0, -9.0, 9.0)
    B, none = np.linspace(-1, 1, n)[:, None] ** 2, np.empty((n, 0))
    noise = rng.normal(size=(reps, n))
    for i in range(1, n):
        noise[:, i] = alike * noise[:, i - 1] + math.sqrt(1 - alike**2) * noise[:, i]
    told, plain = [], []
    for left in noise:
        (mean,), (deviation,) = power.amounts(B, left - 3.0 * B[:, 0], none)
        growth, freedom = power.excess(left, none, [np.arange(n)])
        told.append(power.bound(p, mean, math.sqrt(growth) * deviation, freedom) > 3.0)
        plain.append(power.bound(p, mean, deviation) > 3.0)
    assert np.mean(told) > 0.85 > 0.75 > np.mean(plain)
    growth, freedom = power.excess(rng.normal(size=n), none, [np.arange(n)])
    assert growth < 1.5 and freedom > 60


def test_sizes_that_do_the_same_have_no_limit():
    t = np.linspace(0.0, 1.0, 30)
    _, deviations = power.amounts(np.stack([t, 2.0 * t, t**2], axis=1), 0.0 * t, np.empty((30, 0)))
    assert min(deviations[:2]) > 1e3 * deviations[2]
    assert power.amounts(np.stack([t, 0.0 * t], axis=1), 0.0 * t, np.empty((30, 0)))[1][1] == math.inf


def test_a_residual_within_a_large_floor_is_not_nothing(monkeypatch):
    """Twenty times the noise, and no more than the settings differ by: that much could hide."""
    problem = Line({"young": 1.5}, beside=0.2)
    monkeypatch.setattr(discretisation, "floors", lambda lab, point, free, floor: lab.noise_squares + 0.2**2)
    found = diagnose(problem, draws=39)
    assert found.answer == "insufficient" and "times the noise" in found.why[0]
    assert diagnose(Line({"young": 1.5}), draws=39).answer == "none"


def test_a_declared_figure_at_its_bound_is_reported_first(tmp_path):
    """Data of another unit: whatever effect would lower the error, none is named on top of it."""
    found = diagnose(Line({"young": 0.01, "drag_linear.k": 3.0}, low=0.1), draws=39)
    told = content(found, tmp_path)
    assert told["answer"] == "insufficient" and told["effects"] == [] and told["why"][0].startswith("young would be 0.1 Pa")
    assert told["error"]["before"] == told["error"]["after"]
    page = (tmp_path / "report.html").read_text()
    assert page.index("Young would be 0.1 Pa") < page.index("do not say whether something is missing")


@pytest.mark.parametrize(("value", "cost", "told"), [(40.0, 1.0, True), (40.0, 0.01, False), (20.0, 1.0, False)])
def test_a_declared_figure_far_off_is_a_finding_where_the_data_tell_it(value, cost, told):
    """`cost`: of a unit of the figure."""
    (young,) = Line({"young": 1.5}).declared
    young = replace(young, value=1.0)
    problem = SimpleNamespace(declared=(young,), shown=lambda point, p: (point[p.name], point[p.name]))
    lab = SimpleNamespace(problem=problem, costs=lambda points, floor: [cost * (p["young"] - value) ** 2 for p in points])
    at = SimpleNamespace(fit=SimpleNamespace(point={"young": value}), floor=None)
    assert bool(findings(lab, at)) is told
    problem.declared = (replace(young, value=value),)
    assert not findings(lab, at), "declared there"


def test_noise_is_the_same_from_any_origin_in_any_unit_and_order():
    def noise(**options):
        laboratory = Laboratory(Line({"young": 1.5}, noise=None, **options))
        assert laboratory.noise_from(0) == "estimated" and 0 < laboratory.noise_uncertainty(0) < 0.5
        return laboratory.noise_of(0)

    plain = noise()
    assert plain == pytest.approx(SIGMA, rel=0.35)
    assert noise(origin=1e3) == pytest.approx(plain, rel=1e-6)
    assert noise(unit=1e3) == pytest.approx(1e3 * plain, rel=1e-6)
    assert noise(order=np.random.default_rng(1).permutation(len(T))) == pytest.approx(plain, rel=1e-9)
    flat = Line({"young": 1.5}, noise=None)
    short = replace(flat.recordings[0], y=flat.recordings[0].y[:4], groups=np.zeros(4, int), times=T[:4])
    object.__setattr__(flat, "recordings", (short,))
    assumed = Laboratory(flat)
    assert assumed.noise_from(0) == "assumed" and assumed.noise_uncertainty(0) > 1


def test_a_grid_of_biaxial_states_has_its_noise_from_the_surface_through_it(tmp_path):
    rng = np.random.default_rng(0)
    states = np.array([(a, b) for b in np.linspace(1.1, 1.8, 4) for a in np.linspace(1.1, 1.8, 5)])
    third = 1 / states.prod(axis=1)
    stress = 4e5 * (states**2 - third[:, None] ** 2) / states
    for noise in (0.0, 2e3):
        seen = stress + noise * rng.standard_normal(stress.shape)
        rows = np.concatenate([states, seen], axis=1)
        found = []
        for order in (np.arange(20), rng.permutation(20)):
            np.savetxt(tmp_path / "grid.csv", rows[order], delimiter=",", header="a,b,s,t", comments="")
            columns = {"stretch_1": "a", "stretch_2": "b", "nominal_stress_1": "s", "nominal_stress_2": "t"}
            model = {
                "density": 1000.0,
                "elasticity": {"law": "neo_hookean", "young": 1.0e6, "poisson": 0.499},
                "plasticity": {"law": "identity"},
                "free": ["young"],
                "incompressible": True,
            }
            tests = [{"name": "grid", "file": "grid.csv", "mode": "biaxial", "columns": columns, "role": "fit"}]
            given = {"format": "neuido-material-test/1", "name": "grid", "model": model, "tests": tests}
            (tmp_path / "test.yaml").write_text(yaml.safe_dump(given))
            problem = MaterialProblem(read_material_tests(tmp_path))
            found.append(problem.recordings[0].noise)
            assert diagnose(problem, draws=39).answer == "none"
        assert found[0] == pytest.approx(found[1], rel=1e-6)
        assert noise == 0.0 or 0.5 * noise < found[0] < 2.0 * noise
    assert surface(states[:5], stress[:5, 0]) is None


@pytest.mark.parametrize(("frequency", "decay", "rate"), [(0.5, 0.1, 60), (1.0, 0.2, 60), (2.0, 0.05, 60), (3.0, 0.1, 30), (2.0, 0.1, 15)])
def test_swings_are_no_tracking_error(frequency, decay, rate):
    """Several swings leave a polynomial of the whole much, and that is the motion."""
    rng = np.random.default_rng(0)
    t = np.arange(0.0, 10.0, 1 / rate)
    swing = 0.2 * np.cos(2 * np.pi * frequency * t) * np.exp(-decay * t)
    found = correlation([(t, swing + 5e-4 * rng.standard_normal(len(t)))])
    assert found.sigma == pytest.approx(5e-4, rel=0.3 if rate == 60 else FALLS - 1.0) and found.amplitude < 2 * found.sigma


def test_the_origin_of_a_clock_changes_nothing(tmp_path):
    made.track(tmp_path / "zero")
    plain = track_problems(tmp_path / "zero")[0]
    for name, origin in (("late", 12.3), ("unix", 1.7e9)):
        folder = tmp_path / name
        made.track(folder)
        for path in folder.glob("*.csv"):
            rows = np.loadtxt(path, delimiter=",", skiprows=1)
            rows[:, 0] += origin
            np.savetxt(path, rows, delimiter=",", header="t,x,y", comments="", fmt="%.12f")
        moved = track_problems(folder)[0]
        for point in ({}, {"drag_quadratic.k": 0.1}):
            for n in range(3):
                np.testing.assert_allclose(moved.predict([point], n), plain.predict([point], n), atol=2e-4)
        assert moved.error_model.sigma == pytest.approx(plain.error_model.sigma, rel=1e-2)


def test_a_stated_noise_is_the_noise(tmp_path):
    made.track(tmp_path / "track")
    problem = TrackProblem(read_tracks(tmp_path / "track"), "ball-0")
    assert problem.recordings[0].noise == pytest.approx(0.004) and problem.recordings[0].noise_from == "stated"


def test_bodies_that_share_a_push_along_minus_an_axis(tmp_path):
    """Their common acceleration is negative: a range that ends at zero divided by zero."""
    folder = tmp_path / "track"
    made.track(folder, bodies=2, drag=0.0)
    for path in folder.glob("*.csv"):
        rows = np.loadtxt(path, delimiter=",", skiprows=1)
        rows[:, 1:] -= 0.5 * np.array([2.0, 1.0]) * rows[:, :1] ** 2
        np.savetxt(path, rows, delimiter=",", header="t,x,y", comments="")
    problems = track_problems(folder)
    for problem in problems:
        for c in problem.candidates:
            assert all(start[p.name] != 0.0 for start in c.starts for p in c.size_parameters)
    (first, *_) = problems
    push = next(c for c in first.candidates if c.name == "uniform_acceleration")
    assert all(p.upper < 1.0 and p.lower < -0.9 for p in push.parameters)
    found = diagnose(replace_candidates(first, ("uniform_acceleration", "gravity")), draws=39, most=1)
    assert [t.candidate.name for t in found.effects] == ["uniform_acceleration"]
    assert found.after["uniform_acceleration.x"] == pytest.approx(-2.0, abs=0.1)


def replace_candidates(problem, names):
    """The problem with some of its candidates, changed in place."""
    object.__setattr__(problem, "candidates", tuple(c for c in problem.candidates if c.name in names))
    return problem


class Edge(Line):
    """Runs at young = 1 and nowhere within `gap` of it, or on one side alone."""

    gap, side = 0.0, 0.0

    def predict(self, points, recording, setting=0):
        out = super().predict(points, recording, setting)
        for i, p in enumerate(points):
            off = p.get("young", 1.0) - 1.0
            if off and (abs(off) < self.gap or off * self.side < 0):
                out[i] = np.nan
        return out


def test_slopes_that_fail_are_no_zeros():
    problem = Edge({"young": 1.0})
    problem.gap = math.inf
    lab = Laboratory(problem)
    with pytest.raises(UserError, match="cannot be simulated on either side of young = 1 Pa"):
        directions.slopes(lab, problem.declared, {"young": 1.0}, [0])
    (fit,) = run(problem, [levenberg_marquardt(problem.declared, {"young": 1.0})], lambda r, n: r / SIGMA, [0])
    assert not fit.converged
    problem = Edge({"young": 1.5})
    problem.gap, problem.side = 0.0, 1.0
    assert np.abs(directions.slopes(Laboratory(problem), problem.declared, {"young": 1.0}, [0])[0]).max() > 0.05


class Gridded(Line):
    """With a second setting that does not run."""

    def predict(self, points, recording, setting=0):
        return np.full((len(points), len(T)), np.nan) if setting else super().predict(points, recording)


def test_settings_that_do_not_run_are_told_and_name_nothing(tmp_path):
    problem = Gridded({"young": 1.5, "drag_linear.k": 3.0})
    object.__setattr__(problem, "settings", 2)
    found = diagnose(problem, draws=39)
    assert found.answer == "insufficient" and "no other setting" in found.why[0] and found.effects == []
    told = content(found, tmp_path)
    assert told["settings_not_run"] == {f"r{i}": ["setting 1"] for i in range(3)}
    assert "does not run there" in (tmp_path / "report.html").read_text()


def test_stored_predictions_are_of_the_code_that_made_them(tmp_path, monkeypatch):
    first = store.code_digest()
    assert first == store.code_digest() and len(first) == 64
    package = tmp_path / "neuido"
    for name in ("errors.py", "types.py", "physics/law.py", "data/read.py", "models/a.py", "discrepancy/a.py"):
        (package / name).parent.mkdir(parents=True, exist_ok=True)
        (package / name).write_text("a = 1\n")
    monkeypatch.setattr(store, "__file__", str(package / "discrepancy" / "store.py"))
    digests = []
    for text in ("a = 1\n", "a = 2\n"):
        (package / "physics" / "law.py").write_text(text)
        store.code_digest.cache_clear()
        digests.append(store.code_digest())
    store.code_digest.cache_clear()
    assert digests[0] != digests[1]
    store.workplace(tmp_path / "out", "old", resume=True)
    assert store.outdated(tmp_path / "out", "new") == ["old"] and store.outdated(tmp_path / "out", "old") == []
