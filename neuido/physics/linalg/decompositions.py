"""Singular value and polar decompositions of (..., 3, 3) matrices, with derivatives that are valid at repeated singular values.

Convention throughout: F = U diag(sigma) V^T with rotations U and V, sigma_1 >= sigma_2 >= |sigma_3|; sigma_3 carries the sign of det F.
In the frame P = U^T dF V the derivatives split into a symmetric part, divided by sigma_j - sigma_i, and a skew part, divided by
sigma_i + sigma_j. Only the first is singular at repeated singular values, and for an isotropic function it is a divided difference.
Everything is plain torch in float32 or float64, but on CUDA the decomposition is a Warp kernel (`frame_kernels`).
"""

from typing import NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from neuido.physics.linalg import frame_kernels
from neuido.physics.linalg.warp_functions import GAP
from neuido.physics.runtime.device import launch, real_of, torch_stream


class Frame(NamedTuple):
    """The principal frame F = U diag(sigma) V^T of F. Gradients flow through `sigma` alone; `isotropic_map` accounts for U and V."""

    U: Tensor
    """Left rotation, (..., 3, 3)."""
    sigma: Tensor
    """Singular values, descending, the last one with the sign of det F, (..., 3)."""
    V: Tensor
    """Right rotation, (..., 3, 3)."""


