from .simulator import COURANT_LIMIT, Simulator, StepLimit
from .state import affine_velocity

__all__ = [
    "COURANT_LIMIT",
    "Simulator",
    "StepLimit",
    "affine_velocity",
]
