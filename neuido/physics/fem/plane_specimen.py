"""A flat specimen under prescribed boundary motion: quasi-static finite elements, differentiable in the law and in the motion.

Linear triangles, with Newton's method and a sparse direct solver. The gradient follows from the implicit function theorem: one more step
of Newton's method from the solution, with the matrix held constant, carries the derivatives, so that a backward pass costs one solution of
a linear system and not a new simulation for each parameter.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from neuido.errors import UserError
from neuido.physics.laws.base import ElasticLaw
from neuido.types import brief_fields

TOLERANCE = 1e-10
"""Largest imbalance of the forces of free nodes, relative to the largest force of a node."""
ITERATIONS = 25
"""Largest number of Newton steps of a load step; a step that needs more is halved."""
HALVINGS = 8
"""Largest number of times that a load step is halved."""
CONDITIONS = ("strain", "stress")
"""Plane strain (thick, or held between plates) and plane stress (thin)."""
COMPONENTS = ((0, 0), (0, 1), (1, 0), (1, 1), (2, 2))
"""Components of F that are not fixed by the plane, in the order of the tangent."""


class PlaneMotion(NamedTuple):
    """Equilibrium of a plane specimen in T load steps."""

    displacement: Tensor
    """Displacement of the nodes [m], (T, N, 2) float64."""
    force: Tensor
    """Force that the surroundings exert on each node [N], (T, N, 2) float64; zero at free nodes."""

    def __repr__(self) -> str:
        return brief_fields(self)


@dataclass(frozen=True, eq=False, repr=False)
class PlaneSpecimen:
    """A flat specimen as a mesh of linear triangles.

    Args:
        nodes: Places at rest [m], (N, 2).
        triangles: Nodes of each triangle, (E, 3), in either sense.
        thickness: Thickness at rest [m].
        condition: `strain` or `stress` (plane strain or plane stress).

    Raises:
        UserError: A shape does not fit, a triangle has no area, a node belongs to no triangle, or the condition is unknown.
    """

    nodes: Tensor
    triangles: Tensor
    thickness: float = 1.0
    condition: str = "strain"

    def __post_init__(self) -> None:
        x, t = torch.as_tensor(self.nodes).double(), torch.as_tensor(self.triangles).long()
        if x.ndim != 2 or x.shape[1] != 2 or t.ndim != 2 or t.shape[1] != 3 or not len(t):
            raise UserError(f"nodes have the shape {tuple(x.shape)} and triangles {tuple(t.shape)}; needed (N, 2) and (E, 3)")
        if not bool(torch.isfinite(x).all()):
            raise UserError(f"node {int((~torch.isfinite(x)).any(1).nonzero()[0])} has a place that is not finite")
        if not 0 <= int(t.min()) <= int(t.max()) < len(x):
            raise UserError(f"triangles name the nodes {int(t.min())} to {int(t.max())}, and there are {len(x)}")
        if alone := len(x) - len(t.unique()):
            lone = min(set(range(len(x))) - set(t.unique().tolist()))
            raise UserError(f"{alone} nodes belong to no triangle, the first is {lone}: leave them out")
        if not self.thickness > 0:
            raise UserError(f"thickness = {self.thickness} must be positive")
        if self.condition not in CONDITIONS:
            raise UserError(f"condition = {self.condition!r} is unknown: choose from {', '.join(CONDITIONS)}")
        edges = torch.stack([x[t[:, 1]] - x[t[:, 0]], x[t[:, 2]] - x[t[:, 0]]], 2)
        area = 0.5 * torch.linalg.det(edges)
        if bool((area.abs() < 1e-12 * edges.abs().amax() ** 2).any()):
            raise UserError(f"triangle {int(area.abs().argmin())} has no area")
        inner = torch.linalg.inv(edges)
        object.__setattr__(self, "nodes", x)
        object.__setattr__(self, "triangles", t)
        object.__setattr__(self, "_area", area.abs())
        object.__setattr__(self, "_slopes", torch.cat([-inner.sum(1, keepdim=True), inner], 1))  # d shape / d x, (E, 3, 2)

    def __repr__(self) -> str:
        return f"PlaneSpecimen({len(self.nodes)} nodes, {len(self.triangles)} triangles, plane {self.condition})"

    def equilibrium(self, law: ElasticLaw, prescribed: Tensor, motion: Tensor) -> PlaneMotion:
        """Compute the equilibrium under prescribed displacements of some nodes, load step after load step.

        Args:
            law: Elastic law, one scene. Gradients reach its tensors.
            prescribed: Which displacements are prescribed, (N, 2) bool.
            motion: Displacements [m], (T, N, 2); those of other nodes are not used. Gradients reach the prescribed ones.

        Raises:
            UserError: A shape does not fit, too few displacements are prescribed to hold the specimen, or a load step has no equilibrium.
        """
        fixed, motion = torch.as_tensor(prescribed), torch.as_tensor(motion).double()
        if tuple(fixed.shape) != tuple(self.nodes.shape) or fixed.dtype != torch.bool:
            raise UserError(f"prescribed is {fixed.dtype} of shape {tuple(fixed.shape)}; needed bool {tuple(self.nodes.shape)}")
        if motion.ndim != 3 or motion.shape[1:] != self.nodes.shape:
            raise UserError(f"motion has the shape {tuple(motion.shape)}; needed (T, {len(self.nodes)}, 2)")
        if not bool(fixed.any(0).all()) or int(fixed.sum()) < 3:
            raise UserError("the specimen can move freely: prescribe at least three displacements, in x and in y")
        if not bool(torch.isfinite(motion[:, fixed]).all()):
            raise UserError("a prescribed displacement is not finite")
        u, out, forces = torch.zeros_like(self.nodes), [], []
        for step, target in enumerate(motion):
            u = self._to(law, fixed, u, target.detach(), step)
            moved, force = self._derived(law, fixed, u, target)
            out.append(moved)
            forces.append(force)
        return PlaneMotion(torch.stack(out), torch.stack(forces))

    def _to(self, law: ElasticLaw, fixed: Tensor, begun: Tensor, target: Tensor, step: int) -> Tensor:
        """Return the displacements of the equilibrium of a load step, (N, 2); increments that fail are halved."""
        at, share, halved = 0.0, 1.0, 0
        u, start = begun, begun
        while at < 1:
            part = min(share, 1 - at)
            wanted = start + (at + part) * (target - start)
            found = self._solved(law, fixed, torch.where(fixed, wanted, u), u)
            if found is None:
                halved, share = halved + 1, share / 2
                if halved > HALVINGS:
                    raise UserError(
                        f"load step {step} has no equilibrium, from {at:.0%} of it on: check units and signs of the motion, and the law"
                    )
                continue
            u, at = found, at + part
        return torch.where(fixed, target, u)

    def _solved(self, law: ElasticLaw, fixed: Tensor, trial: Tensor, before: Tensor) -> Tensor | None:
        """Return the displacements of the equilibrium with the prescribed ones of `trial`; None where Newton's method fails."""
        u, free = before, ~fixed.reshape(-1)
        jump = torch.where(fixed, trial - before, 0.0).reshape(-1)
        for iteration in range(ITERATIONS):
            with torch.enable_grad():
                force, matrix = self._assembled(law, u)
            if not bool(torch.isfinite(force).all()):
                return None
            if iteration and float(force[free].abs().max()) <= TOLERANCE * float(force.abs().max()):
                return u
            right = force + (torch.from_numpy(matrix @ jump.numpy()) if not iteration else 0.0)
            move = jump.clone() if not iteration else torch.zeros_like(jump)
            try:
                move[free] = -_factor(matrix, free).solve(right[free])
            except RuntimeError:  # a singular matrix
                return None
            u = u + move.reshape(-1, 2)
            if not bool(torch.isfinite(u).all()) or bool((torch.linalg.det(self._gradient(u)) <= 0).any()):
                return None
        return None

    def _derived(self, law: ElasticLaw, fixed: Tensor, u: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
        """Return displacements and forces of an equilibrium with their derivatives, by one more Newton step at a constant matrix."""
        with torch.enable_grad():
            _, matrix = self._assembled(law, u)
        free = ~fixed.reshape(-1)
        moved = torch.where(fixed, target, u)
        move = torch.zeros_like(u).reshape(-1)
        move = move.index_put((free.nonzero()[:, 0],), -_LinearSolve.apply(self._forces(law, moved)[free], _factor(matrix, free)))
        moved = moved + move.reshape(-1, 2)
        force = self._forces(law, moved).reshape(-1, 2)
        return moved, torch.where(fixed, force, 0.0)

    def _gradient(self, u: Tensor) -> Tensor:
        """Return the deformation gradient in the plane of each triangle, (E, 2, 2)."""
        return torch.eye(2, dtype=u.dtype) + u[self.triangles].mT @ self._slopes  # type: ignore[attr-defined]

    def _stress(self, law: ElasticLaw, F: Tensor) -> Tensor:
        """Return the first Piola-Kirchhoff stress [Pa] in the plane (E, 2, 2) for gradients in the plane (E, 2, 2)."""
        stretch = F.new_ones(len(F))
        if self.condition == "stress":
            with torch.no_grad():
                stretch = self._thinned(law, F)
            with torch.enable_grad():
                slope = _tangent(law, _whole(F.detach(), stretch))[1][:, 4, 4]
            stretch = stretch - _piola(law, _whole(F, stretch))[:, 2, 2] / slope.detach()  # carries the derivative
        return _piola(law, _whole(F, stretch))[:, :2, :2]

    def _thinned(self, law: ElasticLaw, F: Tensor) -> Tensor:
        """Return the stretch of the thickness at which the stress across vanishes, (E,), by Newton's method."""
        stretch = torch.linalg.det(F).clamp(min=1e-3) ** -0.5
        for _ in range(ITERATIONS):
            with torch.enable_grad():
                P, A = _tangent(law, _whole(F, stretch))
            move = P[:, 4] / A[:, 4, 4]
            stretch = torch.maximum(stretch - move, 0.5 * stretch)
            if float(move.abs().max()) < 1e-13:
                break
        return stretch

    def _forces(self, law: ElasticLaw, u: Tensor) -> Tensor:
        """Return the internal force of each degree of freedom [N], (2 N,)."""
        P = self._stress(law, self._gradient(u))
        volume = self.thickness * self._area  # type: ignore[attr-defined]
        each = volume[:, None, None] * self._slopes @ P.mT  # type: ignore[attr-defined]
        return torch.zeros_like(u).index_add(0, self.triangles.reshape(-1), each.reshape(-1, 2)).reshape(-1)

    def _assembled(self, law: ElasticLaw, u: Tensor) -> tuple[Tensor, Any]:
        """Return the internal forces (2 N,) [N] and the stiffness matrix (2 N, 2 N) [N/m], both detached."""
        from scipy.sparse import coo_matrix

        F = self._gradient(u.detach())
        stretch = self._thinned(law, F) if self.condition == "stress" else F.new_ones(len(F))
        P, A = _tangent(law, _whole(F, stretch))
        if self.condition == "stress":  # condensed: the stress across stays zero
            A = A[:, :4, :4] - A[:, :4, 4:] * A[:, 4:, :4] / A[:, 4:, 4:]
        A, P = A[:, :4, :4].reshape(-1, 2, 2, 2, 2), P[:, :4].reshape(-1, 2, 2)
        volume, slopes = self.thickness * self._area, self._slopes  # type: ignore[attr-defined]
        each = volume[:, None, None] * slopes @ P.mT
        force = torch.zeros_like(u).index_add(0, self.triangles.reshape(-1), each.reshape(-1, 2)).reshape(-1)
        K = torch.einsum("e,eaj,eijkl,ebl->eaibk", volume, slopes, A, slopes).reshape(-1, 6, 6)
        places = (2 * self.triangles[:, :, None] + torch.arange(2)).reshape(-1, 6)
        rows, columns = places[:, :, None].expand(-1, 6, 6), places[:, None].expand(-1, 6, 6)
        size = 2 * len(self.nodes)
        matrix = coo_matrix((K.reshape(-1).numpy(), (rows.reshape(-1).numpy(), columns.reshape(-1).numpy())), shape=(size, size))
        return force.detach(), matrix.tocsc()


class _Factor:
    """A factorised stiffness matrix of the free degrees of freedom."""

    def __init__(self, factor: Any) -> None:
        self.factor = factor

    def solve(self, right: Tensor, *, transposed: bool = False) -> Tensor:
        return torch.from_numpy(self.factor.solve(np.ascontiguousarray(right.detach().numpy()), "T" if transposed else "N"))


def _factor(matrix: Any, free: Tensor) -> _Factor:
    from scipy.sparse.linalg import splu

    own = free.nonzero()[:, 0].numpy()
    return _Factor(splu(matrix[own][:, own].tocsc()))


class _LinearSolve(torch.autograd.Function):
    """The solution of a linear system, differentiable in the right-hand side."""

    @staticmethod
    def forward(ctx: Any, right: Tensor, factor: _Factor) -> Tensor:
        ctx.factor = factor
        return factor.solve(right)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None]:  # type: ignore[override]
        return ctx.factor.solve(grad, transposed=True), None


