"""The perceptual difference ꟻLIP of two images (Andersson et al. 2020), which needs no weights.

It is what a viewer sees who flips between the two: differences of colour after the eye's contrast sensitivity, raised where edges and
points of the images differ. 0 is equal, 1 the largest difference.

All filters are separable. They are products with banded matrices that repeat the pixels at the border, as in `render.similarity`.
"""

import functools
import math

import torch
from torch import Tensor

PIXELS_PER_DEGREE = 67.0206
"""Pixels in a degree of the visual field: a display of 3840 pixels and 0.7 m across, seen from 0.7 m (the authors' default)."""

CONTRAST = {"A": ((1.0, 0.0047),), "RG": ((1.0, 0.0053),), "BY": ((34.1, 0.04), (13.5, 0.025))}
"""Gaussians of the contrast sensitivity of each opponent channel: amplitude a and width b [degrees^2], section 3.1."""
WIDEST = 0.04
"""The largest of these widths, which sets the radius of all filters [degrees^2]."""
FEATURE = 0.082
"""Width of the detector of edges and points [degrees], section 3.2."""
COLOUR_EXPONENT, FEATURE_EXPONENT = 0.7, 0.5
KNEE, KNEE_VALUE = 0.4, 0.95
"""Share of the largest colour difference up to which the compression takes `KNEE_VALUE` of the range."""

TO_XYZ = (
    (10135552 / 24577794, 8788810 / 24577794, 4435075 / 24577794),
    (2613072 / 12288897, 8788810 / 12288897, 887015 / 12288897),
    (1425312 / 73733382, 8788810 / 73733382, 70074185 / 73733382),
)
"""From linear sRGB to CIE XYZ (D65)."""


@torch.no_grad()
def flip(images: Tensor, others: Tensor, pixels_per_degree: float = PIXELS_PER_DEGREE) -> Tensor:
    """Return the mean ꟻLIP difference of each pair of sRGB images, (B,).

    Args:
        images: Images in [0, 1], (B, 3, H, W).
        others: Images to compare with, (B, 3, H, W).
        pixels_per_degree: Pixels in a degree of the visual field.
    """
    a, b = (_opponent(_linear(t)) for t in (images, others))
    colour = _colour_difference(a, b, pixels_per_degree)
    feature = _feature_difference(a[:, :1], b[:, :1], pixels_per_degree)
    return colour.pow(1 - feature).mean((1, 2))


def _colour_difference(a: Tensor, b: Tensor, pixels_per_degree: float) -> Tensor:
    """Return the compressed colour difference (B, H, W) of images in YCxCz."""
    largest = _distance(*(_perceived(torch.eye(3, dtype=a.dtype, device=a.device)[i].view(1, 3, 1, 1)) for i in (1, 2)))
    largest = float(largest) ** COLOUR_EXPONENT  # green to blue
    seen = (_perceived(_linear_of(_contrast(t, pixels_per_degree)).clamp(0, 1)) for t in (a, b))
    difference = _distance(*seen).pow(COLOUR_EXPONENT)
    knee = KNEE * largest
    beyond = KNEE_VALUE + (difference - knee) / (largest - knee) * (1 - KNEE_VALUE)
    return torch.where(difference < knee, difference * (KNEE_VALUE / knee), beyond)


def _feature_difference(a: Tensor, b: Tensor, pixels_per_degree: float) -> Tensor:
    """Return the difference (B, H, W) of edges and points of the luminances (B, 1, H, W)."""
    parts = [_features((t + 16) / 116, pixels_per_degree) for t in (a, b)]
    larger = torch.stack([(x - y).abs() for x, y in zip(*parts)]).amax(0)
    return (larger / math.sqrt(2)).pow(FEATURE_EXPONENT)


def _features(luminance: Tensor, pixels_per_degree: float) -> tuple[Tensor, Tensor]:
    """Return the strength of edges and of points, (B, H, W) each."""
    H, W = luminance.shape[-2:]
    spread = 0.5 * FEATURE * pixels_per_degree
    blur, slope, bend = ([_filter(n, spread, order, luminance.dtype, luminance.device) for n in (H, W)] for order in range(3))
    edges, points = ((_apply(luminance, blur[0], f[1]), _apply(luminance, f[0], blur[1])) for f in (slope, bend))
    return torch.hypot(*edges)[:, 0], torch.hypot(*points)[:, 0]


