"""NCLaw's networks in engine form: against their twin, finite differences, and the path that differentiates torch functions."""

import pytest
import torch

from neuido.errors import UserError
from neuido.physics.laws.classical import AutogradElastic, AutogradPlastic
from neuido.physics.laws.neural.invariants import InvariantElastic, InvariantPlastic, features
from neuido.physics.linalg import decompositions as linalg
from neuido.physics.mpm.simulator import Simulator
from neuido.types import Particles, Scene
from tests.physics.bodies import DEVICES, block
from tests.physics.laws.neural.test_networks import OFFSETS, deformations, particles, run

LAWS = {InvariantElastic: 1e4, InvariantPlastic: 1e2}


def law(kind, scenes=3, shared=False, hidden=16, dtype=torch.float64):
    generator = torch.Generator().manual_seed(1)

    def random(first, *shape, gain):
        return (gain * torch.randn(first, *shape, generator=generator, dtype=torch.float64)).to(dtype)

    first = 1 if shared else scenes
    return kind(random(first, hidden, 13, gain=0.5), random(first, hidden, hidden, gain=0.3), random(scenes, 9, hidden, gain=LAWS[kind]))


def on(device):
    """`particles` on a device."""
    return particles()._replace(scene=particles().scene.to(device))


def weights_of(F):
    return torch.randn(F.shape, generator=torch.Generator().manual_seed(2), dtype=torch.float64).to(F)


def adjoint(the_law, F, grad_out, particles):
    grad_F = torch.zeros_like(F)
    grads = [torch.zeros_like(t) for t in the_law.tensors()]
    the_law.adjoint([t.detach() for t in the_law.tensors()], F, grad_out, grad_F, grads, particles)
    return grad_F, grads


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("shared", [True, False], ids=["shared", "per-scene"])
@pytest.mark.parametrize("kind", LAWS)
def test_forward_and_adjoint_equal_the_twin(kind, shared, device):
    """Rest, where all singular values are equal, is among the deformations."""
    F, of = deformations().to(device), on(device)
    the_law = kind(*(W.to(device).requires_grad_() for W in law(kind, shared=shared).tensors()))
    F.requires_grad_(True)
    expected = the_law(F, of)
    grads = torch.autograd.grad(expected, (F, *the_law.tensors()), weights_of(F))
    F = F.detach()
    torch.testing.assert_close(run(the_law, F, of), expected.detach(), rtol=1e-10, atol=1e-9)
    grad_F, grad_tensors = adjoint(the_law, F, weights_of(F), of)
    for got, want in zip([grad_F, *grad_tensors], grads, strict=True):
        torch.testing.assert_close(got, want, rtol=1e-8, atol=1e-8 * float(want.abs().max()))


@pytest.mark.parametrize("kind", LAWS)
def test_adjoint_against_finite_differences(kind):
    F = deformations()[2:]  # away from rest, where the law has directional derivatives alone
    one = Particles(torch.zeros(len(F), dtype=torch.int32), (0, len(F)))
    the_law, w = law(kind, scenes=1), weights_of(F)
    direction = torch.randn(F.shape, generator=torch.Generator().manual_seed(3), dtype=F.dtype)
    step = 1e-7
    up, down = run(the_law, F + step * direction, one), run(the_law, F - step * direction, one)
    slopes = ((up - down) * w).sum((1, 2)) / (2 * step)
    got = (adjoint(the_law, F, w, one)[0] * direction).sum((1, 2))
    torch.testing.assert_close(got, slopes, rtol=1e-5, atol=1e-5 * float(slopes.abs().max()))


@pytest.mark.parametrize("kind", LAWS)
def test_adjoint_equals_that_of_the_autograd_path(kind):
    """As these laws ran before: a torch function with `linalg.svd`, wherever the singular values differ."""
    F = deformations()[2:]
    one = Particles(torch.zeros(len(F), dtype=torch.int32), (0, len(F)))
    the_law, w = law(kind, scenes=1), weights_of(F)
    W1, W2, W3 = the_law.tensors()

    def function(F, W1, W2, W3):
        U, sigma, V = linalg.svd(F, gap=0.0)
        x = torch.cat([sigma - 1, (F.mT @ F - torch.eye(3).to(F)).flatten(1), torch.linalg.det(F)[:, None] - 1], 1)
        gelu = torch.nn.functional.gelu
        Y = (gelu(gelu(x @ W1.T) @ W2.T) @ W3.T).unflatten(1, (3, 3))
        RX = linalg.polar(F)[0] @ (0.5 * (Y + Y.mT))
        return RX @ F.mT if kind is InvariantElastic else F + the_law.scale * RX

    options = {"modulus": 1.0} if kind is InvariantElastic else {}
    old = (AutogradElastic if kind is InvariantElastic else AutogradPlastic)(function, [W1, W2, W3], **options)
    torch.testing.assert_close(run(the_law, F, one), run(old, F, one), rtol=1e-9, atol=1e-8)
    for got, want in zip(adjoint(the_law, F, w, one), adjoint(old, F, w, one), strict=True):
        torch.testing.assert_close(got, want, rtol=1e-7, atol=1e-7 * float(torch.as_tensor(want[0]).abs().max()))


