"""A differentiable mass-spring model (Spring-Gaus, Zhong et al. 2024).

Here a spring acts on both of its ends, which conserves momentum. In Spring-Gaus each mass has a list of springs that pull at it alone.
"""

import math
from typing import Any, NamedTuple

import torch
from torch import Tensor

from neuido.errors import UserError
from neuido.physics.colliders.contact import SLIP, STICKY
from neuido.physics.colliders.solid_tables import refuse_solids
from neuido.physics.colliders.tables import collider_table
from neuido.physics.runtime.device import real_of, repeated, torch_stream
from neuido.physics.runtime.limits import check_frames, check_memory
from neuido.physics.springs import spring_kernels
from neuido.types import Scene, brief_fields

SAFETY = 0.5
"""Largest step of a rollout, relative to the largest stable step [-]."""

BLOCK = 32
"""Threads per block; small blocks, since the masses are few and more blocks use more of the GPU."""

LANES = 32
"""Number of threads that share the springs of a mass on a GPU."""


class Springs(NamedTuple):
    """N springs between A masses."""

    pairs: Tensor
    """Masses at the two ends, the smaller index first, (N, 2) int64."""
    rest: Tensor
    """Rest length [m], (N,)."""
    rank: Tensor
    """Rank of one end among the neighbours of the other, 0 for the nearest; the smaller of both directions, (N,) int64."""

    def __repr__(self) -> str:
        return brief_fields(self)


def connect(x: Tensor, neighbours: int) -> Springs:
    """Connect each mass to its nearest neighbours by springs that are at rest at the given positions.

    Args:
        x: Positions [m], (A, 3).
        neighbours: Number of neighbours of each mass; two masses that are neighbours of each other get one spring.

    Raises:
        UserError: Fewer than two masses, or fewer than one neighbour.
    """
    if len(x) < 2 or neighbours < 1:
        raise UserError(f"{len(x)} masses with {neighbours} neighbours each; give at least two masses and one neighbour")
    points, k = x.detach().double(), min(neighbours, len(x) - 1)
    near = torch.cat([torch.cdist(part, points).topk(k + 1, largest=False).indices for part in points.split(2048)])
    own = torch.arange(len(x), device=x.device)[:, None].expand_as(near)
    ends = torch.stack([own, near], -1).flatten(0, 1)
    rank = torch.arange(-1, k, device=x.device).clamp(min=0).expand_as(near).flatten()
    other = ends[:, 0] != ends[:, 1]
    pairs, which = ends[other].sort(1).values.unique(dim=0, return_inverse=True)
    least = torch.full((len(pairs),), k, device=x.device).scatter_reduce(0, which, rank[other], "amin")
    length = (points[pairs[:, 1]] - points[pairs[:, 0]]).norm(dim=1)
    apart = length > 1e-6 * length.mean()  # no spring between two masses at one position
    return Springs(pairs[apart], length[apart], least[apart])


