"""The material point method.

The names of `__all__` are imported when they are first used.
"""

from typing import TYPE_CHECKING

from neuido.physics.runtime.lazy import lazy_names

if TYPE_CHECKING:
    from neuido.physics.mpm.simulator import COURANT_LIMIT, Simulator, StepLimit
    from neuido.physics.mpm.state import affine_velocity

__all__ = ["COURANT_LIMIT", "Simulator", "StepLimit", "affine_velocity"]

__getattr__, __dir__ = lazy_names(
    __name__,
    {
        "neuido.physics.mpm.simulator": ("COURANT_LIMIT", "Simulator", "StepLimit"),
        "neuido.physics.mpm.state": ("affine_velocity",),
    },
)
