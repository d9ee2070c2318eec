"""The same substep as in `simulator`, in plain torch and differentiable by autograd: a slow reference for tests and benchmarks.

It is written from the equations and shares with the kernels only the tables of colliders, clamps and effects and the order of the bodies.
Laws and effects are those of `constitutive.Constitutive`, contact between bodies is `multibody.contact_twin`.
"""

import torch
from torch import Tensor

from neuido.physics.colliders.contact import SEPARATE, SLIP, STICKY
from neuido.physics.effects.constitutive import Constitutive, History
from neuido.physics.effects.parameters import Effects
from neuido.physics.laws.base import ElasticLaw, PlasticLaw
from neuido.physics.mpm.simulator import Simulator
from neuido.physics.multibody.contact_twin import exchange
from neuido.types import ParticleState


def _splines(cells: Tensor) -> tuple[Tensor, Tensor]:
    """Return the first node (P, 3) and the weights (P, 3 nodes, 3 axes) of the quadratic B-spline at positions in cells."""
    base = torch.floor(cells.detach() - 0.5)
    f = cells - base
    weights = torch.stack([0.5 * (1.5 - f) ** 2, 0.75 - (f - 1.0) ** 2, 0.5 * (f - 0.5) ** 2], dim=1)
    return base.long(), weights


def _slopes(f: Tensor, w: Tensor, offsets: Tensor) -> Tensor:
    """Return the gradient of the weights at the 27 nodes of each particle in the position of the node [1/cell], (P, 27, 3).

    Args:
        f: Distance of each particle to its first node [cells], (P, 3).
        w: Weights, (P, 3 nodes, 3 axes).
        offsets: Number of each node along each axis, (27, 3).
    """
    g = -torch.stack([f - 1.5, -2.0 * (f - 1.0), f - 0.5], dim=1)
    picked = [[(g if axis == along else w)[:, offsets[:, axis], axis] for axis in range(3)] for along in range(3)]
    return torch.stack([a * b * c for a, b, c in picked], dim=-1)


def _contact(v: Tensor, normal: Tensor, kind: int, friction: Tensor) -> Tensor:
    vn = (v * normal).sum(-1, keepdim=True)
    tangent = v - vn * normal
    if kind == STICKY:
        return torch.zeros_like(v)
    if kind == SLIP:
        return tangent
    assert kind == SEPARATE
    speed = tangent.norm(dim=-1, keepdim=True)
    stuck = (speed < -friction * vn) | (vn >= 0.0)
    safe = torch.where(stuck | (speed == 0.0), torch.ones_like(speed), speed)
    slid = torch.where(stuck, torch.zeros_like(v), tangent * (1.0 + torch.where(stuck, 0.0, friction * vn) / safe))
    return torch.where(vn < 0.0, slid, v)


def damp_spin(x: Tensor, v: Tensor, C: Tensor | None, mass: Tensor, spread: Tensor | float, loss: Tensor) -> tuple[Tensor, Tensor | None]:
    """Return v and C of one body after the torque of `Effects.spin_decay`, by explicit sums.

    Args:
        x: Positions [m], (P, 3).
        v: Velocities [m/s], (P, 3).
        C: Affine velocities [1/s], (P, 3, 3); None: nodes, which do not rotate within themselves.
        mass: Masses [kg], (P,).
        spread: dx^2/4 [m^2].
        loss: Share of the angular momentum that goes [-].
    """
    share = (mass / mass.sum())[:, None]
    r, u = x - (share * x).sum(0), v - (share * v).sum(0)
    eye = torch.eye(3, dtype=x.dtype, device=x.device)
    inertia = (mass[:, None, None] * ((r * r).sum(1)[:, None, None] * eye - r[:, :, None] * r[:, None, :])).sum(0)
    L = (mass[:, None] * torch.linalg.cross(r, u)).sum(0)
    if C is not None:
        inertia = inertia + 2 * spread * mass.sum() * eye
        turn = torch.stack([C[:, 2, 1] - C[:, 1, 2], C[:, 0, 2] - C[:, 2, 0], C[:, 1, 0] - C[:, 0, 1]], dim=1)
        L = L + spread * (mass[:, None] * turn).sum(0)
    w = loss * torch.linalg.solve(inertia, L)
    if C is not None:
        C = C - torch.linalg.cross(w.expand(3, 3), eye).mT
    return v - torch.linalg.cross(w.expand_as(r), r), C


