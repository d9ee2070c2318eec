"""Tests and tracks of laboratories whose answer was wrong without a word, one of each kind."""

import numpy as np
import pytest
import yaml

import neuido
from neuido.discrepancy.problems.specimens.material import MaterialProblem
from tests.discrepancy.problems.test_kinds_of_test import FLUID, SOLID, folder

NOISE = 0.015


def test_a_viscosity_counts_as_declared_within_what_the_rates_show(tmp_path):
    rate = np.geomspace(1e-3, 1e2, 30)
    test = {"name": "a", "mode": "flow_curve", "columns": {"shear_rate": "rate", "shear_stress": "s"}}
    problem = MaterialProblem(folder(tmp_path, FLUID, [test], rate=rate, s=10.0 * rate**0.3))
    (p,) = problem.declared
    low, high = problem.shown({"viscosity": 100.0, "power_law.n": -0.7}, p)
    assert low < p.value < 100.0 < high
    assert problem.shown({"viscosity": 4000.0}, p) == pytest.approx((4000.0, 4000.0))


@pytest.mark.parametrize(("scatter", "noise", "said"), [(0.05, 0.001, True), (0.0, 0.02, False)])
def test_a_floor_of_specimens_is_known_as_one(tmp_path, scatter, noise, said):
    draws, stretch = np.random.default_rng(1), np.linspace(1.0, 1.5, 60)
    columns, tests = {"l": stretch}, []
    for i, factor in enumerate((1 - scatter, 1 + scatter)):
        columns[f"s{i}"] = 1e5 * (factor * (stretch - stretch**-2) + noise * draws.standard_normal(60))
        tests.append({"name": f"s{i}", "mode": "uniaxial", "columns": {"stretch": "l", "nominal_stress": f"s{i}"}})
    assert MaterialProblem(folder(tmp_path, SOLID, tests, **columns)).labels["scatter"] == said


@pytest.mark.slow
def test_a_melt_has_a_spectrum_and_no_creep(tmp_path):
    """Nine modes that relax all of the stress: their fit ends where a branch is complete, and had been given up and refused."""
    draws, w, times = np.random.default_rng(3), np.logspace(-2, 2.3, 40), np.logspace(-2, 2, 9)
    x = np.outer(w, times)
    moduli = (4e3 * times**-0.35 * x / (1 + x**2) * np.stack([x, np.ones_like(x)])).sum(axis=2)
    storage, loss = moduli * np.exp(NOISE * draws.standard_normal(moduli.shape))
    test = {"name": "sweep", "mode": "oscillation"}
    test["columns"] = {"angular_frequency": "w", "storage_modulus": "storage", "loss_modulus": "loss"}
    found = neuido.diagnose(folder(tmp_path, SOLID, [test], w=w, storage=storage, loss=loss), device="cpu", draws=39)
    assert [e.name for e in found.effects] == ["relaxation_spectrum"]


@pytest.mark.slow
def test_a_ball_that_slips_before_it_rolls_is_not_complete(tmp_path):
    """One recording at five times its noise is not made good by the others."""
    draws, t = np.random.default_rng(4), np.arange(0.0, 1.4, 1 / 30)
    slope, entries = np.radians(6.0), []
    normal = [float(np.sin(slope)), float(np.cos(slope)), 0.0]
    pull, slips = 9.81 * np.sin(slope), 0.25
    for i, (start, role) in enumerate([(0.0, "fit"), (-0.9, "fit"), (-0.6, "held_out")]):
        early = np.minimum(t, slips)
        fast, slow = pull + 0.5, (pull + 0.5 * (start < 0)) / 1.4
        x = start * t + 0.5 * fast * early**2 + (fast * early) * (t - early) + 0.5 * slow * (t - early) ** 2
        seen = np.stack([x * normal[1], -x * normal[0]], axis=1) + 0.0012 * draws.standard_normal((len(t), 2))
        np.savetxt(tmp_path / f"r{i}.csv", np.column_stack([t, seen]), delimiter=",", header="t,x,y", comments="")
        entries.append({"name": f"r{i}", "body": "ball", "file": f"r{i}.csv", "columns": {k: k for k in "txy"}, "role": role})
    model = {"gravity": [0, -9.81, 0], "effects": {}, "free": [], "constraint": {"type": "plane", "inertia": 0.4, "normal": normal}}
    content = {"format": "neuido-track/1", "name": "slip", "model": model, "bodies": {"ball": {}}, "recordings": entries}
    (tmp_path / "track.yaml").write_text(yaml.safe_dump(content))
    found = neuido.diagnose(tmp_path, device="cpu", draws=39)
    assert found.answer != "none"


@pytest.mark.slow
@pytest.mark.parametrize("row", ["steel-s2", "cyclic-steel"])
def test_yield_found_leaves_what_yield_declared_leaves(data_root, row):
    """A side valley of yield had left twice as much."""
    declared = data_root / "measured" / row
    model = yaml.safe_load((declared / "test.yaml").read_text())["model"]
    model["elasticity"]["young"], model["plasticity"]["yield_stress"] = 2.0e11, 3.5e8
    elastic = model | {"plasticity": {"law": "identity"}, "free": ["young"]}
    first, second = (neuido.diagnose(declared, model=m, device="cpu", draws=39) for m in (model, elastic))
    assert second.effects[0].name == "yield" and [e.name for e in second.effects[1:]] == [e.name for e in first.effects]
    assert second.error.after < 1.05 * first.error.after
