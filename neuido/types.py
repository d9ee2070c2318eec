"""Data types shared by all packages. SI units; shapes with P particles, S scenes, B samples, K frames."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import torch
from torch import Tensor

Vector = tuple[float, float, float]


def brief(value: object) -> str:
    """Format a value briefly: a tensor of one element as its number, a larger one by its shape and dtype."""
    if isinstance(value, Tensor):
        kind = str(value.dtype).removeprefix("torch.")
        return f"{value.item():.6g}" if value.numel() == 1 else f"{tuple(value.shape)} {kind} on {value.device}"
    return f"{value:.6g}" if isinstance(value, float) else repr(value)


def brief_fields(value: NamedTuple) -> str:
    """Format a named tuple with each field brief; fields that are None are left out."""
    fields = zip(value._fields, value)
    return f"{type(value).__name__}({', '.join(f'{name}: {brief(part)}' for name, part in fields if part is not None)})"


class ParticleState(NamedTuple):
    """The state of P particles, or of K frames of them with a leading K."""

    x: Tensor
    """Position [m], (P, 3)."""
    v: Tensor
    """Velocity [m/s], (P, 3)."""
    C: Tensor
    """Affine velocity matrix, approximately the velocity gradient [1/s], (P, 3, 3)."""
    F: Tensor
    """Elastic deformation gradient [-], (P, 3, 3)."""

    def __repr__(self) -> str:
        return brief_fields(self)


class Particles(NamedTuple):
    """The scene of each particle; the particles of all scenes are concatenated, and scene s has offsets[s]:offsets[s+1]."""

    scene: Tensor
    """Scene index, (P,) int32."""
    offsets: tuple[int, ...]
    """Index of the first particle of each scene, then P; S + 1 numbers."""

    def __repr__(self) -> str:
        return brief_fields(self)


class _BodyFields(NamedTuple):
    x: Tensor
    v: Tensor
    volume: Tensor
    F: Tensor | None = None
    name: str = ""
    law: Any = None
    plasticity: Any = None
    density: float | Tensor | None = None
    fields: Any = None
    skin: Any = None


class Body(_BodyFields):
    """One body at t = 0: its particles, and optionally its material.

    `Body(x, v, volume)` gives the particles, `Body(shape=...)` takes those of another body, such as one of `shapes`. A body whose law is
    given needs no law in `Simulator.rollout`.

    Args:
        x: Position [m], (P, 3).
        v: Velocity [m/s], (P, 3); by default at rest.
        volume: Volume [m^3], (P,).
        F: Deformation gradient [-], (P, 3, 3); None: the identity.
        name: Name of the body in messages and results.
        law: Elastic law, or a list of laws between which the field `law` chooses; None: that of the rollout. Parameters of a classical law
            may be a field, (P,).
        plasticity: Plastic law, or a list of them; None: purely elastic.
        density: Mass density [kg/m^3], a number or (P,); None: that of the simulator.
        fields: Material fields by name: `law`, the index of each particle's law, (P,); those of a law of one's own that takes them.
        skin: Surface mesh bound to the particles, for pictures and files.
        shape: A body whose particles and other properties are taken where they are not given here.
        velocity: Velocity of the centre of volume [m/s], in place of `v`.
        spin: Angular velocity about the centre of volume [rad/s], added to `velocity` or `v`.

    Raises:
        TypeError: Neither particles nor a shape, or a value of a wrong kind.
    """

    def __new__(
        cls,
        x: Tensor | None = None,
        v: Tensor | None = None,
        volume: Tensor | None = None,
        F: Tensor | None = None,
        name: str = "",
        law: Any = None,
        plasticity: Any = None,
        density: float | Tensor | None = None,
        fields: Any = None,
        skin: Any = None,
        *,
        shape: "Body | None" = None,
        velocity: Vector | None = None,
        spin: Vector | None = None,
    ) -> "Body":
        """Create a body; the class describes the arguments."""
        given = {"x": x, "v": v, "volume": volume, "F": F, "name": name or None, "law": law, "plasticity": plasticity}
        given |= {"density": density, "fields": fields, "skin": skin}
        if shape is not None:
            if not isinstance(shape, Body):
                raise TypeError(f"shape of a body is {shape!r}; give one of neuido.shapes, such as shapes.ball(...), or another body")
            given = {key: getattr(shape, key) if value is None else value for key, value in given.items()}
        given["name"] = given["name"] or ""
        if given["x"] is None or given["volume"] is None:
            raise TypeError(f"body {name!r} has no particles; give `shape`, or `x` and `volume`")
        if velocity is not None or given["v"] is None:
            start = (0.0, 0.0, 0.0) if velocity is None else velocity
            given["v"] = torch.zeros_like(given["x"]) + three_numbers(start, "velocity of a body").to(given["x"])
        if spin is not None:
            given["v"] = given["v"] + _turning(given["x"], given["volume"], spin)
        return super().__new__(cls, **given)

    def __repr__(self) -> str:
        return brief_fields(self if self.name else self._replace(name=None))


def _turning(x: Tensor, volume: Tensor, spin: Vector) -> Tensor:
    """Return the velocity [m/s], (P, 3), of a rotation about the centre of volume."""
    r = x - (volume[:, None] * x).sum(0) / volume.sum()
    return torch.linalg.cross(three_numbers(spin, "spin of a body").to(r).expand_as(r), r)


def three_numbers(given: Any, what: str) -> Tensor:
    """Return a vector as a tensor, (3,).

    Raises:
        TypeError: It is something else.
    """
    try:
        out = torch.as_tensor(given)
    except (TypeError, ValueError, RuntimeError):
        out = torch.empty(0)
    if out.shape != (3,):
        raise TypeError(f"{what} is {given!r}; give three numbers")
    return out


class Skin(NamedTuple):
    """A surface mesh that moves with the particles of a body: each vertex is a fixed linear combination of particles near it.

    The combination of a vertex gives its own place at rest, so a skin follows every affine motion of its particles exactly (moving least
    squares; Schaefer et al. 2006). `neuido.shapes.mesh` makes one, and `neuido.data.bind_skin` for particles of your own.
    """

    vertices: Tensor
    """Position at rest [m], (V, 3)."""
    faces: Tensor
    """Vertices of the triangles, anticlockwise as seen from outside, (T, 3) int64."""
    indices: Tensor
    """Particles that each vertex is bound to, (V, k) int64; indices of all particles of the frames."""
    weights: Tensor
    """Their weights, which sum to one and may be negative, (V, k)."""

    def vertices_at(self, frames: "ParticleState | Tensor") -> Tensor:
        """Compute the vertices [m] in each frame, (K, V, 3); differentiable.

        Args:
            frames: Frames of a simulation, or positions of the particles [m], (K, P, 3).
        """
        x = frames if isinstance(frames, Tensor) else frames.x
        weights, indices = self.weights.to(x), self.indices.to(x.device)
        return torch.stack([torch.einsum("vk,vkc->vc", weights, frame[indices]) for frame in x])

    def __repr__(self) -> str:
        return brief_fields(self)


class TrajectoryBatch(NamedTuple):
    """Samples of constitutive behaviour (paper, Stage I), in the order of a substep: trial, corrected, stress."""

    trial: Tensor
    """Trial deformation gradient F_tr before the plastic correction [-], (B, 3, 3)."""
    corrected: Tensor
    """Corrected deformation gradient, the plastic law of the trial [-], (B, 3, 3)."""
    stress: Tensor
    """Kirchhoff stress, the elastic law of the corrected gradient [Pa], (B, 3, 3)."""
    trajectory: Tensor
    """Index of the trajectory that a sample comes from, (B,) int64."""

    def __repr__(self) -> str:
        return brief_fields(self)


class Cameras(NamedTuple):
    """V pinhole cameras of one image size. Pixel (i, j) covers [j, j + 1) x [i, i + 1), so its centre lies at j + 0.5, i + 0.5."""

    viewmats: Tensor
    """World to camera in OpenCV axes (x right, y down, z forward) [m], (V, 4, 4); (V, T, 4, 4) for cameras that move in T frames."""
    Ks: Tensor
    """Intrinsics [px], (V, 3, 3)."""
    width: int
    height: int

    @property
    def moving(self) -> bool:
        """Whether there is a pose for each frame."""
        return self.viewmats.dim() == 4

    def at(self, frame: int) -> "Cameras":
        """Return the cameras in one frame; fixed cameras are the same in all."""
        return self._replace(viewmats=self.viewmats[:, frame]) if self.moving else self

    def __repr__(self) -> str:
        return brief_fields(self)


class MultiViewBatch(NamedTuple):
    """Images of one scene: V views in T frames."""

    scene: int
    """Index of the scene."""
    name: str
    """Name of the scene."""
    images: Tensor
    """RGB in [0, 1], composited over `background`, (V, T, H, W, 3) float32."""
    masks: Tensor
    """Coverage of each pixel by the object, (V, T, H, W) float32; one everywhere if no mask is given."""
    cameras: Cameras
    """The V cameras, for images of this size."""
    times: Tensor
    """Times of the frames [s], (T,) float64."""
    held_out: Tensor
    """Views that are only scored, never fitted, (V,) bool."""
    background: Tensor
    """Colour of the background, (3,) float32."""

    def __repr__(self) -> str:
        return brief_fields(self)


@dataclass(frozen=True)
class Plane:
    """A half-space collider; material stays on the side that the normal points to.

    Args:
        point: A point of the plane [m].
        normal: Normal of the plane, of any length.
        contact: `sticky` (zero velocity in the collider), `slip` (no normal velocity) or `separate` (no inward normal velocity).
        friction: Coulomb's coefficient for `separate` [-]; infinity prevents all sliding in contact.
    """

    point: Vector
    normal: Vector
    contact: str = "separate"
    friction: float = 0.0


@dataclass(frozen=True)
class Keyframes:
    """The motion of a collider on a given path: linear in the positions, spherically linear in the rotations, at rest outside the times.

    Args:
        times: Rising times [s], (N,).
        positions: [m], (N, 3).
        rotations: Unit quaternions (w, x, y, z), (N, 4); None: the rotation of the collider throughout.
        smooth: Cubic curves through the poses in place of straight lines, for measured poses: their velocity has no jumps.
    """

    times: tuple[float, ...]
    positions: tuple[Vector, ...]
    rotations: tuple[tuple[float, float, float, float], ...] | None = None
    smooth: bool = False


@dataclass(frozen=True, kw_only=True)
class Solid:
    """What all solid colliders share; the kinds are in `neuido.physics.colliders`: `Sphere`, `Cuboid`, `MeshCollider`, ...

    A solid is at rest, moves at a constant `velocity` and `spin`, follows a `path`, or, with a `mass`, moves freely.

    Args:
        position: Origin of its frame at t = 0 [m]; the centre of mass of a free body.
        rotation: Rotation at t = 0, a quaternion (w, x, y, z) of any length.
        contact: As for `Plane`.
        friction: As for `Plane` [-].
        velocity: [m/s]; the initial velocity of a free body.
        spin: Angular velocity in the axes of the scene [rad/s]; the initial one of a free body.
        path: The motion in time; it replaces position and velocity.
        mass: Mass of a free rigid body [kg]; None: not free.
        inertia: Inertia of a free body about its centre of mass in its own axes [kg m^2], (3, 3); None: that of a uniform density.
        restitution: Share of the normal velocity with which a free body leaves a plane or another solid [-]; the larger one of two
            counts. 0 leaves about a tenth, since contact never pulls.
        name: Name in results.
    """

    position: Vector = (0.0, 0.0, 0.0)
    rotation: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    contact: str = "separate"
    friction: float = 0.0
    velocity: Vector = (0.0, 0.0, 0.0)
    spin: Vector = (0.0, 0.0, 0.0)
    path: Keyframes | None = None
    mass: float | None = None
    inertia: tuple[Vector, Vector, Vector] | None = None
    restitution: float = 0.0
    name: str = ""


@dataclass(frozen=True)
class Box:
    """An axis-aligned box, given by its lower and upper corner [m]."""

    lower: Vector
    upper: Vector


@dataclass(frozen=True)
class AttachedMass:
    """A mass that is added to the particles in a box at t = 0, in proportion to their volume.

    Args:
        box: The box [m].
        mass: The mass [kg].
    """

    box: Box
    mass: float


@dataclass(frozen=True)
class Attachment:
    """Particles that are held to places in space or on a solid collider, by a spring and a damper or rigidly.

    Args:
        particles: Those in a `Box` at t = 0, those that a `Skin` is bound to, or indices of particles of the scene.
        to: Name of the solid collider; empty: places in space.
        point: The place [m] to which all are drawn; None: each to where it is at t = 0.
        stiffness: Of all these particles together [N/m]; infinite: rigidly.
        damping: Of all together [N s/m].
    """

    particles: Any
    to: str = ""
    point: Vector | None = None
    stiffness: float = math.inf
    damping: float = 0.0


@dataclass(frozen=True)
class Walls:
    """The six walls of the domain.

    Args:
        contact: As for `Plane`.
        friction: As for `Plane` [-].
        inset: Distance of the walls from the faces of the domain, in cells.
    """

    contact: str = "separate"
    friction: float = 0.0
    inset: float = 0.0


@dataclass(frozen=True)
class Scene:
    """The set-up of one simulation: domain, grid, time step, gravity, colliders, clamps and attached masses.

    Args:
        lower: Lower corner of the domain [m].
        upper: Upper corner of the domain [m].
        cells: Number of grid cells along the longest side of the domain.
        dt: Substep [s].
        gravity: Acceleration of gravity [m/s^2].
        colliders: Planes and solids. Planes act on the grid in this order and before the walls, then solids in this order.
        walls: Walls of the domain; None: the domain is open, and a particle that leaves it is an error.
        clamps: Boxes whose particles and nodes are held at rest.
        attached_masses: Masses that are added to the body.
        attachments: Particles that are held to places in space or on solid colliders.
        bodies: The bodies, if the scene brings them; `Simulator(scene)` then needs no other.
        contact: Contact between the bodies: `sticky` (they share one velocity field and never part) or `separate` (they push, slide with
            friction, and part).
        body_friction: Coulomb's coefficient between the bodies for `separate` [-], or a list of (name, name, coefficient) for pairs; pairs
            that are not named slide freely.
    """

    lower: Vector = (0.0, 0.0, 0.0)
    upper: Vector = (1.0, 1.0, 1.0)
    cells: int = 32
    dt: float = 1e-3
    gravity: Vector = (0.0, -9.8, 0.0)
    colliders: tuple[Plane | Solid, ...] = ()
    walls: Walls | None = Walls()
    clamps: tuple[Box, ...] = ()
    attached_masses: tuple[AttachedMass, ...] = ()
    attachments: tuple[Attachment, ...] = field(default=(), compare=False)
    bodies: Sequence[Body] = field(default=(), compare=False)
    contact: str = "separate"
    body_friction: float | Sequence[tuple[str, str, float]] = 0.0

    @property
    def dx(self) -> float:
        """Cell size [m]."""
        return max(u - l for l, u in zip(self.lower, self.upper)) / self.cells

    @property
    def nodes(self) -> tuple[int, int, int]:
        """Grid nodes along each axis, without padding."""
        return tuple(math.ceil((u - l) / self.dx - 1e-9) + 1 for l, u in zip(self.lower, self.upper))  # type: ignore[return-value]


class Gaussians(NamedTuple):
    """N Gaussians of one body, or K frames of them with a leading K on means, covariances and rotations."""

    means: Tensor
    """Centre [m], (N, 3)."""
    covariances: Tensor
    """Covariance [m^2], (N, 3, 3)."""
    opacities: Tensor
    """Opacity in 0..1, (N,)."""
    harmonics: Tensor
    """Spherical harmonics of the colour minus one half, (N, (degree + 1)^2, 3); degree 0 to 3."""
    rotations: Tensor | None = None
    """Rotation of each Gaussian since its harmonics were fitted, (N, 3, 3); None: none."""

    def __repr__(self) -> str:
        return brief_fields(self)
