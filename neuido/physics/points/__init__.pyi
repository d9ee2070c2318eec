from .material_point import MODES, Specimen, stress_along
from .point_mass import Forces, fly

__all__ = [
    "MODES",
    "Forces",
    "Specimen",
    "fly",
    "stress_along",
]
