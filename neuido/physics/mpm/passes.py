"""The launches of the particles in a substep for each kind of law, and the choice between them and the kernels of `transfers`."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
import warp as wp
from torch import Tensor

from neuido.physics.laws.base import Engine, Law
from neuido.physics.laws.neural import fused
from neuido.physics.laws.parametric import ParametricLaw
from neuido.physics.mpm import classical_pass, network_pass
from neuido.physics.mpm.kernels import transfer_pass
from neuido.physics.mpm.kernels.tile_source import ROLLED, UNROLLED
from neuido.physics.mpm.plan import FIXED, LARGE, STATES, Plan
from neuido.physics.runtime.device import real_of

VISCOSITY = STATES + 4
"""Index of the input of viscous stress."""

TURNS: int | None = None
"""Turns of the loops over nodes that are written out; None: `UNROLLED` on CUDA, where it is faster, and `ROLLED` on the CPU, which compiles
it sooner."""

PER_WARP: int | None = None
"""Particles of a warp of `NetworkPass`, 16 or 32; None: `particles_per_warp` of the number of particles."""

BY_DEFAULT = {"cuda": "fused"}
"""The kernels that `fusion="auto"` takes on each type of device; `separate` on others."""


class Moved(NamedTuple):
    """What `Pass.advance` reads and writes, in the order of the kernels' arguments."""

    velocity: Tensor
    """Velocity of the nodes, (nodes, 4)."""
    x: Tensor
    F: Tensor
    x_next: Tensor
    v_next: Tensor
    C_next: Tensor
    trial: Tensor | None
    """Trial gradient, (P, 3, 3), if the tape has it."""
    F_next: Tensor
    tau: Tensor | None
    """Stress at `F_next` [Pa], (P, 3, 3), if the tape has it."""
    grid: Tensor
    """Momentum and mass of the nodes, (nodes, 4); added to."""
    step: int
    status: Tensor
    lowest: Tensor
    since: Tensor
    """Failures and events of the tape."""


class Before(NamedTuple):
    """What `Pass.retreat` reads of the substep before."""

    x: Tensor
    F: Tensor
    trial: Tensor | None
    velocity: Tensor


class Adjoints(NamedTuple):
    """The adjoints that `Pass.retreat` reads and writes."""

    grid: Tensor
    """Of the nodal momentum and mass; read."""
    mass: Tensor | None
    """Of the particles' mass; added to, if wanted."""
    x: Tensor
    F: Tensor
    """Of x and F through G2P; updated."""
    velocity: Tensor
    """Of the nodal velocities of the substep before; added to."""


class Pass:
    """The launches of the particles' part of a substep, with the laws of a rollout.

    Args:
        plan: The rollout.
        inputs: Its inputs.

    Attributes:
        warps: Scene, first particle and end of each warp.
        table: The first arguments of every kernel.
    """

    elastic: Engine
    plastic: Engine | None
    block = fused.BLOCK
    """Threads per block."""
    per_warp = 32
    """Particles of a warp."""

    def __init__(self, plan: Plan, inputs: Sequence[Tensor]) -> None:
        setup = plan.setup
        self.plan, self.device, self.corrects = plan, setup.device, plan.plasticity is not None
        self.warps = setup.warps = fused.warps_of(setup.particles.offsets, setup.device, self.per_warp)
        scenes = [setup.held_now, setup.origin, setup.dx, setup.dt, setup.room.size]
        self.table = [*self.warps, *scenes, inputs[STATES], setup.sorted_volume]

    def launch(self, kernel: wp.Kernel, arguments: list) -> None:
        """Launch a kernel with `table` before its arguments."""
        self.plan.launch(kernel, 32 * len(self.warps[0]), [*self.table, *arguments], self.block)

    def advance(self, moved: Moved) -> None:
        """Go from the nodal velocities of a substep to the momentum of the next one."""
        raise NotImplementedError

    def start_adjoint(self, wanted: Sequence[bool]) -> None:
        """Allocate the gradients of the laws' tensors; `wanted` as for `run_backward`."""
        self.elastic.start_adjoint(wanted[FIXED : self.plan.split])
        if self.plastic is not None:
            self.plastic.start_adjoint(wanted[self.plan.split :])

    def differentiates(self, wanted: Sequence[bool]) -> bool:
        """Return whether `retreat` can compute the wanted gradients."""
        return True

    def retreat(self, before: Before, state: Sequence[Tensor], frame: Sequence[Tensor | None], a: Adjoints) -> None:
        """Go from the adjoint of a substep's momentum to that of the nodal velocities of the substep before.

        Args:
            before: What G2P read and wrote in the substep before.
            state: x, v, C, F and stress that P2G read.
            frame: Adjoints of the frame of x, v, C and F between the two; None: none.
            a: The adjoints.
        """
        raise NotImplementedError

    def gradients(self) -> list[Tensor | None]:
        """Return the gradients of the laws' tensors."""
        return [*self.elastic.gradients(), *(() if self.plastic is None else self.plastic.gradients())]


