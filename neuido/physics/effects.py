"""Physical effects beyond the declared law: each is a parameter that is zero (here: None or 0) when the effect is absent.

Nested models are one model with parameters held at zero, so the gradient at zero is a score test for a candidate effect.
The rollout takes the parameters as differentiable inputs. Those here act as body forces on the grid or as viscous stress;
a collider's friction is an input of its own (`friction=` of the rollout). Effects of the law itself (yield, stiffening,
relaxation, fibres) get their place beside these when the closed loop is built.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from neuido.errors import UserError

Number = Tensor | float | None


class Effects(NamedTuple):
    """Parameters of the effects; each a float or a tensor of shape () or (S,), vectors (3,) or (S, 3). None: absent."""

    uniform_acceleration: Tensor | tuple[float, float, float] | None = None
    """An acceleration beside gravity, a tilt or a steady wind [m/s^2], (3,) or (S, 3)."""
    drag_linear: Number = None
    """c of the acceleration -c v [1/s]."""
    drag_quadratic: Number = None
    """k of the acceleration -k |v| v [1/m]."""
    position_force: Number = None
    """k of the acceleration -k (x - centre) [1/s^2], a pull to a place."""
    position_centre: Tensor | tuple[float, float, float] | None = None
    """That place [m], (3,) or (S, 3)."""
    viscosity_shear: Number = None
    """eta of Kelvin-Voigt's Cauchy stress 2 eta dev D [Pa s]."""
    viscosity_bulk: Number = None
    """zeta of Kelvin-Voigt's Cauchy stress zeta tr(D) I [Pa s]."""

    def acceleration(self, scene_count: int, like: Tensor) -> Tensor:
        """The uniform acceleration, (S, 3)."""
        return _rows(self.uniform_acceleration, scene_count, like, width=3, name="uniform_acceleration")

    def force_table(self, scene_count: int, like: Tensor) -> Tensor:
        """Columns linear drag, quadratic drag, pull, centre x, y, z, (S, 6), as `kernels.update_grid` reads them.

        Raises:
            UserError: A negative drag, or a shape that fits neither one scene nor all.
        """
        columns = [
            _rows(value, scene_count, like, name=name)
            for name, value in (
                ("drag_linear", self.drag_linear),
                ("drag_quadratic", self.drag_quadratic),
                ("position_force", self.position_force),
            )
        ]
        for name, column in zip(("drag_linear", "drag_quadratic"), columns):
            if bool((column < 0).any()):
                raise UserError(f"{name} is {column.min().item():g}; it must be zero or more")
        return torch.cat([*columns, _rows(self.position_centre, scene_count, like, width=3, name="position_centre")], dim=1)

    def viscosity(self, scene_count: int, like: Tensor) -> Tensor | None:
        """Columns shear and bulk viscosity, (S, 2), or None where neither is given (the rollout then skips them)."""
        if self.viscosity_shear is None and self.viscosity_bulk is None:
            return None
        shear = _rows(self.viscosity_shear, scene_count, like, name="viscosity_shear")
        bulk = _rows(self.viscosity_bulk, scene_count, like, name="viscosity_bulk")
        for name, column in (("viscosity_shear", shear), ("viscosity_bulk", bulk)):
            if bool((column < 0).any()):
                raise UserError(f"{name} is {column.min().item():g} Pa s; it must be zero or more")
        return torch.cat([shear, bulk], dim=1)


def _rows(value, scene_count: int, like: Tensor, *, width: int = 1, name: str) -> Tensor:
    """A parameter as (S, width), differentiable, in the type and on the device of `like`."""
    if value is None:
        return like.new_zeros(scene_count, width)
    rows = torch.as_tensor(value).to(like.device, like.dtype)
    shape = (1, width) if rows.numel() == width else (-1, width)
    rows = rows.reshape(shape)
    if rows.shape[0] not in (1, scene_count):
        raise UserError(f"{name} has {rows.shape[0]} rows for {scene_count} scenes; give one value or one for each scene")
    return rows.expand(scene_count, width)
