"""Clips of `neuido film` as training data: windows of optical flow for the VAE, whole clips for the warm-up of the projector.

The folder has `plan.json` (the clips to generate), one `clip-<number>.npz` per clip and, when all are complete, `index.json`. A clip has
flow (V, T - 1, S, S, 2) float16 [m/s], cell (V,) [m], frame_interval [s], and n samples of its law: trial (n, 3, 3), corrected (n, 3, 3)
and stress (n, 3, 3) [Pa], float32.
"""

from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from lightning.pytorch import LightningDataModule
from torch import Tensor
from torch.utils.data import DataLoader, Dataset, TensorDataset

from neuido.data.bodies.families import check_entry
from neuido.data.files.parsing import is_zip, read_arrays, read_json
from neuido.data.files.values import list_of_mappings
from neuido.errors import UserError

FORMAT = "neuido-films/1"


class Clip(NamedTuple):
    """One filmed motion from V views, and n samples of its material law."""

    flow: Tensor
    """Optical flow in physical units [m/s], (V, T - 1, S, S, 2)."""
    cell: Tensor
    """Size of one of the S x S cells at the distance of the body [m], (V,)."""
    frame_interval: float
    """Time between frames [s]."""
    trial: Tensor
    """Trial deformation gradients, (n, 3, 3)."""
    corrected: Tensor
    """Deformation gradients after the plastic correction, (n, 3, 3)."""
    stress: Tensor
    """Kirchhoff stress [Pa], (n, 3, 3)."""


class FlowBatch(NamedTuple):
    """Batch of optical-flow windows."""

    flow: Tensor
    """Optical flow [m/s], (B, t, S, S, 2)."""


def is_complete(path: Path) -> bool:
    """Whether the file of a clip exists and is complete."""
    return is_zip(path)


def read_clip(path: Path) -> Clip:
    """Read a clip file.

    Raises:
        UserError: The file is missing, truncated or not a clip.
    """
    arrays = read_arrays(path, Clip._fields, what="clip of `neuido film`")
    for name, array in arrays.items():
        if array.dtype.kind != "f" or array.dtype.itemsize > 8 or not np.isfinite(array).all():
            raise UserError(f"{path} is not a valid clip of `neuido film`: {name} must hold finite floating-point numbers")
    flow, cell = arrays["flow"], arrays["cell"]
    if arrays["frame_interval"].size != 1 or not arrays["frame_interval"].reshape(()) > 0:
        raise UserError(f"{path} is not a valid clip of `neuido film`: frame_interval must be one number")
    if flow.ndim != 5 or flow.shape[2] != flow.shape[3] or flow.shape[4] != 2 or cell.shape != flow.shape[:1] or min(flow.shape) < 1:
        raise UserError(f"{path} is not a valid clip of `neuido film`: flow and cell have the shapes {flow.shape} and {cell.shape}")
    if any(arrays[name].shape != (*arrays["trial"].shape[:1], 3, 3) for name in ("trial", "corrected", "stress")):
        raise UserError(f"{path} is not a valid clip of `neuido film`: trial, corrected and stress must be (n, 3, 3)")
    parts = {name: torch.from_numpy(arrays[name]) for name in Clip._fields if name != "frame_interval"}
    return Clip(**parts, frame_interval=float(arrays["frame_interval"].reshape(())))


