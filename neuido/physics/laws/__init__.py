"""Material laws: Kirchhoff stress and plastic correction as functions of the deformation gradient."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from neuido.physics.laws.base import AutogradElastic as AutogradElastic
    from neuido.physics.laws.base import AutogradPlastic as AutogradPlastic
    from neuido.physics.laws.base import ElasticLaw as ElasticLaw
    from neuido.physics.laws.base import PlasticLaw as PlasticLaw
    from neuido.physics.laws.classical import DruckerPrager as DruckerPrager
    from neuido.physics.laws.classical import FixedCorotated as FixedCorotated
    from neuido.physics.laws.classical import Identity as Identity
    from neuido.physics.laws.classical import NeoHookean as NeoHookean
    from neuido.physics.laws.classical import Sigma as Sigma
    from neuido.physics.laws.classical import VonMises as VonMises
    from neuido.physics.laws.classical import material as material
    from neuido.physics.laws.classical import stack as stack
    from neuido.physics.laws.composite import by_body as by_body
    from neuido.physics.laws.neural.bounded import BoundedElastic as BoundedElastic
    from neuido.physics.laws.neural.invariants import InvariantElastic as InvariantElastic
    from neuido.physics.laws.neural.invariants import InvariantPlastic as InvariantPlastic
    from neuido.physics.laws.neural.networks import ObjectiveElastic as ObjectiveElastic
    from neuido.physics.laws.neural.networks import ObjectivePlastic as ObjectivePlastic
    from neuido.physics.laws.neural.networks import RawElastic as RawElastic
    from neuido.physics.laws.neural.networks import RawPlastic as RawPlastic
    from neuido.physics.laws.neural.symbolic import SymbolicElastic as SymbolicElastic
    from neuido.physics.laws.neural.symbolic import SymbolicPlastic as SymbolicPlastic

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

_PLACES = {
    "AutogradElastic": "base:AutogradElastic",
    "AutogradPlastic": "base:AutogradPlastic",
    "BoundedElastic": "neural.bounded:BoundedElastic",
    "DruckerPrager": "classical:DruckerPrager",
    "ElasticLaw": "base:ElasticLaw",
    "FixedCorotated": "classical:FixedCorotated",
    "Identity": "classical:Identity",
    "InvariantElastic": "neural.invariants:InvariantElastic",
    "InvariantPlastic": "neural.invariants:InvariantPlastic",
    "NeoHookean": "classical:NeoHookean",
    "ObjectiveElastic": "neural.networks:ObjectiveElastic",
    "ObjectivePlastic": "neural.networks:ObjectivePlastic",
    "PlasticLaw": "base:PlasticLaw",
    "RawElastic": "neural.networks:RawElastic",
    "RawPlastic": "neural.networks:RawPlastic",
    "Sigma": "classical:Sigma",
    "SymbolicElastic": "neural.symbolic:SymbolicElastic",
    "SymbolicPlastic": "neural.symbolic:SymbolicPlastic",
    "VonMises": "classical:VonMises",
    "by_body": "composite:by_body",
    "material": "classical:material",
    "stack": "classical:stack",
}
"""Module of each public name below this package, and its name there; a module alone: the module itself."""


def __getattr__(name: str) -> Any:
    """Import a public name at its first use."""
    if name not in _PLACES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, _, own = _PLACES[name].partition(":")
    found = import_module(f"{__name__}.{module}")
    value = globals()[name] = getattr(found, own) if own else found
    return value


def __dir__() -> list[str]:
    """List the public names beside the module's own."""
    return sorted({*globals(), *__all__})
