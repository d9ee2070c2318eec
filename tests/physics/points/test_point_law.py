"""Effects of material points against closed forms, against each other's engines, and their derivatives against differences."""

import math

import numpy as np
import pytest
import torch

from neuido.errors import UserError
from neuido.physics.effects.coefficients import tables
from neuido.physics.effects.parameters import Effects
from neuido.physics.laws.classical import FixedCorotated, NeoHookean, Sigma, VonMises
from neuido.physics.points.material_point import Specimen, complex_modulus, strain_along, stress_along
from neuido.physics.points.plane_engine import PlaneEngine
from neuido.physics.points.rig import Rig, TensorEngine

YOUNG = 1.2e6
MU = YOUNG / (2 * 1.499)


def rubber(points: int = 1, **effects) -> Specimen:
    return Specimen(NeoHookean(YOUNG, 0.499), None, of(effects), points, incompressible=True)


def metal(points: int = 1, *, yield_stress: float = 3e5, **effects) -> Specimen:
    return Specimen(Sigma(2e8, 0.3), VonMises(yield_stress, 2e8, 0.3), of(effects), points)


def of(effects) -> Effects:
    return Effects.of({name.replace("__", "."): value for name, value in effects.items()})


def column(values) -> torch.Tensor:
    return torch.as_tensor(np.asarray(values), dtype=torch.float64)[:, None]


def test_a_spectrum_and_a_power_law_relax_as_their_closed_forms():
    t = torch.tensor(np.concatenate([[0.0, 1e-3], np.geomspace(0.02, 50.0, 30)]))
    step = column([0.0] + [0.01] * 31)
    g, T = (0.5, 0.0, 0.3, 0.2, 0.4), np.geomspace(0.05, 20.0, 5)
    given = {f"relaxation_spectrum__g{i + 1}": v for i, v in enumerate(g)}
    specimen = rubber(**given, relaxation_spectrum__first=0.05, relaxation_spectrum__last=20.0)
    after = t[1:].numpy() - 1e-3
    ramp = sum(v * tau / 1e-3 * -math.expm1(-1e-3 / tau) * np.exp(-after / tau) for v, tau in zip(g, T, strict=True))
    np.testing.assert_allclose(stress_along(specimen, "simple_shear", step, time=t)[0, 1:, 0], MU * 0.01 * (1 + ramp), rtol=1e-6)
    power = rubber(fractional__ratio=0.7, fractional__exponent=0.3, fractional__time=1.0)
    seen = stress_along(power, "simple_shear", step, time=t)[0, 2:, 0].numpy() / (MU * 0.01) - 1
    np.testing.assert_allclose(seen, 0.7 * (t[2:].numpy() - 5e-4) ** -0.3, rtol=0.02)


def test_mullins_leaves_the_first_loading_alone_and_softens_the_way_back():
    l = np.concatenate([np.linspace(1.0, 3.0, 21), np.linspace(2.9, 1.1, 10), np.linspace(1.2, 3.0, 10)])
    there = stress_along(rubber(mullins__share=0.4, mullins__width=0.5), "uniaxial", column(l))[0, :, 0].numpy()
    plain = MU * (l - l**-2)
    np.testing.assert_allclose(there[:21], plain[:21], rtol=1e-9, atol=1e-6)
    x, top = l**2 + 2 / l - 3, 9 + 2 / 3 - 3
    factor = [1 - 0.4 * math.erf((top - a) / (0.5 * top)) for a in x[21:]]
    np.testing.assert_allclose(there[21:], plain[21:] * factor, rtol=1e-9)


def test_a_permanent_set_is_the_stretch_without_stress():
    l = np.array([1.0, 1.5, 2.0, 2.0**0.3, 1.0])
    there = stress_along(rubber(permanent_set__share=0.3), "uniaxial", column(l))[0, :, 0].numpy()
    e = np.log(l) - 0.3 * np.array([0.0, math.log(1.5), math.log(2), math.log(2), math.log(2)])
    np.testing.assert_allclose(there, MU * (np.exp(2 * e) - np.exp(-e)) / l, rtol=1e-9, atol=1e-6)
    assert there[3] == pytest.approx(0.0, abs=1e-3) and there[4] < 0


