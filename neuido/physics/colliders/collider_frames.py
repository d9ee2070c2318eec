"""The colliders in the frames of a rollout: what they are, where they are, and the forces on them."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from neuido.physics.colliders.solid_meshes import SolidMesh, mesh_of
from neuido.physics.colliders.solid_tables import rotate, solids_of
from neuido.types import Plane, Scene, Solid, brief_fields


class ColliderFrames(NamedTuple):
    """One collider in the K frames of a rollout."""

    name: str
    """Its name, or its kind and number, such as `cuboid 0`."""
    scene: int
    """Index of its scene."""
    shape: Plane | Solid
    """The collider."""
    poses: Tensor
    """Pose of its axes in each frame, (K, 4, 4) float64; of a plane, whose local y axis is the normal, too."""
    velocity: Tensor | None = None
    """Velocity [m/s] and angular velocity [rad/s] in each frame, (K, 6) float64; None for a plane."""
    force: Tensor | None = None
    """Force of bodies and attachments on it [N], the mean since the frame before, (K, 3) float64; zero in frame 0; None for a plane."""
    torque: Tensor | None = None
    """Their torque about its position [N m], (K, 3) float64; None for a plane."""

    def __repr__(self) -> str:
        return brief_fields(self)

    @property
    def mesh(self) -> SolidMesh | None:
        """Its surface in its own axes, for pictures and files; None of a half-space or a plane."""
        return mesh_of(self.shape)


def collider_frames(
    scenes: Sequence[Scene], frames: int, every: int, states: Tensor | None, impulses: Tensor | None
) -> tuple[ColliderFrames, ...]:
    """Return the colliders of all scenes in the frames of a rollout, scene by scene.

    Args:
        scenes: The scenes.
        frames: Number of frames K.
        every: Substeps between frames.
        states: States of the solids in the frames, (K, S, C, 13); None without solids.
        impulses: Impulses on the solids in every substep, (T, S, C, 6).
    """
    out = []
    means = None
    if impulses is not None:
        summed = impulses.unflatten(0, (frames - 1, every)).sum(1) if frames > 1 else impulses[:0]
        means = torch.cat([torch.zeros_like(impulses[:1]), summed]) / every
    for s, scene in enumerate(scenes):
        c = 0
        for i, shape in enumerate(scene.colliders):
            name = getattr(shape, "name", "") or f"{type(shape).__name__.lower()} {i}"
            if isinstance(shape, Plane):
                out.append(ColliderFrames(name, s, shape, plane_pose(shape).expand(frames, 4, 4)))
                continue
            assert states is not None and means is not None  # as there are solids
            state, mean = states[:, s, c], means[:, s, c] / scene.dt
            out.append(ColliderFrames(name, s, shape, pose_matrices(state), state[:, 7:], mean[:, :3], mean[:, 3:]))
            c += 1
        assert c == len(solids_of(scene))
    return tuple(out)


def pose_matrices(state: Tensor) -> Tensor:
    """Return the matrices of poses given by position and unit quaternion (w, x, y, z), (K, 4, 4)."""
    turn = state[:, None, 3:7].expand(-1, 3, 4)
    axes = torch.eye(3, dtype=state.dtype, device=state.device).expand(len(state), 3, 3)
    top = torch.cat([rotate(turn, axes).mT, state[:, :3, None]], dim=2)
    bottom = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=state.dtype, device=state.device).expand(len(state), 1, 4)
    return torch.cat([top, bottom], dim=1)


def plane_pose(plane: Plane) -> Tensor:
    """Return the pose of a plane, with its normal along the local y axis, (4, 4) float64."""
    y = torch.tensor(plane.normal, dtype=torch.float64)
    y = y / y.norm()
    least = torch.zeros(3, dtype=torch.float64)
    least[int(y.abs().argmin())] = 1.0
    x = torch.linalg.cross(y, least)
    x = x / x.norm()
    out = torch.eye(4, dtype=torch.float64)
    out[:3, :3] = torch.stack([x, y, torch.linalg.cross(x, y)], dim=1)
    out[:3, 3] = torch.tensor(plane.point, dtype=torch.float64)
    return out
