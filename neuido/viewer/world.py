"""The page in the browser (viser): its server, what stands still in it, and points, meshes, arrows and splats that move."""

import contextlib
import io
from typing import Any

import numpy as np

from neuido.errors import UserError
from neuido.physics.runtime.lazy import import_extra
from neuido.types import Plane
from neuido.viewer.content import Content, Motion, Surface
from neuido.viewer.picture import ARROW, COLLIDER, FIELD_OF_VIEW, MEASURED, View, camera_of, frusta
from neuido.viewer.quantities import Quantity, table
from neuido.viewer.shading import grid_step

HOST, PORT = "localhost", 8080
PORTS = (1, 65535)
DOT = 0.55
"""`point_size` relative to the distance of neighbours. viser draws a point about 2.7 times as wide (measured in a picture), so that points
of a lattice overlap by a little more than its diagonal, and a body is closed."""
KEPT_BYTES = 200e6
"""Largest memory of the points that a page keeps [bytes]; a laptop's graphics card shares its memory with the machine."""
POINT_BYTES = 15
"""Memory of a point in the page: three numbers of float32 and a colour [bytes]."""
FLOOR_REACH = 3.0
"""Side of a drawn floor relative to the size of what is shown."""


def open_server(label: str, host: str = HOST, port: int = PORT) -> Any:
    """Start the web server of a page; another port is taken where the given one is in use.

    Args:
        label: Title of the control panel.
        host: Address that it listens at; localhost alone is seen from this machine only.
        port: Port, 1 to 65535.

    Raises:
        UserError: viser is not installed, or there is no such host or port.
    """
    viser = import_extra("viser", "the viewer", extra="viewer")
    if not PORTS[0] <= port <= PORTS[1]:
        raise UserError(f"port is {port}; it must lie between {PORTS[0]} and {PORTS[1]}")
    try:
        with contextlib.redirect_stdout(io.StringIO()):  # viser greets in a box
            server = viser.ViserServer(host=host, port=port, label=label, verbose=False)
    except OSError as error:
        raise UserError(f"the viewer cannot listen at host {host}, port {port}: {error.strerror or error}") from error
    server.gui.configure_theme(show_logo=False, show_share_button=False, brand_color=(60, 110, 175))
    server.gui.main_panel.dock_right()
    return server


def close_server(server: Any) -> None:
    """End a web server, without viser's own words."""
    with contextlib.redirect_stdout(io.StringIO()):
        server.stop()


def address_of(server: Any) -> str:
    """Return the address under which a page is opened."""
    return f"http://{server.get_host()}:{server.get_port()}"


def furnish(server: Any, content: Content) -> dict[str, list[Any]]:
    """Add the objects that do not move (floors, domain, axes, gravity, cameras, lights) and set the first view of the camera.

    Returns:
        The handles of each group, for its check box: `floor`, `domain`, `axes and gravity`, `cameras`.
    """
    scene, up = server.scene, content.up
    scene.configure_default_lights(cast_shadow=False)  # shadows halve the rate without a graphics card
    scene.set_up_direction(tuple(up))
    eye = camera_of(content, View())
    server.initial_camera.position, server.initial_camera.look_at = tuple(eye.centre), tuple(content.middle)
    server.initial_camera.up, server.initial_camera.fov = tuple(up), float(np.radians(FIELD_OF_VIEW + 10.0))
    groups: dict[str, list[Any]] = {"floor": [_floor(scene, content, i, plane) for i, plane in enumerate(content.planes)]}
    if content.domain is not None:
        edges = _box_edges(*content.domain)
        groups["domain"] = [scene.add_line_segments("/domain", edges, (150, 158, 170), thickness=1.0, thickness_units="screen")]
    length = 0.18 * content.size
    corner = content.bounds[0] if content.domain is None else content.domain[0]
    axes = scene.add_frame("/axes", axes_length=length, axes_radius=0.02 * length, origin_radius=0.03 * length, position=tuple(corner))
    groups["axes and gravity"] = [axes]
    if content.gravity is not None and np.any(content.gravity):
        start = content.middle + 0.42 * content.size * up + 0.35 * content.size * _sideways(up)
        ends = np.stack([start, start - length * up])[None].astype(np.float32)
        arrow = _arrows(scene, "/gravity", ends, (90, 96, 108), 0.03 * length)
        strength = float(np.linalg.norm(content.gravity))
        label = scene.add_label("/gravity/label", f"g {strength:.3g} m/s²", position=tuple(start), font_screen_scale=0.8)
        groups["axes and gravity"] += [arrow, label]
    if content.cameras is not None:
        groups["cameras"] = [_frustum(scene, content, i) for i in range(len(content.views))]
    return {name: handles for name, handles in groups.items() if handles}


