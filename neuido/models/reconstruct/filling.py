"""Filling of a reconstructed surface with particles: visual hulls, opacity volumes, and particle sampling.

A volume is a field in 0..1 on a regular grid; the body is the region where it exceeds a level. Masks give the visual hull (Laurentini
1994). Gaussians give their opacity, with enclosed regions filled by ray casting as in PhysGaussian. A cell is enclosed if 24 of 26 rays
hit the shell, so small holes in the shell do not leak.
"""

import itertools
import math
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from neuido.errors import UserError
from neuido.types import Cameras, Gaussians, Vector

METHODS = ("voxel", "poisson")
REACH = 6
"""Maximum extent of a Gaussian to each side, in grid cells."""

MOST_CELLS = 1 << 28
"""Largest number of cells of a volume of opacity; each takes some ten bytes."""
LEVEL = 0.5
STOPPING_OPACITY = 0.2
"""Opacity that stops a ray; it is low because a shell of Gaussians is thin in places."""

JITTER = 0.5
"""Jitter of the particles of a voxel filling, in spacings."""


class Volume(NamedTuple):
    """Field sampled at the centres of cubic cells."""

    values: Tensor
    """Values in 0..1, (X, Y, Z)."""
    lower: Tensor
    """Lower corner of the grid [m], (3,)."""
    spacing: float
    """Edge of a cell [m]."""

    def __repr__(self) -> str:
        return f"Volume({' x '.join(map(str, self.values.shape))} cells of {self.spacing:.3g} m)"

    def centres(self) -> Tensor:
        """Return the centres of the cells [m], (X, Y, Z, 3)."""
        axes = [torch.arange(n, device=self.lower.device) + 0.5 for n in self.values.shape]
        return self.lower + self.spacing * torch.stack(torch.meshgrid(*axes, indexing="ij"), -1)

    def at(self, x: Tensor) -> Tensor:
        """Return the field at points x [m] (N, 3) by trilinear interpolation, zero outside, (N,)."""
        size = torch.tensor(self.values.shape, device=x.device) * self.spacing
        unit = 2 * (x - self.lower) / size - 1
        grid = unit[:, [2, 1, 0]].view(1, -1, 1, 1, 3).to(self.values)  # grid_sample expects the last axis first
        return torch.nn.functional.grid_sample(self.values[None, None], grid, align_corners=False).view(-1)

    def measure_volume(self, level: float = LEVEL, finer: int = 3) -> float:
        """Measure the volume where the field exceeds the level [m^3], on a grid `finer` times finer."""
        step = self.spacing / finer
        offsets = (torch.arange(finer, device=self.lower.device) + 0.5) * step - 0.5 * self.spacing
        centres, total = self.centres().reshape(-1, 3), 0
        for dx in offsets:
            for dy in offsets:
                for dz in offsets:
                    total += int((self.at(centres + torch.stack([dx, dy, dz])) > level).sum())
        return total * step**3


def visual_hull(masks: Tensor, cameras: Cameras, lower: Vector, upper: Vector, *, resolution: int = 96) -> Volume:
    """Carve the visual hull: the largest body consistent with all masks.

    The value of a point is the minimum of the masks over the cameras that see it.

    Args:
        masks: Coverage of each pixel by the object, (V, H, W).
        cameras: Cameras of the V views; of cameras that move, those of the first frame count.
        lower, upper: Corners of a box that contains the body [m].
        resolution: Cells along the longest side of the body.

    Raises:
        UserError: Masks and cameras differ in shape, or no point is consistent with all masks.
    """
    cameras = cameras.at(0)
    if tuple(masks.shape) != (len(cameras.viewmats), cameras.height, cameras.width):
        raise UserError(f"masks have shape {tuple(masks.shape)}; the cameras need {(len(cameras.viewmats), cameras.height, cameras.width)}")
    low, high = masks.new_tensor(lower), masks.new_tensor(upper)
    coarse = _carve(masks, cameras, low, high, 48, widen=True)
    inside = (coarse.values > LEVEL).nonzero()
    if not len(inside):
        raise UserError("no point of the scene's domain lies in the masks of all views: check cameras, scale, shift and masks")
    low = coarse.lower + coarse.spacing * (inside.amin(0) - 1)
    high = coarse.lower + coarse.spacing * (inside.amax(0) + 2)
    fine = _carve(masks, cameras, low, high, resolution, widen=False)
    if not bool((fine.values > LEVEL).any()):
        raise UserError("the masks of the views do not meet in one body: check cameras, scale, shift and masks")
    return fine


def _cells_around(gaussians: Gaussians, spacing: float) -> tuple[Tensor, list[int]]:
    """Return the lower corner and the cells along each axis of the lattice around Gaussians."""
    means = gaussians.means.detach()
    lower = means.amin(0) - (REACH + 1) * spacing
    return lower, ((means.amax(0) - lower) / spacing + REACH + 1).ceil().long().tolist()


def volume_cells(gaussians: Gaussians, spacing: float) -> int:
    """Return the number of cells of `opacity_volume`."""
    return math.prod(_cells_around(gaussians, spacing)[1])


