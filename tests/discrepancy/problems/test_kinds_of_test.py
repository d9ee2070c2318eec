"""Kinds of material test: creep, oscillation, flow curves, periodic cycles, repeats; what each is compared in and what it can tell."""

import math

import numpy as np
import pytest
import yaml

from neuido.data.measured.material_test import read_material_tests
from neuido.discrepancy.problems.specimens.material import MaterialProblem
from neuido.discrepancy.problems.specimens.repeats import are_repeats, mean_rate, scatter, shows_time
from neuido.errors import UserError

SOLID = {"density": 1000.0, "elasticity": {"law": "neo_hookean", "young": 3e5, "poisson": 0.499}, "plasticity": {"law": "identity"},
         "free": ["young"], "incompressible": True}  # fmt: skip
FLUID = {"density": 1000.0, "flow": {"law": "newtonian", "viscosity": 2.0}, "free": ["viscosity"]}
MU = 3e5 / (2 * 1.499)


def folder(tmp_path, model, tests, **columns):
    rows = np.stack(list(columns.values()), 1)
    np.savetxt(tmp_path / "table.csv", rows, delimiter=",", header=",".join(columns), comments="", fmt="%.12g")
    tests = [{"file": "table.csv", "role": "fit"} | test for test in tests]
    (tmp_path / "test.yaml").write_text(
        yaml.safe_dump({"format": "neuido-material-test/1", "name": "made", "model": model, "tests": tests})
    )
    return tmp_path


SHEAR = {"shear": "g", "shear_stress": "s", "time": "t"}


def test_creep_is_compared_in_strain(tmp_path):
    t = np.geomspace(0.1, 100.0, 40)
    s = np.full(40, 200.0)
    test = {"name": "a", "mode": "simple_shear", "control": "stress", "columns": SHEAR, "noise": 1e-5}
    problem = MaterialProblem(folder(tmp_path, SOLID, [test], t=t, g=s / MU, s=s))
    assert problem.unit == "1" and problem.recordings[0].noise == 1e-5 and problem.recordings[0].noise_from == "stated"
    np.testing.assert_allclose(problem.predict([{}], 0)[0], problem.recordings[0].y, rtol=1e-6)
    assert {"creep", "maxwell", "relaxation_spectrum", "fractional"} <= {c.name for c in problem.candidates}
    creeping = problem.predict([{"creep.rate": 1e-4}], 0)[0]
    assert creeping[-1] > creeping[0] > 0


def test_an_oscillation_is_compared_in_logarithms(tmp_path):
    w = np.geomspace(0.01, 100.0, 30)
    x = (w * 0.5) ** 2
    columns = {"angular_frequency": "w", "storage_modulus": "G1", "loss_modulus": "G2"}
    storage, loss = MU * (1 + 0.8 * x / (1 + x)), MU * 0.8 * w * 0.5 / (1 + x)
    problem = MaterialProblem(folder(tmp_path, SOLID, [{"name": "a", "mode": "oscillation", "columns": columns}], w=w, G1=storage, G2=loss))
    (recording,) = problem.recordings
    assert problem.unit == "1" and recording.y[0] == pytest.approx(math.log(storage[0]))
    np.testing.assert_allclose(problem.predict([{"maxwell.ratio": 0.8, "maxwell.time": 0.5}], 0)[0], recording.y, atol=1e-9)
    elastic = problem.predict([{}], 0)[0]  # has no loss, whose logarithm counts as that of a thousandth of the smallest measured one
    np.testing.assert_allclose(elastic[1::2], math.log(1e-3 * loss.min()))
    assert not {"yield", "strain_stiffening", "stiffness_change"} & {c.name for c in problem.candidates}


