"""The properties of made materials, with which readings are trained and compared."""

from neuido.data.bodies.families import effects, laws
from neuido.data.trajectories.reference_viscosity import reference_viscosity
from neuido.physics.laws.parametric import young_poisson


def properties_of(family: str, parameters: dict[str, float]) -> dict[str, float]:
    """Return the properties of a material that its family has.

    E [Pa] and nu [-] are those at small strains, whatever the law's own parameters are; a fluid has neither.
    """
    shear, bulk = (float(modulus) for modulus in laws(family, [parameters])[0].moduli())
    found = {}
    if shear > 0:  # else a fluid
        found["young"], found["poisson"] = young_poisson(bulk, shear)
    found |= {name: parameters[name] for name in ("yield_stress", "friction_angle") if name in parameters}
    viscosity = effective_viscosity(family, parameters)
    return found | ({"viscosity": viscosity} if viscosity > 0 else {})


def effective_viscosity(family: str, parameters: dict[str, float]) -> float:
    """Return the shear viscosity [Pa s] of a material, zero for one without: that at a shear rate of 10 /s where it depends on the rate."""
    return reference_viscosity(effects(family, [parameters]))
