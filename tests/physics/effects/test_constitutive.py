"""A law with effects at material points, against closed forms."""

import math

import pytest
import torch

from neuido.errors import UserError
from neuido.physics.effects.coefficients import BAND, shear_modulus
from neuido.physics.effects.constitutive import Constitutive, deviator, expm, hencky
from neuido.physics.effects.parameters import Effects
from neuido.physics.laws.classical import AutogradElastic, DruckerPrager, FixedCorotated, NeoHookean, Sigma, VonMises, lame

YOUNG, POISSON = 1e5, 0.3
MU, LAM = (float(t) for t in lame(torch.tensor(YOUNG, dtype=torch.float64), torch.tensor(POISSON, dtype=torch.float64)))
LAW = Sigma(YOUNG, POISSON)
EYE = torch.eye(3, dtype=torch.float64)
SHEAR = torch.tensor([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]], dtype=torch.float64)
STRETCH = torch.diag(torch.tensor([2.0, -1.0, -1.0], dtype=torch.float64)) / math.sqrt(6)


def point(effects, plasticity=None, count=1, law=LAW):
    return Constitutive(law, plasticity, effects, count=count)


def drive(material, rates, dt, F=None, history=None):
    """F, history and stress after each step of prescribed velocity gradients (T, P, 3, 3) or (T, 3, 3)."""
    F = EYE.expand(material.count, 3, 3) if F is None else F
    history = material.start() if history is None else history
    out = []
    for n, C in enumerate(rates):
        C = C.expand(material.count, 3, 3)
        step = torch.as_tensor(dt, dtype=torch.float64).reshape(-1, 1, 1)
        F, history = material.advance(F + step * C @ F, C, history, dt, n * dt)
        out.append(material.stress(F, C, history, (n + 1) * dt))
    return F, history, torch.stack(out)


def random_F(count, size=0.2):
    return EYE + size * torch.randn(count, 3, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)


def size(A):
    return torch.linalg.matrix_norm(A)


def energy(F, name):
    J = torch.linalg.det(F)[:, None, None]
    b = J ** (-2 / 3) * (F @ F.mT)
    I1 = b.diagonal(dim1=1, dim2=2).sum(-1)
    if name == "strain_stiffening":
        return -MU / 2 * (I1 - 3 + torch.log1p(-0.7 * (I1 - 3)) / 0.7)
    if name == "second_invariant":
        return 1.5 * MU * 0.7 * torch.log((I1**2 - (b @ b).diagonal(dim1=1, dim2=2).sum(-1)) / 6)
    if name == "fibre":
        a = torch.tensor([1.0, 2.0, -2.0], dtype=torch.float64) / 3
        return 5e3 / 4 * (((F @ a) ** 2).sum(-1) - 1) ** 2
    e = torch.linalg.svdvals(F).log()
    return MU * 0.7 * (e.clamp(max=0.0) ** 2).sum(-1)


@pytest.mark.parametrize("name", ["strain_stiffening", "second_invariant", "tension_compression", "fibre"])
def test_elastic_terms_are_the_derivative_of_their_energy(name):
    effects = Effects(fibre=5e3, fibre_direction=(2.0, 4.0, -4.0)) if name == "fibre" else Effects(**{name: 0.7})
    F = random_F(20).requires_grad_()
    (P,) = torch.autograd.grad(energy(F, name).sum(), F)
    F = F.detach()
    added = point(effects, count=20).stress(F, torch.zeros_like(F), point(effects, count=20).start()) - LAW(F)
    torch.testing.assert_close(added, P @ F.mT, rtol=1e-9, atol=1e-9 * float(added.abs().max()))


def test_second_invariant_in_equibiaxial_tension():
    lam = 1.4  # sigma_1 - sigma_3 = 2 (lam^2 - lam^-4) (W_1 + W_2 lam^2) with W_2 = 3 mu c / (2 I2), I2 = lam^4 + 2 / lam^2
    F = torch.diag(torch.tensor([lam, lam, lam**-2], dtype=torch.float64))[None]
    law = NeoHookean(YOUNG, POISSON)
    tau = point(Effects(second_invariant=0.5), law=law).stress(F, 0 * F, point(Effects()).start())[0]
    second = 0.5 * lam**2 * 3 / (lam**4 + 2 / lam**2)
    assert float(tau[0, 0] - tau[2, 2]) == pytest.approx(MU * (lam**2 - lam**-4) * (1 + second), rel=1e-12)


