"""The volume of a body of which only the particles are known."""

import numpy as np

from neuido.errors import UserError
from neuido.physics.linalg.extent import box_axes, without_volume

FEW = 4000
"""Number of particles below which the smallest box around them bounds the estimate of their volume."""


def body_volume(x: np.ndarray) -> float:
    """Estimate the volume [m^3] of a body from its particles x (P, 3) [m], by voxel occupancy.

    A voxel is twice as wide as the mean spacing (V / P)^(1/3). It then holds about eight particles, and no voxel inside the body is
    empty. The volume V and the voxel width are found together by iteration. A voxel beside an empty one counts 2/3, because the surface
    cuts it. The result is the mean over eight positions of the voxel grid; its error is below 10 % for 5,000 particles. The motion of
    a body hardly depends on the volume, because a uniform volume scales masses and forces alike.

    With fewer particles lattice blocks are up to 40 % off and balls of about 35 particles up to 92 %. Below `FEW` particles the volume
    of the smallest box around them is the upper bound; without it the error would have no limit.

    Raises:
        UserError: The particles span no volume: they are in one place, on a line or in a plane.
    """
    x = np.asarray(x, dtype=np.float64)
    if flat := without_volume(x):
        raise UserError(f"the {len(x)} particles {flat} and span no volume: give particles in several layers")
    lower, extent = x.min(axis=0), np.ptp(x, axis=0)
    volume = float(np.prod(np.maximum(extent, 1e-3 * extent.max())))
    for _ in range(30):
        voxel = 2 * (volume / len(x)) ** (1 / 3)
        counts = [_occupied((x - lower) / voxel + np.array(shift) / 2) for shift in np.ndindex(2, 2, 2)]
        before, volume = volume, voxel**3 * float(np.mean(counts))
        if abs(volume - before) < 1e-3 * before:
            break
    return min(volume, _box_volume(x)) if len(x) < FEW else volume


def _box_volume(x: np.ndarray) -> float:
    """Return the volume [m^3] of the smallest box around particles, with its faces half a spacing s outside the outermost.

    Were the box full, its volume would be P s^3, which gives s.
    """
    a, b, c = np.ptp(x @ box_axes(x).T, axis=0)
    s = np.roots([len(x) - 1.0, -(a + b + c), -(a * b + b * c + c * a), -a * b * c]).real.max()
    return len(x) * float(s) ** 3


def _occupied(x: np.ndarray) -> float:
    """Count the unit cells that contain a point x >= 0; a cell beside an empty one counts 2/3."""
    cells = np.floor(x).astype(np.int64) + 1
    occupied = np.zeros(cells.max(axis=0) + 2, dtype=bool)
    occupied[tuple(cells.T)] = True
    interior = occupied.copy()
    for axis in range(3):
        interior &= np.roll(occupied, 1, axis) & np.roll(occupied, -1, axis)
    return (2 * occupied.sum() + interior.sum()) / 3
