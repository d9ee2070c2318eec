from .base import AutogradElastic, AutogradPlastic, ElasticLaw, PlasticLaw
from .classical import DruckerPrager, FixedCorotated, Identity, NeoHookean, Sigma, VonMises, material, stack
from .composite import by_body
from .hyperelastic import Fluid, Gent, Hyperfoam, MooneyRivlin
from .neural.bounded import BoundedElastic
from .neural.invariants import InvariantElastic, InvariantPlastic
from .neural.networks import ObjectiveElastic, ObjectivePlastic, RawElastic, RawPlastic
from .neural.symbolic import SymbolicElastic, SymbolicPlastic
from .resets import Snow, VolumetricReset

__all__ = [
    "AutogradElastic",
    "AutogradPlastic",
    "BoundedElastic",
    "DruckerPrager",
    "ElasticLaw",
    "FixedCorotated",
    "Fluid",
    "Gent",
    "Hyperfoam",
    "Identity",
    "InvariantElastic",
    "InvariantPlastic",
    "MooneyRivlin",
    "NeoHookean",
    "ObjectiveElastic",
    "ObjectivePlastic",
    "PlasticLaw",
    "RawElastic",
    "RawPlastic",
    "Sigma",
    "Snow",
    "SymbolicElastic",
    "SymbolicPlastic",
    "VolumetricReset",
    "VonMises",
    "by_body",
    "material",
    "stack",
]
