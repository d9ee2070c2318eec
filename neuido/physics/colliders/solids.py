"""Solid colliders: primitives, height fields and meshes, each with its frame at `position`, turned by `rotation`.

The fields that all kinds share (pose, contact, friction, motion, mass) are those of `neuido.types.Solid`. A collider that is thinner than
two grid cells may let matter through: the nodes on its far side push the other way.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from neuido.errors import UserError
from neuido.types import Keyframes, Solid, Vector

HALF_SPACE, SPHERE, CUBOID, CAPSULE, CYLINDER, HEIGHT_FIELD, MESH = range(1, 8)
"""Number of each kind of solid in the tables of the kernels; 0 means an unused row."""
RIM_POINTS = 12
"""Points on each rim of a cylinder at which a free cylinder touches planes; the sagitta of their polygon is 3.4 % of the radius."""
FIELDS = {"position": 3, "velocity": 3, "spin": 3, "rotation": 4, "restitution": 0}
"""Number of numbers in fields of all solids; 0: one by itself."""
HULL_POINTS = 64
"""Most vertices of a free mesh at which it touches planes; of more, those furthest out along as many even directions are taken."""


@dataclass(frozen=True)
class HalfSpace(Solid):
    """A half-space whose face passes through `position`; its normal is the local y axis. Unlike a `Plane` it can move and has a force."""

    def __post_init__(self) -> None:
        _check(self)


@dataclass(frozen=True)
class Sphere(Solid):
    """A ball.

    Args:
        radius: [m].
    """

    radius: float

    def __post_init__(self) -> None:
        _check(self, radius=self.radius)


@dataclass(frozen=True)
class Cuboid(Solid):
    """A rectangular block centred at `position`.

    Args:
        size: Lengths of the edges along the local axes [m].
    """

    size: Vector

    def __post_init__(self) -> None:
        _check(self, **_edges(self, 3))


@dataclass(frozen=True)
class Capsule(Solid):
    """A cylinder with hemispherical ends along the local y axis.

    Args:
        radius: [m].
        length: Length of the straight part, without the ends [m].
    """

    radius: float
    length: float

    def __post_init__(self) -> None:
        _check(self, radius=self.radius, length=self.length)


@dataclass(frozen=True)
class Cylinder(Solid):
    """A cylinder along the local y axis.

    Args:
        radius: [m].
        length: [m].
    """

    radius: float
    length: float

    def __post_init__(self) -> None:
        _check(self, radius=self.radius, length=self.length)


@dataclass(frozen=True)
class Grip(Solid):
    """A frame without a shape, which nothing touches: particles that an `Attachment` holds to it move with it, and pull at it.

    The clamp of a testing machine, the hand of a robot: its motion is a `path`, and its force is in `Frames.forces`.
    """

    def __post_init__(self) -> None:
        _check(self)
        if self.mass is not None:
            raise UserError("a Grip has a mass; it moves as given: leave `mass` out")


@dataclass(frozen=True, eq=False)
class HeightField(Solid):
    """Ground whose height is given on a regular lattice, bilinear in between; all below it is solid, and nothing beside it.

    Args:
        heights: Heights above the local plane y = 0 [m], (nx, nz), at least 2 x 2.
        size: Lengths of the lattice along the local x and z axes [m]; `position` is its centre.
    """

    heights: Any
    size: tuple[float, float]

    def __post_init__(self) -> None:
        _check(self, **_edges(self, 2))
        heights = array(self.heights, "heights of a HeightField")
        if heights.ndim != 2 or min(heights.shape) < 2:
            raise UserError(f"heights of a HeightField has shape {heights.shape}; give (nx, nz), at least 2 x 2")
        if self.mass is not None:
            raise UserError("a HeightField has a mass; it cannot move freely: leave `mass` out")


@dataclass(frozen=True, eq=False)
class MeshCollider(Solid):
    """A watertight triangle mesh; `neuido.data.bodies.mesh_collider` reads one from a file.

    The position of a free mesh (`mass` given) is kept at the centre of mass of its volume: poses in results refer to it.

    Args:
        vertices: [m], (V, 3).
        faces: Vertices of each triangle, counter-clockwise seen from outside, (T, 3).
    """

    vertices: Any
    faces: Any

    def __post_init__(self) -> None:
        _check(self)
        vertices, faces = array(self.vertices, "vertices of a MeshCollider"), np.asarray(self.faces)
        if vertices.ndim != 2 or vertices.shape[1] != 3 or faces.ndim != 2 or faces.shape[1] != 3 or len(faces) < 4:
            raise UserError(f"a MeshCollider has vertices {vertices.shape} and faces {faces.shape}; give (V, 3) and (T, 3), T at least 4")
        if not np.issubdtype(faces.dtype, np.integer) or faces.min() < 0 or faces.max() >= len(vertices):
            raise UserError(f"faces of a MeshCollider must be whole numbers from 0 to {len(vertices) - 1}")
        edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
        single = int((np.unique(edges, axis=0, return_counts=True)[1] % 2).sum())
        if single:
            raise UserError(f"a MeshCollider is not watertight: {single} edges belong to an odd number of triangles; close its holes")
        if not abs(mass_properties(vertices, faces)[0]) > 0:
            raise UserError("a MeshCollider encloses no volume; give a closed surface")


def array(given: Any, what: str) -> np.ndarray:
    """Return numbers as a float64 array.

    Raises:
        UserError: Not numbers, or not finite.
    """
    try:
        out = np.asarray(given, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise UserError(f"{what} must be numbers: {error}") from error
    if not np.isfinite(out).all():
        raise UserError(f"{what} contains a NaN or an infinity")
    return out


def _edges(solid: "Cuboid | HeightField", count: int) -> dict[str, float]:
    """Return the lengths of a solid, each with its name."""
    return {f"size[{i}]": side for i, side in enumerate(_numbers(solid, "size", count).tolist())}


def _numbers(solid: Solid, name: str, count: int) -> np.ndarray:
    """Return a field of `count` numbers; 0: one number by itself.

    Raises:
        UserError: It is something else.
    """
    what, value = f"{name} of a {type(solid).__name__}", getattr(solid, name)
    out = array(value, what)
    if out.shape != ((count,) if count else ()):
        raise UserError(f"{what} is {value!r}; give {f'{count} numbers' if count else 'one number'}")
    return out


def _check(solid: Solid, **lengths: float) -> None:
    """Validate what all solids share, and that the given lengths are positive."""
    kind = type(solid).__name__
    for name, count in FIELDS.items():
        _numbers(solid, name, count)
    for name, value in lengths.items():
        if not array(value, f"{name} of a {kind}") > 0:
            raise UserError(f"{name} of a {kind} is {value}; give a positive length [m]")
    if solid.path is not None and not isinstance(solid.path, Keyframes):
        raise UserError(f"path of a {kind} is a {type(solid.path).__name__}; give neuido.Keyframes(times, positions)")
    if solid.contact not in ("sticky", "slip", "separate"):
        raise UserError(f"contact of a {kind} is {solid.contact!r}; choose one of sticky, slip, separate")
    if not (isinstance(solid.friction, (int, float, np.number)) and solid.friction >= 0.0):
        raise UserError(f"friction of a {kind} is {solid.friction!r}; give zero or more")
    if not 0.0 <= solid.restitution <= 1.0:
        raise UserError(f"restitution of a {kind} is {solid.restitution}; give a share from 0 to 1")
    if not any(solid.rotation):
        raise UserError(f"rotation of a {kind} is {list(solid.rotation)}; give a quaternion (w, x, y, z) that is not zero")
    if solid.mass is not None:
        if not _numbers(solid, "mass", 0) > 0:
            raise UserError(f"mass of a {kind} is {solid.mass}; give a positive mass [kg], or none for a collider that is not free")
        if solid.path is not None:
            raise UserError(f"a {kind} has a path and a mass; a free body takes its motion from forces: leave one of both out")
        if isinstance(solid, HalfSpace):
            raise UserError("a HalfSpace has a mass; it cannot move freely: leave `mass` out")
    elif solid.inertia is not None:
        raise UserError(f"a {kind} has an inertia and no mass; give `mass` [kg] for a free body")


def inertia_of(solid: Solid) -> np.ndarray:
    """Return the inertia about the centre of mass of a free solid of uniform density, or the one that it states [kg m^2], (3, 3)."""
    assert solid.mass is not None
    if solid.inertia is not None:
        out = array(solid.inertia, "inertia")
        if out.shape != (3, 3) or not np.allclose(out, out.T) or not np.linalg.eigvalsh(out).min() > 0:
            raise UserError("inertia of a collider must be a symmetric positive 3 x 3 matrix [kg m^2] in its own axes")
        return out
    m = solid.mass
    if isinstance(solid, Sphere):
        return 0.4 * m * solid.radius**2 * np.eye(3)
    if isinstance(solid, Cuboid):
        x, y, z = (side**2 for side in solid.size)
        return m / 12 * np.diag([y + z, x + z, x + y])
    if isinstance(solid, Cylinder):
        r2, l2 = solid.radius**2, solid.length**2
        return m * np.diag([r2 / 4 + l2 / 12, r2 / 2, r2 / 4 + l2 / 12])
    if isinstance(solid, Capsule):
        r, l = solid.radius, solid.length
        tube = m * l / (l + 4 / 3 * r)
        ends = m - tube
        across = tube * (r**2 / 4 + l**2 / 12) + ends * (0.4 * r**2 + l**2 / 4 + 3 / 8 * l * r)
        return np.diag([across, tube * r**2 / 2 + ends * 0.4 * r**2, across])
    assert isinstance(solid, MeshCollider)
    volume, _, inertia = mass_properties(np.asarray(solid.vertices, float), np.asarray(solid.faces))
    return inertia * m / volume


def mass_properties(vertices: np.ndarray, faces: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Return volume [m^3], centre [m], (3,), and inertia about the centre at unit density [m^5], (3, 3), of a closed mesh.

    The sums are over the tetrahedra from the mean vertex to each triangle; a mesh with inward faces has a negative volume.
    """
    start = vertices.mean(axis=0)
    corners = vertices[faces] - start
    volumes = np.einsum("ti,ti->t", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6
    volume = float(volumes.sum())
    safe = volume if volume else 1.0
    centre = np.einsum("t,tci->i", volumes, corners) / (4 * safe)
    total = corners.sum(axis=1)
    moment = (np.einsum("t,tci,tcj->ij", volumes, corners, corners) + np.einsum("t,ti,tj->ij", volumes, total, total)) / 20
    moment = moment - volume * np.outer(centre, centre)
    return volume, centre + start, np.trace(moment) * np.eye(3) - moment


def touch_points(solid: Solid) -> np.ndarray:
    """Return the points, each with a radius, at which a free solid touches planes and solids, in its own axes: x, y, z, r [m], (N, 4)."""
    if isinstance(solid, Sphere):
        return np.array([[0.0, 0.0, 0.0, solid.radius]])
    if isinstance(solid, Capsule):
        return np.array([[0.0, side * solid.length / 2, 0.0, solid.radius] for side in (-1, 1)])
    if isinstance(solid, Cuboid):
        lattice = np.array(np.meshgrid(*[[-0.5, 0.0, 0.5]] * 3)).reshape(3, -1).T
        lattice = lattice[np.abs(lattice).max(axis=1) > 0]  # corners, and the middles of edges and faces, which may meet another solid
        return np.pad(lattice * np.array(solid.size), ((0, 0), (0, 1)))
    if isinstance(solid, Cylinder):
        angle = 2 * math.pi * np.arange(RIM_POINTS) / RIM_POINTS
        rim = np.stack([solid.radius * np.cos(angle), 0 * angle, solid.radius * np.sin(angle), 0 * angle], axis=1)
        return np.concatenate([rim + np.array([0, side * solid.length / 2, 0, 0]) for side in (-1, 1)])
    assert isinstance(solid, MeshCollider)
    vertices = centred_vertices(solid)
    if len(vertices) > HULL_POINTS:
        turn = np.arange(HULL_POINTS) + 0.5  # a Fibonacci lattice of directions
        up, around = 1 - 2 * turn / HULL_POINTS, math.pi * (1 + 5**0.5) * turn
        flat = np.sqrt(1 - up**2)
        directions = np.stack([flat * np.cos(around), up, flat * np.sin(around)], axis=1)
        vertices = vertices[np.unique((vertices @ directions.T).argmax(axis=0))]
    return np.pad(vertices, ((0, 0), (0, 1)))


def sharing(solid: Solid) -> int:
    """Return how many of the touch points of a free solid share its weight on a plane at most."""
    if isinstance(solid, Sphere):
        return 1
    return {Capsule: 2, Cuboid: 9, Cylinder: RIM_POINTS}.get(type(solid), 4)


def centre_of(solid: Solid) -> np.ndarray:
    """Return the origin of the frame of a solid in the axes in which it was given [m], (3,): the centre of mass of a free mesh, else 0."""
    if isinstance(solid, MeshCollider) and solid.mass is not None:
        return mass_properties(np.asarray(solid.vertices, float), np.asarray(solid.faces))[1]
    return np.zeros(3)


def centred_vertices(solid: MeshCollider) -> np.ndarray:
    """Return the vertices of a mesh in the frame that its poses refer to [m], (V, 3)."""
    return np.asarray(solid.vertices, dtype=np.float64) - centre_of(solid)


def thickness(solid: Solid) -> float:
    """Return the least thickness of a solid [m]."""
    if isinstance(solid, Sphere):
        return 2 * solid.radius
    if isinstance(solid, Cuboid):
        return min(solid.size)
    if isinstance(solid, Capsule):
        return 2 * solid.radius
    if isinstance(solid, Cylinder):
        return min(2 * solid.radius, solid.length)
    return math.inf
