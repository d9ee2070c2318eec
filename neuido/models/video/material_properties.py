"""Properties of a material that a video may reveal, under one name and unit in all families."""

import math

import torch

from neuido.data.bodies.families import effects, evaluate, laws
from neuido.data.trajectories.reference_viscosity import reference_viscosity

UNITS = {"young": "Pa", "poisson": "", "yield_stress": "Pa", "friction_angle": "°", "viscosity": "Pa s"}
"""The properties, and their units."""
SYMBOLS = {"young": "E", "poisson": "nu", "yield_stress": "yield stress", "friction_angle": "friction angle", "viscosity": "viscosity"}
LOGARITHMIC = ("young", "yield_stress", "viscosity")
"""Properties that are positive and spread over decades; the others are linear."""
LENGTH_POWERS = {"young": 1.0, "poisson": 0.0, "yield_stress": 1.0, "friction_angle": 0.0, "viscosity": 1.5}
"""Power of a length with which a property grows if a motion is enlarged at the same gravity and density: times grow with its root."""
STRAIN = 1e-3
"""Strain of the secants of E and nu [-]."""
FLUID = 1e-3
"""Ratio of shear to P-wave modulus below which a material is a fluid, without E and nu."""


def properties_of(family: str, parameters: dict[str, float]) -> dict[str, float]:
    """Return the properties of a material that its family has.

    E [Pa] and nu [-] are those at small strains, whatever the law's own parameters are; a fluid has neither.
    """
    F = torch.eye(3) + STRAIN * torch.cat([torch.diag_embed(torch.eye(3)), -torch.diag_embed(torch.eye(3))])
    stress = evaluate(laws(family, [parameters])[0], F).double().diagonal(dim1=-2, dim2=-1)
    response = (stress[:3] - stress[3:]) / (2 * STRAIN)
    along = float(response.diagonal().mean())
    lam = (float(response.sum()) - 3 * along) / 6
    mu = (along - lam) / 2
    found = {}
    if mu > FLUID * along:
        found |= {"young": mu * (3 * lam + 2 * mu) / (lam + mu), "poisson": lam / (2 * (lam + mu))}
    found |= {name: parameters[name] for name in ("yield_stress", "friction_angle") if name in parameters}
    viscosity = effective_viscosity(family, parameters)
    return found | ({"viscosity": viscosity} if viscosity > 0 else {})


def to_scale(name: str, value: float) -> float:
    """Return a property on the scale on which its distribution is normal: the logarithm, or itself."""
    return math.log(value) if name in LOGARITHMIC else value


def from_scale(name: str, value: float) -> float:
    """Return the property of a value of `to_scale`."""
    return math.exp(value) if name in LOGARITHMIC else value


def effective_viscosity(family: str, parameters: dict[str, float]) -> float:
    """Return the shear viscosity [Pa s] of a material, zero for one without: that at a shear rate of 10 /s where it depends on the rate."""
    return reference_viscosity(effects(family, [parameters]))