class MassSpring:
    """Simulate a body of masses and springs under the gravity and with the colliders of a scene.

    Args:
        scene: Gravity, colliders and walls; their friction is replaced by `grip` of the rollout.
        springs: The springs, from `connect`.
        mass: Masses [kg], (A,).
        power: Exponent p of the spring force (`spring_kernels`); Spring-Gaus: 0.5, Hooke: 0.
        dtype: `torch.float32` for production, `torch.float64` for gradient checks.

    Raises:
        UserError: A mass that is not positive, or a negative power.
    """

    def __init__(self, scene: Scene, springs: Springs, mass: Tensor, *, power: float = 0.5, dtype: torch.dtype = torch.float32):
        if not bool((mass > 0).all()) or power < 0:
            raise UserError(
                f"mass-spring: the least mass is {float(mass.min()):g} kg and power is {power}; give masses above 0, power >= 0"
            )
        self.device, self.power = mass.device, float(power)
        self.pairs, self.rest, self.mass = springs.pairs, springs.rest.to(dtype), mass.to(dtype).contiguous()
        refuse_solids([scene], "MassSpring")
        table = collider_table([scene], dtype, self.device)
        self.planes, self.kinds = table.plane[0].contiguous(), table.kind[0].contiguous()
        self.gravity = tuple(float(g) for g in scene.gravity)
        self.kernels = spring_kernels.build(real_of(dtype))
        self.lanes = LANES if self.device.type == "cuda" else 1
        ends = torch.cat([self.pairs, self.pairs.flip(1)])
        order = torch.argsort(ends[:, 0], stable=True)
        counts = torch.bincount(ends[:, 0], minlength=len(mass))
        self.offsets = torch.cat([counts.new_zeros(1), counts.cumsum(0)]).int()
        self.others = ends[order, 1].int().contiguous()
        self.springs = torch.arange(len(self.pairs), device=self.device).repeat(2)[order].int().contiguous()

    def __repr__(self) -> str:
        kind = f"{str(self.mass.dtype).removeprefix('torch.')} on {self.device}"
        return f"MassSpring({len(self.mass)} masses, {len(self.pairs)} springs, power {self.power:g}, {kind})"

    def substeps(self, stiffness: Tensor, damping: Tensor, dt: float) -> int:
        """Return into how many stable steps a step must be divided.

        The bound is `SAFETY` times the stable step for Gershgorin's bound of the frequencies and of the damping.

        Args:
            stiffness: k of each spring [N/m], (N,).
            damping: c of each spring [N s/m], (N,).
            dt: The step to divide [s].

        Raises:
            UserError: A stiffness or damping that is not finite.
        """
        with torch.no_grad():
            both = torch.stack([stiffness, damping], 1).to(self.mass)
            sums = torch.zeros(len(self.mass), 2, dtype=both.dtype, device=self.device)
            for end in self.pairs.T:
                sums.index_add_(0, end, both)
            spring, loss = (2 * sums / self.mass[:, None]).amax(0).double().tolist()
        if not math.isfinite(spring + loss):
            raise UserError("mass-spring: a stiffness or damping is not finite; lower the learning rate")
        limit = SAFETY * 2 / (spring**0.5 + loss + 1e-30)  # dt^2 w^2 + 2 dt c < 4 and a little less
        return max(1, math.ceil(dt / limit))

    def rollout(
        self, steps: int, dt: float, x: Tensor, v: Tensor, stiffness: Tensor, damping: Tensor, grip: Tensor, *, every: int = 1
    ) -> tuple[Tensor, Tensor]:
        """Simulate `steps` steps; differentiable with respect to all tensors.

        Args:
            steps: Number of steps, a multiple of `every`.
            dt: Step [s].
            x: Initial positions [m], (A, 3).
            v: Initial velocities [m/s], (A, 3).
            stiffness: k of each spring [N/m], (N,).
            damping: c of each spring [N s/m], (N,).
            grip: Factor on the tangential velocity in each step of contact [-], ().
            every: Steps between two frames.

        Returns:
            Frames of x [m] and v [m/s], (K, A, 3) each, K = steps / every + 1; frame 0 is the initial state.

        Raises:
            UserError: A motion that is not finite, or steps that are not a multiple of `every`.
        """
        check_frames(steps, every)
        needed = 3 * (steps + 1) * x.numel() * x.element_size()  # positions, velocities, velocities before contact
        check_memory(needed, x.device, f"a rollout of {len(x)} masses over {steps} steps", "lower `steps`")
        start = [t.to(self.mass).contiguous() for t in (x, v, stiffness, damping, grip.reshape(1))]
        xs, vs = _Rollout.apply(self, steps, float(dt), *start)
        if not bool(torch.isfinite(xs[-1]).all()):
            raise UserError(f"mass-spring: the motion is not finite after {steps} steps of {dt:g} s; lower the step or the stiffness")
        return xs[::every], vs[::every]

    def energy(self, x: Tensor, v: Tensor, stiffness: Tensor) -> Tensor:
        """Return the sum of kinetic, elastic (Hooke's law) and potential energy [J], (...).

        Args:
            x: Positions [m], (..., A, 3).
            v: Velocities [m/s], (..., A, 3).
            stiffness: k of each spring [N/m], (N,).
        """
        length = (x[..., self.pairs[:, 1], :] - x[..., self.pairs[:, 0], :]).norm(dim=-1)
        elastic = 0.5 * (stiffness * (length - self.rest).square()).sum(-1)
        height = (x * x.new_tensor(self.gravity)).sum(-1)
        return (self.mass * (0.5 * v.square().sum(-1) - height)).sum(-1) + elastic

    def reference_step(self, x: Tensor, v: Tensor, stiffness: Tensor, damping: Tensor, grip: Tensor, dt: float) -> tuple[Tensor, Tensor]:
        """Simulate one step in plain torch, for tests of the kernels; returns x and v, (A, 3) each."""
        i, j = self.pairs.T
        delta, speed = x[j] - x[i], v[j] - v[i]
        length = delta.norm(dim=1).clamp(min=spring_kernels.SHORTEST)
        d = delta / length[:, None]
        pull = stiffness * (length - self.rest) * (1 + (length / self.rest - 1).abs()) ** self.power
        force = (pull + damping * (speed * d).sum(1))[:, None] * d
        total = torch.zeros_like(x).index_add(0, i, force).index_add(0, j, -force)
        v = v + dt * (x.new_tensor(self.gravity) + total / self.mass[:, None])
        x = x + dt * v
        for plane, kind in zip(self.planes, self.kinds.tolist()):
            n = plane[:3]
            depth, along = plane[3] - x @ n, v @ n
            inside = ((depth >= 0) & (kind != 0))[:, None]
            rest = v - along[:, None] * n
            slowed = {STICKY: torch.zeros_like(v), SLIP: rest}.get(kind, grip * rest + along.clamp(min=0)[:, None] * n)
            x, v = torch.where(inside, x + depth[:, None] * n, x), torch.where(inside, slowed, v)
        return x, v


