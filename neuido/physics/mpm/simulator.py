"""The differentiable material point method: one autograd function for a whole rollout, several scenes in one launch.

This module validates the inputs and starts the rollout. `rollout.py` has the forward loop, `adjoint.py` the backward loop,
`differentiable.py` the autograd functions and `graphs.py` the CUDA graphs. A substep has the paper's order (appendix, "Material Point
Method"): P2G with tau(F), grid update, G2P, F_tr = (I + dt C) F, F = F_hat(F_tr). `reference.py` is a slow implementation for tests.
"""

import functools
import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from neuido.errors import UserError
from neuido.physics.colliders.attachments import rates
from neuido.physics.colliders.collider_frames import collider_frames
from neuido.physics.colliders.leaving import OnLeave, checked_on_leave
from neuido.physics.colliders.solid_loop import kernel_inputs
from neuido.physics.colliders.solid_tables import SolidInputs, solid_inputs
from neuido.physics.effects.parameters import Effects
from neuido.physics.laws.base import ElasticLaw, PlasticLaw, strain_limit
from neuido.physics.laws.composite import laws_of_bodies
from neuido.physics.mpm import inputs
from neuido.physics.mpm.differentiable import permuted, run
from neuido.physics.mpm.graphs import RolloutCache
from neuido.physics.mpm.plan import Plan
from neuido.physics.mpm.state import Setup
from neuido.physics.multibody.scene_bodies import bodies_of, labels
from neuido.physics.runtime.deprecated import renamed_option
from neuido.physics.runtime.device import as_device
from neuido.physics.runtime.events import Marks, OnInversion, checked_option, raise_inversions
from neuido.physics.runtime.frames import Frames
from neuido.physics.runtime.invalidation import invalidate
from neuido.physics.runtime.limits import check_frames
from neuido.physics.runtime.threads import scene_pool
from neuido.types import Body, ParticleState, Scene

COURANT_LIMIT = 1.0
"""Upper bound of the Courant number dt c / dx and of 2 dt nu / dx^2; c: elastic P-wave speed, nu: kinematic P-viscosity."""


RESOLUTION = 256.0
"""Rounding units of a position that a step at the largest likely speed has at least; below, float32 carries what it rounds off."""


class StepLimit(NamedTuple):
    """The longest stable time steps of one scene [s]."""

    of_waves: float
    """Limit set by the elastic P-wave."""
    of_viscosity: float
    """Limit set by viscous diffusion; infinite without viscosity."""


