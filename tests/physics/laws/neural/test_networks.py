"""Effective networks: adjoints against finite differences, torch autograd and Warp's autodiff; the symmetries of the laws."""

import pytest
import torch
import warp as wp

from neuido.errors import UserError
from neuido.physics.laws.neural import bounded_kernels, fused, network_kernels, networks, readouts, return_kernels
from neuido.physics.laws.neural.bounded import BoundedElastic, FullPlastic
from neuido.physics.laws.neural.networks import ObjectiveElastic, ObjectivePlastic, RawElastic, RawPlastic
from neuido.types import Particles

LAWS = [RawElastic, RawPlastic, ObjectiveElastic, ObjectivePlastic, BoundedElastic, FullPlastic]
AUTODIFF = {BoundedElastic: bounded_kernels, FullPlastic: return_kernels}
OFFSETS = (0, 9, 20, 32)


def deformations(dtype=torch.float64, seed=0):
    """32 gradients: rest, and strains of 1e-4 to 0.5, rotated."""
    generator = torch.Generator().manual_seed(seed)
    F = torch.eye(3, dtype=torch.float64).repeat(32, 1, 1)
    for i, strain in enumerate((1e-4, 1e-3, 1e-2, 0.1, 0.5)):
        F[2 + 6 * i : 8 + 6 * i] += strain * (2 * torch.rand(6, 3, 3, generator=generator, dtype=torch.float64) - 1) / 3**0.5
    Q = torch.linalg.qr(torch.randn(3, 3, generator=generator, dtype=torch.float64))[0]
    F[20:] = (Q * Q.det()) @ F[20:]
    return F.to(dtype)


def law(kind, scenes=3, shared=True, hidden=16, dtype=torch.float64, seed=1, requires_grad=False):
    generator = torch.Generator().manual_seed(seed)
    first = 1 if shared else scenes

    def random(*shape, gain):
        return (gain * torch.randn(*shape, generator=generator, dtype=torch.float64)).to(dtype).requires_grad_(requires_grad)

    weights = [
        random(first, hidden, 9, gain=0.5),
        random(first, hidden, gain=0.3),
        random(first, hidden, hidden, gain=0.3),
        random(first, hidden, gain=0.3),
        random(scenes, kind.outputs, hidden, gain=0.3),
        random(scenes, kind.outputs, gain=0.3),
    ]
    if issubclass(kind, ObjectivePlastic):  # radii between the strains of `deformations`, so that both sides of the yield surface occur
        with torch.no_grad():
            weights[5] += torch.tensor([1.5, 0.2, 0.3, 0.5][: kind.outputs], dtype=dtype)
    return kind(*weights)


def particles(offsets=OFFSETS):
    scene = torch.repeat_interleave(torch.arange(len(offsets) - 1), torch.tensor(offsets).diff())
    return Particles(scene.int(), offsets)


def run(law, F, particles):
    out = torch.full_like(F, torch.nan)
    law.forward([t.detach() for t in law.tensors()], F, out, particles)
    return out


@pytest.mark.parametrize("shared", [True, False], ids=["shared", "per-scene"])
@pytest.mark.parametrize("kind", LAWS)
def test_forward_and_adjoint_equal_the_twin(kind, shared):
    F = deformations()
    the_law = law(kind, shared=shared, requires_grad=True)
    grad_out = torch.randn(F.shape, generator=torch.Generator().manual_seed(2), dtype=F.dtype)
    F.requires_grad_(True)
    expected = the_law(F, particles())
    grads = torch.autograd.grad(expected, (F, *the_law.tensors()), grad_out)
    F = F.detach()
    torch.testing.assert_close(run(the_law, F, particles()), expected.detach(), rtol=1e-11, atol=1e-11)
    grad_F = torch.ones_like(F)
    grad_tensors = [torch.ones_like(t) for t in the_law.tensors()]
    the_law.adjoint(the_law.tensors(), F, grad_out, grad_F, grad_tensors, particles())
    for name, got, want in zip(("F", "W1", "b1", "W2", "b2", "W3", "b3"), (grad_F, *grad_tensors), grads):
        error = (got - 1 - want).norm() / want.norm()
        assert error < 1e-9, f"{name}: {error:.1e}"


