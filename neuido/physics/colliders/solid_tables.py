"""Tables of the solid colliders of scenes, as the kernels read them, and their motion as differentiable inputs of a rollout."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from neuido.errors import UserError
from neuido.physics.colliders import solids as kinds
from neuido.physics.colliders.contact import CONTACTS
from neuido.physics.colliders.mesh_samples import mesh_samples
from neuido.physics.colliders.solids import HeightField, MeshCollider
from neuido.types import Keyframes, Plane, Scene, Solid, brief_fields

MARGIN = 1.25
"""Cells of the grid by which the samples of a mesh extend beyond it; the contact reaches one."""
SHAPES = {
    kinds.Grip: 0,
    kinds.HalfSpace: kinds.HALF_SPACE,
    kinds.Sphere: kinds.SPHERE,
    kinds.Cuboid: kinds.CUBOID,
    kinds.Capsule: kinds.CAPSULE,
    kinds.Cylinder: kinds.CYLINDER,
    kinds.HeightField: kinds.HEIGHT_FIELD,
    kinds.MeshCollider: kinds.MESH,
}


class SolidInputs(NamedTuple):
    """The motion, mass and friction of the solids of S scenes, up to C in each, all float64: differentiable inputs of a rollout.

    `Simulator.solid_inputs` returns those of the scenes; replace a field to differentiate with respect to it or to change it.
    """

    pose: Tensor
    """Position [m] and unit quaternion (w, x, y, z) at t = 0, (S, C, 7)."""
    velocity: Tensor
    """Velocity [m/s] and angular velocity [rad/s] at t = 0, (S, C, 6); used for free bodies."""
    twist: Tensor
    """The same in each substep for solids that are not free, (T, S, C, 6), or (1, S, C, 6) if constant."""
    friction: Tensor
    """Coulomb's coefficient [-], (S, C)."""
    mass: Tensor
    """Mass of free bodies [kg], (S, C); zero: not free."""
    inertia: Tensor
    """Inertia of free bodies about their centre of mass in their own axes [kg m^2], (S, C, 3, 3)."""

    def __repr__(self) -> str:
        return brief_fields(self)


class SolidTable(NamedTuple):
    """What is constant about the solids of S scenes, C rows each; unused rows have kind 0."""

    shape: Tensor
    """Number of the shape, (S, C) int32."""
    kind: Tensor
    """Kind of contact, (S, C) int32."""
    size: Tensor
    """Lengths of the shape [m], (S, C, 4)."""
    reach: Tensor
    """Distance from its origin that contains the solid [m], (S, C)."""
    info: Tensor
    """First sample and numbers of samples along the axes, (S, C, 4) int32."""
    samples: Tensor
    """Samples of meshes and height fields, (N, 4)."""
    points: Tensor
    """Points at which free bodies touch planes, with radius, (S, C, N, 4) float64; unused ones have radius -1."""
    sharing: Tensor
    """How many points share the weight of a free body at most, (S, C) int32."""
    damping: Tensor
    """Damping ratio of the contact of free bodies with planes and solids [-], (S, C) float64; 1: critical, without restitution."""
    free: bool
    """Whether there is a free body."""


def solids_of(scene: Scene) -> tuple[Solid, ...]:
    """Return the solids among the colliders of a scene.

    Raises:
        UserError: A collider of another kind, or one that is thinner than a cell.
    """
    out = []
    for i, solid in enumerate(scene.colliders):
        if isinstance(solid, Plane):
            continue
        if type(solid) not in SHAPES:
            raise UserError(f"colliders[{i}] is a {type(solid).__name__}; give one of Plane, {', '.join(k.__name__ for k in SHAPES)}")
        if kinds.thickness(solid) < scene.dx:
            raise UserError(f"colliders[{i}], a {type(solid).__name__}, is {kinds.thickness(solid):.3g} m thick, less than a cell of "
                            f"{scene.dx:.3g} m: matter would pass; make it thicker or raise `cells`")  # fmt: skip
        out.append(solid)
    return tuple(out)


