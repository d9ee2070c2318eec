"""Yield of a plane specimen: the elastic part of a gradient, by radial return in logarithmic strains.

The components are those of `plane_law`. The functions of a symmetric matrix of the plane are written by its invariants, which are smooth
where both stretches are alike.
"""

import torch
from torch import Tensor

Five = tuple[Tensor, Tensor, Tensor, Tensor, Tensor]
"""Components 11, 12, 21, 22 and 33 of each triangle, (E,) each."""
ROUND = 1e-4
"""Square of an argument below which a series replaces a function of it; the error of each series is below 1e-15."""


def product(A: Five, B: Five) -> Five:
    """Return the product of matrices."""
    a, b, c, d, l = A
    p, q, r, s, m = B
    return a * p + b * r, a * q + b * s, c * p + d * r, c * q + d * s, l * m


def inverse(A: Five) -> Five:
    """Return the inverse of matrices."""
    a, b, c, d, l = A
    area = a * d - b * c
    return d / area, -b / area, -c / area, a / area, 1 / l


def elastic_part(trial: Five, two_mu: Tensor, limit_inverse: Tensor) -> Five:
    """Return the gradient after a plastic step of von Mises' law, as `laws.VonMises` does in three dimensions.

    The deviator of the logarithmic strain is scaled so that the stress 2 mu |dev ln V| does not exceed the yield stress; rotation and
    volume are those of the trial.

    Args:
        trial: Elastic gradients if nothing yielded.
        two_mu: Twice the shear modulus [Pa], (E,) or ().
        limit_inverse: One over the yield stress, a norm of the deviatoric stress [1/Pa], (); 0: nothing yields.
    """
    a, b, c, d, l = trial
    area = a * d - b * c
    first, second, mixed = a**2 + b**2, c**2 + d**2, a * c + b * d
    mean, half = (first + second) / 2, (first - second) / 2
    ratio = (half**2 + mixed**2) / mean**2
    log_slope = 0.5 * _atanh_over(ratio) / mean  # of half and mixed, to components of ln V
    spread = log_slope**2 * (half**2 + mixed**2)
    flat = 0.5 * area.log() - (area * l).log() / 3  # of the deviator along both axes of the plane; across it is -2 flat
    square = 6 * flat**2 + 2 * spread
    norm = torch.where(square > 0, torch.where(square > 0, square, 1.0).sqrt(), 0.0)
    load = two_mu * norm * limit_inverse
    flows = load > 1
    gone = torch.where(flows, 1 - 1 / torch.where(flows, load, 1.0), 0.0)  # share of the deviator that becomes plastic
    wide, sharp = _cosh_sinhc(gone**2 * spread)
    shrink, slope = torch.exp(-gone * flat), gone * log_slope
    back = (
        shrink * (wide - sharp * slope * half), -shrink * sharp * slope * mixed,
        -shrink * sharp * slope * mixed, shrink * (wide + sharp * slope * half), torch.exp(2 * gone * flat),
    )  # fmt: skip
    return product(back, trial)


def _atanh_over(square: Tensor) -> Tensor:
    """Return atanh(x)/x of x^2."""
    near = square < ROUND
    x = torch.where(near, 0.5, square).clamp(max=1 - 1e-15).sqrt()
    return torch.where(near, 1 + square / 3 + square**2 / 5 + square**3 / 7 + square**4 / 9, x.atanh() / x)


def _cosh_sinhc(square: Tensor) -> tuple[Tensor, Tensor]:
    """Return cosh(x) and sinh(x)/x of x^2."""
    near = square < ROUND
    x = torch.where(near, 1.0, square).sqrt()
    cosh = 1 + square / 2 + square**2 / 24 + square**3 / 720
    return torch.where(near, cosh, x.cosh()), torch.where(near, 1 + square / 6 + square**2 / 120 + square**3 / 5040, x.sinh() / x)