@pytest.mark.parametrize("kind", LAWS)
def test_adjoint_equals_finite_differences(kind):
    """Each particle and each tensor along random directions, to 1e-6 of the derivative's scale."""
    F = deformations()[2:]  # at F = I exactly Drucker-Prager has a corner; the twin's test covers it
    who = particles((0, 10, 20, 30))
    the_law = law(kind)
    generator = torch.Generator().manual_seed(3)
    grad_out = torch.randn(F.shape, generator=generator, dtype=F.dtype)
    grad_F, grad_tensors = torch.zeros_like(F), [torch.zeros_like(t) for t in the_law.tensors()]
    the_law.adjoint(the_law.tensors(), F, grad_out, grad_F, grad_tensors, who)

    direction = torch.randn(F.shape, generator=generator, dtype=F.dtype)
    step = 1e-3 * (F.mT @ F - torch.eye(3, dtype=F.dtype)).flatten(1).norm(dim=1)[:, None, None]

    def along(k):
        return (run(the_law, F + k * step * direction, who) * grad_out).sum((1, 2))

    difference = (45 * (along(1) - along(-1)) - 9 * (along(2) - along(-2)) + (along(3) - along(-3))) / (60 * step[:, 0, 0])
    got = (grad_F * direction).sum((1, 2))
    scale = grad_F.flatten(1).norm(dim=1) * direction.flatten(1).norm(dim=1)
    assert ((got - difference).abs() / scale).max() < 1e-6

    for i, tensor in enumerate(the_law.tensors()):
        direction = torch.randn(tensor.shape, generator=generator, dtype=F.dtype)

        def along(k, i=i, step=1e-3 * direction):
            moved = list(the_law.tensors())
            moved[i] = moved[i] + k * step
            return (run(kind(*moved), F, who) * grad_out).sum()

        difference = (45 * (along(1) - along(-1)) - 9 * (along(2) - along(-2)) + (along(3) - along(-3))) / 6e-2
        assert (grad_tensors[i] * direction).sum().item() == pytest.approx(difference.item(), rel=1e-6), i


@pytest.mark.parametrize("kind", LAWS)
def test_unwanted_gradients_are_skipped(kind):
    F, the_law = deformations(), law(kind)
    grad_out = torch.ones_like(F)
    full, partial = torch.zeros_like(F), torch.zeros_like(F)
    grads = [torch.zeros_like(t) for t in the_law.tensors()]
    the_law.adjoint(the_law.tensors(), F, grad_out, full, grads, particles())
    last = [None, None, None, None, torch.zeros_like(grads[4]), None]
    the_law.adjoint(the_law.tensors(), F, grad_out, partial, last, particles())
    assert torch.equal(full, partial) and torch.equal(grads[4], last[4])


@pytest.mark.parametrize("kind", [ObjectiveElastic, ObjectivePlastic, BoundedElastic, pytest.param(FullPlastic, marks=pytest.mark.slow)])
def test_kernels_equal_warps_autodiff(kind):
    """The kernels have no dynamic loops, so the adjoints that Warp generates of them are right."""
    F, the_law = deformations()[2:], law(kind, scenes=1)
    own, oracle = kind.kernels(F), AUTODIFF.get(kind, network_kernels).build(wp.float64, enable_backward=True)
    generator = torch.Generator().manual_seed(4)
    elastic = not issubclass(kind, ObjectivePlastic)
    c = torch.randn(30, kind.outputs, generator=generator, dtype=F.dtype) + (0 if elastic else 1.0)
    g, gX = (torch.randn(30, *s, generator=generator, dtype=F.dtype) for s in ((3, 3), (9,)))
    got_F, got_c = torch.zeros_like(F), torch.zeros_like(c)
    if elastic:
        networks.launch(own.stress_coefficients_adjoint, F, F, c, the_law.scale, g, got_c)
        networks.launch(own.stress_adjoint, F, F, c, the_law.scale, g, gX, got_F)
    else:
        networks.launch(own.correction_coefficients_adjoint, F, F, c, the_law.scale, 0, g, got_c)
        networks.launch(own.correction_adjoint, F, F, c, the_law.scale, g, gX, got_F)

    wF = wp.from_torch(F.clone(), dtype=oracle.mat33, requires_grad=True)
    wc = wp.from_torch(c.clone(), dtype=wp.float64, requires_grad=True)
    out = wp.zeros(30, dtype=oracle.mat33, requires_grad=True, device="cpu")
    X = wp.zeros((30, 9), dtype=wp.float64, requires_grad=True, device="cpu")
    with wp.Tape() as tape:
        wp.launch(oracle.features, dim=30, inputs=[wF, X], device="cpu")
        wp.launch(oracle.stress if elastic else oracle.correction, dim=30, inputs=[wF, wc, the_law.scale, out], device="cpu")
    tape.backward(grads={out: wp.from_torch(g, dtype=oracle.mat33), X: wp.from_torch(gX, dtype=wp.float64)})
    for got, want in ((got_F, wp.to_torch(wF.grad)), (got_c, wp.to_torch(wc.grad))):
        error = (got - want).flatten(1).norm(dim=1) / want.flatten(1).norm(dim=1).clamp(min=1e-6)
        assert error.max() < 1e-8


