from . import colliders, effects, laws
from .fem.finite_elements import FiniteElements
from .fem.meshing import Mesh, mesh_body
from .mpm.simulator import Simulator
from .plane.plane_specimen import PlaneMotion, PlaneSpecimen
from .runtime.frames import Frames
from .springs.mass_spring import MassSpring

__all__ = [
    "FiniteElements",
    "Frames",
    "MassSpring",
    "Mesh",
    "PlaneMotion",
    "PlaneSpecimen",
    "Simulator",
    "colliders",
    "effects",
    "laws",
    "mesh_body",
]
