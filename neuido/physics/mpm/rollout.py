"""The forward pass of a rollout: kernel launches only, so that it runs eagerly or inside a CUDA graph.

It records a tape: x, v, C, F and the history of every substep and, if `Simulator(store=...)` asks for them, stress and nodal momentum.
"""

import math
from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor

from neuido.physics.colliders.attachments import AttachmentLoop
from neuido.physics.colliders.solid_loop import SolidLoop, SolidTape, new_solid_tape
from neuido.physics.effects import swelling_kernels
from neuido.physics.effects.spin_decay import SpinDecay
from neuido.physics.laws.base import Engine
from neuido.physics.mpm.plan import BODY_FRICTION, SHRINKAGE, SPIN_LOSS, STATES, Material, Plan, at_step, attachment_loop, solid_loop
from neuido.physics.runtime.device import real_of, torch_stream
from neuido.physics.runtime.launches import LaunchRecordings


class Tape(NamedTuple):
    """The results of a forward pass in K frames; one frame per substep if a backward pass follows."""

    x: Tensor
    v: Tensor
    C: Tensor
    F: Tensor
    history: Tensor
    status: Tensor
    """Code, particle and substep of the first failure of each velocity field, (3 fields,) int32."""
    lowest: Tensor
    """Smallest det F of each particle, of those below `COLLAPSED`, (P,)."""
    since: Tensor
    """First substep in which it was below, (P,) int32; -1: never."""
    rest_x: Tensor | None
    """What the rounding of x has left out so far, (P, 3); None: not kept."""
    rest_F: Tensor | None
    """The same of F, (P, 3, 3)."""
    tau: Tensor | None
    """Stress of each substep, (T, P, 3, 3), or None."""
    trial: Tensor | None
    """Trial deformation gradient of each substep, (T, P, 3, 3), or None."""
    grid: Tensor | None
    """Nodal momentum and mass of each substep, (T, nodes, 4), or None."""
    velocity: Tensor | None
    """Nodal velocity of each substep, (T, nodes, 4), or None."""
    whole: bool
    """Whether a backward pass may follow."""
    solids: SolidTape | None
    """Record of the solids in every substep; None without solids."""
    memory: dict[str, Tensor]
    """Memory that `scratch` hands out."""

    @property
    def states(self) -> tuple[Tensor, ...]:
        """Frames of x, v, C, F and the history."""
        return self[:STATES]

    def scratch(self, name: str, like: Tensor) -> Tensor:
        """Return memory of the shape of a tensor; on the CPU the same in each run, since new pages and new addresses cost time there."""
        if like.device.type != "cpu":
            return torch.empty_like(like)
        if name not in self.memory or self.memory[name].shape != like.shape:
            self.memory[name] = torch.empty_like(like)
        return self.memory[name]


def new_tape(plan: Plan, keep_all: bool) -> Tape:
    """Allocate the memory of a forward pass.

    Args:
        plan: The rollout.
        keep_all: Whether to store every substep, as a backward pass needs it, or the frames alone.
    """
    setup = plan.setup
    count = plan.steps if keep_all else plan.steps // plan.every
    history = setup.mass.new_empty(len(setup.mass), plan.layout.width)
    x, v, C, F, history = (t.new_empty(count + 1, *t.shape) for t in (*setup.state, history))
    status = torch.zeros(3 * len(setup.field_scene), dtype=torch.int32, device=setup.device)
    lowest, since = torch.empty_like(setup.mass), torch.empty(len(setup.mass), dtype=torch.int32, device=setup.device)
    more = keep_all and setup.keep_grid
    tau = setup.state.F.new_empty(plan.steps, *setup.state.F.shape) if more else None
    trial = torch.empty_like(tau) if tau is not None and plan.corrects else None
    grid, velocity = (setup.mass.new_empty(plan.steps, setup.room.count, 4) if more else None for _ in range(2))
    rest_x, rest_F = (torch.empty_like(t) if plan.compensated else None for t in (setup.state.x, setup.state.F))
    solids = None if setup.solids is None else new_solid_tape(setup.solids, plan.steps)
    return Tape(x, v, C, F, history, status, lowest, since, rest_x, rest_F, tau, trial, grid, velocity, keep_all, solids, {})


