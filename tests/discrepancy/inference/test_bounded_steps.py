"""Fits whose parameters act alike and may not be negative, as the branches of a relaxation spectrum: steps end at the best place within."""

import numpy as np
import pytest
import yaml
from scipy.optimize import nnls

from neuido.discrepancy.inference.least_squares import bounded_least_squares, levenberg_marquardt
from neuido.discrepancy.inference.search.attribution import diagnose
from neuido.discrepancy.problems.problem import Parameter
from neuido.discrepancy.problems.specimens.material import MaterialProblem
from neuido.discrepancy.workflow import restricted

TIMES = np.geomspace(0.002, 200, 5)
"""Of the branches [s]."""
TRUE_TIMES, TRUE_SHARES = (0.5, 6.0, 70.0), (0.87, 0.67, 0.5)


def relaxation(t, times=TIMES):
    return np.exp(-t[:, None] / np.asarray(times))


def driven(request, residual):
    """Run a fit by itself."""
    points = next(request)
    while True:
        try:
            points = request.send([residual(point) for point in points])
        except StopIteration as end:
            return end.value


@pytest.mark.parametrize("together", [True, False])
@pytest.mark.parametrize("start", [0.1, 0.5])
def test_a_fit_comes_to_the_least_squares_within_the_bounds(start, together):
    """The stress is a modulus times one and the branches; cut off at zero, steps stalled at many times the least cost."""
    t = np.geomspace(0.02, 199, 90)
    y = 26.0 * (1 + relaxation(t, TRUE_TIMES) @ TRUE_SHARES) + np.random.default_rng(0).normal(0, 0.05, len(t))
    A = np.c_[np.ones(len(t)), relaxation(t)]
    least = nnls(A, y)[1] ** 2
    parameters = [Parameter("young", "Pa", 50.0, 0.2, 1.0, 1e3, log=True)]
    parameters += [Parameter(f"g{i}", "1", 0.0, 0.1, 0.0, 50.0) for i in range(5)]

    def residual(point):
        return point["young"] * (1 + relaxation(t) @ [point[f"g{i}"] for i in range(5)]) - y

    fit = driven(levenberg_marquardt(parameters, {"young": 50.0} | {f"g{i}": start for i in range(5)}, together=together), residual)
    assert fit.cost < 1.05 * least


def test_the_least_squares_within_bounds():
    rng = np.random.default_rng(1)
    A, b = rng.normal(size=(30, 4)), rng.normal(size=30)
    np.testing.assert_allclose(bounded_least_squares(A, b, np.zeros(4), np.full(4, np.inf)), nnls(A, b)[0], atol=1e-9)
    held = bounded_least_squares(A, b, np.zeros(4), np.array([np.inf, 0.0, np.inf, np.inf]))
    assert held[1] == 0 and (held >= 0).all()


@pytest.mark.slow
def test_three_relaxation_times_are_a_spectrum(tmp_path):
    """Muscle held after a ramp: its spectrum was rejected at 8.8 times the error of creep."""
    rng, tests = np.random.default_rng(208), []
    t = np.unique(np.r_[np.linspace(0, 1, 40), 1 + np.geomspace(0.02, 199, 90)])
    stretch = 1 + 0.12 * np.minimum(t, 1)
    strain = stretch**2 - 1 / stretch
    for i, role in enumerate(("fit", "fit", "held_out")):
        stress = 9e3 * strain
        for share, time in zip((0.8, 0.6, 0.5), TRUE_TIMES, strict=True):
            branch = [0.0]
            for step, rise in zip(np.diff(t) / time, np.diff(strain), strict=True):
                branch.append(np.exp(-step) * branch[-1] + share * 9e3 * rise * -np.expm1(-step) / step)
            stress = stress + np.array(branch)
        stress = stress / stretch * (1 + rng.normal(0, 0.02)) + rng.normal(0, 12, len(t))
        np.savetxt(tmp_path / f"m{i}.csv", np.c_[stretch, stress, t], delimiter=",", header="stretch,stress,time", comments="")
        columns = {"stretch": "stretch", "nominal_stress": "stress", "time": "time"}
        tests.append({"name": f"m{i}", "file": f"m{i}.csv", "mode": "uniaxial", "columns": columns, "role": role})
    elasticity = {"law": "neo_hookean", "young": 76e3, "poisson": 0.499}
    model = {"density": 1000.0, "elasticity": elasticity, "plasticity": {"law": "identity"}, "free": ["young"], "incompressible": True}
    content = {"format": "neuido-material-test/1", "name": "muscle", "model": model, "tests": tests}
    (tmp_path / "test.yaml").write_text(yaml.safe_dump(content))
    found = diagnose(restricted(MaterialProblem(tmp_path), "relaxation_spectrum,creep,fractional,maxwell"), draws=39, most=1)
    assert "relaxation_spectrum" in {t.candidate.name for t in found.effects}
    (spectrum,) = [t for t in found.effects if t.candidate.name == "relaxation_spectrum"]
    assert spectrum.fit.point["young"] == pytest.approx(27e3, rel=0.25)
