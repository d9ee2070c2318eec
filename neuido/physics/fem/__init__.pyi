from .finite_elements import FiniteElements
from .meshing import Mesh, mesh_body

__all__ = [
    "FiniteElements",
    "Mesh",
    "mesh_body",
]
