"""Weighted means over particles, and covariances F A F^T, of all frames in one kernel launch each, with hand-written adjoints.

The operations of torch that do the same read and write each intermediate result, for each of the particles that carry a Gaussian.
"""

import functools
from types import SimpleNamespace

import torch
import warp as wp
from torch import Tensor
from torch.autograd.function import once_differentiable

from neuido.errors import UserError
from neuido.physics.runtime.device import launch, real_of, start_warp, torch_stream
from neuido.physics.runtime.once import cached

INDEX_LIMIT = 2**31 - 1
"""Largest index of the kernels, which use 32-bit integers."""


@cached
def build(real: type) -> SimpleNamespace:
    """Return the kernels for one scalar type, compiled at their first launch.

    Args:
        real: `wp.float32` or `wp.float64`.
    """
    start_warp()
    mat33 = wp.types.matrix(shape=(3, 3), dtype=real)
    kernel = functools.partial(wp.kernel, module=f"neuido.deformation.{real.__name__}", enable_backward=False)

    @kernel
    def average(
        index: wp.array2d(dtype=wp.int64),
        weight: wp.array2d(dtype=real),
        particles: int,
        columns: int,
        values: wp.array(dtype=real),
        out: wp.array(dtype=real),
    ):
        """Write the weighted mean of one column over the particles of one Gaussian in one frame."""
        i = wp.tid()
        row = i // columns
        frame = row // index.shape[0]
        n = row - frame * index.shape[0]
        total = real(0.0)
        for j in range(index.shape[1]):
            p = frame * particles + int(index[n, j])
            total += weight[n, j] * values[p * columns + i - row * columns]
        out[i] = total

    @kernel
    def average_adjoint(
        index: wp.array2d(dtype=wp.int64),
        weight: wp.array2d(dtype=real),
        particles: int,
        columns: int,
        a_out: wp.array(dtype=real),
        a_values: wp.array(dtype=real),
    ):
        """Add to a_values."""
        i = wp.tid()
        row = i // columns
        frame = row // index.shape[0]
        n = row - frame * index.shape[0]
        for j in range(index.shape[1]):
            if weight[n, j] != real(0.0):
                p = frame * particles + int(index[n, j])
                wp.atomic_add(a_values, p * columns + i - row * columns, weight[n, j] * a_out[i])

    @kernel
    def congruence(F: wp.array(dtype=mat33), A: wp.array(dtype=mat33), out: wp.array(dtype=mat33)):
        """Write F A F^T; A belongs to each frame."""
        i = wp.tid()
        out[i] = F[i] * A[i % A.shape[0]] * wp.transpose(F[i])

    @kernel
    def congruence_adjoint(
        F: wp.array(dtype=mat33),
        A: wp.array(dtype=mat33),
        a_out: wp.array(dtype=mat33),
        a_F: wp.array(dtype=mat33),
        a_A: wp.array(dtype=mat33),
    ):
        """Write a_F, and add to a_A if it is given."""
        i = wp.tid()
        n = i % A.shape[0]
        g = a_out[i]
        a_F[i] = g * F[i] * wp.transpose(A[n]) + wp.transpose(g) * F[i] * A[n]
        if a_A:
            wp.atomic_add(a_A, n, wp.transpose(F[i]) * g * F[i])

    return SimpleNamespace(average=average, average_adjoint=average_adjoint, congruence=congruence, congruence_adjoint=congruence_adjoint)


class Average(torch.autograd.Function):
    """Map values (..., P, m), indices (N, k) and weights (N, k) to the weighted means (..., N, m); differentiable in the values."""

    @staticmethod
    def forward(ctx, values: Tensor, index: Tensor, weight: Tensor) -> Tensor:
        values, index, weight = values.detach().contiguous(), index.contiguous(), weight.detach().contiguous()
        if max(values.numel(), values[..., 0, 0].numel() * len(index) * values.shape[-1]) > INDEX_LIMIT:
            raise UserError(f"{values.numel()} numbers of particles in frames exceed 2^31: deform fewer frames in one call")
        ctx.save_for_backward(index, weight)
        ctx.shape = values.shape
        out = values.new_empty(*values.shape[:-2], len(index), values.shape[-1])
        with torch_stream(values.device):
            arguments = [index, weight, values.shape[-2], values.shape[-1], values.view(-1), out.view(-1)]
            launch(build(real_of(values.dtype)).average, out.numel(), arguments, values.device)
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx, a_out: Tensor) -> tuple[Tensor, None, None]:
        index, weight = ctx.saved_tensors
        a_out = a_out.contiguous()
        a_values = a_out.new_zeros(ctx.shape)
        with torch_stream(a_out.device):
            arguments = [index, weight, ctx.shape[-2], ctx.shape[-1], a_out.view(-1), a_values.view(-1)]
            launch(build(real_of(a_out.dtype)).average_adjoint, a_out.numel(), arguments, a_out.device)
        return a_values, None, None


class Congruence(torch.autograd.Function):
    """Map F (..., N, 3, 3) and A (N, 3, 3) to F A F^T, (..., N, 3, 3)."""

    @staticmethod
    def forward(ctx, F: Tensor, A: Tensor) -> Tensor:
        F, A = F.detach().contiguous(), A.detach().contiguous()
        ctx.save_for_backward(F, A)
        out = torch.empty_like(F)
        with torch_stream(F.device):
            launch(build(real_of(F.dtype)).congruence, F.numel() // 9, [F.view(-1, 3, 3), A, out.view(-1, 3, 3)], F.device)
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx, a_out: Tensor) -> tuple[Tensor, Tensor | None]:
        F, A = ctx.saved_tensors
        a_out, a_F = a_out.contiguous(), torch.empty_like(F)
        a_A = torch.zeros_like(A) if ctx.needs_input_grad[1] else None
        with torch_stream(F.device):
            arguments = [F.view(-1, 3, 3), A, a_out.view(-1, 3, 3), a_F.view(-1, 3, 3), a_A]
            launch(build(real_of(F.dtype)).congruence_adjoint, F.numel() // 9, arguments, F.device)
        return a_F, a_A
