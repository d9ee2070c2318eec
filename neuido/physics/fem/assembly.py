"""What a finite-element rollout runs on: the meshes of some scenes in one set of arrays, and its frames.

Order of an inner step as in the material point method: stress of F, nodal forces, motion and contact of the nodes, F_tr = (I + dt C) F,
its plastic correction and the history.
"""

from collections.abc import Hashable, Sequence
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from neuido.physics.colliders.tables import NEAR, corners
from neuido.physics.effects.coefficients import Tables
from neuido.physics.fem import element_loop
from neuido.physics.fem.element_loop import Fields, Loop
from neuido.physics.fem.meshing import Mesh, follow, locate, steepest
from neuido.physics.laws.base import ElasticLaw, Law, PlasticLaw
from neuido.types import Particles, ParticleState

if TYPE_CHECKING:
    from neuido.physics.fem.finite_elements import FiniteElements


CAPACITY = 8
"""Captured loops that an assembly keeps; each holds its memory."""
DENSE = 3.0
"""Times the median density above which a particle's mass counts as attached to the body."""


class Piece(NamedTuple):
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


class Inputs(NamedTuple):
    """What a rollout of some scenes reads, their rows alone."""

    state: ParticleState
    mass: Tensor
    pull: Tensor
    """(1 or T, S, 3), T over the inner steps."""
    force: Tensor
    friction: Tensor
    viscosity: Tensor | None
    tables: Tables | None
    stiffness: Tensor | None
    growth: Tensor | None
    dt: Tensor
    """Inner step of each scene [s], (S,)."""


