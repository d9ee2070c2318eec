from .bounded import BoundedElastic
from .invariants import InvariantElastic, InvariantPlastic
from .networks import ObjectiveElastic, ObjectivePlastic, RawElastic, RawPlastic
from .symbolic import SymbolicElastic, SymbolicPlastic, formula

__all__ = [
    "BoundedElastic",
    "InvariantElastic",
    "InvariantPlastic",
    "ObjectiveElastic",
    "ObjectivePlastic",
    "RawElastic",
    "RawPlastic",
    "SymbolicElastic",
    "SymbolicPlastic",
    "formula",
]
