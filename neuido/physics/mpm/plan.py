"""What one rollout does: its laws, its steps and its effects, over a fixed set-up of scenes and bodies."""

import copy
from collections.abc import Sequence
from typing import NamedTuple

import torch
import warp as wp
from torch import Tensor

from neuido.physics.effects import stress_kernels as effect_kernels
from neuido.physics.effects.coefficients import Layout, Tables
from neuido.physics.laws.base import ElasticLaw, Engine, PlasticLaw
from neuido.physics.mpm.state import Setup
from neuido.physics.runtime.device import launch, real_of

STATES = 5
"""Inputs that are the start: x, v, C, F and the history (no columns where no effect remembers)."""
KINDS = ("particle",) * 6 + ("time",) + ("scene",) * 3 + ("particle", "time") + ("scene",) * 3
"""What an input before the tensors of the laws has a row for: the start, mass, pull, force, friction, viscosity, and of the effects
on the material stiffness, growth, material, branches, flow. Those over time are (T, S, ...), or (1, S, ...) where constant; an absent
one has no elements."""
FIXED = len(KINDS)

LARGE = 1 << 17
"""Particles above which blocks of 256 threads do as well as blocks of 32 on a GPU; smaller bodies need more blocks to fill it."""


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
        setup: Scenes and bodies.
        elasticity: Elastic law.
        plasticity: Plastic law or None.
        steps: Substeps.
        every: Substeps between frames.
        tables: What the effects of the material need; of it the plan keeps what decides its launches.
        lenient: Frames of a scene that fails are NaN, in place of an error.
    """

    def __init__(
        self,
        setup: Setup,
        elasticity: ElasticLaw,
        plasticity: PlasticLaw | None,
        steps: int,
        every: int,
        tables: Tables | None = None,
        lenient: bool = False,
    ) -> None:
        self.setup, self.elasticity, self.steps, self.every, self.lenient = setup, elasticity, steps, every, lenient
        self.layout = Layout() if tables is None else tables.layout
        self.spectral = tables is not None and tables.spectral
        self.flow_kinds = () if tables is None else tables.kinds
        self.tables = tables
        if plasticity is None or plasticity.identity or self.flow_kinds:
            plasticity = None
        self.plasticity = plasticity
        self.kinds = torch.tensor(self.flow_kinds, dtype=torch.int32, device=setup.device)
        self.effects = None if tables is None else effect_kernels.build(real_of(setup.dtype))
        self.block = 32 if len(setup.mass) < LARGE else 256

    def law_tensors(self) -> tuple[Tensor, ...]:
        """Those of both laws, the elastic ones first."""
        elastic = self.elasticity.tensors()
        self.split = FIXED + len(elastic)
        return (*elastic, *(() if self.plasticity is None else self.plasticity.tensors()))

    def key(self, inputs: Sequence[Tensor]) -> tuple | None:
        """Return what, beside the shapes of the inputs, decides the launches; None where they may not be captured."""
        elastic = self.elasticity.key(inputs[FIXED : self.split])
        plastic = "none" if self.plasticity is None else self.plasticity.key(inputs[self.split :])
        own = (self.steps, self.every, self.layout, self.spectral, self.flow_kinds)
        return None if elastic is None or plastic is None else (*own, elastic, plastic)

    def shortened(self, steps: int) -> "Plan":
        """Return the same plan for fewer substeps."""
        plan = copy.copy(self)
        plan.steps = steps
        return plan

    def engines(self, inputs: Sequence[Tensor]) -> tuple[Engine, Engine | None]:
        particles = self.setup.particles
        plastic = None if self.plasticity is None else self.plasticity.engine(inputs[self.split :], particles)
        return self.elasticity.engine(inputs[FIXED : self.split], particles), plastic

    def single_scene(self, s: int) -> "Plan":
        """Return the plan of one scene."""
        plastic = None if self.plasticity is None else self.plasticity.single_scene(s)
        tables = None if self.tables is None else self.tables._replace(kinds=self.flow_kinds[s : s + 1])
        plan = Plan(self.setup.single_scene(s), self.elasticity.single_scene(s), plastic, self.steps, self.every, tables, self.lenient)
        plan.split = self.split
        return plan

    def launch(self, kernel: wp.Kernel, dim: int, inputs: list, block: int = 256) -> None:
        launch(kernel, dim, inputs, self.setup.device, block=block)

    @property
    def corrects(self) -> bool:
        """Whether the trial gradient is corrected, by a law or by an effect."""
        return self.plasticity is not None or bool(self.flow_kinds)

    def material(self, inputs: Sequence[Tensor], n: int, *, idle: bool = True) -> Material | None:
        """Return what the kernels of the effects read in substep n."""
        if self.tables is None:
            return None
        stiffness, growth, *tables = inputs[STATES + 5 : FIXED]
        return Material(*(t if t.numel() else None for t in (stiffness, at_step(growth, n), *tables)), idle)


def at_step(t: Tensor, n: int) -> Tensor:
    """Return the row of an input over time that substep n reads."""
    return t[n if len(t) > 1 else 0] if t.numel() else t
