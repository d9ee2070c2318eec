"""Attachments: particles that springs and dampers, or rigid links, hold to places in space or on a solid collider.

Each particle takes a share of the stiffness and of the damping in proportion to its mass, so all of an attachment move alike. The spring
is integrated implicitly: any stiffness is stable, and a rigid link is its limit. It acts before the particles add to the grid, and the
collider receives what the particles lose. Where the collider is free, the implicit step counts with its mobility at the particle for the
mass of the whole attachment; a rigid link then closes an error within a few substeps instead of one.
"""

import functools
import math
from collections.abc import Sequence
from types import SimpleNamespace
from typing import NamedTuple

import torch
import warp as wp
from torch import Tensor

from neuido.errors import UserError
from neuido.physics.colliders.solid_contact import BODY, STATE, TWIST
from neuido.physics.colliders.solid_loop import SolidLoop
from neuido.physics.colliders.solid_tables import rotate, solid_inputs, solids_of
from neuido.physics.colliders.tables import inside_box
from neuido.physics.runtime.device import launch, launch_adjoint, real_of, start_warp
from neuido.physics.runtime.once import cached
from neuido.types import Attachment, Box, Scene, Skin

RIGID = -1.0
"""Rate that stands for a rigid link."""


class AttachmentTable(NamedTuple):
    """The A attachments of all scenes."""

    link: Tensor
    """Attachment of each particle, or -1, (P,) int32, in the order of the kernels."""
    anchor: Tensor
    """Place to which each particle is held [m], in space or in the axes of the collider, (P, 3) float64."""
    solid: Tensor
    """Number of the collider in its scene, or -1 for space, (A,) int32."""
    given: Tensor
    """Stiffness [N/m], infinite for a rigid link, and damping [N s/m], (A, 2) float64."""


def attachment_table(scenes: Sequence[Scene], x: Tensor, offsets: Sequence[int], order: Tensor) -> AttachmentTable | None:
    """Collect the attachments of scenes; None without any.

    Args:
        scenes: The scenes.
        x: Positions of the particles of all scenes [m], (P, 3).
        offsets: First particle of each scene, then their number.
        order: The order of the kernels, (P,).

    Raises:
        UserError: An attachment without particles, to an unknown collider, of a particle that another holds, or an impossible stiffness.
    """
    if not any(scene.attachments for scene in scenes):
        return None
    link = torch.full((len(x),), -1, dtype=torch.int32)
    anchor = x.detach().double().cpu().clone()
    solid, given = [], []
    for s, scene in enumerate(scenes):
        names = [own.name for own in solids_of(scene)]
        for i, own in enumerate(scene.attachments):
            where = f"attachments[{i}] of scene {s}"
            picked = _particles(own, anchor[offsets[s] : offsets[s + 1]], where) + offsets[s]
            if bool((link[picked] >= 0).any()):
                raise UserError(f"{where} holds a particle that another attachment holds; a particle takes one")
            if own.to and names.count(own.to) != 1:
                known = ", ".join(name for name in names if name) or "none has a name"
                raise UserError(f"{where} is to {own.to!r}, which is not the name of one solid collider; there are: {known}")
            if not (own.stiffness > 0 and own.damping >= 0 and math.isfinite(own.damping)):
                raise UserError(f"{where} has stiffness {own.stiffness} and damping {own.damping}; give a positive and one of zero or more")
            link[picked] = len(solid)
            solid.append(names.index(own.to) if own.to else -1)
            given.append([own.stiffness, own.damping])
            if own.point is not None:
                anchor[picked] = torch.tensor(own.point, dtype=torch.float64)
            if own.to:
                pose = solid_inputs([scene], 1, torch.device("cpu")).pose[0, solid[-1]]
                back = torch.cat([pose[3:4], -pose[4:]]).expand(len(picked), 4)
                anchor[picked] = rotate(back, anchor[picked] - pose[:3])
    where = x.device
    cpu_order = order.cpu()
    tables = link[cpu_order], anchor[cpu_order], torch.tensor(solid, dtype=torch.int32), torch.tensor(given, dtype=torch.float64)
    return AttachmentTable(*(t.contiguous().to(where) for t in tables))


