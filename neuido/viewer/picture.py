"""One picture of a content at a frame: particles, skins or splats, floors, arrows and cameras, with the legend and the time."""

from typing import Any, NamedTuple

import numpy as np

from neuido.errors import UserError
from neuido.types import Cameras
from neuido.viewer.content import Content, Motion, Surface, camera_centres
from neuido.viewer.shading import Backdrop, Shape, draw
from neuido.viewer.surfaces import Eye

OVERSAMPLING = 2
"""Samples a pixel in each direction, against jagged edges."""
RADIUS = 0.62
"""Radius of a particle's sphere relative to the distance of its neighbours: neighbours overlap, so that a body is closed."""
MEASURED, ARROW, INK = (72, 78, 88), (205, 55, 40), (40, 44, 52)
"""Colours of measured points, of arrows and of text [RGB]."""
COLLIDER = (150, 156, 166)
DIRECTION = (0.62, 0.38, 0.95)
"""Where the camera stands by default, from the middle: right, up and front."""
FIELD_OF_VIEW = 35.0
"""Vertical field of view by default [degrees]."""
MARGIN = 0.92
"""Share of the picture that what is shown fills by default."""


class View(NamedTuple):
    """Where a picture is taken from, and its size."""

    eye: tuple[float, float, float] | None = None
    """Position of the camera [m]; None: where everything is in the picture."""
    look_at: tuple[float, float, float] | None = None
    """Point in the middle of the picture [m]; None: the middle of what is shown."""
    fov: float = FIELD_OF_VIEW
    """Vertical field of view [degrees]."""
    width: int = 800
    height: int = 600
    camera: str | None = None
    """Name of a camera of the recording, in place of `eye`."""


def camera_of(content: Content, view: View, scale: int = 1) -> Eye:
    """Return the camera for a content.

    Args:
        content: What is shown.
        view: What was asked for.
        scale: Factor on the size of the picture.

    Raises:
        UserError: A field of view outside 1 to 170 degrees, a camera in its target, an unknown name of a camera, or a size below 16 px.
    """
    if min(view.width, view.height) < 16:
        raise UserError(f"width and height are {view.width} and {view.height}; a picture has at least 16 pixels a side")
    if not 1.0 <= view.fov <= 170.0:
        raise UserError(f"fov is {view.fov:g}; it must lie between 1 and 170 degrees")
    width, height = scale * view.width, scale * view.height
    if view.camera is not None:
        return _recorded(content, view.camera, width, height)
    up = content.up
    target = content.middle if view.look_at is None else np.array(view.look_at, float)
    focal = 0.5 * height / np.tan(np.radians(view.fov) / 2)
    if view.eye is not None:
        return _looking(np.array(view.eye, float), target, up, focal, width, height)
    right, front = _horizontal(up)
    direction = DIRECTION[0] * right + DIRECTION[1] * up + DIRECTION[2] * front
    direction /= np.linalg.norm(direction)
    low, high = content.bounds
    corners = np.stack(np.meshgrid(*zip(low, high)), axis=-1).reshape(-1, 3)
    if content.cameras is not None:
        corners = np.concatenate([corners, camera_centres(content.cameras)])
    near, far = 0.6 * content.size, 60.0 * content.size
    for _ in range(40):  # the nearest distance from which all corners are in the picture
        distance = (near * far) ** 0.5
        eye = _looking(target + distance * direction, target, up, focal, width, height)
        seen = eye.seen(corners)
        place = eye.pixels(seen)[0] / np.array([width, height]) - 0.5
        fits = (seen[:, 2] > 0).all() and np.abs(place).max() < 0.5 * MARGIN
        near, far = (near, distance) if fits else (distance, far)
    return _looking(target + far * direction, target, up, focal, width, height)


