"""The arrays of a simulator that depend on scenes and bodies alone, and not on laws or effects."""

import math
from collections.abc import Sequence
from itertools import accumulate
from typing import Literal

import torch
from torch import Tensor

from neuido.errors import UserError
from neuido.physics.colliders.attachments import attachment_table
from neuido.physics.colliders.leaving import Leaving
from neuido.physics.colliders.solid_tables import solid_table
from neuido.physics.colliders.tables import clamp_table, collider_table, inside_box
from neuido.physics.mpm.kernels import stencil
from neuido.physics.mpm.kernels import transfers as kernels
from neuido.physics.mpm.window.nodes import Nodes
from neuido.physics.mpm.window.placement import FOLLOWED, PIECE, Window, corners
from neuido.physics.multibody import contact_kernels
from neuido.physics.multibody.contact_grid import ContactGrid
from neuido.physics.multibody.scene_bodies import SceneBodies, checked_body, friction_table
from neuido.physics.runtime.device import launch, real_of, torch_stream
from neuido.physics.runtime.limits import check_memory
from neuido.types import Body, Particles, ParticleState, Scene

NODE_BYTES = 16
"""Memory of a grid node beside its mass, momentum and velocity [bytes]: the index."""
NODES_KEPT = {"cuda": 4, "cpu": 8}
"""Nodes a particle up to which a tape keeps stress and nodal values where `store` is "auto". On the CPU that takes a sixth less time with
4, 10 and 21 nodes a particle, and 8 make the tape four times as large."""
PARTICLE_BYTES = 400
"""Memory of a particle beside its state [bytes]: the body in float64, its order, mass and volume."""


def affine_velocity(x: Tensor, v: Tensor, neighbours: int = 32, chunk: int = 2048) -> Tensor:
    """Estimate the gradient of a velocity field from its values at particles; differentiable in v.

    A rollout starts with C equal to it, since C = 0 would lose 6-8 % of a spin in the first step. If one affine fit is accurate to 1e-3, as
    for all rigid and uniform motions, it serves for all particles. Else the fit is over the nearest neighbours of each particle.

    Args:
        x: Positions [m], (P, 3).
        v: Velocities [m/s], (P, 3).
        neighbours: Number of neighbours in a local fit.
        chunk: Number of particles that are processed at a time.

    Returns:
        Velocity gradient [1/s], (P, 3, 3).
    """
    dx = x - x.mean(dim=0)
    dv = v - v.mean(dim=0)
    gradient = _affine_fit(dx, dv, 1e-9)
    residual = (dv - dx @ gradient.T).detach().norm(dim=1).max()
    if residual <= 1e-3 * v.detach().norm(dim=1).max() or x.shape[0] <= neighbours:
        return gradient.expand(x.shape[0], 3, 3).contiguous()
    out = []
    for start in range(0, x.shape[0], chunk):
        near = torch.cdist(x[start : start + chunk], x).topk(neighbours, largest=False).indices
        nx, nv = x[near], v[near]
        nx, nv = nx - nx.mean(dim=1, keepdim=True), nv - nv.mean(dim=1, keepdim=True)
        out.append(_affine_fit(nx, nv, 1e-6))
    return torch.cat(out).contiguous()


def _affine_fit(x: Tensor, v: Tensor, ridge: float) -> Tensor:
    """Return the velocity gradient (..., 3, 3) of v (..., n, 3) over x (..., n, 3), both about their means.

    It is zero across directions in which the particles do not differ.

    Args:
        x: Positions [m]; particles in one place, or one particle, give zero.
        v: Velocities [m/s].
        ridge: Share of the trace that keeps the fit of flat bodies solvable.
    """
    spread = x.mT @ x
    size = spread.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None]
    apart = size > 0
    eye = torch.eye(3, dtype=x.dtype, device=x.device)
    gradient = torch.linalg.solve(spread + torch.where(apart, ridge * size, 1.0) * eye, x.mT @ v).mT
    return torch.where(apart, gradient, 0.0)


