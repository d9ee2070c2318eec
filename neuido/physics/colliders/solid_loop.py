"""The launches for the solids in one substep of a rollout, and their adjoints."""

from collections.abc import Sequence
from types import SimpleNamespace
from typing import NamedTuple

import torch
from torch import Tensor

from neuido.physics.colliders import rigid_motion, solid_contact
from neuido.physics.colliders.contact import CONTACTS, SEPARATE
from neuido.physics.colliders.solid_contact import STATE, TWIST
from neuido.physics.colliders.solid_tables import SolidInputs, SolidTable
from neuido.physics.colliders.tables import ColliderTable
from neuido.physics.runtime.device import launch, launch_adjoint, real_of

assert CONTACTS["sticky"] == 1  # as `rigid_motion.push` has it


class SolidTape(NamedTuple):
    """What a rollout of T substeps records of the solids, all float64."""

    state: Tensor
    """Position, quaternion, velocity and angular velocity before each substep and at the end, (T + 1, S, C, 13)."""
    impulse: Tensor
    """Impulse [N s] and angular impulse about the position [N m s] that the grid and attachments gave in each substep, (T, S, C, 6)."""
    pushed: Tensor
    """The same of planes on free bodies."""


def new_solid_tape(table: SolidTable, steps: int) -> SolidTape:
    """Allocate the record of a rollout."""
    count = table.kind.shape
    options = {"dtype": torch.float64, "device": table.kind.device}
    return SolidTape(torch.empty(steps + 1, *count, STATE, **options), *(torch.zeros(steps, *count, TWIST, **options) for _ in range(2)))


def kernel_inputs(given: SolidInputs) -> tuple[Tensor, ...]:
    """Return the tensors that the kernels read: state at t = 0, twist, mass with inertia, friction."""
    turn = given.pose[..., 3:]
    start = torch.cat([given.pose[..., :3], turn / turn.norm(dim=-1, keepdim=True), given.velocity], dim=-1)
    body = torch.cat([given.mass[..., None], given.inertia.flatten(-2)], dim=-1)
    return tuple(t.contiguous() for t in (start, given.twist, body, given.friction))