def opacity_volume(gaussians: Gaussians, *, spacing: float, hull: Volume | None = None) -> Volume:
    """Return the opacity of Gaussians, 1 - prod(1 - o exp(-d^2 / 2)), set to one in enclosed cells and limited by the hull.

    Args:
        gaussians: Gaussians at t = 0.
        spacing: Edge of a cell [m].
        hull: Result of `visual_hull`, an upper bound of the field.
    """
    from scipy import ndimage

    lower, shape = _cells_around(gaussians, spacing)
    if math.prod(shape) > MOST_CELLS:
        raise UserError(f"a volume of {shape} cells is too large: raise its spacing, {spacing:g} m")
    clear = _transmittance(gaussians, lower, spacing, shape)
    inside = _fill_enclosed((clear < 1 - STOPPING_OPACITY).cpu().numpy())
    inside = ndimage.uniform_filter(inside.astype(np.float32), 3) > 0.5
    field = torch.maximum(1 - clear, torch.from_numpy(inside).to(clear))
    volume = Volume(field, lower, spacing)
    if hull is not None:
        allowed = hull.at(volume.centres().reshape(-1, 3)).view(field.shape)
        volume = volume._replace(values=torch.minimum(field, allowed))
    return volume


def fill(
    volume: Volume, *, count: int | None = None, spacing: float | None = None, method: str = "voxel", level: float = LEVEL, seed: int = 0
) -> tuple[Tensor, Tensor]:
    """Fill a volume with particles.

    Args:
        volume: Volume of the body.
        count: Approximate number of particles; alternatively
        spacing: Particle spacing [m].
        method: `voxel`: one jittered particle per cube of a lattice; `poisson`: Poisson-disk sampling with a minimum distance that gives
            about the same number of particles.
        level: Level of the field above which the body lies.
        seed: Seed of the positions.

    Returns:
        Positions (P, 3) [m], and equal volumes (P,) [m^3] whose sum is the volume of the body. Both on the CPU, float32.

    Raises:
        UserError: Not exactly one of count and spacing is given, the method is unknown, or the spacing is too coarse for a single particle.
    """
    if (count is None) == (spacing is None):
        raise UserError("give either the number of particles or their spacing")
    if method not in METHODS:
        raise UserError(f"method = {method!r}; one of {', '.join(METHODS)}")
    if (count is not None and count < 1) or (spacing is not None and not spacing > 0):
        raise UserError(f"the number of particles and their spacing must be positive, got {count} and {spacing}")
    size = volume.measure_volume(level)
    if not size > 0:
        raise UserError("the opacity volume is empty: the Gaussians show no body")
    edge = spacing or (size / count) ** (1 / 3)  # type: ignore[operator]
    generator = np.random.default_rng(seed)
    x = _lattice(volume, edge, level, generator) if method == "voxel" else _poisson(volume, edge, level, generator)
    if not len(x):
        raise UserError(f"no particle lies in the body of {size:.3g} m^3: lower the spacing, {edge:g} m")
    return x.float(), torch.full((len(x),), size / len(x))


def _carve(masks: Tensor, cameras: Cameras, lower: Tensor, upper: Tensor, resolution: int, *, widen: bool) -> Volume:
    spacing = float((upper - lower).max()) / resolution
    shape = ((upper - lower) / spacing).round().clamp(min=1).int().tolist()
    volume = Volume(masks.new_ones(shape), lower, spacing)
    x = volume.centres().reshape(-1, 3)
    seen_by = torch.zeros(len(x), dtype=torch.int32, device=x.device)
    for mask, viewmat, K in zip(masks, cameras.viewmats.to(x), cameras.Ks.to(x)):
        seen = x @ viewmat[:3, :3].T + viewmat[:3, 3]
        depth = seen[:, 2].clamp(min=1e-6)
        pixel = seen[:, :2] / depth[:, None] * torch.stack([K[0, 0], K[1, 1]]) + K[:2, 2]
        if widen:  # no thin part may fall between the centres of coarse cells
            near = max(0, math.ceil(0.87 * spacing * float(K[0, 0]) / float(depth.median())))
            mask = torch.nn.functional.max_pool2d(mask[None, None], 2 * near + 1, 1, near)[0, 0]
        size = pixel.new_tensor([cameras.width, cameras.height])
        value = torch.nn.functional.grid_sample(mask[None, None], (2 * pixel / size - 1).view(1, 1, -1, 2), align_corners=False).view(-1)
        visible = (seen[:, 2] > 1e-6) & ((pixel >= 0) & (pixel <= size)).all(1)
        flat = volume.values.view(-1)
        flat.copy_(torch.where(visible, torch.minimum(flat, value), flat))
        seen_by += visible
    volume.values.view(-1)[seen_by < min(2, len(masks))] = 0
    return volume


