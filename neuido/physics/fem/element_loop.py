"""The inner steps of a finite-element rollout between two frames, as kernel launches that run eagerly or as a CUDA graph.

A graph spans the interval between two frames and not the whole rollout. It takes the time of one interval to capture, and serves rollouts
of any length. Inputs that change over time (accelerations, growth, size) are copied into the loop's memory before each interval.
"""

import math
from collections.abc import Hashable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from neuido.physics.effects import stress_kernels, swelling_kernels
from neuido.physics.effects.coefficients import Layout, Tables
from neuido.physics.effects.spin_decay import SpinDecay
from neuido.physics.fem.assembly import Assembly
from neuido.physics.laws.base import Engine, Law
from neuido.physics.mpm.graphs import capture
from neuido.physics.runtime.device import launch, real_of, torch_stream
from neuido.physics.runtime.launches import LaunchRecordings


class Fields(NamedTuple):
    """The arrays that the launches of an interval of T inner steps read; None where absent."""

    mass: Tensor
    """Mass of each node [kg], (N,)."""
    force: Tensor
    """`Effects.force_table`, (S, ...)."""
    friction: Tensor
    """Friction coefficients of the colliders [-], (S, K)."""
    dt: Tensor
    """Inner step of each scene [s], (S,)."""
    pull: Tensor
    """Gravity and other uniform accelerations [m/s^2], (1 or T, S, 3)."""
    growth: Tensor | None
    """`Effects.growth` [-], (T, S)."""
    size: Tensor | None
    """`Effects.stress_free_size` [-], (T, S)."""
    spin_loss: Tensor | None
    """`Effects.spin_loss` of an inner step [-], (S, 1)."""
    viscosity: Tensor | None
    """`Effects.viscosity` [Pa s], (S, 2)."""
    stiffness: Tensor | None
    """Factor of each element's elastic stress [-], (E,)."""
    material: Tensor | None
    """`Tables.material`."""
    branches: Tensor | None
    """`Tables.branches`."""
    flow: Tensor | None
    """`Tables.flow`."""


