"""Colliders, walls and clamps of a scene.

The names of `__all__` are imported when they are first used.
"""

from typing import TYPE_CHECKING

from neuido.physics.runtime.lazy import lazy_names

if TYPE_CHECKING:
    from neuido.physics.colliders.tables import ColliderTable, collider_table, planes_of

__all__ = ["ColliderTable", "collider_table", "planes_of"]

__getattr__, __dir__ = lazy_names(
    __name__,
    {
        "neuido.physics.colliders.tables": ("ColliderTable", "collider_table", "planes_of"),
    },
)
