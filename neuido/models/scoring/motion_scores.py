"""Scores of a predicted motion for each frame: Chamfer distance and its floor, matched RMSE, and image metrics on held-out views."""

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from neuido.models.inference.pipeline import carry_points, render_motion
from neuido.models.inference.prepared_scene import PreparedScene
from neuido.models.render.similarity import structural_similarity
from neuido.models.scoring.flip import flip
from neuido.models.scoring.lpips import LPIPS, Absent
from neuido.models.scoring.metrics import chamfer_distance, resampling_floor
from neuido.models.video.flow import body_window
from neuido.types import ParticleState

CD_SCALE = 1e4
"""Factor on Chamfer distances in unit-cube coordinates, as in the paper's tables."""


def _true_positions(prepared: PreparedScene) -> Tensor:
    truth = prepared.source.truth
    assert truth is not None  # callers score against a known truth only
    return truth.x


def chamfer_per_frame(prepared: PreparedScene, motion: ParticleState) -> Tensor:
    """Return the Chamfer distance to the true particles in each frame after the first, times 1e4, (K - 1,); the truth must be known."""
    target = _true_positions(prepared)[1 : len(motion.x)].to(motion.x)
    return CD_SCALE * chamfer_distance(motion.x[1 : len(target) + 1], target)


def floor_per_frame(prepared: PreparedScene) -> Tensor:
    """Return the `resampling_floor` of the truth in each frame after the first, times 1e4, (T - 1,), whatever the prediction."""
    return CD_SCALE * resampling_floor(_true_positions(prepared)[1:].to(prepared.simulator.state.x))


def score_motion(prepared: PreparedScene, motion: ParticleState, floor: Tensor | None = None) -> list[dict[str, float]]:
    """Score a motion against the true particles in each frame after the first; returns no rows if the truth is unknown.

    `cd` is the Chamfer distance times 1e4. `floor` is the score of a perfect law with other particles (`resampling_floor`). `rmse` [m] is
    the root mean square distance between the true particles and their positions under the predicted motion (`pipeline.carry_points`).

    Args:
        prepared: The scene.
        motion: Predicted motion of K frames.
        floor: Result of `floor_per_frame`, if it was computed before.
    """
    truth = prepared.source.truth
    if truth is None:
        return []
    target = truth.x[: len(motion.x)].to(motion.x)
    carried = carry_points(motion.x[0], target[0], motion.x[: len(target)].detach())[1:]
    rmse = (carried - target[1:]).square().sum(-1).mean(-1).sqrt()
    floor = (floor_per_frame(prepared) if floor is None else floor)[: len(rmse)]
    table = torch.stack([chamfer_per_frame(prepared, motion), floor, rmse], 1).tolist()  # the only synchronisation with the device
    return [{"frame": k, "cd": cd, "floor": low, "rmse": error} for k, (cd, low, error) in enumerate(table, 1)]


@torch.no_grad()
def score_images(prepared: PreparedScene, motion: ParticleState, views: Sequence[int], lpips: LPIPS | Absent) -> list[dict[str, Any]]:
    """Return PSNR [dB], SSIM, ꟻLIP, LPIPS and the IoU of the silhouettes for each view and each frame after the first.

    Image metrics are computed on the full frame and, with the prefix `crop_`, on a crop around the body. Metrics that cannot be computed
    are left out.
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
    """Return the IoU (K,) of silhouettes (K, H, W) thresholded at 0.5; one where both are empty."""
    a, b = alphas > 0.5, masks > 0.5
    either = (a | b).sum((1, 2))
    return torch.where(either > 0, (a & b).sum((1, 2)) / either.clamp(min=1), 1.0)


def _image_rows(images: Tensor, recorded: Tensor, lpips: LPIPS | Absent) -> list[dict[str, float]]:
    """Return the image metrics of K images (K, H, W, 3) against the recorded images."""
    psnr = -10 * (images - recorded).square().mean((1, 2, 3)).clamp(min=1e-10).log10()
    columns = {"psnr": psnr}
    a, b = images.permute(0, 3, 1, 2).contiguous(), recorded.permute(0, 3, 1, 2).contiguous()
    if min(a.shape[-2:]) >= 11:  # window size of SSIM
        columns["ssim"] = torch.cat([structural_similarity(x, y) for x, y in zip(a.split(16), b.split(16))])
    columns["flip"] = torch.cat([flip(x, y) for x, y in zip(a.split(16), b.split(16))])
    if isinstance(lpips, LPIPS) and min(a.shape[-2:]) >= 32:
        columns["lpips"] = torch.cat([lpips(x, y) for x, y in zip(a.split(8), b.split(8))])
    return [dict(zip(columns, row)) for row in torch.stack(list(columns.values()), 1).tolist()]


def mean_of(rows: Sequence[dict[str, Any]], names: Sequence[str]) -> dict[str, float]:
    """Return the mean of each named column over the rows with a finite value."""
    out = {}
    for name in names:
        values = [row[name] for row in rows if name in row and math.isfinite(row[name])]
        if values:
            out[name] = sum(values) / len(values)
    return out


def mean_from_frame(
    particles: Sequence[dict[str, Any]], pictures: Sequence[dict[str, Any]], first: int, names: Sequence[str]
) -> dict[str, float]:
    """Return the mean of each named column over the frames from `first` on, for rows of particles and of images."""
    parts = [mean_of([row for row in rows if row["frame"] >= first], names) for rows in (particles, pictures)]
    return parts[0] | parts[1]
