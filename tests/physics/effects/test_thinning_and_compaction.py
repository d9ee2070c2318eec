"""Rollouts of rubber, foam, fluid, honey and snow with gradients; `yield_index` and `compaction_hardening` against closed forms."""

import math

import pytest
import torch
import warp as wp

from neuido.errors import UserError
from neuido.physics.effects import stress_kernels
from neuido.physics.effects.constitutive import Constitutive, plastic_step
from neuido.physics.effects.history_functions import COMPACTED
from neuido.physics.effects.parameters import Effects
from neuido.physics.laws.classical import FixedCorotated, Fluid, Gent, Hyperfoam, MooneyRivlin, Sigma, Snow, VolumetricReset, VonMises
from neuido.physics.mpm import reference
from neuido.physics.mpm.simulator import Simulator
from neuido.types import ParticleState
from tests.physics.bodies import DEVICE, busy_scenes

EYE = torch.eye(3, dtype=torch.float64)
YOUNG, POISSON = 5e4, 0.3


def leaf(value) -> torch.Tensor:
    return torch.as_tensor(value, dtype=torch.float64).clone().to(DEVICE).requires_grad_()


class Case:
    """A deformed body in contact; every parameter of the material and every part of the state is a leaf."""

    VALUES = {
        "mooney_rivlin": {"c10": 1e4, "c01": 5e3, "bulk": 6e4},
        "gent": {"shear": 3e4, "limit": 0.05, "bulk": 6e4},
        "hyperfoam": {"shear": 2e4, "exponent": 4.0, "poisson": 0.2},
        "fluid": {"bulk": 5e4, "viscosity_shear": 5.0},
        "viscoplastic": {"yield_stress": 500.0, "young": YOUNG, "poisson": POISSON, "rate_yield": 30.0, "yield_index": 0.6},
        "snow": {"young": YOUNG, "poisson": POISSON, "compression": 0.02, "stretch": 0.01, "compaction_hardening": 8.0},
    }

    def __init__(self, name: str):
        self.name, self.sim = name, Simulator(*busy_scenes(), dtype=torch.float64, device=DEVICE)
        g = torch.Generator().manual_seed(3)
        noise = torch.randn(self.sim.state.F.shape, generator=g, dtype=torch.float64).to(DEVICE)
        self.parameters = {key: leaf(value) for key, value in self.VALUES[name].items()}
        state = self.sim.state
        self.state = {"x": leaf(state.x), "v": leaf(state.v), "C": leaf(state.C), "F": leaf(state.F + 0.05 * noise)}

    def laws(self):
        p = {key: value for key, value in self.parameters.items() if key not in Effects._fields}
        if self.name == "fluid":
            return Fluid(**p), VolumetricReset()
        if self.name == "viscoplastic":
            return Sigma(p["young"], p["poisson"]), VonMises(**p)
        if self.name == "snow":
            return FixedCorotated(p.pop("young"), p.pop("poisson")), Snow(**p)
        return {"mooney_rivlin": MooneyRivlin, "gent": Gent, "hyperfoam": Hyperfoam}[self.name](**p), None

    def loss(self, run, steps):
        effects = {key: value for key, value in self.parameters.items() if key in Effects._fields}
        frames = run(steps, *self.laws(), state=ParticleState(**self.state), effects=Effects(**effects) if effects else None, every=3)
        total = 0.0
        for n, t in enumerate(frames):
            weights = torch.randn(t.shape, generator=torch.Generator().manual_seed(n), dtype=t.dtype)
            total = total + (t * weights.to(t.device)).sum()
        return total, frames

    def gradients(self, run, steps):
        loss, frames = self.loss(run, steps)
        leaves = self.parameters | self.state
        return frames, dict(zip(leaves, torch.autograd.grad(loss, list(leaves.values()))))


