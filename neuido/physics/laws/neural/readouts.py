"""Read-outs of objective networks for Stage I, which learns from given F: no gradient flows to F."""

import torch
from torch import Tensor

from neuido.physics.laws.neural import network_kernels
from neuido.physics.laws.neural.networks import ObjectiveElastic, ObjectivePlastic, launch


class StressReadout(torch.autograd.Function):
    """The stress of an objective or bounded law by a Warp kernel, differentiable with respect to the coefficients c (B, 4) alone."""

    @staticmethod
    def forward(ctx, c: Tensor, F: Tensor, law: type[ObjectiveElastic]) -> Tensor:
        c, out = c.detach().contiguous(), torch.empty_like(F)
        launch(law.kernels(F).stress, F, F, c, law.unit, out)
        ctx.save_for_backward(F, c)
        ctx.law = law
        return out

    @staticmethod
    def backward(ctx, grad: Tensor):
        F, c = ctx.saved_tensors
        out = torch.empty_like(c)
        launch(ctx.law.kernels(F).stress_coefficients_adjoint, F, F, c, ctx.law.unit, grad.contiguous(), out)
        return out, None, None


class CorrectionReadout(torch.autograd.Function):
    """The correction of a law by a Warp kernel, differentiable with respect to the coefficients c (B, n) alone.

    Where a clamp is active, the gradient is passed if descent moves the value back into the range; without that, a radius outside the
    range would never learn. The gradient is zero if descent would move the value further out.
    """

    @staticmethod
    def forward(ctx, c: Tensor, F: Tensor, law: type[ObjectivePlastic]) -> Tensor:
        c, out = c.detach().contiguous(), torch.empty_like(F)
        launch(law.kernels(F).correction, F, F, c, law.unit, out)
        ctx.save_for_backward(F, c)
        ctx.law = law
        return out

    @staticmethod
    def backward(ctx, grad: Tensor):
        F, c = ctx.saved_tensors
        out = torch.empty_like(c)
        launch(ctx.law.kernels(F).correction_coefficients_adjoint, F, F, c, ctx.law.unit, 1, grad.contiguous(), out)
        return out, None, None


def compute_strain_features(F: Tensor, law: type[ObjectiveElastic | ObjectivePlastic]) -> Tensor:
    """Compute the input features of a law by a Warp kernel, without gradient.

    Args:
        F: Deformation gradient [-], (B, 3, 3).
        law: The law that reads them.

    Returns:
        The same as `law.features_of` [-], (B, 9).
    """
    out = torch.empty(F.shape[0], network_kernels.FEATURES, dtype=F.dtype, device=F.device)
    launch(law.kernels(F).features, F, F.detach().contiguous(), out)
    return out