@pytest.mark.parametrize("kind", LAWS)
def test_at_rest_the_adjoint_is_finite_and_right_for_a_change_of_volume(kind):
    the_law = law(kind, scenes=1)
    Q = torch.linalg.qr(torch.randn(3, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(4)))[0]
    Q = Q * torch.linalg.det(Q)
    rest = torch.stack([torch.eye(3, dtype=torch.float64), Q])
    one, w, step = Particles(torch.zeros(2, dtype=torch.int32), (0, 2)), weights_of(rest), 1e-6
    out = run(the_law, rest, one)
    torch.testing.assert_close(out, torch.zeros_like(rest) if kind is InvariantElastic else rest, rtol=0, atol=1e-9)
    slopes = (run(the_law, (1 + step) * rest, one) - run(the_law, (1 - step) * rest, one)).mul(w).sum((1, 2)) / (2 * step)
    grad_F = adjoint(the_law, rest, w, one)[0]
    torch.testing.assert_close((grad_F * rest).sum((1, 2)), slopes, rtol=1e-5, atol=1e-6)
    turned = adjoint(
        the_law, rest[:1], Q.T @ w[1:] @ (Q if kind is InvariantElastic else torch.eye(3).to(Q)), one._replace(offsets=(0, 1))
    )[0]
    torch.testing.assert_close(Q @ turned[0], grad_F[1], rtol=1e-6, atol=1e-6 * float(grad_F.abs().max()))  # frame-indifferent


def test_float32_keeps_the_digits_of_small_strains():
    the_law = law(InvariantElastic, scenes=1)
    F = torch.eye(3, dtype=torch.float64) + 1e-4 * torch.randn(50, 3, 3, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
    F = F.float().double()  # the strain that float32 has
    one = Particles(torch.zeros(50, dtype=torch.int32), (0, 50))
    exact = run(the_law, F, one)
    single = run(InvariantElastic(*(t.float() for t in the_law.tensors())), F.float(), one)
    assert float((single - exact).norm() / exact.norm()) < 1e-4


def rollout(device="cpu", dtype=torch.float64, graphs=False, shift=0.0):
    """A block falls on the floor; the weights are moved by `shift` along a fixed direction, which is returned too."""
    body = block((0.3, 0.05, 0.3), (0.7, 0.45, 0.7), (5, 5, 5), velocity=(0.0, -2.0, 0.5))
    simulator = Simulator(Scene(cells=12, dt=1e-3), body, device=device, dtype=dtype, graphs=graphs)
    generator = torch.Generator().manual_seed(6)
    shapes = ((16, 13, 0.3), (16, 16, 0.3), (9, 16, 300.0), (16, 13, 0.3), (16, 16, 0.3), (9, 16, 0.3))
    weights = [gain * torch.randn(1, n, m, generator=generator, dtype=torch.float64) for n, m, gain in shapes]
    directions = [w.abs().mean() * torch.randn(w.shape, generator=generator, dtype=torch.float64) for w in weights]
    leaves = [(w + shift * d).to(device, dtype).requires_grad_() for w, d in zip(weights, directions)]
    frames = simulator.rollout(40, InvariantElastic(*leaves[:3]), InvariantPlastic(*leaves[3:]), every=20, check=False)
    return frames.x[-1].square().sum(), leaves, directions


def test_gradient_of_a_rollout_against_a_finite_difference():
    loss, leaves, directions = rollout()
    gradient = torch.autograd.grad(loss, leaves)
    slope = sum((g * d).sum() for g, d in zip(gradient, directions))
    step = 1e-6
    expected = (rollout(shift=step)[0] - rollout(shift=-step)[0]) / (2 * step)
    assert all(float(g.abs().max()) > 0 for g in gradient)
    assert float(slope) == pytest.approx(float(expected.detach()), rel=1e-5)


@pytest.mark.gpu
def test_captured_rollout_equals_the_eager_one():
    results = []
    for graphs in (False, True):
        for _ in range(2):  # the second run replays
            loss, leaves, _ = rollout("cuda", torch.float32, graphs)
            results.append([loss.detach(), *torch.autograd.grad(loss, leaves)])
    for other in results[1:]:
        for a, b in zip(results[0], other, strict=True):
            assert float((a - b).norm()) <= 1e-3 * float(a.norm())


def test_shapes_that_do_not_fit_are_named():
    W1, W2, W3 = law(InvariantElastic).tensors()
    with pytest.raises(UserError, match=r"W2 has shape .* needed \(1 or 3, 16, 16\)"):
        InvariantElastic(W1, W2[:, :8], W3)
    with pytest.raises(UserError, match="particles"):
        law(InvariantElastic)(deformations())
    assert features(deformations()).shape == (OFFSETS[-1], 13)
