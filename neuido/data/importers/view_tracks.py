"""Pixel tracks of two or more calibrated cameras as one motion in three dimensions."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from neuido.data.footage.filming import Filming, View
from neuido.data.importers.track_folder import Axes, RecordedMotion, in_si, upright
from neuido.data.importers.tracker_exports import read_motions
from neuido.errors import UserError

ALIGNED = 0.02
"""Share of a frame's interval by which times of two views may differ and be the same frame."""
CLOSE = 1.5
"""Frames' intervals within which a view must have seen a point for its place between two frames to be interpolated."""
STRAY, FINEST = 5.0, 2.0
"""Times the median reprojection error, and pixels, above which a position is an outlier; a tracker is good to a pixel or two."""
PARALLEL = 1e-12
"""Last homogeneous coordinate, of one, of a point at infinity."""
PIXELS = ("", "px", "pixel", "pixels")
ODD, WORST = 0.0015, 0.005
"""Shares of an image's size above which the median reprojection error is said, and above which views and cameras do not belong together."""


def read_view_tracks(
    paths: Sequence[Path], filming: Filming, columns: dict[str, str], units: Mapping[str, str], axes: Axes
) -> RecordedMotion:
    """Read the pixel tracks of one motion in several views, and triangulate them.

    Args:
        paths: One table a view, named like the view.
        filming: `cameras`, a recording with the views, and `offsets`.
        columns, units: Titles and units of columns, as for any table.
        axes: `scale` [m] of a unit of the cameras' positions, the axis that points up, and the frame rate.

    Raises:
        UserError: The cameras are no recording, a file has no view of its name, or as `triangulated`.
    """
    from neuido.data.footage.known_cameras import views_of
    from neuido.data.scenes.readers import read_recording

    option = f"--cameras {filming.cameras}"
    if filming.cameras in ("board", "colmap"):
        raise UserError(f"{option} is for videos: give a recording with the cameras of the views, such as a folder with transforms.json")
    if axes.up not in ("y", "z"):
        raise UserError(f"--up {axes.up} must be y or z")
    if len(paths) < 2:
        raise UserError(f"{option} takes the pixel tracks of two views or more: give a file of each; of one view give --scale instead")
    found = read_recording(Path(str(filming.cameras)).expanduser())
    cameras, views = views_of(found, paths, option), {}
    for path in paths:
        motions = list(read_motions(path, columns, axes.frame_rate).values())
        if len(motions) > 1 or motions[0].unit.lower() not in PIXELS:
            what = f"{len(motions)} recordings" if len(motions) > 1 else f"positions in {motions[0].unit}"
            raise UserError(f"{path.name} has {what}: a view of --cameras has the pixel positions of one recording")
        views[path] = in_si(path, motions[0], units, Axes(1.0, frame_rate=axes.frame_rate))
    motion = triangulated(views, cameras, max(found.cameras.width, found.cameras.height), filming.offsets)
    scale = 1.0 if axes.scale is None else axes.scale
    unit = "metres" if axes.scale is None else f"{scale:g} m"
    notes = [f"cameras of {filming.cameras} ({found.format}), positions in {unit}", *motion.notes]
    return motion._replace(points={name: upright(scale * x, axes.up) for name, x in motion.points.items()}, notes=notes)


