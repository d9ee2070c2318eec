"""A flat specimen under prescribed boundary motion: quasi-static finite elements, differentiable in the law and in the motion.

Linear triangles, with Newton's method and a sparse direct solver. The gradient follows from the implicit function theorem: one more step
of Newton's method from the solution, with the matrix held constant, carries the derivatives, so that a backward pass costs one solution of
a linear system and not a new simulation for each parameter.
"""

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from neuido.errors import UserError
from neuido.physics.laws.base import ElasticLaw
from neuido.physics.plane.plane_law import PlaneLaw, SpatialLaw
from neuido.types import brief_fields

TOLERANCE = 1e-10
"""Largest imbalance of the forces of free nodes, relative to the largest force of a node."""
LEAST_STRAIN = 1e-4
"""Strain whose forces the imbalance is measured by where those of the specimen are smaller, as where it is back at rest."""
ITERATIONS = 25
"""Largest number of Newton steps of a load step; a step that needs more is halved."""
HALVINGS = 8
"""Largest number of times that a load step is halved."""
CONDITIONS = ("strain", "stress")
"""Plane strain (thick, or held between plates) and plane stress (thin)."""
CLOSE = 0.3
"""Largest ratio of two successive imbalances at which the stiffness of another solution is still used in place of a new one."""
FAST = 1e-7
"""Largest imbalance that `near` leaves, relative to the largest force of a node: far below what a measurement tells."""
PARTS = 4
"""Parts of a load step in which a law that yields is followed. The plastic strain is that of the end of each part."""
UNDEFORMED = torch.tensor([1.0, 0.0, 0.0, 1.0], dtype=torch.float64)


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
        object.__setattr__(self, "areas", area.abs())
        object.__setattr__(self, "_slopes", torch.cat([-inner.sum(1, keepdim=True), inner], 1))  # d shape / d x, (E, 3, 2)
        object.__setattr__(self, "_gradients", self._operator())

    def __repr__(self) -> str:
        return f"PlaneSpecimen({len(self.nodes)} nodes, {len(self.triangles)} triangles, plane {self.condition})"

    @property
    def centres(self) -> Tensor:
        """Centres of the triangles at rest [m], (E, 2)."""
        return self.nodes[self.triangles].mean(1)

    def equilibrium(self, law: ElasticLaw | PlaneLaw, prescribed: Tensor, motion: Tensor) -> PlaneMotion:
        """Compute the equilibrium under prescribed displacements of some nodes, load step after load step.

        Args:
            law: Elastic law, one scene, or a law of the plane. Gradients reach its tensors.
            prescribed: Which displacements are prescribed, (N, 2) bool.
            motion: Displacements [m], (T, N, 2); those of other nodes are not used. Gradients reach the prescribed ones.

        Raises:
            UserError: A shape does not fit, too few displacements are prescribed to hold the specimen, or a load step has no equilibrium.
        """
        fixed, motion = self.checked(prescribed, motion)
        own = law if isinstance(law, PlaneLaw) else SpatialLaw(law)
        u, out, forces = torch.zeros_like(self.nodes), [], []
        for step, target in enumerate(motion):
            begun, moved, force = u, u, u
            for share in parts_of(own):
                here = begun + share * (target - begun)
                u = self.towards(own, fixed, u, here.detach(), step).displacement
                moved, force = self._derived(own, fixed, u, here)
                own = own.after(self._whole_derived(own, self.gradient(moved))) if isinstance(own, PlaneLaw) else own
            u = moved.detach()
            out.append(moved)
            forces.append(force)
        return PlaneMotion(torch.stack(out), torch.stack(forces))

    def checked(self, prescribed: Tensor, motion: Tensor) -> tuple[Tensor, Tensor]:
        """Return the arguments of `equilibrium` as tensors.

        Raises:
            UserError: A shape does not fit, or too few displacements are prescribed to hold the specimen.
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
        return fixed, motion

    def towards(self, law: "PlaneLaw | SpatialLaw", fixed: Tensor, begun: Tensor, target: Tensor, step: int) -> "Solution":
        """Compute the equilibrium of a load step from that before; increments that fail are halved.

        Args:
            law: The law.
            fixed: Which displacements are prescribed, (N, 2).
            begun: Displacements of an equilibrium [m], (N, 2).
            target: Prescribed displacements [m], (N, 2).
            step: Number of the load step, for messages.

        Raises:
            UserError: There is no equilibrium.
        """
        at, share, halved = 0.0, 1.0, 0
        solution = None
        u = begun
        while at < 1:
            part = min(share, 1 - at)
            wanted = target if at + part == 1 else begun + (at + part) * (target - begun)
            found = self._solved(law, fixed, torch.where(fixed, wanted, u), u)
            if found is None:
                halved, share = halved + 1, share / 2
                if halved > HALVINGS:
                    raise UserError(
                        f"load step {step} has no equilibrium, from {at:.0%} of it on: check units and signs of the motion, and the law"
                    )
                continue
            solution, at = found, at + part
            u = solution.displacement
        assert solution is not None
        return solution

    def followed(self, law: PlaneLaw, fixed: Tensor, begun: Tensor, target: Tensor, step: int) -> tuple["Solution", PlaneLaw, PlaneLaw]:
        """Compute the equilibrium of a load step by a law that may yield, without derivatives.

        Args:
            law, fixed, begun, target, step: As of `towards`.

        Returns:
            The equilibrium, the law before its last part, and the law after it.

        Raises:
            UserError: There is no equilibrium.
        """
        u, before, solution = begun, law, None
        for share in parts_of(law):
            before = law
            solution = self.towards(law, fixed, u, begun + share * (target - begun), step)
            u = solution.displacement
            law = law.after(self.whole(law, self.gradient(u))) if law.yields else law
        assert solution is not None
        return solution, before, law

    def near(self, law: PlaneLaw, fixed: Tensor, known: "Solution") -> "Solution | None":
        """Compute the equilibrium of another law under the same prescribed displacements, with the stiffness of a known one.

        The imbalance is at most `FAST`. The stiffness is computed anew only where it does not serve. None where there is no equilibrium.
        """
        free = ~fixed.reshape(-1)
        u, factor, last = known.displacement, known.factor, math.inf
        scale, move, F = known.size / float(law.moduli.mu), torch.zeros_like(u), self._detached_gradient(u)
        for _ in range(ITERATIONS):
            force = self._spread(law.stress(self.whole(law, F)).detach()[:, :4])
            left, whole = float(force[free].abs().max()), float(force.abs().max())
            if not math.isfinite(left):
                return None
            if left <= FAST * whole:
                return Solution(u, force, factor, known.size if scale != 1 else float(law.moduli.mu))
            if left > CLOSE * last:
                force, matrix = self.assembled(law, u)
                try:
                    factor, scale = _factor(matrix, free), 1.0
                except RuntimeError:  # a singular matrix
                    return None
                left = math.inf
            last = left
            move = torch.zeros(len(free), dtype=torch.float64)
            move[free] = -scale * factor.solve(force[free])
            move = move.reshape(-1, 2)
            for _ in range(HALVINGS):
                F = self._detached_gradient(u + move)
                if law.turns or bool((_area_ratio(F) > 0).all()):
                    break
                move = 0.5 * move  # until it turns no triangle inside out
            u = u + move
        return None

    def _detached_gradient(self, u: Tensor) -> Tensor:
        """Return `_gradient` without derivatives, (E, 4)."""
        F = self._gradients @ u.reshape(-1).numpy()  # type: ignore[attr-defined]
        return torch.from_numpy(F).reshape(-1, 4) + UNDEFORMED

    def _solved(self, law: "PlaneLaw | SpatialLaw", fixed: Tensor, trial: Tensor, before: Tensor) -> "Solution | None":
        """Return the equilibrium with the prescribed displacements of `trial`; None where Newton's method fails."""
        u, free, factor = before, ~fixed.reshape(-1), None
        extent = float((self.nodes.amax(0) - self.nodes.amin(0)).max())
        jump = torch.where(fixed, trial - before, 0.0).reshape(-1)
        for iteration in range(ITERATIONS):
            force, matrix = self.assembled(law, u)
            if not bool(torch.isfinite(force).all()):
                return None
            size = max(float(force.abs().max()), LEAST_STRAIN * float(abs(matrix).max()) * extent)
            if factor is not None and float(force[free].abs().max()) <= TOLERANCE * size:
                return Solution(torch.where(fixed, trial, u), force, factor, float(law.moduli.mu) if isinstance(law, PlaneLaw) else 1.0)
            right = force + (torch.from_numpy(matrix @ jump.numpy()) if not iteration else 0.0)
            move = jump.clone() if not iteration else torch.zeros_like(jump)
            try:
                factor = _factor(matrix, free)
            except RuntimeError:  # a singular matrix
                return None
            move[free] = -factor.solve(right[free])
            u = u + move.reshape(-1, 2)
            if not bool(torch.isfinite(u).all()) or (not law.turns and bool((_area_ratio(self.gradient(u)) <= 0).any())):
                return None
        return None

    def _derived(self, law: "PlaneLaw | SpatialLaw", fixed: Tensor, u: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
        """Return displacements and forces of an equilibrium with their derivatives, by one more Newton step at a constant matrix."""
        _, matrix = self.assembled(law, u)
        free = ~fixed.reshape(-1)
        moved = torch.where(fixed, target, u)
        move = torch.zeros_like(u).reshape(-1)
        move = move.index_put((free.nonzero()[:, 0],), -_LinearSolve.apply(self._forces(law, moved)[free], _factor(matrix, free)))
        moved = moved + move.reshape(-1, 2)
        force = self._forces(law, moved).reshape(-1, 2)
        return moved, torch.where(fixed, force, 0.0)

    def _operator(self) -> Any:
        """Return the sparse matrix from displacements (2 N,) to components 11, 12, 21 and 22 of their gradient, (4 E, 2 N)."""
        from scipy.sparse import csr_matrix

        t, slopes = self.triangles.numpy(), self._slopes.numpy()  # type: ignore[attr-defined]
        columns = 2 * t[:, None, None, :] + np.arange(2)[None, :, None, None] + np.zeros((1, 1, 2, 1), dtype=int)
        values = np.broadcast_to(slopes.transpose(0, 2, 1)[:, None], columns.shape)
        ends = np.arange(4 * len(t) + 1) * 3
        return csr_matrix((values.reshape(-1), columns.reshape(-1), ends), shape=(4 * len(t), 2 * len(self.nodes)))

    def gradient(self, u: Tensor) -> Tensor:
        """Return components 11, 12, 21 and 22 of the deformation gradient of each triangle, (E, 4)."""
        F = u[self.triangles].mT @ self._slopes  # type: ignore[attr-defined]
        return F.reshape(-1, 4) + UNDEFORMED

    def whole(self, law: "PlaneLaw | SpatialLaw", F: Tensor) -> Tensor:
        """Return all components of the deformation gradient, (E, 5), from those in the plane, (E, 4); detached."""
        stretch = self._thinned(law, F) if self.condition == "stress" else F.new_ones(len(F))
        return torch.cat([F, stretch[:, None]], 1)

    def _thinned(self, law: "PlaneLaw | SpatialLaw", F: Tensor) -> Tensor:
        """Return the stretch of the thickness at which the stress across vanishes, (E,), by Newton's method."""
        stretch = _area_ratio(F).clamp(min=1e-3) ** -0.5
        for _ in range(ITERATIONS):
            P, slope = law.across(torch.cat([F, stretch[:, None]], 1))
            move = P / slope
            stretch = torch.maximum(stretch - move, 0.5 * stretch)
            if float(move.abs().max()) < 1e-13:
                break
        return stretch

    def _forces(self, law: "PlaneLaw | SpatialLaw", u: Tensor) -> Tensor:
        """Return the internal force of each degree of freedom [N], (2 N,), differentiable."""
        P = law.stress(self._whole_derived(law, self.gradient(u)))[:, :4].reshape(-1, 2, 2)
        volume = self.thickness * self.areas  # type: ignore[attr-defined]
        each = volume[:, None, None] * self._slopes @ P.mT  # type: ignore[attr-defined]
        return torch.zeros_like(u).index_add(0, self.triangles.reshape(-1), each.reshape(-1, 2)).reshape(-1)

    def _whole_derived(self, law: "PlaneLaw | SpatialLaw", F: Tensor) -> Tensor:
        """Return `whole` with its derivatives by F and by the law."""
        whole = self.whole(law, F.detach())
        if self.condition == "strain":
            return torch.cat([F, whole[:, 4:]], 1)
        slope = law.across(whole)[1]
        whole = torch.cat([F, whole[:, 4:]], 1)
        return torch.cat([F, (whole[:, 4] - law.stress(whole)[:, 4] / slope)[:, None]], 1)

    def _spread(self, P: Tensor) -> Tensor:
        """Return the force of each degree of freedom (2 N,) [N] of stresses (E, 4) [Pa]."""
        weighed = (self.thickness * self.areas)[:, None] * P  # type: ignore[attr-defined]
        return torch.from_numpy(self._gradients.T @ weighed.reshape(-1).numpy())  # type: ignore[attr-defined]

    def assembled(self, law: "PlaneLaw | SpatialLaw", u: Tensor) -> tuple[Tensor, Any]:
        """Return the internal forces (2 N,) [N] and the stiffness matrix (2 N, 2 N) [N/m], both detached."""
        from scipy.sparse import coo_matrix

        P, A = law.tangent(self.whole(law, self.gradient(u.detach())))
        if self.condition == "stress":  # condensed: the stress across stays zero
            A = A[:, :4, :4] - A[:, :4, 4:] * A[:, 4:, :4] / A[:, 4:, 4:]
        A = A[:, :4, :4].reshape(-1, 2, 2, 2, 2)
        volume, slopes = self.thickness * self.areas, self._slopes  # type: ignore[attr-defined]
        K = torch.einsum("e,eaj,eijkl,ebl->eaibk", volume, slopes, A, slopes).reshape(-1, 6, 6)
        places = (2 * self.triangles[:, :, None] + torch.arange(2)).reshape(-1, 6)
        rows, columns = places[:, :, None].expand(-1, 6, 6), places[:, None].expand(-1, 6, 6)
        size = 2 * len(self.nodes)
        matrix = coo_matrix((K.reshape(-1).numpy(), (rows.reshape(-1).numpy(), columns.reshape(-1).numpy())), shape=(size, size))
        return self._spread(P[:, :4]), matrix.tocsc()


def parts_of(law: "PlaneLaw | SpatialLaw") -> tuple[float, ...]:
    """Return the shares of a load step after each of which the plastic strain is kept; a law that does not yield takes one."""
    count = PARTS if isinstance(law, PlaneLaw) and law.yields else 1
    return tuple((i + 1) / count for i in range(count))


class Factor:
    """A factorised stiffness matrix of the free degrees of freedom."""

    def __init__(self, factor: Any) -> None:
        self.factor = factor

    def solve(self, right: Tensor, *, transposed: bool = False) -> Tensor:
        """Return the solution (n,) or (n, k) of a linear system."""
        return torch.from_numpy(self.factor.solve(np.ascontiguousarray(right.detach().numpy()), "T" if transposed else "N"))


class Solution(NamedTuple):
    """An equilibrium of one load step."""

    displacement: Tensor
    """Displacement of the nodes [m], (N, 2)."""
    force: Tensor
    """Internal force of each degree of freedom [N], (2 N,)."""
    factor: Factor
    """The last stiffness that was factorised."""
    size: float
    """Shear modulus [Pa] of the law of that stiffness."""


def _factor(matrix: Any, free: Tensor) -> Factor:
    from scipy.sparse.linalg import splu

    own = free.nonzero()[:, 0].numpy()
    return Factor(splu(matrix[own][:, own].tocsc(), permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True}))


def _area_ratio(F: Tensor) -> Tensor:
    """Return the determinant in the plane, (E,), of gradients (E, 4)."""
    return F[:, 0] * F[:, 3] - F[:, 1] * F[:, 2]


class _LinearSolve(torch.autograd.Function):
    """The solution of a linear system, differentiable in the right-hand side."""

    @staticmethod
    def forward(ctx: Any, right: Tensor, factor: Factor) -> Tensor:
        ctx.factor = factor
        return factor.solve(right)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None]:  # type: ignore[override]
        return ctx.factor.solve(grad, transposed=True), None