def _sideways(up: np.ndarray) -> np.ndarray:
    right = np.cross(np.array([0.0, 0.0, 1.0]) if abs(up[2]) < 0.9 else np.array([0.0, 1.0, 0.0]), up)
    return -right / np.linalg.norm(right)


def _floor(scene: Any, content: Content, index: int, plane: Plane) -> Any:
    """Add a plane as a grid around the foot of the middle."""
    normal = np.asarray(plane.normal, float) / np.linalg.norm(plane.normal)
    foot = content.middle - ((content.middle - np.asarray(plane.point, float)) @ normal) * normal
    step = grid_step(content.size)
    side = step * max(2.0, 2.0 * np.ceil(0.5 * FLOOR_REACH * content.size / step))
    return scene.add_grid(
        f"/floor/{index}", side, side, plane="xy", cell_size=step, section_size=5.0 * step, cell_color=(196, 202, 210),
        section_color=(160, 168, 178), plane_color=(226, 230, 236), plane_opacity=0.85, shadow_opacity=0.0,
        wxyz=_turn_from_z(normal), position=tuple(foot - 1e-4 * content.size * normal),
    )  # fmt: skip


def _turn_from_z(normal: np.ndarray) -> tuple[float, float, float, float]:
    """Return the quaternion wxyz that turns +z to a unit vector."""
    w = 1.0 + normal[2]
    if w < 1e-9:
        return (0.0, 1.0, 0.0, 0.0)
    q = np.array([w, -normal[1], normal[0], 0.0])
    return tuple(q / np.linalg.norm(q))


