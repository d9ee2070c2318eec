"""What a finite-element rollout runs on: the meshes of some scenes in one set of arrays, and its frames.

Order of an inner step as in the material point method: stress of F, nodal forces, motion and contact of the nodes, F_tr = (I + dt C) F,
its plastic correction and the history.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from types import SimpleNamespace
from typing import NamedTuple

import torch
from torch import Tensor

from neuido.physics.colliders.tables import NEAR, ColliderTable, corners
from neuido.physics.effects.coefficients import Tables
from neuido.physics.fem.meshing import Mesh, follow, locate, steepest
from neuido.types import Particles, ParticleState, Scene

DENSE = 3.0
"""Times the median density above which a particle's mass counts as attached to the body."""


@dataclass(frozen=True)
class SolverArrays:
    """What all assemblies of a solver share: scenes, particles and how the elements are computed."""

    scenes: tuple[Scene, ...]
    device: torch.device
    dtype: torch.dtype
    kernels: SimpleNamespace
    """Of `element_kernels.build`."""
    smoothing: str
    """`none` or `nodal`."""
    colliders: ColliderTable
    particles: Particles
    state: ParticleState
    """The start of the particles."""
    volume: Tensor
    """Of the particles [m^3], (P,)."""
    held: Tensor
    """Particles in a clamp, (P,) bool."""

    @property
    def scene_count(self) -> int:
        """The number of scenes S."""
        return len(self.scenes)


class BodyMesh(NamedTuple):
    """The mesh of one body with its ties to the particles; tensors of the solver's type and device."""

    nodes: Tensor
    """Positions at t = 0 [m], (N, 3)."""
    elements: Tensor
    """(E, 4) int64."""
    volume: Tensor
    """(E,) [m^3]."""
    element_of: Tensor
    """Element of each particle, (P,)."""
    weights: Tensor
    """Barycentric weights of each particle in it, (P, 4)."""
    to_nodes: tuple[Tensor, Tensor]
    """Particles and weights (N, k) that take an affine field to the nodes exactly."""
    to_elements: tuple[Tensor, Tensor]
    """Particles and positive weights (E, k) for means over the particles around an element."""
    steepest: Tensor
    """Of each element, `meshing.steepest` [1/m^2], (E,) float64."""


def body_mesh(mesh: Mesh, x: Tensor, volume: Tensor, device: torch.device, dtype: torch.dtype) -> BodyMesh:
    """Return the ties of a mesh to the particles x (P, 3) of the given volumes (P,)."""
    nodes, own = mesh.nodes, mesh.volume
    element_of, weights = locate(mesh, x)
    centroid = nodes[mesh.elements].mean(dim=1)
    to_nodes = follow(x, nodes)
    to_elements = follow(x, centroid, near=8, degree=0)

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
        steepest(mesh).to(device),
    )


class Assembly:
    """Scenes a to b - 1 of a solver in one set of arrays."""

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
        """Nodes in a clamp's box; where it holds particles and no node, those of the particles' elements."""
        held = torch.zeros(len(self.nodes), dtype=torch.bool, device=self.nodes.device)
        for s, scene in enumerate(self.solver.scenes[self.a : self.b]):
            own = self.node_scene == s
            for box in scene.clamps:
                lower, upper = (corner.to(self.nodes) for corner in corners(box, NEAR * scene.dx))
                inside = own & ((self.nodes >= lower) & (self.nodes <= upper)).all(dim=1)
                if not bool(inside.any()):
                    picked = particles & ((self.x0 >= lower) & (self.x0 <= upper)).all(dim=1)
                    inside = torch.zeros_like(held)
                    inside[self.corners[picked].reshape(-1)] = True
                    inside &= own
                held |= inside
        return held

    def rows(self, tables: Tables) -> Tables:
        """Return the rows of this assembly's scenes."""

        def part(t: Tensor | None) -> Tensor | None:
            return None if t is None else t[self.a : self.b].contiguous()

        return tables._replace(
            material=part(tables.material),
            branches=part(tables.branches),
            flow=part(tables.flow),
            kinds=tables.kinds[self.a : self.b],
        )

    def node_mass(self, mass: Tensor) -> Tensor:
        """Lumped masses: the density of the particles around an element, and what attached masses have beyond it at their corners."""
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
        """Positions and velocities of the nodes, C and F of the elements, for a state of the particles.

        Only the difference from a known start is interpolated: from the end of the last rollout where the particles are still there
        (so that a motion may be run in meshes), else from the body as loaded.
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
        """Whether the solver has scenes beside these."""
        return self.b - self.a < self.solver.scene_count

    def frame(self, frames: ParticleState, n: int, x: Tensor, v: Tensor, C: Tensor, F: Tensor) -> None:
        for out, t in ((frames.x, x), (frames.v, v)):
            out[n] = torch.einsum("pk,pkc->pc", self.weights, t[self.corners])
        for out, t in ((frames.C, C), (frames.F, F)):
            out[n] = t[self.element_of]
