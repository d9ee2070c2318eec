"""The Newtonian viscosity that stands for the rate-dependent part of a material, for the viscosity head of the operator.

The operator has one number for what depends on the rate: the viscosity eta of Kelvin and Voigt's stress 2 eta D, beside its yield surface.
For a Newtonian fluid and for a Bingham body in steady shear that is exact. A Herschel-Bulkley body, whose overstress grows with a power of
the rate, is described by the Bingham body that has the same stress at `REFERENCE_RATE`.
"""

import math

import torch

from neuido.physics.effects.parameters import Effects

REFERENCE_RATE = 10.0
"""Shear rate at which the Newtonian viscosity has the overstress of a Herschel-Bulkley body [1/s]: a body of a decimetre at 1 m/s."""


def reference_viscosity(effects: Effects | None) -> float:
    """Return the viscosity of a material with these effects beside its laws [Pa s].

    In simple shear at the rate g, the overstress eta r^n of `rate_yield` acts at the rate r = g / sqrt(2) of the plastic strain, and the
    shear stress is the norm of the deviator over sqrt(2).
    """
    if effects is None:
        return 0.0
    total = 0.0 if effects.viscosity_shear is None else float(torch.as_tensor(effects.viscosity_shear))
    if effects.rate_yield is not None:
        index = 1.0 if effects.yield_index is None else float(torch.as_tensor(effects.yield_index))
        total += float(torch.as_tensor(effects.rate_yield)) * (REFERENCE_RATE / math.sqrt(2)) ** index / math.sqrt(2) / REFERENCE_RATE
    return total
