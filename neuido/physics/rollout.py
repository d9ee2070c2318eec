"""The loops of a rollout, forward and backward: launches alone, so that they run eagerly or inside a CUDA graph.

The forward pass leaves a tape: x, v, C and F of every substep, and where there is room stress and nodal momentum. The
backward pass recomputes what the tape lacks and applies the hand-written adjoints of `kernels.py`, `grid_kernels.py` and of
the laws, last substep first. One `torch.autograd.Function` spans the whole rollout.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
import warp as wp
from torch import Tensor

from neuido.errors import UserError
from neuido.physics import kernels
from neuido.physics.device import launch, torch_stream
from neuido.physics.law import ElasticLaw, Engine, PlasticLaw
from neuido.physics.threads import Scenes, ThreadedRollout

if TYPE_CHECKING:
    from neuido.physics.mpm import Simulator

FIXED = 9
"""Inputs before the tensors of the laws: x, v, C, F, mass, pull, force, friction, viscosity."""

LARGE = 1 << 17
"""Particles above which blocks of 256 threads do as well as blocks of 32 on a GPU; smaller bodies need more blocks to fill it."""


class Tape(NamedTuple):
    """What a forward pass writes; K frames, of every substep where a backward pass follows."""

    x: Tensor
    v: Tensor
    C: Tensor
    F: Tensor
    status: Tensor
    """Code, particle and substep of the first failure, (3,) int32."""
    tau: Tensor | None
    """Stress of each substep, (T, P, 3, 3), or None."""
    trial: Tensor | None
    """Trial deformation gradient of each substep, (T, P, 3, 3), or None."""
    grid: Tensor | None
    """Nodal momentum and mass of each substep, (T, nodes, 4), or None."""
    velocity: Tensor | None
    """Nodal velocity of each substep, (T, nodes, 4), or None."""

    @property
    def states(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        return self[:4]


class Plan:
    """What one rollout does, without its differentiable inputs.

    Args:
        simulator: Scenes, bodies and buffers.
        elasticity: Elastic law.
        plasticity: Plastic law or None.
        steps: Substeps.
        every: Substeps between frames.
    """

    def __init__(self, simulator: "Simulator", elasticity: ElasticLaw, plasticity: PlasticLaw | None, steps: int, every: int) -> None:
        self.simulator, self.elasticity, self.steps, self.every = simulator, elasticity, steps, every
        self.plasticity = None if plasticity is None or plasticity.identity else plasticity
        self.block = 32 if len(simulator.mass) < LARGE else 256

    def law_tensors(self) -> tuple[Tensor, ...]:
        """Those of both laws, the elastic ones first."""
        elastic = self.elasticity.tensors()
        self.split = FIXED + len(elastic)
        return (*elastic, *(() if self.plasticity is None else self.plasticity.tensors()))

    def key(self, inputs: Sequence[Tensor]) -> tuple | None:
        """What, beside the shapes of the inputs, decides the launches; None where they may not be captured."""
        elastic = self.elasticity.key(inputs[FIXED : self.split])
        plastic = "none" if self.plasticity is None else self.plasticity.key(inputs[self.split :])
        return None if elastic is None or plastic is None else (self.steps, self.every, elastic, plastic)

    def engines(self, inputs: Sequence[Tensor]) -> tuple[Engine, Engine | None]:
        particles = self.simulator.particles
        plastic = None if self.plasticity is None else self.plasticity.engine(inputs[self.split :], particles)
        return self.elasticity.engine(inputs[FIXED : self.split], particles), plastic

    def alone(self, s: int) -> "Plan":
        """The plan of one scene."""
        plastic = None if self.plasticity is None else self.plasticity.alone(s)
        plan = Plan(self.simulator.alone(s), self.elasticity.alone(s), plastic, self.steps, self.every)
        plan.split = self.split
        return plan

    def launch(self, kernel: wp.Kernel, dim: int, inputs: list, block: int = 256) -> None:
        launch(kernel, dim, inputs, self.simulator.device, block=block)

    # Forward.

    def tape(self, keep_all: bool) -> Tape:
        """Empty memory for a forward pass; `keep_all`: of every substep, for a backward pass."""
        sim = self.simulator
        count = self.steps if keep_all else self.steps // self.every
        states = (t.new_empty(count + 1, *t.shape) for t in sim.state)
        status = torch.zeros(3, dtype=torch.int32, device=sim.device)
        more = keep_all and sim.keep_grid
        tau = sim.state.F.new_empty(self.steps, *sim.state.F.shape) if more else None
        trial = torch.empty_like(tau) if tau is not None and self.plasticity is not None else None
        nodal = [sim.mass.new_empty(self.steps, sim.node_count, 4) if more else None for _ in range(2)]
        return Tape(*states, status, tau, trial, *nodal)

    def forward(self, inputs: Sequence[Tensor], tape: Tape, steps: int | None = None) -> None:
        """Launch the substeps (all, or the first `steps`); checks nothing."""
        sim = self.simulator
        mass, pull, force, friction, viscosity = inputs[4:FIXED]
        stride = self.steps // (len(tape.x) - 1)
        for frame, t in zip(tape.states, inputs):
            frame[0] = t
        now = tuple(frame[0] for frame in tape.states)
        spare = [tuple(torch.empty_like(t) for t in now) for _ in range(2)] if stride > 1 else []
        scratch, other = torch.empty_like(now[3]), torch.empty_like(now[3])
        tape.status.zero_()
        with torch_stream(sim.device):
            elastic, plastic = self.engines(inputs)
            for n in range(self.steps if steps is None else steps):
                kept = (n + 1) % stride == 0
                then = tuple(frame[(n + 1) // stride] for frame in tape.states) if kept else spare[n % 2]
                x, v, C, F = now
                tau = scratch if tape.tau is None else tape.tau[n]
                trial = other if tape.trial is None else tape.trial[n]
                self.stress(elastic, F, C, viscosity, tau)
                grid = self.to_grid(x, v, C, tau, mass, sim.scratch("grid") if tape.grid is None else tape.grid[n])
                velocity = sim.scratch("velocity") if tape.velocity is None else tape.velocity[n]
                self.on_grid(grid, pull, force, friction, velocity)
                self.launch(sim.kernels.grid_to_particles, len(x),
                            [sim.particles.scene, sim.sorted_held, sim.origin, sim.dx, sim.dt, sim.nodes, velocity, x, F, *then[:3],
                             then[3] if plastic is None else trial, n, tape.status], self.block)  # fmt: skip
                if plastic is not None:
                    plastic.forward(trial, then[3])
                now = then

    def stress(self, elastic: Engine, F: Tensor, C: Tensor, viscosity: Tensor, tau: Tensor) -> None:
        sim = self.simulator
        elastic.forward(F, tau)
        if viscosity.numel():
            self.launch(sim.kernels.add_viscous_stress, len(F), [sim.particles.scene, viscosity, C, F, tau])

    def to_grid(self, x: Tensor, v: Tensor, C: Tensor, tau: Tensor, mass: Tensor, grid: Tensor) -> Tensor:
        sim = self.simulator
        arguments = [sim.particles.scene, sim.origin, sim.dx, sim.dt, sim.nodes, mass, sim.sorted_volume, x, v, C, tau, grid.zero_()]
        self.launch(sim.kernels.particles_to_grid, len(x), arguments, self.block)
        return grid

    def on_grid(self, grid: Tensor, pull: Tensor, force: Tensor, friction: Tensor, velocity: Tensor) -> None:
        sim = self.simulator
        self.launch(sim.kernels.update_grid, sim.node_count // sim.chunk, [*self.grid_inputs(pull, force, friction), grid, velocity])

    def grid_inputs(self, pull: Tensor, force: Tensor, friction: Tensor) -> list:
        sim = self.simulator
        table = sim.colliders
        return [
            sim.origin,
            sim.dx,
            sim.dt,
            pull,
            force,
            table.plane,
            table.kind,
            friction,
            sim.clamp_lower,
            sim.clamp_upper,
            sim.node_index,
            sim.chunk,
        ]

    def check(self, tape: Tape) -> None:
        """Raise what the kernels found, or a last frame that is not finite.

        Raises:
            UserError: A particle lost, too fast, or not finite.
        """
        code, p, step = tape.status.tolist()
        if code == 0 and bool(torch.isfinite(tape.F[-1]).all()):
            return
        if code == 0:
            p, step = int((~torch.isfinite(tape.F[-1]).all(dim=(1, 2))).nonzero()[0]), self.steps - 1
        sim = self.simulator
        s = int(sim.particles.scene[p])
        p = int(sim.order[p]) + sim.first_particle
        scene = sim.scenes[s]
        s += sim.first_scene
        what = {
            kernels.LOST: "left the domain; enlarge `lower`/`upper`, or close it with `walls`",
            kernels.FAST: f"moved by more than a cell ({scene.dx:.4g} m) or became NaN; lower `dt` (now {scene.dt:g} s) or the stiffness",
            0: f"has a deformation gradient that is not finite; lower `dt` (now {scene.dt:g} s) or check the law",
        }[code]
        raise UserError(f"particle {p} of scene {s} {what} (substep {step + 1} of {self.steps})")

    # Backward.

    def backward(
        self, inputs: Sequence[Tensor], tape: Tape, gradients: Sequence[Tensor | None], wanted: Sequence[bool], steps: int | None = None
    ) -> list[Tensor | None]:
        """The adjoint of every input that is wanted, from the gradients of the frames of x, v, C and F (None: zero)."""
        sim, k = self.simulator, self.simulator.kernels
        mass, pull, force, friction, viscosity = inputs[4:FIXED]
        a_mass, a_pull, a_force, a_friction, a_viscosity = (torch.zeros_like(t) for t in inputs[4:FIXED])
        parameters = any(wanted[5:8])
        now = [torch.zeros_like(t) for t in inputs[:4]]
        then = [torch.empty_like(t) for t in now]
        scratch, a_tau, other, a_trial = (torch.empty_like(now[3]) for _ in range(4))
        a_velocity, a_grid = sim.scratch("a_velocity"), sim.scratch("a_grid")
        with torch_stream(sim.device):
            elastic, plastic = self.engines(inputs)
            elastic.start_adjoint(wanted[FIXED : self.split])
            if plastic is not None:
                plastic.start_adjoint(wanted[self.split :])
            for n in reversed(range(self.steps if steps is None else steps)):
                if (n + 1) % self.every == 0:
                    _add(now, gradients, (n + 1) // self.every)
                x, v, C, F = (t[n] for t in tape.states)
                v_next, C_next = tape.v[n + 1], tape.C[n + 1]
                tau = scratch if tape.tau is None else tape.tau[n]
                if tape.tau is None:
                    self.stress(elastic, F, C, viscosity, tau)
                grid = self.to_grid(x, v, C, tau, mass, sim.scratch("grid")) if tape.grid is None else tape.grid[n]
                velocity = sim.scratch("velocity") if tape.velocity is None else tape.velocity[n]
                if tape.velocity is None:
                    self.on_grid(grid, pull, force, friction, velocity)
                a_x, a_v, a_C, a_F = then
                a_out = now[3]
                if plastic is not None:
                    trial = self.trial(F, C_next, other) if tape.trial is None else tape.trial[n]
                    plastic.adjoint(trial, now[3], a_trial.zero_())
                    a_out = a_trial
                self.launch(k.grid_to_particles_adjoint, len(x),
                            [sim.particles.scene, sim.sorted_held, sim.origin, sim.dx, sim.dt, sim.nodes, velocity, x, F, v_next,
                             C_next, *now[:3], a_out, a_velocity.zero_(), a_x, a_F], self.block)  # fmt: skip
                arguments = [grid, a_velocity, a_grid, a_pull, a_force, a_friction, parameters]
                self.launch(k.update_grid_adjoint, sim.node_count // sim.chunk, [*self.grid_inputs(pull, force, friction), *arguments])
                self.launch(k.particles_to_grid_adjoint, len(x),
                            [sim.particles.scene, sim.origin, sim.dx, sim.dt, sim.nodes, mass, sim.sorted_volume, x, v, C, tau,
                             a_grid, a_mass, a_x, a_v, a_C, a_tau], self.block)  # fmt: skip
                if viscosity.numel():
                    self.launch(k.add_viscous_stress_adjoint, len(x),
                                [sim.particles.scene, viscosity, C, F, a_tau, a_C, a_F, a_viscosity])  # fmt: skip
                elastic.adjoint(F, a_tau, a_F)
                now, then = then, now
            _add(now, gradients, 0)
            of_laws = [*elastic.gradients(), *(() if plastic is None else plastic.gradients())]
        return [*now, a_mass, a_pull, a_force, a_friction, a_viscosity, *of_laws]

    def trial(self, F: Tensor, C_next: Tensor, out: Tensor) -> Tensor:
        """F_tr = (I + dt C) F, as grid_to_particles wrote it."""
        self.launch(self.simulator.kernels.trial_gradient, len(F), [self.simulator.particles.scene, self.simulator.dt, F, C_next, out])
        return out


def _add(now: Sequence[Tensor], gradients: Sequence[Tensor | None], frame: int) -> None:
    for a, gradient in zip(now, gradients):
        if gradient is not None:
            a.add_(gradient[frame])


def run(plan: Plan, inputs: tuple[Tensor, ...], segment: int | None = None) -> tuple[Tensor, ...]:
    """Frames of x, v, C and F, in memory that the next rollout overwrites; differentiable where an input requires it.

    Args:
        plan: What to run.
        inputs: State, mass, pull, force, friction, viscosity and the tensors of the laws.
        segment: Substeps between checkpoints of a differentiable run; none: the tape spans the whole of it.

    Raises:
        UserError: What `Plan.check` finds.
    """
    differentiable = torch.is_grad_enabled() and any(t.requires_grad for t in inputs)
    if differentiable and segment is not None and segment < plan.steps:
        return _Segments.apply(plan, segment, *inputs)
    if plan.simulator.pool is not None:
        return ThreadedRollout.apply(Scenes(plan), differentiable, *inputs)
    if differentiable:
        return _Rollout.apply(plan, *inputs)
    return _frames(plan, tuple(t.detach() for t in inputs))


def _frames(plan: Plan, inputs: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
    """A run without a tape."""
    kept = plan.simulator.cache.find(plan, inputs, keep_all=False)
    kept.forward(plan, inputs)
    plan.check(kept.tape)
    return kept.tape.states


class _Rollout(torch.autograd.Function):
    """Frames of x, v, C, F from the start, the parameters and the laws' tensors."""

    @staticmethod
    def forward(ctx: Any, plan: Plan, *inputs: Tensor) -> tuple[Tensor, ...]:
        ctx.set_materialize_grads(False)
        inputs = tuple(t.detach() for t in inputs)
        # the tape belongs to the simulator: a later rollout may overwrite it, and the backward pass then runs this one again
        ctx.plan, ctx.kept = plan, plan.simulator.cache.find(plan, inputs, keep_all=True)
        ctx.serial = ctx.kept.forward(plan, inputs)
        plan.check(ctx.kept.tape)
        ctx.save_for_backward(*(t.clone() for t in inputs))
        return tuple(t[:: plan.every] for t in ctx.kept.tape.states)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:
        wanted = ctx.needs_input_grad[1:]
        out = ctx.kept.backward(ctx.plan, ctx.saved_tensors, ctx.serial, gradients, wanted)
        return (None, *(g if want else None for g, want in zip(out, wanted, strict=True)))


