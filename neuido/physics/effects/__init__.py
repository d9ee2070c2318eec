"""Physical effects beside a material law: forces, dissipation, inhomogeneity; each is a parameter that is zero when absent."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from neuido.physics.effects.entry import Entry as Entry
    from neuido.physics.effects.entry import Parameter as Parameter
    from neuido.physics.effects.library import LIBRARY as LIBRARY
    from neuido.physics.effects.parameters import Effects as Effects
    from neuido.physics.effects.parameters import ball_inclusion as ball_inclusion
    from neuido.physics.effects.parameters import linear_gradient as linear_gradient

__all__ = [
    "LIBRARY",
    "Effects",
    "Entry",
    "Parameter",
    "ball_inclusion",
    "linear_gradient",
]

_PLACES = {
    "Effects": "parameters:Effects",
    "Entry": "entry:Entry",
    "LIBRARY": "library:LIBRARY",
    "Parameter": "entry:Parameter",
    "ball_inclusion": "parameters:ball_inclusion",
    "linear_gradient": "parameters:linear_gradient",
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