def _box_edges(lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    corners = np.array([[(lower, upper)[(i >> a) & 1][a] for a in range(3)] for i in range(8)])
    return np.array([(corners[i], corners[i | 1 << a]) for i in range(8) for a in range(3) if not i >> a & 1], np.float32)


def _arrows(scene: Any, name: str, ends: np.ndarray, colour: tuple[int, int, int], radius: float) -> Any:
    return scene.add_arrows(name, ends, colour, shaft_radius=radius, head_radius=2.5 * radius, head_length=6.0 * radius)


def _frustum(scene: Any, content: Content, index: int) -> Any:
    cameras = content.cameras
    assert cameras is not None
    viewmat, K = cameras.viewmats[index].double().cpu().numpy(), cameras.Ks[index].double().cpu().numpy()
    rotation = viewmat[:3, :3].T
    return scene.add_camera_frustum(
        f"/cameras/{index}",
        fov=float(2.0 * np.arctan(0.5 * cameras.height / K[1, 1])),
        aspect=cameras.width / cameras.height,
        scale=_frustum_size(content),
        thickness=1.5,
        thickness_units="screen",
        color=(60, 110, 175),
        wxyz=_quaternion(rotation),
        position=tuple(-rotation @ viewmat[:3, 3]),
    )


def _frustum_size(content: Content) -> float:
    """Return the length of the drawn pyramids of cameras [m]: a share of the distance of the nearest from the middle."""
    assert content.cameras is not None
    tips = frusta(content.cameras, 1.0)[::8, 0]
    return 0.16 * float(np.linalg.norm(tips - content.middle, axis=1).min()) or 0.1


def _quaternion(rotation: np.ndarray) -> tuple[float, float, float, float]:
    from scipy.spatial.transform import Rotation

    x, y, z, w = Rotation.from_matrix(rotation).as_quat()
    return float(w), float(x), float(y), float(z)


class Cloud:
    """Points of one motion, or of a state that is simulated, with measured points and arrows where there are any.

    The points of a recorded frame stay in the page, hidden, so that showing the frame again costs no more than making it visible: a browser
    takes longer to take in new points than to draw them.

    Args:
        server: Server of the page.
        name: Name in the tree of the scene.
        spacing: Distance of neighbours [m].
        frames: Number of frames that the page may keep; 0: none.
        points: Number of points of a frame.
    """

    def __init__(self, server: Any, name: str, spacing: float, frames: int = 0, points: int = 0) -> None:
        self.server, self.name, self.spacing, self.scale, self.visible = server, name, spacing, 1.0, True
        self.handle: Any = None
        self.keeps = 1 < frames <= KEPT_BYTES / (POINT_BYTES * max(points, 1))
        self.kept: dict[int, Any] = {}

    def show(self, points: np.ndarray, colours: np.ndarray, factor: float = 1.0, frame: int = 0, hidden: bool = False) -> None:
        """Draw points (N, 3) [m] with colours (N, 3) uint8, in place of those before.

        Args:
            points: Places [m].
            colours: Colours.
            factor: Size of a point relative to the usual one.
            frame: The frame that they belong to.
            hidden: Send them to the page without drawing them yet, where it keeps frames.
        """
        points = points.astype(np.float32)
        if not self.keeps and self.handle is not None and self.handle.points.shape == points.shape:
            self.handle.points, self.handle.colors = points, colours
            self.handle.visible = self.visible
            return
        name = f"/{self.name}/{frame}" if self.keeps else f"/{self.name}"
        added = self.server.scene.add_point_cloud(
            name, points, colours, point_size=self.size(factor), point_shape="circle", precision="float32", point_shading="gradient",
            visible=self.visible and not hidden,
        )  # fmt: skip
        if self.keeps:
            self.kept[frame] = added
        if not hidden:
            self._replace(added)

    def recall(self, frame: int) -> bool:
        """Draw a frame that the page has kept; return whether it has."""
        if frame in self.kept:
            self._replace(self.kept[frame])
        return frame in self.kept

    def _replace(self, handle: Any) -> None:
        if self.keeps and self.handle is not None and self.handle is not handle:
            self.handle.visible = False
        self.handle = handle
        handle.visible = self.visible

    def forget(self) -> None:
        """Remove what the page has kept."""
        for handle in self.kept.values():
            handle.remove()
        if self.kept:
            self.handle = None
        self.kept = {}

    def resize(self, factor: float = 1.0) -> None:
        """Draw the points in the size of `scale`."""
        for handle in self.kept.values() or ([] if self.handle is None else [self.handle]):
            handle.point_size = self.size(factor)

    def size(self, factor: float = 1.0) -> float:
        """Return the `point_size` of a point [m]."""
        return DOT * factor * self.scale * max(self.spacing, 1e-6)


class Drawn:
    """One motion of a content in the page.

    Args:
        server: Server of the page.
        content: What is shown.
        index: Number of the motion.
        keeps: Whether the page may keep the points of its frames. A recorded page must not: when it begins anew, what its last frame showed
            would stay.
    """

    def __init__(self, server: Any, content: Content, index: int, *, keeps: bool = True) -> None:
        self.server, self.content, self.motion, self.index = server, content, content.motions[index], index
        spacing = self.motion.spacing * self.motion.thinning ** (1 / 3) or 0.02 * content.size
        room = content.frames if keeps else 0, sum(motion.x.shape[1] for motion in content.motions)
        self.cloud = Cloud(server, f"motion/{index}/particles", spacing, *room)
        self.measured = Cloud(server, f"motion/{index}/measured", 0.6 * spacing)
        self.quantity = ""
        self.arrows: Any = None
        self.shown = {"arrows": True, "measured": True, "particles": True, "skin": bool(self.motion.skins)}
        self.label: Any = None
        self.meshes: list[Any] = []

    def show(self, frame: int, quantity: str) -> None:
        """Draw a frame with the colours of a quantity."""
        motion = self.motion
        self._choose(quantity)
        self.cloud.visible = self.shown["particles"] and not (self.shown["skin"] and motion.skins)
        if not self.cloud.recall(frame):
            self._send(frame, hidden=False)
        if motion.reference is not None:
            self._show_residual(frame, self._seen(frame))
        for i, skin in enumerate(motion.skins):
            self._show_skin(i, skin, frame, motion.colours(frame, quantity))
        if len(self.content.motions) > 1:
            self._show_name(frame, self._seen(frame))

    def prepare(self, quantity: str) -> bool:
        """Send the first frame that the page lacks, hidden; return whether there was one."""
        self._choose(quantity)
        if not self.cloud.keeps or len(self.cloud.kept) == self.content.frames:
            return False
        self._send(next(k for k in range(self.content.frames) if k not in self.cloud.kept), hidden=True)
        return True

    def _choose(self, quantity: str) -> None:
        if quantity != self.quantity:
            self.cloud.forget()
        self.quantity = quantity

    def _seen(self, frame: int) -> np.ndarray:
        seen = np.isfinite(self.motion.x[frame]).all(axis=1)
        seen[np.arange(len(seen)) % self.motion.thinning > 0] = False
        return seen

    def _send(self, frame: int, hidden: bool) -> None:
        motion, seen = self.motion, self._seen(frame)
        lit = motion.lit(motion.x[frame], motion.colours(frame, self.quantity))
        factor = 0.55 if motion.reference is not None else 1.0
        self.cloud.show(motion.x[frame][seen] + motion.shift, lit[seen], factor, frame, hidden)

    def _show_residual(self, frame: int, seen: np.ndarray) -> None:
        motion = self.motion
        assert motion.reference is not None
        both = seen & np.isfinite(motion.reference[frame]).all(axis=1)
        at = motion.reference[frame][both] + motion.shift
        self.measured.visible = self.shown["measured"]
        self.measured.show(at, np.tile(np.array(MEASURED, np.uint8), (len(at), 1)), 0.55)
        self.measured.handle.visible = self.measured.visible
        ends = np.stack([at, motion.x[frame][both] + motion.shift], axis=1).astype(np.float32)
        name = f"/motion/{self.index}/arrows"
        self.arrows = _arrows(self.server.scene, name, ends, ARROW, 0.05 * self.cloud.spacing)
        self.arrows.visible = self.shown["arrows"]

    def _show_skin(self, i: int, skin: Surface, frame: int, colours: np.ndarray) -> None:
        mesh = coloured_mesh(skin, frame, self.motion, colours)
        handle = self.server.scene.add_mesh_trimesh(f"/motion/{self.index}/skin/{i}", mesh, visible=self.shown["skin"])
        self.meshes = [*self.meshes[:i], handle, *self.meshes[i + 1 :]]

    def _show_name(self, frame: int, seen: np.ndarray) -> None:
        own, up = self.motion.x[frame][seen], self.content.up
        if not len(own):
            return
        middle = own.mean(axis=0)
        place = middle + self.motion.shift + (np.max(own @ up) - middle @ up + 0.08 * self.content.size) * up
        if self.label is None:
            self.label = self.server.scene.add_label(f"/motion/{self.index}/name", self.motion.name, position=tuple(place))
        self.label.position = tuple(place)


def coloured_mesh(skin: Surface, frame: int, motion: Motion, colours: np.ndarray) -> Any:
    """Return a skin as a trimesh whose vertices have the colours of the nearest particles."""
    import trimesh
    from scipy.spatial import KDTree

    points, finite = skin.vertices(frame), np.isfinite(motion.x[frame]).all(axis=1)
    nearest = KDTree(motion.x[frame][finite]).query(points)[1]
    return trimesh.Trimesh(points + motion.shift, skin.faces, vertex_colors=colours[finite][nearest], process=False)


def show_surface(server: Any, index: int, surface: Surface, frame: int, before: Any = None) -> Any:
    """Draw a collider at a frame; `before` is its handle of an earlier frame."""
    points = surface.vertices(frame).astype(np.float32)
    if before is None:
        return server.scene.add_mesh_simple(f"/colliders/{index}", points, surface.faces.astype(np.uint32), color=COLLIDER, side="double")
    before.vertices = points
    return before


def legend_html(quantity: Quantity | None) -> str:
    """Return the legend of a quantity as HTML: title with unit, colours, and the numbers at their ends."""
    if quantity is None:
        return "<div style='padding:0 1em;font-size:.85em'>colours of the bodies</div>"
    title, low, high = quantity.legend()
    colours = ", ".join(f"rgb({r},{g},{b})" for r, g, b in table(quantity.around is not None)[::15])
    return (
        f"<div class='neuido-legend' style='padding:0 1em;font-size:.85em'>{title}"
        f"<div style='height:.8em;border-radius:3px;margin:.25em 0;background:linear-gradient(to right, {colours})'></div>"
        f"<div style='display:flex;justify-content:space-between'><span>{low}</span><span>{high}</span></div></div>"
    )