def _turns(plan: Plan) -> int:
    if TURNS is not None:
        return TURNS
    return UNROLLED if plan.setup.device.type == "cuda" else ROLLED


def choose(plan: Plan, inputs: Sequence[Tensor], *, backward: bool = False) -> Pass | None:
    """Return the launches of the particles for a rollout; None where the kernels of `transfers` must run.

    Effects, solids, attachments, bodies that meet, and faces through which particles leave need those. The adjoints of laws run by
    themselves for many particles, since one kernel of both leaves a multiprocessor too few warps.
    """
    setup = plan.setup
    fusion = setup.fusion
    if fusion == "auto":
        fusion = BY_DEFAULT.get(setup.device.type, "separate")
    plain = plan.tables is None and not plan.compensated and plan.steps > 1 and not any(t.numel() for t in inputs[VISCOSITY:FIXED])
    alone = setup.contact is None and setup.solids is None and setup.attached is None and setup.leaving is None
    if fusion == "separate" or not plain or not alone or len(setup.field_scene) > setup.scene_count:
        return None
    if fusion == "fused" and not (backward and len(setup.mass) >= LARGE):
        if _are_classical(plan):
            return ClassicalPass(plan, inputs)
        if _are_networks(plan):
            return NetworkPass(plan, inputs)
    return TransferPass(plan, inputs)


def _are_classical(plan: Plan) -> bool:
    """Return whether the kernels of a whole substep have both laws; `extended_kernels` run between launches of the transfers."""
    return all(law is None or (isinstance(law, ParametricLaw) and not law.extended) for law in (plan.elasticity, plan.plasticity))


def _are_networks(plan: Plan) -> bool:
    """Return whether both laws are objective networks for which there are kernels."""
    widths = {_width(law) for law in (plan.elasticity, plan.plasticity) if law is not None}
    return len(widths) == 1 and widths <= set(fused.WIDTHS) and plan.setup.dtype == torch.float32


def _width(law: Law) -> int:
    """Return the hidden width of an objective network; 0 for another law."""
    return law.weights[0].shape[-2] if hasattr(law, "readout") else 0  # type: ignore[attr-defined]


def particles_per_warp(count: int) -> int:
    """Return how many of `count` particles a warp takes, so that a GPU of some hundred schedulers has several warps for each."""
    return 32


class TransferPass(Pass):
    """Laws of any kind between launches of the transfers; arguments as for `Pass`."""

    def __init__(self, plan: Plan, inputs: Sequence[Tensor]) -> None:
        super().__init__(plan, inputs)
        self.elastic, self.plastic = plan.engines(inputs)
        self.kernels = transfer_pass.build(real_of(plan.setup.dtype), _turns(plan))
        self.block = 32 if len(plan.setup.mass) < LARGE else 128
        self.spare = [torch.empty_like(plan.setup.state.F) for _ in range(2)]

    def advance(self, moved: Moved) -> None:
        to = moved
        trial, tau = (spare if t is None else t for t, spare in zip((to.trial, to.tau), self.spare))
        raw = to.F_next if self.plastic is None else trial
        marks = [to.step, to.status, to.lowest, to.since]
        self.launch(self.kernels.pull, [to.velocity, to.x, to.F, to.x_next, to.v_next, to.C_next, raw, *marks])
        if self.plastic is not None:
            self.plastic.forward(trial, to.F_next)
        self.elastic.forward(to.F_next, tau)
        self.launch(self.kernels.push, [to.x_next, to.v_next, to.C_next, tau, to.grid])

    def start_adjoint(self, wanted: Sequence[bool]) -> None:
        super().start_adjoint(wanted)
        state = self.plan.setup.state
        self.a_v, self.a_C, self.a_tau, self.a_trial = (torch.empty_like(t) for t in (state.v, state.C, state.F, state.F))

    def retreat(self, before: Before, state: Sequence[Tensor], frame: Sequence[Tensor | None], a: Adjoints) -> None:
        x, v, C, F, tau = state
        self.launch(self.kernels.push_adjoint, [x, v, C, tau, a.grid, a.mass, a.x, self.a_v, self.a_C, self.a_tau])
        self.elastic.adjoint(F, self.a_tau, a.F)
        for own, given in zip((a.x, self.a_v, self.a_C, a.F), frame):
            if given is not None:
                own.add_(given)
        a_trial = a.F
        if self.plastic is not None and before.trial is not None:
            a_trial = self.a_trial.zero_()
            self.plastic.adjoint(before.trial, a.F, a_trial)
        moved = [before.velocity, before.x, before.F, v, C, self.a_v, self.a_C, a_trial, a.x, a.F, a.velocity]
        self.launch(self.kernels.pull_adjoint, moved)


