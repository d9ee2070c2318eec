"""The operator: contraction is exact, gradients reach z and all weights, files come back as they were."""

import math

import pytest
import torch
from torch import nn

from neuido.data.bodies.shapes import cube
from neuido.errors import UserError
from neuido.models.inference.law_file import load_law, save_law
from neuido.models.operator import dynamics_operator as module
from neuido.models.operator.dynamics_operator import IntrinsicDynamicsOperator, affine
from neuido.models.operator.law_properties import implausibility, implausible_stress, p_wave_modulus
from neuido.physics.effects.parameters import Effects
from neuido.physics.laws.neural import networks
from neuido.physics.laws.neural.bounded import bounded_stress, full_return_map
from neuido.physics.mpm.simulator import Simulator
from neuido.types import Particles, Scene

SMALL = {"latent_dim": 6, "basis_dim": 5, "hidden_dim": 16, "head_dim": 8}


def make(trunk):
    torch.manual_seed(0)
    return IntrinsicDynamicsOperator(trunk, **SMALL).double()


def deformations(scenes=3, samples=7):
    generator = torch.Generator().manual_seed(1)
    return torch.eye(3, dtype=torch.float64) + 0.05 * torch.randn(scenes, samples, 3, 3, generator=generator, dtype=torch.float64)


@pytest.mark.parametrize("trunk", ["raw", "objective", "bounded", "general"])
def test_contraction_equals_the_sum_over_basis_functions(trunk):
    operator, F = make(trunk), deformations()
    z = torch.randn(3, 6, dtype=torch.float64)
    elastic, plastic = operator.coefficients(z)
    phi_e, phi_p = operator.basis(F)
    c_e, c_p = torch.einsum("sk,snko->sno", elastic, phi_e), torch.einsum("sk,snko->sno", plastic, phi_p)
    if trunk == "raw":
        tau, corrected = networks.RAW_STRESS_SCALE * c_e.view(F.shape), F + networks.STRAIN_SCALE * c_p.view(F.shape)
    else:
        stress = networks.isotropic_stress if trunk == "objective" else bounded_stress
        returned = full_return_map if trunk == "general" else networks.return_map
        tau, corrected = stress(F, c_e), returned(F, c_p)
    torch.testing.assert_close(operator.elastic(z, F), tau)
    torch.testing.assert_close(operator.plastic(z, F), corrected)
    for law, expected in zip(operator.laws(z), (tau, corrected)):
        particles = Particles(torch.arange(3, dtype=torch.int32).repeat_interleave(7), (0, 7, 14, 21))
        torch.testing.assert_close(law(F.view(-1, 3, 3), particles), expected.view(-1, 3, 3))


@pytest.mark.parametrize("trunk", ["raw", "objective", "bounded", "general"])
def test_gradients_of_kernels_and_twins_agree(trunk):
    """Stage I (F fixed, kernels) and the twin (F differentiable) give the same gradient of z and of every weight."""
    operator, F = make(trunk), deformations()
    z = torch.randn(3, 6, dtype=torch.float64, requires_grad=True)
    with torch.no_grad():
        operator.plastic_trunk.out.bias += 0.5  # inside and outside of yield
    wanted = [z, *operator.parameters()]
    grads = []
    for differentiable in (False, True):
        x = F.clone().requires_grad_(differentiable)
        loss = (operator.elastic(z, x) / 1e4).square().sum() + 1e3 * (operator.plastic(z, x) - x.detach()).square().sum()
        grads.append(torch.autograd.grad(loss, wanted))
    for kernel, twin in zip(*grads):
        assert twin.abs().max() > 0
        if trunk == "raw":
            torch.testing.assert_close(kernel, twin)
    for i in range(0 if trunk == "raw" else 1 + 6):  # z and the elastic trunk: no clamp, so no straight-through gradient
        if i > 0:
            torch.testing.assert_close(grads[0][i], grads[1][i], rtol=1e-7, atol=1e-9)


def test_laws_are_graph_nodes_of_latent_and_weights():
    operator = make("objective")
    z = torch.randn(6, dtype=torch.float64, requires_grad=True)
    elastic, plastic = operator.laws(z)
    total = sum(t.square().sum() for law in (elastic, plastic) for t in law.tensors())
    grads = torch.autograd.grad(total, [z, *operator.parameters()])
    assert all(g.abs().max() > 0 for g in grads)
    assert elastic.modulus().shape == (1,)


def test_wrapped_linear_layers_are_merged():
    class Adapted(nn.Module):
        def __init__(self, base):
            super().__init__()
            self.base, self.a, self.b = base, nn.Linear(4, 2, bias=False), nn.Linear(2, 3, bias=False)
            self.in_features = base.in_features

        def forward(self, x):
            return self.base(x) + self.b(self.a(x))

    base = nn.Linear(4, 3)
    adapted = Adapted(base)
    weight, bias = affine(adapted)
    torch.testing.assert_close(weight, base.weight + adapted.b.weight @ adapted.a.weight)
    torch.testing.assert_close(bias, base.bias)


@pytest.mark.parametrize("trunk", ["raw", "objective", "bounded", "general"])
def test_file_round_trip(tmp_path, trunk):
    operator = IntrinsicDynamicsOperator(trunk, **SMALL)
    operator.set_latents(torch.randn(2, 6), ["jelly", "sand"], ["elastic", "sand"])
    operator.save(tmp_path / "weights.safetensors", {"stress_error": 0.01})
    loaded = IntrinsicDynamicsOperator.load(tmp_path / "weights.safetensors")
    assert loaded.config == operator.config
    assert all(torch.equal(a, b) for a, b in zip(loaded.state_dict().values(), operator.state_dict().values(), strict=True))
    assert torch.equal(loaded.latent("sand"), operator.latents[1])
    assert loaded.latent_families == ["elastic", "sand"]
    assert loaded.card["stress_error"] == 0.01 and "date" in loaded.card
    assert [p.name for p in tmp_path.iterdir()] == ["weights.safetensors"]


