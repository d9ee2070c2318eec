"""Silhouettes as data: where an outline lies along the normals of the measured one, and the moments of the area, in pixels.

Both are smooth functionals of a soft mask, measured or rendered. A profile is the integral of the mask along a normal from inside to
outside: that of a rendered mask less that of the measured one is the signed distance of the outlines, to a fraction of a pixel, as long as
they are not further apart than the profile reaches. Moments (area, centroid, second moments) know no such limit.
"""

from typing import NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor

MOMENTS = 6
"""Rows of moments of one image: centroid x, y; area over perimeter; second moments xx, xy, yy over the size."""
SAMPLES = 40
"""Points of an outline."""
REACH = 12.0
"""Length of a profile to each side of the outline [px], at the most."""
STEPS = 24
"""Samples of a mask along a profile."""
LEVEL = 0.5
FINER = 4
"""An outline is traced on a mask so many times finer."""


class Outlines(NamedTuple):
    """The measured outlines of R images, and what is compared there. Pixel (i, j) has its centre at (j + 0.5, i + 0.5)."""

    points: Tensor
    """On the outline [px], (R, M, 2)."""
    normals: Tensor
    """Outward, of length one, (R, M, 2)."""
    inner: Tensor
    """How far a profile reaches into the body [px], (R, M): no further than its middle."""
    outer: Tensor
    """How far it reaches outside [px], (R, M): no further than half way to another part of the body."""
    perimeter: Tensor
    """[px], (R,)"""
    size: Tensor
    """Root of the sum of the second moments [px], (R,)."""
    kept: Tensor
    """Which rows of `features` count, (R, MOMENTS + M) bool: not those that the image's border cuts."""


class View(NamedTuple):
    """By how much a camera and the drawn outline are off."""

    x: float = 0.0
    """Shift [px]."""
    y: float = 0.0
    scale: float = 0.0
    """Relative."""
    roll: float = 0.0
    """[rad]"""
    outline: float = 0.0
    """The drawn outline lies so far outside [px]."""


def outlines(masks: np.ndarray, cut: np.ndarray) -> Outlines:
    """Trace soft masks.

    Args:
        masks: (R, H, W) in 0..1, each with some object.
        cut: Rectangle in which the recorded image lies [px], (R, 4): left, top, right, bottom; what leaves it is not seen.
    """
    parts = [_trace(mask, box) for mask, box in zip(masks, cut, strict=True)]
    stacked = [torch.from_numpy(np.stack(column)) for column in zip(*parts, strict=True)]
    return Outlines(*(t.bool() if t.dtype == torch.bool else t.float() for t in stacked))


def usable(mask: np.ndarray) -> bool:
    """Whether a mask shows an object that is large enough for an outline."""
    return int((mask >= LEVEL).sum()) >= 12


def _trace(mask: np.ndarray, cut: np.ndarray) -> tuple[np.ndarray, ...]:
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
    if np.sum(points[:, 0] * after[:, 1] - after[:, 0] * points[:, 1]) < 0:  # traced the other way round
        normals = -normals
    inner = _clear(mask, points, -normals, inside=True)
    outer = _clear(mask, points, normals, inside=False)
    _, _, covariance = moments(torch.from_numpy(mask)[None].double())
    size = float(torch.diagonal(covariance[0]).sum().sqrt())
    return points, normals, inner, outer, np.array(length[-1]), np.array(size), _uncut(mask, points, cut)