def test_asymmetry_acts_in_compression_alone():
    F = torch.stack([torch.diag(torch.tensor([s, 1.0, 1.0], dtype=torch.float64)) for s in (1.1, 0.9)])
    material = point(Effects(tension_compression=0.5), count=2)
    added = material.stress(F, 0 * F, material.start()) - LAW(F)
    assert float(added[0].abs().max()) == 0.0
    assert float(added[1, 0, 0]) == pytest.approx(MU * math.log(0.9), rel=1e-12)


def test_viscosity_is_newtons():
    C = torch.randn(4, 3, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    material = point(Effects(viscosity_shear=3.0, viscosity_bulk=2.0), count=4)
    D = 0.5 * (C + C.mT)
    t = D.diagonal(dim1=1, dim2=2).sum(-1)[:, None, None]
    torch.testing.assert_close(material.stress(EYE.expand(4, 3, 3), C, material.start()), 6.0 * D + 2.0 * t * EYE)


def test_a_step_of_strain_relaxes_exponentially():
    material = point(Effects(maxwell_ratio=0.5, maxwell_time=torch.tensor([0.1, 0.3])), count=2)
    dt, rate = 1e-6, 1e3
    F, history, first = drive(material, [rate * SHEAR], dt)
    F, history, rest = drive(material, [0 * SHEAR] * 20, 0.01, F, history)
    times = 0.01 * torch.arange(1, 21, dtype=torch.float64)
    shape = torch.exp(-times[:, None] / torch.tensor([0.1, 0.3], dtype=torch.float64))
    torch.testing.assert_close(rest[:, :, 0, 1] - LAW(F)[:, 0, 1], MU * 2 * 0.5 * rate * dt * shape, rtol=1e-4, atol=0.0)


def test_steady_shear_of_a_branch_ends_at_its_viscosity():
    material = point(Effects(maxwell_ratio=0.5, maxwell_time=0.01))
    _, history, _ = drive(material, [0.1 * SHEAR] * 400, 1e-3)
    assert float(history.branches[0, 0, 0, 1]) == pytest.approx(0.1 * 0.01, rel=1e-10)


def test_branches_turn_with_the_body():
    material = point(Effects(maxwell_ratio=0.5, maxwell_time=1e9))
    start = material.start()._replace(branches=1e-2 * STRETCH.expand(1, 1, 3, 3))
    W = torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]], dtype=torch.float64)
    _, history, _ = drive(material, [math.pi * W] * 1000, 1e-3, history=start)
    R = torch.linalg.matrix_exp(math.pi * W)
    torch.testing.assert_close(history.branches[0, 0], 1e-2 * R @ STRETCH @ R.mT, rtol=0, atol=1e-7)


@pytest.mark.parametrize("loss", [0.02, 0.1, 0.3])
def test_the_loss_factor_is_constant_over_the_band(loss):
    frequency = torch.logspace(math.log10(BAND[0]), math.log10(BAND[1]), 9, dtype=torch.float64)
    count, steps, cycles = len(frequency), 120, 4
    material = point(Effects(hysteresis=loss), count=count)
    dt = 1 / frequency / steps
    phase = 2 * math.pi * (torch.arange(steps * cycles + 1, dtype=torch.float64)) / steps
    strain = 1e-5 * torch.sin(phase)
    rates = [((b - a) / dt)[:, None, None] * SHEAR for a, b in zip(strain[:-1], strain[1:])]
    F, history, stress = EYE.expand(count, 3, 3), material.start(), []
    for C in rates:
        F, history = material.advance(F + dt[:, None, None] * C @ F, C, history, dt)
        stress.append(material.stress(F, C, history)[:, 0, 1])
    last = slice(-steps, None)  # the slowest branches have not settled: a drift goes beside the two phases
    t = phase[1:][last]
    basis = torch.stack([t.sin(), t.cos(), torch.ones_like(t), t], 1)
    fit = torch.linalg.lstsq(basis, torch.stack(stress)[last]).solution
    torch.testing.assert_close(fit[1] / fit[0], torch.full_like(frequency, loss), rtol=0.15, atol=0.0)