def test_flow_curves_of_fluids(tmp_path):
    rate = np.geomspace(1e-2, 1e2, 25)
    columns = {"shear_rate": "rate", "shear_stress": "s"}
    stress = 5.0 + 2.0 * rate * (rate / 1.0) ** -0.5
    problem = MaterialProblem(folder(tmp_path, FLUID, [{"name": "a", "mode": "flow_curve", "columns": columns}], rate=rate, s=stress))
    assert {c.name for c in problem.candidates} == {"power_law", "carreau", "bingham", "herschel_bulkley"}
    assert "memory" in problem.labels["excluded"]["thixotropy"]
    point = {"herschel_bulkley.yield": 5.0, "herschel_bulkley.n": -0.5}
    np.testing.assert_allclose(problem.predict([point, {}], 0), [np.log(stress), np.log(2 * rate)], atol=1e-9)
    after = problem.model_after(point | {"viscosity": 3.0}, ["herschel_bulkley"])
    assert after["flow"]["viscosity"] == 3.0 and after["effects"]["herschel_bulkley.yield"] == 5.0
    carreau = problem.predict([{"carreau.n": -0.6, "carreau.time": 10.0}], 0)[0]
    np.testing.assert_allclose(carreau, np.log(2 * rate * (1 + (10 * rate) ** 2) ** -0.3))


def test_thixotropy_needs_rates_up_and_down(tmp_path):
    rate = np.concatenate([np.geomspace(0.1, 10, 20), np.geomspace(9, 0.1, 20)])
    t = np.arange(1.0, 41.0)
    columns = {"shear_rate": "rate", "shear_stress": "s", "time": "t"}
    problem = MaterialProblem(
        folder(tmp_path, FLUID, [{"name": "a", "mode": "flow_curve", "columns": columns}], rate=rate, s=2 * rate, t=t)
    )
    assert "thixotropy" in {c.name for c in problem.candidates}
    slow = {"thixotropy.c": 3.0, "thixotropy.breakdown": 1.0, "thixotropy.build": 1e-3}
    fast = problem.predict([slow, slow | {"thixotropy.build": 1e6}], 0)
    np.testing.assert_allclose(fast[1], np.log(2 * rate * (1 + 3 / (1 + rate))), rtol=1e-6)  # always in balance
    assert fast[0][:5] == pytest.approx(np.log(8 * rate[:5]), abs=0.01)  # the structure has no time to break down
    z, gap = 1.0, 1e-3 / 100  # refined: small explicit steps through the same rates
    for r in rate:
        for _ in range(100):
            z += gap * (1 - z - r * z)
    assert fast[0][-1] == pytest.approx(math.log(2 * rate[-1] * (1 + 3 * z)), rel=1e-4)


def test_a_periodic_state_is_that_of_the_last_of_many_cycles(tmp_path):
    t = np.arange(40) * 0.05
    gamma = 0.02 * np.sin(np.pi * t)
    columns = SHEAR
    many = np.tile(gamma, 8)
    point = {"maxwell.ratio": 2.0, "maxwell.time": 1.5}
    test = {"name": "a", "mode": "simple_shear", "columns": columns}
    long = MaterialProblem(folder(tmp_path, SOLID, [test], t=np.arange(320) * 0.05, g=many, s=MU * many))
    last = long.predict([point], 0)[0][-40:]
    short = MaterialProblem(folder(tmp_path, SOLID, [test | {"periodic": True}], t=t, g=gamma, s=MU * gamma))
    np.testing.assert_allclose(short.predict([point], 0)[0], last, atol=5e-3 * np.abs(last).max())
    with pytest.raises(UserError, match="periodic"):
        read_material_tests(folder(tmp_path, SOLID, [test | {"periodic": True, "control": "stress"}], t=t, g=gamma, s=MU * gamma))


def test_repeats_give_the_scatter_of_specimens(tmp_path):
    rng = np.random.default_rng(1)
    l = np.linspace(1.02, 2.0, 40)
    plain = 3e5 / 2.998 * (l - l**-2)
    factors = (0.96, 1.0, 1.05)
    columns = {f"S{i}": f * plain + 300.0 * rng.standard_normal(40) for i, f in enumerate(factors)}
    tests = [{"name": f"a{i}", "mode": "uniaxial", "columns": {"stretch": "L", "nominal_stress": f"S{i}"}} for i in range(3)]
    tests[2]["role"] = "held_out"
    problem = MaterialProblem(folder(tmp_path, SOLID, tests, L=l, **columns))
    spread = np.std(factors, ddof=1) * math.sqrt(np.mean(plain**2))
    assert all(r.noise == pytest.approx(spread, rel=0.1) for r in problem.recordings)
    assert "unseen" not in problem.labels
    alone = MaterialProblem(folder(tmp_path, SOLID, tests[:1], L=l, **columns))
    assert 200 < alone.recordings[0].noise < 450
    assert "No test was repeated" in alone.labels["unseen"]


