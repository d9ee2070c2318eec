"""Properties of a material that a video may reveal, under one name and unit in all families."""

import math

UNITS = {"young": "Pa", "poisson": "", "yield_stress": "Pa", "friction_angle": "°", "viscosity": "Pa s"}
"""The properties, and their units."""
SYMBOLS = {"young": "E", "poisson": "nu", "yield_stress": "yield stress", "friction_angle": "friction angle", "viscosity": "viscosity"}
LOGARITHMIC = ("young", "yield_stress", "viscosity")
"""Properties that are positive and spread over decades; the others are linear."""
LENGTH_POWERS = {"young": 1.0, "poisson": 0.0, "yield_stress": 1.0, "friction_angle": 0.0, "viscosity": 1.5}
"""Power of a length with which a property grows if a motion is enlarged at the same gravity and density: times grow with its root."""


def to_scale(name: str, value: float) -> float:
    """Return a property on the scale on which its distribution is normal: the logarithm, or itself."""
    return math.log(value) if name in LOGARITHMIC else value


def from_scale(name: str, value: float) -> float:
    """Return the property of a value of `to_scale`."""
    return math.exp(value) if name in LOGARITHMIC else value
