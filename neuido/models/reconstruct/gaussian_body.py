"""A body from the Gaussians of a 3DGS PLY file: those that are opaque enough, filled inside with particles."""

import os

import numpy as np
import torch

from neuido.data.neighbours.neighbour_scene import Placement
from neuido.errors import UserError
from neuido.models.reconstruct.filling import MOST_CELLS, fill, opacity_volume, volume_cells
from neuido.models.render.gaussians import load_gaussians
from neuido.physics.runtime.limits import check_limit
from neuido.types import Gaussians

Box = tuple[np.ndarray, np.ndarray]
"""Lower and upper corner."""

FINE = 2.0
"""Cells of the opacity volume along the spacing of the particles; a surface is placed to about half a cell."""
SHARE = 0.02
"""Share of the Gaussians, half of them on each side of an axis, that may lie apart from the bulk."""
STRAY = 2.0
"""Distance from the middle, in half sizes of the bulk, beyond which Gaussians are strays of a reconstruction and no part of the body."""
ROUNDS = 3
"""Fillings that are tried to come to the number of particles; the spacing is scaled by the third root of the ratio."""
CLOSE = 0.1
"""Relative difference from that number at which the filling is kept."""


def place_gaussians(
    path: str | os.PathLike, placement: Placement, *, opacity: float, scale: float = 1.0, region: Box | None = None
) -> Gaussians:
    """Read Gaussians, leave out faint ones and those outside an area, and move the rest.

    Args:
        path: A 3DGS PLY file.
        placement: Which are kept, and where they are put.
        opacity: Opacity at or below which a Gaussian is left out.
        scale: Metres per unit of the file, where the placement states no length.
        region: Corners of the box that holds the body, in axes and units of the file.

    Raises:
        UserError: The file cannot be read, or no Gaussian is left.
    """
    given = load_gaussians(path, dtype=torch.float64, device="cpu")
    turn = torch.as_tensor(np.asarray(placement.rotation, np.float64))
    means = given.means @ turn.T
    kept = given.opacities > opacity
    if not bool(kept.any()):
        raise UserError(f"{path}: none of {len(kept)} Gaussians has an opacity above {opacity:g}: lower the threshold")
    for points, box, whose in ((given.means, region, "--region"), (means, placement.area, "the area of the scene")):
        if box is not None:
            kept = kept & _within(points, box, kept, f"{path}: {whose}")
    if placement.area is None and placement.length is None and region is None:
        middle, half = _bulk(means[kept])
        kept = kept & ((means - middle).abs() <= STRAY * half).all(dim=1)
    means, low, high = means[kept], means[kept].amin(0), means[kept].amax(0)
    if placement.length is not None:
        if not float((high - low).max()) > 0:
            raise UserError(f"{path}: the Gaussians that are kept lie in one place")
        scale = placement.length / float((high - low).max())
    middle = (low + high) / 2
    target = scale * middle if placement.centre is None else torch.as_tensor(placement.centre, dtype=torch.float64)
    covariances = scale**2 * (turn @ given.covariances[kept] @ turn.T)
    return Gaussians(scale * (means - middle) + target, covariances, given.opacities[kept], given.harmonics[kept])


def _within(points: torch.Tensor, box: Box, kept: torch.Tensor, what: str) -> torch.Tensor:
    """Return which points (N, 3) lie in a box; at least one of those that are kept must."""
    low, high = (torch.as_tensor(corner, dtype=torch.float64) for corner in box)
    inside = ((points > low) & (points < high)).all(dim=1)
    if not bool((kept & inside).any()):
        asked, spans = (
            " x ".join(
                f"{x:.3g} to {y:.3g}" for x, y in zip((corner.round(decimals=9) + 0.0).tolist(), (other.round(decimals=9) + 0.0).tolist())
            )
            for corner, other in ((low, high), (points[kept].amin(0), points[kept].amax(0)))
        )
        raise UserError(f"{what}, {asked}, holds none of its Gaussians, which span {spans}")
    return inside


def filled_body(gaussians: Gaussians, *, particles: int) -> dict[str, np.ndarray]:
    """Fill Gaussians with particles at rest.

    Args:
        gaussians: Gaussians of one body [m].
        particles: Approximate number of particles.

    Returns:
        Arrays x (P, 3) [m], v (P, 3) [m/s] and volume (P,) [m^3].

    Raises:
        UserError: They show no body, or too many particles are asked for.
    """
    check_limit(particles, "NEUIDO_MAX_PARTICLES", f"particles is {particles}")
    if particles < 8:
        raise UserError(f"particles is {particles}; a body has 8 at least")
    half = _bulk(gaussians.means)[1]
    spacing = float(((2 * half).clamp(min=1e-3 * float(half.max())).prod() / particles) ** (1 / 3))
    for _ in range(ROUNDS):
        if volume_cells(gaussians, spacing / FINE) > MOST_CELLS:
            extent = " x ".join(f"{float(side):.3g}" for side in gaussians.means.amax(0) - gaussians.means.amin(0))
            raise UserError(f"the Gaussians span {extent} m, and their bulk far less: cut the body out with --region, or lower --particles")
        volume = opacity_volume(gaussians, spacing=spacing / FINE)
        x, each = fill(volume, spacing=spacing)
        if abs(len(x) / particles - 1) < CLOSE:
            break
        spacing *= (len(x) / particles) ** (1 / 3)
    return {"x": x.double().numpy(), "v": np.zeros((len(x), 3)), "volume": each.double().numpy()}


def _bulk(means: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the middle and the half sizes of the box that all but a `SHARE` of points (N, 3) lie in, along each axis, (3,) each."""
    ordered = means.sort(dim=0).values
    first = int(0.5 * SHARE * len(means))
    low, high = ordered[first], ordered[len(means) - 1 - first]
    return (low + high) / 2, (high - low) / 2
