"""Losses."""

from torch import Tensor


def relative_errors(prediction: Tensor, target: Tensor, epsilon: Tensor | float = 0.0) -> Tensor:
    """Return ||y^ - y|| / (||y|| + epsilon) of each sample, (..., n, 3, 3) or (..., n, 9) -> (..., n).

    Args:
        prediction: y^, (..., 3, 3).
        target: y, the same shape and unit.
        epsilon: Floor in the unit of y, broadcast against (...,): keeps samples near rest from ruling (`relative_lp`'s note).
    """
    return (prediction - target).flatten(-2).norm(dim=-1) / (target.flatten(-2).norm(dim=-1) + epsilon)


def relative_lp(prediction: Tensor, target: Tensor, epsilon: Tensor | float = 0.0) -> Tensor:
    """Return the mean over samples of the relative L2 error, the paper's L_r (neuraloperator's `LpLoss` with a floor).

    A particle in free fall has F ~ I and a stress near zero, and its relative error would be float noise; epsilon is about one
    percent of the trajectory's root mean square.
    """
    return relative_errors(prediction, target, epsilon).mean()