def piece_of(mesh: Mesh, x: Tensor, volume: Tensor, device: torch.device, dtype: torch.dtype) -> Piece:
    """The ties of a mesh to the particles x (P, 3) of the given volumes (P,)."""
    nodes, own = mesh.nodes, mesh.volume
    element_of, weights = locate(mesh, x)
    centroid = nodes[mesh.elements].mean(dim=1)
    to_nodes = follow(x, nodes)
    to_elements = follow(x, centroid, near=8, degree=0)

    def real(t: Tensor) -> Tensor:
        return t.to(device, dtype)

    return Piece(
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

    def __init__(self, solver: "FiniteElements", pieces: Sequence[Piece], a: int, b: int) -> None:
        self.solver, self.pieces, self.a, self.b = solver, tuple(pieces), a, b
        device = solver.device
        nodes = [len(p.nodes) for p in pieces]
        elements = [len(p.elements) for p in pieces]
        shift = [sum(nodes[:s]) for s in range(len(pieces))]
        self.nodes = torch.cat([p.nodes for p in pieces]).contiguous()
        index = torch.cat([p.elements + n for p, n in zip(pieces, shift)])
        self.elements = index.to(torch.int32).contiguous()
        self.volume = torch.cat([p.volume for p in pieces]).contiguous()
        scenes = torch.arange(len(pieces), dtype=torch.int32)
        self.node_scene = scenes.repeat_interleave(torch.tensor(nodes)).to(device)
        self.particles = Particles(
            scenes.repeat_interleave(torch.tensor(elements)).to(device), tuple(sum(elements[:s]) for s in range(len(pieces) + 1))
        )
        first = solver.particles.offsets[a]
        start = [solver.particles.offsets[a + s] - first for s in range(len(pieces))]
        self.element_of = torch.cat([p.element_of + sum(elements[:s]) for s, p in enumerate(pieces)])
        self.corners = index[self.element_of]
        self.weights = torch.cat([p.weights for p in pieces])
        self.to_nodes = tuple(torch.cat([p.to_nodes[i] + (start[s] if i == 0 else 0) for s, p in enumerate(pieces)]) for i in (0, 1))
        self.to_elements = tuple(torch.cat([p.to_elements[i] + (start[s] if i == 0 else 0) for s, p in enumerate(pieces)]) for i in (0, 1))
        order = torch.argsort(index.reshape(-1), stable=True)
        self.corner = order.to(torch.int32).contiguous()
        counts = torch.bincount(index.reshape(-1), minlength=len(self.nodes))
        self.first = torch.cat([counts.new_zeros(1), counts.cumsum(0)]).to(torch.int32).contiguous()
        own = slice(first, solver.particles.offsets[b])
        self.x0 = solver.state.x[own]
        self.loops: dict[Hashable, Loop] = {}
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
        """The rows of this assembly's scenes."""

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
        (so that a motion may be run in pieces), else from the body as loaded.
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

    def run(
        self,
        steps: int,
        every: int,
        inner: int,
        elasticity: ElasticLaw,
        plasticity: PlasticLaw | None,
        given: Inputs,
        frames: ParticleState,
    ) -> None:
        """Fill the frames; launches alone but for the frames."""
        count = every * inner
        if plasticity is not None and (plasticity.identity or (given.tables is not None and given.tables.flow is not None)):
            plasticity = None
        x, v, C, F = self.start(given.state)
        v = torch.where(self.held.bool()[:, None], 0.0, v)
        fields = self._fields(given, count)
        laws = [self._rows(law) for law in (elasticity, plasticity) if law is not None]
        loop = self._loop(elasticity, plasticity, given.tables, fields, laws, count)
        loop.begin((x, v, C, F), fields, laws)
        self._frame(frames, 0, *loop.state)
        for k in range(steps // every):
            own = slice(k * count, (k + 1) * count)
            loop.advance(given.pull[own] if len(given.pull) > 1 else None, None if given.growth is None else given.growth[own])
            self._frame(frames, k + 1, *loop.state)
        self.last = (ParticleState(*(t[-1].clone() for t in frames)), *(t.clone() for t in loop.state))

    def _rows(self, law: Law) -> list[Tensor]:
        """The tensors of a law, those of these scenes alone."""
        tensors = [t.detach().to(self.solver.device, self.solver.dtype) for t in law.tensors()]
        return [t if len(t) == 1 or not self._alone else t[self.a : self.b] for t in tensors]

    @property
    def _alone(self) -> bool:
        return self.b - self.a < self.solver.scene_count

    def _fields(self, given: Inputs, count: int) -> Fields:
        """What the first of the intervals reads."""
        stiffness = None
        if given.stiffness is not None:
            index, weight = self.to_elements
            stiffness = torch.einsum("ek,ek->e", weight, given.stiffness[index].log()).exp()
        tables = given.tables
        return Fields(
            self.node_mass(given.mass),
            given.force,
            given.friction,
            given.dt,
            given.pull[:count],
            None if given.growth is None else given.growth[:count],
            given.viscosity,
            stiffness,
            *((None,) * 3 if tables is None else (tables.material, tables.branches, tables.flow)),
        )

    def _loop(
        self,
        elasticity: ElasticLaw,
        plasticity: PlasticLaw | None,
        tables: Tables | None,
        fields: Fields,
        laws: Sequence[Sequence[Tensor]],
        count: int,
    ) -> Loop:
        """A loop for these launches; those that are captured are kept, the least recently used dropped first."""
        elastic: Law = elasticity.alone(self.a) if self._alone else elasticity
        plastic: Law | None = plasticity.alone(self.a) if self._alone and plasticity is not None else plasticity
        own = element_loop.key(elastic, plastic, tables, fields, laws, count) if self.solver.graphs else None
        loop = self.loops.pop(own, None) or Loop(self, elastic, plastic, tables, fields, laws, count, own is not None)
        if own is not None:
            while len(self.loops) >= CAPACITY:
                self.loops.pop(next(iter(self.loops)))
            self.loops[own] = loop
        return loop

    def _frame(self, frames: ParticleState, n: int, x: Tensor, v: Tensor, C: Tensor, F: Tensor) -> None:
        for out, t in ((frames.x, x), (frames.v, v)):
            out[n] = torch.einsum("pk,pkc->pc", self.weights, t[self.corners])
        for out, t in ((frames.C, C), (frames.F, F)):
            out[n] = t[self.element_of]