def _decompose(F: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    if F.is_cuda:  # torch decomposes large batches of small matrices slowly there
        flat = F.detach().reshape(-1, 3, 3).contiguous()
        U, V, sigma = torch.empty_like(flat), torch.empty_like(flat), flat.new_empty(len(flat), 3)
        with torch_stream(F.device):
            launch(frame_kernels.build(real_of(F.dtype)).decompose, len(flat), [flat, U, sigma, V], F.device)
        return U.view(F.shape), sigma.view(F.shape[:-1]), V.view(F.shape)
    U, sigma, Vh = torch.linalg.svd(F)
    V = Vh.mT
    flip_u, flip_v = torch.linalg.det(U).sign(), torch.linalg.det(V).sign()
    last = torch.tensor([0.0, 0.0, 1.0], dtype=F.dtype, device=F.device)

    def scale(flip: Tensor) -> Tensor:
        return 1 + last * (flip - 1).unsqueeze(-1)

    return U * scale(flip_u).unsqueeze(-2), sigma * scale(flip_u * flip_v), V * scale(flip_v).unsqueeze(-2)


def _pair_sums(sigma: Tensor) -> Tensor:
    """Return sigma_i + sigma_j, (..., 3, 3), bounded below by `GAP`; only an inverted F comes near zero."""
    return (sigma.unsqueeze(-1) + sigma.unsqueeze(-2)).clamp(min=GAP)


def _skew(A: Tensor) -> Tensor:
    return A - A.mT


class _SVD(torch.autograd.Function):
    @staticmethod
    def forward(ctx, F: Tensor, gap: float) -> tuple[Tensor, Tensor, Tensor]:
        U, sigma, V = _decompose(F)
        s1, s2, s3 = sigma.unbind(-1)
        width = gap * s1.abs().clamp(min=torch.finfo(F.dtype).tiny)
        sigma = torch.stack([torch.maximum(s1, s2 + width), s2, torch.minimum(s3, s2 - width)], -1)
        ctx.save_for_backward(U, sigma, V)
        ctx.gap = gap
        return U, sigma, V

    @staticmethod
    @once_differentiable
    def backward(ctx, grad_U: Tensor, grad_sigma: Tensor, grad_V: Tensor):
        U, sigma, V = ctx.saved_tensors
        a, b = _skew(U.mT @ grad_U), _skew(V.mT @ grad_V)
        difference = sigma.unsqueeze(-2) - sigma.unsqueeze(-1)
        eye = torch.eye(3, dtype=U.dtype, device=U.device)
        symmetric = (a + b) / (difference + eye) * (1 - eye)
        P = (symmetric + (a - b) / _pair_sums(sigma)) / 2 + torch.diag_embed(grad_sigma)
        return U @ P @ V.mT, None


def svd(F: Tensor, *, gap: float | None = None) -> tuple[Tensor, Tensor, Tensor]:
    """Decompose F = U diag(sigma) V^T into rotations U and V and singular values, with a derivative for sigma_2 + sigma_3 > 0.

    Singular values closer than `gap` are moved apart to that distance. A function of U, sigma and V that does not depend on the choice of
    the singular vectors (a polar factor, an isotropic function) then has a value and a gradient with an error of order `gap` at
    repeated singular values, and exact ones elsewhere. For more digits use `frame` and `isotropic_map`.

    Args:
        F: Matrices, (..., 3, 3).
        gap: Smallest difference of two singular values relative to the largest [-]; by default the square root of the machine epsilon.

    Returns:
        U (..., 3, 3), sigma (..., 3) in descending order with the sign of det F on the last, V (..., 3, 3).
    """
    return _SVD.apply(F, torch.finfo(F.dtype).eps ** 0.5 if gap is None else gap)


class _Rotation(torch.autograd.Function):
    @staticmethod
    def forward(ctx, F: Tensor) -> Tensor:
        U, sigma, V = _decompose(F)
        ctx.save_for_backward(U, sigma, V)
        return U @ V.mT

    @staticmethod
    @once_differentiable
    def backward(ctx, grad: Tensor) -> Tensor:
        U, sigma, V = ctx.saved_tensors
        return U @ (_skew(U.mT @ grad @ V) / _pair_sums(sigma)) @ V.mT


def polar(F: Tensor) -> tuple[Tensor, Tensor]:
    """Decompose F = R S into the nearest rotation and a symmetric stretch.

    det R is +1 even if det F < 0. The derivative has no singularity at repeated singular values, F = I included.

    Args:
        F: Matrices, (..., 3, 3).

    Returns:
        The rotation R (..., 3, 3) and the stretch S (..., 3, 3).
    """
    R = _Rotation.apply(F)
    S = R.mT @ F
    return R, (S + S.mT) / 2


class _Values(torch.autograd.Function):
    @staticmethod
    def forward(ctx, F: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        U, sigma, V = _decompose(F)
        ctx.save_for_backward(U, V)
        ctx.mark_non_differentiable(U, V)
        return U, sigma, V

    @staticmethod
    @once_differentiable
    def backward(ctx, _U: Tensor, grad: Tensor, _V: Tensor) -> Tensor:
        U, V = ctx.saved_tensors
        return (U * grad.unsqueeze(-2)) @ V.mT


def frame(F: Tensor) -> Frame:
    """Compute the principal frame F = U diag(sigma) V^T; gradients flow through `sigma` alone.

    Args:
        F: Matrices, (..., 3, 3).
    """
    return Frame(*_Values.apply(F))


class _Spectral(torch.autograd.Function):
    @staticmethod
    def forward(ctx, F: Tensor, values: Tensor, U: Tensor, sigma: Tensor, V: Tensor, slopes: Tensor, stress: bool) -> Tensor:
        ctx.save_for_backward(values, U, sigma, V, slopes)
        ctx.stress = stress
        return (U * values.unsqueeze(-2)) @ (U if stress else V).mT

    @staticmethod
    @once_differentiable
    def backward(ctx, grad: Tensor):
        values, U, sigma, V, slopes = ctx.saved_tensors
        A = U.mT @ grad @ (U if ctx.stress else V)
        sums = _pair_sums(sigma)
        if ctx.stress:
            B = (A + A.mT) * slopes * sigma.unsqueeze(-2) / sums
        else:
            B = (slopes * (A + A.mT) + (values.unsqueeze(-1) + values.unsqueeze(-2)) / sums * _skew(A)) / 2
        B = B - torch.diag_embed(B.diagonal(dim1=-2, dim2=-1))
        return U @ B @ V.mT, A.diagonal(dim1=-2, dim2=-1), None, None, None, None, None


def isotropic_map(F: Tensor, at: Frame, values: Tensor, slopes: Tensor) -> Tensor:
    """Compute U diag(z) V^T, such as the result of a return map, with the exact derivative with respect to F.

    Args:
        F: Matrices, (..., 3, 3).
        at: The principal frame `frame(F)`.
        values: z (..., 3), a differentiable function of `at.sigma` and parameters.
        slopes: Divided differences (z_j - z_i) / (sigma_j - sigma_i), (..., 3, 3), finite at repeated singular values. The diagonal is not
            used.
    """
    U, sigma, V = (part.detach() for part in at)
    return _Spectral.apply(F, values, U, sigma, V, slopes.detach(), False)


def isotropic_stress(F: Tensor, at: Frame, values: Tensor, slopes: Tensor) -> Tensor:
    """Compute U diag(t) U^T, such as a stress, with the exact derivative with respect to F.

    Args:
        F: Matrices, (..., 3, 3).
        at: The principal frame `frame(F)`.
        values: t (..., 3), a differentiable function of `at.sigma` and parameters.
        slopes: Divided differences (t_j - t_i) / (sigma_j - sigma_i), (..., 3, 3), finite at repeated singular values. The diagonal is not
            used.
    """
    U, sigma, V = (part.detach() for part in at)
    return _Spectral.apply(F, values, U, sigma, V, slopes.detach(), True)


def log_difference(sigma: Tensor, floor: float) -> Tensor:
    """Return the divided differences of ln(max(sigma, floor)), (..., 3) -> (..., 3, 3), finite at repeated values."""
    a, b = sigma.unsqueeze(-1), sigma.unsqueeze(-2)
    ca, cb = a.clamp(min=floor), b.clamp(min=floor)
    x = (cb - ca) / ca
    slope = torch.where(x == 0, torch.ones_like(x), torch.log1p(x) / torch.where(x == 0, torch.ones_like(x), x)) / ca
    low_a, low_b = (a < floor).expand_as(x), (b < floor).expand_as(x)
    mixed = low_a ^ low_b
    share = torch.where(mixed, (cb - ca) / torch.where(mixed, b - a, torch.ones_like(x)), (~low_a).to(x))
    return slope * share


def exp_difference(h: Tensor) -> Tensor:
    """Return the divided differences of exp at h, (..., 3) -> (..., 3, 3), finite at repeated values."""
    a, b = h.unsqueeze(-1), h.unsqueeze(-2)
    x = b - a
    return torch.exp(a) * torch.where(x == 0, torch.ones_like(x), torch.expm1(x) / torch.where(x == 0, torch.ones_like(x), x))