def viscous():
    torch.manual_seed(0)
    operator = IntrinsicDynamicsOperator("general", **SMALL, viscous=True)
    with torch.no_grad():
        operator.viscosity_head[2].bias.fill_(math.log(3e3))  # some 3 Pa s
    return operator


@pytest.mark.slow
def test_viscosity_reaches_law_file_and_rollout_and_its_gradient_the_latent(tmp_path):
    operator = viscous()
    z = torch.randn(6, requires_grad=True)
    eta = operator.viscosity(z)
    assert eta.shape == (1,) and 1 < eta.item() < 10
    scene = Scene(cells=8, dt=1e-3, gravity=(0.0, 0.0, 0.0))
    body = cube(length=0.4, particles_per_side=4, velocity=(0.0, 0.0, 0.0), angular_velocity=(0.0, 0.0, 0.0))
    body = body._replace(v=torch.stack([body.x[:, 1], 0 * body.x[:, 0], 0 * body.x[:, 0]], 1))  # a shear flow
    simulator = Simulator(scene, body, device="cpu")
    laws = operator.laws(z)
    simulator.rollout(20, *laws).v[-1].square().sum().backward()
    assert z.grad.abs().max() > 0
    operator.save(tmp_path / "operator.safetensors")
    again = IntrinsicDynamicsOperator.load(tmp_path / "operator.safetensors")
    assert torch.equal(again.viscosity(z), eta)
    with torch.no_grad():
        save_law(tmp_path / "law.safetensors", operator, z.detach())
        elastic, plastic = load_law(tmp_path / "law.safetensors")
        assert elastic.viscosity.item() == pytest.approx(eta.item()) and elastic.scaled(torch.tensor([2.0])).viscosity is elastic.viscosity
        found = simulator.rollout(20, elastic, plastic, effects=Effects(viscosity_shear=2.0)).v[-1]
        elastic.viscosity = None
        torch.testing.assert_close(found, simulator.rollout(20, elastic, plastic, effects=Effects(viscosity_shear=2.0 + eta.item())).v[-1])
        assert (found - simulator.rollout(20, elastic, plastic).v[-1]).abs().max() > 1e-4


def test_a_viscosity_below_that_of_water_costs_no_kernel_and_older_operators_have_none():
    operator, z = viscous().requires_grad_(False), torch.zeros(6)
    assert operator.laws(z)[0].viscosity is not None
    operator.viscosity_head[2].bias.fill_(-20.0)
    assert operator.laws(z)[0].viscosity is None and 0 < operator.viscosity(z).item() < 1e-9
    older = IntrinsicDynamicsOperator("bounded", **SMALL)
    assert older.viscosity(z).tolist() == [0.0] and older.laws(z)[0].viscosity is None


def test_random_latents_lie_as_the_trained_ones_do():
    operator = IntrinsicDynamicsOperator("raw", **SMALL)
    mean, deviation = torch.tensor([0.0, 5.0, -3.0, 0.1, 0.0, 2.0]), torch.tensor([1.0, 0.01, 2.0, 0.1, 3.0, 0.5])
    operator.set_latents(mean + deviation * torch.randn(500, 6), [f"m{i}" for i in range(500)], ["elastic"] * 500)
    drawn = operator.random_latents(4000, torch.Generator().manual_seed(1))
    assert torch.allclose(drawn.mean(0), operator.latents.mean(0), atol=0.15)
    assert torch.allclose(drawn.std(0), operator.latents.std(0), rtol=0.05)
    assert torch.equal(drawn, operator.random_latents(4000, torch.Generator().manual_seed(1)))


def test_errors_name_the_option(tmp_path, monkeypatch):
    with pytest.raises(UserError, match="trunk = 'cooked'"):
        IntrinsicDynamicsOperator("cooked")
    with pytest.raises(UserError, match="basis_dim = 0"):
        IntrinsicDynamicsOperator(basis_dim=0)
    monkeypatch.setitem(module.PRETRAINED, "pretrained", tmp_path / "none.safetensors")
    with pytest.raises(UserError, match=r"missing.*neuido fit"):
        IntrinsicDynamicsOperator.load("pretrained")
    (tmp_path / "text").write_text("not safetensors at all")
    with pytest.raises(UserError, match="not a safetensors file"):
        IntrinsicDynamicsOperator.load(tmp_path / "text")
    with pytest.raises(UserError, match="no latent is named 'tofu'"):
        IntrinsicDynamicsOperator(**SMALL).latent("tofu")


def test_implausibility_in_one_evaluation_is_that_in_two():
    operator = make("raw")  # an untrained law, which no rollout would survive
    z = torch.randn(6, generator=torch.Generator().manual_seed(2), dtype=torch.float64).requires_grad_()
    found = implausibility(operator, z)
    apart = implausible_stress(lambda F: operator.elastic(z[None], F[None])[0], p_wave_modulus(operator, z[None])[0])
    assert float(found.detach()) > 0 and float(found.detach()) == pytest.approx(float(apart.detach()))
    torch.testing.assert_close(*(torch.autograd.grad(value, z)[0] for value in (found, apart)))
