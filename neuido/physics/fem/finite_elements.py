"""Explicit finite elements with the interface of the material point method: the same scenes, laws, effects and call.

Linear tetrahedra with lumped masses, symplectic Euler in time, contact of the nodes at the exact planes. Forward only. The particles
of a body are meshed (`meshing`), and the motion is returned at the particles. A step is divided into equal inner steps, as many as
the smallest element and the fastest wave require.
"""

import math
from collections.abc import Sequence
from typing import Literal, NoReturn

import torch
from torch import Tensor

from neuido.errors import UserError
from neuido.physics.colliders.solid_tables import refuse_solids
from neuido.physics.effects.parameters import Effects
from neuido.physics.fem import element_kernels
from neuido.physics.fem.assembly import Assembly, BodyMesh, SolverArrays, body_mesh
from neuido.physics.fem.assembly_rollout import AssemblyRollout, Inputs
from neuido.physics.fem.meshing import Mesh, mesh_body
from neuido.physics.laws.base import ElasticLaw, PlasticLaw, strain_limit
from neuido.physics.mpm import inputs
from neuido.physics.mpm.simulator import Simulator
from neuido.physics.runtime.deprecated import renamed_option
from neuido.physics.runtime.device import real_of
from neuido.physics.runtime.events import MarkRecorder, Marks, OnInversion, checked_option, raise_inversions
from neuido.physics.runtime.frames import Frames
from neuido.physics.runtime.invalidation import invalidate
from neuido.physics.runtime.limits import check_frames, check_memory
from neuido.physics.runtime.threads import one_thread_each, scene_pool
from neuido.types import Body, ParticleState, Scene

SAFETY = 0.5
"""Ratio of the inner step to the stable step of the undeformed mesh; a margin for elements that get thinner under compression."""
MAX_INNER_STEPS = 2000
"""Default of `max_inner_steps`."""


