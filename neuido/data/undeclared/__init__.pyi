from .case import Case
from .making import make_undeclared

__all__ = [
    "Case",
    "make_undeclared",
]
