"""Tensors that leave the third axis alone, in numpy: matrices (..., 5) as xx, xy, yx, yy, zz, symmetric ones (..., 4).

Symmetric tensors are stored as xx, yy, zz, sqrt(2) xy, so that the sum of the squares is that of the tensor.
"""

from collections.abc import Callable

import numpy as np

ROOT = np.sqrt(2.0)
NEAR = 1e-9
"""Half the difference of two principal values below which an isotropic function is taken as linear between them."""
UNIT = np.array([1.0, 1.0, 1.0, 0.0])
"""The identity, symmetric."""


def trace(a: np.ndarray) -> np.ndarray:
    """Return the trace, (..., 1), of symmetric tensors."""
    return a[..., :3].sum(-1, keepdims=True)


def dev(a: np.ndarray) -> np.ndarray:
    """Return the deviator of symmetric tensors."""
    return a - trace(a) / 3 * UNIT


def matmul(A: np.ndarray, B: np.ndarray) -> np.ndarray:
    """Return the product of matrices."""
    a, b, c, d, z = (A[..., i] for i in range(5))
    e, f, g, h, w = (B[..., i] for i in range(5))
    return np.stack([a * e + b * g, a * f + b * h, c * e + d * g, c * f + d * h, z * w], -1)


def as_matrix(a: np.ndarray) -> np.ndarray:
    """Return symmetric tensors as matrices."""
    xy = a[..., 3] / ROOT
    return np.stack([a[..., 0], xy, xy, a[..., 1], a[..., 2]], -1)


def left_cauchy(F: np.ndarray) -> np.ndarray:
    """Return F F^T, symmetric."""
    a, b, c, d, z = (F[..., i] for i in range(5))
    return np.stack([a * a + b * b, c * c + d * d, z * z, ROOT * (a * c + b * d)], -1)


def right_cauchy(F: np.ndarray) -> np.ndarray:
    """Return F^T F, symmetric."""
    return left_cauchy(F[..., [0, 2, 1, 3, 4]])


def square(a: np.ndarray) -> np.ndarray:
    """Return the square of symmetric tensors."""
    return left_cauchy(as_matrix(a))


def isotropic(a: np.ndarray, f: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """Return the symmetric tensor with the principal values f(a_i) in the axes of a."""
    mean = 0.5 * (a[..., 0] + a[..., 1])
    half = 0.5 * (a[..., 0] - a[..., 1])
    r = np.sqrt(half**2 + 0.5 * a[..., 3] ** 2)
    gap = np.maximum(r, NEAR)
    high, low = f(mean + gap), f(mean - gap)
    middle, slope = 0.5 * (high + low), 0.5 * (high - low) / gap
    return np.stack([middle + slope * half, middle - slope * half, f(a[..., 2]), slope * a[..., 3]], -1)


def turned(a: np.ndarray, sine: np.ndarray, cosine: np.ndarray) -> np.ndarray:
    """Return R a R^T of symmetric tensors with the rotation R = [[cosine, sine], [-sine, cosine]] of the first two axes."""
    x, y, z, xy = (a[..., i] for i in range(4))
    cc, ss, cs = cosine**2, sine**2, sine * cosine
    return np.stack([cc * x + ss * y + ROOT * cs * xy, ss * x + cc * y - ROOT * cs * xy, z, (cc - ss) * xy + ROOT * cs * (y - x)], -1)
