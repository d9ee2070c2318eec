"""A scene as read from a neighbour's file, in metres with +y up, and what of the file has no counterpart."""

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from neuido.data.bodies.scanlines import enclosed_volume
from neuido.data.bodies.triangle_mesh import TriangleMesh
from neuido.types import Vector


@dataclass
class Obstacle:
    """A rigid collider.

    Args:
        kind: plane (through `position`, its normal the local y axis), sphere, cuboid, capsule, cylinder (along the local y axis) or mesh.
        name: Name in results and messages.
        position: Origin of its axes [m].
        rotation: Its axes as columns, (3, 3).
        radius: Of a sphere, capsule or cylinder [m].
        length: Of a cylinder, or of the straight part of a capsule [m].
        size: Edges of a cuboid [m].
        mesh: Of a mesh, in its own axes.
        friction: Coulomb's coefficient [-].
        contact: As of `neuido.Plane`.
        mass: Of a freely moving body [kg]; None: it is at rest.
    """

    kind: str
    name: str
    position: np.ndarray
    rotation: np.ndarray
    radius: float = 0.0
    length: float = 0.0
    size: Vector = (0.0, 0.0, 0.0)
    mesh: TriangleMesh | None = None
    friction: float = 0.0
    contact: str = "separate"
    mass: float | None = None

    def turned(self, rotation: np.ndarray, shift: np.ndarray | float = 0.0) -> "Obstacle":
        """Return the collider in other axes: rotation @ x + shift."""
        moved = Obstacle(**vars(self))
        moved.position, moved.rotation = rotation @ self.position + shift, rotation @ self.rotation
        return moved

    def extent(self) -> tuple[np.ndarray, np.ndarray] | None:
        """Return the corners of a box around the collider [m]; None for a plane."""
        if self.kind == "plane":
            return None
        if self.mesh is not None:
            points = self.mesh.vertices @ self.rotation.T + self.position
            return points.min(axis=0), points.max(axis=0)
        along = 0.5 * self.length + (self.radius if self.kind == "capsule" else 0.0)
        half = {"sphere": (self.radius,) * 3, "cuboid": tuple(0.5 * side for side in self.size)}.get(
            self.kind, (self.radius, along, self.radius)
        )
        reach = np.abs(self.rotation) @ np.array(half)
        return self.position - reach, self.position + reach


@dataclass
class SoftBody:
    """A deformable body: a mesh to fill, or particles.

    Args:
        name: Name in results and messages.
        mesh: Its closed surface [m].
        particles: Arrays x, v and volume, in place of a mesh.
        density: [kg/m^3]; None: the file does not say.
        elasticity: As `neuido.laws.material` takes it; without `young` where the file does not say.
        plasticity: The same; None: none.
        velocity: [m/s].
        mass: In place of the density [kg]; None: the file does not say.
    """

    name: str
    mesh: TriangleMesh | None = None
    particles: dict[str, np.ndarray] | None = None
    density: float | None = None
    elasticity: dict[str, Any] = field(default_factory=dict)
    plasticity: dict[str, Any] | None = None
    velocity: Vector = (0.0, 0.0, 0.0)
    mass: float | None = None

    def volume(self) -> float:
        """Return the volume of its shape [m^3]."""
        if self.particles is not None:
            return float(self.particles["volume"].sum())
        assert self.mesh is not None
        return abs(enclosed_volume(self.mesh))


class Placement(NamedTuple):
    """Which Gaussians of a file are the body of a scene, and how they are moved into it."""

    rotation: np.ndarray
    """Turns the positions of the file, (3, 3)."""
    area: tuple[np.ndarray, np.ndarray] | None = None
    """Corners of the box that the turned positions lie in, in units of the file."""
    opacity: float | None = None
    """Opacity at or below which Gaussians are left out; None: not stated."""
    length: float | None = None
    """Longest side of the box around them [m]; None: a unit of the file is a metre."""
    centre: np.ndarray | None = None
    """Where the centre of that box is put [m]; None: it stays."""


@dataclass
class NeighbourScene:
    """What a neighbour's file says.

    Args:
        name: Name of the scene.
        source: The file and its kind.
        gravity: [m/s^2].
        dt: Time step of the file [s]; None: it does not say.
        steps: Number of these steps; None: it does not say.
        domain: Corners of the domain [m]; None: around all that is there.
        cells: Grid cells along its longest side; None: by the spacing of the particles.
        walls: As in a scene file; None: open.
        bodies: Deformable bodies.
        obstacles: Colliders.
        clamps: Boxes that are held at rest [m].
        notes: A line for each thing that has no counterpart, or that was assumed.
    """

    name: str
    source: str
    gravity: Vector = (0.0, -9.8, 0.0)
    dt: float | None = None
    steps: int | None = None
    domain: tuple[Vector, Vector] | None = None
    cells: int | None = None
    walls: dict[str, Any] | None = None
    bodies: list[SoftBody] = field(default_factory=list)
    obstacles: list[Obstacle] = field(default_factory=list)
    clamps: list[tuple[Vector, Vector]] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def note(self, place: str, what: str) -> None:
        """Add a line about a place of the file."""
        self.notes.append(f"{place}: {what}" if place else what)