def _whole(F: Tensor, stretch: Tensor) -> Tensor:
    """Return deformation gradients (E, 3, 3) from those in the plane (E, 2, 2) and the stretch of the thickness (E,)."""
    zero = torch.zeros_like(stretch)
    rows = [torch.stack([F[:, i, 0], F[:, i, 1], zero], 1) for i in range(2)]
    return torch.stack([*rows, torch.stack([zero, zero, stretch], 1)], 1)


def _piola(law: ElasticLaw, F: Tensor) -> Tensor:
    """Return the first Piola-Kirchhoff stress [Pa], (E, 3, 3)."""
    return torch.linalg.solve(F, law(F).mT).mT  # tau F^-T, as (F^-1 tau)^T of a symmetric tau


def _tangent(law: ElasticLaw, F: Tensor) -> tuple[Tensor, Tensor]:
    """Return the stress (E, 5) and its derivative by the gradient (E, 5, 5), both detached, in the order of `COMPONENTS`."""
    leaf = F.detach().clone().requires_grad_()
    P = _piola(law, leaf)
    rows: Sequence[Tensor] = [torch.autograd.grad(P[:, i, j].sum(), leaf, retain_graph=True)[0] for i, j in COMPONENTS]
    stacked = torch.stack([torch.stack([row[:, i, j] for i, j in COMPONENTS], 1) for row in rows], 1)
    return torch.stack([P[:, i, j] for i, j in COMPONENTS], 1).detach(), stacked
