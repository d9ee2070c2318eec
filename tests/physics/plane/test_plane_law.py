"""Energies of plane specimens: the laws and effects of three dimensions, the absent effect, and gradients by finite differences."""

import math

import pytest
import torch

from neuido.errors import UserError
from neuido.physics.effects.constitutive import Constitutive
from neuido.physics.effects.parameters import LIBRARY, Effects, linear_gradient
from neuido.physics.laws.classical import material
from neuido.physics.plane.plane_law import EFFECTS, PARAMETERS, PlaneLaw, SpatialLaw
from tests.physics.plane.test_plane_specimen import pulled, sheet

LAW = {"law": "neo_hookean", "young": 2.7, "poisson": 0.35}
PRESENT = {
    "volumetric": {"volumetric.share": 0.4}, "geometric_nonlinearity": {"geometric_nonlinearity.share": 0.6},
    "strain_stiffening": {"strain_stiffening.k": 0.3}, "second_invariant": {"second_invariant.c": 0.4},
    "fibre": {"fibre.c": 0.8, "fibre.elevation": 0.6}, "stiffness_gradient": {"stiffness_gradient.x": 0.5, "stiffness_gradient.y": -0.3},
    "yield": {"yield.inverse": 4.0},
}  # fmt: skip


def gradients(count: int = 6) -> torch.Tensor:
    """Deformation gradients (E, 5); the first is the identity, the second turns without strain."""
    F = torch.tensor([1.0, 0, 0, 1, 1]) + 0.3 * torch.randn(count, 5, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    F[0] = torch.tensor([1.0, 0, 0, 1, 1])
    F[1] = torch.tensor([math.cos(0.4), -math.sin(0.4), math.sin(0.4), math.cos(0.4), 1])
    return F


class Whole:
    """A law with effects in three dimensions."""

    def __init__(self, elasticity: dict, effects: dict, count: int):
        self.law = Constitutive(*material(elasticity), Effects.of(effects), count=count)

    def __call__(self, F: torch.Tensor) -> torch.Tensor:
        return self.law.stress(F, torch.zeros_like(F), self.law.start())


@pytest.mark.parametrize("law", ["neo_hookean", "fixed_corotated", "sigma"])
@pytest.mark.parametrize("effect", ["", "strain_stiffening", "second_invariant", "fibre"])
def test_the_energy_is_that_of_three_dimensions(law, effect):
    F, effects = gradients(), PRESENT.get(effect, {})
    other = SpatialLaw(Whole(LAW | {"law": law}, effects, len(F))).stress(F)
    torch.testing.assert_close(PlaneLaw(LAW | {"law": law}, effects).stress(F).detach(), other.detach(), atol=1e-11, rtol=1e-9)


def test_parameters_and_gradient_are_those_of_the_library():
    known = {entry.name: [p.name for p in entry.parameters] for entry in LIBRARY}
    assert all(set(own) <= set(known[name]) for name, own in PARAMETERS.items())
    own = sheet(2)
    flat = torch.cat([own.centres, torch.zeros(len(own.centres), 1)], 1)
    F = torch.tensor([1.0, 0, 0, 1, 1]) + 0.1 * gradients(len(flat))
    plain, graded = (PlaneLaw(LAW, more, centres=own.centres).stress(F) for more in ({}, PRESENT["stiffness_gradient"]))
    torch.testing.assert_close(graded, plain * linear_gradient(flat, torch.tensor([0.5, -0.3, 0.0]))[:, None])


def test_beyond_the_locking_the_stress_goes_on():
    F = torch.tensor([[3.0, 0, 0, 1, 1]], dtype=torch.float64)
    effects = {"strain_stiffening.k": 1.0}
    other = SpatialLaw(Whole(LAW, effects, 1)).stress(F)
    torch.testing.assert_close(PlaneLaw(LAW, effects).stress(F).detach(), other.detach(), atol=1e-9, rtol=1e-9)


@pytest.mark.parametrize("law", ["linear", "neo_hookean", "decoupled_neo_hookean", "fixed_corotated", "sigma"])
def test_all_laws_agree_at_small_strain(law):
    F = torch.tensor([1.0, 0, 0, 1, 1]) + 1e-6 * gradients()
    small, own = (PlaneLaw(LAW | {"law": name}).tangent(F)[1] for name in ("linear", law))
    torch.testing.assert_close(own, small, atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("effect", EFFECTS)
def test_an_effect_is_absent_at_zero_and_its_gradient_is_that_of_finite_differences(effect):
    own = sheet(2)
    fixed, motion = pulled(own, [1.25])
    fixed[own.nodes[:, 0] == 1, 1] = True
    law = LAW | ({"law": "linear"} if effect == "geometric_nonlinearity" else {})
    name, value = next(iter(PRESENT[effect].items()))
    more = dict(list(PRESENT[effect].items())[1:])

    def energy(size) -> torch.Tensor:
        found = own.equilibrium(PlaneLaw(law, more | {name: size}, centres=own.centres), fixed, motion)
        return (found.displacement * motion).sum() + (found.force * motion).sum()

    if effect != "stiffness_gradient":
        without = own.equilibrium(PlaneLaw(law), fixed, motion)
        assert float(energy(0.0)) == pytest.approx(float((without.displacement * motion).sum() + (without.force * motion).sum()), rel=1e-9)
    for at in (value,) if effect == "yield" else (0.0, value):  # a yield stress without bound has no slope
        size = torch.tensor(at, dtype=torch.float64, requires_grad=True)
        (grad,) = torch.autograd.grad(energy(size), size)
        low = max(at - 1e-5, 0.0) if effect == "geometric_nonlinearity" else at - 1e-5
        assert float(grad) == pytest.approx(float(energy(at + 1e-5) - energy(low)) / (at + 1e-5 - low), rel=1e-4, abs=1e-7)


@pytest.mark.parametrize("law", ["neo_hookean", "fixed_corotated", "sigma"])
def test_yield_along_a_path_is_that_of_three_dimensions(law):
    """Loading, turning and reversal: the same stress as the law of a simulated body, which takes the exponential of a matrix."""
    effects = {"yield.inverse": 1.5}
    own, ends = PlaneLaw(LAW | {"law": law}, effects), gradients()
    twin = Constitutive(*material(LAW | {"law": law}), Effects.of(effects), count=len(ends))
    here, history, still = torch.eye(3, dtype=torch.float64).expand(len(ends), 3, 3), twin.start(), torch.zeros(len(ends), 3, 3).double()
    rest, last = torch.tensor([1.0, 0, 0, 1, 1], dtype=torch.float64), None
    for share in (0.3, 0.6, 1.0, 0.4, -0.2):
        F = rest + share * (ends - rest)
        whole = torch.zeros(len(F), 3, 3, dtype=torch.float64)
        for i, (row, column) in enumerate([(0, 0), (0, 1), (1, 0), (1, 1), (2, 2)]):
            whole[:, row, column] = F[:, i]
        step = whole if last is None else whole @ torch.linalg.inv(last)
        here, history = twin.advance(step @ here, still, history, 1.0)
        P = torch.linalg.solve(whole, twin.stress(here, still, history).mT).mT
        wanted = torch.stack([P[:, 0, 0], P[:, 0, 1], P[:, 1, 0], P[:, 1, 1], P[:, 2, 2]], 1)
        torch.testing.assert_close(own.stress(F), wanted, atol=1e-8, rtol=1e-7)
        own, last = own.after(F), whole
    assert float((own.plastic - rest).abs().max()) > 0.05


def test_a_strip_yields_at_its_stress_and_keeps_a_set():
    """Uniaxial tension of a thin strip: |dev tau| = Y is tau_11 = sqrt(3/2) Y; unloaded, its length is that of the plastic stretch.

    Two triangles, because a longer strip without hardening may neck anywhere.
    """
    own = sheet(1, condition="stress")
    young, limit = LAW["young"], 0.2
    law = PlaneLaw(LAW | {"law": "sigma"}, {"yield.inverse": 1 / limit})
    tau = math.sqrt(1.5) * limit
    back = 1.3 * math.exp(-1.5 * tau / young)  # half of the yield stress beyond the stretch that is left without a force
    fixed, motion = pulled(own, [1.02, 1.3, back])
    found = own.equilibrium(law, fixed, motion)
    force = found.force[:, own.nodes[:, 0] == 1, 0].sum(1) / own.thickness
    wanted = torch.tensor([young * math.log(1.02) / 1.02, tau / 1.3, -0.5 * tau / back], dtype=torch.float64)
    torch.testing.assert_close(force, wanted, atol=1e-8, rtol=1e-8)


def test_parts_of_a_load_step_change_little():
    """A plate whose field is not uniform, followed in 4 and in 16 parts."""
    own = sheet(3)
    fixed, motion = pulled(own, [1.2, 1.1])
    fixed[own.nodes[:, 0] == 1, 1] = True
    law = PlaneLaw(LAW, {"yield.inverse": 5.0})
    plain, whole = own.equilibrium(PlaneLaw(LAW), fixed, motion), own.equilibrium(law, fixed, motion)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("neuido.physics.plane.plane_specimen.PARTS", 16)
        fine = own.equilibrium(law, fixed, motion)
    assert float((whole.force - fine.force).abs().max()) < 0.02 * float((whole.force - plain.force).abs().max())


def test_the_stiffness_of_another_law_serves():
    own = sheet(3)
    fixed, motion = pulled(own, [1.3])
    fixed[own.nodes[:, 0] == 1, 1] = True
    known = own.towards(PlaneLaw(LAW), fixed, torch.zeros_like(own.nodes), motion[0], 0)
    for law in (LAW | {"young": 5.0}, LAW | {"poisson": 0.2}, LAW | {"law": "decoupled_neo_hookean"}):
        near = own.near(PlaneLaw(law), fixed, known)
        exact = own.equilibrium(PlaneLaw(law), fixed, motion)
        torch.testing.assert_close(near.displacement, exact.displacement[0].detach(), atol=1e-6, rtol=0)


def test_small_strain_may_turn_a_triangle_inside_out():
    """A declared linear elasticity has a prediction at any strain, however wrong; the others have none there."""
    own = sheet(2)
    fixed, motion = pulled(own, [-0.5])
    small = PlaneLaw(LAW | {"law": "linear"})
    found = own.equilibrium(small, fixed, motion)
    assert bool((torch.linalg.det(own.gradient(found.displacement[0].detach()).reshape(-1, 2, 2)) < 0).all())
    torch.testing.assert_close(
        own.near(small, fixed, own.towards(small, fixed, 0 * own.nodes, motion[0], 0)).displacement, found.displacement[0].detach()
    )
    with pytest.raises(UserError, match="has no equilibrium"):
        own.equilibrium(PlaneLaw(LAW), fixed, motion)


@pytest.mark.parametrize(
    ("law", "effects", "message"),
    [
        ({"law": "neohookean"}, {}, "elasticity.law = 'neohookean' is not known, did you mean 'neo_hookean'"),
        ({"young": -1.0}, {}, "young = -1 must be positive"),
        ({"poisson": 0.5}, {}, "poisson = 0.5 between"),
        ({}, {"drag_linear.k": 1.0}, "drag_linear.k is no effect of a plane specimen"),
        ({}, {"volumetric.shares": 1.0}, "volumetric.shares is not a parameter of volumetric"),
        ({}, {"stiffness_gradient.x": 1.0}, "needs the centres"),
    ],
)
def test_a_law_that_is_none(law, effects, message):
    with pytest.raises(UserError, match=message):
        PlaneLaw(LAW | law, effects)
