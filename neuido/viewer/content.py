"""What there is to look at: motions of particles, skins, colliders, cameras and Gaussians, in one form for page, picture and notebook."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from neuido.types import Cameras, Gaussians, Plane, Scene
from neuido.viewer.quantities import Quantity, quantities_of

PLAIN = "body"
"""Name of the colouring by body, without a quantity."""
BODY_COLOURS = ((86, 156, 214), (230, 145, 56), (106, 168, 79), (194, 86, 110), (142, 124, 195), (118, 118, 118))
"""Colours of bodies, in turn [RGB]."""
RELIEF_NEIGHBOURS, RELIEF, GLOSS = 16, 0.3, 110.0
"""Neighbours from which the side that a particle shows to the outside is taken, by which share its brightness changes, and by how much
at the same time where it is dark [of 255]."""
SKY = np.array([-0.35, 0.85, 0.4])
"""Direction towards the light of that relief, for +y up."""
GAP = 0.35
"""Gap between panels side by side, relative to the width of one."""
LARGE = 2.5
"""Size of a collider relative to the motion above which it is background, and need not be in the picture as a whole."""
FEW_SAMPLED = 4000
"""Particles from which the distance to the nearest neighbour is taken."""


class Surface(NamedTuple):
    """A triangle mesh that moves with the frames: the skin of a body, or a collider."""

    name: str
    faces: np.ndarray
    """Indices of vertices, (T, 3)."""
    vertices: Callable[[int], np.ndarray]
    """Function of a frame's index that returns the vertices [m], (V, 3)."""


