"""The differentiable material point method: one autograd function for a whole rollout, several scenes in one launch.

The forward pass keeps x, v, C and F of every substep (96 bytes a particle in float32); the backward pass recomputes the
stress and the grid of a substep and applies the hand-written adjoints of `kernels.py` and of the laws, last step first.
The order of a substep is the paper's (appendix, "Material Point Method"): P2G with tau(F), grid, G2P, F_tr = (I + dt C) F,
F = F_hat(F_tr). The slow twin is `reference.py`.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
import warp as wp
from torch import Tensor

from neuido.errors import UserError
from neuido.physics import kernels
from neuido.physics.colliders import clamp_table, collider_table, inside_box
from neuido.physics.device import launch, real_of, torch_stream
from neuido.physics.effects import Effects
from neuido.physics.laws import ElasticLaw, PlasticLaw
from neuido.types import Body, Particles, ParticleState, Scene

COURANT_LIMIT = 1.0
"""Largest dt c / dx, c the speed of the elastic P-wave; and of twice dt nu / dx^2, nu the kinematic P-viscosity."""


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
    ) -> None:
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
        self._grid: dict[str, Tensor] = {}

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
            x.append(bx), v.append(bv), mass.append(m), volume.append(V), held.append(hold)  # fmt: skip
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
        self.particle_dt = self.dt[self.particles.scene.long()][:, None, None]

    @property
    def scene_count(self) -> int:
        return len(self.scenes)

    def scratch(self, name: str) -> Tensor:
        """A buffer of four numbers a node, (S nx ny nz, 4), that is kept between rollouts."""
        if name not in self._grid:
            self._grid[name] = torch.empty(self.node_count, 4, dtype=self.dtype, device=self.device)
        return self._grid[name]

    def check_step(self, elasticity: ElasticLaw, viscosity: Tensor | None = None, mass: Tensor | None = None) -> None:
        """Compare the time step with the fastest wave and the initial speed.

        Raises:
            UserError: dt c / dx above `COURANT_LIMIT`, too viscous for an explicit step, or a body faster than a cell a step.
        """
        modulus = elasticity.modulus().detach().to(self.device, torch.float64).expand(self.scene_count)
        rho = (self.mass if mass is None else mass.detach()).double() / self.volume.double()
        for s, scene in enumerate(self.scenes):
            own = slice(self.particles.offsets[s], self.particles.offsets[s + 1])
            density = float(rho[own].min())
            if not float(modulus[s]) >= 0.0:
                raise UserError(f"the law of scene {s} has a P-wave modulus of {float(modulus[s]):g} Pa at rest; it must not be negative")
            wave = (float(modulus[s]) / density) ** 0.5
            limit = COURANT_LIMIT * scene.dx / max(wave, 1e-30)
            if scene.dt > limit:
                raise UserError(f"dt is {scene.dt:g} s in scene {s}, above the limit {limit:.3g} s of a wave of {wave:.4g} m/s on cells of "
                                f"{scene.dx:.4g} m; lower `dt`, `cells` or the stiffness")  # fmt: skip
            if viscosity is not None:
                eta, zeta = viscosity.detach()[s].double().tolist()
                limit = COURANT_LIMIT * scene.dx**2 * density / max(2.0 * (4.0 / 3.0 * eta + zeta), 1e-30)
                if scene.dt > limit:
                    raise UserError(f"dt is {scene.dt:g} s in scene {s}, above the limit {limit:.3g} s of a viscosity of {eta:g}, {zeta:g} Pa s; "
                                    "lower `dt` or the viscosity")  # fmt: skip
            speed = float(self.state.v[own].norm(dim=1).max())
            if speed * scene.dt >= scene.dx:
                raise UserError(f"the body of scene {s} starts with {speed:.4g} m/s and crosses a cell of {scene.dx:.4g} m in a step of "
                                f"{scene.dt:g} s; lower `dt`")  # fmt: skip

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
        check: bool = True,
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
            check: Compare the step with the stability limit first.

        Returns:
            Frames x (K, P, 3), v (K, P, 3), C (K, P, 3, 3), F (K, P, 3, 3), K = steps / every + 1; frame 0 is the start.

        Raises:
            UserError: Before the start: an unstable step. Afterwards: a particle lost, too fast, or not finite.
        """
        if steps < 1 or every < 1 or steps % every:
            raise UserError(f"steps is {steps} and every is {every}; steps must be a positive multiple of every")
        state = self.state if state is None else ParticleState(*(t.to(self.device, self.dtype).contiguous() for t in state))
        effects = Effects() if effects is None else effects
        base = self.gravity if gravity is None else gravity.to(self.device, self.dtype).expand(self.scene_count, 3)
        pull = (base + effects.acceleration(self.scene_count, self.mass)).contiguous()
        force = effects.force_table(self.scene_count, self.mass).contiguous()
        viscosity = effects.viscosity(self.scene_count, self.mass)
        friction = self.colliders.friction if friction is None else friction.to(self.device, self.dtype).contiguous()
        if friction.shape != self.colliders.friction.shape:
            raise UserError(f"friction has shape {tuple(friction.shape)}; it must be {tuple(self.colliders.friction.shape)}")
        mass = self.mass if mass is None else mass.to(self.device, self.dtype).contiguous()
        if check:
            self.check_step(elasticity, viscosity, mass)
        plan = _Plan(self, elasticity, plasticity, steps, every)
        law_tensors = [t.to(self.device, self.dtype).contiguous() for t in plan.law_tensors()]
        if viscosity is None:
            viscosity = mass.new_empty(0)
        inputs = (*state, mass, pull, force, friction, viscosity.contiguous(), *law_tensors)
        if torch.is_grad_enabled() and any(t.requires_grad for t in inputs):
            frames = _Rollout.apply(plan, *inputs)
        else:
            frames = plan.forward(inputs, keep_all=False)
        return ParticleState(*frames)


