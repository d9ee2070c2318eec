"""Made scenes of known bodies for Stage II and for scores: the motions of `neuido film`'s plans, filmed again."""

import os
from collections.abc import Iterator, Sequence
from functools import cached_property
from itertools import zip_longest
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch import LightningDataModule

from neuido.data.clips import FilmDataModule
from neuido.data.progress import Progress
from neuido.data.scenes.filmed_scene import Truth, VisualScene
from neuido.data.scenes.filmed_scene_module import ShuffledScenes, ordered_loader
from neuido.errors import UserError
from neuido.models.inference.prepared_scene import as_device
from neuido.models.video.clip_generation import DENSITY, ClipPlan, ClipSetup, alike, render_clip, sample_clip, simulate_clips, steps_of
from neuido.types import MultiViewBatch, ParticleState

BATCH = 16
"""Scenes that are simulated in one launch."""


def made_scenes(
    plan: ClipPlan, numbers: Sequence[int], device: torch.device, *, fill: int = 0
) -> Iterator[tuple[ClipSetup, ParticleState, VisualScene]]:
    """Simulate and film clips of a plan; yield the set-up, the true motion and the scene of each that is stable.

    Args:
        plan: The plan.
        numbers: Numbers of the clips.
        device: Where they are simulated and rendered.
        fill: Filling of the body of the scene (`sample_clip`). With 0 its particles are those that were filmed, each with its Gaussian;
            with another it is the same body with other particles and without colours, as after a reconstruction.
    """
    for wanted in alike(plan, list(numbers)):
        for start in range(0, len(wanted), BATCH):
            group = [sample_clip(plan, i) for i in wanted[start : start + BATCH]]
            for number, clip, motion in zip(wanted[start:], group, simulate_clips(group, plan.frames, device)):
                if motion is not None:
                    own = clip if fill == 0 else sample_clip(plan, number, fill=fill)
                    yield clip, motion, _scene(plan, clip, motion, own, coloured=fill == 0, device=device)


def _scene(plan: ClipPlan, clip: ClipSetup, motion: ParticleState, own: ClipSetup, *, coloured: bool, device: torch.device) -> VisualScene:
    seen = render_clip(clip, motion, device)
    times = torch.arange(plan.frames, dtype=torch.float64) * (clip.scene.dt * clip.frame_steps)
    held_out = torch.zeros(plan.views, dtype=torch.bool)
    batch = MultiViewBatch(0, clip.name, seen["images"], seen["masks"], clip.cameras, times, held_out, torch.ones(3))
    law: dict[str, Any] = {"family": clip.family, "parameters": clip.parameters}
    truth = Truth(motion.x.cpu(), clip.body.x, clip.body.volume, times, law)
    model = {"density": DENSITY}
    return VisualScene(clip.name, clip.scene, DENSITY, model, own.body, clip.gaussians if coloured else None, batch, truth)


class MadeSceneDataModule(LightningDataModule):
    """Lightning data module of made scenes with known bodies, for Stage II over all families.

    The scenes are clips of a folder of `neuido film`, simulated and rendered again. Of its training clips, those with few substeps between
    frames are taken, the first of each family in turn.

    Args:
        root: Folder of `neuido film`.
        count: Number of scenes.
        most_steps: Largest number of substeps between frames; more make steps of the training long.
        held_out: Fraction of the clips that the warm-up held out, as of `FilmDataModule`; they are not used.
        device: auto, cpu or cuda: where the scenes are simulated and rendered.
        seed: Seed of the order of the scenes.
    """

    def __init__(
        self,
        root: str = "data/films",
        *,
        count: int = 256,
        most_steps: int = 8,
        held_out: float = 0.1,
        device: str = "auto",
        seed: int = 0,
    ) -> None:
        super().__init__()
        if count < 1 or most_steps < 1:
            raise UserError(f"data.count = {count} and data.most_steps = {most_steps} must be at least 1")
        self.films, self.count, self.most_steps = FilmDataModule(root, frames=0, held_out=held_out), count, most_steps
        self.device, self.seed = device, seed
        self.unseen_names: list[str] = []

    @cached_property
    def scenes(self) -> list[VisualScene]:
        """Scenes that training uses."""
        plan = _plan_of(self.films.index["plan"], self.films.root)
        own = [int(entry["name"].removeprefix("clip-")) for entry in self.films.clips[: self.films.training_count]]
        kept: dict[str, list[int]] = {}
        for i in own:
            if steps_of(plan, i) <= self.most_steps:
                kept.setdefault(plan.family_of(i), []).append(i)
        chosen = [i for turn in zip_longest(*kept.values()) for i in turn if i is not None][: self.count]
        if not chosen:
            raise UserError(f"data.root = {self.films.root}: no clip has at most most_steps = {self.most_steps} substeps between frames")
        with Progress("made scenes", len(chosen), unit="scenes") as work:
            found = []
            for _, _, scene in made_scenes(plan, chosen, as_device(self.device)):
                found.append(scene)
                work.update()
        return sorted(found, key=lambda scene: scene.name)

    def train_dataloader(self) -> ShuffledScenes:
        share = {} if self.trainer is None else {"rank": self.trainer.global_rank, "ranks": self.trainer.world_size}
        return ShuffledScenes(self.scenes, seed=self.seed, **share)

    def val_dataloader(self) -> Any:
        return ordered_loader(self.scenes[:: max(1, len(self.scenes) // 16)])

    def transfer_batch_to_device(self, batch: VisualScene, device: torch.device, dataloader_idx: int) -> VisualScene:
        """Return the batch unchanged, because the model moves each scene to the device once."""
        return batch


def _plan_of(content: dict[str, Any], root: str | os.PathLike) -> ClipPlan:
    """Return the plan of an index.json."""
    try:
        lists = {name: tuple(content[name]) for name in ("dts", "speeds") if name in content} | {
            "rates": None if content.get("rates") is None else tuple(content["rates"])
        }
        families = {family: {name: tuple(pair) for name, pair in ranges.items()} for family, ranges in content["families"].items()}
        return ClipPlan(**{**content, **lists, "families": families})
    except (TypeError, KeyError, AttributeError) as error:
        raise UserError(f"{Path(root) / 'index.json'} holds no plan of `neuido film` of this version: film the clips again") from error
