from .collider_frames import ColliderFrames
from .solid_tables import SolidInputs
from .solids import Capsule, Cuboid, Cylinder, Grip, HalfSpace, HeightField, MeshCollider, Sphere
from .tables import ColliderTable, collider_table, planes_of

__all__ = [
    "Capsule",
    "ColliderFrames",
    "ColliderTable",
    "Cuboid",
    "Cylinder",
    "Grip",
    "HalfSpace",
    "HeightField",
    "MeshCollider",
    "SolidInputs",
    "Sphere",
    "collider_table",
    "planes_of",
]