class NetworkPass(Pass):
    """Objective networks inside the kernels of a whole substep; arguments as for `Pass`."""

    elastic: fused.FusedEngine
    plastic: fused.FusedEngine | None

    def __init__(self, plan: Plan, inputs: Sequence[Tensor]) -> None:
        self.per_warp = PER_WARP or particles_per_warp(len(plan.setup.mass))
        super().__init__(plan, inputs)
        particles = plan.setup.particles
        elastic, plastic = plan.elasticity, plan.plasticity
        self.elastic = fused.FusedEngine(elastic, inputs[FIXED : plan.split], particles, self.per_warp)
        self.plastic = None if plastic is None else fused.FusedEngine(plastic, inputs[plan.split :], particles, self.per_warp)
        corrects = None if plastic is None else plastic.readout  # type: ignore[attr-defined]
        readout = self.elastic.law.readout  # type: ignore[attr-defined]
        self.kernels = network_pass.build(self.elastic.width, readout, corrects, _turns(plan), self.per_warp)

    def _packed(self, engine: fused.FusedEngine | None) -> list:
        if engine is None:
            return [1, 1, *[None] * 5, 0.0]
        return [*engine.rows, *engine.packed, engine.law.scale]  # type: ignore[attr-defined]

    def advance(self, moved: Moved) -> None:
        self.launch(self.kernels.advance, [*moved, *self._packed(self.elastic), *self._packed(self.plastic)])

    def differentiates(self, wanted: Sequence[bool]) -> bool:
        """Return whether `retreat` can compute the wanted gradients: those of the first two layers need further launches."""
        split = self.plan.split
        return not any(wanted[FIXED : FIXED + 4]) and not any(wanted[split : split + 4])

    def retreat(self, before: Before, state: Sequence[Tensor], frame: Sequence[Tensor | None], a: Adjoints) -> None:
        laws: list = [None]
        for engine in (self.elastic, self.plastic):
            laws += self._packed(engine)
            laws += [None] * 5 if engine is None else [*engine.transposed, engine.P3, engine.PB]
        self.launch(self.kernels.retreat, [*before, *state, a.grid, *frame, *a[1:], *laws])


class ClassicalPass(Pass):
    """Classical laws inside the kernels of a whole substep; arguments as for `Pass`."""

    def __init__(self, plan: Plan, inputs: Sequence[Tensor]) -> None:
        super().__init__(plan, inputs)
        self.elastic, self.plastic = plan.engines(inputs)
        self.kernels = classical_pass.build(real_of(plan.setup.dtype), self.corrects, _turns(plan))
        self.block = 32 if len(plan.setup.mass) < LARGE else 128

    def _law(self, engine: Engine | None) -> list:
        return [None, None] if engine is None else [engine.law.kinds(self.device), engine.tensors[0]]  # type: ignore[attr-defined]

    def advance(self, moved: Moved) -> None:
        self.launch(self.kernels.advance, [*moved, *self._law(self.elastic), *self._law(self.plastic)])

    def start_adjoint(self, wanted: Sequence[bool]) -> None:
        super().start_adjoint(wanted)
        self.shares: list[Tensor | None] = []
        for engine in (self.elastic, self.plastic):
            total = None if engine is None else engine.grads[0]
            self.shares.append(None if total is None else total.new_zeros(len(self.warps[0]), total.shape[1]))

    def retreat(self, before: Before, state: Sequence[Tensor], frame: Sequence[Tensor | None], a: Adjoints) -> None:
        laws = [*self._law(self.elastic), self.shares[0], *self._law(self.plastic), self.shares[1]]
        self.launch(self.kernels.retreat, [*before, *state, a.grid, *frame, *a[1:], *laws])

    def gradients(self) -> list[Tensor | None]:
        for engine, share in ((self.elastic, self.shares[0]), (self.plastic, self.shares[1])):
            total = None if engine is None else engine.grads[0]
            if total is not None and share is not None:
                total.index_add_(0, self.warps[0].long().clamp(max=len(total) - 1), share)
        return super().gradients()
