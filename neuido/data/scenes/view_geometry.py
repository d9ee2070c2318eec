"""Points that several views see: triangulation, how far the views disagree, and which view is late."""

import numpy as np

from neuido.types import Cameras

SEARCH = 2.0
"""Largest delay of a view that is looked for, in frame intervals."""
DELAYS = 41
"""Delays that are tried in this range."""
GAIN = 0.7
"""Ratio of the misfits after and before at which a delay is believed."""


def triangulate(centres: np.ndarray, whole: np.ndarray, cameras: Cameras) -> np.ndarray:
    """Return the point of each frame (T, 3) nearest to the rays through image points; NaN if fewer than two views see it.

    Args:
        centres: Image points [px], (V, T, 2).
        whole: Whether a point counts, (V, T).
        cameras: V cameras, fixed or with a pose for each of the T frames.
    """
    P = _matrices(cameras, centres.shape[1])
    x = np.full((centres.shape[1], 3), np.nan)
    for t in range(len(x)):
        seen = np.flatnonzero(whole[:, t])
        if len(seen) < 2:
            continue
        rows = np.concatenate([centres[v, t][:, None] * P[v, t, 2] - P[v, t, :2] for v in seen])
        rows /= np.linalg.norm(rows[:, :3], axis=1, keepdims=True)
        x[t] = np.linalg.lstsq(rows[:, :3], -rows[:, 3], rcond=None)[0]
    return x


def mean_misfit(x: np.ndarray, centres: np.ndarray, whole: np.ndarray, cameras: Cameras) -> float:
    """Return the root mean square distance [px] of image points from the projected points x (T, 3); NaN if no point is known."""
    projected = np.einsum("vtij,tj->vti", _matrices(cameras, len(x)), np.c_[x, np.ones(len(x))])
    with np.errstate(invalid="ignore", divide="ignore"):
        away = np.linalg.norm(projected[..., :2] / projected[..., 2:] - centres, axis=2)
    kept = whole & np.isfinite(away)
    return float(np.sqrt(np.mean(away[kept] ** 2))) if kept.any() else float("nan")


def view_delays(centres: np.ndarray, whole: np.ndarray, cameras: Cameras, times: np.ndarray) -> np.ndarray:
    """Return the delay of each view [s], (V,): by how much earlier its images were taken than its times say; 0 if none helps.

    One view at a time is shifted, by the interpolated motion of its image point, until the views meet best. The arguments are those of
    `triangulate`, and the times of the frames [s] (T,). Of cameras that move no delay is looked for, since their image points move with
    them.
    """
    if cameras.moving:
        return np.zeros(len(centres))
    interval = float(np.median(np.diff(times)))
    before = mean_misfit(triangulate(centres, whole, cameras), centres, whole, cameras)
    out, best = np.zeros(len(centres)), np.full(len(centres), np.inf)
    for v in range(len(centres)):
        own = np.flatnonzero(whole[v])
        if len(own) < 4:
            continue
        for delay in np.linspace(-SEARCH, SEARCH, DELAYS) * interval:
            at = times - delay
            shifted, counted = centres.copy(), whole.copy()
            shifted[v] = np.stack([np.interp(at, times[own], centres[v, own, a]) for a in range(2)], 1)
            counted[v] &= (at >= times[own[0]] - 1e-9) & (at <= times[own[-1]] + 1e-9)
            if counted[v].sum() < 3:
                continue
            misfit = mean_misfit(triangulate(shifted, counted, cameras), shifted, counted, cameras)
            if misfit < best[v]:
                best[v], out[v] = misfit, -delay
    chosen = int(np.argmin(best))  # with two views either may be late; the one that helps most is named
    return np.where((np.arange(len(out)) == chosen) & (best < GAIN * before), out, 0.0)


def _matrices(cameras: Cameras, frames: int) -> np.ndarray:
    """Return the projection matrices of each view and frame, (V, T, 3, 4)."""
    if cameras.moving:
        return (cameras.Ks.double()[:, None] @ cameras.viewmats.double()[:, :, :3]).numpy()
    return (cameras.Ks.double() @ cameras.viewmats.double()[:, :3])[:, None].expand(-1, frames, -1, -1).numpy()
