"""The plan of one rollout: laws, number of steps and effects, for a given `Setup` of scenes and bodies."""

import copy
from collections.abc import Sequence
from typing import NamedTuple

import torch
import warp as wp
from torch import Tensor

from neuido.physics.colliders.attachments import AttachmentLoop
from neuido.physics.colliders.solid_loop import SolidLoop, SolidTape
from neuido.physics.effects import stress_kernels
from neuido.physics.effects.coefficients import Layout, Tables
from neuido.physics.effects.spin_decay import SpinDecay
from neuido.physics.laws.base import Engine, Law
from neuido.physics.mpm.kernels import stencil
from neuido.physics.mpm.state import Setup
from neuido.physics.multibody import press_kernels
from neuido.physics.runtime.device import launch, real_of
from neuido.physics.runtime.events import MarkRecorder

STATES = 5
"""Number of inputs that form the initial state: x, v, C, F and the history (no columns if no effect has a history)."""
KINDS = ("particle",) * 6 + ("time",) + ("scene",) * 3 + ("particle", "time") + ("scene",) * 3 + ("time", "scene", "scene")
KINDS += ("scene", "time", "scene", "scene", "scene")
"""The leading axis of each input before the tensors of the laws: the initial state (5), mass, acceleration, force, friction,
viscosity, the tables of material effects (stiffness, growth, material, branches, flow), those of swelling and of spin decay, the friction
between bodies, those of solids (`solid_loop.kernel_inputs`), and the rates of attachments. `time` is (T, S, ...), or (1, S, ...) if
constant. An absent input has no elements."""
FIXED = len(KINDS)
MATERIAL, SHRINKAGE, SPIN_LOSS, BODY_FRICTION, SOLIDS, ATTACHED = (STATES + i for i in (5, 10, 11, 12, 13, 17))
"""Index of the first table of the material effects, of `Effects.shrinkage`, of `Effects.spin_loss`, of the friction between bodies, of the
first input of solids and of the rates of attachments."""

LARGE = 1 << 17
"""Number of particles from which a GPU uses blocks of 256 threads, else of 32: small bodies need more blocks to fill the GPU."""


class Material(NamedTuple):
    """The tables of material effects in one substep; None where an effect is absent."""

    stiffness: Tensor | None
    growth: Tensor | None
    material: Tensor | None
    branches: Tensor | None
    flow: Tensor | None
    all_branches: bool = True
    """Whether Maxwell branches of zero weight are advanced too; a backward pass needs them for the gradient of the weight."""


