from . import colliders, effects, laws
from .fem.finite_elements import FiniteElements
from .fem.meshing import Mesh, mesh_body
from .mpm.simulator import Simulator
from .runtime.frames import Frames
from .springs.mass_spring import MassSpring

__all__ = [
    "FiniteElements",
    "Frames",
    "MassSpring",
    "Mesh",
    "Simulator",
    "colliders",
    "effects",
    "laws",
    "mesh_body",
]
