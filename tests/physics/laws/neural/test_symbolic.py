"""Symbolic laws: kernels against the twin and finite differences, and Hencky's law as one of them."""

import pytest
import torch

from neuido.errors import UserError
from neuido.physics.laws.classical import DruckerPrager, Sigma, VonMises, lame
from neuido.physics.laws.neural.symbolic import SymbolicElastic, SymbolicPlastic, formula, generators, polynomial
from neuido.physics.mpm.simulator import Simulator
from neuido.types import Scene
from tests.physics.bodies import DEVICES, block
from tests.physics.laws.neural.test_invariant_networks import adjoint, on, weights_of
from tests.physics.laws.neural.test_networks import deformations, run


def elastic(scenes=3):
    g = torch.Generator().manual_seed(0)
    return SymbolicElastic(torch.randn(scenes, 4, 7, generator=g, dtype=torch.float64).requires_grad_())


def plastic(scenes=3):
    g = torch.Generator().manual_seed(0)
    return SymbolicPlastic((1 + torch.rand(scenes, 3, 1, generator=g, dtype=torch.float64)).requires_grad_())


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("scenes", [1, 3])
@pytest.mark.parametrize("build", [elastic, plastic])
def test_forward_and_adjoint_equal_the_twin(build, scenes, device):
    F, of, law = deformations().to(device).requires_grad_(True), on(device), build(scenes)
    law = type(law)(law.coefficients.detach().to(device).requires_grad_())
    expected = law(F, of)
    wanted = torch.autograd.grad(expected, (F, *law.tensors()), weights_of(F))
    F = F.detach()
    torch.testing.assert_close(run(law, F, of), expected.detach(), rtol=1e-10, atol=1e-8)
    grad_F, grads = adjoint(law, F, weights_of(F), of)
    for got, want in zip([grad_F, *grads], wanted, strict=True):
        torch.testing.assert_close(got, want, rtol=1e-8, atol=1e-9 * float(want.abs().max()))


def test_two_constants_are_henckys_law_and_constants_the_classical_surfaces():
    F = deformations()[:20]  # strains of 0.2 and less: the series of the Hencky strain
    mu, lam = (float(t) for t in lame(torch.tensor(1e5, dtype=torch.float64), torch.tensor(0.3, dtype=torch.float64)))
    coefficients = torch.zeros(1, 4, 7, dtype=torch.float64)
    coefficients[0, :2, 0] = torch.tensor([(lam + 2 * mu / 3) / 1e5, 2 * mu / 1e5])
    law = SymbolicElastic(coefficients)
    torch.testing.assert_close(law(F), Sigma(1e5, 0.3)(F), rtol=2e-4, atol=1e-2)
    assert float(law.modulus()) == pytest.approx(lam + 2 * mu)
    radius = 0.02
    surface = SymbolicPlastic(torch.tensor([[[100 * radius], [0.0], [1e9]]], dtype=torch.float64))
    torch.testing.assert_close(surface(F), VonMises(2 * mu * radius, 1e5, 0.3)(F), rtol=0, atol=2e-5)
    sand = DruckerPrager(25.0, 1e5, 0.3)
    cone = SymbolicPlastic(torch.tensor([[[0.0], [float(sand.tensors()[0])], [0.0]]], dtype=torch.float64))
    squeezed = 0.95 * F
    torch.testing.assert_close(cone(squeezed), sand(squeezed), rtol=0, atol=2e-4)


def test_terms_times_generators_make_the_stress():
    F, law = deformations(), elastic(1)
    parts = torch.einsum("nk,ngij,gk->nij", polynomial(F), generators(F), law.coefficients[0])
    torch.testing.assert_close(1e5 * parts, law(F), rtol=1e-9, atol=1e-6)


def test_formula_says_what_is_left():
    coefficients = torch.zeros(4, 7)
    coefficients[0, 0], coefficients[1, 5] = 0.5, -0.02
    assert formula(coefficients) == "+50 l I -200 l q A"
    assert formula(torch.zeros(4, 7)) == "0"


def test_gradient_of_a_rollout_against_a_finite_difference():
    body = block((0.3, 0.05, 0.3), (0.7, 0.45, 0.7), (5, 5, 5), velocity=(0.0, -2.0, 0.5))
    simulator = Simulator(Scene(cells=12, dt=1e-3), body, dtype=torch.float64, device="cpu")
    g = torch.Generator().manual_seed(1)
    direction = torch.randn(1, 4, 7, generator=g, dtype=torch.float64), torch.rand(1, 3, 1, generator=g, dtype=torch.float64)

    def loss(shift):
        stress = torch.zeros(1, 4, 7, dtype=torch.float64)
        stress[0, :2, 0] = torch.tensor([1.0, 1.5])
        surface = torch.tensor([[[1.0], [0.5], [1.0]]], dtype=torch.float64)
        leaves = [(t + shift * 0.1 * d).requires_grad_() for t, d in zip((stress, surface), direction)]
        frames = simulator.rollout(60, SymbolicElastic(leaves[0]), SymbolicPlastic(leaves[1]), every=60)
        return frames.x[-1].square().sum(), leaves

    value, leaves = loss(0.0)
    gradients = torch.autograd.grad(value, leaves)
    slope = sum(float((0.1 * d * g).sum()) for d, g in zip(direction, gradients))
    expected = float((loss(1e-5)[0] - loss(-1e-5)[0]).detach()) / 2e-5
    assert slope == pytest.approx(expected, rel=1e-4)


def test_wrong_coefficients_are_named():
    with pytest.raises(UserError, match=r"needed \(S, 4, 7\)"):
        SymbolicElastic(torch.zeros(4, 7))
    with pytest.raises(UserError, match="particles"):
        elastic(3)(deformations())
