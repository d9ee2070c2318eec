import math

import numpy as np
import pytest
import yaml

from neuido.data.measured.material_test import read_material_tests
from neuido.discrepancy.inference.least_squares import levenberg_marquardt, run
from neuido.discrepancy.problems.noise import high_pass, monotone_pieces
from neuido.discrepancy.problems.specimens.material import MaterialProblem

YOUNG = 1.0e6
MU = YOUNG / (2 * 1.499)


def write(folder, tests, *, model=None, **columns):
    """A folder with one table and its tests."""
    names = list(columns)
    rows = np.stack([columns[name] for name in names], 1)
    np.savetxt(folder / "table.csv", rows, delimiter=",", header=",".join(names), comments="")
    model = {"density": 1000.0, "elasticity": {"law": "neo_hookean", "young": 1.3e6, "poisson": 0.499}, "plasticity": {"law": "identity"},
             "free": ["young"], "incompressible": True} | (model or {})  # fmt: skip
    tests = [
        {"file": "table.csv", "mode": "uniaxial", "columns": {"stretch": "L", "nominal_stress": "S"}, "role": "fit"} | t for t in tests
    ]
    (folder / "test.yaml").write_text(yaml.safe_dump({"format": "neuido-material-test/1", "name": "made", "model": model, "tests": tests}))
    return folder


def fitted(problem: MaterialProblem, names: tuple[str, ...] = ()):
    """The best fit of the declared parameters and some effects, and its errors on fitted and on held-out tests [Pa]."""
    chosen = [c for c in problem.candidates if c.name in names]
    parameters = (*problem.declared, *(p for c in chosen for p in c.parameters))
    starts = [{}]
    for c in chosen:
        starts = [a | dict(b) for a in starts for b in c.starts]
    fit, held = problem.roles["fit"], problem.roles["held_out"]
    scale = max(float(np.abs(problem.recordings[n].y).max()) for n in fit)
    requests = [levenberg_marquardt(parameters, start, iterations=25) for start in starts]
    best = min(run(problem, requests, lambda r, n: 1e3 * r / scale, fit), key=lambda f: f.cost)

    def error(numbers):
        left = [problem.predict([best.point], n)[0] - problem.recordings[n].y for n in numbers]
        return float(np.sqrt(np.mean(np.concatenate(left) ** 2))) if left else math.nan

    return best.point, error(fit), error(held)


def test_predicts_the_closed_form_for_every_point(tmp_path):
    l = np.linspace(1.0, 3.0, 12)
    problem = MaterialProblem(write(tmp_path, [{"name": "a"}], L=l, S=MU * (l - l**-2)))
    out = problem.predict([{"young": YOUNG}, {"young": 2 * YOUNG}, {}], 0)
    np.testing.assert_allclose(out[0], problem.recordings[0].y, rtol=1e-9)
    np.testing.assert_allclose(out[1], 2 * out[0], rtol=1e-9)
    np.testing.assert_allclose(out[2], 1.3 * out[0], rtol=1e-9)
    assert problem.unit == "Pa" and problem.settings == 1 and not problem.nuisances
    assert problem.predict([], 0).shape == (0, 12)


def test_impossible_points_are_nan_alone(tmp_path):
    l = np.linspace(1.0, 3.0, 12)
    problem = MaterialProblem(write(tmp_path, [{"name": "a"}], L=l, S=YOUNG * (l - 1)))
    out = problem.predict([{"second_invariant.c": 0.1}, {"second_invariant.c": -2.0}, {}], 0)
    assert np.isfinite(out[[0, 2]]).all() and np.isnan(out[1]).all()


