"""What is wrong with a recording of images before any training: too few views, exposure, blur, masks, framing, clocks and frame rate.

The names of the checks are those of the checklist in docs/howto/capture.md.
"""

import math
from typing import NamedTuple

import cv2
import numpy as np

from neuido.data.formats.layout import MultiView
from neuido.data.scenes.masks import mask_centre
from neuido.data.scenes.multiview import SceneViews
from neuido.data.scenes.view_geometry import mean_misfit, triangulate, view_delays
from neuido.errors import UserError

WIDTH = 640
"""Width to which images are reduced for the checks [px]."""
FRAMES = 48
"""Largest number of frames that are looked at, from the first on."""
VIEWS_NEEDED, VIEWS_ADVISED = 2, 4
"""A reconstruction needs two; four are clearly better than one, ten hardly better than four (research/log)."""
NARROW = 30.0
"""Angle between the outermost views [degrees] below which the far side of a body is guessed."""
CLIPPED = 250
"""Level of 255 from which on a pixel counts as overexposed."""
CLIPPED_SHARE = 0.1
"""Share of the object's pixels that may be overexposed."""
SMALL, LARGE = 16.0, 0.5
"""Least size of the object [px], and largest share of the image that it may cover."""
STILL = 2.0
"""Motion of the object [px] below which nothing is seen of its law."""
BLUR_SHARE, BLUR_PIXELS = 0.1, 2.0
"""Blur, relative to the size of the object and in pixels, above which both together are said."""
LATE = 0.2
"""Delay of a view, in frame intervals, that is said."""
MISFIT = 0.2
"""Distance of the centres of the views from a common point, relative to the size of the object, from which on cameras disagree."""
STRIDE = 0.5
"""Motion from one frame to the next, relative to the size of the object, above which outlines hardly overlap."""
UNEVEN = 0.02
"""Largest relative difference of two frame intervals that count as even."""
INTERVALS = {"pretrained": (2.5e-3, 5e-3), "pretrained-small": (12e-3, 24e-3)}
"""Frame intervals [s] of the clips that the shipped weights were trained on."""


class Finding(NamedTuple):
    """One thing that a check has to say."""

    check: str
    """Name of the check, as in the checklist of the capture guide."""
    wrong: bool
    """Whether it must be mended before training; otherwise it is advice."""
    words: str

    def __str__(self) -> str:
        return f"{'wrong ' if self.wrong else 'advice'}  {self.check}: {self.words}"


class Outline(NamedTuple):
    """The object in one image."""

    centre: tuple[float, float]
    """Centre of the mask [px]; NaN if the mask is empty."""
    size: float
    """Diameter of a disc of the area of the mask [px]."""
    share: float
    """Share of the image that the mask covers."""
    border: bool
    """Whether the mask touches the border of the image."""
    clipped: float
    """Share of the object's pixels that are overexposed."""


def capture_findings(found: MultiView) -> list[Finding]:
    """Check a recording; return what is wrong and what could be better, wrong things first.

    Args:
        found: The recording.

    Raises:
        UserError: An image or a mask cannot be read.
    """
    findings = _views(found) + _frame_rate(found)
    width = min(WIDTH, found.cameras.width)
    scene = SceneViews(found, width=width, frame_count=min(FRAMES, len(found.times)), find_masks=True, cache=False)
    try:
        _ = scene.plain_background
    except UserError as error:
        return sorted([*findings, Finding("masks", True, str(error))], key=lambda each: not each.wrong)
    outlines: list[list[Outline]] = []
    blurs: list[tuple[float, float, float, int]] = []
    for v, name in enumerate(scene.views):
        row = []
        before: np.ndarray | None = None
        for t in range(len(scene.frames)):
            images, masks = scene.load([v], [t])
            image, mask = images[0, 0].numpy(), masks[0, 0].numpy()
            row.append(_outline(image, mask))
            centre = np.array(row[-1].centre)
            if before is not None and np.isfinite(centre - before).all() and not row[-1].border:
                blurs.append((*_blur(image, mask, centre - before), row[-1].size, t))
            before = centre
        findings += _framing(row, name)
        outlines.append(row)
    findings += _blurred(blurs, found, width) + _motion(outlines, scene)
    return sorted(findings, key=lambda each: not each.wrong)


