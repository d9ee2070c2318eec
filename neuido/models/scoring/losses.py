"""Relative losses."""

from torch import Tensor


def relative_errors(prediction: Tensor, target: Tensor, epsilon: Tensor | float = 0.0) -> Tensor:
    """Return the relative error ||y^ - y|| / (||y|| + epsilon) of each sample, (..., 3, 3) -> (...).

    Args:
        prediction: y^, (..., 3, 3).
        target: y, the same shape and unit.
        epsilon: Floor in the unit of y, broadcast against (...,). It keeps samples near rest from dominating (see `relative_lp`).
    """
    return (prediction - target).flatten(-2).norm(dim=-1) / (target.flatten(-2).norm(dim=-1) + epsilon)


def relative_lp(prediction: Tensor, target: Tensor, epsilon: Tensor | float = 0.0) -> Tensor:
    """Return the mean relative L2 error over samples: the L_r of the paper, `LpLoss` of neuraloperator with a floor.

    A particle in free fall has F close to I and almost no stress, so its relative error would be rounding noise. A suitable epsilon is
    about one percent of the RMS of the trajectory.
    """
    return relative_errors(prediction, target, epsilon).mean()
