"""The trajectories folder on disk.

The folder has `plan.json` (the trajectories to generate), one `<name>.npy` per trajectory and, when all are complete, `index.json` (the
plan with statistics of each trajectory). A trajectory is (T, P, 27) float32. For each recorded substep and particle it holds the trial
deformation gradient, the corrected deformation gradient and the Kirchhoff stress [Pa], nine numbers each. Files are written atomically.
"""

from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from neuido.types import TrajectoryBatch

FORMAT = "neuido-trajectories/1"
COLUMNS = 27


def is_complete(path: Path, shape: tuple[int, ...]) -> bool:
    """Whether the file of a trajectory exists, is complete and has this shape."""
    if not path.is_file():
        return False
    try:
        array = np.load(path, mmap_mode="r")
    except Exception:  # raised by numpy for a truncated or damaged file: ValueError, EOFError, TokenError, MemoryError, ...
        return False
    return array.shape == shape and array.dtype == np.float32


class TrajectoryFiles:
    """Memory-mapped arrays of several trajectories, opened on first access in each process."""

    def __init__(self, paths: list[Path]) -> None:
        self.paths = paths

    @cached_property
    def arrays(self) -> list[np.ndarray]:
        """One array (T P, 27) per trajectory."""
        return [np.load(path, mmap_mode="r").reshape(-1, COLUMNS) for path in self.paths]

    def __getstate__(self) -> dict[str, Any]:
        return {"paths": self.paths}

    def gather(self, rows: Tensor) -> TrajectoryBatch:
        """Read the samples at `rows` (M, n) int64 of each trajectory, numbered t P + p, as a batch on the CPU."""
        picked = np.stack([array[index] for array, index in zip(self.arrays, rows.numpy(), strict=True)])
        return to_batch(torch.from_numpy(picked))

    def load(self, device: torch.device) -> Tensor:
        """Load all trajectories to a device, (M, T P, 27) float32."""
        out = torch.empty(len(self.arrays), *self.arrays[0].shape, dtype=torch.float32, device=device)
        for target, array in zip(out, self.arrays, strict=True):
            target.copy_(torch.from_numpy(np.array(array)))
        return out


def to_batch(rows: Tensor) -> TrajectoryBatch:
    """Convert stored columns (M, n, 27) to a batch of M n samples sorted by trajectory."""
    trajectories, samples = rows.shape[:2]
    trial, corrected, stress = rows.reshape(-1, 3, 3, 3).transpose(0, 1).contiguous()
    index = torch.arange(trajectories, device=rows.device).repeat_interleave(samples)
    return TrajectoryBatch(trial, corrected, stress, index)
