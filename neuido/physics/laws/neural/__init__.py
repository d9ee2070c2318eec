"""Learned laws: neural networks and polynomials.

The names of `__all__` are imported when they are first used.
"""

from typing import TYPE_CHECKING

from neuido.physics.runtime.lazy import lazy_names

if TYPE_CHECKING:
    from neuido.physics.laws.neural.bounded import BoundedElastic
    from neuido.physics.laws.neural.invariants import InvariantElastic, InvariantPlastic
    from neuido.physics.laws.neural.networks import ObjectiveElastic, ObjectivePlastic, RawElastic, RawPlastic
    from neuido.physics.laws.neural.symbolic import SymbolicElastic, SymbolicPlastic, formula

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

__getattr__, __dir__ = lazy_names(
    __name__,
    {
        "neuido.physics.laws.neural.bounded": ("BoundedElastic",),
        "neuido.physics.laws.neural.invariants": ("InvariantElastic", "InvariantPlastic"),
        "neuido.physics.laws.neural.networks": ("ObjectiveElastic", "ObjectivePlastic", "RawElastic", "RawPlastic"),
        "neuido.physics.laws.neural.symbolic": ("SymbolicElastic", "SymbolicPlastic", "formula"),
    },
)
