"""Simulate the true motion of a case with any solver and effect; effects outside the library act by operator splitting."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from neuido.physics.effects.parameters import Effects, linear_gradient
from neuido.physics.fem.finite_elements import FiniteElements
from neuido.physics.laws.base import ElasticLaw, PlasticLaw
from neuido.physics.laws.classical import material
from neuido.physics.mpm.simulator import Simulator
from neuido.physics.runtime.events import Event
from neuido.types import Body, ParticleState, Scene

SPLIT = 2e-3
"""Longest time between two velocity updates by an effect outside the library [s]."""
CORE = 0.08
"""Distance below which the force of a magnet stays constant [m]."""
SLOW = 0.05
"""Speed below which dry drag falls to zero [m/s]."""

Field = Callable[[Tensor, Tensor], Tensor]
"""Acceleration [m/s^2] (P, 3) as a function of positions [m] and velocities [m/s] (P, 3)."""


class Solver(NamedTuple):
    """Solver of the motion of a body, with grid and substep."""

    name: str = "same"
    """same, finer or elements."""
    cells: int = 32
    dt: float = 5e-4
    tetrahedra: int = 5
    density: float = 1.0
    """Elements per particle."""

    def describe(self) -> str:
        """Describe the solver in words, for the key."""
        if self.name == "elements":
            return f"explicit finite elements, {self.tetrahedra} linear tetrahedra per cell, {self.density:.2f} elements per particle"
        return f"a material point method, {self.cells} cells per side, substep {self.dt:g} s"


class Motion(NamedTuple):
    """Frames of S recordings of one body."""

    x: np.ndarray
    """Positions [m], (S, K, P, 3)."""
    v: np.ndarray
    """Velocities [m/s], (S, K, P, 3)."""
    interval: float
    """Time between frames [s]."""
    events: tuple[Event, ...] = ()
    """What makes the motion doubtful: matter that turned inside out or collapsed."""

    def at(self, times: np.ndarray, recording: int) -> tuple[np.ndarray, np.ndarray]:
        """Interpolate positions and velocities (T, P, 3) at times [s] (T,) by cubic Hermite splines; before 0 the motion is uniform."""
        x, v, h = self.x[recording], self.v[recording], self.interval
        k = np.clip(np.floor(times / h + 1e-9).astype(int), 0, len(x) - 2)
        u = (times / h - k)[:, None, None]
        x0, x1, v0, v1 = x[k], x[k + 1], v[k] * h, v[k + 1] * h
        place = x0 + u * v0 + u**2 * (3 * (x1 - x0) - 2 * v0 - v1) + u**3 * (2 * (x0 - x1) + v0 + v1)
        place = np.where(u < 0, x0 + u * v0, place)
        return place, ((1 - u) * v0 + u * v1) / h


def simulate_motion(
    solver: Solver,
    scene: Scene,
    bodies: Sequence[Body],
    law: Mapping[str, Any],
    values: Mapping[str, float],
    *,
    seconds: float,
    interval: float,
    device: str = "cpu",
) -> Motion:
    """Simulate the motion of bodies of one material, with effects of the library and outside it.

    Args:
        solver: Grid and substep, or finite elements.
        scene: The declared scene.
        bodies: The body at t = 0 of each recording.
        law: The true density, elasticity and plasticity.
        values: Parameters of the effects by flat names.
        seconds: Duration [s].
        interval: Time between frames [s], a multiple of the substep.
        device: auto, cpu or cuda.

    Raises:
        UserError: The substep is above the stability limit, or a particle leaves the domain.
    """
    scene = replace(scene, cells=solver.cells, dt=solver.dt)
    simulator = _simulator(solver, scene, bodies, law["density"], device)
    every = round(interval / scene.dt)
    frames = math.ceil(seconds / interval - 1e-6)
    elasticity, plasticity = material(law["elasticity"], law["plasticity"])
    known, own = _split_by_library(values)
    effects = Effects.of(known, x=simulator.state.x, scene=simulator.particles.scene)
    slope, lift = own.pop("density_gradient", None), own.pop("moving_floor", None)
    mass = None if slope is None else _graded_masses(simulator, slope)
    if lift is not None:
        effects = effects._replace(**_moving_floor_force(lift, frames * every, scene.dt))
    with torch.no_grad():
        if own:
            out, events = _rollout_with_kicks(simulator, elasticity, plasticity, effects, own, frames, every)
        else:
            out = simulator.rollout(frames * every, elasticity, plasticity, every=every, effects=effects, mass=mass)
            events = out.events
    place, velocity = (t.double().cpu().numpy().reshape(frames + 1, len(bodies), -1, 3).swapaxes(0, 1) for t in (out.x, out.v))
    if lift is not None:  # transform back from the frame of the floor
        t = np.arange(frames + 1) * interval
        w = 2 * math.pi * lift["frequency"]
        up = np.array([0.0, 1.0, 0.0])
        place = place + (lift["amplitude"] * (1 - np.cos(w * t)))[None, :, None, None] * up
        velocity = velocity + (lift["amplitude"] * w * np.sin(w * t))[None, :, None, None] * up
    return Motion(place, velocity, interval, tuple(events))


OUTSIDE_PREFIXES = ("dry_drag.", "moving_floor.", "delayed_spring.", "magnet.", "density_gradient.")


def _simulator(solver: Solver, scene: Scene, bodies: Sequence[Body], density: float, device: str) -> Simulator | FiniteElements:
    scenes = [scene] * len(bodies)
    if solver.name != "elements":
        return Simulator(scenes, bodies, density=density, device=device)
    elements = round(solver.density * len(bodies[0].x))
    return FiniteElements(scenes, bodies, density=density, device=device, elements=elements, tetrahedra=solver.tetrahedra)


def _split_by_library(values: Mapping[str, float]) -> tuple[dict[str, float], dict[str, dict[str, float]]]:
    """Separate effects of the library, by flat names, from those outside it, by name and parameter."""
    known: dict[str, float] = {}
    own: dict[str, dict[str, float]] = {}
    for name, value in values.items():
        if name.startswith(OUTSIDE_PREFIXES):
            effect, _, parameter = name.partition(".")
            own.setdefault(effect, {})[parameter] = value
        else:
            known[name] = value
    return known, own


def _graded_masses(simulator: Simulator | FiniteElements, slope: Mapping[str, float]) -> Tensor:
    """Compute particle masses with a density gradient over each body; the total mass does not change."""
    x, mass = simulator.state.x.double(), simulator.mass.double()
    s = torch.tensor([slope[a] for a in "xyz"], dtype=torch.float64, device=x.device)
    factor = torch.cat([linear_gradient(x[i:j], s) for i, j in zip(simulator.particles.offsets[:-1], simulator.particles.offsets[1:])])
    parts = zip(simulator.particles.offsets[:-1], simulator.particles.offsets[1:])
    return torch.cat([mass[i:j] * factor[i:j] / (mass[i:j] * factor[i:j]).sum() * mass[i:j].sum() for i, j in parts]).to(simulator.mass)


def _moving_floor_force(lift: Mapping[str, float], steps: int, dt: float) -> dict[str, Any]:
    """Return the inertial force in the frame of a floor at height amplitude (1 - cos w t), as a `time_force`.

    The floor starts at rest, so initial velocities are equal in both frames.
    """
    w = 2 * math.pi * lift["frequency"]
    t = torch.arange(steps + 1, dtype=torch.float64) * dt
    force = torch.zeros(steps + 1, 3, dtype=torch.float64)
    force[:, 1] = -lift["amplitude"] * w**2 * torch.cos(w * t)
    return {"time_force": force, "time_force_interval": dt}


def _rollout_with_kicks(
    simulator: Simulator | FiniteElements,
    elasticity: ElasticLaw,
    plasticity: PlasticLaw,
    effects: Effects,
    own: dict[str, dict[str, float]],
    frames: int,
    every: int,
) -> tuple[ParticleState, list[Event]]:
    """Alternate rollouts and velocity updates (Strang splitting); return the frames and the first event of each kind and scene.

    Effects of the library with an internal state, such as `maxwell`, cannot be combined with this.
    """
    dt = float(simulator.dt[0])
    pieces = max(1, math.ceil(every * dt / SPLIT - 1e-9))
    while every % pieces:
        pieces += 1
    steps, h = every // pieces, every * dt / pieces
    state = simulator.state
    scene = simulator.particles.scene.long()
    count = len(simulator.scenes)
    mass = simulator.mass
    total = torch.zeros(count, dtype=mass.dtype, device=mass.device).index_add_(0, scene, mass)

    def mean(t: Tensor) -> Tensor:
        return torch.zeros(count, 3, dtype=t.dtype, device=t.device).index_add_(0, scene, mass[:, None] * t) / total[:, None]

    past = [mean(state.x)]
    kept, events = [state], {}
    for n in range(frames * pieces):
        state = _kick(state, _fields(own, mean, scene, state, past, h), 0.5 * h)
        out = simulator.rollout(steps, elasticity, plasticity, state=state, effects=effects, every=steps, check=n == 0)
        for event in out.events:
            events.setdefault((event.scene, event.kind), event._replace(step=n * steps + event.step, time=n * h + event.time))
        state = ParticleState(*(t[-1] for t in out))
        past.append(mean(state.x))
        state = _kick(state, _fields(own, mean, scene, state, past, h), 0.5 * h)
        if (n + 1) % pieces == 0:
            kept.append(state)
    return ParticleState(*(torch.stack(parts) for parts in zip(*kept))), list(events.values())


def _fields(own: Mapping[str, Mapping[str, float]], mean, scene: Tensor, state: ParticleState, past: list[Tensor], h: float) -> list[Field]:
    def vector(given: Mapping[str, float]) -> Tensor:
        return torch.tensor([given[a] for a in "xyz"], dtype=state.x.dtype, device=state.x.device)

    fields: list[Field] = []
    if (one := own.get("dry_drag")) is not None:
        c = one["c"]
        fields.append(lambda x, v: -c * v / (v.square().sum(1, keepdim=True) + SLOW**2).sqrt())
    if (one := own.get("magnet")) is not None:
        m, place = one["m"], vector(one)
        fields.append(lambda x, v: -m * (x - place) / torch.linalg.vector_norm(x - place, dim=1, keepdim=True).clamp(min=CORE) ** 5)
    if (one := own.get("delayed_spring")) is not None:
        then = past[max(len(past) - 1 - round(one["delay"] / h), 0)]
        pull = (-one["k"] * (then - vector(one)))[scene]
        fields.append(lambda x, v: pull)
    return fields


def _kick(state: ParticleState, fields: Sequence[Field], h: float) -> ParticleState:
    """Apply accelerations for a time h [s]; update velocity gradients by central differences over 2 mm."""
    x, v, C, F = state
    reach = 1e-3
    for field in fields:
        columns = [
            (field(x + reach * e, v + reach * C[:, :, j]) - field(x - reach * e, v - reach * C[:, :, j])) / (2 * reach)
            for j, e in enumerate(torch.eye(3, dtype=x.dtype, device=x.device))
        ]
        v, C = v + h * field(x, v), C + h * torch.stack(columns, dim=2)
    return ParticleState(x, v, C, F)