def test_which_effects_are_asked_for(tmp_path):
    """Only what the tests can show: one axis tells no fibre, a monotone path no damage, one loading at one rate no effect of time."""
    l, t = np.linspace(1.0, 2.0, 12), np.linspace(0, 1, 12)
    timed = {"stretch": "L", "nominal_stress": "S", "time": "T"}

    def problem(tests, **more):
        return MaterialProblem(write(tmp_path, tests, **({"L": l, "S": YOUNG * (l - 1), "T": t} | more)))

    def names(tests, **more):
        return {c.name for c in problem(tests, **more).candidates if not c.needs}

    plain = names([{"name": "a"}])
    assert plain == {"strain_stiffening", "second_invariant", "yield"}
    assert names([{"name": "a"}, {"name": "b", "direction": [0, 1, 0]}]) == plain | {"fibre"}
    assert names([{"name": "a", "columns": timed}]) == plain
    why = problem([{"name": "a", "columns": timed}]).labels["excluded"]
    assert "one rate" in why["maxwell"] and "one rate" in why["creep"] and "once" in why["stiffness_change"]
    rates = {"viscosity_shear", "maxwell", "hysteresis", "creep"}
    held = np.minimum(2 * np.linspace(0, 1, 12), 1.0) + 1.0
    assert names([{"name": "a", "columns": timed}], L=held) == plain | rates
    faster = {"columns": timed | {"time": "T2"}, "name": "b"}
    spectra = {"relaxation_spectrum", "fractional"}  # for these the rates must span a decade and a half
    assert names([{"name": "a", "columns": timed}, faster], T2=t / 4) == plain | rates | spectra
    there = np.concatenate([l[::2], l[::-2]])
    unloaded = plain | {"softening", "mullins", "permanent_set"}
    assert names([{"name": "a"}], L=there, S=YOUNG * (there - 1)) == unloaded
    around = np.concatenate([l[::2], 1 / l[::2]])
    assert names([{"name": "a"}], L=around, S=YOUNG * (around - 1)) == unloaded | {"tension_compression"}
    foam = {"incompressible": False, "elasticity": {"law": "neo_hookean", "young": 1e6, "poisson": 0.1}}
    assert "compaction" in names([{"name": "a"}], model=foam, L=around, S=YOUNG * (around - 1))
    steel = {"elasticity": {"law": "sigma", "young": 2e11, "poisson": 0.3}, "plasticity": {"law": "von_mises", "yield_stress": 3e8},
             "incompressible": False}  # fmt: skip
    small = 1 + 0.01 * np.sin(np.linspace(0, 12, 40))
    table = write(tmp_path, [{"name": "a"}], model=steel, L=small, S=3e8 * np.sign(small - 1), T=small)
    flows = {"hardening", "cyclic_hardening", "kinematic_hardening", "nonlinear_backstress"}
    assert {c.name for c in MaterialProblem(table).candidates} == flows | {"tension_compression", "softening"}
    elastic = {"elasticity": {"law": "sigma", "young": 2e11, "poisson": 0.3}, "incompressible": False}
    table = write(tmp_path, [{"name": "a"}], model=elastic, L=small, S=3e8 * np.sign(small - 1), T=small)
    assert {c.name for c in MaterialProblem(table).candidates if c.needs == "yield"} == flows  # offered once yield is found


def test_stiffening_is_found_and_the_model_after_answers_it(tmp_path):
    rng = np.random.default_rng(0)
    l = np.linspace(1.05, 4.0, 30)
    truth = MaterialProblem(write(tmp_path, [{"name": "a"}], L=l, S=YOUNG * (l - 1))).predict(
        [{"young": YOUNG, "strain_stiffening.k": 0.02}], 0
    )[0]
    S = truth + 2e3 * rng.standard_normal(len(l))
    problem = MaterialProblem(
        write(tmp_path, [{"name": "low", "rows": [0, 20]}, {"name": "high", "rows": [20, 30], "role": "held_out"}], L=l, S=S)
    )
    assert problem.recordings[0].noise == pytest.approx(2e3, rel=0.5) and problem.recordings[1].noise == problem.recordings[0].noise
    point, before_fit, before = fitted(problem)
    errors = {c.name: fitted(problem, (c.name,))[1:] for c in problem.candidates}
    point, fit, held = fitted(problem, ("strain_stiffening",))
    assert point["strain_stiffening.k"] == pytest.approx(0.02, rel=0.1) and point["young"] == pytest.approx(YOUNG, rel=0.03)
    assert fit < 2.5e3 and held < 0.1 * before
    assert min(errors, key=lambda name: sum(errors[name])) == "strain_stiffening"

    content = yaml.safe_load((tmp_path / "test.yaml").read_text())
    content["model"] = problem.model_after(point, ["strain_stiffening"])
    (tmp_path / "test.yaml").write_text(yaml.safe_dump(content))
    again = MaterialProblem(tmp_path)
    np.testing.assert_allclose(again.predict([{}], 1), problem.predict([point], 1), rtol=1e-9)
    assert {c.name: c.parameters[0].value for c in again.candidates}["strain_stiffening"] == point["strain_stiffening.k"]


