"""Scores of a predicted motion, frame by frame: Chamfer distance with its floor, matched RMSE, and images on views that were held out."""

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torchmetrics.functional.image import structural_similarity_index_measure

from neuido.models.inference.pipeline import carry_points, render_motion
from neuido.models.inference.prepared_scene import PreparedScene
from neuido.models.scoring.lpips import LPIPS, Absent
from neuido.models.scoring.metrics import chamfer_distance, resampling_floor
from neuido.models.video.flow import body_window
from neuido.types import ParticleState

CD_SCALE = 1e4
"""Of Chamfer distances, in coordinates of the unit cube (the paper's tables)."""


def chamfer_per_frame(prepared: PreparedScene, motion: ParticleState) -> Tensor:
    """Return Chamfer distance times 1e4 to the true particles in each frame after the first, (K - 1,); the truth must be known."""
    target = prepared.source.truth.x[1 : len(motion.x)].to(motion.x)
    return CD_SCALE * chamfer_distance(motion.x[1 : len(target) + 1], target)


def floor_per_frame(prepared: PreparedScene) -> Tensor:
    """Return `resampling_floor` times 1e4 of the truth in each frame after the first, (T - 1,): the same whatever is predicted."""
    return CD_SCALE * resampling_floor(prepared.source.truth.x[1:].to(prepared.simulator.state.x))


def score_motion(prepared: PreparedScene, motion: ParticleState, floor: Tensor | None = None) -> list[dict[str, float]]:
    """Score a motion against the true particles in each frame after the first; no rows where the truth is not known.

    `cd` is the Chamfer distance times 1e4, `floor` what a perfect law with other particles would score (`resampling_floor`), `rmse` [m]
    the root mean square distance of the true particles from where the prediction carries them (`pipeline.carry_points`).

    Args:
        prepared: The scene.
        motion: K frames.
        floor: Of `floor_per_frame`, where it is at hand.
    """
    truth = prepared.source.truth
    if truth is None:
        return []
    target = truth.x[: len(motion.x)].to(motion.x)
    carried = carry_points(motion.x[0], target[0], motion.x[: len(target)].detach())[1:]
    rmse = (carried - target[1:]).square().sum(-1).mean(-1).sqrt()
    floor = (floor_per_frame(prepared) if floor is None else floor)[: len(rmse)]
    table = torch.stack([chamfer_per_frame(prepared, motion), floor, rmse], 1).tolist()  # the one wait for the device
    return [{"frame": k, "cd": cd, "floor": low, "rmse": error} for k, (cd, low, error) in enumerate(table, 1)]


@torch.no_grad()
def score_images(prepared: PreparedScene, motion: ParticleState, views: Sequence[int], lpips: LPIPS | Absent) -> list[dict[str, Any]]:
    """Return PSNR [dB], SSIM, LPIPS and the silhouettes' intersection over union of each frame after the first and each view.

    The image measures are of the full frame, and of the crop around the body (`crop_`).

    A value that there is no way to compute is absent.
    """
    rows = []
    for view in views:
        images, alphas = render_motion(prepared, motion, [view])
        recorded = prepared.recorded([view], len(images))
        whole = _image_rows(images[1:, 0].clamp(0, 1), recorded[1:, 0], lpips)
        masks = prepared.silhouettes([view], len(images))[:, 0]
        overlap = intersection_over_union(alphas[1:, 0], masks[1:]).tolist()
        top, left, side = body_window(masks)
        cut = (slice(1, None), 0, slice(top, top + side), slice(left, left + side))
        crop = _image_rows(images[cut].clamp(0, 1), recorded[cut], lpips)
        for k, (a, b, iou) in enumerate(zip(whole, crop, overlap)):
            rows.append({"frame": k + 1, "view": view, **a, "iou": iou, **{f"crop_{name}": value for name, value in b.items()}})
    return rows


def intersection_over_union(alphas: Tensor, masks: Tensor) -> Tensor:
    """Return the intersection over union (K,) of silhouettes (K, H, W) at half coverage; one where both are empty."""
    a, b = alphas > 0.5, masks > 0.5
    either = (a | b).sum((1, 2))
    return torch.where(either > 0, (a & b).sum((1, 2)) / either.clamp(min=1), 1.0)


def _image_rows(images: Tensor, recorded: Tensor, lpips: LPIPS | Absent) -> list[dict[str, float]]:
    """Score K images (K, H, W, 3) against the recorded ones."""
    psnr = -10 * (images - recorded).square().mean((1, 2, 3)).clamp(min=1e-10).log10()
    columns = {"psnr": psnr}
    a, b = images.permute(0, 3, 1, 2).contiguous(), recorded.permute(0, 3, 1, 2).contiguous()
    if min(a.shape[-2:]) >= 11:  # the window of SSIM
        with torch.backends.cudnn.flags(enabled=torch.backends.cudnn.enabled, allow_tf32=False):  # a variance is a small difference
            ssim = [structural_similarity_index_measure(x, y, data_range=1.0, reduction="none") for x, y in zip(a.split(16), b.split(16))]
        columns["ssim"] = torch.cat([part.reshape(-1) for part in ssim])
    if isinstance(lpips, LPIPS) and min(a.shape[-2:]) >= 32:
        columns["lpips"] = torch.cat([lpips(x, y) for x, y in zip(a.split(8), b.split(8))])
    return [dict(zip(columns, row)) for row in torch.stack(list(columns.values()), 1).tolist()]


def mean_of(rows: Sequence[dict[str, Any]], names: Sequence[str]) -> dict[str, float]:
    """Average the named columns over the rows that have them."""
    out = {}
    for name in names:
        values = [row[name] for row in rows if name in row and math.isfinite(row[name])]
        if values:
            out[name] = sum(values) / len(values)
    return out


def mean_from_frame(
    particles: Sequence[dict[str, Any]], pictures: Sequence[dict[str, Any]], first: int, names: Sequence[str]
) -> dict[str, float]:
    """Average the named columns over the frames from `first` on, of the rows of particles and of images."""
    parts = [mean_of([row for row in rows if row["frame"] >= first], names) for rows in (particles, pictures)]
    return parts[0] | parts[1]
