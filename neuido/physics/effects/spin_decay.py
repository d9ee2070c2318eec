"""The launches of a torque that damps the rotation of a body (`spin_kernels`), shared by the material point method and finite elements."""

import torch
from torch import Tensor

from neuido.physics.effects import spin_kernels
from neuido.physics.runtime.device import launch, real_of

LANES = 64
"""Threads that sum over the particles of a scene on a GPU; one on the CPU."""


class SpinDecay:
    """Damp the rotation of the body of each of S scenes, with memory of its own.

    Args:
        scene: Scene of each particle or node, (P,) int32.
        first: First particle of each scene, then their number, (S + 1,) int32; a scene's particles are consecutive.
        spread: Moment that a particle of unit mass has within itself along each axis, dx^2/4 [m^2], (S,).
        inside: Whether the particles rotate within themselves, with an affine velocity C.
    """

    def __init__(self, scene: Tensor, first: Tensor, spread: Tensor, *, inside: bool) -> None:
        self.scene, self.first, self.spread, self.inside = scene, first, spread, inside
        self.count, self.lanes = len(first) - 1, 1 if scene.device.type == "cpu" else LANES
        self.kernels = spin_kernels.build(real_of(spread.dtype))
        self.partial = self._rows(self.count * self.lanes, spin_kernels.MOMENTS)
        self.state = self._rows(self.count, spin_kernels.STATE)

    def _rows(self, count: int, width: int) -> Tensor:
        return torch.empty(count, width, dtype=torch.float64, device=self.scene.device)

    def _launch(self, kernel, dim: int, *arguments) -> None:
        launch(kernel, dim, arguments, self.scene.device)

    def damp(
        self,
        loss: Tensor,
        mass: Tensor,
        x: Tensor,
        v: Tensor,
        C: Tensor | None,
        v_out: Tensor,
        C_out: Tensor | None,
        *,
        every: bool = False,
    ) -> None:
        """Write v and C after the torque of a substep.

        Scenes without a loss cost next to nothing: launches that serve every set of effects have many of them.

        Args:
            loss: `Effects.spin_loss` [-], (S, 1).
            mass: Masses [kg], (P,).
            x: Positions [m], (P, 3).
            v: Velocities [m/s], (P, 3).
            C: Affine velocities [1/s], (P, 3, 3), or None for nodes.
            v_out: Velocities after the torque; may be v.
            C_out: Affine velocities after the torque; may be C.
            every: Find the rotation of scenes without a loss too, as `adjoint` needs it.
        """
        k, rows = self.kernels, self.count * self.lanes
        self._launch(k.sum_moments, rows, self.first, self.lanes, loss, every, mass, self.spread, x, v, C, self.partial)
        self._launch(k.find_spin, self.count, self.lanes, loss, every, self.spread, self.inside, self.partial, self.state)
        self._launch(k.damp_spin, len(x), self.scene, loss, self.state, x, v, C, v_out, C_out)

    def adjoint(
        self, loss: Tensor, mass: Tensor, x: Tensor, v: Tensor, C: Tensor,
        a_loss: Tensor, a_mass: Tensor, a_x: Tensor, a_v: Tensor, a_C: Tensor,
    ) -> None:  # fmt: skip
        """Compute the adjoint of `damp`, for the same state of which `damp` ran last, with `every`.

        Adds to a_loss, a_mass and a_x; turns a_v and a_C from the adjoints after the torque into those before it.
        """
        k, rows = self.kernels, self.count * self.lanes
        partial, found = self._rows(rows, spin_kernels.ADJOINT_SUMS), self._rows(self.count, spin_kernels.ADJOINT_STATE)
        self._launch(k.sum_spin_adjoint, rows, self.first, self.lanes, self.state, x, a_v, a_C, partial)
        self._launch(k.find_spin_adjoint, self.count, self.lanes, loss, self.state, partial, found, a_loss)
        self._launch(k.damp_spin_adjoint, len(x), self.scene, mass, self.spread, loss, self.state, found, x, v, C, a_mass, a_x, a_v, a_C)
