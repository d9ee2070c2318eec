"""Mechanics: laws, effects, the material point method, finite elements, springs and point masses. Knows torch and Warp, never Lightning."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from neuido.physics import colliders as colliders
    from neuido.physics import effects as effects
    from neuido.physics import laws as laws
    from neuido.physics.fem.finite_elements import FiniteElements as FiniteElements
    from neuido.physics.fem.meshing import Mesh as Mesh
    from neuido.physics.fem.meshing import mesh_body as mesh_body
    from neuido.physics.mpm.simulator import Simulator as Simulator
    from neuido.physics.runtime.frames import Frames as Frames
    from neuido.physics.springs.mass_spring import MassSpring as MassSpring

__all__ = [
    "FiniteElements",
    "Frames",
    "MassSpring",
    "Mesh",
    "Simulator",
    "colliders",
    "effects",
    "laws",
    "mesh_body",
]

_PLACES = {
    "FiniteElements": "fem.finite_elements:FiniteElements",
    "Frames": "runtime.frames:Frames",
    "MassSpring": "springs.mass_spring:MassSpring",
    "Mesh": "fem.meshing:Mesh",
    "Simulator": "mpm.simulator:Simulator",
    "colliders": "colliders",
    "effects": "effects",
    "laws": "laws",
    "mesh_body": "fem.meshing:mesh_body",
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