class Simulator:
    """Simulate one or several scenes by MPM, each with one or several bodies; kernel launches are batched over scenes.

    Args:
        scenes: One scene or a list; grid, time step, gravity and colliders may differ between them.
        bodies: One body per scene; None: the scenes bring theirs (`Scene.bodies`).
        density: Mass density of the bodies that bring none [kg/m^3], one number or one per scene.
        device: `auto` (CUDA where there is one), `cpu`, `cuda`, or a `torch.device`.
        dtype: `torch.float32` for production, `torch.float64` for gradient checks.
        threads: On the CPU, run scenes in parallel, one thread per core.
        graphs: On CUDA, capture the launches of a rollout as a CUDA graph once per shape and replay it afterwards.
        store: What a forward pass stores of each substep for the backward pass. `state`: x, v, C, F (96 bytes a particle in
            float32); stress, trial gradient and grid are recomputed. `all`: these too (72 bytes more a particle, 32 a node), which is
            faster. `auto`: `all` if there are at most four nodes per particle, on the CPU eight, else `state`.
        grid: Extent of the grid. `domain`: all of it. `window`: a block that follows the matter, so that memory goes with the bodies and
            not with the domain. `auto`: `window` if the nodes of the domain take more than 256 MB and more than the particles.
        on_inversion: What a rollout does where matter turns inside out or collapses (det F below 0.001). `report`: `Frames.events` has
            it. `error`: it raises, or makes the scene NaN with `nan_on_failure`.
        on_leave: What happens to a particle that leaves the domain. `error`: the rollout raises as soon as the grid, which reaches a cell
            and a half further, holds it no longer. `clamp`: at the faces it keeps its position and loses its velocity outwards.
            `delete`: it stays where it left, at rest, and has no effect on the others. `Frames.events` counts them.
        fusion: Launches of a substep. `fused`: one for the particles, from gather to scatter, and one for the nodes, where laws and scene
            allow it. `transfers`: the laws by themselves, between transfers that sum by warp. `separate`: one for each part of a substep,
            the slow reference. `auto`: the fastest of them on the device.
        keep: Deprecated name of `store`.

    Raises:
        UserError: A body outside its domain, a clamp or an attached mass that contains no particle, a shape that does not fit.

    Attributes:
        state: `ParticleState` at t = 0, with C the gradient of the initial velocity.
        mass: Particle masses [kg], (P,), attached masses included.
        volume: Initial volumes [m^3], (P,).
        particles: `Particles`, the scene that each particle belongs to.
        bodies: The bodies of each scene.
    """

    def __init__(
        self,
        scenes: Scene | Sequence[Scene],
        bodies: Body | Sequence[Body] | None = None,
        *,
        density: float | Sequence[float] = 1000.0,
        device: str | torch.device = "auto",
        dtype: torch.dtype = torch.float32,
        threads: bool = True,
        graphs: bool = True,
        store: Literal["state", "all", "auto"] = "auto",
        grid: Literal["domain", "window", "auto"] = "auto",
        on_inversion: OnInversion = "report",
        on_leave: OnLeave = "error",
        fusion: Literal["auto", "fused", "transfers", "separate"] = "auto",
        keep: Literal["state", "all", "auto"] | None = None,
    ) -> None:
        store = renamed_option("store", store, "keep", keep)
        if store not in ("state", "all", "auto"):
            raise UserError(f"store is {store!r}; choose state, all or auto")
        if grid not in ("domain", "window", "auto"):
            raise UserError(f"grid is {grid!r}; choose domain, window or auto")
        if fusion not in ("auto", "fused", "transfers", "separate"):
            raise UserError(f"fusion is {fusion!r}; choose auto, fused, transfers or separate")
        self.on_inversion = checked_option(on_inversion)
        self.scenes = (scenes,) if isinstance(scenes, Scene) else tuple(scenes)
        self.bodies = bodies_of(self.scenes, bodies, density)
        self.setup = setup = Setup(self.scenes, self.bodies, as_device(device), dtype, store, grid, fusion)
        setup.watch_faces(checked_on_leave(on_leave))
        self.device, self.dtype = setup.device, dtype
        self.particles, self.state, self.mass, self.volume = setup.particles, setup.state, setup.mass, setup.volume
        self.order, self.inverse, self.held = setup.order, setup.inverse, setup.held
        self.dt, self.dx, self.gravity, self.colliders = setup.dt, setup.dx, setup.gravity, setup.colliders
        self.cache = RolloutCache(graphs and self.device.type == "cuda")
        self.alone = all(len(own.bodies) == 1 and own.bodies[0].law is None for own in self.bodies)
        self.pool = scene_pool() if threads and self.device.type == "cpu" and len(self.scenes) > 1 and self.alone else None

    @functools.cached_property
    def own_laws(self) -> tuple[ElasticLaw, PlasticLaw | None]:
        """The elastic and the plastic law that the bodies bring.

        Raises:
            UserError: A body without a law, or a field that does not fit.
        """
        return laws_of_bodies([body for own in self.bodies for body in own.bodies], self.order)

    @property
    def scene_count(self) -> int:
        """The number of scenes S."""
        return len(self.scenes)

    def __repr__(self) -> str:
        count = len(self.scenes)
        cells = sorted({scene.cells for scene in self.scenes})
        dts = sorted({scene.dt for scene in self.scenes})
        return (f"Simulator({count} scene{'' if count == 1 else 's'}, {len(self.mass)} particles, {_span(cells)} cells, "
                f"dt {_span(dts)} s, {str(self.dtype).removeprefix('torch.')} on {self.device})")  # fmt: skip

    def solid_inputs(self, steps: int) -> SolidInputs:
        """Return pose, motion, mass and friction of the solid colliders of the scenes, for a rollout of `steps` substeps.

        Raises:
            UserError: There is no solid, or a path or an inertia is none.
        """
        if self.setup.solids is None:
            raise UserError("the scenes have no solid colliders; give `colliders` such as Sphere or Cuboid")
        return solid_inputs(self.scenes, steps, self.device)

    def _solid_tensors(self, steps: int, given: SolidInputs | None, effects: Effects) -> list[Tensor | None]:
        """Return the tensors of solids that the kernels read; None each without solids."""
        if self.setup.solids is None:
            if given is not None:
                raise UserError("`solids` is given and the scenes have no solid colliders")
            return [None] * 4
        own = self.solid_inputs(steps)
        if given is not None:
            for name, t, like in zip(own._fields, given, own):
                rows = (steps, *like.shape[1:]) if name == "twist" else like.shape
                if t.shape not in (rows, like.shape):
                    raise UserError(f"solids.{name} has shape {tuple(t.shape)}; it must be {tuple(rows)}")
            if bool(((given.mass > 0) != (own.mass > 0)).any()):
                raise UserError("solids.mass frees a collider or holds a free one; give `mass` where the collider is made")
            own = SolidInputs(*(t.to(self.device, torch.float64) for t in given))
        if effects.friction is not None:
            more = effects.rows("friction", self.scene_count, self.mass)
            own = own._replace(friction=(own.friction + more).clamp(min=0.0))
        return list(kernel_inputs(own))

    def _attachment_rates(self, given: Tensor | None, mass: Tensor) -> Tensor | None:
        """Return the rates of the attachments for the kernels, for masses in their order; None without attachments."""
        table = self.setup.attached
        if given is not None and (table is None or given.shape != table.given.shape):
            wanted = 0 if table is None else len(table.given)
            raise UserError(f"attachments has shape {tuple(given.shape)}; the scenes have {wanted} attachments, so give ({wanted}, 2)")
        return None if table is None else rates(table, given, mass)

    def step_limits(
        self,
        elasticity: ElasticLaw,
        viscosity: Tensor | None = None,
        mass: Tensor | None = None,
        stiffening: tuple[Tensor, Tensor] | None = None,
    ) -> list[StepLimit]:
        """Return the longest stable step of each scene; arguments are those of `check_step`.

        Raises:
            UserError: A negative modulus.
        """
        out = []
        viscosities = None if viscosity is None else viscosity.detach().double().tolist()
        for s, (modulus, density) in enumerate(inputs.waves(self, elasticity, mass, stiffening)):
            dx, viscous = self.scenes[s].dx, math.inf
            if viscosities is not None:
                eta, zeta = viscosities[s]
                viscous = COURANT_LIMIT * dx**2 * density / max(2.0 * (4.0 / 3.0 * eta + zeta), 1e-30)
            out.append(StepLimit(COURANT_LIMIT * dx / max((modulus / density) ** 0.5, 1e-30), viscous))
        return out

    def _laws(self, elasticity: ElasticLaw | None, plasticity: PlasticLaw | None) -> tuple[ElasticLaw, PlasticLaw | None]:
        """Return the laws of a rollout: the given ones, or those of the bodies.

        Raises:
            UserError: A plastic law without an elastic one, or bodies without a law.
        """
        if elasticity is not None:
            return elasticity, plasticity
        if plasticity is not None:
            raise UserError("a rollout got a plastic law without an elastic one; give both, or none to use those of the bodies")
        return self.own_laws

    def step_margin(
        self, steps: int, elasticity: ElasticLaw | None = None, plasticity: PlasticLaw | None = None, *, effects: Effects | None = None
    ) -> float:
        """Return the smallest ratio of stable to actual time step over the scenes; below 1, `rollout` raises.

        Raises:
            UserError: As `rollout`, except for an unstable step.
        """
        elasticity, plasticity = self._laws(elasticity, plasticity)
        given = inputs.prepare(self, steps, elasticity, plasticity, effects=effects)
        limits = self.step_limits(elasticity, given.largest_viscosity(self), given.mass, given.stiffening(self))
        crossing = [scene.dx / max(speed, 1e-30) for speed, scene in zip(self._speeds(), self.scenes)]
        return min(min(*limit, own) / scene.dt for limit, own, scene in zip(limits, crossing, self.scenes))

    def _speeds(self) -> list[float]:
        """Return the largest initial speed of the body of each scene [m/s]."""
        speed = self.state.v.norm(dim=1)
        return torch.stack([speed[i:j].max() for i, j in pairwise(self.particles.offsets)]).tolist()

    def _rounds_off(self, state: ParticleState, pull: Tensor, steps: int) -> bool:
        """Return whether a step at the largest likely speed is so short that float32 would lose a part of the motion (`RESOLUTION`)."""
        if self.dtype != torch.float32:
            return False
        with torch.no_grad():
            largest = [state.v.norm(dim=1).amax(), pull.norm(dim=-1).amax(), state.x.abs().amax(), self.dt.amin(), self.dt.amax()]
            speed, acceleration, reach, shortest, longest = torch.stack(largest).tolist()
        return (speed + acceleration * longest * steps) * shortest < RESOLUTION * torch.finfo(torch.float32).eps * reach

    def check_step(
        self,
        elasticity: ElasticLaw,
        viscosity: Tensor | None = None,
        mass: Tensor | None = None,
        stiffening: tuple[Tensor, Tensor] | None = None,
    ) -> None:
        """Raise where the time step is too long for the elastic wave, the viscosity or the initial speed.

        Args:
            elasticity: Elastic law; its P-wave modulus sets the wave speed.
            viscosity: `Effects.viscosity` [Pa s], (S, 2).
            mass: Particle masses [kg], (P,).
            stiffening: What effects add to the P-wave modulus [Pa], and their largest factor on the sum, (S,) each.

        Raises:
            UserError: A negative modulus, dt c / dx above `COURANT_LIMIT`, a viscosity too large for an explicit step, or a body that
                starts faster than one cell a step.
        """
        for why in self._refusals(elasticity, viscosity, mass, stiffening):
            if why:
                raise UserError(why)

    def _refusals(
        self, elasticity: ElasticLaw, viscosity: Tensor | None, mass: Tensor | None, stiffening: tuple[Tensor, Tensor] | None
    ) -> list[str]:
        """Return for each scene why its step is too long, as `check_step` reports it; an empty string where the step is stable."""
        out = []
        limits, speeds = self.step_limits(elasticity, viscosity, mass, stiffening), self._speeds()
        for s, (scene, limit, speed) in enumerate(zip(self.scenes, limits, speeds)):
            why = ""
            if scene.dt > limit.of_waves:
                wave = COURANT_LIMIT * scene.dx / limit.of_waves
                why = (f"dt is {scene.dt:g} s in scene {s}, above the limit {limit.of_waves:.3g} s of a wave of {wave:.4g} m/s on "
                       f"cells of {scene.dx:.4g} m; lower `dt`, `cells` or the stiffness")  # fmt: skip
            elif viscosity is not None and scene.dt > limit.of_viscosity:
                bulk = float((viscosity[s, 1] - 2.0 / 3.0 * viscosity[s, 0]).detach())  # in the type in which it was added
                eta = float(viscosity[s, 0].detach())
                why = (f"dt is {scene.dt:g} s in scene {s}, above the limit {limit.of_viscosity:.3g} s of a shear viscosity of "
                       f"{eta:.3g} and a bulk viscosity of {bulk:.3g} Pa s; lower `dt` or the viscosity")  # fmt: skip
            elif speed * scene.dt >= scene.dx:
                why = (f"the body of scene {s} starts with {speed:.4g} m/s and crosses a cell of {scene.dx:.4g} m in a step of "
                       f"{scene.dt:g} s; lower `dt`")  # fmt: skip
            out.append(why)
        return out

    def rollout(
        self,
        steps: int,
        elasticity: ElasticLaw | None = None,
        plasticity: PlasticLaw | None = None,
        *,
        state: ParticleState | None = None,
        effects: Effects | None = None,
        gravity: Tensor | None = None,
        friction: Tensor | None = None,
        mass: Tensor | None = None,
        body_friction: Tensor | float | None = None,
        solids: SolidInputs | None = None,
        attachments: Tensor | None = None,
        every: int = 1,
        segment: int | None = None,
        check: bool = True,
        nan_on_failure: bool = False,
        lenient: bool | None = None,
    ) -> Frames:
        """Simulate `steps` substeps.

        Differentiable with respect to `state`, `gravity`, `friction`, `mass`, `body_friction` and the tensors of laws and effects.

        Args:
            steps: Number of substeps.
            elasticity: F -> Kirchhoff stress; None: the laws that the bodies bring.
            plasticity: Trial F -> corrected F; None: purely elastic.
            state: Initial state, (P, ...); by default the bodies as loaded.
            effects: Physical effects beyond the laws.
            gravity: [m/s^2], (S, 3); by default that of the scenes.
            friction: Friction coefficients, (S, K): colliders first, then walls.
            mass: [kg], (P,); by default density times volume.
            body_friction: Coulomb's coefficient between the bodies [-], a number, (S,), or (S, B, B) for each pair of up to B bodies, of
                which the mean of both orders counts; by default that of the scenes.
            solids: Pose, motion, mass and friction of solid colliders; by default `solid_inputs(steps)`, those of the scenes.
            attachments: Stiffness [N/m] and damping [N s/m] of the attachments of all scenes, (A, 2); by default those of the scenes.
            every: Substeps between two frames.
            segment: Substeps between two checkpoints of gradient checkpointing, for long rollouts. The backward pass recomputes each
                segment, which takes a third more time. On CUDA it applies without gradients too: one captured segment is replayed for
                all. It must divide `steps` and be a multiple of `every`.
            check: Whether to compare the time step with the stability limit first.
            nan_on_failure: Instead of raising, set the frames of a scene to NaN if its step is too long or its motion fails; other
                scenes are unaffected.
            lenient: Deprecated name of `nan_on_failure`.

        Returns:
            Frames x (K, P, 3), v (K, P, 3), C (K, P, 3, 3), F (K, P, 3, 3), K = steps / every + 1; frame 0 is the initial state. They
            unpack to these four, have `times` and can be saved (`Frames`).

        Raises:
            UserError: Before the start, an unstable step; afterwards, a particle that left the domain, is too fast, or is not finite.
        """
        nan_on_failure = renamed_option("nan_on_failure", nan_on_failure, "lenient", lenient)
        check_frames(steps, every)
        elasticity, plasticity = self._laws(elasticity, plasticity)
        if segment is not None and (segment < 1 or steps % segment or segment % every):
            raise UserError(f"segment is {segment}; it must divide steps ({steps}) and be a multiple of every ({every})")
        given = inputs.prepare(
            self, steps, elasticity, plasticity, state=state, effects=effects, gravity=gravity, friction=friction, mass=mass
        )
        pull = given.effects.accelerations(given.gravity, self.dt, steps).contiguous()
        step = (elasticity, given.largest_viscosity(self), given.mass, given.stiffening(self))
        refused = [""] * self.scene_count
        if check and nan_on_failure:
            refused = self._refusals(*step)
        elif check:
            self.check_step(*step)
        tables, mass = given.tables, given.mass
        shrinkage, loss = given.effects.shrinkage(self.dt, steps), given.effects.spin_loss(self.dt)
        swells = shrinkage is not None and self.dtype == torch.float32  # a change of 1e-6 a substep is lost in the rounding of F
        compensated = swells or self._rounds_off(given.state, pull, steps)
        plan = Plan(self.setup, elasticity, plasticity, steps, every, tables, nan_on_failure, compensated=compensated)
        law_tensors = [t.to(self.device, self.dtype).contiguous() for t in plan.law_tensors()]
        history = mass.new_zeros(len(mass), plan.layout.width)
        start = [permuted(t, self.order, self.inverse) for t in (*given.state, history, mass)]
        viscosity = given.viscosity
        if viscosity is not None and len(viscosity) > self.scene_count:
            viscosity = viscosity[self.order]
        optional = [viscosity, None if given.stiffness is None else given.stiffness[self.order], given.growth]
        optional += [None] * 3 if tables is None else [tables.material, tables.branches, tables.flow]
        between = None if self.setup.contact is None else self.setup.contact.frictions(body_friction)
        optional += [shrinkage, loss, between, *self._solid_tensors(steps, solids, given.effects)]
        optional += [self._attachment_rates(attachments, start[-1])]
        optional = [mass.new_empty(0) if t is None else t.contiguous() for t in optional]
        pool = None if self.setup.solids is not None or self.setup.attached is not None else self.pool
        with self.cache.lock:
            frames = run(plan, (*start, pull, given.force, given.friction, *optional, *law_tensors), segment, self.cache, pool)
            x, v, C, F, history = (permuted(t, self.inverse, self.order, 1) for t in frames[:5])
            states, impulses = (t.clone() for t in frames[5:]) if len(frames) > 5 else (None, None)
        dts = tuple(scene.dt for scene in self.scenes)
        recorder = plan.recorder
        marks = Marks(recorder.lowest[self.inverse], recorder.since[self.inverse], self.particles.scene, dts, (every,) * len(dts))
        if (leaving := self.setup.leaving) is not None:
            marks = marks._replace(left=leaving.first_frames(frames[0])[self.inverse], clamped=leaving.mode == "clamp")
        limit = strain_limit(elasticity, plasticity)
        out = Frames(
            x,
            v,
            C,
            F,
            [dt * every for dt in dts],
            self.particles,
            history,
            marks=marks,
            strain_limit=limit,
            colliders=collider_frames(self.scenes, len(x), every, states, impulses),
            **labels(self.bodies, self.setup.body),
        )
        if nan_on_failure:
            refusing = torch.tensor([bool(why) for why in refused], device=self.device)
            scene = self.particles.scene.long()
            failed = refusing[scene] | ~torch.isfinite(out.x[-1]).all(dim=1)
            invalidate(out, failed | (marks.since >= 0) if self.on_inversion == "error" else failed, scene)
        elif self.on_inversion == "error":
            raise_inversions(marks)
        return out


def _span(values: list) -> str:
    """Format sorted values as their one value, or as a range."""
    return f"{values[0]:g}" if len(values) == 1 else f"{values[0]:g} to {values[-1]:g}"
