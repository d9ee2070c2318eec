"""Particles that leave the domain: deleted, or clamped to its faces.

What happens to a particle follows from its position alone. A deleted particle stays where it was first outside, at rest, and has neither
mass nor stress on the grid; one at a face has no velocity outwards on the grid, and its position stays within the faces. A state that is
carried on, between segments or by the user, therefore carries this on too.
"""

from types import SimpleNamespace
from typing import Literal

import torch
import warp as wp
from torch import Tensor

from neuido.errors import UserError
from neuido.physics.runtime.device import launch, real_of, start_warp
from neuido.physics.runtime.once import cached
from neuido.types import Scene

OnLeave = Literal["error", "clamp", "delete"]


def checked_on_leave(value: str) -> str:
    """Validate the option `on_leave`, and return it.

    Raises:
        UserError: None of error, clamp and delete.
    """
    if value not in ("error", "clamp", "delete"):
        raise UserError(f"on_leave is {value!r}; choose error, clamp or delete")
    return value


@cached
def build(real: type) -> SimpleNamespace:
    """Return the kernels for one scalar type, compiled at their first launch."""
    start_warp()
    vec3 = wp.types.vector(length=3, dtype=real)
    mat33 = wp.types.matrix(shape=(3, 3), dtype=real)
    module = f"neuido.leaving.{real.__name__}"

    @wp.func(module=module)
    def outside(x: vec3, lower: vec3, upper: vec3):
        gone = False
        for a in range(3):
            if not (x[a] >= lower[a] and x[a] <= upper[a]):
                gone = True
        return gone

    @wp.kernel(module=module, enable_backward=False)
    def take_out(
        scene: wp.array(dtype=wp.int32),
        lower: wp.array(dtype=vec3),
        upper: wp.array(dtype=vec3),
        held: wp.array(dtype=wp.uint8),
        x: wp.array(dtype=vec3),
        mass: wp.array(dtype=real),
        present_mass: wp.array(dtype=real),
        frozen: wp.array(dtype=wp.uint8),
        tau: wp.array(dtype=mat33),
    ):
        """Write the mass of the particles, 0 outside the domain, and whether they are held; set tau outside to 0."""
        p = wp.tid()
        s = scene[p]
        if outside(x[p], lower[s], upper[s]):
            present_mass[p] = real(0.0)
            frozen[p] = wp.uint8(1)
            tau[p] = real(0.0) * wp.identity(n=3, dtype=real)
        else:
            present_mass[p] = mass[p]
            frozen[p] = held[p]

    @wp.kernel(module=module, enable_backward=False)
    def stop(
        scene: wp.array(dtype=wp.int32),
        lower: wp.array(dtype=vec3),
        upper: wp.array(dtype=vec3),
        x: wp.array(dtype=vec3),
        v: wp.array(dtype=vec3),
        inward: wp.array(dtype=vec3),
    ):
        """Write the velocities, without the part that points outwards at a face."""
        p = wp.tid()
        s = scene[p]
        out = v[p]
        for a in range(3):
            if (x[p][a] <= lower[s][a] and out[a] < real(0.0)) or (x[p][a] >= upper[s][a] and out[a] > real(0.0)):
                out[a] = real(0.0)
        inward[p] = out

    @wp.kernel(module=module, enable_backward=False)
    def stay(scene: wp.array(dtype=wp.int32), lower: wp.array(dtype=vec3), upper: wp.array(dtype=vec3), x: wp.array(dtype=vec3)):
        """Move the particles to within the faces."""
        p = wp.tid()
        s = scene[p]
        y = x[p]
        for a in range(3):
            y[a] = wp.clamp(y[a], lower[s][a], upper[s][a])
        x[p] = y

    return SimpleNamespace(take_out=take_out, stop=stop, stay=stay)


