"""The differentiable material point method: one autograd function for a whole rollout, several scenes in one launch.

Here are the set-up, the checks before a start, and the call; `rollout.py` holds the loops, `adjoint.py` makes one function of them, and
`graphs.py` captures them on a GPU. The order of a substep is the paper's (appendix, "Material Point Method"): P2G with tau(F), grid,
G2P, F_tr = (I + dt C) F, F = F_hat(F_tr). The slow twin is `reference.py`.
"""

import math
import threading
from collections.abc import Sequence
from typing import Literal, NamedTuple

import torch
import warp as wp
from torch import Tensor

from neuido.errors import UserError
from neuido.physics.colliders.tables import clamp_table, collider_table, inside_box
from neuido.physics.effects.parameters import Effects
from neuido.physics.laws.base import ElasticLaw, PlasticLaw
from neuido.physics.mpm import inputs
from neuido.physics.mpm import transfers as kernels
from neuido.physics.mpm.adjoint import run
from neuido.physics.mpm.graphs import RolloutCache
from neuido.physics.mpm.rollout import Plan
from neuido.physics.mpm.threads import pool
from neuido.physics.runtime.device import real_of
from neuido.physics.runtime.invalidation import spoil
from neuido.types import Body, Particles, ParticleState, Scene

COURANT_LIMIT = 1.0
"""Largest dt c / dx, c the speed of the elastic P-wave; and of twice dt nu / dx^2, nu the kinematic P-viscosity."""


class StepLimit(NamedTuple):
    """The longest stable steps of one scene [s]."""

    of_waves: float
    of_viscosity: float


def affine_velocity(x: Tensor, v: Tensor, neighbours: int = 32, chunk: int = 2048) -> Tensor:
    """The velocity gradient that belongs to a velocity field on particles, (P, 3, 3) [1/s].

    A rollout starts with it (C = 0 would lose 6-8 % of a spin in the first step). One affine fit serves where it is exact
    to 1e-3 (all rigid and uniform motions), else a fit over the nearest neighbours of each particle. Differentiable in v.

    Args:
        x: Positions [m], (P, 3).
        v: Velocities [m/s], (P, 3).
    """
    dx = x - x.mean(dim=0)
    dv = v - v.mean(dim=0)
    spread = dx.T @ dx
    ridge = 1e-9 * spread.trace() * torch.eye(3, dtype=x.dtype, device=x.device)
    gradient = torch.linalg.solve(spread + ridge, dx.T @ dv).T
    residual = (dv - dx @ gradient.T).detach().norm(dim=1).max()
    if residual <= 1e-3 * v.detach().norm(dim=1).max() or x.shape[0] <= neighbours:
        return gradient.expand(x.shape[0], 3, 3).contiguous()
    out = []
    for start in range(0, x.shape[0], chunk):
        near = torch.cdist(x[start : start + chunk], x).topk(neighbours, largest=False).indices
        nx, nv = x[near], v[near]
        nx, nv = nx - nx.mean(dim=1, keepdim=True), nv - nv.mean(dim=1, keepdim=True)
        normal = nx.transpose(1, 2) @ nx
        ridge = 1e-6 * normal.diagonal(dim1=1, dim2=2).sum(-1)[:, None, None] * torch.eye(3, dtype=x.dtype, device=x.device)
        out.append(torch.linalg.solve(normal + ridge, nx.transpose(1, 2) @ nv).transpose(1, 2))
    return torch.cat(out).contiguous()