def _transmittance(gaussians: Gaussians, lower: Tensor, spacing: float, shape: list[int]) -> Tensor:
    """Return the transmittance prod(1 - o exp(-d^2 / 2)) at the cell centres, (X, Y, Z).

    Gaussians are widened by a third of a cell, so that none falls between the centres.
    """
    means, covariances = gaussians.means.detach(), gaussians.covariances.detach()
    covariances = covariances + (spacing / 3) ** 2 * torch.eye(3, device=means.device, dtype=means.dtype)
    conics = torch.linalg.inv(covariances)
    reach = (3 * covariances.diagonal(dim1=1, dim2=2).amax(1).sqrt() / spacing).ceil().clamp(1, REACH).int()
    total = means.new_zeros(math.prod(shape))
    for r in range(1, REACH + 1):
        chosen = (reach == r).nonzero().squeeze(1)
        axis = torch.arange(-r, r + 1, device=means.device)
        window = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
        for part in chosen.split(max(1, 4_000_000 // len(window))):
            cell = ((means[part] - lower) / spacing).floor().long()[:, None] + window
            d = lower + (cell + 0.5) * spacing - means[part, None]
            alpha = gaussians.opacities.detach()[part, None] * torch.exp(-0.5 * torch.einsum("nwi,nij,nwj->nw", d, conics[part], d))
            index = (cell[..., 0] * shape[1] + cell[..., 1]) * shape[2] + cell[..., 2]
            total.index_add_(0, index.flatten(), torch.log1p(-alpha.clamp(max=0.999)).flatten())
    return total.exp().view(shape)


def _fill_enclosed(solid: np.ndarray, share: int = 24) -> np.ndarray:
    """Return the cells from which at least `share` of the 26 rays to the faces, edges and corners of a cube hit a solid cell."""
    hits = np.zeros(solid.shape, dtype=np.int8)
    for direction in itertools.product((-1, 0, 1), repeat=3):
        axis = next((a for a, step in enumerate(direction) if step), None)
        if axis is None:
            continue
        step, across = direction[axis], [direction[a] for a in range(3) if a != axis]
        slices, counts = np.moveaxis(solid, axis, 0), np.moveaxis(hits, axis, 0)
        carried = np.zeros_like(slices[0])  # whether the ray has hit a solid cell in the slices before
        for i in range(len(slices))[::-step]:
            carried = _shift(carried, across)
            counts[i] += carried
            carried |= slices[i]
    return hits >= share


def _shift(plane: np.ndarray, by: list[int]) -> np.ndarray:
    """Return the plane shifted by an offset, plane[i + by[0], j + by[1]], False outside."""
    padded = np.pad(plane, 1)
    return padded[1 + by[0] : 1 + by[0] + plane.shape[0], 1 + by[1] : 1 + by[1] + plane.shape[1]]


def _lattice(volume: Volume, edge: float, level: float, generator: np.random.Generator) -> Tensor:
    """Return one jittered point for each cube of a lattice, where the point lies in the volume."""
    counts = [math.ceil(n * volume.spacing / edge) for n in volume.values.shape]
    axes = [torch.arange(n, dtype=torch.float32) + 0.5 for n in counts]
    cell = torch.stack(torch.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    lower, shift = volume.lower.cpu(), torch.from_numpy(JITTER * generator.uniform(-0.5, 0.5, (len(cell), 3))).float()
    x = lower + edge * (cell + shift)
    return x[(volume.at(x.to(volume.lower.device)) > level).cpu()]


def _poisson(volume: Volume, edge: float, level: float, generator: np.random.Generator) -> Tensor:
    """Sample Poisson disks: visit candidates in random order and accept each unless an accepted one is closer than the distance.

    All candidates that precede their neighbours are accepted at once, which gives the same result as one at a time.
    """
    from scipy.spatial import KDTree

    inside = torch.nn.functional.max_pool3d((volume.values > 0)[None, None].float(), 3, 1, 1)[0, 0] > 0
    cells = inside.nonzero().cpu().numpy()
    lower = volume.lower.cpu().double().numpy()
    many = max(1, math.ceil(12 * volume.spacing**3 / edge**3))
    corner = np.repeat(cells, many, axis=0) + generator.uniform(0, 1, (len(cells) * many, 3))
    if many == 1:  # thin the candidates to about twelve per particle
        keep = generator.uniform(0, 1, len(corner)) < 12 * volume.spacing**3 / edge**3
        corner = corner[keep]
    x = lower + volume.spacing * corner
    x = x[(volume.at(torch.from_numpy(x).float().to(volume.lower.device)) > level).cpu().numpy()]
    generator.shuffle(x)
    distance = 0.825 * edge  # so that about one particle falls on edge^3
    pairs = KDTree(x).query_pairs(distance, output_type="ndarray") if len(x) else np.empty((0, 2), int)
    first, second = pairs.min(1), pairs.max(1)  # the index is the order of the visits
    open_, taken = np.ones(len(x), bool), np.zeros(len(x), bool)
    while open_.any():
        live = open_[first] & open_[second]
        blocked = np.zeros(len(x), bool)
        blocked[second[live]] = True
        now = open_ & ~blocked
        taken |= now
        open_ &= ~now
        hit = now[first]
        open_[second[hit]] = False
        first, second = first[live & ~hit], second[live & ~hit]
    return torch.from_numpy(x[taken])