class Setup:
    """Scenes, bodies and scratch memory of a simulator; all but the scratch memory is immutable.

    Args:
        scenes: S scenes.
        bodies: The bodies of each scene.
        device: Device of the arrays, with its index.
        dtype: Scalar type of the arrays.
        store: As for `Simulator`.
        grid: As for `Simulator`.
        fusion: As for `Simulator`.

    Raises:
        UserError: As `Simulator`.

    Attributes:
        particles: The scene that each particle belongs to.
        state: The initial state, in the order of the bodies.
        mass: [kg], (P,).
        volume: [m^3], (P,).
        held: Particles in a clamp, (P,) uint8.
        body: Index of each particle's body, (P,) int32; the bodies of all scenes are counted on.
        field: Index of each particle's velocity field, (P,) int32. A scene has one field, or one for each body where bodies may part.
        field_scene: Scene of each field, (fields,) int64.
        first: First particle of each scene, then their number, (S + 1,) int32.
        order: The order in which the kernels see the particles, (P,): scene by scene, body by body, then by cell.
        inverse: The inverse permutation.
        room: The nodes of the grid at present.
        window: Places the grid around the particles; None: it is the whole domain.
        origin: Place of the first node of each scene [m], (S, 3).
        edge: The x of that of the first scene [m].
        keep_grid: Whether a tape stores stress and nodal values too.
        warps: Scene, first particle and end of each warp of kernels that need them; here, since captured graphs read their memory.
        first_scene: Index of the first scene within the whole simulator, if this is a part of one.
        first_particle: Index of the first particle within the whole simulator.
    """

    def __init__(
        self,
        scenes: Sequence[Scene],
        bodies: Sequence[SceneBodies],
        device: torch.device,
        dtype: torch.dtype,
        store: Literal["state", "all", "auto"],
        grid: Literal["domain", "window", "auto"] = "domain",
        fusion: Literal["auto", "fused", "transfers", "separate"] = "auto",
    ) -> None:
        self.fusion = fusion
        self.scenes, self.bodies, self.device, self.dtype = tuple(scenes), tuple(bodies), device, dtype
        self.kernels = kernels.build(real_of(dtype))
        self._load_scenes()
        self.whole = tuple(max(scene.nodes[a] for scene in self.scenes) + 2 * kernels.PAD for a in range(3))
        self.field_counts = torch.tensor([len(own.bodies) if own.separate else 1 for own in bodies])
        self.field_scene = torch.arange(len(bodies)).repeat_interleave(self.field_counts).to(device)
        self.field_origin, self.field_dx, self.field_dt = self.origin, self.dx, self.dt
        if any(own.separate for own in bodies):
            self.field_origin, self.field_dx, self.field_dt = (t[self.field_scene] for t in (self.origin, self.dx, self.dt))
        self.window: Window | None = None
        self._rooms: dict[tuple[int, ...], Nodes] = {}
        self._open_room(grid)
        self._load_bodies()
        watched = self.device.type == "cpu" and len(self.field_scene) == 1
        self.span = torch.empty(2 if watched else 0, dtype=self.dtype, device=self.device)
        """Smallest and largest x [m] of the particles after a substep; only for a single velocity field on the CPU."""
        self.ends = self.span.numpy() if watched else None
        self._sort()
        self.attached = attachment_table(self.scenes, self.state.x, self.particles.offsets, self.order)
        many = NODES_KEPT["cuda" if device.type == "cuda" else "cpu"] * len(self.mass)
        self.keep_grid = store == "all" or (store == "auto" and self.room.count <= many)
        self.first_scene = self.first_particle = 0
        self.leaving: Leaving | None = None
        self.warps: list[Tensor] = []
        self._single: dict[int, Setup] = {}

    def _load_scenes(self) -> None:
        def column(values: list) -> Tensor:
            return torch.tensor(values, dtype=torch.float64).to(self.device, self.dtype)

        for scene in self.scenes:
            if not (scene.cells >= 4 and scene.dt > 0 and all(u > l for l, u in zip(scene.lower, scene.upper))):
                raise UserError(f"cells is {scene.cells}, dt {scene.dt:g}; a scene needs cells >= 4, dt > 0 and upper above lower")
        self.dx = column([s.dx for s in self.scenes])
        self.dt = column([s.dt for s in self.scenes])
        self._corner = [[l - kernels.PAD * s.dx for l in s.lower] for s in self.scenes]
        self.origin = column(self._corner)
        self.gravity = column([list(s.gravity) for s in self.scenes])
        self.colliders = collider_table(self.scenes, self.dtype, self.device)
        self.solids = solid_table(self.scenes, self.dtype, self.device)
        self.clamp_lower, self.clamp_upper = clamp_table(self.scenes, self.dtype, self.device)

    def _open_room(self, grid: str) -> None:
        """Choose between the whole domain and a window, and allocate the nodes.

        Raises:
            UserError: Grid and particles need more memory than there is.
        """
        positions = [torch.cat([torch.as_tensor(body.x).reshape(-1, 3) for body in own.bodies]) for own in self.bodies]
        of_particles = sum(len(x) for x in positions) * (PARTICLE_BYTES + 24 * self.dtype.itemsize)
        of_nodes = self._node_bytes(self.whole)
        if grid == "window" or (grid == "auto" and of_nodes > max(FOLLOWED, of_particles)):
            self.window = Window(self.scenes, kernels.PAD)
            ends = [corners(x, (0, len(x))) for x in positions]
            shape, origin = self.window.fit(torch.cat([low for low, _ in ends]), torch.cat([high for _, high in ends]), PIECE)
            of_nodes = self._node_bytes(shape)
            self.window.shape.zero_()  # a rollout of shorter pieces needs less
        else:
            shape, origin = self.whole, torch.tensor(self._corner, dtype=torch.float64)
        nodes = " x ".join(str(n) for n in shape)
        count = sum(len(x) for x in positions)
        what = f"a simulator of {len(self.scenes)} scene{'s' * (len(self.scenes) > 1)}, {count} particles and {nodes} grid nodes a scene"
        change = "lower `cells` or the number of particles or scenes"
        check_memory(of_nodes + of_particles, self.device, what, change + (", or give `grid='window'`" if grid == "domain" else ""))
        self.place(shape, origin)

    def _node_bytes(self, shape: Sequence[int]) -> int:
        """Return the memory of the nodes of a grid [bytes]."""
        return len(self.field_scene) * math.prod(shape) * (NODE_BYTES + 8 * self.dtype.itemsize)

    def _nodes(self, shape: tuple[int, ...]) -> Nodes:
        """Return the nodes of a grid; of several shapes the last two are kept."""
        if shape not in self._rooms:
            while len(self._rooms) >= 2:
                self._rooms.pop(next(iter(self._rooms)))
            nodes = Nodes(self.field_scene, shape, self.dtype, self.device)
            if any(own.separate for own in self.bodies):
                pairs = contact_kernels.build(real_of(self.dtype), stencil.functions)
                frictions = friction_table(self.scenes, self.bodies)
                counts = self.field_counts.tolist()
                nodes.contact = ContactGrid(counts, pairs, nodes.size, nodes.chunk, self.dx, self.dt, frictions, self.device, self.dtype)
            self._rooms[shape] = nodes
        return self._rooms[shape]

    @property
    def contact(self) -> ContactGrid | None:
        """Contact between bodies with fields of their own; None where no scene has such."""
        return self.room.contact

    def place(self, shape: tuple[int, ...], origin: Tensor) -> None:
        """Move the grid: nodes along each axis, and the place of the first node of each scene [m], (S, 3)."""
        self.room = self._nodes(shape)
        self.edge = float(origin[0, 0])
        self.origin.copy_(origin)  # in place: a captured graph reads this memory
        if self.field_origin is not self.origin:
            self.field_origin.copy_(self.origin[self.field_scene])
        table = [self.origin, self.dx, self.colliders.plane, self.clamp_lower, self.clamp_upper, self.room.index, self.room.near]
        with torch_stream(self.device):
            launch(self.kernels.mark_nodes, self.room.count, table, self.device)

    def _load_bodies(self) -> None:
        x, v, C, F, mass, volume, held, scene_index, body_index, field_index = ([] for _ in range(10))
        counts, bodies_before, fields_before = [], 0, 0
        for s, (scene, own) in enumerate(zip(self.scenes, self.bodies)):
            parts = [checked_body(body, s, b, own.own, self.device) for b, body in enumerate(own.bodies)]
            bx, bv, V = (torch.cat(t) for t in zip(*parts))
            lower, upper = bx.new_tensor(scene.lower), bx.new_tensor(scene.upper)
            out = ((bx < lower) | (bx > upper)).any(dim=1)
            if bool(out.any()):
                p = int(out.nonzero()[0])
                raise UserError(f"particle {p} of scene {s} at {short_vector(bx[p])} m lies outside the domain "
                                f"{short_vector(lower)} to {short_vector(upper)}; move the body or enlarge `lower`/`upper`")  # fmt: skip
            densities = [rho if isinstance(rho, float) else rho.to(self.device) for rho in own.density]
            m = torch.cat([rho * part[2] for rho, part in zip(densities, parts)])
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
            for body, (own_x, own_v, _) in zip(own.bodies, parts):
                C.append(affine_velocity(own_x, own_v))
                eye = torch.eye(3, dtype=torch.float64, device=self.device).expand(len(own_x), 3, 3)
                F.append(eye if body.F is None else torch.as_tensor(body.F).to(self.device, torch.float64))
            counts.append(len(bx))
            scene_index.append(torch.full((len(bx),), s, dtype=torch.int32, device=self.device))
            of_body = torch.arange(len(own.bodies), dtype=torch.int32, device=self.device)
            of_body = of_body.repeat_interleave(torch.tensor(own.counts, device=self.device))
            body_index.append(of_body + bodies_before)
            field_index.append(of_body * int(own.separate) + fields_before)
            bodies_before += len(own.bodies)
            fields_before += len(own.bodies) if own.separate else 1

        def join(parts: list[Tensor]) -> Tensor:
            return torch.cat(parts).to(self.dtype).contiguous()

        offsets = [0, *accumulate(counts)]
        self.particles = Particles(torch.cat(scene_index), tuple(offsets))
        self.first = torch.tensor(offsets, dtype=torch.int32, device=self.device)
        self.state = ParticleState(join(x), join(v), join(C), join(F))
        self.mass, self.volume = join(mass), join(volume)
        self.held = torch.cat(held).to(torch.uint8)
        self.body, self.field = torch.cat(body_index), torch.cat(field_index)

    def _sort(self) -> None:
        """Sort the particles as the kernels see them: by scene, body and cell, so that neighbours add to the same nodes."""
        scene, body = self.particles.scene.long(), self.body.long()
        cell = ((self.state.x - self.origin[scene]) / self.dx[scene, None] - 0.5).floor().long()
        nx, ny, nz = self.whole
        key = ((body * nx + cell[:, 0]) * ny + cell[:, 1]) * nz + cell[:, 2]
        self.order = torch.argsort(key, stable=True)
        self.inverse = torch.argsort(self.order)
        self.sorted_volume, self.sorted_held = self.volume[self.order].contiguous(), self.held[self.order].contiguous()
        self.numbers = torch.arange(len(self.order), dtype=torch.int32, device=self.device)

    def viscosity_rows(self, viscosity: Tensor) -> Tensor:
        """Return the row of each particle in a table of viscosities, (P,) int32: its scene, or its number in a table of all particles."""
        return self.particles.scene if len(viscosity) <= self.scene_count else self.numbers

    def single_scene(self, s: int) -> "Setup":
        """Return the set-up of scene s alone, with its particles in the order that they have here."""
        if s not in self._single:
            own = slice(self.particles.offsets[s], self.particles.offsets[s + 1])
            body = Body(self.state.x[own], self.state.v[own], self.volume[own], self.state.F[own])
            alone = SceneBodies((body,), (1000.0,), own=False, separate=False)
            one = Setup(self.scenes[s : s + 1], [alone], self.device, self.dtype, "all" if self.keep_grid else "state", fusion=self.fusion)
            one.order = self.order[own] - own.start
            one.sorted_volume, one.sorted_held = self.sorted_volume[own], self.sorted_held[own]
            one.first_scene, one.first_particle = s, own.start
            if self.leaving is not None:
                one.watch_faces(self.leaving.mode)
            self._single[s] = one
        return self._single[s]

    def watch_faces(self, on_leave: str) -> None:
        """Clamp or delete particles that leave the domain, in place of an error."""
        self.leaving = None if on_leave == "error" else Leaving(on_leave, self.scenes, self.particles.scene, self.sorted_held, self.mass)

    @property
    def held_now(self) -> Tensor:
        """Particles that are held at rest in the current substep, (P,) uint8: those of clamps, and deleted ones."""
        return self.sorted_held if self.leaving is None else self.leaving.held

    @property
    def scene_count(self) -> int:
        """The number of scenes S."""
        return len(self.scenes)


def short_vector(t: Tensor) -> list[float]:
    """Return the numbers of a tensor with four digits, for messages."""
    return [float(f"{value:.4g}") for value in t.tolist()]