def refuse_solids(scenes: Sequence[Scene], solver: str) -> None:
    """Raise UserError where a scene has solids, for a solver that knows planes alone."""
    for s, scene in enumerate(scenes):
        if solids_of(scene):
            raise UserError(f"scene {s} has colliders other than planes, which {solver} cannot meet; use neuido.Simulator")


def solid_table(scenes: Sequence[Scene], dtype: torch.dtype, device: torch.device) -> SolidTable | None:
    """Collect the solids of all scenes in one table; None without solids.

    Raises:
        UserError: As `solids_of`.
    """
    rows = [solids_of(scene) for scene in scenes]
    count = max(len(row) for row in rows)
    if not count:
        return None
    shape, kind, sharing = (torch.zeros(len(rows), count, dtype=torch.int32) for _ in range(3))
    size, reach = torch.zeros(len(rows), count, 4, dtype=torch.float64), torch.zeros(len(rows), count, dtype=torch.float64)
    info = torch.zeros(len(rows), count, 4, dtype=torch.int32)
    damping = torch.ones(len(rows), count, dtype=torch.float64)
    samples, points = [], {}
    for s, (scene, row) in enumerate(zip(scenes, rows)):
        for c, solid in enumerate(row):
            damping[s, c] = damping_ratio(solid.restitution)
            shape[s, c], kind[s, c] = SHAPES[type(solid)], 0 if isinstance(solid, kinds.Grip) else CONTACTS[solid.contact]
            lengths, bound, dims, own = _geometry(solid, scene.dx)
            size[s, c], reach[s, c] = torch.tensor(lengths), bound
            info[s, c] = torch.tensor([sum(len(t) for t in samples), *dims], dtype=torch.int32)
            if own is not None:
                samples.append(own.reshape(-1, 4))
            if solid.mass is not None:
                points[s, c], sharing[s, c] = kinds.touch_points(solid), kinds.sharing(solid)
    most = max((len(own) for own in points.values()), default=1)
    touch = torch.full((len(rows), count, most, 4), -1.0, dtype=torch.float64)
    for (s, c), own in points.items():
        touch[s, c, : len(own)] = torch.from_numpy(own)
    flat = torch.from_numpy(np.concatenate(samples)) if samples else torch.zeros(1, 4, dtype=torch.float64)
    real = [t.to(device, dtype) for t in (size, reach, flat)]
    return SolidTable(shape.to(device), kind.to(device), real[0], real[1], info.to(device), real[2], touch.to(device),
                      sharing.to(device), damping.to(device), bool(points))  # fmt: skip


def damping_ratio(restitution: float) -> float:
    """Return the ratio of the damping of a spring to the critical one with which bodies part at this share of their speed."""
    if restitution <= 0.0:
        return 1.0
    loss = -math.log(restitution)
    return loss / math.hypot(math.pi, loss)


