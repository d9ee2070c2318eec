"""Masses joined by springs.

The names of `__all__` are imported when they are first used.
"""

from typing import TYPE_CHECKING

from neuido.physics.runtime.lazy import lazy_names

if TYPE_CHECKING:
    from neuido.physics.springs.mass_spring import MassSpring, Springs, connect

__all__ = ["MassSpring", "Springs", "connect"]

__getattr__, __dir__ = lazy_names(
    __name__,
    {
        "neuido.physics.springs.mass_spring": ("MassSpring", "Springs", "connect"),
    },
)
