"""Silhouettes in the report: outlines before and after over the measured mask, and how well they agree."""

from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np

from neuido.data.files.html_page import escaped, png, table
from neuido.discrepancy.silhouettes import distances

BEFORE, AFTER = (192, 57, 43), (31, 119, 180)
"""Red and blue of the report, RGB."""
FRAMES = 8
"""Of a view that are shown, evenly taken."""
ENLARGED = 2


def section(drawn: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """The parts of the page about silhouettes.

    Args:
        drawn: Of each recording `masks`, `drawn_before`, `drawn_after` (T, V, H, W) in 0..1, `inset` [px], `times` (T,) [s], and `scores`.
    """
    out = ["<h2>Silhouettes before and after</h2>", _table(drawn)]
    for name, own in drawn.items():
        chosen = sorted({round(i) for i in np.linspace(0, len(own["times"]) - 1, FRAMES)})
        times = ", ".join(f"{own['times'][t]:.3g}" for t in chosen)
        out.append(f'<p>{escaped(name)} at {times} s: measured (grey), <span class="b">before</span>, <span class="a">after</span>.</p>')
        rows = [np.concatenate([_overlay(own, t, v) for t in chosen], axis=1) for v in range(own["masks"].shape[1])]
        _, data = cv2.imencode(".png", cv2.cvtColor(np.concatenate(rows), cv2.COLOR_RGB2BGR))
        out.append(png(data.tobytes(), f"silhouettes of {name}"))
    return out


def _table(drawn: Mapping[str, Mapping[str, Any]]) -> str:
    rows = [
        (name, role.replace("_", " "), when, *(own["scores"][when][role][key] for key in ("iou", "outline_px", "outline_mm", "psnr")))
        for name, own in drawn.items()
        for role in own["scores"]["before"]
        for when in ("before", "after")
    ]
    return table(("recording", "frames", "", "overlap (IoU)", "outline [px]", "outline [mm]", "PSNR [dB]"), rows, digits=3)


def _overlay(own: Mapping[str, Any], t: int, v: int) -> np.ndarray:
    """One image (H, W, 3) uint8."""
    mask = own["masks"][t, v]
    size = (ENLARGED * mask.shape[1], ENLARGED * mask.shape[0])
    image = np.repeat((255 - 90 * cv2.resize(mask, size, interpolation=cv2.INTER_LINEAR))[..., None], 3, axis=2).round().astype(np.uint8)
    for when, colour in (("drawn_before", BEFORE), ("drawn_after", AFTER)):
        body = (distances(own[when][None, t, v])[0] + own["inset"] <= 0).astype(np.uint8)
        found, _ = cv2.findContours(cv2.resize(body, size, interpolation=cv2.INTER_NEAREST), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        image = cv2.drawContours(image, found, -1, colour, 1)
    image[:, -1] = 230
    return image