def _smooth(line: np.ndarray, width: int) -> np.ndarray:
    """A closed line by its running mean."""
    width = min(width, len(line) // 4)
    if width < 2:
        return line
    padded = np.concatenate([line[-width:], line, line[:width]])
    kernel = np.ones(2 * (width // 2) + 1) / (2 * (width // 2) + 1)
    return np.stack([np.convolve(padded[:, a], kernel, mode="same") for a in range(2)], axis=1)[width:-width]


def _clear(mask: np.ndarray, points: np.ndarray, direction: np.ndarray, *, inside: bool) -> np.ndarray:
    """Half the way from each point until the mask changes again, within 1.5..REACH [px]."""
    s = np.arange(1.5, 2 * REACH, 0.5)
    at = (points[:, None] + s[:, None] * direction[:, None] - 0.5).astype(np.float32)
    seen = cv2.remap(mask.astype(np.float32), at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderValue=0.0) >= LEVEL
    changed = seen != inside
    first = np.where(changed.any(axis=1), s[changed.argmax(axis=1)], 2 * REACH)
    return np.clip(0.5 * first, 1.5, REACH)


def _uncut(mask: np.ndarray, points: np.ndarray, cut: np.ndarray) -> np.ndarray:
    low, high = cut[:2], cut[2:]
    own = ((points > low + 1.5) & (points < high - 1.5)).all(axis=1)
    return np.concatenate([np.full(MOMENTS, bool(own.all())), own])


def moments(masks: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Area [px^2] (R,), centroid [px] (R, 2) and second central moments [px^2] (R, 2, 2) of soft masks (R, H, W)."""
    height, width = masks.shape[-2:]
    y, x = (torch.arange(n, dtype=masks.dtype, device=masks.device) + 0.5 for n in (height, width))
    area = masks.sum((-2, -1)).clamp(min=1e-3)
    centre = torch.stack([(masks.sum(-2) @ x), (masks.sum(-1) @ y)], -1) / area[:, None]
    dx, dy = x - centre[:, :1], y - centre[:, 1:]
    xx, yy = ((masks.sum(-2) * dx**2).sum(-1), (masks.sum(-1) * dy**2).sum(-1))
    xy = torch.einsum("rhw,rh,rw->r", masks, dy, dx)
    return area, centre, torch.stack([xx, xy, xy, yy], -1).view(-1, 2, 2) / area[:, None, None]


def profiles(masks: Tensor, at: Outlines, off: tuple[Tensor, Tensor] | None = None) -> Tensor:
    """Integrals of masks (R, H, W) along the normals [px], (R, M).

    Args:
        masks: Soft masks.
        at: Where.
        off: A linear map (2, 2) and a shift (2,) that bring a pixel of the compared image to one of the mask.
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
    """Moments and profiles of masks (R, H, W) [px], (R, MOMENTS + M), as a camera that is off by `view` and a drawn outline show them."""
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
    """What affine motions of the image do to `features`, to first order, (R, MOMENTS + M, 6): shifts and gradients x, y by x, y.

    A gradient moves the end of the body, at `size` from its centroid, by one pixel.
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
    """How well silhouettes agree, means over images."""

    iou: float
    """Area of both over area of either."""
    outline: float
    """Mean distance from one outline to the other, both ways [px]."""
    psnr: float
    """Of the masks as images [dB]."""


def distances(masks: np.ndarray) -> np.ndarray:
    """Signed distance from the outline of soft masks (R, H, W), positive outside [px], on a grid `FINER` times finer."""
    out = []
    for mask in masks:
        size = (FINER * mask.shape[1], FINER * mask.shape[0])
        inside = (cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_LINEAR) >= LEVEL).astype(np.uint8)
        far = [cv2.distanceTransform(part, cv2.DIST_L2, cv2.DIST_MASK_PRECISE) - 0.5 * part for part in (1 - inside, inside)]
        out.append((far[0] - far[1]) / FINER)
    return np.stack(out)


def inset(drawn: np.ndarray, measured: np.ndarray) -> float:
    """How far inside the drawn outlines (R, H, W) a body ends whose area is that of the measured ones [px]."""
    far = np.sort(distances(drawn).ravel())
    wanted = int((distances(measured) <= 0).sum())
    return -float(far[min(max(wanted - 1, 0), far.size - 1)])


def score(drawn: np.ndarray, measured: np.ndarray, inside: float = 0.0) -> Score:
    """Compare drawn with measured masks, (R, H, W) in 0..1; the drawn body ends `inside` its outline [px]."""
    ious, apart = [], []
    for far, true in zip(distances(drawn) + inside, distances(measured), strict=True):
        a, b = far <= 0, true <= 0
        ious.append(np.sum(a & b) / max(np.sum(a | b), 1))
        if a.any() and b.any():
            apart.append(0.5 * (np.abs(true[_edge(a)]).mean() + np.abs(far[_edge(b)]).mean()))
    psnr = -10 * np.log10(max(float(np.mean((drawn - measured) ** 2)), 1e-10))
    return Score(float(np.mean(ious)), float(np.mean(apart)) if apart else float("nan"), float(psnr))


def _edge(mask: np.ndarray) -> np.ndarray:
    """The border pixels of a mask."""
    return mask & ~cv2.erode(mask.astype(np.uint8), np.ones((3, 3), np.uint8), borderValue=0).astype(bool)