def test_a_test_without_a_repeat_has_the_scatter_of_those_that_have_one(tmp_path):
    l = np.linspace(1.02, 2.0, 40)
    plain = 1e5 * (l - l**-2)
    rows = {"L": l, "S0": 0.97 * plain, "S1": 1.03 * plain, "S2": 3 * plain, "slow": 50 * l, "fast": l}
    tests = [
        {"name": f"a{i}", "mode": "uniaxial", "columns": {"stretch": "L", "nominal_stress": f"S{i}", "time": "fast" if i == 2 else "slow"}}
        for i in range(3)
    ]
    noises = [r.noise for r in MaterialProblem(folder(tmp_path, SOLID, tests, **rows)).recordings]
    assert noises[0] == noises[1] == pytest.approx(0.06 / math.sqrt(2) * math.sqrt(np.mean(plain**2)), rel=0.1)
    assert noises[2] == pytest.approx(3 * noises[0], rel=0.1)


def test_curves_and_creep_have_repeats_too(tmp_path):
    rate = np.geomspace(1e-2, 1e2, 25)
    columns = {f"S{i}": f * (5.0 + 2.0 * rate**0.5) for i, f in enumerate((0.95, 1.05))}
    tests = [{"name": f"a{i}", "mode": "flow_curve", "columns": {"shear_rate": "rate", "shear_stress": f"S{i}"}} for i in range(2)]
    (tmp_path / "flow").mkdir()
    (tmp_path / "creep").mkdir()
    problem = MaterialProblem(folder(tmp_path / "flow", FLUID, tests, rate=rate, **columns))
    assert problem.recordings[0].noise == pytest.approx(math.log(1.05 / 0.95) / math.sqrt(2), rel=0.01)
    t = np.geomspace(0.1, 100.0, 40)
    strains = {f"g{i}": f * 1e-3 * (1 + np.log1p(t)) for i, f in enumerate((0.95, 1.05, 1.0))}
    tests = [
        {"name": f"a{i}", "mode": "simple_shear", "control": "stress", "columns": {"time": "t", "shear": f"g{i}", "shear_stress": "s"}}
        for i in range(3)
    ]
    problem = MaterialProblem(folder(tmp_path / "creep", SOLID, tests, t=t, s=np.full(40, 200.0), **strains))
    at = np.interp(np.linspace(0, t[-1] - t[0], 50), t - t[0], strains["g2"])
    assert all(r.noise == pytest.approx(0.05 * math.sqrt(np.mean(at**2)), rel=0.05) for r in problem.recordings)


@pytest.mark.parametrize(
    ("model", "change", "message"),
    [
        (SOLID, {"mode": "flow_curve", "columns": {"shear_rate": "t", "shear_stress": "s"}}, "a flow curve takes a declared fluid"),
        (FLUID, {"mode": "simple_shear", "columns": SHEAR}, "a flow curve takes no other mode"),
        (SOLID, {"control": "force"}, "control = 'force' does not suit simple_shear"),
        (SOLID, {"noise": -1.0}, "noise"),
        (FLUID | {"flow": {"law": "carreau", "viscosity": 1.0}}, {}, "use newtonian"),
    ],
)
def test_mistakes_are_said(tmp_path, model, change, message):
    t = np.linspace(0.1, 1.0, 8)
    test = {"name": "a", "mode": "simple_shear", "columns": SHEAR} | change
    with pytest.raises(UserError, match=message):
        read_material_tests(folder(tmp_path, model, [test], t=t, g=0.01 * t, s=1e3 * t))