def deviatoric_size(tau):
    return size(deviator(tau))


def test_yield_ends_in_a_plateau():
    material = point(Effects(yield_inverse=1 / 2e3))
    _, _, tau = drive(material, [STRETCH] * 100, 1e-3)
    sizes = deviatoric_size(tau)[:, 0]
    assert float(sizes[20]) == pytest.approx(2 * MU * 0.021, rel=1e-3)
    assert float(sizes[-1]) == pytest.approx(2e3, rel=1e-12)


def test_yield_as_an_effect_is_the_declared_law():
    a = drive(point(Effects(yield_inverse=1 / 2e3), count=5), [3 * random_F(5)] * 20, 1e-2)
    b = drive(point(Effects(), VonMises(2e3, YOUNG, POISSON), count=5), [3 * random_F(5)] * 20, 1e-2)
    c = drive(point(Effects(hardening=0.0), VonMises(2e3, YOUNG, POISSON), count=5), [3 * random_F(5)] * 20, 1e-2)
    for other in (b, c):
        torch.testing.assert_close(a[0], other[0], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("declared", [False, True])
def test_hardening_has_its_slope(declared):
    effects = Effects(hardening=4e4) if declared else Effects(hardening=4e4, yield_inverse=1 / 2e3)
    material = point(effects, VonMises(2e3, YOUNG, POISSON) if declared else None)
    _, history, tau = drive(material, [STRETCH] * 100, 1e-3)
    alpha = float(history.alpha)
    assert float(deviatoric_size(tau)[-1]) == pytest.approx(2e3 + 4e4 * alpha, rel=1e-10)
    # monotonic: H alpha + Y = 2 mu (strain - alpha)
    assert alpha == pytest.approx((2 * MU * 0.1 - 2e3) / (2 * MU + 4e4), rel=1e-3)


def test_softening_of_the_yield_stress():
    _, history, tau = drive(point(Effects(softening=10.0, yield_inverse=1 / 2e3)), [STRETCH] * 500, 4e-4)
    assert float(deviatoric_size(tau)[-1]) == pytest.approx(2e3 * math.exp(-10.0 * float(history.alpha)), rel=5e-3)


def test_softening_without_a_yield_stress_is_damage():
    material = point(Effects(softening=2.0))
    F, history, tau = drive(material, [STRETCH] * 10 + [-STRETCH] * 5, 1e-2)
    peak = 0.0
    stretches = torch.ones(3, dtype=torch.float64)
    for n in range(15):
        stretches = stretches * (1 + (1 if n < 10 else -1) * 1e-2 * STRETCH.diagonal())
        e = stretches.log()
        peak = max(peak, float((e - e.mean()).norm()))
    assert float(history.e_max) == pytest.approx(peak, rel=1e-12)
    torch.testing.assert_close(tau[-1], LAW(F) * math.exp(-2.0 * peak))
    assert float(deviator(hencky(F)).norm()) < 0.6 * peak


def test_kinematic_hardening_shows_bauschingers_effect():
    material = point(Effects(kinematic_hardening=4e4, yield_inverse=1 / 2e3))
    F, history, there = drive(material, [STRETCH] * 100, 1e-3)
    top = float((deviator(there[-1, 0]) * STRETCH).sum())
    slope = float((history.backstress[0] * STRETCH).sum())
    assert top == pytest.approx(2e3 + slope, rel=1e-10)
    assert slope == pytest.approx(4e4 * (2 * MU * 0.1 - 2e3) / (2 * MU + 4e4), rel=1e-3)
    _, back, again = drive(material, [-STRETCH] * 100, 1e-3, F, history)
    along = (deviator(again[:, 0]) * STRETCH).sum((-2, -1))
    moved = ((deviator(again[:, 0]) - history.backstress[0]) * STRETCH).sum((-2, -1))
    # elastic over twice the yield stress, less than twice the stress that was reached
    elastic = moved > -2e3 * (1 - 1e-9)
    first = int((~elastic).nonzero()[0])
    assert float(along[first]) == pytest.approx(slope - 2e3, rel=0.05)
    assert float(along[-1]) == pytest.approx(-2e3 + float((back.backstress[0] * STRETCH).sum()), rel=1e-9)


def test_the_backstress_turns_with_the_body():
    material = point(Effects(kinematic_hardening=4e4, yield_inverse=1 / 2e3))
    start = material.start()._replace(backstress=100.0 * STRETCH.expand(1, 3, 3))
    W = torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]], dtype=torch.float64)
    _, history, _ = drive(material, [math.pi * W] * 500, 1e-3, history=start)
    R = torch.linalg.matrix_exp(0.5 * math.pi * W)
    torch.testing.assert_close(history.backstress[0], 100.0 * R @ STRETCH @ R.mT, rtol=0, atol=1e-3)