class Loop:
    """The inner steps between two frames, with memory of its own.

    Args:
        assembly: Meshes of the scenes.
        elasticity: Elastic law of these scenes.
        plasticity: Plastic law, or None.
        tables: Tables of the effects that act on the law, or None; they determine which kernels are launched.
        fields: The arrays that the launches read; copied.
        laws: Tensors of the elastic and of the plastic law; copied.
        count: Inner steps of an interval.
        captured: Whether to capture the second interval as a CUDA graph and replay it from then on. On the CPU the second interval is
            always recorded and repeated (`launches`).
    """

    def __init__(
        self,
        assembly: Assembly,
        elasticity: Law,
        plasticity: Law | None,
        tables: Tables | None,
        fields: Fields,
        laws: Sequence[Sequence[Tensor]],
        count: int,
        captured: bool,
    ) -> None:
        solver = assembly.solver
        self.assembly, self.elasticity, self.plasticity, self.count, self.captured = assembly, elasticity, plasticity, count, captured
        copies = {name: t.clone(memory_format=torch.contiguous_format) for name, t in zip(fields._fields, fields) if t is not None}
        self.fields = fields._replace(**copies)
        self.laws = [[t.clone(memory_format=torch.contiguous_format) for t in tensors] for tensors in laws]
        self.layout = Layout() if tables is None else tables.layout
        self.spectral = tables is not None and tables.spectral
        self.flows = fields.flow is not None
        self.changes = plasticity is not None or self.flows
        self.material = None if tables is None else stress_kernels.build(real_of(solver.dtype))
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
        self.swelling = None if fields.size is None else swelling_kernels.build(real_of(solver.dtype))
        self.spin = None
        if fields.spin_loss is not None:
            self.spin = SpinDecay(assembly.node_scene, assembly.first_node, torch.zeros_like(self.fields.dt), inside=False)
        self.rest = torch.empty_like(self.x) if solver.dtype == torch.float32 else None
        self.lowest = like.new_empty(elements)
        self.since = torch.empty(elements, dtype=torch.int32, device=like.device)
        self.graph: torch.cuda.CUDAGraph | None = None
        self.warm = False
        self.recordings = LaunchRecordings()

    @property
    def state(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """x and v of the nodes, C and F of the elements; the next interval overwrites them."""
        return self.x, self.v, self.C, self.F

    def begin(self, state: Sequence[Tensor], fields: Fields, laws: Sequence[Sequence[Tensor]]) -> None:
        """Start a rollout.

        Args:
            state: x and v of the nodes, C and F of the elements.
            fields: New values of the constructor's `fields`.
            laws: New values of the constructor's `laws`.
        """
        given = [*state, *fields, *(t for tensors in laws for t in tensors)]
        own = [*self.state, *self.fields, *(t for tensors in self.laws for t in tensors)]
        for t, value in zip(own, given, strict=True):
            if t is not None and value is not None:
                t.copy_(value)
        self.history.zero_()
        self.lowest.fill_(math.inf)
        if self.rest is not None:
            self.rest.zero_()
        assembly = self.assembly
        with torch_stream(assembly.solver.device):
            self._launch(assembly.solver.kernels.reference, len(self.F), assembly.elements, self.x, self.gradients)
        torch.matmul(self.gradients, self.F, out=self.shape)

    def advance(self, pull: Tensor | None = None, growth: Tensor | None = None, size: Tensor | None = None) -> None:
        """Run one interval; `since` counts from its start.

        Args:
            pull: Accelerations of this interval, (count, S, 3); None: as before.
            growth: Growth of this interval, (count, S); None: as before.
            size: Stress-free sizes of this interval, (count, S); None: as before.
        """
        self.since.fill_(-1)
        for own, value in ((self.fields.pull, pull), (self.fields.growth, growth), (self.fields.size, size)):
            if own is not None and value is not None:
                own.copy_(value)
        if not self.warm:  # the first interval compiles and loads the kernels
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
        if self.count % 2 and self.layout.width > 0:  # the next interval reads the same buffer as this one
            self.history.copy_(self.history_next)

    def run(self) -> None:
        """Launch the kernels of one interval.

        The two history buffers swap roles in each inner step; after an odd number of steps the result is in `history_next`.
        """
        begun = self.history, self.history_next
        with torch_stream(self.assembly.solver.device):
            elastic, plastic = self._engines()
            for n in range(self.count):
                growth = None if self.fields.growth is None else self.fields.growth[n]
                self._stress(elastic, growth)
                size = None if self.fields.size is None else self.fields.size[n]
                self._move(self.fields.pull[n if len(self.fields.pull) > 1 else 0], n, size)
                if plastic is not None:
                    plastic.forward(self.trial, self.F)
                if self.layout.width > 0 or self.flows:
                    self._update_history(growth)
                    self.history, self.history_next = self.history_next, self.history
                if self.changes:
                    arrays = self.trial, self.F, self.gradients, self.shape
                    self._launch(self.assembly.solver.kernels.reshape, len(self.F), self.assembly.particles.scene, size, *arrays)
        self.history, self.history_next = begun

    def _engines(self) -> tuple[Engine, Engine | None]:
        particles = self.assembly.particles
        elastic = self.elasticity.engine(self.laws[0], particles)
        return elastic, None if self.plasticity is None else self.plasticity.engine(self.laws[1], particles)

    def _stress(self, elastic: Engine, growth: Tensor | None) -> None:
        """Compute the stress of each element, tau, with effects, viscosity and smoothing."""
        k, a, f, scene = self.assembly.solver.kernels, self.assembly, self.fields, self.assembly.particles.scene
        elements, nodes = len(self.F), len(self.x)
        if self.nodal:
            self._launch(k.volume_change, elements, self.F, self.J)
            self._launch(k.node_mean, nodes, a.first, a.corner, a.volume, self.J, self.at_node)
            self._launch(k.smooth, elements, a.elements, self.at_node, self.F, self.J, self.J_mean, self.smoothed)
        elastic.forward(self.smoothed, self.tau)
        if self.material is not None:
            self._launch(self.material.add_effect_stress, elements, scene, f.stiffness, growth, f.material, f.branches, self.spectral,
                         self.layout.e_max_column, self.layout.compaction_column, False, self.smoothed, self.history,
                         self.tau)  # fmt: skip
        if f.viscosity is not None:
            self._launch(k.add_viscous_stress, elements, scene, f.viscosity, self.C, self.smoothed, self.tau)
        if self.nodal:
            self._launch(k.pressure, elements, self.tau, self.J_mean, self.pressure)
            self._launch(k.node_mean, nodes, a.first, a.corner, a.volume, self.pressure, self.at_node)
            self._launch(k.spread_pressure, elements, a.elements, self.at_node, self.J, self.tau)

    def _move(self, pull: Tensor, n: int, size: Tensor | None) -> None:
        """Move the nodes in inner step n, and compute the trial F of the elements (F itself if nothing corrects it).

        Args:
            pull: Accelerations [m/s^2], (S, 3).
            n: The inner step.
            size: Stress-free size at its end [-], (S,), by which swelling divides F, or None.
        """
        k, a, f = self.assembly.solver.kernels, self.assembly, self.fields
        rates = n == self.count - 1 or f.viscosity is not None or self.layout.width > 0
        self._launch(k.corner_forces, len(self.F), a.volume, self.gradients, self.tau, self.force)
        if self.spin is not None and f.spin_loss is not None:
            self.spin.damp(f.spin_loss, f.mass, self.x, self.v, None, self.v, None)
        self._launch(k.move, len(self.x), a.first, a.corner, a.node_scene, a.held, f.mass, f.dt, pull, f.force, self.plane, self.kind,
                     f.friction, self.force, self.x, self.v, self.rest)  # fmt: skip
        gradient = self.trial if self.changes else self.F
        self._launch(k.kinematics, len(self.F), a.elements, self.x, self.v, self.shape, rates, self.gradients, self.C, gradient, n,
                     a.volume, self.lowest, self.since)  # fmt: skip
        if self.swelling is not None:
            self._launch(self.swelling.elastic_part, len(self.F), a.particles.scene, size, gradient)

    def _update_history(self, growth: Tensor | None) -> None:
        """Advance the history by a step, and correct the trial F if a plastic effect is present."""
        f, scene, layout, k = self.fields, self.assembly.particles.scene, self.layout, self.material
        assert k is not None  # a history or a flow comes from an effect
        if f.branches is not None:
            self._launch(k.relax, len(self.F), scene, f.dt, f.branches, False, self.C, self.history, self.history_next)
        if self.flows:
            self._launch(k.flow, len(self.F), scene, f.dt, self.kinds, f.flow, f.stiffness, growth, layout.alpha_column,
                         layout.backstress_column, self.trial, self.C, self.history, self.F, self.history_next)  # fmt: skip
        if layout.e_max:
            self._launch(k.remember, len(self.F), self.F, layout.e_max_column, self.history, self.history_next)
        if layout.compaction:
            self._launch(k.compact, len(self.F), self.trial, self.F, layout.compaction_column, self.history, self.history_next)

    def _launch(self, kernel, dim: int, *arguments) -> None:
        launch(kernel, dim, arguments, self.assembly.solver.device)


def key(
    elasticity: Law, plasticity: Law | None, tables: Tables | None, fields: Fields, laws: Sequence[Sequence[Tensor]], count: int
) -> Hashable | None:
    """Return a key that is equal for loops with the same launches; None if the launches must not be captured."""
    elastic = elasticity.key(laws[0])
    plastic = "none" if plasticity is None else plasticity.key(laws[1])
    if elastic is None or plastic is None:
        return None
    material = None if tables is None else (tables.layout, tables.spectral, tables.kinds)
    shapes = tuple(None if t is None else tuple(t.shape) for t in (*fields, *(t for tensors in laws for t in tensors)))
    return (count, elastic, plastic, material, shapes)
