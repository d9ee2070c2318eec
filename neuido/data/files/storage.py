"""The trajectories folder on disk, and functions to create folders that several runs fill.

The folder has `plan.json` (the trajectories to generate), one `<name>.npy` per trajectory and, when all are complete, `index.json` (the
plan with statistics of each trajectory). A trajectory is (T, P, 27) float32. For each recorded substep and particle it holds the trial
deformation gradient, the corrected deformation gradient and the Kirchhoff stress [Pa], nine numbers each. Files are written atomically.
"""

import json
import os
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from neuido.data.files.writing import atomic_write
from neuido.errors import UserError
from neuido.types import TrajectoryBatch

FORMAT = "neuido-trajectories/1"
COLUMNS = 27


def is_complete(path: Path, shape: tuple[int, ...]) -> bool:
    """Whether the file of a trajectory exists, is complete and has this shape."""
    if not path.is_file():
        return False
    try:
        array = np.load(path, mmap_mode="r")
    except (ValueError, EOFError, OSError):  # raised by numpy for a truncated file
        return False
    return array.shape == shape and array.dtype == np.float32


def write_text(path: Path, text: str) -> None:
    """Write a text file atomically; several processes may write the same file."""
    with atomic_write(path) as hidden:
        hidden.write_text(text)


def claim_folder(folder: Path, text: str, held: str, *, compared: str | None = None) -> None:
    """Create a folder with `plan.json`, or check that an existing folder has the same plan.

    Several runs, one after another or at the same time, may then fill the folder with the same files.

    Args:
        folder: The folder.
        text: The plan as JSON.
        held: What the error message says the folder holds if its plan differs.
        compared: Key of the plan whose differing entries the error message lists.

    Raises:
        UserError: The folder cannot be created, or it has another plan.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError) as error:
        raise UserError(f"out = {folder} cannot be a folder: {error.filename} is a file") from error
    except OSError as error:
        raise UserError(f"out = {folder} cannot be created: {str(error.strerror).lower()} for {error.filename}") from error
    path = folder / "plan.json"
    if not path.exists():
        write_text(path, text)
    elif path.read_text() != text:
        changed = "" if compared is None else _difference(path, text, compared)
        raise UserError(f"{folder} holds {held}{changed}: give another out, or remove the folder")


def _difference(path: Path, text: str, key: str) -> str:
    try:
        old: dict[str, Any] = json.loads(path.read_text())[key]
    except (ValueError, KeyError):
        return ""
    changed = [
        f"{name} is {old.get(name)} there and {value} here" for name, value in json.loads(text)[key].items() if old.get(name) != value
    ]
    return f" ({'; '.join(changed)})" if changed else ""


def publish(hidden: Path, path: Path) -> None:
    """Rename a finished temporary file to its final name in the same folder, atomically and synchronised to disk."""
    _sync(hidden)
    os.replace(hidden, path)
    _sync(path.parent)


def publish_folder(hidden: Path, folder: Path) -> None:
    """Rename a finished temporary folder to its final name, atomically and synchronised to disk."""
    for path in sorted(hidden.rglob("*"), reverse=True):
        _sync(path)
    _sync(hidden)
    os.replace(hidden, folder)
    _sync(folder.parent)


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


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