def _particles(own: Attachment, x: Tensor, where: str) -> Tensor:
    """Return the indices of the particles of an attachment among those of its scene, (n,) int64."""
    chosen = own.particles
    if isinstance(chosen, Box):
        return inside_box(x, chosen, name=f"the box of {where}").nonzero()[:, 0]
    index = chosen.indices.flatten().unique().cpu() if isinstance(chosen, Skin) else torch.as_tensor(chosen).cpu()
    if index.ndim != 1 or not len(index) or index.dtype.is_floating_point or index.dtype == torch.bool:
        raise UserError(f"particles of {where} must be a Box, a Skin or whole numbers that are indices; got {type(chosen).__name__}")
    if int(index.min()) < 0 or int(index.max()) >= len(x) or len(index.unique()) != len(index):
        raise UserError(f"particles of {where} must be different indices from 0 to {len(x) - 1}")
    return index.long()


def rates(table: AttachmentTable, given: Tensor | None, mass: Tensor) -> Tensor:
    """Return stiffness and damping over the mass of each attachment [1/s^2, 1/s], and that mass [kg], (A, 3) float64.

    A rigid link has `RIGID` in place of its stiffness.

    Args:
        table: The attachments.
        given: Stiffness and damping in place of those of the table, (A, 2), or None.
        mass: Masses of the particles in the order of the kernels [kg], (P,); differentiable.
    """
    given = table.given if given is None else given.to(table.given)
    held = table.link >= 0
    total = torch.zeros(len(given), dtype=torch.float64, device=given.device)
    total = total.index_add(0, table.link[held].long(), mass[held].double())
    rigid = torch.isinf(given[:, 0])
    stiffness = torch.where(rigid, RIGID, torch.where(rigid, 1.0, given[:, 0]) / total)
    return torch.stack([stiffness, given[:, 1] / total, total], dim=1).contiguous()


@cached
def build(real: type) -> SimpleNamespace:
    """Return the kernel `hold`, without a loop, so that Warp's own adjoint is right."""
    start_warp()
    vec3 = wp.types.vector(length=3, dtype=real)
    state_vec = wp.types.vector(length=STATE, dtype=wp.float64)
    twist_vec = wp.types.vector(length=TWIST, dtype=wp.float64)
    body_vec = wp.types.vector(length=BODY, dtype=wp.float64)
    kernel = functools.partial(wp.kernel, module=f"neuido.attachments.{real.__name__}", enable_backward=True)
    f64 = wp.float64

    @kernel
    def hold(
        step: int,
        scene: wp.array(dtype=wp.int32),
        dt: wp.array(dtype=real),
        link: wp.array(dtype=wp.int32),
        anchor: wp.array(dtype=wp.vec3d),
        solid: wp.array(dtype=wp.int32),
        rate: wp.array2d(dtype=wp.float64),
        state: wp.array3d(dtype=state_vec),
        twist: wp.array3d(dtype=twist_vec),
        body: wp.array2d(dtype=body_vec),
        mass: wp.array(dtype=real),
        x: wp.array(dtype=vec3),
        v: wp.array(dtype=vec3),
        held: wp.array(dtype=vec3),
        impulse: wp.array3d(dtype=twist_vec),
    ):
        """Write the velocities after the attachments into `held`; add what particles lose to `impulse[step]` of their collider."""
        p = wp.tid()
        a = link[p]
        if a < 0:
            held[p] = v[p]
        else:
            s = scene[p]
            c = solid[a]
            h = f64(dt[s])
            at = wp.vec3d(f64(x[p][0]), f64(x[p][1]), f64(x[p][2]))
            u = wp.vec3d(f64(v[p][0]), f64(v[p][1]), f64(v[p][2]))
            goal = anchor[p]
            own = wp.vec3d(f64(0.0), f64(0.0), f64(0.0))
            origin = own
            both = f64(1.0)  # mobility of particle and collider over that of the particle
            if c >= 0:
                st = state[step, s, c]
                origin = wp.vec3d(st[0], st[1], st[2])
                arm = wp.quat_rotate(wp.quatd(st[4], st[5], st[6], st[3]), anchor[p])
                goal = origin + arm
                b = body[s, c]
                if b[0] > f64(0.0):
                    inverse = wp.inverse(wp.mat33d(b[1], b[2], b[3], b[4], b[5], b[6], b[7], b[8], b[9]))
                    both = both + rate[a, 2] * (f64(1.0) / b[0] + wp.dot(arm, arm) * wp.trace(inverse))
                    own = wp.vec3d(st[7], st[8], st[9]) + wp.cross(wp.vec3d(st[10], st[11], st[12]), arm)
                else:
                    t = twist[wp.min(step, twist.shape[0] - 1), s, c]
                    own = wp.vec3d(t[0], t[1], t[2]) + wp.cross(wp.vec3d(t[3], t[4], t[5]), arm)
            ahead = goal + h * own - at
            out = u + (ahead / h - u) / both
            if rate[a, 0] >= f64(0.0):
                k = h * rate[a, 0]
                d = h * rate[a, 1]
                out = u + (k * ahead + d * own - (d + h * k) * u) / (f64(1.0) + (d + h * k) * both)
            held[p] = vec3(real(out[0]), real(out[1]), real(out[2]))
            if c >= 0:
                J = f64(mass[p]) * (u - out)
                L = wp.cross(at - origin, J)
                wp.atomic_add(impulse, step, s, c, twist_vec(J[0], J[1], J[2], L[0], L[1], L[2]))

    return SimpleNamespace(hold=hold)