@pytest.mark.parametrize("kind", [ObjectiveElastic, BoundedElastic])
def test_objective_laws_are_objective_and_isotropic(kind):
    F = deformations()
    elastic, plastic = law(kind), law(ObjectivePlastic)
    Q, R = (torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(s), dtype=F.dtype))[0] for s in (5, 6))
    Q, R = Q * Q.det(), R * R.det()
    tau, corrected = run(elastic, F, particles()), run(plastic, F, particles())
    turned = Q @ F @ R
    torch.testing.assert_close(run(elastic, turned, particles()), Q @ tau @ Q.T, rtol=1e-8, atol=1e-6)
    torch.testing.assert_close(run(plastic, turned, particles()), Q @ corrected @ R, rtol=1e-9, atol=1e-11)
    torch.testing.assert_close(tau, tau.mT)
    assert (corrected - F).abs().amax() > 1e-2  # the yield surface is crossed


@pytest.mark.parametrize("kind", [ObjectiveElastic, BoundedElastic])
def test_objective_laws_rest_at_rest(kind):
    rest = torch.eye(3).repeat(32, 1, 1)
    assert run(law(kind, dtype=torch.float32), rest, particles()).abs().max() == 0
    assert torch.equal(run(law(ObjectivePlastic, dtype=torch.float32), rest, particles()), rest)


def test_constant_coefficients_are_hencky_elasticity_and_von_mises():
    F = deformations()[2:20]
    U, s, Vh = torch.linalg.svd(F)
    eps = s.log()
    trace = eps.sum(1, keepdim=True)
    dev = eps - trace / 3
    c = torch.tensor([0.5, 0.8, 0.0, 0.0], dtype=F.dtype).expand(len(F), 4)
    tau = (U * (1e5 * (0.5 * trace + 0.8 * dev))[:, None]) @ U.mT
    torch.testing.assert_close(networks.isotropic_stress(F, c), tau, rtol=1e-4, atol=1e-3)
    radius = 0.005
    c = torch.tensor([radius / networks.STRAIN_SCALE, 0.0, 1e3], dtype=F.dtype).expand(len(F), 3)
    norm = dev.norm(dim=1, keepdim=True)
    mapped = (U * torch.where(norm > radius, trace / 3 + dev * radius / norm, eps).exp()[:, None]) @ Vh
    torch.testing.assert_close(networks.return_map(F, c), mapped, rtol=0, atol=1e-6)
    assert (norm > radius).any() and (norm < radius).any()


@pytest.mark.parametrize("kind", [ObjectiveElastic, ObjectivePlastic, BoundedElastic])
@pytest.mark.parametrize("strain", [1e-5, 1e-4, 1e-3, 1e-2, 0.1, 0.3])
def test_float32_agrees_with_float64(kind, strain):
    """The SVD-free strain keeps small strains: F itself is rounded to 6e-8, so the error is at most some 1e-7 / strain."""
    generator = torch.Generator().manual_seed(7)
    F = (torch.eye(3) + strain * torch.randn(200, 3, 3, generator=generator) / 3).float()
    exact = run(law(kind, scenes=1), F.double(), None)
    rough = run(law(kind, scenes=1, dtype=torch.float32), F, None).double()
    reference = exact if kind is not ObjectivePlastic else torch.full_like(exact, strain)
    assert (rough - exact).norm() / reference.norm() < 2e-6 + 1e-7 / strain


