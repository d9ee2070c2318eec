"""Scores of a predicted motion, frame by frame: Chamfer distance with its floor, matched RMSE, and images on views that were held out."""

import csv
import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torchmetrics.functional.image import structural_similarity_index_measure

from neuido.metrics import chamfer_distance, resampling_floor
from neuido.models.flow import window
from neuido.models.lpips import LPIPS, Absent
from neuido.models.pipeline import Prepared, draw, track
from neuido.types import ParticleState

CD_SCALE = 1e4
"""Of Chamfer distances, in coordinates of the unit cube (the paper's tables)."""


def score_motion(prepared: Prepared, motion: ParticleState) -> list[dict[str, float]]:
    """Distances to the true particles of each frame after the first; none where the truth is not known.

    `cd` is the Chamfer distance times 1e4, `floor` what a perfect law with other particles would score (`resampling_floor`), `rmse` [m]
    the root mean square distance of the true particles from where the prediction carries them (`pipeline.track`).
    """
    truth = prepared.source.truth
    if truth is None:
        return []
    target = truth.x.to(motion.x.device)
    carried = track(motion.x[0], target[0], motion.x)
    rows = []
    for k in range(1, min(len(target), len(motion.x))):
        cd = chamfer_distance(motion.x[k].detach(), target[k])
        rmse = (carried[k] - target[k]).square().sum(-1).mean().sqrt()
        floor = resampling_floor(target[k])
        rows.append({"frame": k, "cd": CD_SCALE * float(cd), "floor": CD_SCALE * float(floor), "rmse": float(rmse)})
    return rows


@torch.no_grad()
def score_images(prepared: Prepared, motion: ParticleState, views: Sequence[int], lpips: LPIPS | Absent) -> list[dict[str, Any]]:
    """PSNR [dB], SSIM and LPIPS of each frame after the first and each view: the full frame, and the crop around the body (`crop_`).

    A value that there is no way to compute is absent.
    """
    rows = []
    for view in views:
        images, _ = draw(prepared, motion, [view])
        recorded = prepared.recorded([view], len(images))
        whole = _image_rows(images[1:, 0].clamp(0, 1), recorded[1:, 0], lpips)
        top, left, side = window(prepared.silhouettes([view], len(images))[:, 0])
        cut = (slice(1, None), 0, slice(top, top + side), slice(left, left + side))
        crop = _image_rows(images[cut].clamp(0, 1), recorded[cut], lpips)
        for k, (a, b) in enumerate(zip(whole, crop)):
            rows.append({"frame": k + 1, "view": view, **a, **{f"crop_{name}": value for name, value in b.items()}})
    return rows


def _image_rows(images: Tensor, recorded: Tensor, lpips: LPIPS | Absent) -> list[dict[str, float]]:
    """Of K images (K, H, W, 3) each."""
    psnr = -10 * (images - recorded).square().mean((1, 2, 3)).clamp(min=1e-10).log10()
    columns = {"psnr": psnr}
    a, b = images.permute(0, 3, 1, 2).contiguous(), recorded.permute(0, 3, 1, 2).contiguous()
    if min(a.shape[-2:]) >= 11:  # the window of SSIM
        ssim = [structural_similarity_index_measure(x, y, data_range=1.0, reduction="none") for x, y in zip(a.split(16), b.split(16))]
        columns["ssim"] = torch.cat([part.reshape(-1) for part in ssim])
    if isinstance(lpips, LPIPS) and min(a.shape[-2:]) >= 32:
        columns["lpips"] = torch.cat([lpips(x, y) for x, y in zip(a.split(8), b.split(8))])
    return [{name: float(value[k]) for name, value in columns.items()} for k in range(len(a))]


def mean_of(rows: Sequence[dict[str, Any]], names: Sequence[str]) -> dict[str, float]:
    """Means over the rows of those of the names that they have."""
    out = {}
    for name in names:
        values = [row[name] for row in rows if name in row and math.isfinite(row[name])]
        if values:
            out[name] = sum(values) / len(values)
    return out


def write_rows(path: str | os.PathLike, rows: Sequence[dict[str, Any]]) -> None:
    """Write rows as CSV, all at once; a value that a row lacks is empty."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    names = list(dict.fromkeys(name for row in rows for name in row))
    hidden = path.with_name(f".{path.name}.tmp")
    with hidden.open("w", newline="") as file:
        writer = csv.DictWriter(file, names, restval="")
        writer.writeheader()
        for row in rows:
            writer.writerow({name: f"{value:.6g}" if isinstance(value, float) else value for name, value in row.items()})
    os.replace(hidden, path)
