"""Doubts about the length scale: an error of it as a rival of what was named, and recordings of another scale than the others."""

import math
from collections.abc import Sequence

import numpy as np

from neuido.data.measured.track import Track
from neuido.discrepancy.inference.power import excess
from neuido.discrepancy.problems.problem import Point, Problem

CALIBRATION = 0.05
"""Standard deviation of a length scale of which nothing better is known: of a ruler that stands a twentieth of the camera's distance before
or behind the motion."""
OTHER_SCALE = 10.0**1.5
"""Ratio of a path to those of the other recordings from which another unit is suspected. It lies nearer to a hundred, a metre for a
centimetre, than to ten, which launches of one experiment differ by."""


def rival_scale(problem: Problem, before: Point, after: Point, count: int) -> list[float] | None:
    """Return the smallest and the largest error of the length scale by which the model without effects explains as much as with them.

    The errors are those at the far ends of the paths. The scale of each fitted recording has a Gaussian prior, of `CALIBRATION` or what the
    folder states if that is more, and may change by as much along the path, as for a camera that looks askew. It explains as much if
    Schwarz's criterion does not prefer the effects: misfit and prior together exceed those with the effects by no more than log n for each
    of their parameters, n independent data. What the effects leave for each of these sets the unit (`power.excess`).

    Args:
        problem: What was diagnosed.
        before: The fit without effects.
        after: The fit with the named effects.
        count: Number of fitted parameters of the named effects.

    Returns:
        The errors; None if the data are no lengths of a track, if the effects explain more, or if the scales that it takes differ in sign.
    """
    if not hasattr(problem, "with_scale_error") or problem.unit != "m":
        return None
    other, fitted = problem.with_scale_error(CALIBRATION), problem.roles["fit"]
    rows = [problem.whitened([after], n)[0] for n in fitted]
    independent = sum(_independent(row, len(problem.recordings[n].y), len(problem.axes)) for row, n in zip(rows, fitted, strict=True))
    left = float(np.sum(np.concatenate(rows) ** 2))
    by_scale, found = zip(*(other.misfit_by_scale(before, n) for n in fitted), strict=True)
    if not sum(by_scale) - left <= count * math.log(independent) * max(left / independent, 1.0):
        return None
    return [min(found, key=abs), max(found, key=abs)] if min(found) > 0 or max(found) < 0 else None


def _independent(row: np.ndarray, data: int, axes: int) -> float:
    """Return how many of the whitened residuals of a recording, frame by frame along its axes, are independent."""
    _, freedom = excess(row[:data], np.empty((data, 0)), [np.arange(a, data, axes) for a in range(axes)])
    return freedom + 1


def gravity_found(problem: Problem, after: Point) -> dict[str, float] | None:
    """Return the gravity that a free flight takes, and the errors of length and time that look like it.

    A body under a gravity r times the true one moves as one whose lengths are measured r times too long, or whose times are measured
    1 / sqrt(r) times as long.

    Args:
        problem: What was diagnosed.
        after: The fit with a different gravity, or an acceleration that the data cannot tell from one.

    Returns:
        `declared` and `found` [m/s^2], and the relative errors `length` and `time`; None for other data than tracks of free bodies, and
        where the gravity points the other way.
    """
    tracks = getattr(problem, "tracks", None)
    if tracks is None or tracks.constraint is not None or problem.unit != "m":
        return None
    declared = float(np.linalg.norm(tracks.gravity))
    if declared == 0.0:
        return None
    along = [after.get(f"uniform_acceleration.{a}", 0.0) * g / declared for a, g in zip("xyz", tracks.gravity, strict=True)]
    found = declared + after.get("gravity.g", 0.0) + sum(along)
    if found <= 0.0:
        return None
    return {"declared": declared, "found": found, "length": found / declared - 1.0, "time": math.sqrt(declared / found) - 1.0}


def of_another_scale(tracks: Sequence[Track]) -> list[tuple[Track, float]]:
    """Return the recordings whose path is much longer or shorter than those of the others, with the ratio to their median."""
    lengths = [float(np.linalg.norm(np.ptp(track.x, axis=0))) for track in tracks]
    out = []
    for i, (track, own) in enumerate(zip(tracks, lengths, strict=True)):
        others = [length for length in lengths[:i] + lengths[i + 1 :] if length > 0]
        if len(others) < 2 or own == 0:  # of two, neither is the other's measure
            continue
        ratio = own / float(np.median(others))
        if max(ratio, 1 / ratio) > OTHER_SCALE:
            out.append((track, ratio))
    return out