def test_modulus_is_the_derivative_of_the_stress_at_rest():
    F = torch.eye(3, dtype=torch.float64).repeat(3, 1, 1).requires_grad_(True)
    raw = law(RawElastic)
    (gradient,) = torch.autograd.grad(raw(F, particles((0, 1, 2, 3)))[:, 0, 0].sum(), F)
    torch.testing.assert_close(raw.modulus(), gradient[:, 0, 0], rtol=1e-4, atol=0)

    weights = list(law(ObjectiveElastic).tensors())
    weights[4] = torch.zeros_like(weights[4])
    hencky = ObjectiveElastic(*weights)
    bulk, twice_shear = (hencky.scale * weights[5][:, i] for i in (0, 1))
    torch.testing.assert_close(hencky.modulus(), bulk + 2 / 3 * twice_shear + hencky.scale * 0, rtol=1e-2, atol=2e2)


def test_straight_through_gradient_enters_the_range_and_does_not_leave_it():
    F = torch.eye(3, dtype=torch.float64).repeat(2, 1, 1)
    F[:, 0, 0], F[:, 1, 1] = 1.05, 0.95
    c = torch.tensor([[100.0, 0.0, 100.0], [-5.0, 0.0, 100.0]], dtype=F.dtype, requires_grad=True)  # radius too large; below zero
    more = readouts.CorrectionReadout.apply(c, F, ObjectivePlastic)  # f = 0 in the first row, 1 in the second
    target = torch.stack([0.5 * (F[0] + torch.eye(3)), 0.5 * (F[1] + torch.eye(3))])
    (gradient,) = torch.autograd.grad((more - target).square().sum(), c)
    assert gradient[0, 0] > 0 and gradient[1, 0] < 0  # both radii are led back
    (away,) = torch.autograd.grad(-(readouts.CorrectionReadout.apply(c, F, ObjectivePlastic) - target).square().sum(), c)
    assert away[0, 0] == 0 and away[1, 0] == 0


def test_wrong_shapes_are_named():
    weights = list(law(ObjectiveElastic).tensors())
    weights[4] = weights[4][:, :2]
    with pytest.raises(UserError, match="W3 has shape"):
        ObjectiveElastic(*weights)


@pytest.mark.parametrize("shared", [1, 2])
@pytest.mark.parametrize("depth", [1, 2, 16])
def test_layer_gradients_of_a_gpu_add_up_over_kept_substeps(shared, depth, monkeypatch):
    """The kernel is replaced by one that writes given activations; two scenes share the first layers or have their own."""
    g = torch.Generator().manual_seed(0)
    offsets, width, substeps = (0, 5, 12), 32, 5
    weights = [torch.randn(shared, width, 9, generator=g), torch.randn(shared, width, generator=g)]
    weights += [torch.randn(shared, width, width, generator=g), torch.randn(shared, width, generator=g)]
    weights += [torch.randn(2, 4, width, generator=g), torch.randn(2, 4, generator=g)]
    scene = torch.repeat_interleave(torch.arange(2, dtype=torch.int32), torch.tensor([5, 7]))
    given = [[torch.randn(12, n, generator=g) for n in (9, width, width, width)] for _ in range(substeps)]
    written = iter(given)

    def write(kernel, threads, arguments, device, *, block):
        for target, values in zip(arguments[-4:], next(written), strict=True):
            target.view(12, -1).copy_(values)

    monkeypatch.setattr(fused, "launch", write)
    monkeypatch.setattr(fused, "BATCH", depth)
    engine = fused.FusedEngine(ObjectiveElastic(*weights), weights, Particles(scene, offsets))
    engine.start_adjoint([True] * 4 + [False] * 2)
    F = torch.eye(3).expand(12, 3, 3).contiguous()
    for _ in range(substeps):
        engine.adjoint(F, F, F.clone())
    found = engine.gradients()
    rows = scene.long() if shared == 2 else torch.zeros(12, dtype=torch.long)
    for n in range(shared):
        own = rows == n
        true = [sum(d1[own].T @ x[own] for x, _, d1, _ in given), sum(d1[own].sum(0) for _, _, d1, _ in given)]
        true += [sum(d2[own].T @ h[own] for _, h, _, d2 in given), sum(d2[own].sum(0) for *_, d2 in given)]
        for a, b in zip(found[:4], true):
            torch.testing.assert_close(a[n], b, rtol=1e-5, atol=1e-5)
