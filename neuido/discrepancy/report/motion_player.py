"""Data for the player of motions on the page, and for the map of the residual on the body."""

import base64
from collections.abc import Mapping
from typing import Any

import numpy as np

from neuido.discrepancy.report.plots import heading, numbers, predictions, thinned
from neuido.discrepancy.report.reader_units import Units

MOST_POINTS, MOST_FRAMES = 400, 60
LEAST_POINTS, LEAST_FRAMES = 60, 24
ROOM = 700_000
"""Size of all motions on a page [bytes]."""
STEP = 32_000
"""Integer that stands for the largest distance of a coordinate from the middle."""
HIDDEN = -32_768
"""Integer that stands for a coordinate of a point that was not seen."""
NEAR = 0.5
"""Largest gap between the motion and a drawn collider, less half a diameter of the motion [diameters]."""
SETS = ("measured", "before", "after")


def player(motion: Mapping[str, Mapping[str, np.ndarray]], c: Mapping[str, Any], units: Units, *, room: float = ROOM) -> dict[str, Any]:
    """Return the data of the player: points of each recording, measured and predicted before and after.

    Args:
        motion: Arrays of each recording of a body, as in `predicted`.
        c: Part of diagnosis.json for the body.
        units: Units of the page.
        room: Largest size [bytes].
    """
    factor, unit = units.scaled("m")
    most = room / max(len(motion), 1)
    recordings = [_packed(name, arrays, c, factor, most) for name, arrays in motion.items()]
    return {"unit": unit, "called": ["measured", *(called for _, called in predictions(c))], "recordings": recordings}


def _packed(name: str, arrays: Mapping[str, np.ndarray], c: Mapping[str, Any], factor: float, most: float) -> dict[str, Any]:
    """Pack one recording for the player into at most `most` bytes; `factor` leads from metres to the unit of the page."""
    frames, points = _budget(*arrays["measured"].shape[:2], most)
    sets = [arrays[key][np.ix_(frames, points)] for key in SETS[: 1 + len(predictions(c))]]
    finite = np.concatenate([s[np.isfinite(s).all(axis=-1)] for s in sets])
    low, high = (finite.min(axis=0), finite.max(axis=0)) if len(finite) else (np.zeros(3), np.ones(3))
    middle, size = 0.5 * (low + high), 0.5 * float(np.max(high - low)) or 1.0
    packed = []
    for s in sets:
        q = np.where(np.isfinite(s), np.clip((s - middle) / size, -1.0, 1.0) * STEP, HIDDEN).astype("<i2")
        packed.append(base64.b64encode(q.tobytes()).decode())
    own = c["recordings"].get(name, {})
    gravity = np.array(own.get("gravity") or [0.0, 0.0, 0.0])
    down = gravity / np.linalg.norm(gravity) if np.any(gravity) else None
    return {
        "name": heading(name, c),
        "points": len(points),
        "frames": len(frames),
        "times": numbers(arrays["t"][frames]),
        "sets": packed,
        "middle": numbers(factor * middle),
        "scale": factor * size / STEP,
        "first": most_telling(sets[0], sets[1]),
        "planes": [p for plane in own.get("colliders", ()) if (p := _plane(plane, low, high, size, factor)) is not None],
        "down": None if down is None else numbers(down),
        "ranges": [numbers([factor * (a - 0.1 * size), factor * (b + 0.1 * size)]) for a, b in zip(low, high)],
    }


def _budget(frames: int, points: int, most: float) -> tuple[np.ndarray, np.ndarray]:
    """Choose frames and points that fit into `most` bytes: 24 for each point and frame (three sets, base64 text)."""
    count, times = min(points, MOST_POINTS), min(frames, MOST_FRAMES)
    while count * times * 24 > most and (count > LEAST_POINTS or times > LEAST_FRAMES):
        if count > LEAST_POINTS:
            count = max(LEAST_POINTS, int(0.8 * count))
        else:
            times = max(LEAST_FRAMES, int(0.8 * times))
    return thinned(frames, times), thinned(points, count)


def most_telling(measured: np.ndarray, before: np.ndarray) -> int:
    """Return the frame in which measurement and prediction lie furthest apart."""
    square = np.sum((measured - before) ** 2, axis=-1)
    return int(np.argmax(np.nansum(square, axis=1) / np.maximum(np.isfinite(square).sum(axis=1), 1)))


def _plane(plane: Mapping[str, Any], low: np.ndarray, high: np.ndarray, size: float, factor: float) -> dict[str, Any] | None:
    """Return the rectangle of a collider that is drawn near the motion; None where the collider is far from it."""
    normal = np.array(plane["normal"], dtype=float)
    normal /= np.linalg.norm(normal)
    middle = 0.5 * (low + high)
    height = float((middle - np.array(plane["point"])) @ normal)
    if abs(height) > (1.0 + 2.0 * NEAR) * size + 0.5 * float(np.abs(high - low) @ np.abs(normal)):
        return None
    foot = middle - height * normal
    side = np.eye(3)[int(np.argmin(np.abs(normal)))]
    a = np.cross(normal, side)
    a /= np.linalg.norm(a)
    b = np.cross(normal, a)
    reach = [1.15 * (0.5 * float(np.abs(high - low) @ np.abs(v)) + 0.1 * size) for v in (a, b)]
    corners = [foot + i * reach[0] * a + j * reach[1] * b for i, j in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    return {"corners": [numbers(factor * corner) for corner in corners], "contact": plane.get("contact", "")}


def residual_map(motion: Mapping[str, Mapping[str, np.ndarray]], c: Mapping[str, Any], units: Units) -> dict[str, Any]:
    """Return the data of the map: root mean square residual of each point before and after, and the first place of the points."""
    factor, unit = units.scaled("m")
    recordings = []
    for name, arrays in motion.items():
        points = _budget(*arrays["measured"].shape[:2], ROOM)[1]
        place = np.where(np.isfinite(arrays["measured"][0]), arrays["measured"][0], arrays["before"][0])[points]
        sizes = {}
        for when, _ in predictions(c):
            square = np.sum((arrays["measured"] - arrays[when])[:, points] ** 2, axis=-1)
            count = np.isfinite(square).sum(axis=0)
            sizes[when] = factor * np.sqrt(np.nansum(square, axis=0) / np.maximum(count, 1))
        own: dict[str, Any] = {when: numbers(values, 4) for when, values in sizes.items()}
        top = {when: float(np.quantile(values, 0.98)) for when, values in sizes.items()}
        recordings.append({"name": name, "place": [numbers(factor * place[:, k]) for k in range(3)], **own, "top": top})
    return {"unit": unit, "shown": [when for when, _ in predictions(c)], "recordings": recordings}
