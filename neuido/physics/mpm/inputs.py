"""Inputs of a rollout other than the laws, converted to the solver's dtype and device and validated; shared by MPM and FEM."""

from itertools import pairwise
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from neuido.errors import UserError
from neuido.physics.colliders.tables import ColliderTable
from neuido.physics.effects import coefficients
from neuido.physics.effects.coefficients import Tables
from neuido.physics.effects.parameters import Effects
from neuido.physics.laws.base import ElasticLaw, Law, PlasticLaw
from neuido.types import Particles, ParticleState


class Solver(Protocol):
    """The attributes of `mpm.Simulator` and `FiniteElements` that this module reads; documented there."""

    device: torch.device
    dtype: torch.dtype
    particles: Particles
    state: ParticleState
    mass: Tensor
    volume: Tensor
    dt: Tensor
    gravity: Tensor
    colliders: ColliderTable

    @property
    def scene_count(self) -> int: ...


class RolloutInputs(NamedTuple):
    """Validated inputs of a rollout of S scenes with P particles and K colliders, in the dtype and on the device of the solver."""

    state: ParticleState
    """Initial state."""
    effects: Effects
    """Effects beyond the laws."""
    gravity: Tensor
    """Acceleration of gravity [m/s^2], (S, 3), without effects."""
    force: Tensor
    """`Effects.force_table`."""
    friction: Tensor
    """Friction coefficients [-], (S, K), with the effect `friction`."""
    mass: Tensor
    """Particle masses [kg], (P,), with the effects `added_mass` and `relative_density`."""
    viscosity: Tensor | None
    """`Effects.viscosity` with that of the elastic law [Pa s], (S, 2), or (P, 2) where it differs between the bodies of a scene."""
    tables: Tables | None
    """Tables of the effects that act on the law; None without such effects."""
    stiffness: Tensor | None
    """Factor of each particle's elastic stress [-], (P,)."""
    growth: Tensor | None
    """`Effects.growth` over the steps of the solver [-], (T, S)."""

    def largest_viscosity(self, solver: Solver) -> Tensor | None:
        """Return the largest viscosity of each scene [Pa s], (S, 2)."""
        if self.viscosity is None or len(self.viscosity) <= solver.scene_count:
            return self.viscosity
        return torch.stack([self.viscosity[i:j].detach().amax(0) for i, j in pairwise(solver.particles.offsets)])

    def stiffening(self, solver: Solver) -> tuple[Tensor, Tensor] | None:
        """Return what the effects add to the P-wave modulus of each scene [Pa], and a factor on the sum [-], (S,) float64 each.

        If the stiffness differs between particles, the factor is that of the particle with the fastest wave, scaled to the smallest
        density of the scene, with which the step limit combines the modulus.
        """
        if self.tables is None:
            return None
        added = self.tables.stiffening.double()
        factor = torch.ones(len(self.gravity), dtype=torch.float64, device=self.mass.device)
        if self.stiffness is not None:
            rho = self.mass.detach().double() / solver.volume.double()
            parts = pairwise(solver.particles.offsets)
            factor = torch.stack([(self.stiffness[i:j].detach() / rho[i:j]).max() * rho[i:j].min() for i, j in parts])
        if self.growth is not None:
            factor = factor * self.growth.detach().double().amax(dim=0)
        return added, factor


