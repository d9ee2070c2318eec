"""The inner steps of a finite-element rollout between two frames: launches alone, run eagerly or replayed from a CUDA graph.

A graph spans one interval between frames and not the whole rollout: it is captured in the time of one interval, and serves rollouts of any
length. What changes from one interval to the next (pulls and growth over time) is copied into the loop's memory before each.
"""

from collections.abc import Hashable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from neuido.physics.effects import stress_kernels as effect_kernels
from neuido.physics.effects.coefficients import Layout, Tables
from neuido.physics.fem.assembly import Assembly
from neuido.physics.laws.base import ElasticLaw, Engine, Law, PlasticLaw
from neuido.physics.mpm.graphs import capture
from neuido.physics.runtime.device import launch, real_of, torch_stream
from neuido.physics.runtime.launches import LaunchRecordings


class Fields(NamedTuple):
    """What the launches of an interval of T inner steps read; None where absent."""

    mass: Tensor
    """Of the nodes [kg], (N,)."""
    force: Tensor
    """`Effects.force_table`, (S, ...)."""
    friction: Tensor
    """(S, K)."""
    dt: Tensor
    """Inner step of each scene [s], (S,)."""
    pull: Tensor
    """[m/s^2], (1 or T, S, 3)."""
    growth: Tensor | None
    """(T, S)."""
    viscosity: Tensor | None
    """[Pa s], (S, 2)."""
    stiffness: Tensor | None
    """Factor of each element, (E,)."""
    material: Tensor | None
    branches: Tensor | None
    flow: Tensor | None
    """Columns of `effect_tables.Tables`."""


