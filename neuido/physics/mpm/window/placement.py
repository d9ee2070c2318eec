"""Where the grid of a simulator lies: a window that follows the matter.

A window is a block of nodes of the domain's own lattice, so that every node lies where it would without the window. It holds all particles
with a margin of as many cells as substeps follow, and a particle moves less than a cell a substep, so none reaches its edge. It grows where
the matter spreads and never shrinks; where it would fill the domain it is the domain.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from neuido.types import Scene

PIECE = 16
"""Substeps between two positions of a window. Its margin is as many cells on each side: at most a few megabytes of nodes, where a
look at the positions costs a fiftieth of sixteen substeps of a million particles."""
ROUNDING = 8
"""Cells to which the size of a window is rounded up, so that a body that spreads slowly changes it seldom."""
FOLLOWED = 1 << 28
"""Memory of the nodes of a domain [bytes] above which `grid="auto"` follows the matter, if they also take more than the particles."""


class Piece(NamedTuple):
    """Substeps that share one position of the window."""

    first: int
    """Substeps of the rollout before these."""
    steps: int
    """Number of substeps."""
    every: int
    """Substeps between the frames that they give."""


def pieces(steps: int, every: int, segment: int | None = None) -> list[Piece]:
    """Divide a rollout into pieces of at most `PIECE` substeps, whose ends include every frame.

    Args:
        steps: Substeps, a multiple of `every`.
        every: Substeps between two frames.
        segment: Largest number of substeps of a piece, if less than `PIECE`.
    """
    most = min(PIECE, segment or PIECE)
    if every <= most:
        length = most // every * every
        return [Piece(n, min(length, steps - n), every) for n in range(0, steps, length)]
    out = []
    for frame in range(0, steps, every):
        for n in range(frame, frame + every, most):
            length = min(most, frame + every - n)
            out.append(Piece(n, length, length))
    return out


def corners(x: Tensor, offsets: Sequence[int]) -> tuple[Tensor, Tensor]:
    """Return the smallest and the largest coordinates of the finite particles of each scene [m], (S, 3) float64 on the CPU each.

    A scene without one has infinite corners, the smallest above the largest.
    """
    low, high = (x.new_full((len(offsets) - 1, 3), sign * math.inf) for sign in (1.0, -1.0))
    finite = torch.isfinite(x).all(dim=1, keepdim=True)
    least, most = torch.where(finite, x, math.inf), torch.where(finite, x, -math.inf)
    for s, (i, j) in enumerate(zip(offsets[:-1], offsets[1:])):
        low[s], high[s] = least[i:j].amin(dim=0), most[i:j].amax(dim=0)
    both = torch.stack([low, high]).double().cpu()  # one transfer
    return both[0], both[1]


class Window:
    """Place a window of nodes around the particles of each scene.

    Args:
        scenes: The scenes.
        pad: Nodes added on each side of a domain.
    """

    def __init__(self, scenes: Sequence[Scene], pad: int) -> None:
        self.dx = torch.tensor([[scene.dx] * 3 for scene in scenes], dtype=torch.float64)
        self.edge = torch.tensor([scene.lower for scene in scenes], dtype=torch.float64) - pad * self.dx
        self.whole = torch.tensor([[n + 2 * pad for n in scene.nodes] for scene in scenes])
        self.shape = torch.zeros(3, dtype=torch.int64)
        self.first = torch.zeros_like(self.whole)

    def fit(self, low: Tensor, high: Tensor, margin: int) -> tuple[tuple[int, int, int], Tensor]:
        """Return the nodes along each axis, and the place of the first node of each scene [m], (S, 3) float64.

        Args:
            low: Smallest coordinates of each scene [m], (S, 3).
            high: Largest coordinates [m], (S, 3).
            margin: Cells between the particles and the edge, at least.
        """
        seen = (torch.isfinite(low) & torch.isfinite(high)).all(dim=1, keepdim=True)
        # a scene without a finite particle keeps its place, of one node
        low, high = (torch.where(seen, corner, self.edge) for corner in (low, high))
        first = torch.where(seen, ((low - self.edge) / self.dx - 0.5).floor().long() - margin, self.first).clamp(min=0)
        last = ((high - self.edge) / self.dx - 0.5).floor().long() + 2 + margin
        last = torch.where(seen, torch.minimum(last, self.whole - 1), first)
        needed = (last - first + 1).amax(dim=0)
        rounded = (needed + ROUNDING - 1) // ROUNDING * ROUNDING
        self.shape = torch.minimum(torch.where(needed > self.shape, rounded, self.shape), self.whole.amax(dim=0))
        middle = (first + last + 1 - self.shape) // 2  # the rest of the window lies on both sides
        self.first = torch.minimum(middle, self.whole - self.shape).clamp(min=0)
        nx, ny, nz = self.shape.tolist()
        return (nx, ny, nz), self.edge + self.first * self.dx