def prepare(
    solver: Solver,
    steps: int,
    elasticity: ElasticLaw,
    plasticity: PlasticLaw | None,
    *,
    state: ParticleState | None = None,
    effects: Effects | None = None,
    gravity: Tensor | None = None,
    friction: Tensor | None = None,
    mass: Tensor | None = None,
) -> RolloutInputs:
    """Validate and convert the inputs of a rollout, differentiable in all of them; arguments as for `mpm.Simulator.rollout`.

    Raises:
        UserError: What is no law, a shape that does not fit, an effect outside its range or without the law that it needs.
    """
    for name, law in (("elasticity", elasticity), ("plasticity", plasticity)):
        if law is not None and not isinstance(law, Law):
            pair = "; give the two laws of a pair one after the other: rollout(steps, *laws)" if isinstance(law, tuple) else ""
            raise UserError(f"{name} of a rollout must be a law, and is of type {type(law).__name__}{pair}")
    count, like = solver.scene_count, solver.mass

    def own(t: Tensor) -> Tensor:
        return t.to(solver.device, solver.dtype).contiguous()

    state = solver.state if state is None else ParticleState(*(own(t) for t in state))
    effects = with_viscosity(Effects() if effects is None else effects, elasticity.viscosity)
    friction = solver.colliders.friction if friction is None else own(friction)
    if friction.shape != solver.colliders.friction.shape:
        raise UserError(f"friction has shape {tuple(friction.shape)}; it must be {tuple(solver.colliders.friction.shape)}")
    if effects.friction is not None:
        friction = (friction + effects.rows("friction", count, like)).clamp(min=0.0)
    mass = like if mass is None else own(mass)
    if effects.added_mass is not None:
        mass = mass * (1 + effects.rows("added_mass", count, mass)[solver.particles.scene.long(), 0])
    if effects.relative_density is not None:
        mass = mass * effects.particle_factor("relative_density", len(mass), mass)
    tables = stiffness = growth = None
    if effects.changes_law:
        tables = coefficients.tables(effects, elasticity, plasticity, count, like)
        stiffness = effects.particle_stiffness(len(mass), mass)
        growth = effects.growth(solver.dt, steps)
    return RolloutInputs(
        state=state,
        effects=effects,
        gravity=solver.gravity if gravity is None else gravity.to(solver.device, solver.dtype).expand(count, 3),
        force=effects.force_table(count, like).contiguous(),
        friction=friction.contiguous(),
        mass=mass,
        viscosity=_with_bodies(effects.viscosity(count, like), elasticity, solver),
        tables=tables,
        stiffness=stiffness,
        growth=growth,
    )


def with_viscosity(effects: Effects, viscosity: Tensor | None) -> Effects:
    """Return the effects with the shear viscosity of a law [Pa s], (S,), added to their own."""
    if viscosity is None:
        return effects
    own = effects.viscosity_shear
    return effects._replace(viscosity_shear=viscosity if own is None else torch.as_tensor(own).to(viscosity) + viscosity)


def _with_bodies(viscosity: Tensor | None, elasticity: ElasticLaw, solver: Solver) -> Tensor | None:
    """Return the viscosity of the effects [Pa s], (S, 2), with that of the bodies' laws where they bring one, (P, 2)."""
    each = elasticity.particle_viscosity()
    if each is None:
        return viscosity
    own = each.to(solver.mass)[:, None] * solver.mass.new_tensor([1.0, 2.0 / 3.0])
    return own if viscosity is None else own + viscosity[solver.particles.scene.long()]


def waves(
    solver: Solver, elasticity: ElasticLaw, mass: Tensor | None = None, stiffening: tuple[Tensor, Tensor] | None = None
) -> list[tuple[float, float]]:
    """Return the P-wave modulus at rest [Pa] and the smallest density [kg/m^3] of each scene, which bound the stable step.

    Args:
        solver: The simulator.
        elasticity: Elastic law.
        mass: Particle masses [kg], (P,); by default those of the solver.
        stiffening: The result of `RolloutInputs.stiffening`.

    Raises:
        UserError: A modulus that is negative or not a number.
    """
    rho = (solver.mass if mass is None else mass.detach()).double() / solver.volume.double()
    least = torch.stack([rho[i:j].min() for i, j in pairwise(solver.particles.offsets)])
    each = elasticity.particle_modulus()
    if each is None:
        modulus = elasticity.modulus().detach().to(solver.device, torch.float64).expand(solver.scene_count)
    else:  # that of the fastest wave, scaled to the smallest density
        speed2 = each.to(rho) / rho
        modulus = torch.stack([speed2[i:j].max() for i, j in pairwise(solver.particles.offsets)]) * least
    if stiffening is not None:
        modulus = (modulus + stiffening[0]) * stiffening[1]
    out = []
    for s, (value, density) in enumerate(torch.stack([modulus, least], dim=1).tolist()):  # one transfer for all scenes
        if not value >= 0.0:
            raise UserError(f"the law of scene {s} has a P-wave modulus of {value:g} Pa at rest; it must not be negative")
        out.append((value, density))
    return out