def _geometry(solid: Solid, dx: float) -> tuple[tuple[float, ...], float, tuple[int, int, int], np.ndarray | None]:
    """Return the lengths of a solid in the table, its reach, the numbers of samples and the samples (nx, ny, nz, 4)."""
    none = (0, 0, 0)
    if isinstance(solid, kinds.HalfSpace):
        return (0.0,) * 4, np.inf, none, None
    if isinstance(solid, kinds.Grip):
        return (0.0,) * 4, 0.0, none, None
    if isinstance(solid, kinds.Sphere):
        return (solid.radius, 0.0, 0.0, 0.0), solid.radius, none, None
    if isinstance(solid, kinds.Cuboid):
        x, y, z = (side / 2 for side in solid.size)
        return (x, y, z, 0.0), float(np.linalg.norm([x, y, z])), none, None
    if isinstance(solid, kinds.Capsule):
        return (solid.radius, solid.length / 2, 0.0, 0.0), solid.radius + solid.length / 2, none, None
    if isinstance(solid, kinds.Cylinder):
        return (solid.radius, solid.length / 2, 0.0, 0.0), float(np.hypot(solid.radius, solid.length / 2)), none, None
    if isinstance(solid, HeightField):
        heights = np.asarray(solid.heights, dtype=np.float64)
        step = [side / (n - 1) for side, n in zip(solid.size, heights.shape)]
        slopes = np.gradient(heights, *step)
        own = np.stack([*slopes, np.zeros_like(heights), heights], axis=-1)[:, None]
        return (*step, -solid.size[0] / 2, -solid.size[1] / 2), np.inf, (heights.shape[0], 1, heights.shape[1]), own
    assert isinstance(solid, MeshCollider)
    vertices = kinds.centred_vertices(solid)
    own, spacing, lower = mesh_samples(vertices, np.asarray(solid.faces), dx / 2, MARGIN * dx)
    return (spacing, *lower), float(np.linalg.norm(vertices, axis=1).max()), own.shape[:3], own


def solid_inputs(scenes: Sequence[Scene], steps: int, device: torch.device) -> SolidInputs:
    """Return the motion, mass and friction that the solids of scenes state, for a rollout of `steps` substeps.

    Raises:
        UserError: A path that is not one, or an inertia that is none.
    """
    rows = [solids_of(scene) for scene in scenes]
    count = max(len(row) for row in rows)
    moving = any(solid.path is not None for row in rows for solid in row)
    pose = torch.zeros(len(rows), count, 7, dtype=torch.float64)
    pose[..., 3] = 1.0
    velocity = torch.zeros(len(rows), count, 6, dtype=torch.float64)
    twist = torch.zeros(steps if moving else 1, len(rows), count, 6, dtype=torch.float64)
    friction, mass = (torch.zeros(len(rows), count, dtype=torch.float64) for _ in range(2))
    inertia = torch.eye(3, dtype=torch.float64).repeat(len(rows), count, 1, 1)
    for s, (scene, row) in enumerate(zip(scenes, rows)):
        for c, solid in enumerate(row):
            turn = torch.from_numpy(_unit(np.array([solid.rotation], dtype=np.float64))[0])
            pose[s, c] = torch.cat([torch.tensor(solid.position, dtype=torch.float64), turn])
            pose[s, c, :3] += rotate(turn, torch.from_numpy(kinds.centre_of(solid)))
            velocity[s, c] = torch.tensor([*solid.velocity, *solid.spin], dtype=torch.float64)
            twist[:, s, c] = velocity[s, c]
            friction[s, c] = solid.friction
            if solid.path is not None:
                at = path_poses(solid.path, solid.rotation, scene.dt * np.arange(steps + 1))
                pose[s, c] = torch.from_numpy(at[0])
                twist[:, s, c] = torch.from_numpy(twists_of(at, scene.dt))
            if solid.mass is not None:
                mass[s, c], inertia[s, c] = solid.mass, torch.from_numpy(kinds.inertia_of(solid))
    return SolidInputs(*(t.to(device) for t in (pose, velocity, twist, friction, mass, inertia)))