def _horizontal(up: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return two horizontal axes: right and front, x and z where +y is up."""
    right = np.array([1.0, 0.0, 0.0]) if abs(up[0]) < 0.9 else np.array([0.0, 1.0, 0.0])
    right = right - (right @ up) * up
    right /= np.linalg.norm(right)
    return right, np.cross(right, up)


def _looking(position: np.ndarray, target: np.ndarray, up: np.ndarray, focal: float, width: int, height: int) -> Eye:
    forward = target - position
    length = float(np.linalg.norm(forward))
    right = np.cross(forward, up)
    if length == 0 or np.linalg.norm(right) < 1e-9 * length:
        raise UserError(f"a camera at {position.tolist()} cannot look at {target.tolist()}: it is there, or right above or below")
    forward, right = forward / length, right / np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    return Eye(rotation, position, focal, 1.0, (width / 2, height / 2), width, height)


def _recorded(content: Content, name: str, width: int, height: int) -> Eye:
    if content.cameras is None:
        raise UserError(f"camera = {name!r}: {content.title} has no cameras; give eye and look_at")
    if name not in content.views:
        raise UserError(f"camera = {name!r} is none of {', '.join(content.views)}")
    own = content.views.index(name)
    K = content.cameras.Ks[own].double().cpu().numpy()
    ratio = height / content.cameras.height
    rotation = content.cameras.viewmats[own, :3, :3].double().cpu().numpy()
    middle = width / 2 + ratio * (K[0, 2] - content.cameras.width / 2), ratio * K[1, 2]
    return Eye(rotation, camera_centres(content.cameras)[own], ratio * K[1, 1], 1.0, middle, width, height)


class Painter:
    """Pictures of a content from one camera.

    Args:
        content: What is shown.
        quantity: Name of the quantity by which particles are coloured.
        view: Camera and size.
        legend: Whether the legend, the time and the names of panels are written.
    """

    def __init__(self, content: Content, quantity: str, view: View, *, legend: bool = True) -> None:
        self.content, self.quantity, self.view, self.legend = content, quantity, view, legend
        self.eye = camera_of(content, view, OVERSAMPLING)
        self.shown = content.quantity(quantity)
        self.backdrop = Backdrop(self.eye, content.planes, content.middle, content.size, content.up)

    def picture(self, frame: int) -> np.ndarray:
        """Return the picture of a frame, (H, W, 3) uint8."""
        from PIL import Image, ImageDraw

        shapes, lines = shapes_of(self.content, frame, self.quantity)
        image = draw(shapes, self.backdrop)
        if self.content.gaussians:
            image = _with_splats(self.content, frame, self.eye, image)
        drawn = Image.fromarray(image.round().astype(np.uint8))
        _draw_lines(ImageDraw.Draw(drawn), self.eye, lines)
        small = drawn.resize((self.view.width, self.view.height), Image.Resampling.BOX)
        if self.legend:
            _write(ImageDraw.Draw(small), self.content, frame, self.shown, self.eye, self.view)
        return np.asarray(small)


class Lines(NamedTuple):
    """Line segments (N, 2, 3) [m] of one colour and width [px]; with a head if they are arrows."""

    ends: np.ndarray
    colour: tuple[int, int, int]
    width: float = 1.5
    arrows: bool = False


def shapes_of(content: Content, frame: int, quantity: str) -> tuple[list[Shape], list[Lines]]:
    """Return spheres, meshes and lines of a frame."""
    shapes: list[Shape] = []
    lines: list[Lines] = []
    for motion in content.motions:
        colours = motion.colours(frame, quantity)
        for skin in motion.skins:
            shapes.append(_mesh(skin, frame, motion, colours))
        x, seen = motion.x[frame], np.isfinite(motion.x[frame]).all(axis=1)
        radius = RADIUS * motion.spacing or 0.01 * content.size
        if motion.reference is not None:
            radius *= 0.55  # arrows need room
            measured = motion.reference[frame]
            both = seen & np.isfinite(measured).all(axis=1)
            shapes.append(Shape(measured[both] + motion.shift, np.tile(np.array(MEASURED, np.uint8), (both.sum(), 1)), 0.8 * radius))
            lines.append(Lines(np.stack([measured[both], x[both]], axis=1) + motion.shift, ARROW, 2.0, arrows=True))
        if not motion.skins:
            shapes.append(Shape(x[seen] + motion.shift, colours[seen], radius))
    for surface in content.surfaces:
        points = surface.vertices(frame)
        shapes.append(Shape(points, np.tile(np.array(COLLIDER, np.uint8), (len(points), 1)), faces=surface.faces))
    if content.cameras is not None:
        lines.append(Lines(frusta(content.cameras, 0.25 * content.size), (70, 110, 170)))
    return [shape for shape in shapes if len(shape.points)], lines


def _mesh(skin: Surface, frame: int, motion: Motion, colours: np.ndarray) -> Shape:
    """Return a skin whose vertices have the colours of the nearest particles."""
    from scipy.spatial import KDTree

    points = skin.vertices(frame)
    finite = np.isfinite(motion.x[frame]).all(axis=1)
    nearest = KDTree(motion.x[frame][finite]).query(points)[1]
    return Shape(points + motion.shift, colours[finite][nearest], faces=skin.faces)


def frusta(cameras: Cameras, length: float) -> np.ndarray:
    """Return the edges of the pyramids of cameras, (8 V, 2, 3) [m]."""
    edges = []
    for viewmat, K in zip(cameras.viewmats.double().cpu().numpy(), cameras.Ks.double().cpu().numpy()):
        corners = np.array([(i * cameras.width, j * cameras.height, 1.0) for i, j in ((0, 0), (1, 0), (1, 1), (0, 1))])
        local = length * (corners @ np.linalg.inv(K).T)
        world = (local - viewmat[:3, 3]) @ viewmat[:3, :3]
        centre = -viewmat[:3, :3].T @ viewmat[:3, 3]
        edges += [(centre, corner) for corner in world] + [(world[i], world[(i + 1) % 4]) for i in range(4)]
    return np.array(edges)


def _with_splats(content: Content, frame: int, eye: Eye, image: np.ndarray) -> np.ndarray:
    """Draw the Gaussians of a frame over a picture."""
    import torch

    from neuido.models.render.splatting import render

    own = content.gaussians[min(frame, len(content.gaussians) - 1)]
    viewmat = np.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = eye.rotation, -eye.rotation @ eye.centre
    K = np.array([[eye.focal, 0, eye.middle[0]], [0, eye.focal, eye.middle[1]], [0, 0, 1.0]])
    cameras = Cameras(torch.from_numpy(viewmat[None]).float(), torch.from_numpy(K[None]).float(), eye.width, eye.height)
    with torch.no_grad():
        found, alpha = render(own, cameras)
    return 255.0 * found[0].clamp(0, 1).numpy() + (1.0 - alpha[0, ..., None].numpy()) * image


def _draw_lines(pen: Any, eye: Eye, lines: list[Lines]) -> None:
    for each in lines:
        if not len(each.ends):
            continue
        seen = eye.seen(each.ends.reshape(-1, 3))
        place = eye.pixels(seen)[0].reshape(-1, 2, 2)
        before = (seen[:, 2] > 0).reshape(-1, 2).all(axis=1)
        for (start, end), visible in zip(place, before):
            if not visible:
                continue
            pen.line([*start, *end], fill=each.colour, width=round(OVERSAMPLING * each.width))
            along = end - start
            length = float(np.hypot(*along))
            if each.arrows and length > 3 * OVERSAMPLING:
                back = along / length * min(4.0 * OVERSAMPLING, 0.5 * length)
                across = 0.5 * np.array([-back[1], back[0]])
                pen.polygon([*end, *(end - back + across), *(end - back - across)], fill=each.colour)


def _write(pen: Any, content: Content, frame: int, shown: Any, eye: Eye, view: View) -> None:
    """Write the time, the names of several panels and the legend."""
    from PIL import ImageFont

    unit = max(11, round(min(view.width, view.height) / 38))
    font = ImageFont.load_default(size=unit)
    pad = unit
    if content.frames > 1:
        pen.text((pad, pad), content.words(frame), fill=INK, font=font)
    if len(content.motions) > 1:
        low, high = content.bounds
        for motion in content.motions:
            own = motion.x[frame][np.isfinite(motion.x[frame]).all(axis=1)]
            if len(own):
                top = own.mean(axis=0) + motion.shift
                top += (np.max(own @ content.up) - own.mean(axis=0) @ content.up + 0.06 * content.size) * content.up
                place = eye.pixels(eye.seen(top[None]))[0][0] / OVERSAMPLING
                pen.text(tuple(place), motion.name, fill=INK, font=font, anchor="mb")
    if shown is None:
        return
    from neuido.viewer.quantities import table

    title, low, high = shown.legend()
    width, thick = max(90, view.width // 4), max(6, unit // 2)
    left, top = view.width - pad - width, view.height - pad - thick - round(1.4 * unit)
    for i in range(width):
        colour = tuple(int(c) for c in table(shown.around is not None)[int(255 * i / (width - 1))])
        pen.line([left + i, top, left + i, top + thick], fill=colour)
    pen.text((left, top - round(0.35 * unit)), title, fill=INK, font=font, anchor="lb")
    pen.text((left, top + thick + round(0.25 * unit)), low, fill=INK, font=font, anchor="lt")
    pen.text((left + width, top + thick + round(0.25 * unit)), high, fill=INK, font=font, anchor="rt")