@pytest.mark.parametrize("name", Case.VALUES)
def test_rollout_and_its_gradient(name):
    """The kernels equal the slow twin in torch, and central differences of the rollout."""
    case, steps = Case(name), 6
    frames, fast = case.gradients(case.sim.rollout, steps)
    expected, slow = case.gradients(lambda *a, **k: reference.rollout(case.sim, *a, **k), steps)
    for key, a, b in zip("xvCF", frames, expected):
        assert torch.allclose(a, b, rtol=0, atol=1e-11 * float(b.detach().abs().max())), key
    for key in fast:
        assert float((fast[key] - slow[key]).norm()) <= 1e-8 * float(slow[key].norm()), key
        assert float(fast[key].norm()) > 0, key
    for key, t in (case.parameters | {"F": case.state["F"]}).items():
        direction = torch.randn(t.shape, generator=torch.Generator().manual_seed(9), dtype=t.dtype).to(t.device)
        h = 1e-6 * float(t.detach().norm() / direction.norm())
        values = []
        with torch.no_grad():
            for shift in (-1, 1):
                t.add_(shift * h * direction)
                values.append(float(case.loss(case.sim.rollout, steps)[0]))
                t.sub_(shift * h * direction)
        numeric, analytic = (values[1] - values[0]) / (2 * h), float((fast[key] * direction).sum())
        assert abs(numeric - analytic) <= 1e-4 * abs(analytic) + 1e-9 / h, f"{key}: {numeric} {analytic}"


def flow(F: torch.Tensor, row: list[float], dt: float = 1e-3, adjoint: torch.Tensor | None = None):
    """Run the kernel of plastic flow at F (P, 3, 3), or its adjoint: those of F and of the row of the table."""
    kernels, P = stress_kernels.build(wp.float64), len(F)
    of = {
        "scene": torch.zeros(P, dtype=torch.int32),
        "dt": torch.tensor([dt], dtype=torch.float64),
        "kinds": torch.ones(1, dtype=torch.int32),
    }
    table, empty = torch.tensor([row], dtype=torch.float64), torch.zeros(P, 0, dtype=torch.float64)

    def matrices(t):
        return wp.from_torch(t.contiguous(), dtype=wp.mat33d)

    given = [*(wp.from_torch(t) for t in of.values()), wp.from_torch(table), None, None, -1, -1]
    state = [matrices(F), matrices(torch.zeros_like(F)), wp.from_torch(empty)]
    if adjoint is None:
        out = torch.zeros_like(F)
        wp.launch(kernels.flow, P, [*given, *state, matrices(out), wp.from_torch(empty)], device="cpu")
        return out
    a_F, a_C, a_table = torch.zeros_like(F), torch.zeros_like(F), torch.zeros_like(table)
    sinks = [
        matrices(adjoint),
        wp.from_torch(empty),
        matrices(a_F),
        matrices(a_C),
        wp.from_torch(empty),
        wp.from_torch(a_table),
        None,
        None,
    ]
    wp.launch(kernels.flow_adjoint, P, [*given, *state, *sinks], device="cpu")
    return a_F, a_table[0]