class Plan:
    """Everything that defines a rollout except its differentiable inputs.

    Args:
        setup: Scenes and bodies.
        elasticity: Elastic law.
        plasticity: Plastic law or None.
        steps: Substeps.
        every: Substeps between frames.
        tables: Tables of the material effects, if any; they decide which kernels are launched.
        nan_on_failure: Set the frames of a failed scene to NaN instead of raising.
        recorder: Collects the marks of the rollout, with the particles in the order of the kernels; by default a new one.
        compensated: Carry what the rounding of x and F leaves out from substep to substep (Kahan 1965).

    Attributes:
        offset: Substeps of the whole rollout before those of this plan.
        total: Substeps of the whole rollout.
    """

    def __init__(
        self,
        setup: Setup,
        elasticity: Law,
        plasticity: Law | None,
        steps: int,
        every: int,
        tables: Tables | None = None,
        nan_on_failure: bool = False,
        recorder: MarkRecorder | None = None,
        compensated: bool = False,
    ) -> None:
        self.compensated = compensated
        self.recorder = MarkRecorder(len(setup.mass), setup.mass) if recorder is None else recorder
        self.offset, self.total = 0, steps
        self.setup, self.elasticity, self.steps, self.every = setup, elasticity, steps, every
        self.nan_on_failure = nan_on_failure
        self.layout = Layout() if tables is None else tables.layout
        self.spectral = tables is not None and tables.spectral
        self.flow_kinds = () if tables is None else tables.kinds
        self.tables = tables
        if plasticity is None or plasticity.identity or self.flow_kinds:
            plasticity = None
        self.plasticity = plasticity
        self.kinds = torch.tensor(self.flow_kinds, dtype=torch.int32, device=setup.device)
        self.effects = None if tables is None else stress_kernels.build(real_of(setup.dtype))
        self.block = 32 if len(setup.mass) < LARGE else 256

    def law_tensors(self) -> tuple[Tensor, ...]:
        """Return the tensors of both laws, the elastic law's first."""
        elastic = self.elasticity.tensors()
        self.split = FIXED + len(elastic)
        return (*elastic, *(() if self.plasticity is None else self.plasticity.tensors()))

    def key(self, inputs: Sequence[Tensor]) -> tuple | None:
        """Return what the laws and effects add to the cache key of the launches; None if they must not be captured."""
        elastic = self.elasticity.key(inputs[FIXED : self.split])
        plastic = "none" if self.plasticity is None else self.plasticity.key(inputs[self.split :])
        return None if elastic is None or plastic is None else (self.layout, self.spectral, self.flow_kinds, elastic, plastic)

    def shortened(self, steps: int) -> "Plan":
        """Return a copy of the plan with another number of substeps."""
        plan = copy.copy(self)
        plan.steps = steps
        return plan

    def engines(self, inputs: Sequence[Tensor]) -> tuple[Engine, Engine | None]:
        """Create the engines of the elastic and the plastic law."""
        particles = self.setup.particles
        plastic = None if self.plasticity is None else self.plasticity.engine(inputs[self.split :], particles)
        return self.elasticity.engine(inputs[FIXED : self.split], particles), plastic

    def single_scene(self, s: int) -> "Plan":
        """Return the plan of one scene."""
        plastic = None if self.plasticity is None else self.plasticity.single_scene(s)
        tables = None if self.tables is None else self.tables._replace(kinds=self.flow_kinds[s : s + 1])
        elastic = self.elasticity.single_scene(s)
        whole = self.nan_on_failure, self.recorder, self.compensated
        plan = Plan(self.setup.single_scene(s), elastic, plastic, self.steps, self.every, tables, *whole)
        plan.split = self.split
        return plan

    def launch(self, kernel: wp.Kernel, dim: int, inputs: list, block: int = 256) -> None:
        """Launch a kernel on the device of the simulator."""
        launch(kernel, dim, inputs, self.setup.device, block=block)

    @property
    def corrects(self) -> bool:
        """Whether the trial gradient is corrected, by a law or by an effect."""
        return self.plasticity is not None or bool(self.flow_kinds)

    def material(self, inputs: Sequence[Tensor], n: int, *, all_branches: bool = True) -> Material | None:
        """Return the tables of material effects in substep n; None without such effects."""
        if self.tables is None:
            return None
        stiffness, growth, *tables = inputs[MATERIAL:SHRINKAGE]
        given = (stiffness, at_step(growth, n), *tables)
        stiffness, growth, material, branches, flow = (t if t.numel() else None for t in given)
        return Material(stiffness, growth, material, branches, flow, all_branches)

    def pressed(self, x: Tensor, mass: Tensor) -> list:
        """Return the particles as `SolidLoop.press` takes them, at x [m] with their masses [kg]."""
        own = self.setup
        fields = [own.field, own.particles.scene, own.field_origin, own.field_dx, own.field_dt]
        return [*fields, x, own.sorted_volume, mass, own.room.size]

    def spin_decay(self, inputs: Sequence[Tensor]) -> SpinDecay | None:
        """Return the launches of the torque of `Effects.spin_decay`; None without it."""
        setup = self.setup
        if not inputs[SPIN_LOSS].numel():
            return None
        return SpinDecay(setup.particles.scene, setup.first, 0.25 * setup.dx**2, inside=True)


def solid_loop(plan: Plan, inputs: Sequence[Tensor], tape: SolidTape | None) -> SolidLoop | None:
    """Return the launches of the solids of a rollout; None without solids."""
    setup = plan.setup
    if tape is None or setup.solids is None:
        return None
    presses = press_kernels.build(real_of(setup.dtype), stencil.functions)
    own = inputs[SOLIDS:ATTACHED], inputs[STATES + 1], inputs[STATES + 3]
    return SolidLoop(setup.solids, setup.colliders, setup.origin, setup.dx, setup.dt, *own, tape, presses)


def attachment_loop(plan: Plan, inputs: Sequence[Tensor], solids: SolidLoop | None) -> AttachmentLoop | None:
    """Return the launches of the attachments of a rollout; None without any."""
    setup = plan.setup
    if setup.attached is None:
        return None
    return AttachmentLoop(setup.attached, setup.particles.scene, setup.dt, inputs[ATTACHED], inputs[STATES], solids)


def at_step(t: Tensor, n: int) -> Tensor:
    """Return the row for substep n of an input with a leading time axis."""
    return t[n if len(t) > 1 else 0] if t.numel() else t