class AttachmentLoop:
    """The launches for the attachments of a rollout.

    Args:
        table: The attachments.
        scene: Scene of each particle, (P,).
        dt: Substep of each scene [s], (S,).
        rate: The result of `rates`.
        mass: Masses [kg], (P,).
        solids: The launches for the solids, or None.
    """

    def __init__(self, table: AttachmentTable, scene: Tensor, dt: Tensor, rate: Tensor, mass: Tensor, solids: SolidLoop | None) -> None:
        self.table, self.scene, self.dt, self.rate, self.mass, self.solids = table, scene, dt, rate, mass, solids
        self.kernel = build(real_of(dt.dtype)).hold
        self.held = torch.empty(len(scene), 3, dtype=dt.dtype, device=dt.device)

    def _inputs(self, n: int, x: Tensor, v: Tensor, impulse: Tensor | None) -> list:
        t, solids = self.table, self.solids
        moving = [None] * 3 if solids is None else [solids.tape.state, solids.twist, solids.body]
        return [n, self.scene, self.dt, t.link, t.anchor, t.solid, self.rate, *moving, self.mass, x, v, self.held, impulse]

    def hold(self, n: int, x: Tensor, v: Tensor, *, spare: bool = False) -> Tensor:
        """Return the velocities after the attachments in substep n, in memory that the next call overwrites.

        Args:
            n: Number of the substep.
            x: Positions [m], (P, 3).
            v: Velocities [m/s], (P, 3).
            spare: Do not record the impulses on colliders, since the forward pass did.
        """
        impulse = None if self.solids is None else self.solids.spare if spare else self.solids.tape.impulse
        launch(self.kernel, len(x), self._inputs(n, x, v, impulse), x.device)
        return self.held

    def adjoint(self, n: int, x: Tensor, v: Tensor, a_rate: Tensor, a_mass: Tensor, a_x: Tensor, a_v: Tensor) -> None:
        """Compute the adjoint of `hold`: add to a_rate, a_mass and a_x, and turn a_v into the adjoint of the velocities before."""
        solids = self.solids
        moving = [None] * 3 if solids is None else [solids.a_state, solids.a_twist, solids.a_body]
        impulse = None if solids is None else solids.tape.impulse
        a_impulse = None if solids is None else solids.a_impulse
        before = torch.zeros_like(a_v)
        adjoints = [*[None] * 6, a_rate, *moving, a_mass, a_x, before, a_v, a_impulse]
        launch_adjoint(self.kernel, len(x), self._inputs(n, x, v, impulse), adjoints, x.device)
        a_v.copy_(before)