def test_compaction_rises_towards_the_locking_strain():
    foam = Specimen(Sigma(1e5, 0.0), None, of({"compaction__k": 0.5, "compaction__lock": 1.0}), 1)
    l = np.array([1.2, 1.0, 0.9, 0.6, 0.45])
    there = stress_along(foam, "uniaxial", column(l), true_stress=True)[0, :, 0].numpy()
    x = np.maximum(-np.log(l), 0)
    np.testing.assert_allclose(there, (1e5 * np.log(l) - 1e5 * 0.5 * x**2 / (1.0 - x)) / l, rtol=1e-8, atol=1e-6)


@pytest.mark.parametrize("exponent", [1.0, 3.0])
def test_creep_flows_at_the_rate_of_the_stress(exponent):
    tau, t = 1e4, torch.tensor([0.0, 1e-3, *range(1, 10)], dtype=torch.float64)
    specimen = rubber(creep__rate=2e-3, creep__exponent=exponent, creep__stress=2e4)
    gamma = strain_along(specimen, "simple_shear", column([tau] * 11), time=t)[0, :, 0].numpy()
    steady = math.sqrt(2) * 2e-3 * (math.sqrt(2) * tau / 2e4) ** exponent  # |s| = sqrt(2) tau, and gamma' = sqrt(2) plastic rate
    np.testing.assert_allclose(np.diff(gamma)[1:] / np.diff(t.numpy())[1:], steady, rtol=0.03)
    assert gamma[0] == pytest.approx(tau / MU, rel=1e-2)


def test_hardening_that_saturates_and_backstress_that_fades():
    """Shear: the norm of the stress is sqrt(2) tau, alpha is the plastic shear over sqrt(2)."""
    gamma = np.concatenate([np.linspace(0, 0.2, 401), np.linspace(0.1995, -0.2, 800)])
    both = metal(nonlinear_backstress__h1=4e7, nonlinear_backstress__g1=100.0, cyclic_hardening__q=1e5, cyclic_hardening__b=20.0)
    tau = stress_along(both, "simple_shear", column(gamma))[0, :, 0].numpy()
    mu = 2e8 / 2.6
    alpha = (0.2 - tau[400] / mu) / math.sqrt(2)
    limit = 3e5 + 1e5 * -math.expm1(-20 * alpha)
    assert math.sqrt(2) * tau[400] == pytest.approx(limit + 4e5 * -math.expm1(-100 * alpha), rel=0.01)
    alpha += (0.4 - (tau[400] - tau[-1]) / mu) / math.sqrt(2)
    assert math.sqrt(2) * tau[-1] == pytest.approx(-(3e5 + 1e5 * -math.expm1(-20 * alpha)) - 4e5, rel=0.01)


def test_flow_stress_is_that_of_herschel_and_bulkley():
    for rate in (0.1, 10.0):
        t = torch.linspace(0.0, 1.0 / rate, 201, dtype=torch.float64)
        specimen = metal(rate_power__k=1e5, rate_power__n=0.5)
        tau = stress_along(specimen, "simple_shear", column(rate * t.numpy()), time=t)[0, -1, 0].item()
        assert math.sqrt(2) * tau == pytest.approx(3e5 + 1e5 * math.sqrt(rate / math.sqrt(2)), rel=0.005)


def test_small_oscillations_give_the_complex_modulus():
    w = 2.0
    effects = {"creep__rate": 0.2, "creep__exponent": 1.0, "creep__stress": MU, "viscosity_shear__eta": 2e4}
    effects |= {f"relaxation_spectrum__g{i}": 0.3 for i in range(1, 6)} | {
        "relaxation_spectrum__first": 0.1,
        "relaxation_spectrum__last": 3.0,
    }
    specimen = rubber(2, **effects)
    G = complex_modulus(specimen, torch.tensor([w], dtype=torch.float64))
    assert G.shape == (2, 1, 2)
    n = 100
    t = torch.arange(n, dtype=torch.float64) * 2 * math.pi / w / n
    gamma = 1e-4 * np.sin(w * t.numpy())
    tau = stress_along(specimen, "simple_shear", column(gamma), time=t, periodic=True)[0, :, 0].numpy()
    storage, loss = (2 * np.mean(tau * f(w * t.numpy())) / 1e-4 for f in (np.sin, np.cos))
    assert storage == pytest.approx(G[0, 0, 0].item(), rel=0.01) and loss == pytest.approx(G[0, 0, 1].item(), rel=0.02)


