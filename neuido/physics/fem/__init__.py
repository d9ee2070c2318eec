"""Explicit finite elements.

The names of `__all__` are imported when they are first used.
"""

from typing import TYPE_CHECKING

from neuido.physics.runtime.lazy import lazy_names

if TYPE_CHECKING:
    from neuido.physics.fem.finite_elements import FiniteElements
    from neuido.physics.fem.meshing import Mesh, mesh_body

__all__ = ["FiniteElements", "Mesh", "mesh_body"]

__getattr__, __dir__ = lazy_names(
    __name__,
    {
        "neuido.physics.fem.finite_elements": ("FiniteElements",),
        "neuido.physics.fem.meshing": ("Mesh", "mesh_body"),
    },
)