class FiniteElements:
    """Explicit finite elements of one or several scenes, each with one body; used as `mpm.Simulator` is.

    Args:
        scenes: One scene or a list; the grid (`cells`) is not used.
        bodies: One body per scene.
        density: Mass density [kg/m^3], one number or one per scene.
        device: `auto` (CUDA where there is one), `cpu`, `cuda`, or a `torch.device`.
        dtype: `torch.float32` for production, `torch.float64` for checks.
        threads: On the CPU, run scenes in parallel, one thread per core.
        graphs: On CUDA, capture the launches between two frames as a CUDA graph once per shape and replay it afterwards.
        elements: Approximate number of elements of a body; see `meshing.mesh_body`.
        tetrahedra: Number of tetrahedra per lattice cell, 5 or 6.
        smoothing: `none` or `nodal`. With `nodal`, the volume change of an element is averaged over its nodes, which avoids the locking
            of nearly incompressible bodies (average nodal pressure, Bonet and Burton 1998).
        meshes: Meshes to use instead of generated ones, one per body or one for all.
        max_inner_steps: Largest number of inner steps per step; a scene that needs more is an error.
        on_inversion: What a rollout does where an element turns inside out or collapses, as for `mpm.Simulator`.

    Raises:
        UserError: As `mpm.Simulator`, or a body that cannot be meshed.

    Attributes:
        state: `ParticleState` at t = 0.
        mass: Particle masses [kg], (P,), attached masses included.
        volume: Initial volumes [m^3], (P,).
        particles: `Particles`, which scene each particle belongs to.
        meshes: The `Mesh` of each scene.
    """

    def __init__(
        self,
        scenes: Scene | Sequence[Scene],
        bodies: Body | Sequence[Body],
        *,
        density: float | Sequence[float] = 1000.0,
        device: str | torch.device = "auto",
        dtype: torch.dtype = torch.float32,
        threads: bool = True,
        graphs: bool = True,
        elements: int | None = None,
        tetrahedra: int = 5,
        smoothing: Literal["none", "nodal"] = "none",
        meshes: Mesh | Sequence[Mesh] | None = None,
        max_inner_steps: int = MAX_INNER_STEPS,
        on_inversion: OnInversion = "report",
    ) -> None:
        if smoothing not in ("none", "nodal"):
            raise UserError(f"smoothing is {smoothing!r}; choose none or nodal")
        self.on_inversion = checked_option(on_inversion)
        refuse_solids((scenes,) if isinstance(scenes, Scene) else scenes, "FiniteElements")
        loaded = Simulator(scenes, bodies, density=density, device=device, dtype=dtype, threads=False, graphs=False)
        self.scenes, self.device, self.dtype, self.smoothing = loaded.scenes, loaded.device, loaded.dtype, smoothing
        self.particles, self.state, self.mass, self.volume = loaded.particles, loaded.state, loaded.mass, loaded.volume
        self.dt, self.gravity, self.colliders = loaded.dt, loaded.gravity, loaded.colliders
        self.graphs, self.max_inner_steps = graphs and self.device.type == "cuda", max_inner_steps
        self.held = loaded.setup.held.bool()
        self.kernels = element_kernels.build(real_of(dtype))
        bodies = (bodies,) if isinstance(bodies, Body) else tuple(bodies)
        if meshes is not None:
            meshes = (meshes,) * len(bodies) if isinstance(meshes, Mesh) else tuple(meshes)
            if len(meshes) != len(bodies):
                raise UserError(f"{len(meshes)} meshes for {len(bodies)} bodies; give one mesh per body, or one for all")
        made: dict[tuple[int, ...], tuple[Mesh, BodyMesh]] = {}
        tied_meshes = []
        self.meshes: tuple[Mesh, ...] = ()
        self.sizes: list[float] = []
        for s, body in enumerate(bodies):
            given = None if meshes is None else meshes[s]
            key = (id(body.x), id(body.volume), id(given))  # references to one body share its mesh
            if key not in made:
                x, volume = torch.as_tensor(body.x).double().cpu(), torch.as_tensor(body.volume).double().cpu()
                mesh = mesh_body(x, volume, elements=elements, kind=tetrahedra) if given is None else given
                made[key] = (mesh, body_mesh(mesh, x, volume, self.device, self.dtype))
            mesh, tied = made[key]
            self.meshes += (mesh,)
            self.sizes.append(self.sizes[-1] if s and mesh is self.meshes[-2] else _size(mesh))
            tied_meshes.append(tied)
        # on the CPU each scene is an assembly that one thread runs; on a GPU one assembly holds all scenes
        count = len(self.scenes)
        ranges = [(s, s + 1) for s in range(count)] if self.device.type == "cpu" else [(0, count)]
        self.arrays = SolverArrays(
            self.scenes, self.device, dtype, self.kernels, smoothing, self.colliders, self.particles, self.state, self.volume, self.held
        )
        assemblies = [Assembly(self.arrays, tied_meshes[a:b], a, b) for a, b in ranges]
        self.runs = [AssemblyRollout(assembly, self.graphs) for assembly in assemblies]
        self.pool = scene_pool() if threads and len(self.runs) > 1 else None

    def __repr__(self) -> str:
        count, elements = len(self.scenes), sum(len(mesh.elements) for mesh in self.meshes)
        return (f"FiniteElements({count} scene{'' if count == 1 else 's'}, {len(self.mass)} particles, {elements} elements, "
                f"smoothing {self.smoothing}, {str(self.dtype).removeprefix('torch.')} on {self.device})")  # fmt: skip

    @property
    def scene_count(self) -> int:
        """The number of scenes S."""
        return len(self.scenes)

    @property
    def assemblies(self) -> list[Assembly]:
        """The assembled meshes: one assembly per scene on the CPU, one for all scenes on a GPU."""
        return [run.assembly for run in self.runs]

    def inner_steps(
        self,
        elasticity: ElasticLaw,
        viscosity: Tensor | None = None,
        mass: Tensor | None = None,
        stiffening: tuple[Tensor, Tensor] | None = None,
        refused: list[int] | None = None,
        smallest: Tensor | None = None,
    ) -> list[int]:
        """Return the inner steps per step of each scene, by the bound 2/omega of its worst element (Belytschko et al., sec. 6.2).

        Args:
            elasticity: Elastic law; its P-wave modulus sets the wave speed.
            viscosity: `Effects.viscosity` [Pa s], (S, 2), or None; it acts on the velocity of half a step earlier.
            mass: Particle masses [kg], (P,).
            stiffening: What effects add to each scene's P-wave modulus [Pa], and the largest factor on the sum, (S,) each.
            refused: A list to which scenes that need more than `max_inner_steps` are appended instead of raising; they run with the
                inner steps of the others.
            smallest: Smallest stress-free size of each scene [-], (S,), where it swells or dries.

        Raises:
            UserError: A negative modulus, or a scene that needs more than `max_inner_steps`.
        """
        needs = [math.ceil(need - 1e-9) for need in self._needs(elasticity, viscosity, mass, stiffening, smallest)]
        out = []
        for assembly in self.assemblies:
            count = 1
            for s in range(assembly.a, assembly.b):
                if needs[s] <= self.max_inner_steps:
                    count = max(count, needs[s])
                elif refused is not None:
                    refused.append(s)
                else:
                    raise UserError(f"dt of scene {s} needs {needs[s]} inner steps of its smallest element, more than max_inner_steps = "
                                    f"{self.max_inner_steps}; lower the stiffness, the viscosity or `elements`")  # fmt: skip
            out += [count] * (assembly.b - assembly.a)
        return out

    def _needs(
        self,
        elasticity: ElasticLaw,
        viscosity: Tensor | None,
        mass: Tensor | None,
        stiffening: tuple[Tensor, Tensor] | None,
        smallest: Tensor | None,
    ) -> list[float]:
        """Return the ratio of the step to the stable inner step of each scene; arguments as for `inner_steps`."""
        bounds = inputs.waves(self, elasticity, mass, stiffening)
        viscosities = None if viscosity is None else viscosity.detach().double().tolist()
        out = []
        for assembly in self.assemblies:
            for s in range(assembly.a, assembly.b):
                modulus, density = bounds[s]
                bound = assembly.meshes[s - assembly.a].stiffness_bound
                if smallest is not None:  # elements of a body that dries become smaller
                    bound = bound / min(float(smallest[s]), 1.0) ** 2
                omega = 2.0 * math.sqrt(modulus / density * bound)
                damping = 0.0
                if viscosities is not None:
                    eta, zeta = viscosities[s]
                    damping = 4.0 * bound * (4.0 / 3.0 * eta + zeta) / density
                # the root of (omega dt)^2 + 2 damping dt = 4
                step = 4.0 / (damping + math.sqrt(damping**2 + 4.0 * omega**2)) if omega + damping > 0 else math.inf
                out.append(self.scenes[s].dt / (SAFETY * step))
        return out

    def step_margin(
        self, steps: int, elasticity: ElasticLaw, plasticity: PlasticLaw | None = None, *, effects: Effects | None = None
    ) -> float:
        """Return the smallest ratio of `max_inner_steps` to required inner steps over the scenes; below 1, `rollout` raises.

        Raises:
            UserError: As `rollout`, except for too many inner steps.
        """
        given = inputs.prepare(self, steps, elasticity, plasticity, effects=effects)
        needs = self._needs(elasticity, given.viscosity, given.mass, given.stiffening(self), self._smallest(given.effects, steps))
        return self.max_inner_steps / max(needs)

    def _smallest(self, effects: Effects, steps: int) -> Tensor | None:
        """Return the smallest stress-free size of each scene [-], (S,); None without swelling."""
        size = effects.stress_free_size(self.dt, steps)
        return None if size is None else size.detach().amin(dim=0)

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
        inner: int | None = None,
        inner_factor: int = 1,
        nan_on_failure: bool = False,
        finer: int | None = None,
        lenient: bool | None = None,
    ) -> Frames:
        """Simulate `steps` steps without gradients; arguments and result are those of `mpm.Simulator.rollout`.

        Args:
            steps: Number of steps.
            elasticity: F -> Kirchhoff stress.
            plasticity: Trial F -> corrected F; None: purely elastic.
            state: Initial state, (P, ...). Its difference from the bodies as loaded (or from the end of the last rollout, if the
                particles are there) is interpolated to nodes and elements. F is the initial elastic deformation gradient and is
                independent of the positions.
            effects: Physical effects beyond the laws.
            gravity: [m/s^2], (S, 3); by default that of the scenes.
            friction: Friction coefficients, (S, K): colliders first, then walls.
            mass: [kg], (P,); by default density times volume.
            every: Steps between two frames.
            segment: Ignored; there is no tape.
            check: Ignored; the inner steps are always stable for the undeformed mesh.
            inner: Inner steps per step, instead of `inner_steps`.
            inner_factor: Factor on the number of inner steps. `inner_steps` ensures stability for the body at rest; a law that stiffens
                with strain may need more.
            nan_on_failure: Instead of raising, set the frames of a scene to NaN if it needs too many inner steps or its motion fails.
            finer: Deprecated name of `inner_factor`.
            lenient: Deprecated name of `nan_on_failure`.

        Returns:
            Frames x (K, P, 3), v (K, P, 3), C (K, P, 3, 3), F (K, P, 3, 3), K = steps / every + 1. x and v are interpolated within the
            element of each particle, C and F are those of the element. Frame 0 is the initial state.

        Raises:
            UserError: Before the start, as `inner_steps`; afterwards, a motion that is not finite.
        """
        inner_factor = renamed_option("inner_factor", inner_factor, "finer", finer)
        nan_on_failure = renamed_option("nan_on_failure", nan_on_failure, "lenient", lenient)
        check_frames(steps, every)
        with torch.no_grad():
            given = inputs.prepare(
                self, steps, elasticity, plasticity, state=state, effects=effects, gravity=gravity, friction=friction, mass=mass
            )
            return self._rollout(steps, elasticity, plasticity, given, every, inner, inner_factor, nan_on_failure)

    def _rollout(
        self,
        steps: int,
        elasticity: ElasticLaw,
        plasticity: PlasticLaw | None,
        given: inputs.RolloutInputs,
        every: int,
        inner: int | None,
        inner_factor: int,
        nan_on_failure: bool,
    ) -> Frames:
        needed = (steps // every + 1) * sum(t.numel() for t in given.state) * self.dtype.itemsize
        what = f"a rollout of {len(self.mass)} particles and {steps // every + 1} frames"
        check_memory(needed, self.device, what, "raise `every`, lower `steps`")
        state, effects, tables, viscosity, stiffness = given.state, given.effects, given.tables, given.viscosity, given.stiffness
        refused: list[int] = []
        if inner is None:
            refused_or_raise = refused if nan_on_failure else None
            smallest = self._smallest(effects, steps)
            inner_of = self.inner_steps(elasticity, viscosity, given.mass, given.stiffening(self), refused_or_raise, smallest)
        else:
            inner_of = [inner] * self.scene_count
        inner_of = [n * inner_factor for n in inner_of]
        frames = Frames(
            *(t.new_empty(steps // every + 1, *t.shape) for t in state),
            dt=[scene.dt * every for scene in self.scenes],
            particles=self.particles,
            strain_limit=strain_limit(elasticity, plasticity),
        )

        def one(run: AssemblyRollout) -> MarkRecorder:
            assembly = run.assembly
            a, b = assembly.a, assembly.b
            n = inner_of[a]
            scenes, own = slice(a, b), slice(self.particles.offsets[a], self.particles.offsets[b])
            dt = self.dt[scenes] / n
            growth = effects.growth(self.dt / n, steps * n)
            size, loss = effects.stress_free_size(self.dt / n, steps * n), effects.spin_loss(self.dt / n)
            part = Inputs(
                ParticleState(*(t[own] for t in state)),
                given.mass[own],
                effects.accelerations(given.gravity, self.dt / n, steps * n)[:, scenes].contiguous(),
                given.force[scenes].contiguous(),
                given.friction[scenes].contiguous(),
                None if viscosity is None else viscosity[scenes].contiguous(),
                None if tables is None else assembly.rows(tables),
                None if stiffness is None else stiffness[own],
                None if growth is None else growth[:, scenes].contiguous(),
                None if size is None else size[:, scenes].to(self.dtype).contiguous(),
                None if loss is None else loss[scenes].contiguous(),
                dt.contiguous(),
            )
            return run.run(steps, every, n, elasticity, plasticity, part, ParticleState(*(t[:, own] for t in frames)))

        if self.pool is None:
            recorders = [one(run) for run in self.runs]
        else:
            with one_thread_each():
                recorders = list(self.pool.map(one, self.runs))
        frames.marks = self._marks(recorders, every, inner_of)
        scene = self.particles.scene.long()
        dt = self.dt / torch.tensor(inner_of).to(self.dt)
        limit = (torch.tensor(self.sizes).to(self.dt) / dt)[scene]  # a point must not cross an element within an inner step
        fine = torch.isfinite(frames.x).all(dim=2) & (frames.v.norm(dim=2) <= limit)
        if nan_on_failure:
            refusing = torch.tensor([s in refused for s in range(self.scene_count)], device=self.device)
            failed = refusing[scene] | ~fine.all(dim=0)
            if self.on_inversion == "error":
                inverted = torch.zeros(self.scene_count, dtype=torch.bool, device=self.device)
                inverted[frames.marks.scene[frames.marks.since >= 0].long()] = True
                failed = failed | inverted[scene]
            invalidate(frames, failed, scene)
        else:
            if self.on_inversion == "error":
                raise_inversions(frames.marks)
            if not bool(fine.all()):
                self._raise(fine, steps, every, inner_of)
        return frames

    def _marks(self, recorders: Sequence[MarkRecorder], every: int, inner: Sequence[int]) -> Marks:
        """Return what was noted of the elements of all scenes; a step is an inner one."""
        scene = torch.cat([assembly.particles.scene + assembly.a for assembly in self.assemblies])
        dt = tuple(own.dt / n for own, n in zip(self.scenes, inner))
        lowest, since = (torch.cat([getattr(recorder, name) for recorder in recorders]) for name in ("lowest", "since"))
        return Marks(lowest, since, scene, dt, tuple(every * n for n in inner), "elements")

    def _raise(self, fine: Tensor, steps: int, every: int, inner: list[int]) -> NoReturn:
        """Raise for the first particle whose motion is not finite or too fast; `fine` (K, P) says where the motion is valid."""
        frame, p = ((~fine).nonzero()[0]).tolist()
        s = int(self.particles.scene[p])
        raise UserError(f"the motion of scene {s} is not finite from step {max(frame - 1, 0) * every} of {steps} on; lower `dt` "
                        f"(now {self.scenes[s].dt:g} s in {inner[s]} inner steps) or the stiffness")  # fmt: skip


def _size(mesh: Mesh) -> float:
    """Return the longest edge from an element's first corner [m]."""
    corners = mesh.nodes[mesh.elements]
    return float((corners[:, 1:] - corners[:, :1]).norm(dim=2).max())