class FlowWindows(Dataset):
    """Random windows of the optical flow of clips; a window is a function of the seed and its index only."""

    def __init__(self, paths: list[Path], frames: int, per_clip: int, seed: int) -> None:
        self.paths, self.frames, self.per_clip, self.seed = paths, frames, per_clip, seed

    def __len__(self) -> int:
        return len(self.paths) * self.per_clip

    def __getitem__(self, index: int) -> Tensor:
        clip = read_clip(self.paths[index // self.per_clip])
        random = np.random.default_rng([self.seed, index])
        v = int(random.integers(len(clip.flow)))
        start = int(random.integers(max(1, clip.flow.shape[1] - self.frames + 1)))
        flow = clip.flow[v, start : start + self.frames].float()
        if random.random() < 0.5:  # the mirrored motion has the same law
            flow = flow.flip(2) * flow.new_tensor([-1.0, 1.0])
        return flow


class FilmDataModule(LightningDataModule):
    """Lightning data module of the clips of `neuido film`.

    Args:
        root: Folder of the clips.
        batch_size: Windows or clips per batch.
        frames: Flow frames of a window, a multiple of 4; the VAE sees one video frame more. 0: batches of clip numbers, for the warm-up.
        windows: Windows of each clip per epoch.
        held_out: Fraction of the clips for validation; the last clips are used.
        num_workers: Number of worker processes that read.
        seed: Seed of the order and of the windows.
    """

    def __init__(
        self,
        root: str = "data/films",
        *,
        batch_size: int = 16,
        frames: int = 16,
        windows: int = 2,
        held_out: float = 0.1,
        num_workers: int = 0,
        seed: int = 0,
    ) -> None:
        super().__init__()
        if batch_size < 1 or windows < 1 or frames < 0 or frames % 4:
            raise UserError(f"batch_size = {batch_size} and windows = {windows} must be at least 1, and frames = {frames} a multiple of 4")
        if not 0 < held_out < 1:
            raise UserError(f"held_out must be a fraction between 0 and 1, got {held_out}")
        self.root, self.batch_size, self.frames, self.windows = Path(root), batch_size, frames, windows
        self.held_out, self.num_workers, self.seed = held_out, num_workers, seed

    @cached_property
    def index(self) -> dict[str, Any]:
        """The content of index.json.

        Raises:
            UserError: The folder is missing, incomplete or of another format.
        """
        path = self.root / "index.json"
        if not path.is_file():
            raise UserError(f"data.root = {self.root} has no finished clips: generate them with `neuido film --out {self.root}`")
        content = read_json(path)
        if not isinstance(content, dict):
            raise UserError(f"{path} must contain a mapping of keys to values")
        if content.get("format") != FORMAT:
            raise UserError(f"{path} has the format {content.get('format')!r}, not {FORMAT!r}")
        for i, entry in enumerate(list_of_mappings(content.get("clips"), f"{path}: clips")):
            check_entry(entry, f"{path}: clips[{i}]")
        return content

    @property
    def clips(self) -> list[dict[str, Any]]:
        """Name, family and parameters of each clip."""
        return self.index["clips"]

    @property
    def training_count(self) -> int:
        """Number of training clips; the clips after them are held out."""
        count = len(self.clips)
        kept = count - max(1, round(self.held_out * count))
        if kept < 1:
            raise UserError(f"data.root = {self.root} has {count} clips, too few to hold one out: generate more")
        return kept

    def read(self, number: int) -> Clip:
        """Read the clip with this number."""
        return read_clip(self.root / f"{self.clips[number]['name']}.npz")

    def train_dataloader(self) -> DataLoader:
        return self._loader(range(self.training_count), shuffle=True)

    def val_dataloader(self) -> DataLoader:
        return self._loader(range(self.training_count, len(self.clips)), shuffle=False)

    def test_dataloader(self) -> DataLoader:
        return self.val_dataloader()

    def _loader(self, numbers: range, *, shuffle: bool) -> DataLoader:
        if self.frames == 0:
            dataset: Dataset = TensorDataset(torch.tensor(list(numbers)))
            collate = _numbers
        else:
            paths = [self.root / f"{self.clips[i]['name']}.npz" for i in numbers]
            epoch = self.trainer.current_epoch if self.trainer is not None and shuffle else 0
            dataset = FlowWindows(paths, self.frames, self.windows, self.seed + 1000 * epoch)
            collate = _stack
        generator = torch.Generator().manual_seed(self.seed)
        size = min(self.batch_size, len(dataset))  # type: ignore[arg-type]
        return DataLoader(
            dataset, size, shuffle=shuffle, generator=generator, num_workers=self.num_workers, collate_fn=collate, drop_last=shuffle
        )


def _numbers(rows: list[tuple[Tensor]]) -> Tensor:
    return torch.stack([row[0] for row in rows])


def _stack(rows: list[Tensor]) -> FlowBatch:
    return FlowBatch(torch.stack(rows))