class Simulator:
    """MPM of one or several scenes, each with one body; all scenes move in the same launches.

    Args:
        scenes: One scene or a list of them; grid, step, gravity and colliders may differ.
        bodies: As many bodies.
        density: [kg/m^3], one number or one for each scene.
        device: Where it runs.
        dtype: `torch.float32` for work, `torch.float64` for checks.
        threads: On the CPU, run several scenes in as many threads as there are cores.
        graphs: On CUDA, capture a rollout's launches once for each shape and replay them after.
        keep: What the backward pass finds of each substep: `state` is x, v, C, F (96 bytes a particle in float32), and it
            recomputes stress, trial and grid; `all` is these too (72 bytes more a particle, 32 a node) and faster; `auto` is
            `all` where the nodes do not outnumber the particles by more than four.

    Raises:
        UserError: A body outside its domain, a clamp or an attached mass that picks no particle, a shape that does not fit.

    Attributes:
        state: `ParticleState` at t = 0, with C the gradient of the initial velocity.
        mass: Particle masses [kg], (P,), attached masses included.
        volume: Initial volumes [m^3], (P,).
        particles: `Particles`, which scene each particle belongs to.
    """

    def __init__(
        self,
        scenes: Scene | Sequence[Scene],
        bodies: Body | Sequence[Body],
        *,
        density: float | Sequence[float] = 1000.0,
        device: str | torch.device = "cpu",
        dtype: torch.dtype = torch.float32,
        threads: bool = True,
        graphs: bool = True,
        keep: Literal["state", "all", "auto"] = "auto",
    ) -> None:
        if keep not in ("state", "all", "auto"):
            raise UserError(f"keep is {keep!r}; choose state, all or auto")
        self.scenes = (scenes,) if isinstance(scenes, Scene) else tuple(scenes)
        bodies = (bodies,) if isinstance(bodies, Body) else tuple(bodies)
        if len(bodies) != len(self.scenes) or not bodies:
            raise UserError(f"{len(bodies)} bodies for {len(self.scenes)} scenes; give one body a scene")
        densities = [float(density)] * len(bodies) if isinstance(density, (int, float)) else [float(d) for d in density]
        if len(densities) != len(bodies) or not all(d > 0 for d in densities):
            raise UserError(f"density is {density}; give one positive number, or one for each of {len(bodies)} scenes")
        self.device, self.dtype = torch.empty(0, device=device).device, dtype  # with its index, which Warp needs
        self.kernels = kernels.build(real_of(dtype))
        self._load_scenes()
        self._load_bodies(bodies, densities)
        nodes = [max(scene.nodes[a] for scene in self.scenes) + 2 * kernels.PAD for a in range(3)]
        self.nodes = wp.vec3i(*nodes)
        self.grid_shape = (len(self.scenes), *nodes)
        self.node_count = math.prod(self.grid_shape)
        self.chunk = nodes[2] if self.device.type == "cpu" else 1  # nodes a thread: on the CPU its call costs as much as a node
        scene, *axes = (torch.arange(n, dtype=torch.int32) for n in self.grid_shape)
        s, i, j, k = torch.meshgrid(scene, *axes, indexing="ij")
        self.node_index = torch.stack([i, j, k, s], dim=-1).reshape(-1, 4).to(self.device)
        watched = self.device.type == "cpu" and len(self.scenes) == 1
        self.span = torch.empty(2 if watched else 0, dtype=self.dtype, device=self.device)
        """Least and greatest x [m] of the particles after a substep, of one scene on the CPU."""
        self.ends = self.span.numpy() if watched else None
        self._sort()
        self.keep_grid = keep == "all" or (keep == "auto" and self.node_count <= 4 * len(self.mass))
        self.cache = RolloutCache(graphs and self.device.type == "cuda")
        self.pool = pool() if threads and self.device.type == "cpu" and len(self.scenes) > 1 else None
        self.first_scene = self.first_particle = 0
        self._alone: dict[int, Simulator] = {}
        self._grid: dict[str, Tensor] = {}
        self.lock = threading.RLock()
        """Held by a rollout or an adjoint: tape, grid and graphs are one set, which threads that share a simulator take in turn."""

    def _load_scenes(self) -> None:
        def column(values: list) -> Tensor:
            return torch.tensor(values, dtype=torch.float64).to(self.device, self.dtype)

        for scene in self.scenes:
            if not (scene.cells >= 4 and scene.dt > 0 and all(u > l for l, u in zip(scene.lower, scene.upper))):
                raise UserError(f"cells is {scene.cells}, dt {scene.dt:g}; a scene needs cells >= 4, dt > 0 and upper above lower")
        self.dx = column([s.dx for s in self.scenes])
        self.dt = column([s.dt for s in self.scenes])
        self.origin = column([[l - kernels.PAD * s.dx for l in s.lower] for s in self.scenes])
        self.gravity = column([list(s.gravity) for s in self.scenes])
        self.colliders = collider_table(self.scenes, self.dtype, self.device)
        self.clamp_lower, self.clamp_upper = clamp_table(self.scenes, self.dtype, self.device)

    def _load_bodies(self, bodies: Sequence[Body], densities: list[float]) -> None:
        x, v, C, F, mass, volume, held, scene_index = [], [], [], [], [], [], [], []
        for s, (scene, body, rho) in enumerate(zip(self.scenes, bodies, densities)):
            bx = torch.as_tensor(body.x).to(self.device, torch.float64)
            bv = torch.as_tensor(body.v).to(self.device, torch.float64)
            V = torch.as_tensor(body.volume).to(self.device, torch.float64)
            if bx.ndim != 2 or bx.shape[1] != 3 or bv.shape != bx.shape or V.shape != bx.shape[:1] or not len(bx):
                raise UserError(f"body of scene {s} has shapes x {tuple(bx.shape)}, v {tuple(bv.shape)}, volume {tuple(V.shape)}; "
                                "they must be (P, 3), (P, 3), (P,)")  # fmt: skip
            if not bool(torch.isfinite(bx).all() & torch.isfinite(bv).all() & (V > 0).all()):
                raise UserError(f"body of scene {s} holds a NaN, an infinity or a volume that is not positive")
            lower, upper = bx.new_tensor(scene.lower), bx.new_tensor(scene.upper)
            out = ((bx < lower) | (bx > upper)).any(dim=1)
            if bool(out.any()):
                p = int(out.nonzero()[0])
                raise UserError(f"particle {p} of scene {s} at {_short(bx[p])} m lies outside the domain "
                                f"{_short(lower)} to {_short(upper)}; move the body or enlarge `lower`/`upper`")  # fmt: skip
            m = rho * V
            for attached in scene.attached_masses:
                picked = inside_box(bx, attached.box, name="attached mass")
                m = m + torch.where(picked, V, 0.0) * (attached.mass / V[picked].sum())
            hold = torch.zeros(len(bx), dtype=torch.bool, device=self.device)
            for box in scene.clamps:
                hold |= inside_box(bx, box, name="clamp")
            x.append(bx)
            v.append(bv)
            mass.append(m)
            volume.append(V)
            held.append(hold)
            C.append(affine_velocity(bx, bv))
            eye = torch.eye(3, dtype=torch.float64, device=self.device).expand(len(bx), 3, 3)
            F.append(eye if body.F is None else torch.as_tensor(body.F).to(self.device, torch.float64))
            scene_index.append(torch.full((len(bx),), s, dtype=torch.int32, device=self.device))

        def join(parts: list[Tensor]) -> Tensor:
            return torch.cat(parts).to(self.dtype).contiguous()

        offsets = [0]
        for part in x:
            offsets.append(offsets[-1] + len(part))
        self.particles = Particles(torch.cat(scene_index), tuple(offsets))
        self.state = ParticleState(join(x), join(v), join(C), join(F))
        self.mass, self.volume = join(mass), join(volume)
        self.held = torch.cat(held).to(torch.uint8)

    def _sort(self) -> None:
        """The order in which the kernels see the particles: scene by scene, then by cell, so that neighbours add to the same nodes."""
        scene = self.particles.scene.long()
        cell = ((self.state.x - self.origin[scene]) / self.dx[scene, None] - 0.5).floor().long()
        ny, nz = self.grid_shape[2:]
        key = ((scene * self.grid_shape[1] + cell[:, 0]) * ny + cell[:, 1]) * nz + cell[:, 2]
        self.order = torch.argsort(key, stable=True)
        self.inverse = torch.argsort(self.order)
        self.sorted_volume, self.sorted_held = self.volume[self.order].contiguous(), self.held[self.order].contiguous()

    def alone(self, s: int) -> "Simulator":
        """The simulator of one scene, with this one's particles in this one's order."""
        if s not in self._alone:
            own = slice(self.particles.offsets[s], self.particles.offsets[s + 1])
            body = Body(self.state.x[own], self.state.v[own], self.volume[own], self.state.F[own])
            one = Simulator(self.scenes[s], body, device=self.device, dtype=self.dtype)
            one.keep_grid = self.keep_grid
            one.order = self.order[own] - own.start
            one.sorted_volume, one.sorted_held = self.sorted_volume[own], self.sorted_held[own]
            one.first_scene, one.first_particle = s, own.start
            self._alone[s] = one
        return self._alone[s]

    @property
    def scene_count(self) -> int:
        return len(self.scenes)

    def scratch(self, name: str) -> Tensor:
        """A buffer of four numbers a node, (S nx ny nz, 4), that is kept between rollouts."""
        if name not in self._grid:
            self._grid[name] = torch.empty(self.node_count, 4, dtype=self.dtype, device=self.device)
        return self._grid[name]

    def step_limits(
        self,
        elasticity: ElasticLaw,
        viscosity: Tensor | None = None,
        mass: Tensor | None = None,
        stiffer: tuple[Tensor, Tensor] | None = None,
    ) -> list[StepLimit]:
        """The longest stable step of each scene; arguments are those of `check_step`.

        Raises:
            UserError: A negative modulus.
        """
        out = []
        for s, (modulus, density) in enumerate(inputs.waves(self, elasticity, mass, stiffer)):
            dx, viscous = self.scenes[s].dx, math.inf
            if viscosity is not None:
                eta, zeta = viscosity.detach()[s].double().tolist()
                viscous = COURANT_LIMIT * dx**2 * density / max(2.0 * (4.0 / 3.0 * eta + zeta), 1e-30)
            out.append(StepLimit(COURANT_LIMIT * dx / max((modulus / density) ** 0.5, 1e-30), viscous))
        return out

    def step_margin(
        self, steps: int, elasticity: ElasticLaw, plasticity: PlasticLaw | None = None, *, effects: Effects | None = None
    ) -> float:
        """The longest stable step over the one in use, of the scene that has least to spare; below 1 a `rollout` of these refuses.

        Raises:
            UserError: As `rollout`, but for the step.
        """
        given = inputs.prepare(self, steps, elasticity, plasticity, effects=effects)
        limits = self.step_limits(elasticity, given.viscosity, given.mass, given.stiffening(self))
        return min(min(limit) / scene.dt for limit, scene in zip(limits, self.scenes))

    def check_step(
        self,
        elasticity: ElasticLaw,
        viscosity: Tensor | None = None,
        mass: Tensor | None = None,
        stiffer: tuple[Tensor, Tensor] | None = None,
    ) -> None:
        """Compare the time step with the fastest wave and the initial speed.

        Args:
            elasticity: Its modulus is that of the wave.
            viscosity: `Effects.viscosity` [Pa s], (S, 2).
            mass: [kg], (P,).
            stiffer: What effects add to the modulus [Pa] and their largest factor on it, (S,) each.

        Raises:
            UserError: A negative modulus, dt c / dx above `COURANT_LIMIT`, too viscous for an explicit step, or a body faster than a cell
                a step.
        """
        for why in self._refusals(elasticity, viscosity, mass, stiffer):
            if why:
                raise UserError(why)

    def _refusals(
        self, elasticity: ElasticLaw, viscosity: Tensor | None, mass: Tensor | None, stiffer: tuple[Tensor, Tensor] | None
    ) -> list[str]:
        """Why the step of each scene is too long, in the words of `check_step`; nothing where it is not."""
        out = []
        for s, limit in enumerate(self.step_limits(elasticity, viscosity, mass, stiffer)):
            why = ""
            scene = self.scenes[s]
            own = slice(self.particles.offsets[s], self.particles.offsets[s + 1])
            if scene.dt > limit.of_waves:
                wave = COURANT_LIMIT * scene.dx / limit.of_waves
                why = (f"dt is {scene.dt:g} s in scene {s}, above the limit {limit.of_waves:.3g} s of a wave of {wave:.4g} m/s on "
                       f"cells of {scene.dx:.4g} m; lower `dt`, `cells` or the stiffness")  # fmt: skip
            elif viscosity is not None and scene.dt > limit.of_viscosity:
                bulk = float((viscosity[s, 1] - 2.0 / 3.0 * viscosity[s, 0]).detach())  # in the type in which it was added
                eta = float(viscosity[s, 0].detach())
                why = (f"dt is {scene.dt:g} s in scene {s}, above the limit {limit.of_viscosity:.3g} s of a shear viscosity of "
                       f"{eta:.3g} and a bulk viscosity of {bulk:.3g} Pa s; lower `dt` or the viscosity")  # fmt: skip
            elif (speed := float(self.state.v[own].norm(dim=1).max())) * scene.dt >= scene.dx:
                why = (f"the body of scene {s} starts with {speed:.4g} m/s and crosses a cell of {scene.dx:.4g} m in a step of "
                       f"{scene.dt:g} s; lower `dt`")  # fmt: skip
            out.append(why)
        return out

    def rollout(
        self,
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
        segment: int | None = None,
        check: bool = True,
        lenient: bool = False,
    ) -> ParticleState:
        """Run `steps` substeps.

        Differentiable with respect to `state`, `gravity`, `friction`, `mass`, the tensors of the laws and of the effects.

        Args:
            steps: Number of substeps.
            elasticity: F -> Kirchhoff stress.
            plasticity: Trial F -> corrected F; none: purely elastic.
            state: Start, (P, ...); the bodies as loaded where absent.
            effects: Further effects.
            gravity: [m/s^2], (S, 3); the scenes' own where absent.
            friction: Coefficients of the colliders, (S, K) in the order colliders, walls.
            mass: [kg], (P,); density times volume where absent.
            every: Keep a frame every so many substeps.
            segment: For a long rollout with gradients: keep only the state every so many substeps, and make the rest again in the
                backward pass, piece by piece (a third more time); on CUDA also without gradients: one captured piece serves all of them.
                It must divide `steps` and be a multiple of `every`.
            check: Compare the step with the stability limit first.
            lenient: Frames of a scene whose step is too long, or whose motion fails, are NaN, in place of an error.

        Returns:
            Frames x (K, P, 3), v (K, P, 3), C (K, P, 3, 3), F (K, P, 3, 3), K = steps / every + 1; frame 0 is the start.

        Raises:
            UserError: Before the start: an unstable step. Afterwards: a particle lost, too fast, or not finite.
        """
        inputs.check_frames(steps, every)
        if segment is not None and (segment < 1 or steps % segment or segment % every):
            raise UserError(f"segment is {segment}; it must divide steps ({steps}) and be a multiple of every ({every})")
        given = inputs.prepare(
            self, steps, elasticity, plasticity, state=state, effects=effects, gravity=gravity, friction=friction, mass=mass
        )
        pull = given.effects.accelerations(given.gravity, self.dt, steps).contiguous()
        step = (elasticity, given.viscosity, given.mass, given.stiffening(self))
        refused = [""] * self.scene_count
        if check and lenient:
            refused = self._refusals(*step)
        elif check:
            self.check_step(*step)
        tables, mass = given.tables, given.mass
        plan = Plan(self, elasticity, plasticity, steps, every, tables, lenient)
        law_tensors = [t.to(self.device, self.dtype).contiguous() for t in plan.law_tensors()]
        history = mass.new_zeros(len(mass), plan.layout.width)
        start = [t[self.order] for t in (*given.state, history, mass)]
        optional = [given.viscosity, None if given.stiffness is None else given.stiffness[self.order], given.growth]
        optional += [None] * 3 if tables is None else [tables.material, tables.branches, tables.flow]
        optional = [mass.new_empty(0) if t is None else t.contiguous() for t in optional]
        with self.lock:
            frames = run(plan, (*start, pull, given.force, given.friction, *optional, *law_tensors), segment)
            out = ParticleState(*(t[:, self.inverse] for t in frames[:4]))
        if lenient:
            refusing = torch.tensor([bool(why) for why in refused], device=self.device)
            scene = self.particles.scene.long()
            spoil(out, refusing[scene] | ~torch.isfinite(out.x[-1]).all(dim=1), scene)
        return out


def _short(t: Tensor) -> list[float]:
    return [float(f"{value:.4g}") for value in t.tolist()]
