"""What is written to other programs: particles with fields, surfaces, colliders, cameras and Gaussians of a motion, as NumPy arrays."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from neuido.errors import UserError
from neuido.export.splats import MovingSplats
from neuido.physics.colliders.solids import Grip
from neuido.types import Cameras, Plane, Scene

NEAREST_SAMPLED = 4000
"""Particles from which the distance to the nearest neighbour is taken."""
PALETTE = ((0.34, 0.61, 0.84), (0.90, 0.57, 0.22), (0.42, 0.66, 0.31), (0.76, 0.34, 0.43), (0.56, 0.49, 0.76), (0.46, 0.46, 0.46))
"""Colours of bodies, in turn, RGB in 0..1 (sRGB)."""
SHARP = 0.77
"""Cosine of the angle between two triangles, 40 degrees, beyond which their edge is drawn sharp."""
COLLIDER_COLOUR = (0.55, 0.55, 0.55)
SQUARE = ((0, 1, 2), (0, 2, 3))
"""Triangles of a square whose corners go anticlockwise."""


class Field(NamedTuple):
    """A quantity of each particle."""

    values: np.ndarray
    """Values, (K, P), or (P,) for one that does not change."""
    unit: str
    """Its unit; `1` for none."""

    def at(self, frame: int) -> np.ndarray:
        """Return the values of a frame, (P,)."""
        return self.values if self.values.ndim == 1 else self.values[frame]


@dataclass(eq=False)
class Surface:
    """A triangle mesh: a skin, a reconstructed surface, or a collider.

    Args:
        name: Its name.
        vertices: Vertices of each frame [m], (V, 3); one entry where they do not change.
        faces: Triangles of each frame, (T, 3) int32; one entry where they do not change.
        normals: Unit normals at the vertices of each frame, (V, 3).
        poses: Rigid pose of each frame, (K, 4, 4), for vertices that do not change; one entry where it does not change either.
        colour: RGB in 0..1 (sRGB).
    """

    name: str
    vertices: Sequence[np.ndarray]
    faces: Sequence[np.ndarray]
    normals: Sequence[np.ndarray]
    poses: np.ndarray | None = None
    colour: tuple[float, float, float] = PALETTE[0]

    @property
    def rigid(self) -> bool:
        """Whether its vertices do not change."""
        return len(self.vertices) == 1

    @property
    def remeshed(self) -> bool:
        """Whether its triangles change from frame to frame."""
        return len(self.faces) > 1

    def at(self, frame: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return vertices, triangles and normals of a frame, without the pose."""
        return tuple(part[min(frame, len(part) - 1)] for part in (self.vertices, self.faces, self.normals))  # type: ignore[return-value]

    def pose(self, frame: int) -> np.ndarray:
        """Return the pose of a frame, (4, 4)."""
        return np.eye(4) if self.poses is None else self.poses[min(frame, len(self.poses) - 1)]

    def placed(self, frame: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return vertices, triangles and normals of a frame in the world."""
        vertices, faces, normals = self.at(frame)
        pose = self.pose(frame)
        return vertices @ pose[:3, :3].T + pose[:3, 3], faces, normals @ pose[:3, :3].T


class Part(NamedTuple):
    """The particles of one body."""

    name: str
    index: np.ndarray
    """Indices of its particles, (n,)."""


@dataclass(eq=False)
class Exchange:
    """A motion in the form that every writer takes.

    Args:
        times: Times of the frames [s], (K,), at even intervals.
        x: Positions [m], (K, P, 3) float32.
        v: Velocities [m/s], (K, P, 3) float32.
        F: Elastic deformation gradients [-], (K, P, 3, 3), of which the Gaussians are deformed.
        width: Diameter at which a particle is drawn [m].
        parts: The bodies.
        fields: Further quantities of the particles, by name.
        surfaces: Skins and reconstructed surfaces.
        colliders: Colliders.
        cameras: Cameras of a recording.
        gaussians: Gaussians that move with the particles.
        up: Axis that points against gravity, `Y` or `Z`.
        notes: What was left out, a line each.
    """

    times: np.ndarray
    x: np.ndarray
    v: np.ndarray | None
    F: np.ndarray | None
    width: float
    parts: tuple[Part, ...]
    fields: dict[str, Field] = field(default_factory=dict)
    surfaces: tuple[Surface, ...] = ()
    colliders: tuple[Surface, ...] = ()
    cameras: Cameras | None = None
    gaussians: MovingSplats | None = None
    up: str = "Y"
    notes: list[str] = field(default_factory=list)

    @property
    def frames(self) -> int:
        """Number of frames."""
        return len(self.x)

    @property
    def rate(self) -> float:
        """Frames per second of the motion; 24 for a single frame."""
        return 24.0 if len(self.times) < 2 else (len(self.times) - 1) / float(self.times[-1] - self.times[0])


def exchange_of(motion: Any, *, every: int = 1, scene: Scene | None = None) -> Exchange:
    """Collect particles, skins and colliders of a motion.

    Args:
        motion: `Frames`, of several scenes too where these have the same frame times.
        every: Take every so many frames.
        scene: The scene, for its planes and the direction of gravity.

    Raises:
        UserError: No frames, scenes of other frame times, a position that is not finite, or an impossible `every`.
    """
    if every < 1:
        raise UserError(f"every is {every}; it must be a positive whole number")
    times = np.asarray(motion.times, np.float64)
    if times.ndim > 1:
        raise UserError("the scenes of these frames have other frame times: export them to .npz, or each scene of its own")
    x, v, F = (_array(getattr(motion, name, None)) for name in ("x", "v", "F"))
    if x is None or not x.size:
        raise UserError("the motion has no frames or no particles: there is nothing to export")
    if not np.isfinite(x).all():
        frame = int(np.argmax(~np.isfinite(x).reshape(len(x), -1).all(axis=1)))
        count = int((~np.isfinite(x[frame]).all(axis=-1)).sum())
        raise UserError(f"{count} particles of frame {frame} are not at a finite place: export to .npz, or end the motion before")
    made = Exchange(times[::every], x[::every], *(None if part is None else part[::every] for part in (v, F)), spacing_of(x[0]), ())
    made.parts = _parts(motion, x.shape[1], made)
    made.surfaces = tuple(_skin(skin, motion, i, every) for i, skin in enumerate(getattr(motion, "skins", None) or ()))
    own = tuple(each for each in getattr(motion, "colliders", None) or () if not isinstance(getattr(each, "shape", None), Grip))
    colliders = [_collider(each, i, every, made, scene) for i, each in enumerate(own)]
    if scene is not None:
        down = np.asarray(scene.gravity, float)
        made.up = "Z" if np.any(down) and int(np.argmax(np.abs(down))) == 2 else "Y"
        if not any(isinstance(getattr(each, "shape", None), Plane) for each in own):
            planes = [plane for plane in scene.colliders if isinstance(plane, Plane)]
            colliders += [_plane(plane, f"plane_{i}", made, scene) for i, plane in enumerate(planes)]
    made.colliders = tuple(colliders)
    return made


def _array(value: Any) -> np.ndarray | None:
    if value is None:
        return None
    value = value.detach().cpu().numpy() if hasattr(value, "detach") else np.asarray(value)
    return np.ascontiguousarray(value, np.float32)


def spacing_of(x: np.ndarray) -> float:
    """Return the median distance of particles (P, 3) to their nearest neighbour [m]; 0.01 for one particle."""
    from scipy.spatial import KDTree

    if len(x) < 2:
        return 0.01
    asked = x[:: max(1, len(x) // NEAREST_SAMPLED)]
    found = float(np.median(np.asarray(KDTree(x).query(asked, k=2)[0])[:, 1]))
    return found or 0.01


def _parts(motion: Any, count: int, made: Exchange) -> tuple[Part, ...]:
    body, names = getattr(motion, "body", None), tuple(getattr(motion, "body_names", None) or ())
    particles = getattr(motion, "particles", None)
    word = "body"
    if body is None and particles is not None and len(particles.offsets) > 2:
        body, word = particles.scene, "scene"
    if body is None:
        return (Part("body", np.arange(count)),)
    index = np.asarray(body.cpu() if hasattr(body, "cpu") else body).astype(np.int32)
    made.fields[word] = Field(index, "1")
    each = np.unique(index)
    own = [names[i] if i < len(names) and names[i] else f"{word}_{i}" for i in each]
    return tuple(Part(name, np.flatnonzero(index == i)) for name, i in zip(own, each))


def _skin(skin: Any, motion: Any, number: int, every: int) -> Surface:
    vertices = np.asarray(_array(skin.vertices_at(motion)))[::every]
    faces = np.asarray(skin.faces.cpu() if hasattr(skin.faces, "cpu") else skin.faces, np.int32)
    name = getattr(skin, "name", "") or ("skin" if number == 0 else f"skin_{number}")
    return Surface(name, list(vertices), [faces], [normals_of(at, faces) for at in vertices], colour=PALETTE[number % len(PALETTE)])


def _collider(collider: Any, number: int, every: int, made: Exchange, scene: Scene | None) -> Surface:
    """Return a collider with its mesh, or with a square of its face where it is a half-space."""
    mesh, name = collider.mesh, getattr(collider, "name", "") or f"collider_{number}"
    if mesh is None and isinstance(collider.shape, Plane):
        return _plane(collider.shape, name, made, scene)
    if mesh is None:
        low, high = _room(made, scene)
        half = 0.5 * float((high - low).max())
        vertices = half * np.array([[-1, 0, -1], [-1, 0, 1], [1, 0, 1], [1, 0, -1]], np.float32)
        faces = np.array(SQUARE, np.int32)
    else:
        vertices, faces = np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces, np.int32)
    poses = getattr(collider, "poses", None)
    poses = None if poses is None else np.asarray(poses.cpu() if hasattr(poses, "cpu") else poses, np.float64)
    if poses is not None and len(poses) > 1:
        poses = poses[::every]
    return Surface(name, [vertices], [faces], [normals_of(vertices, faces)], poses, COLLIDER_COLOUR)


def _room(made: Exchange, scene: Scene | None) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners of the domain [m], or of a box three times as large as what moves."""
    if scene is not None:
        return np.asarray(scene.lower, float), np.asarray(scene.upper, float)
    low, high = made.x.min(axis=(0, 1)).astype(float), made.x.max(axis=(0, 1)).astype(float)
    return low - (high - low), high + (high - low)


def _plane(plane: Plane, name: str, made: Exchange, scene: Scene | None) -> Surface:
    """Return a square of a half-space's boundary, below the middle of the domain."""
    normal = np.asarray(plane.normal, float) / np.linalg.norm(plane.normal)
    low, high = _room(made, scene)
    middle = (low + high) / 2
    centre = middle - ((middle - np.asarray(plane.point, float)) @ normal) * normal
    along = np.cross(normal, np.eye(3)[int(np.argmin(np.abs(normal)))])
    along /= np.linalg.norm(along)
    half = 0.5 * float((high - low).max())
    sides = half * np.stack([along, np.cross(normal, along)])
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    vertices = (centre + corners @ sides).astype(np.float32)
    faces = np.array(SQUARE, np.int32)
    return Surface(name, [vertices], [faces], [np.tile(normal.astype(np.float32), (4, 1))], colour=COLLIDER_COLOUR)


def normals_of(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return the unit normals of a mesh at its vertices, weighted by the areas of the triangles, (V, 3) float32."""
    a, b, c = (vertices[faces[:, i]].astype(np.float64) for i in range(3))
    flat = np.cross(b - a, c - a)
    normals = np.stack(
        [sum(np.bincount(faces[:, corner], flat[:, axis], len(vertices)) for corner in range(3)) for axis in range(3)], axis=1
    )
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.where(length > 0, normals / np.where(length > 0, length, 1), [0.0, 1.0, 0.0]).astype(np.float32)


def with_edges(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return a mesh with its vertices repeated along sharp edges, and their unit normals: a box is drawn with flat faces."""
    a, b, c = (vertices[faces[:, i]].astype(np.float64) for i in range(3))
    flat = np.cross(b - a, c - a)
    unit = flat / np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-30)
    vertex, face = faces.reshape(-1), np.repeat(np.arange(len(faces)), 3)
    many = np.bincount(vertex, minlength=len(vertices))
    begin, each = (np.cumsum(many) - many)[vertex], many[vertex]
    own = np.repeat(np.arange(len(vertex)), each)  # every corner with every corner at its vertex
    other = np.argsort(vertex, kind="stable")[np.repeat(begin - np.cumsum(each) + each, each) + np.arange(len(own))]
    smooth = np.einsum("ni,ni->n", unit[face[own]], unit[face[other]]) > SHARP
    weights = np.where(smooth[:, None], flat[face[other]], 0.0)
    normals = np.stack([np.bincount(own, weights[:, axis], len(vertex)) for axis in range(3)], axis=1)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    _, first, new = np.unique(np.column_stack([vertex, normals.round(4) + 0.0]), axis=0, return_index=True, return_inverse=True)
    return vertices[vertex[first]], new.reshape(-1, 3).astype(np.int32), normals[first].astype(np.float32)
