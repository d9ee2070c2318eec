"""Pictures of silhouettes in the report: predicted outlines before and after, over the measured mask."""

import base64
from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np

from neuido.discrepancy.problems.silhouettes import distances

BEFORE, AFTER = (192, 57, 43), (31, 119, 180)
"""Red and blue of the report, RGB."""
FRAMES = 8
"""Number of frames shown per view, evenly chosen."""
ENLARGED = 2
"""Factor by which masks are enlarged."""


def pictures(motion: Mapping[str, Mapping[str, np.ndarray]], c: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return caption and data URL of the picture of each recording, with frames in a row and views below each other.

    Args:
        motion: For each recording `masks`, `drawn_before` and `drawn_after`, (T, V, H, W) uint8.
        c: Part of diagnosis.json, whose `recordings` have `inset` [px] and `frame_times` [s].
    """
    out = []
    for name, own in motion.items():
        if "masks" not in own:
            continue
        told = c["recordings"].get(name, {})
        count, views = own["masks"].shape[:2]
        chosen = sorted({round(i) for i in np.linspace(0, count - 1, FRAMES)})
        times = told.get("frame_times")
        when = f" at {', '.join(f'{times[t]:.3g}' for t in chosen)} s" if times and len(times) == count else ""
        rows = [np.concatenate([_overlay(own, t, v, float(told.get("inset", 0.0))) for t in chosen], axis=1) for v in range(views)]
        _, data = cv2.imencode(".png", cv2.cvtColor(np.concatenate(rows), cv2.COLOR_RGB2BGR))
        out.append((f"{name}{when}", f"data:image/png;base64,{base64.b64encode(data.tobytes()).decode()}"))
    return out


def _overlay(own: Mapping[str, np.ndarray], t: int, v: int, inset: float) -> np.ndarray:
    """Return the picture of frame t and view v, (H, W, 3) uint8; predicted outlines are moved inwards by `inset` [px]."""
    mask = own["masks"][t, v] / 255.0
    size = (ENLARGED * mask.shape[1], ENLARGED * mask.shape[0])
    image = np.repeat((255 - 90 * cv2.resize(mask, size, interpolation=cv2.INTER_LINEAR))[..., None], 3, axis=2).round().astype(np.uint8)
    for when, colour in (("drawn_before", BEFORE), ("drawn_after", AFTER)):
        drawn = own[when][None, t, v] / 255.0
        body = (distances(drawn)[0] + inset <= 0).astype(np.uint8)
        found, _ = cv2.findContours(cv2.resize(body, size, interpolation=cv2.INTER_NEAREST), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        image = cv2.drawContours(image, found, -1, colour, 1)
    image[:, -1] = 230
    return image
