"""The loops of a rollout, forward and backward: launches alone, so that they run eagerly or inside a CUDA graph.

The forward pass leaves a tape: x, v, C, F and the history of every substep, and where there is room stress and nodal momentum. The
backward pass recomputes what the tape lacks and applies the hand-written adjoints of `transfers.py`, `grid.py` and of
the laws, last substep first. `adjoint.py` makes one `torch.autograd.Function` of a whole rollout.
"""

import copy
import math
from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING, NamedTuple

import torch
import warp as wp
from torch import Tensor

from neuido.errors import UserError
from neuido.physics.effects import stress_kernels as effect_kernels
from neuido.physics.effects.coefficients import Layout, Tables
from neuido.physics.laws.base import ElasticLaw, Engine, PlasticLaw
from neuido.physics.mpm import transfers as kernels
from neuido.physics.runtime.device import launch, real_of, torch_stream
from neuido.physics.runtime.invalidation import spoil
from neuido.physics.runtime.launches import Stretches

if TYPE_CHECKING:
    from neuido.physics.mpm.simulator import Simulator

STATES = 5
"""Inputs that are the start: x, v, C, F and the history (no columns where no effect remembers)."""
KINDS = ("particle",) * 6 + ("time",) + ("scene",) * 3 + ("particle", "time") + ("scene",) * 3
"""What an input before the tensors of the laws has a row for: the start, mass, pull, force, friction, viscosity, and of the effects
on the material stiffness, growth, material, branches, flow. Those over time are (T, S, ...), or (1, S, ...) where constant; an absent
one has no elements."""
FIXED = len(KINDS)

LARGE = 1 << 17
"""Particles above which blocks of 256 threads do as well as blocks of 32 on a GPU; smaller bodies need more blocks to fill it."""


class Tape(NamedTuple):
    """What a forward pass writes; K frames, of every substep where a backward pass follows."""

    x: Tensor
    v: Tensor
    C: Tensor
    F: Tensor
    history: Tensor
    status: Tensor
    """Code, particle and substep of the first failure of each scene, (3 S,) int32."""
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

    @property
    def states(self) -> tuple[Tensor, ...]:
        return self[:STATES]


class Material(NamedTuple):
    """The inputs of the effects on the material in one substep; None where absent."""

    stiffness: Tensor | None
    growth: Tensor | None
    material: Tensor | None
    branches: Tensor | None
    flow: Tensor | None
    idle: bool = True
    """Whether branches of weight zero are kept too, for a backward pass."""


