"""Silhouettes as data: the place of an outline along normals of the measured outline, and moments of the area, both in pixels.

Both depend smoothly on a soft mask, measured or rendered. A profile is the integral of the mask along a normal from inside to outside. The
profile of a rendered mask less that of the measured one is the signed distance of their outlines, to a fraction of a pixel, up to the
length of the profile. The moments (area, centroid, second moments) have no such limit.
"""

from typing import NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor

MOMENTS = 6
"""Number of moments of an image: centroid x, y; area over perimeter; second moments xx, xy, yy over the size."""
SAMPLES = 40
"""Number of points on an outline."""
REACH = 12.0
"""Largest length of a profile on each side of the outline [px]."""
STEPS = 24
"""Number of samples of a mask along a profile."""
LEVEL = 0.5
"""Value of a soft mask on the outline."""
FINER = 4
"""Factor by which a mask is enlarged before its outline is traced."""


class Outlines(NamedTuple):
    """Measured outlines of R images with M points each. Pixel (i, j) has its centre at (j + 0.5, i + 0.5)."""

    points: Tensor
    """Points on the outline [px], (R, M, 2)."""
    normals: Tensor
    """Outward unit normals, (R, M, 2)."""
    inner: Tensor
    """Length of a profile inside the body [px], (R, M): at most to its middle."""
    outer: Tensor
    """Length of a profile outside the body [px], (R, M): at most half way to another part of the body."""
    perimeter: Tensor
    """Perimeter [px], (R,)."""
    size: Tensor
    """Root of the sum of the second moments xx and yy [px], (R,)."""
    kept: Tensor
    """Mask of the values of `features` that count, (R, MOMENTS + M) bool: those that the border of the image does not cut."""


class View(NamedTuple):
    """Errors of a camera and of the drawn outline."""

    x: float = 0.0
    """Shift to the right [px]."""
    y: float = 0.0
    """Shift downwards [px]."""
    scale: float = 0.0
    """Relative error of the magnification."""
    roll: float = 0.0
    """Rotation about the viewing direction [rad]."""
    outline: float = 0.0
    """Distance by which the drawn outline is moved outwards [px]."""


def outlines(masks: np.ndarray, cut: np.ndarray) -> Outlines:
    """Trace the outlines of soft masks.

    Args:
        masks: Masks (R, H, W) in 0..1, each with an object.
        cut: Rectangle of the recorded image [px], (R, 4): left, top, right, bottom. Nothing outside was recorded.
    """
    parts = [_trace(mask, box) for mask, box in zip(masks, cut, strict=True)]
    stacked = [torch.from_numpy(np.stack(column)) for column in zip(*parts, strict=True)]
    return Outlines(*(t.bool() if t.dtype == torch.bool else t.float() for t in stacked))


def usable(mask: np.ndarray) -> bool:
    """Return whether the object of a mask is large enough for an outline."""
    return int((mask >= LEVEL).sum()) >= 12