def test_a_prescribed_stress_gives_back_the_strain():
    l = column(np.linspace(1.05, 2.0, 8))
    for specimen in (rubber(strain_stiffening__k=0.1), Specimen(NeoHookean(1e5, 0.3), None, Effects(), 1), metal(hardening__h=1e6)):
        for mode in ("uniaxial", "equibiaxial"):
            s = stress_along(specimen, mode, l if specimen.incompressible else 1 + (l - 1) / 100)
            back = strain_along(specimen, mode, s[0])[0]
            torch.testing.assert_close(back, l if specimen.incompressible else 1 + (l - 1) / 100, rtol=1e-6, atol=1e-8)


EVERYTHING = {
    "mullins.share": 0.3, "mullins.width": 0.8, "permanent_set.share": 0.1, "compaction.k": 0.4, "compaction.lock": 1.0,
    "nonlinear_backstress.h1": 4e4, "nonlinear_backstress.g1": 30.0, "nonlinear_backstress.h2": 1e4, "nonlinear_backstress.g2": 5.0,
    "cyclic_hardening.q": -5e3, "cyclic_hardening.b": 5.0, "rate_power.k": 1e4, "rate_power.n": 0.4, "fractional.ratio": 0.2,
    "fractional.exponent": 0.4, "fractional.time": 1.0, "strain_stiffening.k": 0.1, "second_invariant.c": 0.2, "tension_compression.r": 0.3,
    "viscosity_shear.eta": 500.0, "viscosity_bulk.zeta": 300.0, "stiffness_change.rate": 0.05, "hardening.h": 1e4, "softening.s": 0.1,
    "kinematic_hardening.h": 2e4, "rate_yield.eta": 1e3,
}  # fmt: skip


@pytest.mark.parametrize(("law", "mode"), [(NeoHookean, "uniaxial"), (Sigma, "simple_shear"), (FixedCorotated, "pure_shear")])
def test_both_engines_compute_the_same(law, mode):
    t = np.linspace(0.0, 4.0, 12)
    path = (np.exp(0.3 * np.sin(2 * t)) if mode != "simple_shear" else 0.5 * np.sin(2 * t))[:, None]
    creep = {"creep.rate": 0.05, "creep.exponent": 2.0, "creep.stress": 2e4}
    some = {k: v for k, v in EVERYTHING.items() if k.partition(".")[0] in ("mullins", "fractional", "softening")}
    for effects, plasticity in ((EVERYTHING, VonMises(2e4, YOUNG, 0.3)), ({**some, **creep}, None)):
        values = {name: torch.tensor([value, 0.5 * value], dtype=torch.float64) for name, value in effects.items()}
        specimen = Specimen(law(YOUNG, 0.3), plasticity, Effects.of(values), 2)
        rig = Rig(specimen, mode, path, np.array([1.0, 0.0, 0.0]), true_stress=False)
        engines = PlaneEngine(rig), TensorEngine(rig)
        with torch.no_grad():
            fast, slow = (rig.along(engine, t, 0.1) for engine in engines)
        for a, b in zip(fast, slow, strict=True):
            assert np.isfinite(a).all()
            np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-6 * np.abs(b).max())


