"""The nodes of a grid: their places in the array, and scratch memory of four numbers a node."""

import math
from collections.abc import Sequence

import torch
import warp as wp
from torch import Tensor

from neuido.physics.multibody.contact_grid import ContactGrid


class Nodes:
    """The nodes of one shape of grid, with scratch memory.

    Args:
        fields: Scene of each velocity field, (fields,) int64.
        shape: Nodes along each axis, padding included.
        dtype: Scalar type of the scratch memory.
        device: Device of the arrays.

    Attributes:
        shape: Velocity fields, and nodes along each axis.
        count: Number of nodes of all fields.
        size: Nodes along each axis.
        index: Place along each axis, and scene, of each node, (count, 4) int32.
        near: Whether a node is in or near a collider or clamp, (count,) uint8; `mark_nodes` of the kernels writes it.
        chunk: Nodes of one thread: on the CPU a column, since calling a thread costs as much there as a node.
        contact: Contact between bodies with fields of their own, which needs memory for each node; None where there are none.
    """

    def __init__(self, fields: Tensor, shape: Sequence[int], dtype: torch.dtype, device: torch.device) -> None:
        self.shape, self.dtype, self.device = (len(fields), *shape), dtype, device
        self.count = math.prod(self.shape)
        self.size = wp.vec3i(*shape)
        axes = (torch.arange(n, dtype=torch.int32) for n in shape)
        s, i, j, k = torch.meshgrid(fields.int().cpu(), *axes, indexing="ij")
        self.index = torch.stack([i, j, k, s], dim=-1).reshape(-1, 4).to(device)
        self.near = torch.ones(self.count, dtype=torch.uint8, device=device)
        self.chunk = self.shape[3] if device.type == "cpu" else 1
        self.contact: ContactGrid | None = None
        self._scratch: dict[str, Tensor] = {}

    def scratch(self, name: str) -> Tensor:
        """Return a buffer of four numbers a node, (count, 4), reused by later rollouts."""
        if name not in self._scratch:
            self._scratch[name] = torch.empty(self.count, 4, dtype=self.dtype, device=self.device)
        return self._scratch[name]