def triangulated(
    views: Mapping[Path, RecordedMotion], cameras: Sequence[View], size: int, offsets: Sequence[float] | None
) -> RecordedMotion:
    """Return the positions of the points that several cameras saw.

    A position is where the lines of sight meet best. Of three or more views, one that misses by far is left out; of two, the position is.

    Args:
        views: Pixel positions of each view by its file, x to the right and y down from the upper left corner; times [s] start at 0, and
            `start` is the first of the file.
        cameras: The camera of each view.
        size: Larger side of the images [px].
        offsets: What to add to the times of each view [s]. None: the times of the files hold.

    Raises:
        UserError: A view has other coordinates, or the views share no points or times, or the lines of sight do not meet.
    """
    files, motions = list(views), list(views.values())
    if offsets is not None and (len(offsets) != len(files) or not np.isfinite(offsets).all()):
        raise UserError(f"--offsets has {len(offsets)} numbers for {len(files)} views: give one finite number (s) for each")
    late = np.zeros(len(files)) if offsets is None else np.asarray(offsets, float)
    clocks = [motion.t + motion.start + add for motion, add in zip(motions, late)]
    names = _shared_points(files, motions)
    t, notes = (
        clocks[0],
        [f"{path.name}: {note}" for path, motion in zip(files, motions) for note in motion.notes if not note.endswith("becomes 0 s")],
    )
    inside = (t >= max(clock[0] for clock in clocks) - 1e-9) & (t <= min(clock[-1] for clock in clocks) + 1e-9)
    if inside.sum() < 3:
        spans = ", ".join(f"{path.name} {clock[0]:.6g} to {clock[-1]:.6g} s" for path, clock in zip(files, clocks))
        raise UserError(f"the views share {int(inside.sum())} frames ({spans}): give --offsets, what to add to the times of each (s)")
    t = t[inside]
    points, left, errors, before, shifted = {}, 0, [], [], 0
    for name, own in names.items():
        seen = []
        for clock, motion, point, camera in zip(clocks, motions, own, cameras):
            at, moved = _at_times(t, clock, motion.points[point])
            shifted += moved
            seen.append(_straight(at, camera))
        first, x, error, bad = _meeting(np.stack(seen), cameras)
        points[name], left = x, left + bad
        errors.append(error)
        before.append(first)
    error = np.concatenate(errors)
    if not np.isfinite(error).any():
        raise UserError("no point is seen by two views at one time: check the times of the views, or give --offsets")
    median = float(np.nanmedian(np.concatenate(before)))
    if median > max(WORST * size, STRAY):
        raise UserError(
            f"the lines of sight miss each other by {median:.3g} px: are the files named like the views of --cameras, does y point down "
            "from the upper left corner, and are the views synchronised (--offsets)?"
        )
    notes.append(f"{len(files)} views, reprojection error {median:.2g} px in the median, {np.nanmax(error):.2g} px at most")
    if median > max(ODD * size, FINEST):
        notes.append("odd: the reprojection error is large: are the views synchronised (--offsets), and their lenses calibrated?")
    if shifted:
        notes.append(f"{shifted} pixel positions are interpolated in time to the frames of {files[0].name}")
    if left:
        notes.append(f"{left} pixel positions are outliers and left out: more than {STRAY:g} times the median error and {FINEST:g} px away")
    return RecordedMotion(t - t[0], points, notes)


def _shared_points(files: Sequence[Path], motions: Sequence[RecordedMotion]) -> dict[str, list[str]]:
    """Return the name of each point in each view; the only point of each view is one and the same."""
    if any(x.shape[1] != 2 for motion in motions for x in motion.points.values()):
        raise UserError("views of --cameras have x and y in pixels, and a file has other coordinates")
    if all(len(motion.points) == 1 for motion in motions):
        return {"point": [next(iter(motion.points)) for motion in motions]}
    common = [name for name in motions[0].points if all(name in motion.points for motion in motions)]
    if not common:
        have = "; ".join(f"{path.name} has {', '.join(list(motion.points)[:6])}" for path, motion in zip(files, motions))
        raise UserError(f"the views have no point of the same name: {have}"[:280])
    return {name: [name] * len(motions) for name in common}


def _at_times(t: np.ndarray, clock: np.ndarray, x: np.ndarray) -> tuple[np.ndarray, int]:
    """Return the positions (T, 2) of a view at times (T,), and how many are interpolated between its frames."""
    from scipy.interpolate import CubicSpline

    interval = float(np.median(np.diff(clock)))
    near = np.clip(np.searchsorted(clock, t - interval / 2), 0, len(clock) - 1)
    same = np.abs(clock[near] - t) < ALIGNED * interval
    out = np.where(same[:, None], x[near], np.nan)
    good = np.flatnonzero(np.isfinite(x).all(axis=1))
    if same.all() or len(good) < 4:
        return out, 0
    after = np.clip(np.searchsorted(clock[good], t), 1, len(good) - 1)
    between = (t - clock[good[after - 1]] < CLOSE * interval) & (clock[good[after]] - t < CLOSE * interval) & ~same
    between &= (t >= clock[good[0]]) & (t <= clock[good[-1]])
    out[between] = CubicSpline(clock[good], x[good])(t[between])
    return out, int(between.sum())