def run_forward(plan: Plan, inputs: Sequence[Tensor], tape: Tape, steps: int | None = None) -> None:
    """Launch the substeps of a rollout, without checking the result.

    Args:
        plan: The rollout.
        inputs: The inputs in the order of `plan.KINDS`, then the tensors of the laws.
        tape: Memory for the result; overwritten.
        steps: Number of substeps; by default those of the plan.
    """
    setup = plan.setup
    pull, force, friction = inputs[STATES + 1 : STATES + 4]
    stride = plan.steps // (len(tape.x) - 1)
    for frame, t in zip(tape.states, inputs):
        frame[0] = t
    now = tuple(frame[0] for frame in tape.states)
    spare = [tuple(tape.scratch(f"spare {k} {i}", t) for i, t in enumerate(now)) for k in range(2)] if stride > 1 else []
    scratch, other = tape.scratch("tau", now[3]), tape.scratch("trial", now[3])
    copies = setup.device.type == "cpu"
    # the grid update zeroes the nodes as it reads them, which saves a pass
    clears = copies and tape.grid is None and setup.contact is None and tape.solids is None
    for name in ("grid", "velocity") if clears else ():
        setup.room.scratch(name).zero_()
    recordings = LaunchRecordings()
    changing = pull, inputs[STATES + 6], inputs[SHRINKAGE]
    steady = all(len(t) <= 1 for t in changing)  # none has a row for each substep
    tape.status.zero_()
    tape.lowest.fill_(math.inf)
    tape.since.fill_(-1)
    for rest in (tape.rest_x, tape.rest_F):
        if rest is not None:
            rest.zero_()
    with torch_stream(setup.device):
        elastic, plastic = plan.engines(inputs)
        spin = plan.spin_decay(inputs)
        damped = None if spin is None else (torch.empty_like(now[1]), torch.empty_like(now[2]))
        solids = solid_loop(plan, inputs, tape.solids)
        if solids is not None:
            solids.begin()
        attached = attachment_loop(plan, inputs, solids)
        for n in range(plan.steps if steps is None else steps):
            frame = tuple(frames[(n + 1) // stride] for frames in tape.states) if (n + 1) % stride == 0 else None
            # on the CPU a frame is copied out: launches that always use the same buffers can be recorded once and repeated
            then = spare[n % 2] if frame is None or (spare and copies) else frame
            same = n % 2 if spare and copies and steady and n else None
            reach = node_range(plan, now[0] if n == 0 else None) if tape.grid is None else slice(None)
            tau = scratch if tape.tau is None else tape.tau[n]
            trial = other if tape.trial is None else tape.trial[n]
            grid = setup.room.scratch("grid") if tape.grid is None else tape.grid[n]
            velocity = setup.room.scratch("velocity") if tape.velocity is None else tape.velocity[n]
            if n == 0 or not steady:
                material, pull_now = plan.material(inputs, n, all_branches=tape.whole), at_step(pull, n)
            if not clears:
                grid.zero_()
            if solids is not None:
                solids.clear(setup.room.count)
            to_nodes = partial(scatter, plan, inputs, now, material, elastic, tau, grid, spin, damped, attached, n, solids)
            met = grid if setup.contact is None else setup.room.scratch("met")
            on_nodes = partial(update_nodes, plan, met, pull_now, force, friction, velocity, reach, clears, solids, n)
            shrinkage = at_step(inputs[SHRINKAGE], n)
            to_particles = partial(gather, plan, n, now, then, material, plastic, velocity, trial, tape, shrinkage)
            if same is None:
                to_nodes()
                on_nodes()
                to_particles()
            else:
                recordings.run(("scatter", same), to_nodes, n)
                recordings.run((reach.start, reach.stop), on_nodes, n)
                recordings.run(("gather", same), to_particles, n)
            if frame is not None and then is not frame:
                for target, t in zip(frame, then):
                    target.copy_(t)
            now = then


def scatter(
    plan: Plan,
    inputs: Sequence[Tensor],
    now: Sequence[Tensor],
    material: Material | None,
    elastic: Engine,
    tau: Tensor,
    grid: Tensor,
    spin: SpinDecay | None = None,
    damped: tuple[Tensor, Tensor] | None = None,
    attached: AttachmentLoop | None = None,
    n: int = 0,
    solids: SolidLoop | None = None,
) -> None:
    """Compute the stress, and add momentum and mass of the particles to the nodes (P2G); let bodies that meet exchange momentum.

    Args:
        plan: The rollout.
        inputs: Inputs of the rollout.
        now: x, v, C, F and the history before the substep.
        material: Tables of material effects in the substep, or None.
        elastic: Engine of the elastic law.
        tau: Kirchhoff stress [Pa], (P, 3, 3); overwritten.
        grid: Momentum and mass of the nodes, (nodes, 4); added to, and zero before.
        spin: The torque that damps the rotation, or None.
        damped: Memory for v and C after that torque.
        attached: The launches of attachments, or None.
        n: Number of the substep.
        solids: The launches of solids, or None.
    """
    x, v, C, F, history = now
    stress(plan, elastic, F, C, history, inputs[STATES + 4], material, tau)
    if spin is not None and damped is not None:
        spin.damp(inputs[SPIN_LOSS], inputs[STATES], x, v, C, *damped)
        v, C = damped
    v = v if attached is None else attached.hold(n, x, v)
    mass = inputs[STATES]
    if plan.setup.leaving is not None:
        v, mass = plan.setup.leaving.enter(x, v, mass, tau)
    add_to_grid(plan, x, v, C, tau, mass, grid)
    meet(plan, x, grid, inputs[BODY_FRICTION])
    if solids is not None:
        solids.press(n, plan.pressed(x, mass))


def meet(plan: Plan, x: Tensor, grid: Tensor, friction: Tensor) -> Tensor:
    """Exchange momentum between bodies in contact.

    Args:
        plan: The rollout.
        x: Position of the particles [m], (P, 3).
        grid: Momentum and mass of the nodes of each velocity field, (nodes, 4).
        friction: Coulomb's coefficient of each pair of bodies [-], (S, B B).

    Returns:
        Momentum and mass after the exchange: `grid` itself where no bodies have fields of their own, else scratch memory.
    """
    setup = plan.setup
    if setup.contact is None:
        return grid
    particles = [setup.field, setup.particles.scene, setup.field_origin, setup.field_dx, x, setup.sorted_volume]
    return setup.contact.exchange(plan.launch, particles, grid, friction, setup.room.scratch("met"))


def gather(
    plan: Plan,
    n: int,
    now: Sequence[Tensor],
    then: Sequence[Tensor],
    material: Material | None,
    plastic: Engine | None,
    velocity: Tensor,
    trial: Tensor,
    tape: Tape,
    shrinkage: Tensor,
) -> None:
    """Update the particles from the nodal velocities (G2P), then correct F and advance the history.

    Args:
        plan: The rollout.
        n: Number of the substep.
        now: x, v, C, F and the history before the substep.
        then: The same after the substep; overwritten.
        material: Tables of material effects in the substep, or None.
        plastic: Engine of the plastic law, or None.
        velocity: Velocity of the nodes, (nodes, 4).
        trial: Memory for the trial gradient, (P, 3, 3).
        tape: Receives failures and events.
        shrinkage: `Effects.shrinkage` of the substep [-], (S,), or empty.
    """
    setup = plan.setup
    x, _, _, F, history = now
    raw = trial if plan.corrects else then[3]
    k = setup.kernels
    plan.launch(k.grid_to_particles if tape.rest_x is None else k.grid_to_particles_with_rests, len(x),
                [setup.field, setup.held_now, setup.field_origin, setup.field_dx, setup.field_dt, setup.room.size, velocity, x, F,
                 *then[:3], raw, n, tape.status, setup.span, tape.lowest, tape.since,
                 tape.rest_x, tape.rest_F], plan.block)  # fmt: skip
    if setup.leaving is not None:
        setup.leaving.end(then[0])
    if shrinkage.numel():
        swell(plan, shrinkage, raw, tape.rest_F)
    if plastic is not None:
        plastic.forward(trial, then[3])
    if material is not None:
        update_history(plan, material, trial, then[2], history, then[3], then[4])


def swell(plan: Plan, shrinkage: Tensor, F: Tensor, rest: Tensor | None = None) -> None:
    """Take from F the change of the stress-free size in a substep.

    Args:
        plan: The rollout.
        shrinkage: `Effects.shrinkage` of the substep [-], (S,).
        F: Trial gradient [-], (P, 3, 3); overwritten.
        rest: What the rounding of F left out, if it is kept.
    """
    kernels = swelling_kernels.build(real_of(plan.setup.dtype))
    plan.launch(kernels.swell, len(F), [plan.setup.particles.scene, shrinkage, rest, F])


def stress(
    plan: Plan, elastic: Engine, F: Tensor, C: Tensor, history: Tensor, viscosity: Tensor, material: Material | None, tau: Tensor
) -> None:
    """Compute the Kirchhoff stress with effects and viscosity.

    Args:
        plan: The rollout.
        elastic: Engine of the elastic law.
        F: Deformation gradient [-], (P, 3, 3).
        C: Affine velocity [1/s], (P, 3, 3).
        history: History at F.
        viscosity: `RolloutInputs.viscosity` [Pa s], or empty.
        material: Tables of material effects in the substep, or None.
        tau: Kirchhoff stress [Pa], (P, 3, 3); overwritten.
    """
    setup = plan.setup
    elastic.forward(F, tau)
    if material is not None:
        assert plan.effects is not None  # the kernels of the tables
        plan.launch(plan.effects.add_effect_stress, len(F), [*stress_inputs(plan, material), material.all_branches, F, history, tau])
    if viscosity.numel():
        plan.launch(setup.kernels.add_viscous_stress, len(F), [setup.viscosity_rows(viscosity), viscosity, C, F, tau])


def stress_inputs(plan: Plan, material: Material) -> list:
    """Return the first arguments of `add_effect_stress` and its adjoint."""
    return [plan.setup.particles.scene, *material[:4], plan.spectral, plan.layout.e_max_column, plan.layout.compaction_column]


def flow_inputs(plan: Plan, material: Material) -> list:
    """Return the first arguments of `flow` and its adjoint."""
    setup, layout = plan.setup, plan.layout
    table = [setup.particles.scene, setup.dt, plan.kinds, material.flow, material.stiffness, material.growth]
    return [*table, layout.alpha_column, layout.backstress_column]


def update_history(plan: Plan, material: Material, trial: Tensor, C: Tensor, history: Tensor, F: Tensor, history_next: Tensor) -> None:
    """Advance the history, and correct the trial gradient if a plastic effect does so.

    Args:
        plan: The rollout.
        material: Tables of material effects in the substep.
        trial: Trial gradient [-], (P, 3, 3).
        C: Affine velocity after the substep [1/s], (P, 3, 3).
        history: History before the substep.
        F: Corrected gradient [-], (P, 3, 3); overwritten by a plastic effect.
        history_next: History after the substep; overwritten.
    """
    setup, k = plan.setup, plan.effects
    assert k is not None  # the kernels of the tables
    if material.branches is not None:
        plan.launch(k.relax, len(F), [setup.particles.scene, setup.dt, material.branches, material.all_branches, C, history, history_next])
    if material.flow is not None:
        plan.launch(k.flow, len(F), [*flow_inputs(plan, material), trial, C, history, F, history_next])
    if plan.layout.e_max:
        plan.launch(k.remember, len(F), [F, plan.layout.e_max_column, history, history_next])
    if plan.layout.compaction:
        plan.launch(k.compact, len(F), [trial, F, plan.layout.compaction_column, history, history_next])


def node_range(plan: Plan, x: Tensor | None) -> slice:
    """Return the range of nodes that the particles touch.

    For one scene on the CPU these are the grid planes from the first to the last particle along x, with a margin of one plane;
    elsewhere all nodes. The particles are at x or, if x is None, where the last `gather` left them.
    """
    setup = plan.setup
    if setup.ends is None:
        return slice(None)
    low, high = setup.ends.tolist() if x is None else [float(t) for t in torch.aminmax(x[:, 0])]
    setup.ends[:] = math.inf, -math.inf
    if not math.isfinite(high - low):
        return slice(None)
    planes, dx = setup.room.shape[1], setup.scenes[0].dx
    edge, plane = setup.edge, setup.room.count // planes
    first, last = (min(max(int((at - edge) / dx - 0.5), 0), planes - 3) for at in (low, high))
    return slice(max(first - 1, 0) * plane, min(last + 4, planes) * plane)


def add_to_grid(plan: Plan, x: Tensor, v: Tensor, C: Tensor, tau: Tensor, mass: Tensor, grid: Tensor) -> None:
    """Add momentum and mass of the particles to the nodes of `grid`."""
    setup = plan.setup
    table = [setup.field, setup.field_origin, setup.field_dx, setup.field_dt, setup.room.size]
    arguments = [*table, mass, setup.sorted_volume, x, v, C, tau, grid]
    plan.launch(setup.kernels.particles_to_grid, len(x), arguments, plan.block)


def update_nodes(
    plan: Plan,
    grid: Tensor,
    pull: Tensor,
    force: Tensor,
    friction: Tensor,
    velocity: Tensor,
    reach: slice = slice(None),
    clear: bool = False,
    solids: SolidLoop | None = None,
    n: int = 0,
) -> None:
    """Compute the velocities of the nodes from their momentum: gravity, body forces, colliders and clamps; move the solids.

    Args:
        plan: The rollout.
        grid: Momentum and mass, (nodes, 4).
        pull: Gravity and other uniform accelerations [m/s^2], (S, 3).
        force: `Effects.force_table`.
        friction: Friction coefficients [-], (S, K).
        velocity: Velocity, (nodes, 4); overwritten.
        reach: Range of nodes to update.
        clear: Whether to zero `grid` for the next substep.
        solids: The launches of solids, which come last, or None.
        n: Number of the substep.
    """
    setup = plan.setup
    inputs = [*grid_inputs(plan, pull, force, friction, reach), grid[reach], velocity[reach], clear]
    plan.launch(setup.kernels.update_grid, len(grid[reach]) // setup.room.chunk, inputs)
    if solids is not None:
        solids.meet(n, setup.room.index[reach], grid[reach], velocity[reach], reach)
        solids.advance(n)


def grid_inputs(plan: Plan, pull: Tensor, force: Tensor, friction: Tensor, reach: slice = slice(None)) -> list:
    """Return the first arguments of `update_grid` and its adjoint."""
    setup = plan.setup
    table = setup.colliders
    return [
        setup.origin,
        setup.dx,
        setup.dt,
        pull,
        force,
        table.plane,
        table.kind,
        friction,
        setup.clamp_lower,
        setup.clamp_upper,
        setup.room.index[reach],
        setup.room.near[reach],
        setup.room.chunk,
    ]