def path_poses(path: Keyframes, rotation: tuple[float, ...], at: np.ndarray) -> np.ndarray:
    """Return position and unit quaternion on a path at the times `at` [s], (N, 7); `rotation` where the path has none.

    Raises:
        UserError: Times that do not rise, or numbers of times, positions and rotations that differ.
    """
    times, places = kinds.array(path.times, "path.times"), kinds.array(path.positions, "path.positions")
    turns = np.tile(rotation, (len(times), 1)) if path.rotations is None else kinds.array(path.rotations, "path.rotations")
    if times.ndim != 1 or not len(times) or places.shape != (len(times), 3) or turns.shape != (len(times), 4):
        raise UserError(f"a path has times {times.shape}, positions {places.shape} and rotations {turns.shape}; give (N,), (N, 3), (N, 4)")
    if not (np.diff(times) > 0).all():
        raise UserError("path.times of a collider must rise")
    if not np.abs(turns).max(axis=1).min() > 0:
        raise UserError("path.rotations has a quaternion of length zero")
    turns = _unit(turns)
    inside = np.clip(at, times[0], times[-1])
    i = np.clip(np.searchsorted(times, inside, side="right") - 1, 0, max(len(times) - 2, 0))
    j = np.minimum(i + 1, len(times) - 1)
    f = ((inside - times[i]) / np.where(j > i, times[j] - times[i], 1.0))[:, None]
    if path.smooth and len(times) > 1:
        flips = np.concatenate([[1.0], np.cumprod(np.where((turns[1:] * turns[:-1]).sum(1) < 0, -1.0, 1.0))])
        poses = np.concatenate([places, flips[:, None] * turns], axis=1)
        found = _cubic(times, poses, i, f)
        return np.concatenate([found[:, :3], _unit(found[:, 3:])], axis=1)
    return np.concatenate([places[i] + f * (places[j] - places[i]), slerp(turns[i], turns[j], f)], axis=1)


def _cubic(times: np.ndarray, values: np.ndarray, i: np.ndarray, f: np.ndarray) -> np.ndarray:
    """Return cubic Hermite curves through values (N, k) at the shares f (n, 1) of the intervals i (n,); slopes are central differences."""
    slopes = np.gradient(values, times, axis=0, edge_order=min(2, len(times) - 1))
    h, g = np.diff(times)[i][:, None], 1 - f
    return (1 + 2 * f) * g**2 * values[i] + f * g**2 * h * slopes[i] + f**2 * (3 - 2 * f) * values[i + 1] - f**2 * g * h * slopes[i + 1]


def _unit(turns: np.ndarray) -> np.ndarray:
    """Return quaternions (N, 4) of unit length."""
    return turns / np.linalg.norm(turns, axis=1, keepdims=True)


def slerp(a: np.ndarray, b: np.ndarray, f: np.ndarray) -> np.ndarray:
    """Return the unit quaternions at the shares f (N, 1) of the shorter arcs from a to b, (N, 4)."""
    b = np.where((a * b).sum(1, keepdims=True) >= 0, b, -b)
    angle = 2 * np.arcsin(np.minimum(np.linalg.norm(b - a, axis=1, keepdims=True) / 2, 1.0))
    arc = np.where(angle > 0, np.sin(angle), 1.0)
    return np.where(angle > 0, (np.sin((1 - f) * angle) * a + np.sin(f * angle) * b) / arc, a)


def twists_of(poses: np.ndarray, dt: float) -> np.ndarray:
    """Return the velocity [m/s] and angular velocity [rad/s] that lead from each pose (N + 1, 7) to the next in dt [s], (N, 6)."""
    a, b = poses[:-1, 3:], poses[1:, 3:]
    w = np.einsum("ni,ni->n", a, b)[:, None]
    vector = a[:, :1] * b[:, 1:] - b[:, :1] * a[:, 1:] + np.cross(a[:, 1:], b[:, 1:])  # of b times the inverse of a
    flip = np.where(w < 0, -1.0, 1.0)
    vector, w = flip * vector, flip * w
    size = np.linalg.norm(vector, axis=1, keepdims=True)
    angle = 2 * np.arctan2(size, w)
    spin = np.where(size > 0, vector / np.where(size > 0, size, 1.0), 0.0) * angle / dt
    return np.concatenate([np.diff(poses[:, :3], axis=0) / dt, spin], axis=1)


def rotate(q: Tensor, y: Tensor) -> Tensor:
    """Return vectors y (..., 3) rotated by unit quaternions q (w, x, y, z), (..., 4)."""
    u = q[..., 1:]
    t = 2.0 * torch.linalg.cross(u, y)
    return y + q[..., :1] * t + torch.linalg.cross(u, t)
