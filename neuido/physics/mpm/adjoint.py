"""The backward pass of a rollout: hand-written adjoints of the kernels and of the laws, from the last substep to the first.

What the tape of the forward pass does not contain is computed again.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from neuido.physics.colliders.solid_loop import SolidLoop
from neuido.physics.effects import swelling_kernels
from neuido.physics.laws.base import Engine
from neuido.physics.mpm.plan import (
    ATTACHED,
    BODY_FRICTION,
    FIXED,
    SHRINKAGE,
    SOLIDS,
    SPIN_LOSS,
    STATES,
    Material,
    Plan,
    at_step,
    attachment_loop,
    solid_loop,
)
from neuido.physics.mpm.rollout import (
    Tape,
    add_to_grid,
    flow_inputs,
    grid_inputs,
    meet,
    stress,
    stress_inputs,
    swell,
    update_nodes,
)
from neuido.physics.runtime.device import real_of, torch_stream


def run_backward(
    plan: Plan, inputs: Sequence[Tensor], tape: Tape, gradients: Sequence[Tensor | None], wanted: Sequence[bool], steps: int | None = None
) -> list[Tensor | None]:
    """Compute the gradients of the inputs of a rollout.

    Args:
        plan: The rollout.
        inputs: Inputs of the forward pass.
        tape: Tape of the forward pass.
        gradients: Gradient with respect to the frames of x, v, C, F and the history; None: zero.
        wanted: Which inputs need a gradient.
        steps: Number of substeps; by default those of the plan.

    Returns:
        The gradient of each input; None for tensors of laws that need none.
    """
    setup, k = plan.setup, plan.setup.kernels
    mass_before = None
    mass, pull, force, friction, viscosity = inputs[STATES : STATES + 5]
    a_fixed = [tape.scratch(f"fixed {i}", t).zero_() for i, t in enumerate(inputs[STATES:FIXED])]
    a_mass, a_pull, a_force, a_friction, a_viscosity = a_fixed[:5]
    a_shrinkage, a_loss, a_body_friction = a_fixed[SHRINKAGE - STATES : SOLIDS - STATES]
    parameters = any(wanted[STATES + 1 : STATES + 4])
    now, then = ([tape.scratch(f"{name} {i}", t) for i, t in enumerate(inputs[:STATES])] for name in ("now", "then"))
    for t in now:
        t.zero_()
    scratch, a_tau, other, a_trial = (tape.scratch(name, inputs[3]) for name in ("tau", "a_tau", "trial", "a_trial"))
    a_velocity, a_grid = setup.room.scratch("a_velocity"), setup.room.scratch("a_grid")
    with torch_stream(setup.device):
        elastic, plastic = plan.engines(inputs)
        for engine, own in ((elastic, wanted[FIXED : plan.split]), (plastic, wanted[plan.split :])):
            if engine is not None:
                engine.start_adjoint(own)
                if hasattr(engine, "grads"):  # an engine of several laws has none of its own
                    name = "elastic" if engine is elastic else "plastic"
                    engine.grads = [None if g is None else tape.scratch(f"{name} {i}", g).zero_() for i, g in enumerate(engine.grads)]
        spin = plan.spin_decay(inputs)
        damped = None if spin is None else (torch.empty_like(now[1]), torch.empty_like(now[2]))
        solids = solid_loop(plan, inputs, tape.solids)
        if solids is not None:
            solids.start_adjoint(plan.every, gradients[STATES:], a_fixed[SOLIDS - STATES : ATTACHED - STATES], a_pull, a_friction)
        attached = attachment_loop(plan, inputs, solids)
        for n in reversed(range(plan.steps if steps is None else steps)):
            if (n + 1) % plan.every == 0:
                add_frame(now, gradients, (n + 1) // plan.every)
            x, v, C, F, history = state = tuple(t[n] for t in tape.states)
            v_next, C_next, F_next = tape.v[n + 1], tape.C[n + 1], tape.F[n + 1]
            material, a_material = plan.material(inputs, n), plan.material((*inputs[:STATES], *a_fixed), n)
            if setup.leaving is not None:
                mass_before = a_mass.clone()
            v_in, C_in = v, C  # what P2G reads
            if spin is not None and damped is not None:
                spin.damp(inputs[SPIN_LOSS], mass, x, v, C, *damped, every=True)
                v_in, C_in = damped
            v_free = v_in
            v_in = v_in if attached is None else attached.hold(n, x, v_in, spare=True)
            v_first, mass_in = v_in, mass
            if solids is not None:
                solids.clear(setup.room.count)
            tau, grid, met, velocity = recompute(plan, inputs, tape, n, state, (v_in, C_in), elastic, material, scratch, solids)
            if setup.leaving is not None:
                v_in, mass_in = setup.leaving.entered(v_first, mass)
            shrinkage = at_step(inputs[SHRINKAGE], n)
            a_x, a_v, a_C, a_F, a_history = then
            if setup.leaving is not None:
                setup.leaving.end_adjoint(tape.x[n + 1], now[0])
            a_out = now[3]
            trial = None
            if plan.corrects:
                trial = trial_gradient(plan, F, C_next, shrinkage, other) if tape.trial is None else tape.trial[n]
                a_out = a_trial.zero_()
            if material is not None and a_material is not None:
                update_history_adjoint(plan, material, a_material, trial, C_next, history, F_next, now, a_out, a_history.zero_())
            if plastic is not None:
                assert trial is not None  # a plastic law corrects it
                plastic.adjoint(trial, now[3], a_trial)
            if shrinkage.numel():
                arguments = [shrinkage, F, C_next, a_out, at_step(a_shrinkage, n)]
                swelling = swelling_kernels.build(real_of(setup.dtype))
                plan.launch(swelling.swell_adjoint, len(x), [setup.particles.scene, setup.dt, *arguments])
            plan.launch(k.grid_to_particles_adjoint, len(x),
                        [setup.field, setup.held_now, setup.field_origin, setup.field_dx, setup.field_dt, setup.room.size, velocity, x, F,
                         v_next, C_next, *now[:3], a_out, a_velocity.zero_(), a_x, a_F], plan.block)  # fmt: skip
            if solids is not None:
                free = setup.room.scratch("free")
                update_nodes(plan, met, at_step(pull, n), force, friction, free)
                solids.advance_adjoint(n)
                solids.meet_adjoint(n, setup.room.index, met, free, a_velocity)
                solids.press_adjoint(n, plan.pressed(x, mass_in), a_x, a_mass)
            arguments = [met, a_velocity, a_grid, at_step(a_pull, n), a_force, a_friction, parameters, False]
            inputs_n = grid_inputs(plan, at_step(pull, n), force, friction)
            plan.launch(k.update_grid_adjoint, setup.room.count // setup.room.chunk, [*inputs_n, *arguments])
            if solids is not None:
                a_grid[:, 3] += a_velocity[:, 3]
            a_before = a_grid
            if setup.contact is not None:
                particles = [setup.field, setup.particles.scene, setup.field_origin, setup.field_dx, x, setup.sorted_volume]
                adjoints = [a_grid, setup.room.scratch("a_before"), a_x, a_body_friction]
                a_before = setup.contact.exchange_adjoint(plan.launch, particles, grid, inputs[BODY_FRICTION], *adjoints)
            plan.launch(k.particles_to_grid_adjoint, len(x),
                        [setup.field, setup.field_origin, setup.field_dx, setup.field_dt, setup.room.size, mass_in, setup.sorted_volume, x,
                         v_in, C_in, tau, a_before, a_mass, a_x, a_v, a_C, a_tau], plan.block)  # fmt: skip
            if setup.leaving is not None and mass_before is not None:
                setup.leaving.enter_adjoint(x, v_first, a_v, a_tau, a_mass, mass_before)
            if attached is not None:
                attached.adjoint(n, x, v_free, a_fixed[ATTACHED - STATES], a_mass, a_x, a_v)
            if spin is not None:
                spin.adjoint(inputs[SPIN_LOSS], mass, x, v, C, a_loss, a_mass, a_x, a_v, a_C)
            if viscosity.numel():
                plan.launch(k.add_viscous_stress_adjoint, len(x),
                            [setup.viscosity_rows(viscosity), viscosity, C, F, a_tau, a_C, a_F, a_viscosity])  # fmt: skip
            if material is not None and a_material is not None:
                assert plan.effects is not None  # the kernels of the tables
                if material.stiffness is not None or material.growth is not None or plan.layout.e_max or plan.layout.compaction:
                    elastic.forward(F, other)
                plan.launch(plan.effects.add_effect_stress_adjoint, len(x),
                            [*stress_inputs(plan, material), F, history, other, a_tau, a_F, a_history, *a_material[:4]])  # fmt: skip
            elastic.adjoint(F, a_tau, a_F)
            now, then = then, now
        add_frame(now, gradients, 0)
        if solids is not None:
            solids.end_adjoint()
        of_laws = [*elastic.gradients(), *(() if plastic is None else plastic.gradients())]
    # the memory is that of the next run too
    return [None if t is None else t.clone() for t in (*now, *a_fixed, *of_laws)]


def recompute(
    plan: Plan,
    inputs: Sequence[Tensor],
    tape: Tape,
    n: int,
    state: Sequence[Tensor],
    moving: tuple[Tensor, Tensor],
    elastic: Engine,
    material: Material | None,
    scratch: Tensor,
    solids: SolidLoop | None = None,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return stress, nodal momentum before and after contact of bodies, and nodal velocity of a substep, from the tape or recomputed.

    Args:
        plan: The rollout.
        inputs: Inputs of the forward pass.
        tape: Tape of the forward pass.
        n: Number of the substep.
        state: x, v, C, F and the history before the substep.
        moving: v and C that the nodes receive, after a torque that damps the rotation.
        elastic: Engine of the elastic law.
        material: Tables of material effects in the substep, or None.
        scratch: Memory for a recomputed stress, (P, 3, 3).
        solids: The launches of the solids, or None.
    """
    setup = plan.setup
    mass, pull, force, friction, viscosity = inputs[STATES : STATES + 5]
    x, _, C, F, history = state
    tau = scratch if tape.tau is None else tape.tau[n]
    if tape.tau is None:
        stress(plan, elastic, F, C, history, viscosity, material, tau)
    v_in, C_in = moving
    if setup.leaving is not None:
        v_in, mass = setup.leaving.enter(x, v_in, mass, tau)
    grid = to_grid(plan, x, v_in, C_in, tau, mass, setup.room.scratch("grid")) if tape.grid is None else tape.grid[n]
    met = meet(plan, x, grid, inputs[BODY_FRICTION])
    if solids is not None:
        solids.press(n, plan.pressed(x, mass))
    velocity = setup.room.scratch("velocity") if tape.velocity is None else tape.velocity[n]
    if tape.velocity is None:
        update_nodes(plan, met, at_step(pull, n), force, friction, velocity)
        if solids is not None:
            solids.meet(n, setup.room.index, met, velocity, impulse=solids.spare)
    return tau, grid, met, velocity