def _views(found: MultiView) -> list[Finding]:
    count = len(found.views) - len(found.held_out)
    out = []
    if count < VIEWS_ADVISED:
        wrong = count < VIEWS_NEEDED
        out.append(Finding("views", wrong, f"{count} to train on; {VIEWS_NEEDED} are needed, {VIEWS_ADVISED} are clearly better"))
    ahead = found.cameras.at(0).viewmats[:, 2, :3].double()
    angle = math.degrees(math.acos(float((ahead @ ahead.T).min().clamp(-1, 1))))
    if len(found.views) > 1 and angle < NARROW:
        out.append(Finding("views", False, f"all look within {angle:.0f} degrees: film from several sides"))
    return out


def _frame_rate(found: MultiView) -> list[Finding]:
    if len(found.times) < 3:
        return [Finding("frames", True, f"{len(found.times)} moments; a motion needs at least 3, and one moment is a still body")]
    steps = np.diff(found.times.numpy())
    interval = float(steps.mean())
    out = []
    if np.ptp(steps) > UNEVEN * interval:
        out.append(
            Finding(
                "frames", False, f"intervals from {1e3 * steps.min():.3g} to {1e3 * steps.max():.3g} ms; even ones are simulated exactly"
            )
        )
    if not any(low <= interval <= high for low, high in INTERVALS.values()):
        ranges = ", ".join(f"{1e3 * low:g} to {1e3 * high:g} ms for {name}" for name, (low, high) in INTERVALS.items())
        rates = f"one every {1e3 * interval:.4g} ms ({1 / interval:.4g} per second)"
        out.append(Finding("frames", False, f"{rates}; the shipped weights read {ranges}: choose another rate or --data.frame_step"))
    return out


def _outline(image: np.ndarray, mask: np.ndarray) -> Outline:
    area = float(mask.sum())
    inside = mask > 0.5
    if not inside.any():
        return Outline((math.nan, math.nan), 0.0, 0.0, False, 0.0)
    border = bool(inside[0].any() or inside[-1].any() or inside[:, 0].any() or inside[:, -1].any())
    clipped = float((image[inside].min(axis=1) >= CLIPPED / 255).mean())
    return Outline(mask_centre(mask), 2 * math.sqrt(area / math.pi), float(mask.mean()), border, clipped)


def _framing(row: list[Outline], view: str) -> list[Finding]:
    """Check mask, size, exposure and framing of one view."""
    out = []
    empty = [t for t, each in enumerate(row) if each.share == 0]
    if empty:
        words = f"view {view} shows no object in {len(empty)} of {len(row)} frames, first in frame {empty[0]}"
        out.append(Finding("masks", True, f"{words}: give masks, or cut the recording (frame_start, frame_count)"))
    seen = [each for each in row if each.share > 0]
    if not seen:
        return out
    size, share = float(np.median([each.size for each in seen])), max(each.share for each in seen)
    if size < SMALL:
        out.append(Finding("masks", True, f"the object is {size:.2g} px across in view {view}; {SMALL:g} are needed: film closer"))
    if share > LARGE:
        out.append(Finding("masks", True, f"the mask covers {share:.0%} of view {view}: is it the background, or inverted?"))
    cut = [t for t, each in enumerate(row) if each.border]
    if cut:
        words = f"the object touches the border of view {view} in {len(cut)} of {len(row)} frames, first in frame {cut[0]}"
        out.append(
            Finding("framing", cut[0] == 0, f"{words}: film a wider view{', since the first frame is reconstructed' * (cut[0] == 0)}")
        )
    clipped = max(each.clipped for each in seen)
    if clipped > CLIPPED_SHARE:
        out.append(
            Finding("exposure", False, f"{clipped:.0%} of the object is overexposed in view {view}: less light or a shorter exposure")
        )
    return out


def _blur(image: np.ndarray, mask: np.ndarray, moved: np.ndarray) -> tuple[float, float]:
    """Return the length of the motion blur and of the motion since the frame before [px].

    The outline is steeper across the motion than along it. Its widths, contrast over steepest slope, tell the blur: they add in squares.
    """
    length = float(np.linalg.norm(moved))
    grey = image.mean(axis=2)
    inside, near = (mask > 0.5).astype(np.uint8), np.ones((3, 3), np.uint8)
    core, around = (
        cv2.erode(inside, near, iterations=2) > 0,
        cv2.dilate(inside, near, iterations=4) - cv2.dilate(inside, near, iterations=3) > 0,
    )
    if length < 1.0 or not core.any() or not around.any():
        return 0.0, length
    contrast = abs(float(np.median(grey[core]) - np.median(grey[around])))
    slopes = np.stack([cv2.Sobel(grey, cv2.CV_32F, 1, 0, ksize=3), cv2.Sobel(grey, cv2.CV_32F, 0, 1, ksize=3)], -1) / 8
    band = (cv2.dilate(inside, near, iterations=3) - (cv2.erode(inside, near, iterations=3))) > 0
    along, across = np.abs(slopes[band] @ (moved / length)), np.abs(slopes[band] @ (np.array([-moved[1], moved[0]]) / length))
    if contrast < 0.1:
        return 0.0, length
    widths = [contrast / max(float(np.percentile(slope, 97)), 1e-6) for slope in (along, across)]
    return math.sqrt(max(widths[0] ** 2 - widths[1] ** 2, 0.0)), length