def test_a_held_out_half_of_a_test_starts_where_the_first_ends(tmp_path):
    """A body of perfect plasticity, pulled and then pushed back: its second half alone would start elastic from another state."""
    strain = np.concatenate([np.linspace(0, 0.02, 21), np.linspace(0.0185, -0.01, 20)])
    steel = {"elasticity": {"law": "sigma", "young": 2e11, "poisson": 0.3}, "plasticity": {"law": "von_mises", "yield_stress": 3e8},
             "incompressible": False, "free": ["young", "yield_stress"]}  # fmt: skip
    tests = [{"name": "first", "rows": [0, 21]}, {"name": "then", "rows": [21, 41], "role": "held_out"}]
    columns = {"log_strain": "E", "true_stress": "S"}
    problem = MaterialProblem(write(tmp_path, [t | {"columns": columns} for t in tests], model=steel, E=strain, S=2e11 * strain))
    then = problem.predict([{}], 1)[0]
    level = math.sqrt(1.5) * 3e8
    assert then[0] == pytest.approx(level - 2e11 * 0.0015, rel=0.01) and then[-1] == pytest.approx(-level, rel=0.01)
    content = (tmp_path / "test.yaml").read_text().replace("- 21\n  - 41", "- 22\n  - 41")
    (tmp_path / "test.yaml").write_text(content)
    assert read_material_tests(tmp_path).histories() == ((0,), (1,))
    assert MaterialProblem(tmp_path).predict([{}], 1)[0][0] > then[0]  # a virgin specimen, stretched to 1.7 %


@pytest.mark.slow
def test_kinematic_hardening_of_steel_is_told_from_isotropic(tmp_path):
    strain = np.concatenate([np.linspace(0, 0.015, 16), np.linspace(0.013, -0.015, 15), np.linspace(-0.013, 0.015, 15)])
    steel = {"elasticity": {"law": "sigma", "young": 2e11, "poisson": 0.3}, "plasticity": {"law": "von_mises", "yield_stress": 3e8},
             "incompressible": False, "free": ["yield_stress"]}  # fmt: skip
    tests = [{"name": "first", "rows": [0, 31]}, {"name": "then", "rows": [31, 46], "role": "held_out"}]
    tests = [t | {"columns": {"log_strain": "E", "true_stress": "S"}} for t in tests]
    truth = MaterialProblem(write(tmp_path, [tests[0] | {"rows": [0, 46]}], model=steel, E=strain, S=2e11 * strain))
    S = truth.predict([{"kinematic_hardening.h": 4e9}], 0)[0]
    problem = MaterialProblem(write(tmp_path, tests, model=steel, E=strain, S=S + 1e6 * np.random.default_rng(1).standard_normal(len(S))))
    point, fit, held = fitted(problem, ("kinematic_hardening",))
    assert point["kinematic_hardening.h"] == pytest.approx(4e9, rel=0.02) and held < 2e6
    assert fitted(problem, ("hardening",))[2] > 10 * held


def test_high_pass_sees_the_noise_and_not_the_curve():
    rng = np.random.default_rng(0)
    x = np.linspace(0, 3, 200)
    y = np.exp(x) + 0.05 * rng.standard_normal(200)
    y[[50, 120]] += 3.0  # two outliers
    assert high_pass([(x, y)]) == pytest.approx(0.05, rel=0.15)
    assert high_pass([(x[:5], y[:5])]) is None
    path = np.array([[1.0, 1.0], [1.1, 1.0], [1.2, 0.9], [1.3, 1.0], [1.2, 1.1]])
    assert monotone_pieces(path) == [slice(0, 3), slice(3, 5)]


@pytest.mark.parametrize(
    ("name", "effect", "best"),
    [("treloar-rubber", "strain_stiffening", 0.15), ("diani-rubber", "fibre", 0.25), ("kawabata-rubber", "second_invariant", 0.55)],
)
def test_measured_rubber(data_root, name, effect, best):
    """The effect that the literature gives lowers the held-out error more than any other."""
    problem = MaterialProblem(data_root / "measured" / name)
    _, _, before = fitted(problem)
    held = {c.name: fitted(problem, (c.name,))[2] for c in problem.candidates if c.name != "yield"}
    assert min(held, key=held.get) == effect and held[effect] < best * before
