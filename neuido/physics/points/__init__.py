"""Models without spatial discretisation: the point mass and the material point.

The names of `__all__` are imported when they are first used.
"""

from typing import TYPE_CHECKING

from neuido.physics.runtime.lazy import lazy_names

if TYPE_CHECKING:
    from neuido.physics.points.material_point import MODES, Specimen, stress_along
    from neuido.physics.points.point_mass import Forces, fly

__all__ = ["MODES", "Forces", "Specimen", "fly", "stress_along"]

__getattr__, __dir__ = lazy_names(
    __name__,
    {
        "neuido.physics.points.material_point": ("MODES", "Specimen", "stress_along"),
        "neuido.physics.points.point_mass": ("Forces", "fly"),
    },
)
