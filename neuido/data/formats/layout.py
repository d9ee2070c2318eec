"""`MultiView`, which every reader of recordings returns, and the checks that all readers share. The files are not trusted."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from neuido.data import cameras as convert
from neuido.data.files.parsing import image_size
from neuido.errors import UserError
from neuido.types import Body, Cameras

SAME_TIME = 1e-6  # s
SAME_SHAPE = 0.01  # relative difference of two aspect ratios
SAME_POSE = 1e-5  # absolute difference of the entries of two world-to-camera matrices, below which a camera stands still

Grid = tuple[tuple[Path | None, ...], ...]


@dataclass(frozen=True, eq=False)
class MultiView:
    """A motion filmed by V cameras in T frames: cameras, times and the paths of the images. No image is loaded."""

    name: str
    format: str
    folder: Path
    cameras: Cameras
    """The V cameras; with a pose for each of the T frames if one of them moves."""
    views: tuple[str, ...]
    """Names of the V views."""
    times: Tensor
    """Times of the frames [s], (T,) float64, increasing."""
    images: Grid
    """images[v][t]: path of the image of view v and frame t; None if there is no such image."""
    masks: Grid | None = None
    """masks[v][t]: path of the mask of view v and frame t. If None, the alpha channel of an image is its mask."""
    held_out: tuple[int, ...] = ()
    """Indices of the views that the files reserve for scoring."""
    distortion: Tensor | None = None
    """OpenCV's distortion coefficients k1, k2, p1, p2, k3 of each view, (V, 5) float64; None if no image is distorted."""
    backgrounds: tuple[Path | None, ...] | None = None
    """Path of an image of the empty scene for each view."""
    body: Body | None = None
    """The particles at t = 0, if the files have them."""
    gaussians: Path | None = None
    """Path of the first frame as a 3DGS PLY file, if the files have one."""


class Shot(NamedTuple):
    """One image with its camera and time."""

    view: str
    time: float
    image: Path
    viewmat: Tensor
    """OpenCV world-to-camera matrix, (4, 4) float64."""
    K: Tensor
    """Intrinsic matrix [px], (3, 3) float64."""
    mask: Path | None = None
    distortion: tuple[float, ...] = ()
    size: tuple[int, int] | None = None
    """Width and height [px] that K refers to; None: those of the recording."""


def assemble(shots: Sequence[Shot], *, size: tuple[int, int] | None = None, folder: Path, **fields: Any) -> MultiView:
    """Assemble images into a `MultiView`: views in order of appearance, frames by time.

    Args:
        shots: All images of one motion.
        size: Width and height [px] of all views; None: those of the first view. The intrinsics of a view of another size are scaled.
        folder: The folder of the recording.
        fields: The other fields of `MultiView`. `held_out` holds names of views; `backgrounds` maps names of views to paths.

    Raises:
        UserError: There is no image, a file is missing, two images have the same view and frame, the lens of a view changes, or views have
            different aspect ratios.
    """
    if not shots:
        raise UserError(f"{folder} lists no image")
    missing = [path for shot in shots for path in (shot.image, shot.mask) if path is not None and not path.is_file()]
    if missing:
        more = f" (and {len(missing) - 1} more)" if len(missing) > 1 else ""
        raise UserError(f"the image {missing[0]} is missing{more}; {folder} lists it")
    views = list(dict.fromkeys(shot.view for shot in shots))
    times, at = _frames(shots)
    first: dict[str, Shot] = {}
    grid: dict[tuple[str, int], Shot] = {}
    moves = False
    for shot, frame in zip(shots, at):
        key = (shot.view, int(frame))
        if key in grid:
            raise UserError(f"view {shot.view} has two images at {shot.time:g} s: {grid[key].image.name} and {shot.image.name}")
        grid[key] = shot
        camera = first.setdefault(shot.view, shot)
        if camera.size != shot.size:
            raise UserError(
                f"view {shot.view} has images of two sizes: {camera.image.name} {camera.size} and {shot.image.name} {shot.size} px"
            )
        if not _same(camera.K, shot.K, rtol=1e-5, atol=1e-8) or camera.distortion != shot.distortion:
            raise UserError(
                f"the lens of view {shot.view} changes between {camera.image.name} and {shot.image.name}: film without zoom and give all "
                "frames of a view one focal length, centre and distortion, or make them separate views"
            )
        moves = moves or not _same(camera.viewmat, shot.viewmat, rtol=0, atol=SAME_POSE)
    width, height = size or first[views[0]].size or image_size(shots[0].image)
    cameras = Cameras(
        _poses(grid, views, len(times)) if moves else torch.stack([first[view].viewmat for view in views]).float(),
        torch.stack([_resized(first[view], width, height) for view in views]).float(),
        width,
        height,
    )
    distortion = torch.zeros(len(views), 5, dtype=torch.float64)
    for v, view in enumerate(views):
        given = first[view].distortion
        distortion[v, : len(given)] = torch.tensor(given, dtype=torch.float64)
    frames = range(len(times))
    masks = None
    if any(shot.mask is not None for shot in shots):
        masks = tuple(tuple(grid[view, t].mask if (view, t) in grid else None for t in frames) for view in views)
    backgrounds = fields.pop("backgrounds", None)
    held_out = set(fields.pop("held_out", ()))
    return MultiView(
        folder=folder,
        cameras=cameras,
        views=tuple(views),
        times=torch.tensor(times, dtype=torch.float64),
        images=tuple(tuple(grid[view, t].image if (view, t) in grid else None for t in frames) for view in views),
        masks=masks,
        held_out=tuple(v for v, view in enumerate(views) if view in held_out),
        distortion=distortion if bool(distortion.any()) else None,
        backgrounds=tuple(backgrounds.get(view) for view in views) if backgrounds else None,
        **fields,
    )