def _blurred(blurs: list[tuple[float, float, float, int]], found: MultiView, width: int) -> list[Finding]:
    fast = [each for each in blurs if each[0] > BLUR_PIXELS and each[0] > BLUR_SHARE * each[2]]
    if len(fast) < 2:
        return []
    blur, moved, _, t = max(fast)
    factor, interval = found.cameras.width / width, float(found.times[t] - found.times[t - 1])
    exposure = 1e3 * interval * min(float(np.median([b / m for b, m, *_ in fast])), 1.0)
    words = f"outlines are smeared over {factor * blur:.2g} px in frame {t}, an exposure of about {exposure:.2g} ms"
    return [Finding("blur", False, f"{words}: shorten it, with more light")]


def _motion(outlines: list[list[Outline]], scene: SceneViews) -> list[Finding]:
    """Check the motion of the centres: that there is one, its size per frame, and that the views agree on it."""
    centres = np.array([[each.centre for each in row] for row in outlines])
    sizes = np.array([[each.size for each in row] for row in outlines])
    whole = np.isfinite(centres).all(axis=2) & ~np.array([[each.border for each in row] for row in outlines])
    if len(scene.frames) < 3 or not whole.any():
        return []
    out = []
    size = float(np.median(sizes[whole]))
    reach = max(float(np.ptp(centres[v][whole[v]], axis=0).max()) for v in range(len(centres)) if whole[v].any())
    if reach < STILL:
        return [Finding("motion", True, f"the object moves by {reach:.2g} px at the most: a body at rest shows nothing of its law")]
    steps = np.linalg.norm(np.diff(centres, axis=1), axis=2)
    stride = float(np.nanmax(np.where(whole[:, 1:] & whole[:, :-1], steps, np.nan))) if (whole[:, 1:] & whole[:, :-1]).any() else 0.0
    if stride > STRIDE * size:
        out.append(
            Finding(
                "frames", False, f"the object moves by {stride / size:.0%} of its size from one frame to the next: film more per second"
            )
        )
    if len(centres) < 2:
        return out
    times, cameras = scene.times.numpy(), scene.cameras
    x = triangulate(centres, whole, cameras)
    misfit = mean_misfit(x, centres, whole, cameras)
    if not math.isfinite(misfit):
        return out
    delays = view_delays(centres, whole, cameras, times)
    interval = float(np.median(np.diff(times)))
    v = int(np.argmax(np.abs(delays)))
    if abs(delays[v]) > LATE * interval:
        words = f"view {scene.views[v]} seems {1e3 * abs(delays[v]):.2g} ms {'behind' if delays[v] > 0 else 'ahead of'} the others"
        out.append(Finding("synchronisation", True, f"{words}, {abs(delays[v]) / interval:.2g} frames: correct its times"))
    elif misfit > MISFIT * size:
        out.append(
            Finding(
                "cameras", True, f"the centres of the views meet only within {misfit:.2g} px of an object of {size:.2g} px: check the poses"
            )
        )
    return out + _fall(x, times)


def _fall(x: np.ndarray, times: np.ndarray) -> list[Finding]:
    """Compare the acceleration in flight with gravity, which tells the unit of length."""
    seen = np.isfinite(x).all(axis=1)
    if seen.sum() < 6:
        return []
    fit = np.polynomial.polynomial.polyfit(times[seen], x[seen], 2)
    left = x[seen] - np.polynomial.polynomial.polyval(times[seen], fit).T
    bend = 2 * fit[2]
    size = float(np.linalg.norm(bend))
    sag = size * np.ptp(times[seen]) ** 2 / 8
    if not sag > 10 * float(np.sqrt(np.mean(left**2))) or 0.7 < size / 9.81 < 1.3:
        return []
    axis = int(np.argmax(np.abs(bend)))
    up = f"{'-' if bend[axis] > 0 else ''}{'xyz'[axis]}"
    words = f"it accelerates by {size:.3g} units/s^2 along {'-' if bend[axis] < 0 else ''}{'xyz'[axis]}; a free fall in metres has 9.81"
    return [Finding("scale", False, f"{words}: if it falls freely, give `neuido reconstruct` --scale {9.81 / size:.3g} --up {up}")]