def test_stress_and_strain_do_not_share_a_folder(tmp_path):
    t = np.linspace(0.1, 1.0, 8)
    test = {"name": "a", "mode": "simple_shear", "columns": SHEAR}
    with pytest.raises(UserError, match="two folders"):
        read_material_tests(folder(tmp_path, SOLID, [test, test | {"name": "b", "control": "stress"}], t=t, g=0.01 * t, s=1e3 * t))


def test_what_relaxes_stiffens_a_fast_test(tmp_path):
    """So that a soft base law with a strong relaxation is no other material than the declared one."""
    t = np.geomspace(0.1, 100.0, 40)
    problem = MaterialProblem(
        folder(tmp_path, SOLID, [{"name": "a", "mode": "simple_shear", "columns": SHEAR}], t=t, g=0.01 * t, s=t * MU / 100)
    )
    (young,) = problem.declared
    point = {"young": 5e3, "maxwell.ratio": 50.0, "maxwell.time": 1.0}
    assert problem.shown(point, young) == pytest.approx((5e3, 51 * 5e3)) and problem.shown({"young": 5e3}, young) == (5e3, 5e3)


def test_the_order_of_rates_says_nothing(tmp_path):
    """Rows of a flow curve stand by themselves: in any order the same ones are early, and the last ones validate."""
    rates = np.geomspace(0.01, 10.0, 20)
    order = np.random.default_rng(0).permutation(20)
    found = []
    for name, rows in (("a", np.arange(20)), ("b", order)):
        folder = tmp_path / name
        folder.mkdir()
        table = np.stack([rates, 2.0 * rates**0.5 + 1.0], axis=1)[rows]
        np.savetxt(folder / "curve.csv", table, delimiter=",", header="rate,stress", comments="")
        entry = {"name": "curve", "file": "curve.csv", "mode": "flow_curve", "role": "fit",
                 "columns": {"shear_rate": "rate", "shear_stress": "stress"}}  # fmt: skip
        model = {"density": 1000.0, "flow": {"law": "newtonian", "viscosity": 1.0}, "free": ["viscosity"]}
        content = {"format": "neuido-material-test/1", "name": name, "model": model, "tests": [entry]}
        (folder / "test.yaml").write_text(yaml.safe_dump(content))
        (own,) = MaterialProblem(folder).recordings
        found.append((own.times[np.argsort(rows)], own.noise))
    np.testing.assert_array_equal(*(times for times, _ in found))
    assert found[0][1] == pytest.approx(found[1][1], rel=1e-9)


def test_ramps_of_another_speed_are_no_repeats_though_both_are_held(tmp_path):
    """The hold is no part of the loading: else what the rate does to a relaxing rubber would count as scatter of specimens."""
    t = np.concatenate([np.linspace(0.0, 1.0, 11), 1.0 + np.geomspace(0.05, 1000.0, 40)])
    rise = np.minimum(t, 1.0)
    tests = []
    for name, ramp in (("fast", 0.05), ("slow", 1.0)):
        table = np.stack([ramp * rise + np.maximum(t - 1.0, 0.0), 1.0 + 0.3 * rise, 1e5 * rise * (1 + 0.2 * (t / ramp + 1) ** -0.3)], 1)
        np.savetxt(tmp_path / f"{name}.csv", table, delimiter=",", header="t,l,s", comments="")
        tests.append({"name": name, "file": f"{name}.csv", "mode": "uniaxial", "role": "fit",
                      "columns": {"time": "t", "stretch": "l", "nominal_stress": "s"}})  # fmt: skip
    content = {"format": "neuido-material-test/1", "name": "ramps", "model": SOLID, "tests": tests}
    (tmp_path / "test.yaml").write_text(yaml.safe_dump(content))
    found = read_material_tests(tmp_path)
    assert [mean_rate(test) for test in found.tests] == pytest.approx([np.log(1.3) / 0.05, np.log(1.3)], rel=1e-3)
    assert not are_repeats(*found.tests) and not scatter(found)
    assert shows_time(found.tests)