def _poses(grid: dict[tuple[str, int], Shot], views: Sequence[str], frames: int) -> Tensor:
    """Return the pose of each view in each frame, (V, T, 4, 4) float32; a frame without an image has the pose of the nearest with one."""
    out = []
    for view in views:
        own = [frame for frame in range(frames) if (view, frame) in grid]
        out += [grid[view, min(own, key=lambda other: abs(other - frame))].viewmat for frame in range(frames)]
    return torch.stack(out).float().unflatten(0, (len(views), frames))


def _frames(shots: Sequence[Shot]) -> tuple[list[float], list[int]]:
    """Group shots into frames; return the times of the frames [s] and the frame index of each shot.

    The times of several cameras may differ by up to a quarter of the frame interval. The time of a frame is the mean over its shots.
    """
    own: dict[str, list[float]] = {}
    for shot in shots:
        own.setdefault(shot.view, []).append(shot.time)
    gaps = [gap for times in own.values() for gap in np.diff(np.sort(times)) if gap > SAME_TIME]
    tolerance = max(SAME_TIME, 0.25 * min(gaps)) if gaps else SAME_TIME
    groups: list[list[float]] = []
    for time in sorted(shot.time for shot in shots):
        if groups and time - groups[-1][0] <= tolerance:
            groups[-1].append(time)
        else:
            groups.append([time])
    times = [group[0] if group[-1] - group[0] <= SAME_TIME else float(np.mean(group)) for group in groups]
    starts = np.array([group[0] for group in groups])
    return times, [int(i) for i in np.searchsorted(starts, [shot.time for shot in shots], side="right") - 1]


def _resized(shot: Shot, width: int, height: int) -> Tensor:
    """Scale the intrinsic matrix of a shot to another image size, whose aspect ratio may differ by one percent."""
    if shot.size is None or shot.size == (width, height):
        return shot.K
    own_width, own_height = shot.size
    if abs(own_width * height / (own_height * width) - 1) > SAME_SHAPE:
        raise UserError(
            f"view {shot.view} ({shot.image.name}) has {own_width} x {own_height} pixels, another view {width} x {height}: crop the images "
            "of all views to one aspect ratio, and move cx and cy with them"
        )
    return shot.K * shot.K.new_tensor([width / own_width, height / own_height, 1.0])[:, None]


def read_matrix(value: Any, where: str, *shapes: tuple[int, ...]) -> Tensor:
    """Convert nested lists of numbers to a float64 tensor of one of the allowed `shapes`.

    Raises:
        UserError: The shape is not allowed, or an entry is not a finite number.
    """
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise UserError(f"{where} must contain numbers and have the shape {_or(shapes)}") from error
    if array.shape not in shapes:
        raise UserError(f"{where} must have the shape {_or(shapes)}, got {array.shape}")
    if not np.isfinite(array).all():
        raise UserError(f"{where} contains a NaN or an infinity")
    return torch.from_numpy(array)


def viewmat_from_opengl(value: Any, where: str) -> Tensor:
    """Convert an OpenGL camera-to-world matrix (3, 4) or (4, 4) of a file to an OpenCV world-to-camera matrix (4, 4), float64.

    Raises:
        UserError: It is not such a matrix, or its rotation is sheared or mirrored.
    """
    c2w = read_matrix(value, where, (3, 4), (4, 4))
    if len(c2w) == 4 and not torch.allclose(c2w[3], c2w.new_tensor([0.0, 0.0, 0.0, 1.0]), atol=1e-6):
        hint = ": it seems to be transposed; write it row by row" if torch.allclose(c2w[:3, 3], c2w.new_zeros(3), atol=1e-6) else ""
        raise UserError(f"{where} has the last row {[round(float(n), 6) for n in c2w[3]]}, not 0, 0, 0, 1{hint}")
    try:
        return convert.from_opengl(c2w)
    except UserError as error:
        raise UserError(f"{where}: {error}") from error


def read_intrinsics(value: Any, where: str) -> Tensor:
    """Validate an intrinsic matrix K (3, 3) of a file; return it as float64.

    Raises:
        UserError: It is not a 3 x 3 matrix, a focal length is not positive, or it has a skew.
    """
    K = read_matrix(value, where, (3, 3))
    if not (K[0, 0] > 0 and K[1, 1] > 0):
        raise UserError(f"{where} has the focal lengths {K[0, 0]:g} and {K[1, 1]:g}; they must be positive")
    if K[0, 1] != 0 or not torch.equal(K[2], K.new_tensor([0.0, 0.0, 1.0])) or K[1, 0] != 0:
        raise UserError(f"{where} must have the form [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]")
    return K


def _same(one: Tensor, other: Tensor, *, rtol: float, atol: float) -> bool:
    """Return whether two matrices are equal within tolerances; those of a fixed camera are the same, which is seen at once."""
    return one is other or torch.equal(one, other) or torch.allclose(one, other, rtol=rtol, atol=atol)


def natural_key(text: str) -> list[tuple[int, str]]:
    """Return a sort key that compares numbers in a text as numbers: `r_2` before `r_10`."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"([0-9]+)", text) if part]


def _or(shapes: tuple[tuple[int, ...], ...]) -> str:
    return " or ".join(str(shape) for shape in shapes)