def substep(
    sim: Simulator,
    state: ParticleState,
    material: Constitutive,
    history: History,
    pull: Tensor,
    *,
    time: Tensor | float = 0.0,
    friction: Tensor | None = None,
    mass: Tensor | None = None,
) -> tuple[ParticleState, History]:
    """Simulate one substep of all scenes.

    Args:
        sim: The scenes.
        state: Before the substep.
        material: Laws and effects.
        history: Before the substep.
        pull: Gravity and the other uniform accelerations [m/s^2], (S, 3).
        time: At the start [s], a number or one for each particle.
        friction: As in `Simulator.rollout`.
        mass: As in `Simulator.rollout`, added mass included.
    """
    effects, setup = material.effects, sim.setup
    friction = sim.colliders.friction if friction is None else friction
    mass = sim.mass if mass is None else mass
    force = effects.force_table(sim.scene_count, sim.mass)
    if force.shape[1] == 6:
        force = torch.cat([force, force.new_zeros(sim.scene_count, 5)], dim=1)
    eye = torch.eye(3, dtype=sim.dtype, device=sim.device)
    loss = effects.spin_loss(sim.dt)
    parts = []
    tau_all = material.stress(state.F, state.C, history, time)
    for s in range(sim.scene_count):
        own = slice(sim.particles.offsets[s], sim.particles.offsets[s + 1])
        x, v, C, F = (t[own] for t in state)
        tau, m, volume = tau_all[own], mass[own], sim.volume[own]
        dx, dt = sim.dx[s], sim.dt[s]
        if loss is not None:
            v, C = damp_spin(x, v, C, m, dx**2 / 4, loss[s, 0])
        base, w = _splines((x - setup.origin[s]) / dx)
        offsets = torch.cartesian_prod(*[torch.arange(3, device=sim.device)] * 3)
        nodes = base[:, None, :] + offsets
        weight = w[:, offsets[:, 0], 0] * w[:, offsets[:, 1], 1] * w[:, offsets[:, 2], 2]
        arm = setup.origin[s] + nodes * dx - x[:, None, :]
        shape = setup.room.shape[1:]
        flat = ((nodes[..., 0] * shape[1] + nodes[..., 1]) * shape[2] + nodes[..., 2]).reshape(-1)
        affine = m[:, None, None] * C - dt * volume[:, None, None] * 4.0 / dx**2 * tau
        momentum = weight[..., None] * (m[:, None, None] * v[:, None, :] + torch.einsum("pab,pnb->pna", affine, arm))
        fields, size = int((setup.field_scene == s).sum()), shape[0] * shape[1] * shape[2]
        field = (setup.field[own] - setup.field[own].min()).long().repeat_interleave(27)
        flat = field * size + flat
        grid_p = x.new_zeros(fields * size, 3)
        grid_m = x.new_zeros(fields * size)
        grid_p = grid_p.index_add(0, flat, momentum.reshape(-1, 3))
        grid_m = grid_m.index_add(0, flat, (weight * m[:, None]).reshape(-1))
        if fields > 1:
            slope = _slopes((x - setup.origin[s]) / dx - base, w, offsets) * (volume / dx)[:, None, None]
            gradient = x.new_zeros(fields * size, 3).index_add(0, flat, slope.reshape(-1, 3)).reshape(fields, size, 3)
            half = 0.5 * volume.pow(1 / 3).repeat_interleave(27)
            table = sim.setup.contact.friction[s].reshape(sim.setup.contact.bodies, -1)  # type: ignore[union-attr]
            arms = (flat, -arm.detach().reshape(-1, 3), half)
            grid_p = exchange(
                grid_p.reshape(fields, size, 3), grid_m.reshape(fields, size), gradient, table, arms, float(dx), float(dt)
            ).reshape(-1, 3)
        full = grid_m > 0
        u = grid_p / torch.where(full, grid_m, 1.0)[:, None]
        index = torch.cartesian_prod(*[torch.arange(n, device=sim.device) for n in shape])
        place = (setup.origin[s] + index * dx).repeat(fields, 1)
        u = u + dt * (pull[s] - force[s, 2] * (place - force[s, 3:6]))
        w = 0.5 * dt * torch.linalg.cross(force[s, 6:9].expand(3, 3), eye).mT  # half of w x, for Cayley's rotation
        u = u @ torch.linalg.solve(eye - w, eye + w).mT
        speed = torch.where(full[:, None], u, 1.0).norm(dim=1, keepdim=True)
        u = u / (1.0 + dt * (force[s, 0] + force[s, 1] * speed))
        for c in range(sim.colliders.kind.shape[1]):
            kind = int(sim.colliders.kind[s, c])
            if kind:
                normal, offset = sim.colliders.plane[s, c, :3], sim.colliders.plane[s, c, 3]
                inside = place @ normal <= offset
                met = _contact(torch.where(full[:, None], u, 1.0), normal, kind, friction[s, c]) * torch.exp(-dt * force[s, 9])
                outward = (met @ normal).clamp(min=0.0)[:, None] * normal
                met = met - (1.0 - torch.exp(-dt * force[s, 10])) * outward
                u = torch.where((inside & full)[:, None], met, u)
        for lower, upper in zip(setup.clamp_lower[s], setup.clamp_upper[s]):
            u = torch.where(((place >= lower) & (place <= upper)).all(1, keepdim=True), 0.0, u)
        u = torch.where(full[:, None], u, 0.0)[flat].reshape(len(x), 27, 3)
        held = sim.held[own].bool()
        v_next = torch.where(held[:, None], 0.0, (weight[..., None] * u).sum(1))
        C_next = 4.0 / dx**2 * torch.einsum("pn,pna,pnb->pab", weight, u, arm)
        C_next = torch.where(held[:, None, None], 0.0, C_next)
        parts.append((x + dt * v_next, v_next, C_next, (eye + dt * C_next) @ F))
    x, v, C, trial = (torch.cat(t) for t in zip(*parts))
    F, history = material.advance(trial, C, history, sim.dt[sim.particles.scene.long()], time)
    return ParticleState(x, v, C, F), history


