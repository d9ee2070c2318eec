"""Cube, box, ball, cylinder and mesh filled with particles; at t = 0 they move as rigid bodies."""

import math
import os
from collections.abc import Iterable, Sequence

import numpy as np
import torch
from torch import Tensor

from neuido.errors import UserError
from neuido.physics.runtime.limits import limit
from neuido.types import Body, Vector


def cube(
    *,
    length: float = 0.5,
    centre: Vector = (0.5, 0.5, 0.5),
    particles_per_side: int = 10,
    velocity: Vector = (0.0, 0.0, 0.0),
    angular_velocity: Vector = (0.0, 0.0, 0.0),
) -> Body:
    """Fill a cube with a regular particle grid that includes its faces, as NCLaw does.

    With particles on the faces the volume of a particle is approximate (NCLaw, issue 3).

    Args:
        length: Edge [m].
        centre: Centre [m].
        particles_per_side: n; the body has n^3 particles of volume length^3 / n^3 [m^3].
        velocity: Velocity of the centre [m/s].
        angular_velocity: Angular velocity about the centre [rad/s].

    Raises:
        UserError: `length` is not positive, or `particles_per_side` is below 2.
    """
    _positive("length", length)
    if particles_per_side < 2:
        raise UserError(f"particles_per_side must be at least 2, got {particles_per_side}")
    _affordable(particles_per_side**3, "particles_per_side")
    lower = [c - length / 2 for c in _vector("centre", centre)]
    axes = [torch.linspace(l, l + length, particles_per_side, dtype=torch.float64) for l in lower]
    return _body(_grid(axes), length**3, centre, velocity, angular_velocity)


def box(
    *,
    lower: Vector,
    upper: Vector,
    spacing: float,
    jitter: float = 0.0,
    seed: int = 0,
    velocity: Vector = (0.0, 0.0, 0.0),
    angular_velocity: Vector = (0.0, 0.0, 0.0),
) -> Body:
    """Fill a box with particles at the centres of a regular lattice of cells.

    Args:
        lower: Lower corner [m].
        upper: Upper corner [m].
        spacing: Distance between particles [m]. It is rounded on each axis so that whole cells fill the box.
        jitter: Random displacement in fractions of a cell, 0 (regular) to 1 (anywhere in the cell).
        seed: Seed of the jitter.
        velocity: Velocity of the centre [m/s].
        angular_velocity: Angular velocity about the centre [rad/s].

    Raises:
        UserError: lower >= upper on an axis, `spacing` is not positive, or `jitter` is outside [0, 1].
    """
    lower, upper = _vector("lower", lower), _vector("upper", upper)
    if any(u <= l for l, u in zip(lower, upper)):
        raise UserError(f"a box needs lower < upper on each axis, got lower {list(lower)} and upper {list(upper)}")
    centre = ((lower[0] + upper[0]) / 2, (lower[1] + upper[1]) / 2, (lower[2] + upper[2]) / 2)
    volume = math.prod(u - l for l, u in zip(lower, upper))
    x = _lattice(lower, upper, spacing, jitter, seed)
    return _body(x, volume, centre, velocity, angular_velocity)


def ball(
    *,
    centre: Vector,
    radius: float,
    spacing: float,
    jitter: float = 0.0,
    seed: int = 0,
    velocity: Vector = (0.0, 0.0, 0.0),
    angular_velocity: Vector = (0.0, 0.0, 0.0),
) -> Body:
    """Fill a ball with the particles of `box` that lie inside it; they share the exact volume of the ball equally.

    Args:
        centre: Centre [m].
        radius: Radius [m].
        spacing: Distance between particles [m].
        jitter: As in `box`.
        seed: Seed of the jitter.
        velocity: Velocity of the centre [m/s].
        angular_velocity: Angular velocity about the centre [rad/s].

    Raises:
        UserError: `radius` or `spacing` is not positive, or no particle lies inside.
    """
    _positive("radius", radius)
    centre = _vector("centre", centre)
    x = _lattice([c - radius for c in centre], [c + radius for c in centre], spacing, jitter, seed)
    x = x[(x - torch.tensor(centre, dtype=torch.float64)).square().sum(-1) <= radius**2]
    return _body(x, 4 / 3 * math.pi * radius**3, centre, velocity, angular_velocity)


