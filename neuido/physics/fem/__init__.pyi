from .finite_elements import FiniteElements
from .meshing import Mesh, mesh_body
from .plane_specimen import PlaneMotion, PlaneSpecimen

__all__ = [
    "FiniteElements",
    "Mesh",
    "PlaneMotion",
    "PlaneSpecimen",
    "mesh_body",
]