def rollout(
    sim: Simulator,
    steps: int,
    elasticity: ElasticLaw,
    plasticity: PlasticLaw | None = None,
    *,
    state: ParticleState | None = None,
    effects: Effects | None = None,
    gravity: Tensor | None = None,
    friction: Tensor | None = None,
    mass: Tensor | None = None,
    every: int = 1,
) -> ParticleState:
    """Simulate `steps` substeps; arguments and shapes of the result are those of `Simulator.rollout`."""
    state = sim.state if state is None else state
    effects = Effects() if effects is None else effects
    mass = sim.mass if mass is None else mass
    scene = sim.particles.scene.long()
    material = Constitutive(elasticity, plasticity, effects, count=len(mass), dtype=sim.dtype, particles=sim.particles)
    history = material.start()
    pull = effects.accelerations(sim.gravity if gravity is None else gravity, sim.dt, steps)
    if effects.added_mass is not None:
        mass = mass * (1 + effects.rows("added_mass", sim.scene_count, mass)[scene, 0])
    if effects.relative_density is not None:
        mass = mass * effects.particle_factor("relative_density", len(mass), mass)
    if effects.friction is not None:
        friction = sim.colliders.friction if friction is None else friction
        friction = (friction + effects.rows("friction", sim.scene_count, mass)).clamp(min=0.0)
    frames = [state]
    for n in range(steps):
        state, history = substep(
            sim, state, material, history, pull[n if len(pull) > 1 else 0], time=n * sim.dt[scene], friction=friction, mass=mass
        )
        if (n + 1) % every == 0:
            frames.append(state)
    return ParticleState(*(torch.stack(parts) for parts in zip(*frames)))