@dataclass(eq=False)
class Motion:
    """A motion of points: K frames of P particles.

    Args:
        name: What it is: "simulated", "measured", "before".
        times: Times of the frames [s], (K,); their numbers where `timed` is False.
        x: Position [m], (K, P, 3); NaN where a point was not seen.
        v: Velocity [m/s], (K, P, 3).
        F: Elastic deformation gradient [-], (K, P, 3, 3).
        stress: Function from F (P, 3, 3) to the Kirchhoff stress [Pa].
        reference: Positions that x is compared with [m], (K, P, 3): arrows lead from there to x.
        body: Index of each particle's body, (P,); None: one body.
        skins: Meshes that are bound to the particles.
        shift: Where the panel of this motion stands relative to the world [m], (3,).
        thinning: Draw every so many particles as a point.
    """

    name: str
    times: np.ndarray
    x: np.ndarray
    v: np.ndarray | None = None
    F: np.ndarray | None = None
    stress: Callable[[np.ndarray], np.ndarray] | None = None
    reference: np.ndarray | None = None
    body: np.ndarray | None = None
    skins: tuple[Surface, ...] = ()
    shift: np.ndarray = field(default_factory=lambda: np.zeros(3))
    thinning: int = 1

    @cached_property
    def quantities(self) -> dict[str, Quantity]:
        """The quantities by which the particles can be coloured, by name."""
        return quantities_of(self.times, self.x, self.v, self.F, stress=self.stress, reference=self.reference)

    def colours(self, frame: int, quantity: str) -> np.ndarray:
        """Return the colour of each particle, (P, 3) uint8; of the bodies where the motion lacks the quantity."""
        found = self.quantities.get(quantity)
        if found is not None:
            return found.colours(frame)
        body = np.zeros(self.x.shape[1], int) if self.body is None else self.body
        return np.array(BODY_COLOURS, np.uint8)[body % len(BODY_COLOURS)]

    @cached_property
    def _neighbours(self) -> np.ndarray:
        from scipy.spatial import KDTree

        points = np.where(np.isfinite(self.x[0]), self.x[0], 0.0)
        return np.asarray(KDTree(points).query(points, k=min(RELIEF_NEIGHBOURS, len(points)))[1]).reshape(len(points), -1)

    def lit(self, x: np.ndarray, colours: np.ndarray) -> np.ndarray:
        """Return colours with a relief, (P, 3) uint8, for points that are drawn without light.

        A particle at the surface lies apart from the mean of its neighbours, away from the body; those inside stay as they are.
        """
        if self.x.shape[1] <= RELIEF_NEIGHBOURS or not self.spacing:
            return colours
        outwards = (x - x[self._neighbours].mean(axis=1)) @ SKY.astype(x.dtype) / self.spacing
        outwards = np.where(np.isfinite(outwards), outwards, 0.0)  # a particle without a place is not drawn
        light = RELIEF * np.clip(outwards, -1.0, 1.0)[:, None]
        return np.clip(colours * (1.0 + light) + GLOSS * light, 0, 255).astype(np.uint8)

    @cached_property
    def spacing(self) -> float:
        """Typical distance between neighbouring particles in the first frame [m]."""
        from scipy.spatial import KDTree

        points = self.x[0][np.isfinite(self.x[0]).all(axis=1)]
        if len(points) < 2:
            return 0.0
        asked = points[:: max(1, len(points) // FEW_SAMPLED)]
        return float(np.median(np.asarray(KDTree(points).query(asked, k=2)[0])[:, 1]))


@dataclass(eq=False)
class Content:
    """All that a page or a picture shows.

    Args:
        title: Name of the whole.
        motions: Motions, one panel each; all have the same frames.
        gravity: Acceleration of gravity [m/s^2].
        planes: Half-spaces that carry the matter.
        domain: Lower and upper corner of the simulated domain [m].
        surfaces: Colliders with a mesh.
        cameras: Cameras of a recording.
        views: Names of the cameras.
        images: images[v][t]: file of view v and frame t; None where there is none.
        gaussians: Gaussians of each frame; one entry: they stand still.
        times: Times of the frames [s], (K,).
        timed: Whether `times` are seconds; False: numbers of frames.
        notes: Remarks for the reader, a line each.
    """

    title: str
    motions: list[Motion] = field(default_factory=list)
    gravity: tuple[float, float, float] | None = None
    planes: tuple[Plane, ...] = ()
    domain: tuple[np.ndarray, np.ndarray] | None = None
    surfaces: tuple[Surface, ...] = ()
    cameras: Cameras | None = None
    views: tuple[str, ...] = ()
    images: tuple[tuple[Path | None, ...], ...] = ()
    gaussians: Sequence[Gaussians] = ()
    times: np.ndarray = field(default_factory=lambda: np.zeros(1))
    timed: bool = True
    notes: list[str] = field(default_factory=list)

    @property
    def frames(self) -> int:
        """Number of frames."""
        return len(self.times)

    @cached_property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper corner of everything that moves [m], in the first, middle and last frames and those between."""
        parts = []
        for motion in self.motions:
            few = motion.x[np.unique(np.linspace(0, len(motion.x) - 1, min(len(motion.x), 24)).astype(int))]
            parts.append(few[np.isfinite(few).all(axis=-1)] + motion.shift)
        for one in self.gaussians[:: max(1, len(self.gaussians) // 8)]:
            means = one.means.detach().cpu().numpy()
            parts.append(np.quantile(means, (0.02, 0.98), axis=0))  # splats of a room have floaters far away
        parts = [part for part in parts if len(part)]
        if not parts:
            eyes = camera_centres(self.cameras) if self.cameras is not None else np.zeros((1, 3))
            parts = [eyes]
        every = np.concatenate([part.reshape(-1, 3) for part in parts]).astype(np.float64)
        low, high = every.min(axis=0), every.max(axis=0)
        for surface in self.surfaces:
            points = np.concatenate([surface.vertices(0), surface.vertices(self.frames - 1)])
            if np.ptp(points, axis=0).max() < LARGE * (high - low).max():
                low, high = np.minimum(low, points.min(axis=0)), np.maximum(high, points.max(axis=0))
        pad = 0.02 * max(float((high - low).max()), 1e-6)
        return low - pad, high + pad

    @property
    def middle(self) -> np.ndarray:
        """Middle of `bounds` [m], (3,)."""
        return (self.bounds[0] + self.bounds[1]) / 2

    @property
    def size(self) -> float:
        """Length of the diagonal of `bounds` [m]."""
        return float(np.linalg.norm(self.bounds[1] - self.bounds[0]))

    @property
    def up(self) -> np.ndarray:
        """Direction against gravity, (3,); +y where gravity is not known."""
        if self.gravity is None or not np.any(self.gravity):
            return np.array([0.0, 1.0, 0.0])
        return -np.asarray(self.gravity, float) / np.linalg.norm(self.gravity)

    def quantities(self) -> list[str]:
        """Return the names of what the particles can be coloured by; the first is what they are coloured by at the start."""
        names = list(dict.fromkeys(name for motion in self.motions for name in motion.quantities))
        return [*names, PLAIN]

    def quantity(self, name: str) -> Quantity | None:
        """Return the quantity of a name whose range all panels share; None where particles have the colours of their bodies."""
        found = [motion.quantities[name] for motion in self.motions if name in motion.quantities]
        if not found:
            return None
        low, high = min(each.range[0] for each in found), max(each.range[1] for each in found)
        for each in found:
            each.range = (low, high)
        return found[0]

    def words(self, frame: int) -> str:
        """Return the time of a frame in words."""
        if not self.timed:
            return f"frame {frame + 1} of {self.frames}"
        return f"{float(self.times[frame]):.3f} s"


def camera_centres(cameras: Cameras) -> np.ndarray:
    """Return the positions of cameras [m], (V, 3)."""
    viewmats = cameras.viewmats.double().cpu().numpy()
    return -np.einsum("vji,vj->vi", viewmats[:, :3, :3], viewmats[:, :3, 3])


def place_side_by_side(motions: Sequence[Motion], up: np.ndarray) -> None:
    """Shift motions to panels in a row, along the horizontal axis in which they are narrower."""
    every = [motion.x[np.isfinite(motion.x).all(axis=-1)] for motion in motions]
    extent = np.max([np.ptp(part, axis=0) if len(part) else np.zeros(3) for part in every], axis=0)
    axes = [axis for axis in range(3) if abs(up[axis]) < 0.9]
    axis = min(axes, key=lambda a: (extent[a], a))
    step = (1.0 + GAP) * max(float(extent[axis]), 0.5 * float(extent.max()))
    for i, motion in enumerate(motions):
        motion.shift = np.eye(3)[axis] * step * i


def walls_of(scene: Scene) -> tuple[Plane, ...]:
    """Return the planes on which matter of a scene rests: its colliders, and the wall of the domain that gravity points at."""
    planes = tuple(plane for plane in scene.colliders if isinstance(plane, Plane))
    pull = np.asarray(scene.gravity, float)
    if scene.walls is None or not np.any(pull):
        return planes
    axis = int(np.argmax(np.abs(pull)))
    down = pull[axis] < 0
    normal = np.eye(3)[axis] * (1.0 if down else -1.0)
    corner = np.array(scene.lower if down else scene.upper, float)
    return (*planes, Plane(tuple(corner + scene.walls.inset * scene.dx * normal), tuple(normal)))


def content_of_frames(frames: Any, *, title: str = "rollout", scene: Scene | None = None, law: Any = None) -> Content:
    """Return the content of a rollout.

    Args:
        frames: `Frames` of a simulator; skins, bodies and colliders are shown where it has them.
        title: Name of the whole.
        scene: The scene that was simulated, for floor, domain and gravity.
        law: Elastic law, for the stress; those of the scene's bodies where absent.
    """
    from neuido.viewer.quantities import stress_by_body, stress_of

    def array(name: str) -> np.ndarray | None:
        value = getattr(frames, name, None)
        return None if value is None else value.detach().cpu().numpy()

    x = array("x")
    times = np.asarray(frames.times, float).reshape(-1, len(x))[0]
    body = array("body")
    particles = getattr(frames, "particles", None)
    if particles is not None and len(particles.offsets) > 2:
        x, body = _apart(x, particles.scene.cpu().numpy()), particles.scene.cpu().numpy()
    skins = tuple(
        skin_surface(f"skin {i}", skin.faces.cpu().numpy(), skin.indices.cpu().numpy(), skin.weights.cpu().numpy(), x)
        for i, skin in enumerate(getattr(frames, "skins", None) or ())
    )
    stress = None if law is None else stress_of(law)
    if law is None and scene is not None and body is not None and len(scene.bodies) == int(body.max()) + 1:
        stress = stress_by_body([each.law for each in scene.bodies], body)
    motion = Motion(title, times, x, array("v"), array("F"), stress=stress, body=body, skins=skins)
    content = Content(title, [motion], times=times)
    shapes = getattr(frames, "colliders", None) or ()
    content.surfaces = tuple(
        moved_surface(each.name, each.mesh.vertices, each.mesh.faces, each.poses.detach().cpu().numpy())
        for each in shapes
        if each.mesh is not None
    )
    content.planes = tuple(each.shape for each in shapes if isinstance(each.shape, Plane))
    return content if scene is None else with_scene(content, scene)


def with_scene(content: Content, scene: Scene) -> Content:
    """Add floor, gravity and domain of a scene to a content, and return it."""
    content.gravity, content.planes = scene.gravity, walls_of(scene)
    content.domain = np.asarray(scene.lower, float), np.asarray(scene.upper, float)
    return content


def _apart(x: np.ndarray, scene: np.ndarray) -> np.ndarray:
    """Return the positions of several scenes in a row along x."""
    finite = x[np.isfinite(x).all(axis=-1)]
    step = (1.0 + GAP) * float(np.ptp(finite[:, 0])) if len(finite) else 1.0
    return x + (step * scene)[None, :, None] * np.array([1.0, 0.0, 0.0], x.dtype)


def skin_surface(name: str, faces: np.ndarray, indices: np.ndarray, weights: np.ndarray, x: np.ndarray) -> Surface:
    """Return a skin (`neuido.types.Skin`) as a surface that follows the particles x, (K, P, 3)."""
    return Surface(name, faces, lambda k: np.einsum("vk,vkc->vc", weights, x[k][indices]).astype(np.float32))


def moved_surface(name: str, vertices: np.ndarray, faces: np.ndarray, poses: np.ndarray) -> Surface:
    """Return a mesh as a surface that follows its poses, (K, 4, 4)."""

    def moved(frame: int) -> np.ndarray:
        pose = poses[min(frame, len(poses) - 1)]
        return vertices @ pose[:3, :3].T + pose[:3, 3]

    return Surface(name, faces, moved)
