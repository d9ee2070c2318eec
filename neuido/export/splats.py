"""Gaussians that deform with particles, frame by frame, in the form that 3DGS files have: no rotation beside the harmonics."""

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from neuido.errors import UserError
from neuido.models.render.gaussians import Binding, bind, deform, degree_of, harmonic_basis, scales_and_quaternions
from neuido.types import Gaussians

DIRECTIONS = 32
"""Directions from which the rotation of a band of harmonics is solved; seven would do for degree 3."""


class Ellipsoids(NamedTuple):
    """N Gaussians of one frame as float32 arrays."""

    means: np.ndarray
    """Centre [m], (N, 3)."""
    scales: np.ndarray
    """Standard deviations [m], (N, 3)."""
    quaternions: np.ndarray
    """Orientation, wxyz, (N, 4)."""
    opacities: np.ndarray
    """Opacity in 0..1, (N,)."""
    harmonics: np.ndarray
    """Spherical harmonics, (N, (degree + 1)^2, 3)."""


class MovingSplats:
    """Gaussians that are bound to the particles of a motion.

    Means follow the particles, covariances A become F A F^T, and harmonics turn with the polar part of F (`models.deform`).

    Args:
        gaussians: Gaussians at the first frame.
        x: Positions of the particles [m], (K, P, 3).
        F: Deformation gradients [-], (K, P, 3, 3).

    Raises:
        UserError: The Gaussians lie far from the particles.
    """

    def __init__(self, gaussians: Gaussians, x: np.ndarray, F: np.ndarray) -> None:
        gaussians = Gaussians(*(None if part is None else part.detach().float().cpu() for part in gaussians))
        self.rest, self.x, self.F = gaussians, torch.from_numpy(x), torch.from_numpy(F)
        self.binding: Binding = bind(gaussians, self.x[0])
        low, high = self.x[0].amin(0), self.x[0].amax(0)
        middle = gaussians.means.median(dim=0).values
        if bool(((middle < low - (high - low)) | (middle > high + (high - low))).any()):
            where = ", ".join(f"{value:.3g}" for value in middle.tolist())
            raise UserError(f"the Gaussians lie around ({where}) m, away from the particles of the first frame: they are of another body")

    def at(self, frame: int) -> Gaussians:
        """Return the Gaussians of a frame, with turned harmonics and without rotations."""
        with torch.no_grad():
            moved = deform(self.rest, self.F[frame], self.x[frame], self.binding)
            if moved.rotations is None:
                return moved
            return moved._replace(harmonics=turned(moved.harmonics, moved.rotations), rotations=None)

    def ellipsoids(self, frame: int) -> Ellipsoids:
        """Return the Gaussians of a frame as scales, quaternions and harmonics."""
        moved = self.at(frame)
        scales, quaternions = scales_and_quaternions(moved.covariances)
        parts = (moved.means, scales, quaternions, moved.opacities, moved.harmonics)
        return Ellipsoids(*(np.ascontiguousarray(part.numpy(), np.float32) for part in parts))


def turned(harmonics: Tensor, rotations: Tensor) -> Tensor:
    """Return the harmonics that have, seen along d, the colour that the given ones have along R^T d.

    Each band is closed under rotation, so that its coefficients follow exactly from the values in enough directions.

    Args:
        harmonics: Coefficients, (N, (degree + 1)^2, 3).
        rotations: Rotation R of each, (N, 3, 3).
    """
    degree = degree_of(harmonics)
    generator = torch.Generator().manual_seed(0)
    directions = torch.nn.functional.normalize(torch.randn(DIRECTIONS, 3, generator=generator, dtype=torch.float64), dim=-1)
    seen = harmonic_basis(torch.einsum("nji,mj->nmi", rotations.double(), directions), degree)
    basis = harmonic_basis(directions, degree)
    out = harmonics.clone()
    for band in range(1, degree + 1):
        own = slice(band**2, (band + 1) ** 2)
        solve = torch.linalg.pinv(basis[:, own])
        out[:, own] = torch.einsum("km,nml,nlc->nkc", solve, seen[..., own], harmonics[:, own].double()).to(harmonics)
    return out