@pytest.mark.parametrize("index", [0.3, 0.6, 1.0, 1.7])
def test_power_law_flow_at_its_onset_and_far_beyond(index):
    """Kernel against bisection, and its adjoint against central differences, at |s| from 0.9 to 30 times the yield stress."""
    two_mu, limit, eta, dt = 4e4, 400.0, 20.0, 1e-3
    row = [two_mu, 1 / limit, 0.0, 0.0, 0.0, eta, 0.0, 0.0, index]
    over = torch.tensor([0.9, 0.999, 1.001, 1.01, 1.3, 3.0, 30.0], dtype=torch.float64)
    axis = torch.diag(torch.tensor([2.0, -1.0, -1.0], dtype=torch.float64)) / math.sqrt(6)
    turn, _ = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64))
    F = turn @ torch.matrix_exp(over[:, None, None] * limit / two_mu * axis) @ turn.mT
    out = flow(F, row)
    kept = torch.linalg.svdvals(out).log()
    kept = two_mu * (kept - kept.mean(1, keepdim=True)).norm(dim=1)
    ones = torch.ones(5, dtype=torch.float64)
    step = plastic_step((over[2:] - 1) * limit, two_mu * ones, eta * ones, index * ones, dt * ones)
    torch.testing.assert_close(kept[2:], over[2:] * limit - two_mu * step, rtol=1e-11, atol=0)
    assert torch.equal(out[:2], F[:2])
    weight = torch.randn(F.shape, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    a_F, a_row = flow(F, row, adjoint=weight)
    for i in range(3):
        for j in range(3):
            h = torch.zeros(3, 3, dtype=torch.float64)
            h[i, j] = 1e-7
            numeric = ((flow(F + h, row) - flow(F - h, row)) * weight).sum((1, 2)) / 2e-7
            torch.testing.assert_close(a_F[:, i, j], numeric, rtol=1e-5, atol=1e-6)
    for column in (0, 1, 5, 8):
        h = 1e-5 * row[column]
        up, down = (flow(F, [*row[:column], row[column] + sign * h, *row[column + 1 :]]) for sign in (1, -1))
        numeric = float(((up - down) * weight).sum() / (2 * h))
        assert float(a_row[column]) == pytest.approx(numeric, rel=1e-5), column


@pytest.mark.parametrize("index", [0.5, 1.0])
def test_steady_shear_is_herschel_and_bulkley_s(index):
    """The shear stress of a flow that does not change is yield stress/sqrt(2) + viscosity r^n, as `families.effects` has it."""
    from neuido.data.bodies import families

    rate, dt = 20.0, 1e-4
    entry = {"young": 1e6, "poisson": 0.3, "yield_stress": 200.0, "viscosity": 15.0, "index": index}
    (elastic, plastic), effects = families.laws("viscoplastic", [entry]), families.effects("viscoplastic", [entry])
    material = Constitutive(elastic, plastic, effects, count=1)
    C = rate * torch.tensor([[[0.0, 1.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]]], dtype=torch.float64)
    F, history = EYE[None], material.start()
    for _ in range(100):
        F, history = material.advance((EYE + dt * C) @ F, C, history, dt)
    shear = float(material.stress(F, C, history)[0, 0, 1])
    assert shear == pytest.approx(200 / math.sqrt(2) + 15 * rate**index, rel=2e-3)


def test_compacted_snow_is_harder():
    """tau = exp(xi (1 - J_P)) tau(F_e) after a compression in two steps, up to the bound of J_P."""
    xi, compression = 10.0, 0.02
    base = FixedCorotated(YOUNG, POISSON)
    material = Constitutive(base, Snow(compression, 0.01), Effects(compaction_hardening=xi), count=2)
    F, history = EYE.expand(2, 3, 3), material.start()
    total = torch.tensor([0.95, 0.7], dtype=torch.float64)
    for _ in range(2):
        F, history = material.advance(total.sqrt()[:, None, None] * F, torch.zeros_like(F), history, 1e-3)
    kept = (1 - compression) * EYE.expand(2, 3, 3)
    torch.testing.assert_close(F, kept)
    J_P = (total / (1 - compression)) ** 3
    torch.testing.assert_close(history.compaction, J_P.log())
    factor = torch.exp(xi * (1 - J_P.clamp(min=COMPACTED)))
    torch.testing.assert_close(material.stress(F, 0 * F, history), factor[:, None, None] * base(kept))
    assert J_P[1] < COMPACTED < J_P[0]


@pytest.mark.parametrize(
    ("effects", "plastic", "match"),
    [
        (Effects(yield_index=0.5), VonMises(1e3, YOUNG, POISSON), "yield_index is the exponent of rate_yield: give rate_yield too"),
        (Effects(rate_yield=1.0, yield_index=0.01), VonMises(1e3, YOUNG, POISSON), "yield_index is 0.01; it must be 0.1 or more"),
        (Effects(rate_yield=1.0), Snow(0.02, 0.01), "rate_yield needs a declared von_mises plasticity, or an elastic body"),
        (Effects(compaction_hardening=5.0), None, "compaction_hardening needs a plastic law that changes the volume, such as snow"),
    ],
)
def test_effects_without_what_they_need(effects, plastic, match):
    with pytest.raises(UserError, match=match):
        Constitutive(FixedCorotated(YOUNG, POISSON), plastic, effects, count=1)