@dataclass
class _Plan:
    """What one rollout does, without the differentiable inputs."""

    simulator: Simulator
    elasticity: ElasticLaw
    plasticity: PlasticLaw | None
    steps: int
    every: int

    def law_tensors(self) -> tuple[Tensor, ...]:
        if self.plasticity is not None and self.plasticity.identity:
            self.plasticity = None
        elastic = self.elasticity.tensors()
        plastic = () if self.plasticity is None else self.plasticity.tensors()
        self.split = len(elastic)
        return (*elastic, *plastic)

    def launch(self, kernel: wp.Kernel, dim: int, inputs: list) -> None:
        launch(kernel, dim, inputs, self.simulator.device)

    # -- forward -------------------------------------------------------------------------------------------------

    def stress(self, F: Tensor, C: Tensor, viscosity: Tensor, law: Sequence[Tensor], tau: Tensor) -> None:
        sim = self.simulator
        self.elasticity.forward(law[: self.split], F, tau, sim.particles)
        if viscosity.numel():
            self.launch(sim.kernels.add_viscous_stress, len(F), [sim.particles.scene, viscosity, C, F, tau])

    def to_grid(self, x: Tensor, v: Tensor, C: Tensor, tau: Tensor, mass: Tensor) -> Tensor:
        sim = self.simulator
        grid = sim.scratch("grid").zero_()
        self.launch(sim.kernels.particles_to_grid, len(x),
                    [sim.particles.scene, sim.origin, sim.dx, sim.dt, sim.nodes, mass, sim.volume, x, v, C, tau, grid])  # fmt: skip
        return grid

    def on_grid(self, grid: Tensor, pull: Tensor, force: Tensor, friction: Tensor) -> Tensor:
        sim = self.simulator
        velocity = sim.scratch("velocity")
        self.launch(sim.kernels.update_grid, sim.node_count, [*self._grid_inputs(pull, force, friction), grid, velocity])
        return velocity

    def _grid_inputs(self, pull: Tensor, force: Tensor, friction: Tensor) -> list:
        sim = self.simulator
        table = sim.colliders
        return [sim.origin, sim.dx, sim.dt, pull, force, table.plane, table.kind, friction,
                sim.clamp_lower, sim.clamp_upper, sim.nodes]  # fmt: skip

    def forward(self, inputs: Sequence[Tensor], keep_all: bool) -> tuple[Tensor, ...]:
        """Frames of x, v, C, F; of every substep if `keep_all`, else every `every`-th."""
        sim = self.simulator
        inputs = [t.detach() for t in inputs]
        start, (mass, pull, force, friction, viscosity), law = inputs[:4], inputs[4:9], inputs[9:]
        stride = 1 if keep_all else self.every
        frames = tuple(t.new_empty(self.steps // stride + 1, *t.shape) for t in start)
        for frame, t in zip(frames, start):
            frame[0] = t
        now = tuple(frame[0] for frame in frames)
        spare = () if stride == 1 else [tuple(torch.empty_like(t) for t in start) for _ in range(2)]
        tau, trial = torch.empty_like(now[3]), torch.empty_like(now[3])
        status = torch.zeros(3, dtype=torch.int32, device=sim.device)
        plastic = self.plasticity
        with torch_stream(sim.device):
            for n in range(self.steps):
                kept = (n + 1) % stride == 0
                then = tuple(frame[(n + 1) // stride] for frame in frames) if kept else spare[n % 2]
                x, v, C, F = now
                self.stress(F, C, viscosity, law, tau)
                grid = self.to_grid(x, v, C, tau, mass)
                velocity = self.on_grid(grid, pull, force, friction)
                self.launch(sim.kernels.grid_to_particles, len(x),
                            [sim.particles.scene, sim.held, sim.origin, sim.dx, sim.dt, sim.nodes, velocity, x, F, then[0], then[1], then[2],
                             then[3] if plastic is None else trial, n, status])  # fmt: skip
                if plastic is not None:
                    plastic.forward(law[self.split :], trial, then[3], sim.particles)
                now = then
        self.check_status(status, now)
        return frames

    def check_status(self, status: Tensor, last: Sequence[Tensor]) -> None:
        code, p, step = status.tolist()
        if code == 0 and bool(torch.isfinite(last[3]).all()):
            return
        if code == 0:
            p, step = int((~torch.isfinite(last[3]).all(dim=(1, 2))).nonzero()[0]), self.steps - 1
        s = int(self.simulator.particles.scene[p])
        scene = self.simulator.scenes[s]
        what = {
            kernels.LOST: "left the domain; enlarge `lower`/`upper`, or close it with `walls`",
            kernels.FAST: f"moved by more than a cell ({scene.dx:.4g} m) or became NaN; lower `dt` (now {scene.dt:g} s) or the stiffness",
            0: f"has a deformation gradient that is not finite; lower `dt` (now {scene.dt:g} s) or check the law",
        }[code]
        raise UserError(f"particle {p} of scene {s} {what} (substep {step + 1} of {self.steps})")

    # -- backward ------------------------------------------------------------------------------------------------

    def backward(self, saved: Sequence[Tensor], inputs: Sequence[Tensor], gradients: Sequence[Tensor | None],
                 wanted: Sequence[bool]) -> list[Tensor | None]:  # fmt: skip
        """The adjoint of all inputs, from the states of all substeps and the gradients of the frames."""
        sim, k = self.simulator, self.simulator.kernels
        (mass, pull, force, friction, viscosity), law = inputs[4:9], inputs[9:]
        a_mass = torch.zeros_like(mass)
        a_pull, a_force, a_friction = torch.zeros_like(pull), torch.zeros_like(force), torch.zeros_like(friction)
        a_viscosity = torch.zeros_like(viscosity)
        a_law = [torch.zeros_like(t) if want else None for t, want in zip(law, wanted[9:])]
        parameters = any(wanted[5:8])
        now = [t.new_zeros(t.shape[1:]) for t in saved]
        then = [torch.empty_like(t) for t in now]
        tau, a_tau, trial, a_trial = (torch.empty_like(now[3]) for _ in range(4))
        a_velocity, a_grid = sim.scratch("a_velocity"), sim.scratch("a_grid")
        with torch_stream(sim.device):
            for n in reversed(range(self.steps)):
                if (n + 1) % self.every == 0:
                    _add(now, gradients, (n + 1) // self.every)
                x, v, C, F = (t[n] for t in saved)
                C_next = saved[2][n + 1]
                self.stress(F, C, viscosity, law, tau)
                grid = self.to_grid(x, v, C, tau, mass)
                velocity = self.on_grid(grid, pull, force, friction)
                a_x, a_v, a_C, a_F = then
                a_out = now[3]
                if self.plasticity is not None:
                    self._trial(F, C_next, trial)
                    self.plasticity.adjoint(law[self.split :], trial, now[3], a_trial.zero_(), a_law[self.split :], sim.particles)
                    a_out = a_trial
                self.launch(k.grid_to_particles_adjoint, len(x),
                            [sim.particles.scene, sim.held, sim.origin, sim.dx, sim.dt, sim.nodes, velocity, x, F, saved[1][n + 1], C_next, now[0], now[1], now[2],
                             a_out, a_velocity.zero_(), a_x, a_F])  # fmt: skip
                self.launch(k.update_grid_adjoint, sim.node_count,
                            [*self._grid_inputs(pull, force, friction), grid, a_velocity, a_grid, a_pull, a_force, a_friction, parameters])  # fmt: skip
                self.launch(k.particles_to_grid_adjoint, len(x),
                            [sim.particles.scene, sim.origin, sim.dx, sim.dt, sim.nodes, mass, sim.volume, x, v, C, tau, a_grid, a_mass,
                             a_x, a_v, a_C, a_tau])  # fmt: skip
                if viscosity.numel():
                    self.launch(k.add_viscous_stress_adjoint, len(x),
                                [sim.particles.scene, viscosity, C, F, a_tau, a_C, a_F, a_viscosity])  # fmt: skip
                self.elasticity.adjoint(law[: self.split], F, a_tau, a_F, a_law[: self.split], sim.particles)
                now, then = then, now
        _add(now, gradients, 0)
        return [*now, a_mass, a_pull, a_force, a_friction, a_viscosity, *a_law]

    def _trial(self, F: Tensor, C_next: Tensor, out: Tensor) -> None:
        """F_tr = (I + dt C) F, as grid_to_particles wrote it."""
        sim = self.simulator
        torch.bmm(C_next, F, out=out)
        out.mul_(sim.particle_dt).add_(F)


def _add(now: Sequence[Tensor], gradients: Sequence[Tensor | None], frame: int) -> None:
    for a, gradient in zip(now, gradients):
        if gradient is not None:
            a.add_(gradient[frame])


class _Rollout(torch.autograd.Function):
    """x, v, C, F of the frames from the start, the parameters and the laws' tensors."""

    @staticmethod
    def forward(ctx: Any, plan: _Plan, *inputs: Tensor) -> tuple[Tensor, ...]:
        saved = plan.forward(inputs, keep_all=True)
        ctx.plan = plan
        ctx.save_for_backward(*saved, *inputs)
        return saved if plan.every == 1 else tuple(t[:: plan.every].clone() for t in saved)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:
        tensors = ctx.saved_tensors
        out = ctx.plan.backward(tensors[:4], tensors[4:], gradients, ctx.needs_input_grad[1:])
        return (None, *(g if want else None for g, want in zip(out, ctx.needs_input_grad[1:])))


def _short(t: Tensor) -> list[float]:
    return [float(f"{value:.4g}") for value in t.tolist()]