def to_grid(plan: Plan, x: Tensor, v: Tensor, C: Tensor, tau: Tensor, mass: Tensor, grid: Tensor) -> Tensor:
    """Zero `grid`, write momentum and mass of the nodes into it, and return it."""
    add_to_grid(plan, x, v, C, tau, mass, grid.zero_())
    return grid


def update_history_adjoint(
    plan: Plan,
    material: Material,
    a_material: Material,
    trial: Tensor | None,
    C: Tensor,
    history: Tensor,
    F: Tensor,
    a_next: Sequence[Tensor],
    a_trial: Tensor,
    a_history: Tensor,
) -> None:
    """Compute the adjoint of `rollout.update_history`.

    Adds to the adjoints of C and F after the substep (in `a_next`), of the trial gradient and of the history before the substep.
    """
    setup, k = plan.setup, plan.effects
    assert k is not None  # the kernels of the tables
    a_C, a_F, a_history_next = a_next[2:]
    if plan.layout.compaction:
        plan.launch(k.compact_adjoint, len(F), [trial, F, plan.layout.compaction_column, a_history_next, a_trial, a_F, a_history])
    if plan.layout.e_max:
        plan.launch(k.remember_adjoint, len(F), [F, plan.layout.e_max_column, history, a_history_next, a_F, a_history])
    if material.flow is not None:
        adjoints = [a_F, a_history_next, a_trial, a_C, a_history, a_material.flow, a_material.stiffness, a_material.growth]
        plan.launch(k.flow_adjoint, len(F), [*flow_inputs(plan, material), trial, C, history, *adjoints])
    if material.branches is not None:
        arguments = [C, history, a_history_next, a_C, a_history, a_material.branches]
        plan.launch(k.relax_adjoint, len(F), [setup.particles.scene, setup.dt, material.branches, *arguments])


def trial_gradient(plan: Plan, F: Tensor, C_next: Tensor, shrinkage: Tensor, out: Tensor) -> Tensor:
    """Compute the trial gradient F_tr = (I + dt C) F of a substep, less what swelling takes, as the forward pass did.

    Args:
        plan: The rollout.
        F: Deformation gradient before the substep [-], (P, 3, 3).
        C_next: Affine velocity after the substep [1/s], (P, 3, 3).
        shrinkage: `Effects.shrinkage` of the substep [-], (S,), or empty.
        out: The trial gradient [-], (P, 3, 3); overwritten and returned.
    """
    plan.launch(plan.setup.kernels.trial_gradient, len(F), [plan.setup.particles.scene, plan.setup.dt, F, C_next, out])
    if shrinkage.numel():
        swell(plan, shrinkage, out)
    return out


def add_frame(now: Sequence[Tensor], gradients: Sequence[Tensor | None], frame: int) -> None:
    """Add the gradients of one frame to the adjoints of the state."""
    for a, gradient in zip(now, gradients):
        if gradient is not None:
            a.add_(gradient[frame])
