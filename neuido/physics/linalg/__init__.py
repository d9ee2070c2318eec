"""Decompositions of 3x3 matrices with derivatives that are valid at repeated singular values, and nearest points.

The names of `__all__` are imported when they are first used.
"""

from typing import TYPE_CHECKING

from neuido.physics.runtime.lazy import lazy_names

if TYPE_CHECKING:
    from neuido.physics.linalg.decompositions import Frame, frame, isotropic_map, isotropic_stress, polar, svd
    from neuido.physics.linalg.nearest import nearest_by_pairs

__all__ = ["Frame", "frame", "isotropic_map", "isotropic_stress", "nearest_by_pairs", "polar", "svd"]

__getattr__, __dir__ = lazy_names(
    __name__,
    {
        "neuido.physics.linalg.decompositions": ("Frame", "frame", "isotropic_map", "isotropic_stress", "polar", "svd"),
        "neuido.physics.linalg.nearest": ("nearest_by_pairs",),
    },
)