def _straight(x: np.ndarray, camera: View) -> np.ndarray:
    """Return pixel positions (T, 2) as an ideal camera of the same intrinsics would see them."""
    import cv2

    seen = np.isfinite(x).all(axis=1)
    if not camera.distortion or not seen.any():
        return x
    K = camera.K - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]  # OpenCV's pixel centres are at whole numbers
    out = x.copy()
    flat = np.ascontiguousarray(x[seen] - 0.5).reshape(-1, 1, 2)
    out[seen] = cv2.undistortPoints(flat, K, np.array(camera.distortion), P=K).reshape(-1, 2) + 0.5
    return out


def _meeting(pixels: np.ndarray, cameras: Sequence[View]) -> tuple[np.ndarray, np.ndarray, np.ndarray, int]:
    """Return errors of all lines of sight [px] (V * T,), where those meet that are no outliers (T, 3), their errors, and how many are.

    Args:
        pixels: Positions in each view, (V, T, 2); NaN where it was not seen.
        cameras: The V cameras.
    """
    Ks, poses = np.stack([camera.K for camera in cameras]), np.stack([camera.viewmat[:3] for camera in cameras])
    x, error = _least_squares(pixels, Ks, poses)
    before = error.ravel().copy()
    limit = max(FINEST, STRAY * float(np.nanmedian(error))) if np.isfinite(error).any() else FINEST
    bad = 0
    for frame in np.flatnonzero((error > limit).any(axis=0)):
        while np.nanmax(error[:, frame], initial=0.0) > limit and np.isfinite(pixels[:, frame, 0]).sum() > 2:
            trials = []
            for view in np.flatnonzero(np.isfinite(pixels[:, frame, 0])):
                without = pixels[:, frame : frame + 1].copy()
                without[view] = np.nan
                trials.append((float(np.nanmax(_least_squares(without, Ks, poses)[1])), view))
            pixels[min(trials)[1], frame] = np.nan
            own, rest = _least_squares(pixels[:, frame : frame + 1], Ks, poses)
            x[frame], error[:, frame], bad = own[0], rest[:, 0], bad + 1
        if np.nanmax(error[:, frame], initial=0.0) > limit:
            x[frame], error[:, frame], bad = np.nan, np.nan, bad + 1
    return before, x, error.ravel(), bad


def _least_squares(pixels: np.ndarray, Ks: np.ndarray, poses: np.ndarray, rounds: int = 4) -> tuple[np.ndarray, np.ndarray]:
    """Return positions (T, 3) of least reprojection error and the errors [px] (V, T); the start is the direct linear transform."""
    seen = np.isfinite(pixels).all(axis=2)
    enough = seen.sum(axis=0) >= 2
    x, error = np.full((pixels.shape[1], 3), np.nan), np.full(seen.shape, np.nan)
    rays = np.einsum("vab,vtb->vta", np.linalg.inv(Ks), np.concatenate([pixels, np.ones((*seen.shape, 1))], 2))
    matrices = Ks @ poses
    for frame in np.flatnonzero(enough):
        here = seen[:, frame]
        rows = [ray[axis] * pose[2] - pose[axis] for ray, pose in zip(rays[here, frame], poses[here]) for axis in (0, 1)]
        *point, far = np.linalg.svd(np.array(rows))[2][-1]
        if abs(far) < PARALLEL:
            continue
        point, own, target = np.array(point) / far, matrices[here], pixels[here, frame]
        for _ in range(rounds):
            h = own[:, :, :3] @ point + own[:, :, 3]
            guess = h[:, :2] / h[:, 2:]
            slope = (own[:, :2, :3] - guess[:, :, None] * own[:, 2:, :3]) / h[:, 2:, None]
            point = point + np.linalg.lstsq(slope.reshape(-1, 3), (target - guess).ravel(), rcond=None)[0]
        h = own[:, :, :3] @ point + own[:, :, 3]
        x[frame] = point
        error[here, frame] = np.linalg.norm(h[:, :2] / h[:, 2:] - target, axis=1)
    return x, error
