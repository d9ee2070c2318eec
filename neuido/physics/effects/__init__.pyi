from .entry import Entry, Parameter
from .library import LIBRARY
from .parameters import Effects, ball_inclusion, linear_gradient

__all__ = [
    "LIBRARY",
    "Effects",
    "Entry",
    "Parameter",
    "ball_inclusion",
    "linear_gradient",
]