def _contrast(image: Tensor, pixels_per_degree: float) -> Tensor:
    """Filter an image in YCxCz (B, 3, H, W) by the contrast sensitivity of the eye."""
    radius = math.ceil(3 * math.sqrt(WIDEST / (2 * math.pi**2)) * pixels_per_degree)
    channels = []
    for channel, gaussians in zip(image.split(1, 1), CONTRAST.values()):
        total, weight = torch.zeros_like(channel), 0.0
        for a, b in gaussians:
            spread = math.sqrt(b / (2 * math.pi**2)) * pixels_per_degree
            sum_1d = sum(math.exp(-0.5 * (i / spread) ** 2) for i in range(-radius, radius + 1))
            own = a * math.sqrt(math.pi / b) * sum_1d**2
            rows, columns = (_filter(n, spread, 0, image.dtype, image.device, radius) for n in image.shape[-2:])
            total, weight = total + own * _apply(channel, rows, columns), weight + own
        channels.append(total / weight)
    return torch.cat(channels, 1)


def _apply(image: Tensor, rows: Tensor, columns: Tensor) -> Tensor:
    return rows @ (image @ columns.mT)


@functools.lru_cache(maxsize=64)
def _filter(size: int, spread: float, order: int, dtype: torch.dtype, device: torch.device, radius: int | None = None) -> Tensor:
    """Return the matrix (size, size) of a Gaussian or its first or second derivative along an axis; the border is repeated.

    The positive weights of a derivative sum to one, and the negative ones to minus one.
    """
    radius = math.ceil(3 * spread) if radius is None else radius
    x = torch.arange(-radius, radius + 1, dtype=torch.float64)
    weights = torch.exp(-0.5 * (x / spread).square()) * (torch.ones_like(x), -x, (x / spread).square() - 1)[order]
    if order:
        weights = torch.where(weights < 0, weights / -weights.clamp(max=0).sum(), weights / weights.clamp(min=0).sum())
    else:
        weights = weights / weights.sum()
    at = (torch.arange(size)[:, None] + x.long()).clamp(0, size - 1)
    with torch.inference_mode(False), torch.no_grad():
        matrix = torch.zeros(size, size, dtype=torch.float64).scatter_add_(1, at, weights.expand(size, -1))
        return matrix.to(device, dtype)


# Colour spaces; images are (B, 3, H, W).


def _matrix(image: Tensor, inverse: bool = False) -> Tensor:
    matrix = torch.tensor(TO_XYZ, dtype=torch.float64)
    return (torch.linalg.inv(matrix) if inverse else matrix).to(image)


def _white(image: Tensor) -> Tensor:
    return _matrix(image).sum(1).view(3, 1, 1)


def _linear(srgb: Tensor) -> Tensor:
    """Convert sRGB to linear RGB."""
    return torch.where(srgb > 0.04045, ((srgb.clamp(min=0) + 0.055) / 1.055).pow(2.4), srgb / 12.92)


def _opponent(linear: Tensor) -> Tensor:
    """Convert linear RGB to YCxCz, in which the contrast sensitivity is given."""
    X, Y, Z = (torch.einsum("ij,bjhw->bihw", _matrix(linear), linear) / _white(linear)).unbind(1)
    return torch.stack([116 * Y - 16, 500 * (X - Y), 200 * (Y - Z)], 1)


def _linear_of(opponent: Tensor) -> Tensor:
    """Convert YCxCz to linear RGB."""
    Y = (opponent[:, 0] + 16) / 116
    XYZ = torch.stack([Y + opponent[:, 1] / 500, Y, Y - opponent[:, 2] / 200], 1) * _white(opponent)
    return torch.einsum("ij,bjhw->bihw", _matrix(opponent, inverse=True), XYZ)


def _perceived(linear: Tensor) -> Tensor:
    """Convert linear RGB to CIELAB with Hunt's adjustment: chroma counts less where it is dark."""
    ratio = torch.einsum("ij,bjhw->bihw", _matrix(linear), linear) / _white(linear)
    limit = 6 / 29
    x, y, z = torch.where(ratio > limit**3, ratio.clamp(min=1e-12).pow(1 / 3), ratio / (3 * limit**2) + 4 / 29).unbind(1)
    L = 116 * y - 16
    return torch.stack([L, 0.01 * L * 500 * (x - y), 0.01 * L * 200 * (y - z)], 1)


def _distance(a: Tensor, b: Tensor) -> Tensor:
    """Return the distance HyAB (B, H, W): the difference of lightness plus that of chroma."""
    return (a[:, 0] - b[:, 0]).abs() + (a[:, 1:] - b[:, 1:]).square().sum(1).sqrt()
