"""Contact between bodies that have a velocity field each: one momentum exchange on the grid a substep.

The fields of a scene lie one after the other in the arrays of the grid. At a node that several bodies reach, each pair of bodies whose
surfaces overlap exchanges momentum: a stiff spring pushes along the common normal, and of the tangential part of their relative velocity
goes what Coulomb's law allows. The impulse on the one is minus that on the other, so momentum is kept to rounding. Surfaces overlap
where particles of the two do along the normal, not where their weights do: bodies would else be held about a cell apart. `contact_kernels`
and `reach_kernels` have the kernels and their adjoints.
"""

from collections.abc import Callable, Sequence
from itertools import accumulate
from types import SimpleNamespace

import torch
import warp as wp
from torch import Tensor

from neuido.errors import UserError

Launch = Callable[[wp.Kernel, int, list], None]


class ContactGrid:
    """Scratch memory and launches of the contact between bodies.

    Args:
        counts: Number of velocity fields of each scene.
        kernels: The kernels (`contact_kernels.build`).
        nodes: Grid nodes along each axis, padding included.
        chunk: Nodes that a thread handles.
        dx: Cell size of each scene [m], (S,).
        dt: Substep of each scene [s], (S,).
        friction: `friction_table` of the scenes.
        device: Device of the arrays.
        dtype: Scalar type of the arrays.

    Attributes:
        first: First field of each scene, then the number of fields, (S + 1,) int32.
        friction: As given.
    """

    def __init__(
        self,
        counts: Sequence[int],
        kernels: SimpleNamespace,
        nodes: wp.vec3i,
        chunk: int,
        dx: Tensor,
        dt: Tensor,
        friction: Tensor,
        device: torch.device,
        dtype: torch.dtype,
    ) -> None:
        self.kernels, self.dx, self.dt = kernels, dx, dt
        self.nodes, self.chunk = nodes, chunk
        self.size = nodes[0] * nodes[1] * nodes[2]
        self.first = torch.tensor([0, *accumulate(counts)], dtype=torch.int32, device=device)
        self.friction = friction.to(device, dtype)
        self.scenes, fields, self.bodies = len(counts), sum(counts), round(friction.shape[1] ** 0.5)
        self.shared = torch.zeros(self.scenes * self.size, dtype=torch.int32, device=device)
        self.gradient, self.a_gradient = (torch.zeros(fields * self.size, 3, dtype=dtype, device=device) for _ in range(2))
        self.reach = torch.zeros(fields * self.size, 4 * self.bodies, dtype=dtype, device=device)
        self.of_adjoint: tuple[Tensor, Tensor] | None = None

    def frictions(self, given: Tensor | float | None) -> Tensor:
        """Return the friction of each pair for a rollout, (S, B B).

        Args:
            given: As for `Simulator.rollout`.

        Raises:
            UserError: A shape that does not fit, or a negative number.
        """
        if given is None:
            return self.friction
        bodies = self.bodies
        value = torch.as_tensor(given).to(self.friction)
        if value.ndim == 0 or value.shape == (self.scenes,):
            value = value.reshape(-1, 1, 1).expand(self.scenes, bodies, bodies)
        if value.shape != (self.scenes, bodies, bodies):
            raise UserError(
                f"body_friction has shape {tuple(value.shape)}; give a number, {(self.scenes,)} or {(self.scenes, bodies, bodies)}"
            )
        if not bool((value.detach() >= 0).all()):
            raise UserError(f"body_friction is {float(value.detach().min()):g}; give zero or more")
        return (0.5 * (value + value.mT)).reshape(self.scenes, -1).contiguous()

    def exchange(self, launch: Launch, particles: list, grid: Tensor, friction: Tensor, out: Tensor) -> Tensor:
        """Let bodies in contact exchange momentum.

        Args:
            launch: Launches a kernel.
            particles: Field, scene, origin and cell size of each field, position [m] and volume [m^3] of the particles.
            grid: Momentum and mass of the nodes, (fields nodes, 4).
            friction: Coulomb's coefficients [-], (S, B B).
            out: Momentum and mass after the exchange; overwritten and returned.
        """
        k, threads, count = self.kernels, self.scenes * self.size // self.chunk, len(particles[0])
        launch(k.find_shared, threads, [self.first, self.size, self.chunk, grid, self.shared, self.gradient, self.reach])
        launch(k.add_gradients, count, [*particles, self.nodes, self.shared, self.gradient])
        launch(k.find_reach, count, [*particles, self.nodes, self.first, self.shared, self.gradient, self.reach])
        launch(k.exchange, threads, [*self._table(friction), grid, out])
        return out

    def exchange_adjoint(
        self,
        launch: Launch,
        particles: list,
        grid: Tensor,
        friction: Tensor,
        a_out: Tensor,
        a_grid: Tensor,
        a_x: Tensor,
        a_friction: Tensor,
    ) -> Tensor:
        """Compute the adjoint of the last `exchange`, which had the same particles, grid and friction.

        Args:
            launch: Launches a kernel.
            particles: As for `exchange`.
            grid: As for `exchange`.
            friction: As for `exchange`.
            a_out: Adjoint of the momentum and mass after the exchange.
            a_grid: Adjoint of those before; overwritten and returned.
            a_x: Adjoint of the positions; added to.
            a_friction: Adjoint of the friction; added to.
        """
        k, threads, count = self.kernels, self.scenes * self.size // self.chunk, len(particles[0])
        if self.of_adjoint is None:
            a_reach = torch.zeros(len(self.reach), 2 * self.bodies, dtype=self.reach.dtype, device=self.reach.device)
            self.of_adjoint = a_reach, torch.zeros_like(a_reach, dtype=torch.int32)
        a_reach, owner = self.of_adjoint
        launch(k.exchange_adjoint, threads, [*self._table(friction), grid, a_out, a_grid, self.a_gradient, a_reach, owner, a_friction])
        at_nodes = [self.nodes, self.first, self.shared, self.gradient]
        launch(k.find_owner, count, [*particles, *at_nodes, self.reach, a_reach, owner])
        launch(k.find_reach_adjoint, count, [*particles[:5], *at_nodes, a_reach, owner, self.a_gradient, a_x])
        launch(k.add_gradients_adjoint, count, [*particles, self.nodes, self.shared, self.a_gradient, a_x])
        return a_grid

    def _table(self, friction: Tensor) -> list:
        """Return the first arguments of the kernel of the exchange and of its adjoint."""
        return [self.first, self.size, self.chunk, self.bodies, self.dx, self.dt, friction, self.shared, self.gradient, self.reach]