def test_overstress_is_the_viscosity_times_the_rate():
    material = point(Effects(rate_yield=torch.tensor([0.0, 50.0]), yield_inverse=1 / 2e3), count=2)
    F, _, tau = drive(material, [2.0 * STRETCH] * 400, 1e-3)
    # steady flow: the plastic rate is |dev D| = 2 / s, apart from the step's change of the strain's rate
    torch.testing.assert_close(deviatoric_size(tau)[-1], torch.tensor([2e3, 2e3 + 50.0 * 2.0], dtype=torch.float64), rtol=1e-3, atol=0.0)


def test_one_step_of_overstress():
    material = point(Effects(rate_yield=50.0, yield_inverse=1 / 2e3))
    F = torch.diag((0.05 * STRETCH.diagonal()).exp())[None]
    after, _ = material.advance(F, 0 * F, material.start(), 1e-4)
    excess = 2 * MU * 0.05 - 2e3
    expected = 2e3 + excess / (1 + 2 * MU * 1e-4 / 50.0)
    assert float(deviatoric_size(LAW(after))) == pytest.approx(expected, rel=1e-12)


def test_stiffness_in_space_and_time():
    F = random_F(3, 0.05)
    material = point(Effects(stiffness=torch.tensor([1.0, 2.0, 3.0]), stiffness_change=-0.5), count=3)
    factor = torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64)[:, None, None] * math.exp(-0.5 * 0.4)
    torch.testing.assert_close(material.stress(F, 0 * F, material.start(), 0.4), LAW(F) * factor)


def test_a_stiffer_part_yields_at_the_same_stress():
    material = point(Effects(stiffness=torch.tensor([1.0, 4.0])), VonMises(2e3, YOUNG, POISSON), count=2)
    _, _, tau = drive(material, [STRETCH] * 100, 1e-3)
    torch.testing.assert_close(deviatoric_size(tau)[-1], torch.full((2,), 2e3, dtype=torch.float64))


def test_cohesion_moves_the_tip_of_the_cone():
    phi, c = math.radians(30.0), 300.0
    sand = DruckerPrager(30.0, YOUNG, POISSON)
    material = point(Effects(cohesion=c), sand)
    F, _, tau = drive(material, [0.1 * EYE] * 200, 1e-2)
    torch.testing.assert_close(tau[-1, 0], c / math.tan(phi) * EYE, rtol=1e-9, atol=1e-6)
    alpha = math.sqrt(2 / 3) * 2 * math.sin(phi) / (3 - math.sin(phi))
    _, _, tau = drive(material, [0.1 * SHEAR] * 200, 1e-2)
    trace = tau[-1, 0].diagonal().sum()
    assert float(deviatoric_size(tau)[-1]) == pytest.approx(float(alpha * (3 * c / math.tan(phi) - trace)), rel=1e-9)
    without = drive(point(Effects(cohesion=0.0), sand, count=4), [random_F(4) - EYE] * 20, 1e-2)[0]
    torch.testing.assert_close(without, drive(point(Effects(), sand, count=4), [random_F(4) - EYE] * 20, 1e-2)[0], rtol=1e-10, atol=1e-10)


def test_the_matrix_exponential():
    A = 2.0 * (random_F(8) - EYE)
    values, vectors = torch.linalg.eigh(A + A.mT)
    torch.testing.assert_close(expm(A + A.mT), vectors @ torch.diag_embed(values.exp()) @ vectors.mT, rtol=1e-12, atol=1e-12)