class _Segments(torch.autograd.Function):
    """`_Rollout` in pieces: only the states between them are kept, and the backward pass makes the tape of one piece at a time."""

    @staticmethod
    def forward(ctx: Any, plan: Plan, segment: int, *inputs: Tensor) -> tuple[Tensor, ...]:
        ctx.set_materialize_grads(False)
        inputs = tuple(t.detach() for t in inputs)
        piece = Plan(plan.simulator, plan.elasticity, plan.plasticity, segment, plan.every)
        piece.split = plan.split
        ctx.piece, ctx.count = piece, plan.steps // segment
        length = segment // plan.every
        frames = tuple(t.new_empty(ctx.count * length + 1, *t.shape) for t in inputs[:4])
        starts = [inputs[:4]]
        for i in range(ctx.count):
            for frame, part in zip(frames, _frames(piece, (*starts[i], *inputs[4:]))):
                frame[i * length : (i + 1) * length + 1] = part
            starts.append(tuple(frame[(i + 1) * length].clone() for frame in frames))
        ctx.save_for_backward(*inputs[4:], *(t for start in starts[:-1] for t in start))
        return frames

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:
        piece, wanted, tensors = ctx.piece, ctx.needs_input_grad[2:], ctx.saved_tensors
        rest, starts = tensors[: len(wanted) - 4], tensors[len(wanted) - 4 :]
        length = piece.steps // piece.every
        cache = piece.simulator.cache
        carry = [torch.zeros_like(t) for t in starts[:4]]
        total: list[Tensor | None] = [None] * (len(wanted) - 4)
        for i in reversed(range(ctx.count)):
            inputs = (*starts[4 * i : 4 * i + 4], *rest)
            own = []
            for a, gradient in zip(carry, gradients):
                part = a.new_zeros(length + 1, *a.shape)
                if gradient is not None:
                    # a piece's first frame is the last one of the piece before
                    part[0 if i == 0 else 1 :] = gradient[i * length + (0 if i == 0 else 1) : (i + 1) * length + 1]
                part[-1] += a
                own.append(part)
            kept = cache.find(piece, inputs, keep_all=True)
            serial = kept.forward(piece, inputs)
            out = kept.backward(piece, inputs, serial, own, (True,) * 4 + tuple(wanted[4:]))
            carry = out[:4]
            total = [t if new is None else new if t is None else t + new for t, new in zip(total, out[4:])]
        return (None, None, *(g if want else None for g, want in zip([*carry, *total], wanted, strict=True)))
