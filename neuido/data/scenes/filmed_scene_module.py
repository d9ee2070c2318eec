"""Lightning data module of filmed bodies for Stage II, scoring and prediction; a batch is one scene."""

import os
from collections.abc import Iterable, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lightning.pytorch import LightningDataModule
from torch.utils.data import DataLoader, Dataset

from neuido.data.bodies.scene_files import VARIABLE, data_root
from neuido.data.sampling import ResumableLoader
from neuido.data.scenes.filmed_scene import VisualScene, load_visual_scene
from neuido.data.scenes.known_body import load_known_body
from neuido.errors import UserError, suggest
from neuido.types import MultiViewBatch

KEYS = {
    "reconstruction": ("reconstruction", "recording", "views", "frame_interval"),
    "particles": ("recording", "views", "dt", "crop", "frame_interval"),
}
"""Keys of a scene's mapping beside `path`, by the source of its body (key `body`)."""


def ordered_loader(scenes: Sequence[VisualScene], *, rank: int = 0, ranks: int = 1) -> DataLoader:
    """Create a loader of scenes in the given order; process `rank` of `ranks` loads every `ranks`-th scene."""
    return DataLoader(_SceneList(scenes[rank::ranks]), batch_size=1, collate_fn=_only)


class _SceneList(Dataset):
    """List of scenes as a dataset."""

    def __init__(self, scenes: Sequence[VisualScene]) -> None:
        self.scenes = list(scenes)

    def __len__(self) -> int:
        return len(self.scenes)

    def __getitem__(self, index: int) -> VisualScene:
        return self.scenes[index]


def _only(samples: list[VisualScene]) -> VisualScene:
    return samples[0]