def cylinder(
    *,
    centre: Vector,
    radius: float,
    height: float,
    spacing: float,
    axis: str = "y",
    jitter: float = 0.0,
    seed: int = 0,
    velocity: Vector = (0.0, 0.0, 0.0),
    angular_velocity: Vector = (0.0, 0.0, 0.0),
) -> Body:
    """Fill a cylinder along a coordinate axis with the particles of `box` that lie inside it.

    The particles share the exact volume of the cylinder equally.

    Args:
        centre: Centre [m].
        radius: Radius [m].
        height: Height along the axis [m].
        spacing: Distance between particles [m].
        axis: x, y or z.
        jitter: As in `box`.
        seed: Seed of the jitter.
        velocity: Velocity of the centre [m/s].
        angular_velocity: Angular velocity about the centre [rad/s].

    Raises:
        UserError: `radius`, `height` or `spacing` is not positive, `axis` is unknown, or no particle lies inside.
    """
    _positive("radius", radius)
    _positive("height", height)
    if axis not in ("x", "y", "z"):
        raise UserError(f"axis must be x, y or z, got {axis!r}")
    centre = _vector("centre", centre)
    half = [height / 2 if name == axis else radius for name in "xyz"]
    x = _lattice([c - h for c, h in zip(centre, half)], [c + h for c, h in zip(centre, half)], spacing, jitter, seed)
    across = [i for i in range(3) if "xyz"[i] != axis]
    x = x[(x - torch.tensor(centre, dtype=torch.float64))[:, across].square().sum(-1) <= radius**2]
    return _body(x, math.pi * radius**2 * height, centre, velocity, angular_velocity)


def mesh(
    *,
    file: str | os.PathLike,
    spacing: float | None = None,
    particles: int | None = None,
    scale: float | None = None,
    size: float | None = None,
    up: str | None = None,
    rotation: Vector = (0.0, 0.0, 0.0),
    centre: Vector | None = None,
    repair: bool = False,
    velocity: Vector = (0.0, 0.0, 0.0),
    angular_velocity: Vector = (0.0, 0.0, 0.0),
) -> Body:
    """Fill the mesh of a file with particles; the body has the mesh as its skin.

    In the depth the particles are a regular lattice. Under the surface they are relaxed to share the space evenly, and their volumes are
    what they share. The volumes sum to the volume of the mesh.

    Args:
        file: An .obj, .stl, .ply, .glb (trimesh) or .usd, .usda, .usdc, .usdz (usd-core) file, with a closed surface.
        spacing: Distance between particles [m]; alternatively
        particles: Approximate number of particles.
        scale: Metres per unit of the file; by default what a USD file says, else 1. Alternatively
        size: Longest side of the box around the mesh [m].
        up: The axis of the file that points up: x, y or z; it becomes y. By default what a USD file says, else y.
        rotation: Axis of a rotation times its angle [degrees], applied after `up`: (0, 90, 0) turns by a right angle about y.
        centre: Where the centre of the box around the mesh is put [m]; None: the mesh stays where its file has it.
        repair: Whether to close holes and orient the triangles alike first.
        velocity: Velocity of the centre of mass [m/s].
        angular_velocity: Angular velocity about the centre of mass [rad/s].

    Raises:
        UserError: The file cannot be read, the mesh is not closed, an option is out of its range, or the spacing is too coarse for it.
    """
    from neuido.data.bodies.mesh_files import read_mesh
    from neuido.data.bodies.mesh_filling import closed_mesh, fill_mesh
    from neuido.data.bodies.scanlines import enclosed_volume
    from neuido.data.bodies.skinning import bind_skin

    if (spacing is None) == (particles is None):
        raise UserError("a mesh needs either spacing or particles")
    if scale is not None and size is not None:
        raise UserError("a mesh takes scale or size, not both")
    for name, value in (("spacing", spacing), ("size", size)):
        if value is not None:
            _positive(name, value)
    if particles is not None and particles < 1:
        raise UserError(f"particles must be positive, got {particles}")
    surface = closed_mesh(read_mesh(file, scale=scale, up=up), str(file), repair=repair)
    turned = surface.vertices @ _rotation(_vector("rotation", rotation)).T
    if size is not None:
        turned = turned * (size / np.ptp(turned, axis=0).max())
    if centre is not None:
        turned = turned + np.array(_vector("centre", centre)) - (turned.min(axis=0) + turned.max(axis=0)) / 2
    surface = surface._replace(vertices=turned)
    x, volume = fill_mesh(surface, spacing or (enclosed_volume(surface) / particles) ** (1 / 3), str(file))  # type: ignore[operator]
    middle = tuple(np.average(x, axis=0, weights=volume).tolist())
    at = torch.from_numpy(x)
    v = rigid_velocity(at, centre=middle, velocity=velocity, angular_velocity=angular_velocity)
    skin = bind_skin(surface.vertices, surface.faces, at.float())
    return Body(at.float(), v.float(), torch.from_numpy(volume).float(), skin=skin)


