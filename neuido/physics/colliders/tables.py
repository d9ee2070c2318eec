"""Colliders, walls and clamps of the scenes as the tables that the kernels read.

A collider acts on the grid nodes inside it, in the order in which it is listed, the walls last: `sticky` sets the velocity
to zero, `slip` removes its normal part, `separate` removes an inward normal part and brakes the tangential one with
Coulomb's friction (Stomakhin et al. 2013, eq. 8). Friction is a differentiable input of the rollout.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from neuido.errors import UserError
from neuido.physics.colliders.contact import CONTACTS
from neuido.types import Box, Plane, Scene

NEAR = 1e-4
"""Cells within which a node lies on a face: nodes are placed in the simulation's own precision."""
NEAREST = 0.5 - NEAR
"""Cells beyond its faces in which a clamp holds nodes, so that each face lies on the nearest layer.

Where only the nodes inside are held, the last layer may be almost a cell from the face: the material next to it feels that layer by the
tail of its stencil alone and slides out, and a beam is 9 % too soft at 20 cells to its length (2.6 % with the nearest layer).
"""


class ColliderTable(NamedTuple):
    """K planes for each of S scenes; rows that a scene does not use have kind 0."""

    plane: Tensor
    """Unit normal n that points to the material, and the offset w: a node at x is inside where n x <= w, (S, K, 4).

    A node that lies on the plane to 1e-4 of a cell counts as inside; the offset of an unused row is -inf.
    """
    kind: Tensor
    """1 sticky, 2 slip, 3 separate, 0 none, (S, K) int32."""
    friction: Tensor
    """Coulomb's coefficient [-], (S, K)."""


def planes_of(scene: Scene) -> tuple[Plane, ...]:
    """Return the colliders of a scene followed by its six walls.

    Raises:
        UserError: Unknown contact, zero normal, negative or NaN friction.
    """
    planes = list(scene.colliders)
    if scene.walls is not None:
        wall = scene.walls
        for axis in range(3):
            for sign, face in ((1.0, scene.lower[axis]), (-1.0, scene.upper[axis])):
                normal = tuple(sign if a == axis else 0.0 for a in range(3))
                point = tuple(face + sign * wall.inset * scene.dx if a == axis else 0.0 for a in range(3))
                planes.append(Plane(point, normal, wall.contact, wall.friction))  # type: ignore[arg-type]
    for plane in planes:
        if plane.contact not in CONTACTS:
            raise UserError(f"contact is {plane.contact!r}; choose one of {', '.join(CONTACTS)}")
        if not plane.friction >= 0.0:
            raise UserError(f"friction is {plane.friction}; it must be zero or more")
        length = math.hypot(*plane.normal)
        if not (length > 0.0 and math.isfinite(length)):
            raise UserError(f"normal of a collider is {list(plane.normal)}; it must have a length")
    return tuple(planes)


def collider_table(scenes: Sequence[Scene], dtype: torch.dtype, device: torch.device) -> ColliderTable:
    """Return the planes of all scenes, padded to the largest number of them."""
    rows = [planes_of(scene) for scene in scenes]
    count = max(1, *(len(row) for row in rows))
    plane = torch.zeros(len(scenes), count, 4, dtype=torch.float64)
    plane[..., 3] = -torch.inf
    kind = torch.zeros(len(scenes), count, dtype=torch.int32)
    friction = torch.zeros(len(scenes), count, dtype=torch.float64)
    for s, (scene, row) in enumerate(zip(scenes, rows)):
        for c, given in enumerate(row):
            normal = torch.tensor(given.normal, dtype=torch.float64)
            normal = normal / normal.norm()
            plane[s, c, :3] = normal
            plane[s, c, 3] = normal @ torch.tensor(given.point, dtype=torch.float64) + NEAR * scene.dx
            kind[s, c] = CONTACTS[given.contact]
            friction[s, c] = given.friction
    return ColliderTable(plane.to(device, dtype), kind.to(device), friction.to(device, dtype))


def clamp_table(scenes: Sequence[Scene], dtype: torch.dtype, device: torch.device) -> tuple[Tensor, Tensor]:
    """Lower and upper corners of what the clamps hold of the grid, (S, B, 3) each [m]; unused rows hold an empty box."""
    count = max(len(scene.clamps) for scene in scenes)
    lower = torch.full((len(scenes), count, 3), torch.inf, dtype=torch.float64)
    upper = torch.full((len(scenes), count, 3), -torch.inf, dtype=torch.float64)
    for s, scene in enumerate(scenes):
        for b, box in enumerate(scene.clamps):
            lower[s, b], upper[s, b] = corners(box, NEAREST * scene.dx)
    return lower.to(device, dtype), upper.to(device, dtype)


def corners(box: Box, margin: float) -> tuple[Tensor, Tensor]:
    """Lower and upper corner (3,) [m], float64, of a box with a margin [m]."""
    return torch.tensor(box.lower, dtype=torch.float64) - margin, torch.tensor(box.upper, dtype=torch.float64) + margin


def inside_box(x: Tensor, box: Box, *, name: str) -> Tensor:
    """Which particles lie in a box, (P,) bool, from x (P, 3) [m].

    Raises:
        UserError: The box picks no particle.
    """
    lower, upper = (corner.to(x.device) for corner in corners(box, 0.0))
    picked = ((x >= lower) & (x <= upper)).all(dim=-1)
    if not bool(picked.any()):
        raise UserError(f"{name} {[list(box.lower), list(box.upper)]} picks no particle; move or enlarge the box")
    return picked
