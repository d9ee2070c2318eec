"""The properties of made materials, with which readings are trained and compared."""

import torch

from neuido.data.bodies.families import effects, evaluate, laws
from neuido.data.trajectories.reference_viscosity import reference_viscosity

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


def effective_viscosity(family: str, parameters: dict[str, float]) -> float:
    """Return the shear viscosity [Pa s] of a material, zero for one without: that at a shear rate of 10 /s where it depends on the rate."""
    return reference_viscosity(effects(family, [parameters]))