SOFT = ("mullins", "permanent_set", "compaction", "fractional")
GROUPS = {
    "yields": {name: value for name, value in EVERYTHING.items() if "viscosity" not in name},
    "creeps": {name: value for name, value in EVERYTHING.items() if name.partition(".")[0] in SOFT}
    | {"creep.rate": 0.05, "creep.exponent": 2.0, "creep.stress": 2e4},
    "relaxes": {f"relaxation_spectrum.g{i}": 0.1 * i for i in range(1, 6)}
    | {"relaxation_spectrum.first": 0.05, "relaxation_spectrum.last": 20.0, "hysteresis.eta": 0.2},
    "relaxes once": {"maxwell.ratio": 0.4, "maxwell.time": 0.3, "viscosity_shear.eta": 500.0, "viscosity_bulk.zeta": 300.0},
}
"""Parameters that are differentiated together."""


@pytest.mark.parametrize("group", GROUPS)
def test_derivatives_of_every_parameter_are_those_of_differences(group):
    torch.manual_seed(0)
    names = list(GROUPS[group])
    C = 0.3 * torch.randn(4, 3, 3, dtype=torch.float64)

    def total(values: torch.Tensor) -> torch.Tensor:
        effects = Effects.of(dict(zip(names, values, strict=True)))
        specimen = Specimen(NeoHookean(YOUNG, 0.3), VonMises(2e4, YOUNG, 0.3) if group == "yields" else None, effects, 4)
        law = specimen.law()
        F, history = torch.eye(3, dtype=torch.float64).expand(4, 3, 3), law.start()
        out = torch.zeros((), dtype=torch.float64)
        for i in range(3):
            step = C if i < 2 else -0.5 * C
            F, history = law.advance((torch.eye(3, dtype=torch.float64) + 0.2 * step) @ F, step, history, 0.2, 0.2 * i)
            out = out + (law.stress(F, step, history, 0.2 * i) * torch.linspace(0.5, 1.5, 9, dtype=torch.float64).reshape(3, 3)).sum()
        return out / 1e4

    start = torch.tensor(list(GROUPS[group].values()), dtype=torch.float64)
    values = start.clone().requires_grad_()
    (grad,) = torch.autograd.grad(total(values), values)
    for i, name in enumerate(names):
        h = 1e-5 * float(start[i].abs())
        ends = [float(total(start + sign * h * torch.eye(len(names), dtype=torch.float64)[i])) for sign in (1, -1)]
        assert float(grad[i]) == pytest.approx((ends[0] - ends[1]) / (2 * h), rel=2e-4, abs=1e-6 / float(start[i].abs())), name
        assert float(grad[i]) != 0.0, name


def test_slopes_of_the_moduli_by_a_spectrum():
    """dG'/dg = mu (w T)^2 / (1 + (w T)^2) and dG''/dg = mu w T / (1 + (w T)^2) of a branch."""
    w, h, T = torch.tensor([0.3, 2.0, 40.0], dtype=torch.float64), 1e-5, np.geomspace(0.05, 20.0, 5)
    given = {f"relaxation_spectrum__g{i}": 0.2 for i in range(1, 6)}
    ends = {"relaxation_spectrum__first": 0.05, "relaxation_spectrum__last": 20.0}
    for i in range(5):
        name = f"relaxation_spectrum__g{i + 1}"
        high, low = (complex_modulus(rubber(**(given | {name: 0.2 + sign * h}), **ends), w)[0].numpy() for sign in (1, -1))
        x = w.numpy() * T[i]
        np.testing.assert_allclose((high - low) / (2 * h), MU * np.stack([x**2, x], 1) / (1 + x**2)[:, None], rtol=1e-6)


def test_a_body_refuses_what_only_a_material_point_has():
    like = torch.zeros((), dtype=torch.float64)
    with pytest.raises(UserError, match="mullins is an effect of material tests"):
        tables(of({"mullins__share": 0.3}), NeoHookean(YOUNG, 0.3), None, 1, like)
    branches = tables(of({"fractional__ratio": 0.3}), NeoHookean(YOUNG, 0.3), None, 1, like).branches
    assert branches is not None and branches.shape == (1, 13, 2)
    with pytest.raises(UserError, match=r"mullins\.share is 2"):
        stress_along(rubber(mullins__share=2.0), "uniaxial", column([1.0, 1.1]))
    with pytest.raises(UserError, match="creep depends on the rate"):
        stress_along(rubber(creep__rate=2.0), "uniaxial", column([1.0, 1.1]))
