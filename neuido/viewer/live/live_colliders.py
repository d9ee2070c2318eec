"""Solid colliders of a live simulation: they keep their motion from one chunk of substeps to the next, and follow the sliders."""

from typing import Any

import numpy as np
import torch

from neuido.physics.colliders.solid_tables import SolidInputs, path_poses, solids_of, twists_of

FASTEST = 0.25
"""Largest share of a cell by which a slider moves a collider in a substep."""


class LiveColliders:
    """The solids of the scene of a simulator, and where they are.

    Args:
        simulator: A `Simulator` of one scene.

    Attributes:
        shapes: The solids.
        poses: Position [m] and unit quaternion (w, x, y, z) now, (C, 7).
    """

    def __init__(self, simulator: Any) -> None:
        self.simulator, self.scene = simulator, simulator.scenes[0]
        self.shapes = solids_of(self.scene)
        self.reset()

    def reset(self) -> None:
        """Return to t = 0; what the sliders ask for stays."""
        start = self.simulator.solid_inputs(1) if self.shapes else None
        self.poses = np.zeros((0, 7)) if start is None else start.pose[0].cpu().numpy().copy()
        self._velocity = np.zeros((0, 6)) if start is None else start.velocity[0].cpu().numpy().copy()
        self.targets: dict[int, np.ndarray] = getattr(self, "targets", {})

    def movable(self) -> list[int]:
        """Return the indices of the solids that sliders may move: neither free nor on a path."""
        return [i for i, solid in enumerate(self.shapes) if solid.mass is None and solid.path is None]

    def inputs(self, count: int, begun: float) -> SolidInputs | None:
        """Return the poses and velocities of the solid colliders for a chunk of substeps; None if there are no solids.

        Args:
            count: Number of substeps.
            begun: Simulated time at the start of the chunk [s].
        """
        if not self.shapes:
            return None
        own, dt = self.simulator.solid_inputs(count), self.scene.dt
        pose, velocity = torch.from_numpy(self.poses)[None], torch.from_numpy(self._velocity)[None]
        twist = own.twist.expand(count, *own.twist.shape[1:]).clone().cpu()
        for i, solid in enumerate(self.shapes):
            if solid.path is not None:
                at = path_poses(solid.path, solid.rotation, begun + dt * np.arange(count + 1))
                twist[:, 0, i] = torch.from_numpy(twists_of(at, dt))
            elif i in self.targets and solid.mass is None:
                way = (self.targets[i] - self.poses[i, :3]) / (count * dt)
                largest = FASTEST * self.scene.dx / dt
                way *= min(1.0, largest / max(float(np.linalg.norm(way)), 1e-30))
                twist[:, 0, i, :3] = torch.from_numpy(way)
        return own._replace(pose=pose.to(own.pose), velocity=velocity.to(own.velocity), twist=twist.to(own.twist))

    def follow(self, frames: Any) -> None:
        """Take poses and velocities from the last frame of a chunk."""
        from scipy.spatial.transform import Rotation

        moved = [each for each in frames.colliders if each.velocity is not None]
        for i, each in enumerate(moved):
            matrix = each.poses[-1].detach().cpu().numpy()
            x, y, z, w = Rotation.from_matrix(matrix[:3, :3]).as_quat()
            self.poses[i] = (*matrix[:3, 3], w, x, y, z)
            self._velocity[i] = each.velocity[-1].detach().cpu().numpy()
