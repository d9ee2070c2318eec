"""Colliders, walls, clamps and attachments of a scene.

The names of `__all__` are imported when they are first used.
"""

from typing import TYPE_CHECKING

from neuido.physics.runtime.lazy import lazy_names

if TYPE_CHECKING:
    from neuido.physics.colliders.collider_frames import ColliderFrames
    from neuido.physics.colliders.solid_tables import SolidInputs
    from neuido.physics.colliders.solids import Capsule, Cuboid, Cylinder, HalfSpace, HeightField, MeshCollider, Sphere
    from neuido.physics.colliders.tables import ColliderTable, collider_table, planes_of

__all__ = [
    "Capsule",
    "ColliderFrames",
    "ColliderTable",
    "Cuboid",
    "Cylinder",
    "HalfSpace",
    "HeightField",
    "MeshCollider",
    "SolidInputs",
    "Sphere",
    "collider_table",
    "planes_of",
]

__getattr__, __dir__ = lazy_names(
    __name__,
    {
        "neuido.physics.colliders.collider_frames": ("ColliderFrames",),
        "neuido.physics.colliders.solid_tables": ("SolidInputs",),
        "neuido.physics.colliders.solids": ("Capsule", "Cuboid", "Cylinder", "HalfSpace", "HeightField", "MeshCollider", "Sphere"),
        "neuido.physics.colliders.tables": ("ColliderTable", "collider_table", "planes_of"),
    },
)
