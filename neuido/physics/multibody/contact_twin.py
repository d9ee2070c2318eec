"""The contact between bodies in plain torch, differentiable by autograd: a slow twin of `contact_kernels` for tests."""

from itertools import combinations

import torch
from torch import Tensor

from neuido.physics.colliders.solid_contact import DAMPING, PARTING
from neuido.physics.multibody.contact_kernels import BETTER, PUSH
from neuido.physics.multibody.reach_kernels import ROUND


def exchange(
    momentum: Tensor,
    mass: Tensor,
    gradient: Tensor,
    friction: Tensor,
    arms: tuple[Tensor, Tensor, Tensor],
    dx: float,
    dt: float,
) -> Tensor:
    """Return the momentum of the nodes of one scene after contact.

    Args:
        momentum: [kg m/s], (B, N, 3) for B bodies and N nodes.
        mass: [kg], (B, N).
        gradient: Volume gradient [m^2], (B, N, 3).
        friction: Coulomb's coefficients [-], (B, B).
        arms: Row of (B N) nodes, place relative to it [m] and half edge [m] of each of the particles around each node; (Q,), (Q, 3), (Q,).
        dx: Cell size [m].
        dt: Substep [s].
    """
    rows, arm, half = arms
    bodies, nodes = mass.shape
    shared = (mass > 0).sum(0) > 1
    total = mass.sum(0)
    change = torch.zeros_like(momentum)

    def reach(body: int, axis: Tensor) -> tuple[Tensor, Tensor]:
        own = rows // nodes == body
        at = rows[own] % nodes
        along = (axis[at] * arm[own]).sum(-1)
        aside = arm[own].square().sum(-1) - along.square()
        none = torch.full((nodes,), -torch.inf, dtype=axis.dtype)
        plain = along + half[own]
        return tuple(none.scatter_reduce(0, at, t, "amax") for t in (plain, plain - aside / (2 * ROUND * dx)))

    for a, b in combinations(range(bodies), 2):
        met = shared & (mass[a] > 0) & (mass[b] > 0)
        overlaps, bent, axes = [], [], []
        for axis in (gradient[b] - gradient[a], -gradient[a], gradient[b]):
            unit = torch.nn.functional.normalize(axis, dim=-1)
            plain, ball = (ra + rb for ra, rb in zip(reach(a, unit), reach(b, -unit)))
            overlaps.append(torch.where(axis.norm(dim=-1) > 0, plain, torch.inf))
            bent.append(ball)
            axes.append(axis)
        least, chosen, overlap = overlaps[0] - BETTER * dx, axes[0], bent[0]
        for other, ball, axis in zip(overlaps[1:], bent[1:], axes[1:]):
            better = other < least
            least, overlap = torch.where(better, other, least), torch.where(better, ball, overlap)
            chosen = torch.where(better[:, None], axis, chosen)
        met = met & (overlap > 0) & (chosen.norm(dim=-1) > 0)
        n = chosen[met] / chosen[met].norm(dim=-1, keepdim=True)
        ma, mb = mass[a][met][:, None], mass[b][met][:, None]
        r = momentum[a][met] / ma - momentum[b][met] / mb
        rn = (r * n).sum(-1, keepdim=True)
        t = r - rn * n
        speed = t.norm(dim=-1, keepdim=True)
        push = torch.minimum(PUSH * overlap[met][:, None] / dt + DAMPING * rn, rn + PARTING * dx / dt).clamp(min=0.0)
        grip = torch.minimum(friction[a, b] * push, speed)
        J = -ma * mb / total[met][:, None] * (push * n + grip * t / speed.clamp(min=1e-30))
        index = met.nonzero()[:, 0]
        change = change.index_put((torch.full_like(index, a), index), J, accumulate=True)
        change = change.index_put((torch.full_like(index, b), index), -J, accumulate=True)
    return momentum + change
