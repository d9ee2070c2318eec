"""Pictures of a frame without a display: lit spheres, meshes, planes with a grid, shadows and arrows, drawn in NumPy."""

from typing import NamedTuple

import numpy as np

from neuido.types import Plane
from neuido.viewer.surfaces import DepthBuffer, Eye

LIGHT = np.array([-0.55, 1.0, 0.25]) / np.linalg.norm([-0.55, 1.0, 0.25])
"""Direction towards the light where +y is up."""
AMBIENT, DIFFUSE, SHINE = 0.48, 0.58, 0.12
SHADOW, FLOOR_SHADOW = 0.55, 0.42
"""Share of the direct light that a shadow takes from a body, and of all light that it takes from a floor."""
MAP = 768
"""Side of the shadow map [px]."""
TAPS = ((-0.9, -0.4), (0.4, -0.9), (0.9, 0.4), (-0.4, 0.9))
"""Shifts [px] of the looks into the shadow map, whose mean softens the edges."""
PAPER_TOP, PAPER_BOTTOM = (244, 246, 249), (222, 227, 234)
"""Background, top and bottom [RGB]."""
CREASE = 0.87
"""Cosine of the angle between the normals of a face and of its corner, 30 degrees, above which an edge is drawn sharp."""
FLOOR, LINE = (206, 211, 218), (172, 179, 189)
FADE = 2.6
"""Distance from the middle at which a floor has faded into the background, relative to the size of what is shown."""


class Shape(NamedTuple):
    """What is drawn: spheres where `faces` is None, else a mesh."""

    points: np.ndarray
    """Centres or vertices [m], (N, 3)."""
    colours: np.ndarray
    """Colour of each point, (N, 3) uint8."""
    radius: float = 0.0
    """Radius of the spheres [m]."""
    faces: np.ndarray | None = None


class Backdrop:
    """Background and floors of a camera that stands still, without shadows; made once for all frames.

    Args:
        eye: The camera.
        planes: Half-spaces; those that face the camera are drawn.
        middle: Middle of what is shown [m], around which floors are drawn.
        size: Size of what is shown [m].
        up: Upward direction, (3,).
    """

    def __init__(self, eye: Eye, planes: tuple[Plane, ...], middle: np.ndarray, size: float, up: np.ndarray) -> None:
        self.eye, self.middle, self.size, self.up = eye, middle, size, up
        self.light, self.rays = _towards_light(up), eye.rays()
        rise = np.linspace(0.0, 1.0, eye.height, dtype=np.float32)[:, None, None]
        paper = (1 - rise) * np.array(PAPER_TOP, np.float32) + rise * np.array(PAPER_BOTTOM, np.float32)
        self.image = np.broadcast_to(paper, (eye.height, eye.width, 3)).reshape(-1, 3).copy()
        self.floor = np.full(eye.height * eye.width, np.inf, np.float32)
        self.strength = np.zeros(eye.height * eye.width, np.float32)
        for plane in planes:
            self._add(np.asarray(plane.point, float), np.asarray(plane.normal, float) / np.linalg.norm(plane.normal))
        self.pixels = np.flatnonzero(self.strength)
        self.places = eye.centre + self.rays.reshape(-1, 3)[self.pixels] * self.floor[self.pixels, None]

    def _add(self, point: np.ndarray, normal: np.ndarray) -> None:
        """Draw a plane with its grid, which fades with the distance from the middle."""
        eye, rays = self.eye, self.rays.reshape(-1, 3)
        slope = rays @ normal.astype(np.float32)
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = np.float32((point - eye.centre) @ normal) / slope
        chosen = np.flatnonzero((slope < 0) & (depth > 0) & (depth < self.floor))
        foot = self.middle - ((self.middle - point) @ normal) * normal
        place = eye.centre + rays[chosen] * depth[chosen, None]
        far = np.linalg.norm(place - foot, axis=1) / (FADE * max(self.size, 1e-9))
        near = far < 1.0
        chosen, place, far = chosen[near], place[near], far[near]
        if not len(chosen):
            return
        share = (np.clip((1.0 - far) / 0.55, 0.0, 1.0) ** 1.5).astype(np.float32)
        colour = _grid(place, normal, self.size, depth[chosen] / (eye.focal or 1.0))
        self.image[chosen] = share[:, None] * colour + (1 - share[:, None]) * self.image[chosen]
        shown = share > 0.02
        self.floor[chosen[shown]], self.strength[chosen[shown]] = depth[chosen[shown]], share[shown]


