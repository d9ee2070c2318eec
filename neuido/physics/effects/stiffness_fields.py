"""Factors on the elastic stress that vary over a body: a gradient across it, and a ball that is stiffer or softer."""

import torch
from torch import Tensor


def as_tensor(value: Tensor | float) -> Tensor:
    """Return a value as a tensor; numbers become float64, to lose no precision."""
    return value if isinstance(value, Tensor) else torch.as_tensor(value, dtype=torch.float64)


def linear_gradient(x: Tensor, slope: Tensor, *, mean: Tensor | None = None, length: Tensor | float | None = None) -> Tensor:
    """Return the factor exp(slope . (X - mean) / length), (P,): a stiffness gradient across the body.

    Args:
        x: Reference positions [m], (P, 3).
        slope: Change of the factor's logarithm over `length` along each axis [-], (3,) or (P, 3).
        mean: Position at which the factor is one [m]; by default the mean of `x`.
        length: Reference length [m]; by default the largest extent of `x`.
    """
    mean = x.mean(dim=0) if mean is None else mean
    length = (x.amax(dim=0) - x.amin(dim=0)).max().clamp(min=1e-30) if length is None else length  # one point: a factor of one
    return torch.exp(((x - mean) / length * slope).sum(-1))


def ball_inclusion(
    x: Tensor, log_ratio: Tensor | float, centre: Tensor, radius: Tensor | float, *, width: Tensor | float = 0.0, mean: Tensor | None = None
) -> Tensor:
    """Return the factor exp(log_ratio) inside a ball and 1 outside, (P,): a stiffer or softer inclusion.

    Args:
        x: Reference positions [m], (P, 3).
        log_ratio: Logarithm of the factor inside [-], () or (P,).
        centre: Centre of the ball relative to the mean of `x` [m], (3,) or (P, 3).
        radius: Radius of the ball [m], () or (P,).
        width: Width of a smooth border tanh((radius - r) / width) [m]. With 0 the border is sharp, and the factor has no gradient with
            respect to centre and radius.
        mean: Replaces the mean of `x`.
    """
    r = torch.linalg.vector_norm(x - (x.mean(dim=0) if mean is None else mean) - centre, dim=-1)
    width = torch.as_tensor(width, dtype=x.dtype, device=x.device)
    soft = 0.5 + 0.5 * torch.tanh((radius - r) / torch.where(width > 0, width, 1.0))
    inside = torch.where(width > 0, soft, (r <= radius).to(x.dtype))
    return torch.exp(log_ratio * inside)