class ShuffledScenes(ResumableLoader[VisualScene]):
    """Resumable loader of scenes in random order, a function of seed and epoch only.

    Args:
        scenes: The scenes.
        seed: Seed of the order.
        rank: Index of this process.
        ranks: Number of processes. If it does not divide the number of scenes, the first scenes of the order are loaded twice.
    """

    def __init__(self, scenes: Sequence[VisualScene], *, seed: int = 0, rank: int = 0, ranks: int = 1) -> None:
        super().__init__({"scenes": len(scenes), "ranks": ranks})
        self.scenes, self.seed, self.rank, self.ranks = list(scenes), seed, rank, ranks

    def __len__(self) -> int:
        return -(-len(self.scenes) // self.ranks)

    def batches(self, epoch: int, start: int) -> Iterable[VisualScene]:
        count = len(self.scenes)
        order = np.random.default_rng([self.seed, epoch]).permutation(count).tolist()
        return (self.scenes[order[(k * self.ranks + self.rank) % count]] for k in range(start, len(self)))


class SequentialScenes(ResumableLoader[VisualScene]):
    """Resumable loader whose epoch e repeats scene e for `steps` steps, or the last scene where other processes have more.

    Args:
        scenes: The scenes of this process.
        steps: Steps of each scene.
        total: Number of scenes of all processes, which must be equal when a run is resumed; that of `scenes` where absent.
    """

    def __init__(self, scenes: Sequence[VisualScene], *, steps: int, total: int | None = None) -> None:
        super().__init__({"scenes": len(scenes) if total is None else total, "steps": steps})
        self.scenes, self.steps = list(scenes), steps

    def __len__(self) -> int:
        return self.steps

    def batches(self, epoch: int, start: int) -> Iterable[VisualScene]:
        return [self.scenes[min(epoch, len(self.scenes) - 1)]] * (self.steps - start)


def select_training_views(batch: MultiViewBatch, views: int | list[int]) -> MultiViewBatch:
    """Select training views of a scene; held-out views stay.

    Args:
        batch: Images of V views.
        views: Number of training views, spaced evenly, or their indices among the views that are not held out.

    Raises:
        UserError: The scene has fewer training views, or an index is out of range.
    """
    there = (~batch.held_out).nonzero()[:, 0].tolist()
    if isinstance(views, int):
        if not 0 < views <= len(there):
            raise UserError(f"data.training_views = {views}: {batch.name} has only {len(there)} views that are not held out")
        chosen = torch.linspace(0, len(there) * (1 - 1 / views), views).round().long().tolist()
    else:
        chosen = sorted(set(views))
        if not chosen or not all(0 <= view < len(there) for view in chosen):
            raise UserError(f"data.training_views = {views}: the indices of {batch.name} range from 0 to {len(there) - 1}")
    kept = sorted([*(there[i] for i in chosen), *batch.held_out.nonzero()[:, 0].tolist()])
    cameras = batch.cameras._replace(viewmats=batch.cameras.viewmats[kept], Ks=batch.cameras.Ks[kept])
    return batch._replace(images=batch.images[kept], masks=batch.masks[kept], cameras=cameras, held_out=batch.held_out[kept])


class VisualDataModule(LightningDataModule):
    """Lightning data module of filmed bodies, each with the output of `neuido reconstruct`.

    Training and validation use `scenes`; test and predict use `scenes` and `unseen`. Several processes share the scenes: each batch is of
    one of them, or, with the strategy `scenes` of an adaptation, each process opens some of the scenes alone.

    Args:
        scenes: Folders, or mappings with `path` and options of `load_visual_scene`: `reconstruction`, `recording`, `views`,
            `frame_interval`. With `body: particles`, the options are those of `load_known_body`: `recording`, `views`, `dt`, `crop`,
            `frame_interval`.
        unseen: Scenes that training does not use.
        root: Folder that the paths of scenes are relative to. None: the current folder, and then NEUIDO_DATA.
        reconstructions: Folder with a reconstruction of each scene under the name of the scene folder. None: inside each scene folder.
        frame_step: Use every n-th frame.
        frame_count: Number of frames; None: all.
        width: Width of the images [px]; None: as recorded.
        background: Colour behind the object if a mask is known, `white` or `black`.
        training_views: Number of training views, spaced evenly, or their indices among the views that are not held out; None: all.
        seed: Seed of the order of the scenes, which differs between epochs.
    """

    def __init__(
        self,
        scenes: list[str | dict[str, Any]],
        *,
        unseen: list[str | dict[str, Any]] | None = None,
        root: str | None = None,
        reconstructions: str | None = None,
        frame_step: int = 1,
        frame_count: int | None = None,
        width: int | None = None,
        background: str = "white",
        training_views: int | list[int] | None = None,
        seed: int = 0,
    ) -> None:
        super().__init__()
        if not scenes:
            raise UserError("data.scenes is empty: name at least one folder")
        self.given, self.given_unseen, self.seed = list(scenes), list(unseen or []), seed
        self.root, self.reconstructions, self.training_views = root, reconstructions, training_views
        self.options: dict[str, Any] = {"frame_step": frame_step, "frame_count": frame_count, "width": width, "background": background}
        self.steps_in_a_row: int | None = None
        """Steps per scene, set by a model that fits the scenes one after another; an epoch is then one scene."""

    @cached_property
    def scenes(self) -> list[VisualScene]:
        """Scenes that training uses, in this process."""
        return self._all(self.given, "data.scenes")

    @cached_property
    def unseen(self) -> list[VisualScene]:
        """Scenes that training does not use, in this process."""
        return self._all(self.given_unseen, "data.unseen")

    @property
    def unseen_names(self) -> list[str]:
        return [scene.name for scene in self.unseen]

    def setup(self, stage: str | None = None) -> None:
        names = [scene.name for scene in [*self.scenes, *(self.unseen if stage in ("test", "predict") else [])]]
        for name in names:
            if names.count(name) > 1:
                raise UserError(f"data.scenes: two scenes have the name {name}: rename one of them in its experiment.yaml")
        for scene in self.scenes:
            if bool(scene.batch.held_out.all()):
                raise UserError(f"{scene.name} has no training view: all {len(scene.batch.held_out)} views are held out")

    def train_dataloader(self) -> ShuffledScenes | SequentialScenes:
        if self.steps_in_a_row is not None:
            return SequentialScenes(self.scenes, steps=self.steps_in_a_row, total=len(self.given))
        return ShuffledScenes(self.scenes, seed=self.seed, **self._share())

    def val_dataloader(self) -> DataLoader:
        return ordered_loader(self.scenes, **self._share())

    def test_dataloader(self) -> DataLoader:
        return ordered_loader([*self.scenes, *self.unseen], **self._share())

    def _share(self) -> dict[str, int]:
        """Return the share of this process in the scenes that it has opened."""
        return {} if self.trainer is None or self._apart() else {"rank": self.trainer.global_rank, "ranks": self.trainer.world_size}

    def _apart(self) -> bool:
        """Return whether each process opens scenes of its own."""
        return self.trainer is not None and getattr(self.trainer.strategy, "scenes_apart", False)

    def predict_dataloader(self) -> DataLoader:
        return self.test_dataloader()

    def __str__(self) -> str:
        """Summarise the module without opening scenes; that of Lightning opens the loaders."""
        return f"VisualDataModule({len(self.given)} scenes, {len(self.given_unseen)} unseen)"

    def transfer_batch_to_device(self, batch: VisualScene, device: torch.device, dataloader_idx: int) -> VisualScene:
        """Return the batch unchanged, because the model moves each scene to the device once."""
        return batch

    def _all(self, given: list[str | dict[str, Any]], where: str) -> list[VisualScene]:
        own = slice(self.trainer.global_rank, None, self.trainer.world_size) if self.trainer is not None and self._apart() else slice(None)
        scenes = [self._open(each, f"{where}[{i}]") for i, each in list(enumerate(given))[own]]
        if self.training_views is None:
            return scenes
        return [scene._replace(batch=select_training_views(scene.batch, self.training_views)) for scene in scenes]

    def _find(self, path: Path) -> Path:
        own = Path(self.root or ".") / path
        if self.root is None and not own.exists() and os.environ.get(VARIABLE):
            return data_root() / path
        return own

    def _open(self, given: str | dict[str, Any], where: str) -> VisualScene:
        options: dict[str, Any] = dict(given) if isinstance(given, dict) else {"path": given}
        if "path" not in options:
            raise UserError(f"{where} lacks the key 'path'")
        body = options.pop("body", "reconstruction")
        if body not in KEYS:
            raise UserError(f"{where}.body = {body!r} is unknown: choose from {', '.join(KEYS)}")
        known = ("path", "body", *KEYS[body])
        for key in options:
            if key not in known:
                raise UserError(f"unknown key {key!r} in {where}{suggest(str(key), known) or ';'} it takes {', '.join(known)}")
        path = self._find(Path(options.pop("path")).expanduser())
        if body == "reconstruction" and "reconstruction" not in options and self.reconstructions is not None:
            options["reconstruction"] = Path(self.reconstructions) / path.resolve().name
        try:
            return (load_known_body if body == "particles" else load_visual_scene)(path, **options, **self.options)
        except UserError as error:
            raise UserError(f"{where}: {error}") from error
