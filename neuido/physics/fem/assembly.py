"""The arrays of a finite-element rollout: the meshes of some scenes side by side, and their ties to the particles.

An inner step has the order of the material point method: stress of F, nodal forces, motion and contact of the nodes, F_tr = (I + dt C) F,
plastic correction, history.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from types import SimpleNamespace
from typing import NamedTuple

import torch
from torch import Tensor

from neuido.physics.colliders.tables import NEAR, ColliderTable, box_corners
from neuido.physics.effects.coefficients import Tables
from neuido.physics.fem.meshing import Mesh, stiffness_bound
from neuido.physics.fem.particle_weights import interpolation_weights, locate
from neuido.types import Particles, ParticleState, Scene

DENSE = 3.0
"""Factor on the median density of a body; particle mass above that density counts as an attached mass."""


@dataclass(frozen=True)
class SolverArrays:
    """The arrays and settings that all assemblies of a solver share."""

    scenes: tuple[Scene, ...]
    device: torch.device
    dtype: torch.dtype
    kernels: SimpleNamespace
    """The result of `element_kernels.build`."""
    smoothing: str
    """`none` or `nodal`."""
    colliders: ColliderTable
    particles: Particles
    state: ParticleState
    """Initial state of the particles."""
    volume: Tensor
    """Volume of each particle [m^3], (P,)."""
    held: Tensor
    """Which particles lie in a clamp, (P,) bool."""

    @property
    def scene_count(self) -> int:
        """The number of scenes S."""
        return len(self.scenes)


class BodyMesh(NamedTuple):
    """The mesh of one body and its ties to the particles, in the dtype and on the device of the solver."""

    nodes: Tensor
    """Positions at t = 0 [m], (N, 3)."""
    elements: Tensor
    """Nodes of each element, (E, 4) int64."""
    volume: Tensor
    """Volume of each element [m^3], (E,), scaled so that the sum is the volume of the particles."""
    element_of: Tensor
    """Element that contains each particle, (P,)."""
    weights: Tensor
    """Barycentric weights of each particle in that element, (P, 4)."""
    to_nodes: tuple[Tensor, Tensor]
    """Particles and weights, (N, k) each, that interpolate a field to the nodes; exact for affine fields."""
    to_elements: tuple[Tensor, Tensor]
    """Particles and positive weights, (E, k) each, for the mean over the particles near an element."""
    stiffness_bound: float
    """Largest `meshing.stiffness_bound` of an element [1/m^2]."""


def body_mesh(mesh: Mesh, x: Tensor, volume: Tensor, device: torch.device, dtype: torch.dtype) -> BodyMesh:
    """Tie a mesh to the particles of a body.

    Args:
        mesh: The mesh.
        x: Positions of the particles at t = 0 [m], (P, 3).
        volume: Volumes of the particles [m^3], (P,).
        device: Device of the result.
        dtype: Scalar type of the result.
    """
    nodes, own = mesh.nodes, mesh.volume
    element_of, weights = locate(mesh, x)
    centroid = nodes[mesh.elements].mean(dim=1)
    to_nodes = interpolation_weights(x, nodes)
    to_elements = interpolation_weights(x, centroid, near=8, degree=0)

    def real(t: Tensor) -> Tensor:
        return t.to(device, dtype)

    return BodyMesh(
        real(nodes),
        mesh.elements.to(device),
        real(own * (volume.sum() / own.sum())),
        element_of.to(device),
        real(weights),
        (to_nodes[0].to(device), real(to_nodes[1])),
        (to_elements[0].to(device), real(to_elements[1])),
        float(stiffness_bound(mesh).max()),
    )


class Assembly:
    """The meshes of some scenes of a solver in common arrays.

    Args:
        solver: The arrays and settings that all assemblies share.
        meshes: The mesh of each scene.
        a: First scene.
        b: Last scene plus one.
    """

    def __init__(self, solver: SolverArrays, meshes: Sequence[BodyMesh], a: int, b: int) -> None:
        self.solver, self.meshes, self.a, self.b = solver, tuple(meshes), a, b
        device = solver.device
        nodes = [len(p.nodes) for p in meshes]
        elements = [len(p.elements) for p in meshes]
        shift = [sum(nodes[:s]) for s in range(len(meshes))]
        self.nodes = torch.cat([p.nodes for p in meshes]).contiguous()
        index = torch.cat([p.elements + n for p, n in zip(meshes, shift)])
        self.elements = index.to(torch.int32).contiguous()
        self.volume = torch.cat([p.volume for p in meshes]).contiguous()
        scenes = torch.arange(len(meshes), dtype=torch.int32)
        self.node_scene = scenes.repeat_interleave(torch.tensor(nodes)).to(device)
        self.first_node = torch.tensor([*shift, sum(nodes)], dtype=torch.int32, device=device)
        self.particles = Particles(
            scenes.repeat_interleave(torch.tensor(elements)).to(device), tuple(sum(elements[:s]) for s in range(len(meshes) + 1))
        )
        first = solver.particles.offsets[a]
        start = [solver.particles.offsets[a + s] - first for s in range(len(meshes))]
        self.element_of = torch.cat([p.element_of + sum(elements[:s]) for s, p in enumerate(meshes)])
        self.corners = index[self.element_of]
        self.weights = torch.cat([p.weights for p in meshes])
        self.to_nodes = tuple(torch.cat([p.to_nodes[i] + (start[s] if i == 0 else 0) for s, p in enumerate(meshes)]) for i in (0, 1))
        self.to_elements = tuple(torch.cat([p.to_elements[i] + (start[s] if i == 0 else 0) for s, p in enumerate(meshes)]) for i in (0, 1))
        order = torch.argsort(index.reshape(-1), stable=True)
        self.corner = order.to(torch.int32).contiguous()
        counts = torch.bincount(index.reshape(-1), minlength=len(self.nodes))
        self.first = torch.cat([counts.new_zeros(1), counts.cumsum(0)]).to(torch.int32).contiguous()
        own = slice(first, solver.particles.offsets[b])
        self.x0 = solver.state.x[own]
        self.last: tuple[ParticleState, Tensor, Tensor, Tensor, Tensor] | None = None
        self.held = self._held(solver.held[own]).to(torch.uint8)
        self.particle_volume = solver.volume[own]
        self.scene_of_particle = solver.particles.scene[own].long() - a

    def _held(self, particles: Tensor) -> Tensor:
        """Return which nodes are held by clamps, (N,) bool.

        These are the nodes in the box of a clamp. If the box contains particles but no node, they are the nodes of the elements of
        those particles.
        """
        held = torch.zeros(len(self.nodes), dtype=torch.bool, device=self.nodes.device)
        for s, scene in enumerate(self.solver.scenes[self.a : self.b]):
            own = self.node_scene == s
            for box in scene.clamps:
                lower, upper = (corner.to(self.nodes) for corner in box_corners(box, NEAR * scene.dx))
                inside = own & ((self.nodes >= lower) & (self.nodes <= upper)).all(dim=1)
                if not bool(inside.any()):
                    picked = particles & ((self.x0 >= lower) & (self.x0 <= upper)).all(dim=1)
                    inside = torch.zeros_like(held)
                    inside[self.corners[picked].reshape(-1)] = True
                    inside &= own
                held |= inside
        return held

    def rows(self, tables: Tables) -> Tables:
        """Return the rows of the tables that belong to the scenes of this assembly."""

        def part(t: Tensor | None) -> Tensor | None:
            return None if t is None else t[self.a : self.b].contiguous()

        return tables._replace(
            material=part(tables.material),
            branches=part(tables.branches),
            flow=part(tables.flow),
            kinds=tables.kinds[self.a : self.b],
        )

    def node_mass(self, mass: Tensor) -> Tensor:
        """Compute the lumped masses of the nodes [kg], (N,), from the masses of the particles [kg], (P,).

        An element has the mean density of the particles around it. The excess of attached masses (`DENSE`) goes to the corners of the
        elements that contain them.
        """
        out = torch.zeros(len(self.nodes), dtype=torch.float64, device=mass.device)
        mass, volume = mass.double(), self.particle_volume.double()
        density, scene = mass / volume, self.scene_of_particle
        scenes = range(self.b - self.a)
        body = torch.minimum(density, DENSE * torch.stack([density[scene == s].median() for s in scenes])[scene])
        index, weight = self.to_elements
        share = self.volume.double() * (weight.double() * body[index]).sum(dim=1)
        of_elements = self.particles.scene.long()
        wanted, made = (torch.zeros(len(scenes), dtype=torch.float64, device=mass.device) for _ in range(2))
        share = share * (wanted.index_add_(0, scene, body * volume) / made.index_add_(0, of_elements, share))[of_elements]
        out.index_add_(0, self.elements.long().reshape(-1), 0.25 * share.repeat_interleave(4))
        inside = self.weights.double().clamp(min=0.0)
        inside = inside / inside.sum(dim=1, keepdim=True)
        out.index_add_(0, self.corners.reshape(-1), ((mass - body * volume)[:, None] * inside).reshape(-1))
        return out.to(self.nodes)

    def start(self, state: ParticleState) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Convert a state of the particles to x and v of the nodes and C and F of the elements.

        Only the difference from a known state is interpolated. That is the end of the last rollout if the particles still have the
        positions of that end, so that a rollout can be continued without loss; else it is the body as loaded.
        """
        index, weight = self.to_nodes
        around, mean = self.to_elements

        def at_nodes(t: Tensor) -> Tensor:
            return torch.einsum("nk,nkc->nc", weight, t[index])

        def at_elements(t: Tensor) -> Tensor:
            return torch.einsum("ek,ekab->eab", mean, t[around])

        if self.last is not None:
            known, x, v, C, F = self.last
            if float((state.x - known.x).abs().max()) <= 1e-6 * float(state.x.amax(dim=0).sub(state.x.amin(dim=0)).max()):
                change = ParticleState(*(now - then for now, then in zip(state, known)))
                return x + at_nodes(change.x), v + at_nodes(change.v), C + at_elements(change.C), F + at_elements(change.F)
        return self.nodes + at_nodes(state.x - self.x0), at_nodes(state.v), at_elements(state.C), at_elements(state.F)

    @property
    def is_part(self) -> bool:
        """Whether the solver has more scenes than this assembly."""
        return self.b - self.a < self.solver.scene_count

    def frame(self, frames: ParticleState, n: int, x: Tensor, v: Tensor, C: Tensor, F: Tensor) -> None:
        """Write frame n at the particles, from x and v of the nodes and C and F of the elements."""
        for out, t in ((frames.x, x), (frames.v, v)):
            out[n] = torch.einsum("pk,pkc->pc", self.weights, t[self.corners])
        for out, t in ((frames.C, C), (frames.F, F)):
            out[n] = t[self.element_of]
