"""The rollout of one assembly of meshes, from the inputs of its scenes to frames at the particles."""

from collections.abc import Hashable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from neuido.physics.effects.coefficients import Tables
from neuido.physics.fem import element_loop
from neuido.physics.fem.assembly import Assembly
from neuido.physics.fem.element_loop import Fields, Loop
from neuido.physics.laws.base import ElasticLaw, Law, PlasticLaw
from neuido.physics.runtime.events import MarkRecorder
from neuido.types import ParticleState

CAPACITY = 8
"""Number of captured loops in the cache of an assembly; each owns its memory."""


class Inputs(NamedTuple):
    """The inputs of a rollout for the S scenes and P particles of one assembly."""

    state: ParticleState
    """Initial state of the particles."""
    mass: Tensor
    """Mass of each particle [kg], (P,)."""
    pull: Tensor
    """Gravity and other uniform accelerations [m/s^2], (1, S, 3), or (T, S, 3) over T inner steps."""
    force: Tensor
    """`Effects.force_table` of the scenes."""
    friction: Tensor
    """Friction coefficients of the colliders [-], (S, K)."""
    viscosity: Tensor | None
    """`Effects.viscosity` [Pa s], (S, 2)."""
    tables: Tables | None
    """Tables of the effects that act on the law."""
    stiffness: Tensor | None
    """Factor of each particle's elastic stress [-], (P,)."""
    growth: Tensor | None
    """`Effects.growth` over the inner steps [-], (T, S)."""
    size: Tensor | None
    """`Effects.stress_free_size` over the inner steps [-], (T, S)."""
    spin_loss: Tensor | None
    """`Effects.spin_loss` of an inner step [-], (S, 1)."""
    dt: Tensor
    """Inner step of each scene [s], (S,)."""


class AssemblyRollout:
    """Run rollouts of one assembly, with a cache of captured loops.

    Args:
        assembly: Meshes of some scenes.
        graphs: Whether to capture the launches between two frames as a CUDA graph; CUDA only.
    """

    def __init__(self, assembly: Assembly, graphs: bool) -> None:
        self.assembly, self.graphs = assembly, graphs
        self.loops: dict[Hashable, Loop] = {}

    def run(
        self,
        steps: int,
        every: int,
        inner: int,
        elasticity: ElasticLaw,
        plasticity: PlasticLaw | None,
        given: Inputs,
        frames: ParticleState,
    ) -> MarkRecorder:
        """Simulate and write the frames.

        Args:
            steps: Number of steps, a multiple of `every`.
            every: Steps between two frames.
            inner: Inner steps per step.
            elasticity: Elastic law.
            plasticity: Plastic law, or None.
            given: Inputs of the scenes.
            frames: Frames of the particles, steps / every + 1 of them; overwritten.

        Returns:
            The events of the elements, in inner steps.
        """
        count, assembly = every * inner, self.assembly
        if plasticity is not None and (plasticity.identity or (given.tables is not None and given.tables.flow is not None)):
            plasticity = None
        x, v, C, F = assembly.start(given.state)
        v = torch.where(assembly.held.bool()[:, None], 0.0, v)
        fields = self._fields(given, count)
        laws = [self._rows(law) for law in (elasticity, plasticity) if law is not None]
        loop = self._loop(elasticity, plasticity, given.tables, fields, laws, count)
        loop.begin((x, v, C, F), fields, laws)
        assembly.frame(frames, 0, *loop.state)
        recorder = MarkRecorder(len(F), F)
        for k in range(steps // every):
            own = slice(k * count, (k + 1) * count)
            growth, size = (None if t is None else t[own] for t in (given.growth, given.size))
            loop.advance(given.pull[own] if len(given.pull) > 1 else None, growth, size)
            assembly.frame(frames, k + 1, *loop.state)
            recorder.add(loop.lowest, loop.since, start=k * count)
        x, v, C, F = (t.clone() for t in loop.state)
        assembly.last = (ParticleState(*(t[-1].clone() for t in frames)), x, v, C, F)
        return recorder

    def _rows(self, law: Law) -> list[Tensor]:
        """Return the tensors of a law, restricted to the scenes of the assembly."""
        assembly = self.assembly
        tensors = [t.detach().to(assembly.solver.device, assembly.solver.dtype) for t in law.tensors()]
        return [t if len(t) == 1 or not assembly.is_part else t[assembly.a : assembly.b] for t in tensors]

    def _fields(self, given: Inputs, count: int) -> Fields:
        """Return the arrays that the launches of the first interval of `count` inner steps read."""
        stiffness = None
        if given.stiffness is not None:
            index, weight = self.assembly.to_elements
            stiffness = torch.einsum("ek,ek->e", weight, given.stiffness[index].log()).exp()
        tables = given.tables
        return Fields(
            self.assembly.node_mass(given.mass),
            given.force,
            given.friction,
            given.dt,
            given.pull[:count],
            None if given.growth is None else given.growth[:count],
            None if given.size is None else given.size[:count],
            given.spin_loss,
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
        """Return a loop for these launches, from the cache if it can be captured; the least recently used is dropped first."""
        assembly = self.assembly
        elastic: Law = elasticity.single_scene(assembly.a) if assembly.is_part else elasticity
        plastic: Law | None = plasticity.single_scene(assembly.a) if assembly.is_part and plasticity is not None else plasticity
        own = element_loop.key(elastic, plastic, tables, fields, laws, count) if self.graphs else None
        loop = self.loops.pop(own, None) or Loop(assembly, elastic, plastic, tables, fields, laws, count, own is not None)
        if own is not None:
            while len(self.loops) >= CAPACITY:
                self.loops.pop(next(iter(self.loops)))
            self.loops[own] = loop
        return loop