def draw(shapes: list[Shape], backdrop: Backdrop) -> np.ndarray:
    """Draw shapes over floors and a plain background.

    Args:
        shapes: Spheres and meshes.
        backdrop: The background, with the camera.

    Returns:
        The picture, (H, W, 3) float32 in 0..255.
    """
    eye, light = backdrop.eye, backdrop.light
    buffer = DepthBuffer(eye, near=1e-3 * backdrop.size)
    _fill(buffer, shapes)
    shadows = _ShadowMap(shapes, light, backdrop.middle, backdrop.size)
    image = backdrop.image.copy()
    dark = 1.0 - FLOOR_SHADOW * backdrop.strength[backdrop.pixels] * shadows.at(backdrop.places)
    image[backdrop.pixels] *= dark[:, None]
    depth, item = buffer.depth().reshape(-1), buffer.item().reshape(-1)
    hit = np.flatnonzero((item >= 0) & (depth < backdrop.floor))
    if len(hit):
        rays = backdrop.rays.reshape(-1, 3)[hit]
        place = eye.centre + rays * depth[hit][:, None]
        normal, colour, bias = _surface(shapes, item[hit], place)
        normal[np.sum(normal * rays, axis=1) > 0] *= -1
        facing = np.maximum(normal @ light, 0.0) * (1.0 - SHADOW * shadows.at(place + bias[:, None] * normal))
        halfway = light - rays / np.linalg.norm(rays, axis=1, keepdims=True)
        halfway /= np.linalg.norm(halfway, axis=1, keepdims=True)
        shine = np.maximum(np.sum(normal * halfway, axis=1), 0.0) ** 24
        brightness = AMBIENT * (0.85 + 0.15 * (normal @ backdrop.up)) + DIFFUSE * facing
        image[hit] = colour * brightness[:, None] + 255.0 * SHINE * (shine * facing)[:, None]
    return np.clip(image, 0, 255).reshape(eye.height, eye.width, 3)


def _towards_light(up: np.ndarray) -> np.ndarray:
    """Return the direction towards the light for an upward direction: `LIGHT`, turned with it."""
    side = np.eye(3)[int(np.argmin(np.abs(up)))]
    right = np.cross(up, side) if abs(up[1]) < 0.9 else np.array([1.0, 0.0, 0.0])
    right = right / np.linalg.norm(right)
    front = np.cross(right, up)
    return LIGHT[0] * right + LIGHT[1] * up + LIGHT[2] * front


def _fill(buffer: DepthBuffer, shapes: list[Shape]) -> None:
    for shape in shapes:
        if shape.faces is None:
            buffer.spheres(shape.points, shape.radius)
        else:
            buffer.triangles(shape.points[shape.faces])


