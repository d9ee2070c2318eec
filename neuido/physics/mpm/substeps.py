"""The loops of a rollout by kernels of a whole substep: two launches a substep, for the particles and for the nodes.

From G2P of a substep to P2G of the next everything is local to a particle. `advance` does it in registers: gather, motion, trial gradient,
plastic law, elastic law, scatter. `retreat` does the same for the adjoints. The first scatter and the last gather are separate launches of
the kernels that `rollout` and `adjoint` use; those two remain for everything that `passes.applies` excludes, and as the slow twin.
"""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from neuido.physics.mpm import adjoint, rollout
from neuido.physics.mpm.passes import Adjoints, Before, Moved, Pass, choose
from neuido.physics.mpm.plan import FIXED, SHRINKAGE, STATES, Plan, at_step
from neuido.physics.mpm.rollout import Tape, gather, grid_inputs, scatter, update_nodes
from neuido.physics.runtime.device import torch_stream


def run_forward(plan: Plan, inputs: Sequence[Tensor], tape: Tape, steps: int | None = None) -> None:
    """Launch the substeps of a rollout by the kernels that suit it; arguments as for `rollout.run_forward`."""
    own = choose(plan, inputs)
    if own is None:
        rollout.run_forward(plan, inputs, tape, steps)
    else:
        with torch_stream(plan.setup.device):
            _forward(plan, own, inputs, tape, plan.steps if steps is None else max(steps, 2))