class Plan:
    """What one rollout does, without its differentiable inputs.

    Args:
        simulator: Scenes, bodies and buffers.
        elasticity: Elastic law.
        plasticity: Plastic law or None.
        steps: Substeps.
        every: Substeps between frames.
        tables: What the effects of the material need; of it the plan keeps what decides its launches.
        lenient: Frames of a scene that fails are NaN, in place of an error.
    """

    def __init__(
        self,
        simulator: "Simulator",
        elasticity: ElasticLaw,
        plasticity: PlasticLaw | None,
        steps: int,
        every: int,
        tables: Tables | None = None,
        lenient: bool = False,
    ) -> None:
        self.simulator, self.elasticity, self.steps, self.every, self.lenient = simulator, elasticity, steps, every, lenient
        self.layout = Layout() if tables is None else tables.layout
        self.spectral = tables is not None and tables.spectral
        self.flow_kinds = () if tables is None else tables.kinds
        self.tables = tables
        if plasticity is None or plasticity.identity or self.flow_kinds:
            plasticity = None
        self.plasticity = plasticity
        self.kinds = torch.tensor(self.flow_kinds, dtype=torch.int32, device=simulator.device)
        self.effects = None if tables is None else effect_kernels.build(real_of(simulator.dtype))
        self.block = 32 if len(simulator.mass) < LARGE else 256

    def law_tensors(self) -> tuple[Tensor, ...]:
        """Those of both laws, the elastic ones first."""
        elastic = self.elasticity.tensors()
        self.split = FIXED + len(elastic)
        return (*elastic, *(() if self.plasticity is None else self.plasticity.tensors()))

    def key(self, inputs: Sequence[Tensor]) -> tuple | None:
        """What, beside the shapes of the inputs, decides the launches; None where they may not be captured."""
        elastic = self.elasticity.key(inputs[FIXED : self.split])
        plastic = "none" if self.plasticity is None else self.plasticity.key(inputs[self.split :])
        own = (self.steps, self.every, self.layout, self.spectral, self.flow_kinds)
        return None if elastic is None or plastic is None else (*own, elastic, plastic)

    def piece(self, steps: int) -> "Plan":
        """The same for fewer substeps."""
        plan = copy.copy(self)
        plan.steps = steps
        return plan

    def engines(self, inputs: Sequence[Tensor]) -> tuple[Engine, Engine | None]:
        particles = self.simulator.particles
        plastic = None if self.plasticity is None else self.plasticity.engine(inputs[self.split :], particles)
        return self.elasticity.engine(inputs[FIXED : self.split], particles), plastic

    def alone(self, s: int) -> "Plan":
        """The plan of one scene."""
        plastic = None if self.plasticity is None else self.plasticity.alone(s)
        tables = None if self.tables is None else self.tables._replace(kinds=self.flow_kinds[s : s + 1])
        plan = Plan(self.simulator.alone(s), self.elasticity.alone(s), plastic, self.steps, self.every, tables, self.lenient)
        plan.split = self.split
        return plan

    def launch(self, kernel: wp.Kernel, dim: int, inputs: list, block: int = 256) -> None:
        launch(kernel, dim, inputs, self.simulator.device, block=block)

    @property
    def corrects(self) -> bool:
        """Whether the trial gradient is corrected, by a law or by an effect."""
        return self.plasticity is not None or bool(self.flow_kinds)

    def material(self, inputs: Sequence[Tensor], n: int, *, idle: bool = True) -> Material | None:
        """What the kernels of the effects read in substep n."""
        if self.tables is None:
            return None
        stiffness, growth, *tables = inputs[STATES + 5 : FIXED]
        return Material(*(t if t.numel() else None for t in (stiffness, at_step(growth, n), *tables)), idle)

    # Forward.

    def tape(self, keep_all: bool) -> Tape:
        """Empty memory for a forward pass; `keep_all`: of every substep, for a backward pass."""
        sim = self.simulator
        count = self.steps if keep_all else self.steps // self.every
        history = sim.mass.new_empty(len(sim.mass), self.layout.width)
        states = (t.new_empty(count + 1, *t.shape) for t in (*sim.state, history))
        status = torch.zeros(3 * sim.scene_count, dtype=torch.int32, device=sim.device)
        more = keep_all and sim.keep_grid
        tau = sim.state.F.new_empty(self.steps, *sim.state.F.shape) if more else None
        trial = torch.empty_like(tau) if tau is not None and self.corrects else None
        nodal = [sim.mass.new_empty(self.steps, sim.node_count, 4) if more else None for _ in range(2)]
        return Tape(*states, status, tau, trial, *nodal, keep_all)

    def forward(self, inputs: Sequence[Tensor], tape: Tape, steps: int | None = None) -> None:
        """Launch the substeps (all, or the first `steps`); checks nothing."""
        sim = self.simulator
        pull, force, friction = inputs[STATES + 1 : STATES + 4]
        stride = self.steps // (len(tape.x) - 1)
        for frame, t in zip(tape.states, inputs):
            frame[0] = t
        now = tuple(frame[0] for frame in tape.states)
        spare = [tuple(torch.empty_like(t) for t in now) for _ in range(2)] if stride > 1 else []
        scratch, other = torch.empty_like(now[3]), torch.empty_like(now[3])
        copies = sim.device.type == "cpu"
        clears = copies and tape.grid is None  # what the nodes held goes as they are read, instead of in a pass of its own
        for name in ("grid", "velocity") if clears else ():
            sim.scratch(name).zero_()
        stretches = Stretches()
        steady = all(len(t) <= 1 for t in (pull, inputs[STATES + 6]))  # neither pull nor growth has a row for each substep
        tape.status.zero_()
        with torch_stream(sim.device):
            elastic, plastic = self.engines(inputs)
            for n in range(self.steps if steps is None else steps):
                frame = tuple(frames[(n + 1) // stride] for frames in tape.states) if (n + 1) % stride == 0 else None
                # on the CPU a frame is a copy: launches whose tensors always lie in the same places are repeated as they were
                then = spare[n % 2] if frame is None or (spare and copies) else frame
                same = n % 2 if spare and copies and steady and n else None
                reach = self.reach(now[0] if n == 0 else None) if tape.grid is None else slice(None)
                tau = scratch if tape.tau is None else tape.tau[n]
                trial = other if tape.trial is None else tape.trial[n]
                grid = sim.scratch("grid") if tape.grid is None else tape.grid[n]
                velocity = sim.scratch("velocity") if tape.velocity is None else tape.velocity[n]
                if n == 0 or not steady:
                    material, pull_now = self.material(inputs, n, idle=tape.whole), at_step(pull, n)
                if not clears:
                    grid.zero_()
                scatter = partial(self.scatter, inputs, now, material, elastic, tau, grid)
                update = partial(self.on_grid, grid, pull_now, force, friction, velocity, reach, clears)
                gather = partial(self.gather, n, now, then, material, plastic, velocity, trial, tape.status)
                if same is None:
                    scatter()
                    update()
                    gather()
                else:
                    stretches.run(("scatter", same), scatter)
                    stretches.run((reach.start, reach.stop), update)
                    stretches.run(("gather", same), gather, n)
                if frame is not None and then is not frame:
                    for kept, t in zip(frame, then):
                        kept.copy_(t)
                now = then

    def scatter(
        self, inputs: Sequence[Tensor], now: Sequence[Tensor], material: Material | None, elastic: Engine, tau: Tensor, grid: Tensor
    ) -> None:
        """Stress, and momentum and mass of the nodes, which are zero before."""
        x, v, C, F, history = now
        self.stress(elastic, F, C, history, inputs[STATES + 4], material, tau)
        self.add_to_grid(x, v, C, tau, inputs[STATES], grid)

    def gather(
        self,
        n: int,
        now: Sequence[Tensor],
        then: Sequence[Tensor],
        material: Material | None,
        plastic: Engine | None,
        velocity: Tensor,
        trial: Tensor,
        status: Tensor,
    ) -> None:
        """The particles of the next substep, from the velocity of the nodes."""
        sim = self.simulator
        x, _, _, F, history = now
        self.launch(sim.kernels.grid_to_particles, len(x),
                    [sim.particles.scene, sim.sorted_held, sim.origin, sim.dx, sim.dt, sim.nodes, velocity, x, F, *then[:3],
                     trial if self.corrects else then[3], n, status, sim.span], self.block)  # fmt: skip
        if plastic is not None:
            plastic.forward(trial, then[3])
        if material is not None:
            self.remember(material, trial, then[2], history, then[3], then[4])

    def stress(
        self, elastic: Engine, F: Tensor, C: Tensor, history: Tensor, viscosity: Tensor, material: Material | None, tau: Tensor
    ) -> None:
        sim = self.simulator
        elastic.forward(F, tau)
        if material is not None:
            self.launch(self.effects.add_effect_stress, len(F), [*self.stress_inputs(material), material.idle, F, history, tau])
        if viscosity.numel():
            self.launch(sim.kernels.add_viscous_stress, len(F), [sim.particles.scene, viscosity, C, F, tau])

    def stress_inputs(self, material: Material) -> list:
        return [self.simulator.particles.scene, *material[:4], self.spectral, self.layout.at_e_max]

    def flow_inputs(self, material: Material) -> list:
        sim, layout = self.simulator, self.layout
        table = [sim.particles.scene, sim.dt, self.kinds, material.flow, material.stiffness, material.growth]
        return [*table, layout.at_alpha, layout.at_backstress]

    def remember(self, material: Material, trial: Tensor, C: Tensor, history: Tensor, F: Tensor, history_next: Tensor) -> None:
        """The history of the next substep, and its F where an effect makes it of the trial one."""
        sim, k = self.simulator, self.effects
        if material.branches is not None:
            self.launch(k.relax, len(F), [sim.particles.scene, sim.dt, material.branches, material.idle, C, history, history_next])
        if material.flow is not None:
            self.launch(k.flow, len(F), [*self.flow_inputs(material), trial, C, history, F, history_next])
        if self.layout.e_max:
            self.launch(k.remember, len(F), [F, self.layout.at_e_max, history, history_next])

    def reach(self, x: Tensor | None) -> slice:
        """The nodes that particles touch, as a range: on the CPU the planes between the first and the last one, with one to spare.

        The particles are at x, or, if None, where the last `gather` left them.
        """
        sim = self.simulator
        if not len(sim.span):
            return slice(None)
        low, high = sim.ends.tolist() if x is None else [float(t) for t in torch.aminmax(x[:, 0])]
        sim.ends[:] = math.inf, -math.inf
        if not math.isfinite(high - low):
            return slice(None)
        planes, dx = sim.grid_shape[1], sim.scenes[0].dx
        edge, plane = sim.scenes[0].lower[0] - kernels.PAD * dx, sim.node_count // planes
        first, last = (min(max(int((at - edge) / dx - 0.5), 0), planes - 3) for at in (low, high))
        return slice(max(first - 1, 0) * plane, min(last + 4, planes) * plane)

    def to_grid(self, x: Tensor, v: Tensor, C: Tensor, tau: Tensor, mass: Tensor, grid: Tensor) -> Tensor:
        """Momentum and mass of the nodes."""
        self.add_to_grid(x, v, C, tau, mass, grid.zero_())
        return grid

    def add_to_grid(self, x: Tensor, v: Tensor, C: Tensor, tau: Tensor, mass: Tensor, grid: Tensor) -> None:
        """The same, added to what is there."""
        sim = self.simulator
        arguments = [sim.particles.scene, sim.origin, sim.dx, sim.dt, sim.nodes, mass, sim.sorted_volume, x, v, C, tau, grid]
        self.launch(sim.kernels.particles_to_grid, len(x), arguments, self.block)

    def on_grid(
        self,
        grid: Tensor,
        pull: Tensor,
        force: Tensor,
        friction: Tensor,
        velocity: Tensor,
        reach: slice = slice(None),
        clear: bool = False,
    ) -> None:
        """Velocities of the nodes within reach; `clear` empties them for the next scatter."""
        sim = self.simulator
        inputs = [*self.grid_inputs(pull, force, friction, reach), grid[reach], velocity[reach], clear]
        self.launch(sim.kernels.update_grid, len(grid[reach]) // sim.chunk, inputs)

    def grid_inputs(self, pull: Tensor, force: Tensor, friction: Tensor, reach: slice = slice(None)) -> list:
        sim = self.simulator
        table = sim.colliders
        return [
            sim.origin,
            sim.dx,
            sim.dt,
            pull,
            force,
            table.plane,
            table.kind,
            friction,
            sim.clamp_lower,
            sim.clamp_upper,
            sim.node_index[reach],
            sim.chunk,
        ]

    def check(self, tape: Tape) -> None:
        """Raise what the kernels found, or a last frame that is not finite; if `lenient`, make the frames of such scenes NaN.

        Raises:
            UserError: A particle lost, too fast, or not finite.
        """
        sim, found = self.simulator, tape.status.view(-1, 3)
        finite = torch.isfinite(tape.F[-1]).all(dim=(1, 2))
        if bool(finite.all()) and not bool(found.any()):
            return
        if self.lenient:
            spoil(tape.states[:4], ~finite | (found[:, 0] != 0)[sim.particles.scene.long()], sim.particles.scene)
            return
        # the first one in time
        code, p, step = min((row for row in found.tolist() if row[0]), key=lambda row: row[2], default=(0, 0, 0))
        if code == 0:
            p, step = int((~finite).nonzero()[0]), self.steps - 1
        s = int(sim.particles.scene[p])
        p = int(sim.order[p]) + sim.first_particle
        scene = sim.scenes[s]
        s += sim.first_scene
        what = {
            kernels.LOST: "left the domain; enlarge `lower`/`upper`, or close it with `walls`",
            kernels.FAST: f"moved by more than a cell ({scene.dx:.4g} m) or became NaN; lower `dt` (now {scene.dt:g} s) or the stiffness",
            0: f"has a deformation gradient that is not finite; lower `dt` (now {scene.dt:g} s) or check the law",
        }[code]
        raise UserError(f"particle {p} of scene {s} {what} (substep {step + 1} of {self.steps})")

    # Backward.

    def backward(
        self, inputs: Sequence[Tensor], tape: Tape, gradients: Sequence[Tensor | None], wanted: Sequence[bool], steps: int | None = None
    ) -> list[Tensor | None]:
        """The adjoint of every input that is wanted, from the gradients of the frames of x, v, C and F (None: zero)."""
        sim, k = self.simulator, self.simulator.kernels
        mass, pull, force, friction, viscosity = inputs[STATES : STATES + 5]
        a_fixed = [torch.zeros_like(t) for t in inputs[STATES:FIXED]]
        a_mass, a_pull, a_force, a_friction, a_viscosity = a_fixed[:5]
        parameters = any(wanted[STATES + 1 : STATES + 4])
        now = [torch.zeros_like(t) for t in inputs[:STATES]]
        then = [torch.empty_like(t) for t in now]
        scratch, a_tau, other, a_trial = (torch.empty_like(now[3]) for _ in range(4))
        a_velocity, a_grid = sim.scratch("a_velocity"), sim.scratch("a_grid")
        with torch_stream(sim.device):
            elastic, plastic = self.engines(inputs)
            elastic.start_adjoint(wanted[FIXED : self.split])
            if plastic is not None:
                plastic.start_adjoint(wanted[self.split :])
            for n in reversed(range(self.steps if steps is None else steps)):
                if (n + 1) % self.every == 0:
                    _add(now, gradients, (n + 1) // self.every)
                x, v, C, F, history = state = tuple(t[n] for t in tape.states)
                v_next, C_next, F_next = tape.v[n + 1], tape.C[n + 1], tape.F[n + 1]
                material, a_material = self.material(inputs, n), self.material((*inputs[:STATES], *a_fixed), n)
                tau, grid, velocity = self.remade(inputs, tape, n, state, elastic, material, scratch)
                a_x, a_v, a_C, a_F, a_history = then
                a_out = now[3]
                trial = None
                if self.corrects:
                    trial = self.trial(F, C_next, other) if tape.trial is None else tape.trial[n]
                    a_out = a_trial.zero_()
                if material is not None:
                    self.remember_adjoint(material, a_material, trial, C_next, history, F_next, now, a_out, a_history.zero_())
                if plastic is not None:
                    plastic.adjoint(trial, now[3], a_trial)
                self.launch(k.grid_to_particles_adjoint, len(x),
                            [sim.particles.scene, sim.sorted_held, sim.origin, sim.dx, sim.dt, sim.nodes, velocity, x, F, v_next,
                             C_next, *now[:3], a_out, a_velocity.zero_(), a_x, a_F], self.block)  # fmt: skip
                arguments = [grid, a_velocity, a_grid, at_step(a_pull, n), a_force, a_friction, parameters]
                inputs_n = self.grid_inputs(at_step(pull, n), force, friction)
                self.launch(k.update_grid_adjoint, sim.node_count // sim.chunk, [*inputs_n, *arguments])
                self.launch(k.particles_to_grid_adjoint, len(x),
                            [sim.particles.scene, sim.origin, sim.dx, sim.dt, sim.nodes, mass, sim.sorted_volume, x, v, C, tau,
                             a_grid, a_mass, a_x, a_v, a_C, a_tau], self.block)  # fmt: skip
                if viscosity.numel():
                    self.launch(k.add_viscous_stress_adjoint, len(x),
                                [sim.particles.scene, viscosity, C, F, a_tau, a_C, a_F, a_viscosity])  # fmt: skip
                if material is not None:
                    if material.stiffness is not None or material.growth is not None or self.layout.e_max:
                        elastic.forward(F, other)
                    self.launch(self.effects.add_effect_stress_adjoint, len(x),
                                [*self.stress_inputs(material), F, history, other, a_tau, a_F, a_history, *a_material[:4]])  # fmt: skip
                elastic.adjoint(F, a_tau, a_F)
                now, then = then, now
            _add(now, gradients, 0)
            of_laws = [*elastic.gradients(), *(() if plastic is None else plastic.gradients())]
        return [*now, *a_fixed, *of_laws]

    def remade(
        self,
        inputs: Sequence[Tensor],
        tape: Tape,
        n: int,
        state: Sequence[Tensor],
        elastic: Engine,
        material: Material | None,
        scratch: Tensor,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Stress, grid and nodal velocities of substep n, from the tape, or made again from the state before it."""
        sim = self.simulator
        mass, pull, force, friction, viscosity = inputs[STATES : STATES + 5]
        x, v, C, F, history = state
        tau = scratch if tape.tau is None else tape.tau[n]
        if tape.tau is None:
            self.stress(elastic, F, C, history, viscosity, material, tau)
        grid = self.to_grid(x, v, C, tau, mass, sim.scratch("grid")) if tape.grid is None else tape.grid[n]
        velocity = sim.scratch("velocity") if tape.velocity is None else tape.velocity[n]
        if tape.velocity is None:
            self.on_grid(grid, at_step(pull, n), force, friction, velocity)
        return tau, grid, velocity

    def remember_adjoint(
        self,
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
        """Adds to the adjoints of C and F after the substep (in `a_next`), of the trial gradient and of the history before."""
        sim, k = self.simulator, self.effects
        a_C, a_F, a_history_next = a_next[2:]
        if self.layout.e_max:
            self.launch(k.remember_adjoint, len(F), [F, self.layout.at_e_max, history, a_history_next, a_F, a_history])
        if material.flow is not None:
            adjoints = [a_F, a_history_next, a_trial, a_C, a_history, a_material.flow, a_material.stiffness, a_material.growth]
            self.launch(k.flow_adjoint, len(F), [*self.flow_inputs(material), trial, C, history, *adjoints])
        if material.branches is not None:
            arguments = [C, history, a_history_next, a_C, a_history, a_material.branches]
            self.launch(k.relax_adjoint, len(F), [sim.particles.scene, sim.dt, material.branches, *arguments])

    def trial(self, F: Tensor, C_next: Tensor, out: Tensor) -> Tensor:
        """F_tr = (I + dt C) F, as grid_to_particles wrote it."""
        self.launch(self.simulator.kernels.trial_gradient, len(F), [self.simulator.particles.scene, self.simulator.dt, F, C_next, out])
        return out


def _add(now: Sequence[Tensor], gradients: Sequence[Tensor | None], frame: int) -> None:
    for a, gradient in zip(now, gradients):
        if gradient is not None:
            a.add_(gradient[frame])


def at_step(t: Tensor, n: int) -> Tensor:
    """The row of an input over time that substep n reads."""
    return t[n if len(t) > 1 else 0] if t.numel() else t
