"""Shared parts of Stage II and few-shot adaptation: image losses, the rollout curriculum, scores and output files."""

import functools
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, cast

import torch
from torch import Tensor
from torch.nn import functional

from neuido.data.files.score_tables import write_rows
from neuido.errors import UserError
from neuido.models.inference.outputs import contact_sheet, write_particles, write_video
from neuido.models.inference.pipeline import render_motion
from neuido.models.inference.prepared_scene import PreparedScene
from neuido.models.scoring import motion_scores as scores
from neuido.models.scoring.lpips import LPIPS, Absent, open_lpips
from neuido.models.stages.training import SteadyModule
from neuido.types import ParticleState

SCORES = ("cd", "floor", "rmse", "psnr", "ssim", "flip", "lpips", "iou", "crop_psnr", "crop_ssim", "crop_flip", "crop_lpips")
STILL_IMAGE, STILL_MASK = 1e-6, 1e-5
"""Floors of the mean squared change from the first frame; it vanishes for a body at rest."""


def without_gradients(method: Callable) -> Callable:
    """Run a method without gradients but outside inference mode, whose tensors cannot be used in training afterwards."""

    @functools.wraps(method)
    def run(*arguments, **options):
        with torch.inference_mode(False), torch.no_grad():
            return method(*arguments, **options)

    return run


def check_options(counts: dict[str, int], weights: dict[str, float], shares: dict[str, float], curriculum: Sequence[float]) -> None:
    """Check that counts and weights are not negative and that shares lie between 0 and 1.

    Raises:
        UserError: An option is out of range; the message names it.
    """
    for name, value in {**counts, **weights}.items():
        if not value >= 0:
            raise UserError(f"model.{name} = {value}: it must not be negative")
    for name, value in shares.items():
        if not 0 <= value <= 1:
            raise UserError(f"model.{name} = {value}: it must lie between 0 and 1")
    if not all(0 < share <= 1 for share in curriculum):
        raise UserError(f"model.curriculum = {curriculum}: each share must be above 0 and at most 1")


def curriculum_frames(done: float, frames: int, curriculum: Sequence[float], curriculum_share: float) -> int:
    """Return the rollout length, in frames, after a fraction `done` of a run: each share of the curriculum in turn, then all frames."""
    if not curriculum or done >= curriculum_share:
        return frames
    share = curriculum[min(int(done / curriculum_share * len(curriculum)), len(curriculum) - 1)]
    return min(frames, max(2, math.ceil(share * frames)))


def sample_views(views: list[int], count: int, step: int) -> list[int]:
    """Sample `count` views (0: all), seeded by the step so that a resumed run samples the same views."""
    if not 0 < count < len(views):
        return views
    order = torch.randperm(len(views), generator=torch.Generator().manual_seed(step))
    return [views[i] for i in order[:count].tolist()]


def image_losses(prepared: PreparedScene, motion: ParticleState, views: list[int], loss: str = "relative") -> tuple[Tensor, Tensor]:
    """Return the squared errors of images and silhouettes: as they are (`mse`), or relative to the error of a still first frame."""
    frames = len(motion.x)
    images, alphas = render_motion(prepared, motion, views)
    recorded, masks = prepared.recorded(views, frames), prepared.silhouettes(views, frames)
    if loss == "mse":
        return functional.mse_loss(images, recorded), functional.mse_loss(alphas, masks)
    still = (functional.mse_loss(t, t[:1].expand_as(t)) for t in (recorded, masks))
    floors = (STILL_IMAGE, STILL_MASK)
    return tuple(  # type: ignore[return-value]
        functional.mse_loss(a, b) / (s + floor) for a, b, s, floor in zip((images, alphas), (recorded, masks), still, floors)
    )


class ImageModule(SteadyModule):
    """Base class that scores filmed scenes; subclasses have the options `out`, `lpips_backbone` and `lpips_net`."""

    def __init__(self) -> None:
        super().__init__()
        self._floors: dict[str, Tensor] = {}

    def score_motion(
        self, prepared: PreparedScene, motion: ParticleState, *, images: bool = True
    ) -> tuple[dict[str, float], list[dict[str, Any]], list[dict[str, Any]]]:
        """Score a motion; return the means, and the rows of each frame for particles and for images of the held-out views."""
        particles = scores.score_motion(prepared, motion, self._floor(prepared))
        pictures = scores.score_images(prepared, motion, prepared.scoring_views, self._lpips()) if images else []
        return scores.mean_of(particles, SCORES) | scores.mean_of(pictures, SCORES), particles, pictures

    def _floor(self, prepared: PreparedScene) -> Tensor | None:
        """Return the resampling floor of a scene, which is cached because it depends only on the truth."""
        name = prepared.source.name
        if prepared.source.truth is not None and name not in self._floors:
            self._floors[name] = scores.floor_per_frame(prepared)
        return self._floors.get(name)

    def _lpips(self) -> LPIPS | Absent:
        if not hasattr(self, "_lpips_module"):
            opened = open_lpips(self.hparams.lpips_backbone, self.hparams.lpips_net, self.device)
            object.__setattr__(self, "_lpips_module", opened)  # not part of the checkpoint
        return cast(LPIPS | Absent, self._lpips_module)

    def _log(self, values: dict[str, Tensor | float]) -> None:
        if self._trainer is not None:
            plain = {name: value.detach() if isinstance(value, Tensor) else value for name, value in values.items()}
            self.log_dict(plain, prog_bar=False, batch_size=1)

    def _report_missing_lpips(self) -> None:
        absent = self._lpips()
        if isinstance(absent, Absent):
            self.print(f"LPIPS is not available: {absent.reason}")


def write_frame_scores(folder: Path, particles: list[dict[str, Any]], pictures: list[dict[str, Any]]) -> None:
    """Write the rows of `ImageModule.score_motion` to particles.csv and images.csv."""
    write_rows(folder / "particles.csv", particles)
    write_rows(folder / "images.csv", pictures)


def write_prediction(folder: Path, prepared: PreparedScene, motion: ParticleState) -> None:
    """Write the particles, and a video and contact sheet that compare recorded and predicted frames in one scoring view."""
    view = prepared.scoring_views[0]
    images, recorded = render_motion(prepared, motion, [view])[0][:, 0], prepared.recorded([view])[:, 0]
    write_particles(folder / "particles", motion, prepared.times(len(motion.x)))
    write_video(folder / "prediction.mp4", torch.cat([recorded, images], 2))
    contact_sheet(folder / "prediction.png", [recorded, images])