def _rotation(degrees: Vector) -> np.ndarray:
    """Return the rotation matrix of an axis times an angle in degrees."""
    x, y, z = (math.radians(angle) for angle in degrees)
    cross = torch.tensor([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]], dtype=torch.float64)
    return torch.linalg.matrix_exp(cross).numpy()


def rigid_velocity(x: Tensor, *, centre: Vector, velocity: Vector, angular_velocity: Vector) -> Tensor:
    """Compute the velocity v + omega x (x - centre) [m/s] (P, 3) of a rigid body at the points x [m] (P, 3)."""
    about = [
        torch.tensor(_vector(n, a), dtype=x.dtype, device=x.device)
        for n, a in (("centre", centre), ("velocity", velocity), ("angular_velocity", angular_velocity))
    ]
    return about[1] + torch.linalg.cross(about[2].expand_as(x), x - about[0])


def _body(x: Tensor, volume: float, centre: Vector, velocity: Vector, angular_velocity: Vector) -> Body:
    if len(x) == 0:
        raise UserError("no particle lies inside the body: lower spacing")
    v = rigid_velocity(x, centre=centre, velocity=velocity, angular_velocity=angular_velocity)
    return Body(x.float(), v.float(), torch.full((len(x),), volume / len(x), dtype=torch.float32))


def _grid(axes: Sequence[Tensor]) -> Tensor:
    return torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1).reshape(-1, 3)


def _lattice(lower: Sequence[float], upper: Sequence[float], spacing: float, jitter: float, seed: int) -> Tensor:
    _positive("spacing", spacing)
    if not 0 <= jitter <= 1:
        raise UserError(f"jitter must lie in [0, 1] cells, got {jitter}")
    counts = [max(1, round((u - l) / spacing)) for l, u in zip(lower, upper)]
    _affordable(math.prod(counts), "spacing")
    steps = [(u - l) / n for l, u, n in zip(lower, upper, counts)]
    x = _grid([l + h * (torch.arange(n, dtype=torch.float64) + 0.5) for l, h, n in zip(lower, steps, counts)])
    if jitter:
        shift = torch.rand(x.shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) - 0.5
        x = x + jitter * shift * torch.tensor(steps, dtype=torch.float64)
    return x


def _vector(name: str, value: Sequence[float]) -> Vector:
    if not isinstance(value, Iterable) or len(value := tuple(value)) != 3 or not all(math.isfinite(c) for c in value):
        raise UserError(f"{name} must be three finite numbers, got {value!r}")
    return tuple(float(c) for c in value)  # type: ignore[return-value]


def _positive(name: str, value: float) -> None:
    if not (value > 0 and math.isfinite(value)):
        raise UserError(f"{name} must be a positive length, got {value}")


def _affordable(count: int, option: str) -> None:
    if count > limit("NEUIDO_MAX_PARTICLES"):
        largest = limit("NEUIDO_MAX_PARTICLES")
        raise UserError(f"the body would have {count} particles, more than {largest}: change {option}, or set NEUIDO_MAX_PARTICLES")
