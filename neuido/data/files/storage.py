"""The folder of trajectories on disk.

It holds `plan.json` (what is to be made), one `<name>.npy` per trajectory, and, when all are there, `index.json` (the plan with each
trajectory's statistics). A trajectory is (T, P, 27) float32: for each recorded substep and particle the trial deformation gradient,
the corrected one and the Kirchhoff stress [Pa], nine numbers each. A file appears under its name only when it is whole.
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
    """Whether a trajectory's file is there, whole and of this shape."""
    if not path.is_file():
        return False
    try:
        array = np.load(path, mmap_mode="r")
    except (ValueError, EOFError, OSError):  # numpy's answers to a file that is cut short
        return False
    return array.shape == shape and array.dtype == np.float32


def write_text(path: Path, text: str) -> None:
    """Write a small file all at once; several processes may write the same one."""
    with atomic_write(path) as hidden:
        hidden.write_text(text)


def claim_folder(folder: Path, text: str, held: str, *, compared: str | None = None) -> None:
    """Make a folder with `plan.json`, or check that its plan is this one.

    Args:
        folder: Where several runs, one after the other or at once, make the same files.
        text: The plan, JSON.
        held: What the folder of another plan is said to hold.
        compared: Key of the plan whose entries the error compares.

    Raises:
        UserError: The folder cannot be made, or has another plan.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError) as error:
        raise UserError(f"out = {folder} cannot be a folder: {error.filename} is a file") from error
    except OSError as error:
        raise UserError(f"out = {folder} cannot be made: {str(error.strerror).lower()} for {error.filename}") from error
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
    changed = [f"{name} {old.get(name)} there, {value} here" for name, value in json.loads(text)[key].items() if old.get(name) != value]
    return f" ({'; '.join(changed)})" if changed else ""


def publish(hidden: Path, path: Path) -> None:
    """Make a finished temporary file of the same folder appear under its name, all at once and for good."""
    _sync(hidden)
    os.replace(hidden, path)
    _sync(path.parent)


def publish_folder(hidden: Path, folder: Path) -> None:
    """Make a finished temporary folder appear under its name, all at once and for good."""
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
    """The memory-mapped arrays of several trajectories, opened when first read (and again in each worker)."""

    def __init__(self, paths: list[Path]) -> None:
        self.paths = paths

    @cached_property
    def arrays(self) -> list[np.ndarray]:
        """One (T P, 27) array per trajectory."""
        return [np.load(path, mmap_mode="r").reshape(-1, COLUMNS) for path in self.paths]

    def __getstate__(self) -> dict[str, Any]:
        return {"paths": self.paths}

    def gather(self, rows: Tensor) -> TrajectoryBatch:
        """Return the samples at the rows t P + p of each trajectory, (M, n) int64, on the CPU."""
        picked = np.stack([array[index] for array, index in zip(self.arrays, rows.numpy(), strict=True)])
        return to_batch(torch.from_numpy(picked))

    def load(self, device: torch.device) -> Tensor:
        """Load everything, (M, T P, 27) float32 on the device."""
        out = torch.empty(len(self.arrays), *self.arrays[0].shape, dtype=torch.float32, device=device)
        for target, array in zip(out, self.arrays, strict=True):
            target.copy_(torch.from_numpy(np.array(array)))
        return out


def to_batch(rows: Tensor) -> TrajectoryBatch:
    """Return stored columns (M, n, 27) as a batch of M n samples sorted by trajectory."""
    trajectories, samples = rows.shape[:2]
    trial, corrected, stress = rows.reshape(-1, 3, 3, 3).transpose(0, 1).contiguous()
    index = torch.arange(trajectories, device=rows.device).repeat_interleave(samples)
    return TrajectoryBatch(trial, corrected, stress, index)