class Leaving:
    """The launches for particles that leave, and their memory.

    Args:
        mode: `clamp` or `delete`.
        scenes: S scenes.
        scene: The scene of each particle, (P,) int32.
        held: Particles that are held at rest, (P,) uint8, in the order of the kernels.
        mass: A tensor of their masses, for its dtype and device, (P,).
    """

    def __init__(self, mode: str, scenes: tuple[Scene, ...], scene: Tensor, held: Tensor, mass: Tensor) -> None:
        self.mode, self.scene, self.own_held = mode, scene, held
        corners = [[own.lower for own in scenes], [own.upper for own in scenes]]
        self.lower, self.upper = torch.tensor(corners, dtype=torch.float64).to(mass.device, mass.dtype)
        self.kernels = build(real_of(mass.dtype))
        self.mass, self.held = torch.zeros_like(mass), held.clone()
        self.v = mass.new_zeros(len(mass), 3)

    def _launch(self, kernel: wp.Kernel, x: Tensor, arguments: list) -> None:
        launch(kernel, len(x), [self.scene, self.lower, self.upper, *arguments], x.device)

    def enter(self, x: Tensor, v: Tensor, mass: Tensor, tau: Tensor) -> tuple[Tensor, Tensor]:
        """Return the velocities and the masses that the grid receives from particles at x; tau of deleted particles becomes 0."""
        if self.mode == "clamp":
            self._launch(self.kernels.stop, x, [x, v, self.v])
        else:
            self._launch(self.kernels.take_out, x, [self.own_held, x, mass, self.mass, self.held, tau])
        return self.entered(v, mass)

    def entered(self, v: Tensor, mass: Tensor) -> tuple[Tensor, Tensor]:
        """Return what the last `enter` returned for the velocities v and masses."""
        return (self.v, mass) if self.mode == "clamp" else (v, self.mass)

    def end(self, x: Tensor) -> None:
        """Keep the positions after a substep within the faces."""
        if self.mode == "clamp":
            self._launch(self.kernels.stay, x, [x])

    def end_adjoint(self, x: Tensor, a_x: Tensor) -> None:
        """Take the gradient with respect to clamped positions x after a substep out of a_x."""
        if self.mode == "clamp":
            a_x.masked_fill_((x <= self._at(self.lower)) | (x >= self._at(self.upper)), 0.0)

    def enter_adjoint(self, x: Tensor, v: Tensor, a_v: Tensor, a_tau: Tensor, a_mass: Tensor, mass_before: Tensor) -> None:
        """Correct the gradients of what the grid received.

        Args:
            x: Positions before the substep [m], (P, 3).
            v: Velocities before the substep [m/s], (P, 3).
            a_v: Gradient with respect to the velocities that the grid received; overwritten.
            a_tau: Gradient with respect to the stress; overwritten.
            a_mass: Gradient with respect to the masses, summed over the substeps; overwritten.
            mass_before: The same before this substep was added.
        """
        low, high = x <= self._at(self.lower), x >= self._at(self.upper)
        if self.mode == "clamp":
            a_v.masked_fill_((low & (v < 0)) | (high & (v > 0)), 0.0)
            return
        gone = self.outside(x)
        a_tau.masked_fill_(gone[:, None, None], 0.0)
        a_mass.copy_(torch.where(gone, mass_before, a_mass))

    def outside(self, x: Tensor) -> Tensor:
        """Return which particles lie outside the domain, (..., P) bool."""
        return ~((x >= self._at(self.lower)) & (x <= self._at(self.upper))).all(dim=-1)

    def _at(self, corner: Tensor) -> Tensor:
        return corner[self.scene.long()]

    def first_frames(self, x: Tensor) -> Tensor:
        """Return the first frame of x (K, P, 3) in which each particle is outside, or at a face where it was clamped; -1: none, (P,)."""
        first = torch.full((x.shape[1],), -1, dtype=torch.int32, device=x.device)
        for k, at in enumerate(x.detach()):
            seen = self.outside(at) if self.mode == "delete" else ((at <= self._at(self.lower)) | (at >= self._at(self.upper))).any(dim=-1)
            first = torch.where(seen & (first < 0), k, first)
        return first