def _surface(shapes: list[Shape], item: np.ndarray, place: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return normals, colours and the distance [m] that keeps a surface out of its own shadow, for drawn pixels."""
    normal, colour, bias = np.zeros((len(item), 3)), np.zeros((len(item), 3)), np.zeros(len(item))
    first = 0
    for shape in shapes:
        count = len(shape.points) if shape.faces is None else len(shape.faces)
        own = (item >= first) & (item < first + count)
        index = item[own] - first
        if shape.faces is None:
            normal[own] = (place[own] - shape.points[index]) / max(shape.radius, 1e-12)
            colour[own], bias[own] = shape.colours[index], 0.8 * shape.radius
        elif len(index):
            corners = shape.points[shape.faces[index]]
            weights = _barycentric(place[own], corners)
            normal[own] = np.einsum("nk,nkc->nc", weights, _corner_normals(shape.points, shape.faces, index))
            colour[own] = np.einsum("nk,nkc->nc", weights, shape.colours[shape.faces[index]].astype(float))
            bias[own] = 0.5 * float(np.median(np.linalg.norm(corners[:, 1] - corners[:, 0], axis=1)))
        first += count
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    return normal / np.maximum(length, 1e-12), colour, bias


def _corner_normals(points: np.ndarray, faces: np.ndarray, index: np.ndarray) -> np.ndarray:
    """Return the normals at the corners of some faces, (N, 3, 3): smooth, but those of the face itself at a sharp edge."""
    corners = points[faces[index]].astype(np.float64)
    own = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    own = (own / np.maximum(np.linalg.norm(own, axis=1, keepdims=True), 1e-30))[:, None]
    smooth = vertex_normals(points, faces)[faces[index]]
    return np.where(np.sum(own * smooth, axis=2, keepdims=True) > CREASE, smooth, own)


def vertex_normals(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return the normals of vertices, weighted by the areas of their faces, (V, 3), not normalised."""
    corners = points[faces].astype(np.float64)
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    out = np.zeros((len(points), 3))
    for k in range(3):
        np.add.at(out, faces[:, k], across)
    return out / np.maximum(np.linalg.norm(out, axis=1, keepdims=True), 1e-30)


def _barycentric(place: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Return the weights (N, 3) of the corners (N, 3, 3) at points of their triangles (N, 3)."""
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    p = place - corners[:, 0]
    aa, ab, bb, pa, pb = (np.sum(u * v, axis=1) for u, v in ((a, a), (a, b), (b, b), (p, a), (p, b)))
    whole = np.maximum(aa * bb - ab * ab, 1e-30)
    v, w = np.clip((bb * pa - ab * pb) / whole, 0, 1), np.clip((aa * pb - ab * pa) / whole, 0, 1)
    return np.stack([np.clip(1 - v - w, 0, 1), v, w], axis=1)


class _ShadowMap:
    """Depth of the shapes seen from the light, with parallel rays."""

    def __init__(self, shapes: list[Shape], light: np.ndarray, middle: np.ndarray, size: float) -> None:
        side = np.eye(3)[int(np.argmin(np.abs(light)))]
        right = np.cross(light, side)
        right /= np.linalg.norm(right)
        rotation = np.stack([right, np.cross(-light, right), -light])
        reach = 1.3 * max(size, 1e-9)
        self.eye = Eye(rotation, middle + 2.0 * reach * light, None, MAP / reach, (MAP / 2, MAP / 2), MAP, MAP)
        buffer = DepthBuffer(self.eye, near=0.0)
        _fill(buffer, shapes)
        self.depth, self.slack = buffer.depth(), 2.5 * reach / MAP
        rows, columns = np.nonzero(np.isfinite(self.depth))
        self.box = (np.array([columns.min(), rows.min()]), np.array([columns.max(), rows.max()])) if len(rows) else None

    def at(self, points: np.ndarray) -> np.ndarray:
        """Return how much of the light is kept from points (N, 3): 0 lit, 1 in shadow; softened over neighbouring pixels."""
        out = np.zeros(len(points), np.float32)
        if self.box is None:
            return out
        seen = self.eye.seen(points)
        place, _ = self.eye.pixels(seen)
        near = np.flatnonzero(((place > self.box[0] - 3) & (place < self.box[1] + 3)).all(axis=1))
        place, limit = place[near], seen[near, 2] - self.slack
        for shift in TAPS:
            column, row = np.floor(place + shift).astype(np.int32).clip(0, MAP - 1).T
            out[near] += self.depth[row, column] < limit
        return out / len(TAPS)


def grid_step(size: float) -> float:
    """Return the distance of a floor's lines [m]: 1, 2 or 5 times a power of ten, about a tenth of a size."""
    wanted = max(size, 1e-9) / 8.0
    power = 10.0 ** np.floor(np.log10(wanted))
    return float(power * next(each for each in (1.0, 2.0, 5.0, 10.0) if each * power >= 0.999 * wanted))


def _grid(place: np.ndarray, normal: np.ndarray, size: float, pixel: np.ndarray) -> np.ndarray:
    """Return the colours of points of a floor (N, 3) with lines at even distances; `pixel` is the width of a pixel there [m], (N,)."""
    step = grid_step(size)
    a = np.cross(normal, np.eye(3)[int(np.argmin(np.abs(normal)))])
    a /= np.linalg.norm(a)
    line = np.zeros(len(place))
    for axis in (a, np.cross(normal, a)):
        along = place @ axis / step
        distance = np.abs(along - np.round(along)) * step
        line = np.maximum(line, np.clip(1.5 - distance / np.maximum(0.9 * pixel, 0.0022 * step), 0, 1))
    return np.array(FLOOR) * (1 - line[:, None]) + np.array(LINE) * line[:, None]