def _trace(mask: np.ndarray, cut: np.ndarray) -> tuple[np.ndarray, ...]:
    """Trace the outline of the largest object in a mask (H, W); return the fields of `Outlines` for one image."""
    height, width = mask.shape
    fine = cv2.resize(mask, (FINER * width, FINER * height), interpolation=cv2.INTER_LINEAR)
    found, _ = cv2.findContours((fine >= LEVEL).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    line = (max(found, key=cv2.contourArea)[:, 0].astype(np.float64) + 0.5) / FINER
    line = _smooth(line, 2 * FINER)
    step = np.linalg.norm(np.diff(line, axis=0, append=line[:1]), axis=1)
    length = np.concatenate([[0.0], np.cumsum(step)])
    at = np.linspace(0.0, length[-1], SAMPLES, endpoint=False)
    closed = np.concatenate([line, line[:1]])
    points = np.stack([np.interp(at, length, closed[:, a]) for a in range(2)], axis=1)
    ahead, behind = (np.stack([np.interp((at + d) % length[-1], length, closed[:, a]) for a in range(2)], axis=1) for d in (1.5, -1.5))
    tangent = ahead - behind
    normals = np.stack([tangent[:, 1], -tangent[:, 0]], axis=1)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
    after = np.roll(points, -1, axis=0)
    if np.sum(points[:, 0] * after[:, 1] - after[:, 0] * points[:, 1]) < 0:  # traced in the opposite direction
        normals = -normals
    inner = _half_way_to_change(mask, points, -normals, inside=True)
    outer = _half_way_to_change(mask, points, normals, inside=False)
    _, _, covariance = moments(torch.from_numpy(mask)[None].double())
    size = float(torch.diagonal(covariance[0]).sum().sqrt())
    return points, normals, inner, outer, np.array(length[-1]), np.array(size), _inside_image(mask, points, cut)


def _smooth(line: np.ndarray, width: int) -> np.ndarray:
    """Smooth a closed line (n, 2) by a running mean over about `width` points."""
    width = min(width, len(line) // 4)
    if width < 2:
        return line
    padded = np.concatenate([line[-width:], line, line[:width]])
    kernel = np.ones(2 * (width // 2) + 1) / (2 * (width // 2) + 1)
    return np.stack([np.convolve(padded[:, a], kernel, mode="same") for a in range(2)], axis=1)[width:-width]


def _half_way_to_change(mask: np.ndarray, points: np.ndarray, direction: np.ndarray, *, inside: bool) -> np.ndarray:
    """Return half the distance from each point to the next change of the mask along a direction, within 1.5..REACH [px]."""
    s = np.arange(1.5, 2 * REACH, 0.5)
    at = (points[:, None] + s[:, None] * direction[:, None] - 0.5).astype(np.float32)
    seen = cv2.remap(mask.astype(np.float32), at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderValue=0.0) >= LEVEL
    changed = seen != inside
    first = np.where(changed.any(axis=1), s[changed.argmax(axis=1)], 2 * REACH)
    return np.clip(0.5 * first, 1.5, REACH)


def _inside_image(mask: np.ndarray, points: np.ndarray, cut: np.ndarray) -> np.ndarray:
    """Return `Outlines.kept` of an image: points off the border of the recorded image, and the moments if all points are."""
    low, high = cut[:2], cut[2:]
    own = ((points > low + 1.5) & (points < high - 1.5)).all(axis=1)
    return np.concatenate([np.full(MOMENTS, bool(own.all())), own])


def moments(masks: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return area [px^2] (R,), centroid [px] (R, 2) and second central moments [px^2] (R, 2, 2) of soft masks (R, H, W)."""
    height, width = masks.shape[-2:]
    y, x = (torch.arange(n, dtype=masks.dtype, device=masks.device) + 0.5 for n in (height, width))
    area = masks.sum((-2, -1)).clamp(min=1e-3)
    centre = torch.stack([(masks.sum(-2) @ x), (masks.sum(-1) @ y)], -1) / area[:, None]
    dx, dy = x - centre[:, :1], y - centre[:, 1:]
    xx, yy = ((masks.sum(-2) * dx**2).sum(-1), (masks.sum(-1) * dy**2).sum(-1))
    xy = torch.einsum("rhw,rh,rw->r", masks, dy, dx)
    return area, centre, torch.stack([xx, xy, xy, yy], -1).view(-1, 2, 2) / area[:, None, None]


def profiles(masks: Tensor, at: Outlines, off: tuple[Tensor, Tensor] | None = None) -> Tensor:
    """Integrate masks along the normals of outlines, (R, M) [px].

    Args:
        masks: Soft masks (R, H, W).
        at: Outlines with their normals.
        off: Linear map (2, 2) and shift (2,) [px] from pixels of the measured image to pixels of the mask.
    """
    height, width = masks.shape[-2:]
    share = (torch.arange(STEPS, device=masks.device, dtype=masks.dtype) + 0.5) / STEPS
    reach = (at.inner + at.outer)[..., None]
    place = at.points[:, :, None] + at.normals[:, :, None] * (share * reach - at.inner[..., None])[..., None]
    if off is not None:
        place = place @ off[0].T + off[1]
    grid = 2 * place / place.new_tensor([width, height]) - 1
    seen = torch.nn.functional.grid_sample(masks[:, None], grid, align_corners=False)[:, 0]
    return reach[..., 0] * seen.mean(-1)


def features(masks: Tensor, at: Outlines, view: View = View()) -> Tensor:  # noqa: B008 (immutable)
    """Return moments and profiles of masks (R, H, W), (R, MOMENTS + M) [px], as seen with the errors `view` of camera and outline."""
    height, width = masks.shape[-2:]
    area, centre, covariance = moments(masks)
    turn = masks.new_tensor([[np.cos(view.roll), -np.sin(view.roll)], [np.sin(view.roll), np.cos(view.roll)]]) * (1 + view.scale)
    middle, shift = masks.new_tensor([0.5 * width, 0.5 * height]), masks.new_tensor([view.x, view.y])
    back = torch.linalg.inv(turn)
    lengths = profiles(masks, at, (back, middle - back @ (middle + shift))) + view.outline
    centre = (centre - middle) @ turn.T + middle + shift
    covariance = turn @ covariance @ turn.T * (1 + 0.5 * view.outline * at.perimeter / area)[:, None, None] ** 2
    area = area * (1 + view.scale) ** 2 + view.outline * at.perimeter
    second = torch.stack([covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]], -1) / at.size[:, None]
    return torch.cat([centre, (area / at.perimeter)[:, None], second, lengths], -1)


def displaced(at: Outlines, masks: Tensor) -> Tensor:
    """Return the change of `features` by six affine motions of the image, (R, MOMENTS + M, 6), to first order.

    They are shifts by one pixel along x and y, and the gradients x by x, x by y, y by x, y by y. A gradient moves a point at the
    distance `size` from the centroid by one pixel.
    """
    area, centre, covariance = moments(masks)
    columns = []
    for k in range(6):
        shift, gradient = masks.new_zeros(2), masks.new_zeros(2, 2)
        if k < 2:
            shift[k] = 1.0
        else:
            gradient[(k - 2) // 2, (k - 2) % 2] = 1.0
        G = gradient / at.size[:, None, None]
        moved = shift + torch.einsum("rab,rmb->rma", G, at.points - centre[:, None])
        change = G @ covariance + covariance @ G.mT
        second = torch.stack([change[:, 0, 0], change[:, 0, 1], change[:, 1, 1]], -1) / at.size[:, None]
        grown = (torch.diagonal(G, dim1=1, dim2=2).sum(-1) * area / at.perimeter)[:, None]
        columns.append(torch.cat([shift.expand(len(G), 2), grown, second, (moved * at.normals).sum(-1)], -1))
    return torch.stack(columns, -1)


class Score(NamedTuple):
    """Agreement of silhouettes, as means over images."""

    iou: float
    """Overlap: area of the intersection over area of the union."""
    outline: float
    """Mean distance from each outline to the other [px]."""
    psnr: float
    """Peak signal-to-noise ratio of the masks as images [dB]."""


def distances(masks: np.ndarray) -> np.ndarray:
    """Return the signed distance from the outline of soft masks (R, H, W) [px], positive outside, on a grid `FINER` times finer."""
    out = []
    for mask in masks:
        size = (FINER * mask.shape[1], FINER * mask.shape[0])
        inside = (cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_LINEAR) >= LEVEL).astype(np.uint8)
        far = [cv2.distanceTransform(part, cv2.DIST_L2, cv2.DIST_MASK_PRECISE) - 0.5 * part for part in (1 - inside, inside)]
        out.append((far[0] - far[1]) / FINER)
    return np.stack(out)


def inset(drawn: np.ndarray, measured: np.ndarray) -> float:
    """Return the distance by which drawn outlines must move inwards to enclose the measured area [px]; masks are (R, H, W)."""
    far = np.sort(distances(drawn).ravel())
    wanted = int((distances(measured) <= 0).sum())
    return -float(far[min(max(wanted - 1, 0), far.size - 1)])


def score(drawn: np.ndarray, measured: np.ndarray, inside: float = 0.0) -> Score:
    """Compare drawn and measured masks, (R, H, W) in 0..1, with the drawn outlines moved inwards by `inside` [px]."""
    ious, apart = [], []
    for far, true in zip(distances(drawn) + inside, distances(measured), strict=True):
        a, b = far <= 0, true <= 0
        ious.append(np.sum(a & b) / max(np.sum(a | b), 1))
        if a.any() and b.any():
            apart.append(0.5 * (np.abs(true[_edge(a)]).mean() + np.abs(far[_edge(b)]).mean()))
    psnr = -10 * np.log10(max(float(np.mean((drawn - measured) ** 2)), 1e-10))
    return Score(float(np.mean(ious)), float(np.mean(apart)) if apart else float("nan"), float(psnr))


def _edge(mask: np.ndarray) -> np.ndarray:
    """Return the border pixels of a mask."""
    return mask & ~cv2.erode(mask.astype(np.uint8), np.ones((3, 3), np.uint8), borderValue=0).astype(bool)