def test_a_step_leaves_isochoric_flow_isochoric():
    material = point(Effects(yield_inverse=1 / 500.0, hardening=1e4, kinematic_hardening=1e4, softening=2.0), count=6)
    C = deviator(random_F(6, 1.0))
    F = EYE.expand(6, 3, 3)
    history = material.start()
    for _ in range(30):
        trial = F + 1e-2 * C @ F
        F, history = material.advance(trial, C, history, 1e-2)
        torch.testing.assert_close(torch.linalg.det(F), torch.linalg.det(trial), rtol=1e-12, atol=0.0)
    assert float(history.alpha.min()) > 0.05


def test_the_shear_modulus_of_any_law():
    numeric = AutogradElastic(NeoHookean.twin, NeoHookean(YOUNG, POISSON).tensors(), modulus=LAM + 2 * MU)
    assert float(shear_modulus(numeric)) == pytest.approx(MU, rel=1e-6)
    assert float(shear_modulus(FixedCorotated(YOUNG, POISSON))) == pytest.approx(MU, rel=1e-12)


def test_gradients_of_the_material_reach_the_parameters():
    young = torch.tensor(YOUNG, dtype=torch.float64, requires_grad=True)
    values = [torch.tensor(v, dtype=torch.float64, requires_grad=True) for v in (1 / 2e3, 1e3, 2.0, 1e3, 5.0, 0.3, 0.05)]
    C = random_F(3)

    def end():
        effects = Effects(
            yield_inverse=values[0],
            hardening=values[1],
            softening=values[2],
            kinematic_hardening=values[3],
            rate_yield=values[4],
            maxwell_ratio=values[5],
            maxwell_time=values[6],
        )
        return drive(point(effects, count=3, law=Sigma(young, POISSON)), [C] * 10, 1e-2)[2][-1]

    weights = random_F(3)
    leaves = [young, *values]
    gradients = torch.autograd.grad((end() * weights).sum(), leaves)
    for t, gradient in zip(leaves, gradients):
        h = 1e-4 * float(t.detach())
        sides = []
        with torch.no_grad():
            for shift in (-2, -1, 1, 2):
                t += shift * h
                sides.append(float((end() * weights).sum()))
                t -= shift * h
        numeric = (8 * (sides[2] - sides[1]) - (sides[3] - sides[0])) / (12 * h)
        assert numeric == pytest.approx(float(gradient), rel=1e-5) and numeric != 0


@pytest.mark.parametrize(
    ("effects", "plasticity", "message"),
    [
        (Effects(hardening=1.0), None, "hardening needs a yield stress"),
        (Effects(cohesion=1.0), None, "cohesion needs a declared drucker_prager"),
        (Effects(cohesion=1.0), VonMises(1e3, 1e5, 0.3), "cohesion needs a declared drucker_prager"),
        (Effects(yield_inverse=1.0), VonMises(1e3, 1e5, 0.3), "yields already"),
        (Effects(softening=1.0), DruckerPrager(30.0, 1e5, 0.3), "softening needs a declared von_mises"),
        (Effects(maxwell_ratio=1.0), None, "maxwell_ratio and maxwell_time come together"),
        (Effects(maxwell_ratio=1.0, maxwell_time=0.0), None, "maxwell_time is 0 s"),
        (Effects(fibre=1.0), None, "fibre and fibre_direction come together"),
        (Effects(fibre=1.0, fibre_direction=(0.0, 0.0, 0.0)), None, "fibre_direction is zero"),
        (Effects(yield_inverse=-1.0), None, "yield_inverse is -1 1/Pa"),
        (Effects(hysteresis=torch.tensor([0.1, float("nan")])), None, "hysteresis is nan"),
        (Effects(stiffness=torch.tensor([1.0, 0.0])), None, "must be positive"),
        (Effects(stiffness=torch.ones(3)), None, "give one factor for each"),
        (Effects(relative_density=torch.tensor([-1.0, 1.0])), None, "relative_density is -1 somewhere"),
        (Effects(strain_stiffening=torch.ones(3)), None, "3 rows for 2 scenes"),
    ],
)
def test_what_does_not_fit_is_said(effects, plasticity, message):
    with pytest.raises(UserError, match=message):
        point(effects, plasticity, count=2)
