"""Decompositions: their values, and their derivatives where singular values repeat."""

import pytest
import torch

from neuido.physics.linalg import decompositions as linalg

EYE = torch.eye(3, dtype=torch.float64)


def rotations(count: int, seed: int = 0) -> torch.Tensor:
    q, _ = torch.linalg.qr(torch.randn(count, 3, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(seed)))
    return q * torch.linalg.det(q).sign()[:, None, None]


def with_stretches(rows: list[list[float]]) -> torch.Tensor:
    sigma = torch.tensor(rows, dtype=torch.float64)
    return (rotations(len(rows), 1) * sigma[:, None]) @ rotations(len(rows), 2).mT


CASES = {
    "identity": EYE.repeat(2, 1, 1),
    "rotation": rotations(3),
    "repeated": with_stretches([[1.4, 1.4, 1.4], [1.3, 1.3, 0.6], [1.3, 0.6, 0.6]]),
    "near": with_stretches([[1 + 1e-9, 1.0, 1 - 1e-9], [1 + 1e-6, 1.0, 0.7], [1.2, 0.8 + 1e-4, 0.8], [1 + 1e-12, 1, 1]]),
    "generic": EYE + 0.4 * torch.randn(6, 3, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(3)),
    "inverted": with_stretches([[1.4, 1.1, -0.6], [1.2, 1.2, -0.3]]),
}


def finite_difference(function, F: torch.Tensor, weight: torch.Tensor, step: float = 2e-5) -> torch.Tensor:
    """Gradient of sum(weight * function(F)), matrix by matrix."""
    grad = torch.empty_like(F)
    for i in range(3):
        for j in range(3):
            h = torch.zeros(3, 3, dtype=F.dtype)
            h[i, j] = step
            grad[:, i, j] = ((function(F + h) - function(F - h)) * weight).sum((1, 2)) / (2 * step)
    return grad


def autograd(function, F: torch.Tensor, weight: torch.Tensor) -> torch.Tensor:
    F = F.clone().requires_grad_()
    return torch.autograd.grad(function(F), F, weight)[0]


def weights(F: torch.Tensor) -> torch.Tensor:
    return torch.randn(F.shape, dtype=F.dtype, generator=torch.Generator().manual_seed(7))


@pytest.mark.parametrize("case", CASES)
def test_svd_is_a_decomposition_into_rotations(case):
    F = CASES[case]
    U, sigma, V = linalg.svd(F)
    for rotation in (U, V):
        torch.testing.assert_close(rotation @ rotation.mT, EYE.expand_as(F), atol=1e-12, rtol=0)
        torch.testing.assert_close(torch.linalg.det(rotation), torch.ones(len(F), dtype=F.dtype))
    assert (sigma[:, :-1] > sigma[:, 1:]).all()
    assert (sigma[:, 2].sign() == torch.linalg.det(F).sign()).all()
    torch.testing.assert_close((U * sigma[:, None]) @ V.mT, F, atol=5e-8, rtol=0)
    U, sigma, V = linalg.svd(F, gap=0.0)
    torch.testing.assert_close((U * sigma[:, None]) @ V.mT, F, atol=1e-14, rtol=0)


@pytest.mark.parametrize("case", ["identity", "rotation", "repeated", "near", "generic"])
def test_svd_gradient_of_isotropic_functions(case):
    """U, sigma and V in every role: a function of the stretch, one of the left stretch, and the rotation."""

    def function(F):
        U, sigma, V = linalg.svd(F)
        return (U * sigma.log()[:, None]) @ U.mT + (V * (sigma**3)[:, None]) @ V.mT + U @ V.mT

    def exact(F):
        U, sigma, V = linalg.svd(F, gap=0.0)
        return (U * sigma.log()[:, None]) @ U.mT + (V * (sigma**3)[:, None]) @ V.mT + U @ V.mT

    F = CASES[case]
    expected = finite_difference(exact, F, weights(F))
    torch.testing.assert_close(autograd(function, F, weights(F)), expected, rtol=1e-6, atol=1e-6 * expected.abs().max().item())


def test_svd_gradcheck_away_from_repeated_values():
    F = CASES["generic"].clone().requires_grad_()
    assert torch.autograd.gradcheck(lambda F: linalg.svd(F)[1], F)
    # The squares of the entries of U and V do not depend on the signs of the singular vectors.
    assert torch.autograd.gradcheck(lambda F: tuple(linalg.svd(F)[k] ** 2 for k in (0, 2)), F)


@pytest.mark.parametrize("case", CASES)
def test_polar_values(case):
    F = CASES[case]
    R, S = linalg.polar(F)
    torch.testing.assert_close(R @ R.mT, EYE.expand_as(F), atol=1e-13, rtol=0)
    torch.testing.assert_close(torch.linalg.det(R), torch.ones(len(F), dtype=F.dtype))
    torch.testing.assert_close(R @ S, F, atol=1e-13, rtol=0)
    assert torch.equal(S, S.mT)