class _Rollout(torch.autograd.Function):
    """Map the initial state and the parameters to x and v of every step, (steps + 1, A, 3) each."""

    @staticmethod
    def forward(ctx: Any, body: MassSpring, steps: int, dt: float, x: Tensor, v: Tensor, *parameters: Tensor) -> tuple[Tensor, Tensor]:
        xs, vs = x.new_empty(steps + 1, *x.shape), v.new_empty(steps + 1, *v.shape)
        before, parts = v.new_empty(steps, *v.shape), v.new_empty(len(v) * body.lanes, 3)
        left_out = torch.zeros_like(v) if v.dtype == torch.float32 else None
        xs[0], vs[0] = x.detach(), v.detach()
        stiffness, damping, grip = (p.detach() for p in parameters)
        springs = [body.power, body.offsets, body.others, body.springs, body.rest, stiffness, damping]
        masses = [dt, body.kernels.vec3(*body.gravity), body.mass, body.planes, body.kinds, grip]
        now = [xs, vs, body.lanes, parts]
        with torch_stream(body.device):
            pull = repeated(body.kernels.pull, len(parts), [*springs, *now], body.device, block=BLOCK)
            move = repeated(body.kernels.move, len(x), [*masses, *now, before, left_out], body.device, block=BLOCK)
            for n in range(steps):
                pull(n)
                move(n)
        ctx.body, ctx.dt = body, dt
        ctx.save_for_backward(xs, vs, before, stiffness, damping, grip)
        return xs, vs

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad_x: Tensor, grad_v: Tensor) -> tuple[Tensor | None, ...]:
        body, dt = ctx.body, ctx.dt
        xs, vs, before, stiffness, damping, grip = ctx.saved_tensors
        grad_x, grad_v = grad_x.contiguous(), grad_v.contiguous()
        g_stiffness, g_damping, g_grip = torch.zeros_like(stiffness), torch.zeros_like(damping), torch.zeros_like(body.mass)
        back, force = [grad_x[-1].clone(), grad_v[-1].clone()], torch.empty_like(xs[0])
        parts = [xs.new_empty(len(force) * body.lanes, 3) for _ in range(2)]
        springs = [body.power, body.offsets, body.others, body.springs, body.rest, stiffness, damping]
        contact = [dt, body.mass, body.planes, body.kinds, grip, xs, before, *back, force, g_grip]
        pulled = [*springs, xs, vs, force, body.lanes, *parts, g_stiffness, g_damping]
        gathered = [body.lanes, *parts, grad_x, grad_v, *back]
        with torch_stream(body.device):
            touch = repeated(body.kernels.contact_adjoint, len(force), contact, body.device, block=BLOCK)
            pull = repeated(body.kernels.pull_adjoint, len(parts[0]), pulled, body.device, block=BLOCK)
            gather = repeated(body.kernels.gather, len(force), gathered, body.device, block=BLOCK)
            for n in reversed(range(len(before))):
                touch(n)
                pull(n)
                gather(n)
        return None, None, None, *back, g_stiffness, g_damping, g_grip.sum().reshape(1)
