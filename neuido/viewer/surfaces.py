"""Depth buffer of spheres and triangles in NumPy, for pictures without a display: each pixel keeps the nearest item and its depth."""

from typing import NamedTuple

import numpy as np

EMPTY = np.uint64(2**64 - 1)
"""Entry of a pixel that nothing covers."""
BATCH = 4_000_000
"""Fragments that are handled at once, which bounds the memory to about 200 MB."""


class Eye(NamedTuple):
    """A camera for drawing: a pinhole, or parallel rays where `focal` is None."""

    rotation: np.ndarray
    """World to camera in OpenCV axes, (3, 3)."""
    centre: np.ndarray
    """Position [m], (3,)."""
    focal: float | None
    """Focal length [px]; None: parallel rays."""
    scale: float
    """Pixels per metre with parallel rays."""
    middle: tuple[float, float]
    """Principal point [px]."""
    width: int
    height: int

    def seen(self, points: np.ndarray) -> np.ndarray:
        """Return points [m] in the axes of the camera, (..., 3)."""
        return (points - self.centre) @ self.rotation.T

    def pixels(self, seen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return pixel coordinates x, y (N, 2) and pixels per metre at the points (N,)."""
        per_metre = np.full(len(seen), self.scale) if self.focal is None else self.focal / np.maximum(seen[:, 2], 1e-9)
        return seen[:, :2] * per_metre[:, None] + np.array(self.middle), per_metre

    def rays(self) -> np.ndarray:
        """Return the directions of a pinhole's pixels in the world, of depth 1, (H, W, 3)."""
        x = (np.arange(self.width) + 0.5 - self.middle[0]) / self.focal
        y = (np.arange(self.height) + 0.5 - self.middle[1]) / self.focal
        grid = np.stack([*np.meshgrid(x, y), np.ones((self.height, self.width))], axis=-1)
        return (grid @ self.rotation).astype(np.float32)


class DepthBuffer:
    """The nearest item of each pixel; items are numbered in the order in which they are drawn.

    Args:
        eye: The camera.
        near: Depth before which nothing is drawn [m].
    """

    def __init__(self, eye: Eye, near: float) -> None:
        self.eye, self.near = eye, near
        self.best = np.full(eye.width * eye.height, EMPTY, np.uint64)
        self.items = 0

    def spheres(self, points: np.ndarray, radius: float) -> None:
        """Draw spheres at points (N, 3) [m]; items are numbered on from `items`."""
        first, self.items = self.items, self.items + len(points)
        seen = self.eye.seen(points)
        place, per_metre = self.eye.pixels(seen)
        size = np.maximum(radius * per_metre, 0.75)  # a sphere is never smaller than a pixel
        inside = (seen[:, 2] > self.near) & np.isfinite(seen).all(axis=1)
        inside &= (place > -size[:, None]).all(axis=1)
        inside &= (place[:, 0] < self.eye.width + size) & (place[:, 1] < self.eye.height + size)
        chosen = np.flatnonzero(inside)
        for reach in np.unique(np.ceil(size[chosen]).astype(int)):
            own = chosen[np.ceil(size[chosen]).astype(int) == reach]
            span = np.arange(-reach, reach + 1)
            offsets = np.stack(np.meshgrid(span, span), axis=-1).reshape(-1, 2)
            offsets = offsets[np.hypot(*(offsets.T)) < reach + 0.75]
            step = max(1, BATCH // len(offsets))
            for i in range(0, len(own), step):
                part = own[i : i + step]
                corner = np.floor(place[part]).astype(np.int32)
                cell = corner[:, None] + offsets[None].astype(np.int32)
                apart = (cell + np.float32(0.5) - place[part].astype(np.float32)[:, None]) / size[part].astype(np.float32)[:, None, None]
                square = apart[..., 0] ** 2 + apart[..., 1] ** 2
                depth = seen[part, 2].astype(np.float32)[:, None] - np.float32(radius) * np.sqrt(np.maximum(1 - square, 0))
                rows = np.broadcast_to((first + part)[:, None], square.shape)
                self._keep(cell[..., 0], cell[..., 1], depth, rows, square <= 1.0)

    def triangles(self, corners: np.ndarray) -> None:
        """Draw triangles (T, 3, 3) [m]; items are numbered on from `items`. Triangles that reach behind the camera are left out."""
        first, self.items = self.items, self.items + len(corners)
        seen = self.eye.seen(corners.reshape(-1, 3))
        place, _ = self.eye.pixels(seen)
        place, depth = place.reshape(-1, 3, 2), seen[:, 2].reshape(-1, 3)
        low = np.floor(place.min(axis=1)).astype(int).clip(0)
        high = np.ceil(place.max(axis=1)).astype(int).clip(max=(self.eye.width, self.eye.height))
        sides = (high - low).clip(0)
        whole = (depth > self.near).all(axis=1) & np.isfinite(place).all(axis=(1, 2))
        counts = np.where(whole, sides[:, 0] * sides[:, 1], 0)
        order = np.flatnonzero(counts)
        ends = np.cumsum(counts[order])
        start = 0
        while start < len(order):
            stop = max(start + 1, int(np.searchsorted(ends, (ends[start - 1] if start else 0) + BATCH, side="right")))
            self._fill(order[start:stop], first, place, depth, low, sides, counts)
            start = stop

    def _fill(self, own, first, place, depth, low, sides, counts) -> None:
        repeated = np.repeat(own, counts[own])
        within = np.arange(len(repeated)) - np.repeat(np.cumsum(counts[own]) - counts[own], counts[own])
        x = low[repeated, 0] + within % sides[repeated, 0]
        y = low[repeated, 1] + within // sides[repeated, 0]
        a, b, c = place[repeated, 0], place[repeated, 1], place[repeated, 2]
        point = np.stack([x + 0.5, y + 0.5], axis=1)
        area = _cross(b - a, c - a)
        with np.errstate(divide="ignore", invalid="ignore"):
            u, v = _cross(c - b, point - b) / area, _cross(a - c, point - c) / area
            w = 1.0 - u - v
            if self.eye.focal is None:
                z = u * depth[repeated, 0] + v * depth[repeated, 1] + w * depth[repeated, 2]
            else:  # 1/z is linear in the image
                z = 1.0 / (u / depth[repeated, 0] + v / depth[repeated, 1] + w / depth[repeated, 2])
        covered = (u >= 0) & (v >= 0) & (w >= 0) & np.isfinite(z)
        self._keep(x, y, z.astype(np.float32), first + repeated, covered)

    def _keep(self, x: np.ndarray, y: np.ndarray, depth: np.ndarray, item: np.ndarray, covered: np.ndarray) -> None:
        covered = covered & (x >= 0) & (x < self.eye.width) & (y >= 0) & (y < self.eye.height) & (depth > self.near)
        pixel = (y[covered].astype(np.int64)) * self.eye.width + x[covered]
        bits = np.ascontiguousarray(depth[covered], np.float32).view(np.uint32).astype(np.uint64)  # ordered as positive floats are
        np.minimum.at(self.best, pixel, (bits << np.uint64(32)) | item[covered].astype(np.uint64))

    def depth(self) -> np.ndarray:
        """Return the depth of each pixel [m], (H, W) float32; infinity where nothing is."""
        bits = (self.best >> np.uint64(32)).astype(np.uint32)
        depth = np.where(self.best == EMPTY, np.float32(np.inf), bits.view(np.float32))
        return depth.reshape(self.eye.height, self.eye.width)

    def item(self) -> np.ndarray:
        """Return the number of the item of each pixel, (H, W) int64; -1 where nothing is."""
        number = (self.best & np.uint64(2**32 - 1)).astype(np.int64)
        return np.where(self.best == EMPTY, -1, number).reshape(self.eye.height, self.eye.width)


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