def test_polar_of_a_reflection_is_a_rotation():
    R, S = linalg.polar(torch.diag(torch.tensor([1.0, 1.0, -1.0], dtype=torch.float64)))
    assert torch.linalg.det(R) == pytest.approx(1.0)
    assert torch.linalg.eigvalsh(S).tolist() == pytest.approx([-1.0, 1.0, 1.0])


@pytest.mark.parametrize("case", CASES)
def test_polar_gradcheck(case):
    F = CASES[case].clone().requires_grad_()
    assert torch.autograd.gradcheck(linalg.polar, F, eps=1e-5, atol=1e-7, rtol=1e-6)


def test_polar_at_the_identity_is_the_skew_part():
    F, G = EYE[None].clone(), weights(EYE[None])
    torch.testing.assert_close(autograd(lambda F: linalg.polar(F)[0], F, G), (G - G.mT) / 2)
    torch.testing.assert_close(autograd(lambda F: linalg.polar(F)[1], F, G), (G + G.mT) / 2)


@pytest.mark.parametrize("case", ["identity", "rotation", "repeated", "near", "generic"])
@pytest.mark.parametrize("kind", ["map", "stress"])
def test_isotropic_functions(case, kind):
    """U diag(ln sigma) W^T to full precision at every F."""

    def function(F):
        at = linalg.frame(F)
        build = linalg.isotropic_map if kind == "map" else linalg.isotropic_stress
        return build(F, at, at.sigma.log(), linalg.log_difference(at.sigma, 1e-3))

    F = CASES[case]
    expected = finite_difference(function, F, weights(F))
    torch.testing.assert_close(autograd(function, F, weights(F)), expected, rtol=1e-7, atol=1e-8 * expected.abs().max().item())


def test_divided_differences():
    sigma = torch.tensor([[2.0, 1.0, 0.5], [1.0, 1.0, 1.0], [1 + 1e-13, 1.0, 1 - 1e-9], [1.0, 1e-4, -0.2]], dtype=torch.float64)
    got = linalg.log_difference(sigma, 1e-3)
    assert got[0, 0, 1] == pytest.approx(torch.log(torch.tensor(2.0, dtype=torch.float64)).item(), rel=1e-14)
    torch.testing.assert_close(got[1], torch.ones(3, 3, dtype=torch.float64), rtol=0, atol=0)
    torch.testing.assert_close(got[2], torch.ones(3, 3, dtype=torch.float64), rtol=0, atol=2e-9)
    assert got[3, 1, 2] == 0
    assert got[3, 0, 2] == pytest.approx(-torch.log(torch.tensor(1e-3, dtype=torch.float64)).item() / 1.2, rel=1e-14)
    h = torch.tensor([[0.3, 0.3, -1.0]], dtype=torch.float64)
    got, e = linalg.exp_difference(h), h.exp()
    assert got[0, 0, 1] == pytest.approx(e[0, 0].item(), rel=1e-14)
    assert got[0, 0, 2] == pytest.approx(((e[0, 2] - e[0, 0]) / -1.3).item(), rel=1e-14)


def test_float32_and_leading_axes():
    F = CASES["generic"].float().reshape(2, 3, 3, 3).requires_grad_()
    U, sigma, V = linalg.svd(F)
    R, S = linalg.polar(F)
    assert sigma.shape == (2, 3, 3)
    assert R.shape == F.shape
    assert R.dtype == torch.float32
    (R.sum() + S.sum() + (U * sigma.unsqueeze(-2) @ V.mT).sum()).backward()
    assert torch.isfinite(F.grad).all()


def test_the_kernel_frame_decomposes_as_torch_does():
    """What CUDA uses in place of torch's SVD, run here on the CPU: same singular values, rotations, and product."""
    from neuido.physics.linalg import frame_kernels
    from neuido.physics.runtime.device import launch, real_of

    g = torch.Generator().manual_seed(5)
    F = torch.randn(200, 3, 3, generator=g, dtype=torch.float64)
    F[:50] = torch.eye(3, dtype=torch.float64) + 1e-3 * F[:50]
    F[0] = torch.eye(3)
    U, V, sigma = torch.empty_like(F), torch.empty_like(F), torch.empty(200, 3, dtype=torch.float64)
    launch(frame_kernels.build(real_of(F.dtype)).decompose, 200, [F, U, sigma, V], F.device)
    expected = linalg.svd(F, gap=0.0)[1]
    assert torch.allclose(sigma, expected, atol=1e-12)
    assert torch.allclose(U @ torch.diag_embed(sigma) @ V.mT, F, atol=1e-12)
    for R in (U, V):
        assert torch.allclose(torch.linalg.det(R), torch.ones(200, dtype=torch.float64), atol=1e-12)
