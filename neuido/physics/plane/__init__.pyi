from .plane_law import PlaneLaw
from .plane_specimen import PlaneMotion, PlaneSpecimen

__all__ = [
    "PlaneLaw",
    "PlaneMotion",
    "PlaneSpecimen",
]