def _forward(plan: Plan, own: Pass, inputs: Sequence[Tensor], tape: Tape, steps: int) -> None:
    setup = plan.setup
    pull, force, friction = inputs[STATES + 1 : STATES + 4]
    stride = plan.steps // (len(tape.x) - 1)
    for frame, t in zip(tape.states, inputs):
        frame[0] = t
    now = tuple(frame[0] for frame in tape.states)
    spare = [tuple(torch.empty_like(t) for t in now) for _ in range(2)] if stride > 1 else []
    scratch = torch.empty_like(now[3])
    tape.status.zero_()
    tape.lowest.fill_(math.inf)
    tape.since.fill_(-1)
    # without a tape of the nodes, the grid update zeroes them as it reads them
    grids, velocities = (setup.room.scratch("grid"), setup.room.scratch("velocity")) if tape.grid is None else (tape.grid, tape.velocity)
    assert velocities is not None  # it is on the tape if the grid is
    grids.zero_()
    if tape.grid is None:
        velocities.zero_()
    scatter(plan, inputs, now, None, own.elastic, scratch if tape.tau is None else tape.tau[0], grids if tape.grid is None else grids[0])
    for n in range(steps):
        grid, velocity = (grids, velocities) if tape.grid is None else (grids[n], velocities[n])
        update_nodes(plan, grid, at_step(pull, n), force, friction, velocity, clear=tape.grid is None)
        framed = (n + 1) % stride == 0
        then = tuple(frames[(n + 1) // stride] for frames in tape.states) if framed else spare[n % 2]
        if n + 1 == steps:
            trial = scratch if tape.trial is None else tape.trial[n]
            gather(plan, n, now, then, None, own.plastic, velocity, trial, tape, inputs[SHRINKAGE])
        else:
            trial = None if tape.trial is None else tape.trial[n]
            tau = None if tape.tau is None else tape.tau[n + 1]
            following = grids if tape.grid is None else grids[n + 1]
            x, v, C, F, _ = then
            moved = velocity, now[0], now[3], x, v, C, trial, F, tau, following, n, tape.status, tape.lowest, tape.since
            own.advance(Moved(*moved))
        now = then


def run_backward(
    plan: Plan, inputs: Sequence[Tensor], tape: Tape, gradients: Sequence[Tensor | None], wanted: Sequence[bool], steps: int | None = None
) -> list[Tensor | None]:
    """Compute the gradients of a rollout by the kernels that suit it; arguments and result as for `adjoint.run_backward`."""
    own = choose(plan, inputs, backward=True)
    if own is None or tape.tau is None or tape.grid is None or not own.differentiates(wanted):
        return adjoint.run_backward(plan, inputs, tape, gradients, wanted, steps)
    with torch_stream(plan.setup.device):
        return _backward(plan, own, inputs, tape, gradients, wanted, plan.steps if steps is None else max(steps, 2))


def _backward(
    plan: Plan,
    own: Pass,
    inputs: Sequence[Tensor],
    tape: Tape,
    gradients: Sequence[Tensor | None],
    wanted: Sequence[bool],
    steps: int,
) -> list[Tensor | None]:
    setup, k = plan.setup, plan.setup.kernels
    assert tape.tau is not None and tape.grid is not None and tape.velocity is not None
    mass, pull, force, friction = inputs[STATES : STATES + 4]
    a_fixed = [torch.zeros_like(t) for t in inputs[STATES:FIXED]]
    a_mass, a_pull, a_force, a_friction = a_fixed[:4]
    parameters = any(wanted[STATES + 1 : STATES + 4])
    last = [torch.zeros_like(t) for t in inputs[:STATES]]
    now = [torch.empty_like(t) for t in last]
    a_x, a_v, a_C, a_F, _ = now
    a_velocity, a_grid = setup.room.scratch("a_velocity").zero_(), setup.room.scratch("a_grid")
    own.start_adjoint(wanted)
    transfer = [setup.field, setup.held_now, setup.field_origin, setup.field_dx, setup.field_dt, setup.room.size]

    def nodes_adjoint(n: int) -> None:
        arguments = [tape.grid[n], a_velocity, a_grid, at_step(a_pull, n), a_force, a_friction, parameters, True]  # type: ignore[index]
        given = grid_inputs(plan, at_step(pull, n), force, friction)
        plan.launch(k.update_grid_adjoint, setup.room.count // setup.room.chunk, [*given, *arguments])

    n = steps - 1
    if steps % plan.every == 0:
        adjoint.add_frame(last, gradients, steps // plan.every)
    a_out = last[3]
    if own.plastic is not None:
        assert tape.trial is not None  # it is on the tape if the stress is
        a_out = torch.zeros_like(a_out)
        own.plastic.adjoint(tape.trial[n], last[3], a_out)
    moved = [tape.velocity[n], tape.x[n], tape.F[n], tape.v[n + 1], tape.C[n + 1], *last[:3], a_out, a_velocity, a_x, a_F]
    plan.launch(k.grid_to_particles_adjoint, len(mass), [*transfer, *moved], plan.block)
    adjoints = Adjoints(a_grid, a_mass if wanted[STATES] else None, a_x, a_F, a_velocity)
    for n in range(steps - 1, 0, -1):
        nodes_adjoint(n)
        framed = n % plan.every == 0
        frame = [None if g is None or not framed else g[n // plan.every] for g in gradients[:4]]
        before = Before(tape.x[n - 1], tape.F[n - 1], None if tape.trial is None else tape.trial[n - 1], tape.velocity[n - 1])
        own.retreat(before, [tape.x[n], tape.v[n], tape.C[n], tape.F[n], tape.tau[n]], frame, adjoints)
    nodes_adjoint(0)
    a_tau = torch.empty_like(a_F)
    given = [setup.field, setup.field_origin, setup.field_dx, setup.field_dt, setup.room.size, mass, setup.sorted_volume]
    state = [tape.x[0], tape.v[0], tape.C[0], tape.tau[0], a_grid, a_mass, a_x, a_v, a_C, a_tau]
    plan.launch(k.particles_to_grid_adjoint, len(mass), [*given, *state], plan.block)
    own.elastic.adjoint(tape.F[0], a_tau, a_F)
    adjoint.add_frame(now, gradients, 0)
    now[4].zero_()
    return [*now, *a_fixed, *own.gradients()]
