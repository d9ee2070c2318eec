"""Relative density of a body, as a field over its rest shape, which a reconstruction from the first frame cannot observe.

Images show only the surface, so a reconstructed body is filled evenly. Real bodies may be hollow or foamed, and the bodies of published
data sets have denser particles near the surface. The relative density scales mass and elastic stress together
(`Effects.relative_density`; Gibson and Ashby 1997, chapter 5, exponent 1), so a uniform factor has no effect.
"""

import math
from pathlib import Path

import torch
from torch import Tensor, nn

from neuido.errors import UserError
from neuido.models.fewshot.method import read_tensors, write_tensors

BOUND = math.log(20.0)
"""Approximate bound on the natural logarithm of the density relative to the mean."""
LEVELS = 3


class RelativeDensity(nn.Module):
    """Exponential of a sum of trilinear fields on lattices of spacing h, 2 h and 4 h, normalised to preserve the mass of the body.

    Args:
        x: Rest positions of the particles [m], (P, 3).
        volume: Particle volumes [m^3], (P,).
        h: Finest spacing [m]: the cell size of the simulation grid, which does not resolve finer fields.
        levels: Number of lattices.
    """

    def __init__(self, x: Tensor, volume: Tensor, h: float, levels: int = LEVELS):
        super().__init__()
        self.spacing = h
        self.register_buffer("volume", volume.detach().clone())
        self.fields = nn.ParameterList()
        for level in range(levels):
            index, weight, size = lattice(x.detach(), h * 2**level)
            self.register_buffer(f"index_{level}", index)
            self.register_buffer(f"weight_{level}", weight)
            self.fields.append(nn.Parameter(x.new_zeros(size)))

    def forward(self) -> Tensor:
        """Return the relative density of each particle [-], (P,), whose volume average is one."""
        total = self.fields[0].new_zeros(())
        for level, field in enumerate(self.fields):
            total = total + (field[getattr(self, f"index_{level}")] * getattr(self, f"weight_{level}")).sum(1)
        factor = (BOUND * (total / BOUND).tanh()).exp()
        return factor * (self.volume.sum() / (self.volume * factor).sum())

    def prior(self) -> Tensor:
        """Return the volume average of the squared logarithm, (): zero for an evenly filled body."""
        return (self.volume * self().log().square()).sum() / self.volume.sum()

    def save(self, path: Path) -> None:
        """Write the fields to a safetensors file atomically."""
        tensors = {f"field_{level}": field.detach().cpu().clone() for level, field in enumerate(self.fields)}
        write_tensors(path, tensors | {"spacing": torch.tensor(self.spacing, dtype=torch.float64)})

    def load(self, path: Path) -> None:
        """Load what `save` wrote.

        Raises:
            UserError: The file is missing, damaged, or belongs to another body.
        """
        given = read_tensors(path)
        for level, field in enumerate(self.fields):
            found = given.get(f"field_{level}")
            if found is None or found.shape != field.shape:
                raise UserError(f"model.adapter: {path} is the density of another body: it has no field_{level} of {len(field)} numbers")
            with torch.no_grad():
                field.copy_(found)


def lattice(x: Tensor, h: float) -> tuple[Tensor, Tensor, int]:
    """Return the trilinear interpolation weights of points on a lattice of spacing h that contains them.

    Args:
        x: Points [m], (P, 3).
        h: Spacing [m].

    Returns:
        Indices of the nodes around each point (P, 8) int64, their weights (P, 8), and the number of nodes.
    """
    at = (x - x.amin(0)) / h
    low = at.floor()
    share = at - low
    size = [int(n) + 2 for n in low.amax(0)]
    index, weight = [], []
    for corner in range(8):
        step = [(corner >> axis) & 1 for axis in range(3)]
        i, j, k = (low[:, axis].long() + step[axis] for axis in range(3))
        index.append((i * size[1] + j) * size[2] + k)
        weight.append(math.prod(share[:, axis] if step[axis] else 1 - share[:, axis] for axis in range(3)))
    return torch.stack(index, 1), torch.stack(weight, 1), math.prod(size)