class Loop:
    """The inner steps of one interval, over memory of its own.

    Args:
        assembly: Meshes of the scenes.
        elasticity: Elastic law of these scenes.
        plasticity: Plastic law, or None.
        tables: What the effects of the material need; of it the loop keeps what decides its launches.
        fields: What the launches read; the loop owns copies.
        laws: Tensors of the elastic and of the plastic law; likewise.
        count: Inner steps of an interval.
        captured: Replay a CUDA graph from the third interval on. On the CPU the second one is recorded and repeated.
    """

    def __init__(
        self,
        assembly: Assembly,
        elasticity: ElasticLaw,
        plasticity: PlasticLaw | None,
        tables: Tables | None,
        fields: Fields,
        laws: Sequence[Sequence[Tensor]],
        count: int,
        captured: bool,
    ) -> None:
        solver = assembly.solver
        self.assembly, self.elasticity, self.plasticity, self.count, self.captured = assembly, elasticity, plasticity, count, captured
        self.fields = Fields(*(None if t is None else t.clone(memory_format=torch.contiguous_format) for t in fields))
        self.laws = [[t.clone(memory_format=torch.contiguous_format) for t in tensors] for tensors in laws]
        self.layout = Layout() if tables is None else tables.layout
        self.spectral = tables is not None and tables.spectral
        self.flows = fields.flow is not None
        self.changes = plasticity is not None or self.flows
        self.material = None if tables is None else effect_kernels.build(real_of(solver.dtype))
        self.kinds = torch.tensor(() if tables is None else tables.kinds, dtype=torch.int32, device=solver.device)
        self.plane, self.kind = (t[assembly.a : assembly.b].contiguous() for t in (solver.colliders.plane, solver.colliders.kind))
        elements, nodes = len(assembly.elements), len(assembly.nodes)
        like = assembly.nodes
        self.x, self.v = like.new_empty(nodes, 3), like.new_empty(nodes, 3)
        self.C, self.F, self.tau, self.trial, self.gradients, self.shape = (like.new_empty(elements, 3, 3) for _ in range(6))
        self.force = like.new_empty(4 * elements, 3)
        self.history, self.history_next = (like.new_zeros(elements, self.layout.width) for _ in range(2))
        self.nodal = solver.smoothing == "nodal"
        self.smoothed = torch.empty_like(self.F) if self.nodal else self.F
        self.J, self.J_mean, self.pressure = (like.new_empty(elements if self.nodal else 0) for _ in range(3))
        self.at_node = like.new_empty(nodes if self.nodal else 0)
        self.graph: torch.cuda.CUDAGraph | None = None
        self.warm = False
        self.recordings = LaunchRecordings()

    @property
    def state(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """x and v of the nodes, C and F of the elements, in memory that the next interval overwrites."""
        return self.x, self.v, self.C, self.F

    def begin(self, state: Sequence[Tensor], fields: Fields, laws: Sequence[Sequence[Tensor]]) -> None:
        """Start a rollout from x, v, C and F, with new values of what the loop was made for."""
        given = [*state, *fields, *(t for tensors in laws for t in tensors)]
        own = [*self.state, *self.fields, *(t for tensors in self.laws for t in tensors)]
        for t, value in zip(own, given, strict=True):
            if t is not None and value is not None:
                t.copy_(value)
        self.history.zero_()
        assembly = self.assembly
        with torch_stream(assembly.solver.device):
            self._launch(assembly.solver.kernels.reference, len(self.F), assembly.elements, self.x, self.gradients)
        torch.matmul(self.gradients, self.F, out=self.shape)

    def advance(self, pull: Tensor | None = None, growth: Tensor | None = None) -> None:
        """Run an interval, with its rows of what changes over time."""
        for own, value in ((self.fields.pull, pull), (self.fields.growth, growth)):
            if value is not None:
                own.copy_(value)
        if not self.warm:  # the first one compiles and loads the kernels
            self.run()
            self.warm = True
        elif self.assembly.solver.device.type == "cpu":
            self.recordings.run("interval", self.run)
        elif not self.captured:
            self.run()
        else:
            if self.graph is None:
                self.graph, _ = capture(self.run)
            self.graph.replay()
        if self.count % 2 and self.layout.width > 0:  # the next one begins where this one began
            self.history.copy_(self.history_next)

    def run(self) -> None:
        """Launch an interval; the last history is where an odd number of swaps leaves it."""
        begun = self.history, self.history_next
        with torch_stream(self.assembly.solver.device):
            elastic, plastic = self._engines()
            for n in range(self.count):
                growth = None if self.fields.growth is None else self.fields.growth[n]
                self._stress(elastic, growth)
                self._move(self.fields.pull[n if len(self.fields.pull) > 1 else 0], last=n == self.count - 1)
                if plastic is not None:
                    plastic.forward(self.trial, self.F)
                if self.layout.width > 0 or self.flows:
                    self._remember(growth)
                    self.history, self.history_next = self.history_next, self.history
                if self.changes:
                    self._launch(self.assembly.solver.kernels.reshape, len(self.F), self.trial, self.F, self.gradients, self.shape)
        self.history, self.history_next = begun

    def _engines(self) -> tuple[Engine, Engine | None]:
        particles = self.assembly.particles
        elastic = self.elasticity.engine(self.laws[0], particles)
        return elastic, None if self.plasticity is None else self.plasticity.engine(self.laws[1], particles)

    def _stress(self, elastic: Engine, growth: Tensor | None) -> None:
        """tau of F."""
        k, a, f, scene = self.assembly.solver.kernels, self.assembly, self.fields, self.assembly.particles.scene
        elements, nodes = len(self.F), len(self.x)
        if self.nodal:
            self._launch(k.volume_change, elements, self.F, self.J)
            self._launch(k.node_mean, nodes, a.first, a.corner, a.volume, self.J, self.at_node)
            self._launch(k.smooth, elements, a.elements, self.at_node, self.F, self.J, self.J_mean, self.smoothed)
        elastic.forward(self.smoothed, self.tau)
        if self.material is not None:
            self._launch(self.material.add_effect_stress, elements, scene, f.stiffness, growth, f.material, f.branches, self.spectral,
                         self.layout.at_e_max, False, self.smoothed, self.history, self.tau)  # fmt: skip
        if f.viscosity is not None:
            self._launch(k.add_viscous_stress, elements, scene, f.viscosity, self.C, self.smoothed, self.tau)
        if self.nodal:
            self._launch(k.pressure, elements, self.tau, self.J_mean, self.pressure)
            self._launch(k.node_mean, nodes, a.first, a.corner, a.volume, self.pressure, self.at_node)
            self._launch(k.spread_pressure, elements, a.elements, self.at_node, self.J, self.tau)

    def _move(self, pull: Tensor, *, last: bool) -> None:
        """Nodes by their forces, and the trial F of the elements (F itself where nothing corrects it)."""
        k, a, f = self.assembly.solver.kernels, self.assembly, self.fields
        rates = last or f.viscosity is not None or self.layout.width > 0
        self._launch(k.corner_forces, len(self.F), a.volume, self.gradients, self.tau, self.force)
        self._launch(k.move, len(self.x), a.first, a.corner, a.node_scene, a.held, f.mass, f.dt, pull, f.force, self.plane, self.kind,
                     f.friction, self.force, self.x, self.v)  # fmt: skip
        self._launch(k.kinematics, len(self.F), a.elements, self.x, self.v, self.shape, rates, self.gradients, self.C,
                     self.trial if self.changes else self.F)  # fmt: skip

    def _remember(self, growth: Tensor | None) -> None:
        """Write the history after a step, and F where an effect makes it of the trial one."""
        f, scene, layout, k = self.fields, self.assembly.particles.scene, self.layout, self.material
        if f.branches is not None:
            self._launch(k.relax, len(self.F), scene, f.dt, f.branches, False, self.C, self.history, self.history_next)
        if self.flows:
            self._launch(k.flow, len(self.F), scene, f.dt, self.kinds, f.flow, f.stiffness, growth, layout.at_alpha, layout.at_backstress,
                         self.trial, self.C, self.history, self.F, self.history_next)  # fmt: skip
        if layout.e_max:
            self._launch(k.remember, len(self.F), self.F, layout.at_e_max, self.history, self.history_next)

    def _launch(self, kernel, dim: int, *arguments) -> None:
        launch(kernel, dim, arguments, self.assembly.solver.device)


def key(
    elasticity: Law, plasticity: Law | None, tables: Tables | None, fields: Fields, laws: Sequence[Sequence[Tensor]], count: int
) -> Hashable | None:
    """Return what decides the launches of a loop; None where they may not be captured."""
    elastic = elasticity.key(laws[0])
    plastic = "none" if plasticity is None else plasticity.key(laws[1])
    if elastic is None or plastic is None:
        return None
    material = None if tables is None else (tables.layout, tables.spectral, tables.kinds)
    shapes = tuple(None if t is None else tuple(t.shape) for t in (*fields, *(t for tensors in laws for t in tensors)))
    return (count, elastic, plastic, material, shapes)