class SolidLoop:
    """The launches for the solids of a rollout.

    Args:
        table: The solids.
        planes: The planes, which free bodies meet.
        origin: First node of the grid of each scene [m], (S, 3).
        dx: Cell size of each scene [m], (S,).
        dt: Substep of each scene [s], (S,).
        inputs: The result of `kernel_inputs`.
        pull: Gravity [m/s^2], (T, S, 3) or (1, S, 3).
        friction: Friction of the planes [-], (S, K).
        tape: Record of the rollout; written, and read by the adjoints.
        presses: The kernels of `multibody.press_kernels`.
    """

    def __init__(
        self, table: SolidTable, planes: ColliderTable, origin: Tensor, dx: Tensor, dt: Tensor,
        inputs: Sequence[Tensor], pull: Tensor, friction: Tensor, tape: SolidTape, presses: SimpleNamespace,
    ) -> None:  # fmt: skip
        self.table, self.planes, self.tape = table, planes, tape
        self.origin, self.dx, self.dt, self.pull, self.plane_friction = origin, dx, dt, pull, friction
        self.start, self.twist, self.body, self.friction = inputs
        real = real_of(dx.dtype)
        self.contact, self.motion = solid_contact.build(real), rigid_motion.build(real)
        self.device, self.count = dx.device, table.kind.numel()
        self.presses = presses if bool((table.kind == SEPARATE).any()) else None
        self.pressed, self.a_pressed = (dx.new_empty(0, table.kind.shape[1], 3) for _ in range(2))
        self.colliding = self.count * table.points.shape[2] * table.kind.shape[1] * (table.kind.shape[1] > 1)
        self.exact = table.size.double(), table.info, table.samples.double()
        self.touching = self.count * table.points.shape[2] * planes.kind.shape[1]

    def begin(self) -> None:
        """Reset the record to the start of the rollout."""
        self.tape.state[0] = self.start
        self.tape.impulse.zero_()
        self.tape.pushed.zero_()

    def _contact_inputs(self, n: int, index: Tensor) -> list:
        t = self.table
        return [n, self.origin, self.dx, index, self.tape.state, self.twist, self.body, self.friction,
                t.shape, t.kind, t.size, t.reach, t.info, t.samples, self.dt]  # fmt: skip

    def clear(self, nodes: int) -> None:
        """Zero the impulses of `press` on the nodes, of which there are so many."""
        if len(self.pressed) != nodes:
            self.pressed = self.dx.new_zeros(nodes, self.table.kind.shape[1], 3)
        elif self.presses is not None:
            self.pressed.zero_()

    def press(self, n: int, particles: list) -> None:
        """Add the impulses of the solids of the kind `separate` on the nodes in substep n.

        Args:
            n: Number of the substep.
            particles: Field, scene, origin, cell size and substep of each field, position [m], volume [m^3] and mass [kg] of the particles,
                and the nodes along each axis.
        """
        if self.presses is not None:
            launch(self.presses.press, len(particles[0]), [*self._press_inputs(n, particles), self.pressed], self.device)

    def _press_inputs(self, n: int, particles: list) -> list:
        t = self.table
        return [n, *particles, self.tape.state, t.shape, t.kind, t.size, t.reach, t.info, t.samples]

    def press_adjoint(self, n: int, particles: list, a_x: Tensor, a_mass: Tensor) -> None:
        """Compute the adjoint of `press`, after `meet_adjoint`; adds to the adjoints of positions and masses."""
        if self.presses is not None:
            arguments = [*self._press_inputs(n, particles), self.a_pressed, self.a_state, a_x, a_mass]
            launch(self.presses.press_adjoint, len(particles[0]), arguments, self.device)

    def meet(
        self, n: int, index: Tensor, grid: Tensor, velocity: Tensor, reach: slice = slice(None), impulse: Tensor | None = None
    ) -> None:
        """Bring the nodes in contact with the solids in substep n.

        Args:
            n: Number of the substep.
            index: Indices and scene of each node, (nodes, 4).
            grid: Momentum and mass, (nodes, 4).
            velocity: Velocity, (nodes, 4); changed in place.
            reach: Which of all nodes these are.
            impulse: Receives what the nodes lose; by default the record.
        """
        impulse = self.tape.impulse if impulse is None else impulse
        launch(self.contact.meet, len(grid), [*self._contact_inputs(n, index), self.pressed[reach], grid, velocity, impulse], self.device)

    def _push_inputs(self, n: int) -> list:
        t = self.table
        return [n, self.dt, self.tape.state, self.body, t.points, t.sharing, t.damping, self.planes.plane, self.planes.kind,
                self.plane_friction, self.tape.pushed]  # fmt: skip

    def _collide_inputs(self, n: int) -> list:
        t = self.table
        return [n, self.dt, self.tape.state, self.twist, self.body, t.points, t.sharing, t.damping, self.friction, t.shape, *self.exact,
                self.tape.pushed]  # fmt: skip

    def _advance_inputs(self, n: int) -> list:
        tape = self.tape
        return [n, self.dt, self.pull, self.twist, self.body, tape.impulse, tape.pushed, tape.state, tape.state]

    def advance(self, n: int) -> None:
        """Move the solids by substep n, after the contact."""
        if self.table.free:
            launch(self.motion.push, self.touching, self._push_inputs(n), self.device)
            if self.colliding:
                launch(self.motion.collide, self.colliding, self._collide_inputs(n), self.device)
        launch(self.motion.advance, self.count, self._advance_inputs(n), self.device)

    def start_adjoint(
        self, every: int, gradients: Sequence[Tensor | None], a_inputs: Sequence[Tensor], a_pull: Tensor, a_friction: Tensor
    ) -> None:
        """Begin a backward pass.

        Args:
            every: Substeps between frames.
            gradients: Gradients of the frames of the states, (K, S, C, 13), and of the impulses of all substeps; None: zero.
            a_inputs: Adjoints of the inputs; added to.
            a_pull: Adjoint of gravity; added to.
            a_friction: Adjoint of the friction of planes; added to.
        """
        self.a_start, self.a_twist, self.a_body, self.a_own_friction = a_inputs
        self.a_pull, self.a_plane_friction = a_pull, a_friction
        self.a_state, self.a_impulse, self.a_pushed = (torch.zeros_like(t) for t in self.tape)
        self.spare = torch.zeros_like(self.tape.impulse)
        of_state, of_impulse = gradients
        if of_state is not None:
            self.a_state[::every] += of_state
        if of_impulse is not None:
            self.a_impulse += of_impulse

    def advance_adjoint(self, n: int) -> None:
        """Compute the adjoint of `advance`."""
        adjoints = [None, None, self.a_pull, self.a_twist, self.a_body, self.a_impulse, self.a_pushed, self.a_state, self.a_state]
        launch_adjoint(self.motion.advance, self.count, self._advance_inputs(n), adjoints, self.device)
        if self.table.free:
            if self.colliding:
                adjoints = [None, None, self.a_state, self.a_twist, self.a_body, None, None, None, self.a_own_friction]
                adjoints += [None, None, None, None, self.a_pushed]
                launch_adjoint(self.motion.collide, self.colliding, self._collide_inputs(n), adjoints, self.device)
            adjoints = [None, None, self.a_state, self.a_body, None, None, None, None, None, self.a_plane_friction, self.a_pushed]
            launch_adjoint(self.motion.push, self.touching, self._push_inputs(n), adjoints, self.device)

    def meet_adjoint(self, n: int, index: Tensor, grid: Tensor, free: Tensor, a_velocity: Tensor) -> None:
        """Compute the adjoint of `meet`.

        Args:
            n: Number of the substep.
            index: As for `meet`.
            grid: As for `meet`.
            free: Velocities before the contact, (nodes, 4).
            a_velocity: Adjoint of the velocities; turned into that before the contact, with the adjoint of the node's mass last.
        """
        if self.a_pressed.shape != self.pressed.shape:
            self.a_pressed = torch.empty_like(self.pressed)
        arguments = [
            *self._contact_inputs(n, index),
            self.pressed,
            grid,
            free,
            a_velocity,
            self.a_impulse,
            self.a_state,
            self.a_twist,
            self.a_own_friction,
            self.a_pressed,
        ]
        launch(self.contact.meet_adjoint, len(grid), arguments, self.device)

    def end_adjoint(self) -> None:
        """Add the adjoint of the state at t = 0."""
        self.a_start += self.a_state[0]
