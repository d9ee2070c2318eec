"""Tables of the colliders, walls and clamps of scenes, as the kernels read them.

Colliders act on the grid nodes inside them one after the other, in the order of the scene and the walls last. The kinds of contact are
described in `contact`. Friction is a differentiable input of the rollout.
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
"""Distance in cells within which a node counts as lying on a face, since node positions are rounded to the simulation's precision."""
CLAMP_MARGIN = 0.5 - NEAR
"""Distance in cells beyond the faces of a clamp in which nodes are held, so that the nearest layer of nodes to each face is held.

If only nodes inside the box were held, the last layer could be almost a cell away from the face. The material there would be held by the
tail of its stencil alone and slide out: a beam of 20 cells along its length would be 9 % too soft (with this margin: 2.6 %).
"""


class ColliderTable(NamedTuple):
    """The planes of S scenes, K rows each; unused rows have kind 0."""

    plane: Tensor
    """Unit normal n that points to the material, and offset w [m]: a node at x is inside the collider if n x <= w, (S, K, 4).

    The offset includes `NEAR`, so that a node on the plane counts as inside. The offset of an unused row is -inf.
    """
    kind: Tensor
    """Kind of contact: 1 sticky, 2 slip, 3 separate, 0 unused row, (S, K) int32."""
    friction: Tensor
    """Coulomb's coefficient [-], (S, K)."""


def planes_of(scene: Scene) -> tuple[Plane, ...]:
    """Return the planes among the colliders of a scene, followed by its six walls.

    Raises:
        UserError: An unknown kind of contact, a normal without length, or a friction that is negative or NaN.
    """
    planes = [plane for plane in scene.colliders if isinstance(plane, Plane)]
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
            raise UserError(f"friction is {plane.friction}; give zero or more")
        length = math.hypot(*plane.normal)
        if not (length > 0.0 and math.isfinite(length)):
            raise UserError(f"normal of a collider is {list(plane.normal)}; give a vector that is not zero")
    return tuple(planes)


def collider_table(scenes: Sequence[Scene], dtype: torch.dtype, device: torch.device) -> ColliderTable:
    """Collect the planes of all scenes in one table, padded to the largest number of planes in a scene.

    Raises:
        UserError: As `planes_of`.
    """
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
    """Collect the boxes in which clamps hold grid nodes, `CLAMP_MARGIN` included.

    Returns:
        Lower and upper corners [m], (S, B, 3) each, for up to B clamps per scene; unused rows are empty boxes.
    """
    count = max(len(scene.clamps) for scene in scenes)
    lower = torch.full((len(scenes), count, 3), torch.inf, dtype=torch.float64)
    upper = torch.full((len(scenes), count, 3), -torch.inf, dtype=torch.float64)
    for s, scene in enumerate(scenes):
        for b, box in enumerate(scene.clamps):
            lower[s, b], upper[s, b] = box_corners(box, CLAMP_MARGIN * scene.dx)
    return lower.to(device, dtype), upper.to(device, dtype)


def box_corners(box: Box, margin: float) -> tuple[Tensor, Tensor]:
    """Return the lower and upper corner of a box enlarged by `margin` [m], (3,) float64 each."""
    return torch.tensor(box.lower, dtype=torch.float64) - margin, torch.tensor(box.upper, dtype=torch.float64) + margin


def inside_box(x: Tensor, box: Box, *, name: str) -> Tensor:
    """Return which particles lie in a box, (P,) bool.

    Args:
        x: Positions [m], (P, 3).
        box: The box.
        name: What the box belongs to, for the error.

    Raises:
        UserError: No particle lies in the box.
    """
    lower, upper = (corner.to(x.device) for corner in box_corners(box, 0.0))
    picked = ((x >= lower) & (x <= upper)).all(dim=-1)
    if not bool(picked.any()):
        raise UserError(f"{name} {[list(box.lower), list(box.upper)]} contains no particle; move or enlarge the box")
    return picked
