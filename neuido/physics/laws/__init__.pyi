from .base import AutogradElastic, AutogradPlastic, ElasticLaw, PlasticLaw
from .classical import DruckerPrager, FixedCorotated, Identity, NeoHookean, Sigma, VonMises, material, stack
from .composite import by_body
from .neural.bounded import BoundedElastic
from .neural.invariants import InvariantElastic, InvariantPlastic
from .neural.networks import ObjectiveElastic, ObjectivePlastic, RawElastic, RawPlastic
from .neural.symbolic import SymbolicElastic, SymbolicPlastic

__all__ = [
    "AutogradElastic",
    "AutogradPlastic",
    "BoundedElastic",
    "DruckerPrager",
    "ElasticLaw",
    "FixedCorotated",
    "Identity",
    "InvariantElastic",
    "InvariantPlastic",
    "NeoHookean",
    "ObjectiveElastic",
    "ObjectivePlastic",
    "PlasticLaw",
    "RawElastic",
    "RawPlastic",
    "Sigma",
    "SymbolicElastic",
    "SymbolicPlastic",
    "VonMises",
    "by_body",
    "material",
    "stack",
]
