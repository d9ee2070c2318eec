"""One view of a deforming body becomes an experiment folder: silhouettes in metres, and a body that the outline and its depth tell."""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch
import yaml

from neuido.data import cameras as convert
from neuido.data.files.writing import write_arrays, write_text
from neuido.data.footage.contact_sheet import Sheet
from neuido.data.footage.filming import Filming, chosen_frames
from neuido.data.footage.moving_object import background_of, sightings
from neuido.data.footage.video_frames import read_clip
from neuido.data.formats import nerfstudio
from neuido.data.importers.declared_guide import GRAVITY
from neuido.data.importers.deforming import declared_content
from neuido.data.importers.tables.checked_folder import write_checked
from neuido.data.measured.held_start import held_rows
from neuido.data.measured.motion_plausibility import check_flight
from neuido.errors import UserError
from neuido.types import Cameras

PARTICLES = 800
"""Particles of a body, about: some nine along an edge."""
FAR = 100.0
"""Distance of the camera in widths of the picture: a scale in metres per pixel holds at every depth only from far away."""
SYMMETRIC = 0.9
"""Least overlap of an outline and its mirror image (area of the intersection over that of the union) for a body of revolution."""
ODD_SWING, MOST_SWING = 1.3, 2.0
"""Ratios of the largest to the smallest outline of a clip that are said, and refused. A body that turns or is pressed flat changes less."""
INSIDE = 0.5
"""Value of a soft mask on the outline."""
UNSEEN = (
    "one view tells nothing of the line of sight: not the depth of the body, which is the one that was assumed, and no motion or force "
    "towards the camera"
)


class Silhouettes(NamedTuple):
    """What one clip shows."""

    times: np.ndarray
    """Times of the frames [s], (T,), from 0."""
    first: np.ndarray
    """Mask of the first frame, (H, W) in 0..1."""
    low: np.ndarray
    """Lower left corner of all outlines [m], (2,)."""
    high: np.ndarray
    """Upper right corner of all outlines [m], (2,)."""
    seen: int
    """Number of frames that show the object."""
    swing: float
    """Largest over smallest area of the whole outlines."""
    centres: np.ndarray
    """Times [s] and centres [m] of the whole outlines, (n, 3), y up."""


def write_filmed_body(
    files: Mapping[str, Path],
    out: str | os.PathLike | None,
    filming: Filming,
    sheet: Sheet,
    *,
    roles: Mapping[str, str],
    scale: float | None,
    thickness: float | None,
    density: float | None,
    young: float | None,
    poisson: float | None,
    floor: float | None,
    frame_rate: float | None,
) -> list[str]:
    """Write clips of one fixed camera each as an experiment folder (`neuido-experiment/1`) of silhouettes; return the summary.

    Coordinates are metres from the lower left corner of the picture, with x to the right, y up and z towards the camera; z = 0 is the
    middle plane of the body. The mask is the difference from the background.

    Args:
        files: Video file of each recording by its name.
        out: The folder to create. None: check the clips and write nothing.
        filming: The user's options.
        sheet: Collects frames for the contact sheet.
        roles: `fit` or `held_out` for each recording.
        scale: Metres per pixel at the body.
        thickness: Depth of the body along the line of sight [m], which its outline is extruded by; None: a body of revolution about the
            vertical axis.
        density: Declared density [kg/m^3].
        young: Declared Young's modulus [Pa].
        poisson: Declared Poisson's ratio; 0.3 if None.
        floor: Height of the floor above the lower edge of the picture [m]; None: there is no floor.
        frame_rate: True frames per second of a slow-motion video.

    Raises:
        UserError: Scale, density or Young's modulus is missing, a clip cannot be read, its first frame does not show the whole body, or its
            outline is not that of a body of revolution.
    """
    from neuido.data.measured.experiment import read_experiment

    if density is None or young is None:
        raise UserError("a deforming body needs a declared material: give --density (kg/m^3) and --young (Pa); rough values are enough")
    if scale is None:
        raise UserError("one view of a body needs its scale: give --scale (metres per pixel)")
    summary: list[str] = []

    def fill(folder: Path) -> None:
        recordings, lows, highs, spacings = [], [], [], []
        for name, path in files.items():
            (folder / name).mkdir()
            found = _silhouettes(path, folder / name, filming, sheet, scale, frame_rate)
            summary.extend(_fall(found.centres, path))
            x0, volume, spacing, words = _body(found.first, scale, thickness, path)
            depth = float(np.abs(x0[:, 2]).max()) + 0.5 * spacing
            arrays = {"x0": x0, "v0": np.zeros_like(x0), "volume": np.full(len(x0), volume / len(x0))}
            write_arrays(folder / name / "body.npz", {key: each.astype(np.float32) for key, each in arrays.items()})
            summary.append(f"{path.name}: {len(found.times)} frames, {found.seen} with the object; {len(x0)} particles, {words}")
            if found.swing > ODD_SWING:
                odd_area = f"odd: {path.name}: outlines differ in area by a factor of {found.swing:.2g}"
                summary.append(
                    f"{odd_area}; look at them (--picture), and give an image of the empty scene (--background) if they are wrong"
                )
            recordings.append({"name": name, "role": roles[name], "frame_interval": float(np.median(np.diff(found.times)))})
            lows.append([*found.low, -depth])
            highs.append([*found.high, depth])
            spacings.append(spacing)
        low, high, spacing = np.min(lows, axis=0), np.max(highs, axis=0), float(np.median(spacings))
        content, notes = declared_content(next(iter(files)), low, high, spacing, density, young, poisson, floor, recordings)
        summary.extend(notes)
        write_text(folder / "experiment.yaml", yaml.safe_dump(content, sort_keys=False, default_flow_style=None))

    odd = write_checked(out, fill, read_experiment)
    return [*summary, UNSEEN, *odd]


def _silhouettes(path: Path, folder: Path, filming: Filming, sheet: Sheet, scale: float, frame_rate: float | None) -> Silhouettes:
    """Write the images of a clip with their masks and the camera; return what it shows."""
    clip = read_clip(path, frame_rate=frame_rate)
    chosen = chosen_frames(clip, filming)
    if len(chosen) < 4:
        raise UserError(f"{path}: {len(chosen)} frames lie between --start and --end; a diagnosis needs at least 4")
    times = clip.times[chosen] - clip.times[chosen[0]]
    background = background_of(clip, np.arange(len(clip.times)), filming.background_file)
    first, areas, corners, centres = np.zeros(0), [], [], []
    seen = 0
    (folder / "images").mkdir()
    for t, (image, found) in enumerate(sightings(clip, chosen, background)):
        sheet.add(path.name, t, len(chosen), image, found.mask, f"{clip.times[chosen[t]] - clip.times[0]:.3f} s")
        if t == 0:
            first = found.mask
            if not found.area > 0 or found.cut:
                what = "is cut by the border" if found.cut else "is not found"
                raise UserError(
                    f"{path}: the body {what} in the first frame, which gives its shape: choose it by --start (s), or give an image of the "
                    "empty scene (--background) if the body hardly moves"
                )
        if found.area > 0:
            seen += 1
            if not found.cut:
                areas.append(found.area)
                centres.append((times[t], scale * found.centre[0], scale * (clip.height - found.centre[1])))
            y, x = np.nonzero(found.mask >= INSIDE)
            corners += [(x.min(), clip.height - y.max() - 1), (x.max() + 1, clip.height - y.min())] if len(x) else []
        rgba = np.dstack([image, np.rint(255 * found.mask).astype(np.uint8)])
        nerfstudio.write_image(folder / f"images/0_{t:03d}.png", rgba)
    nerfstudio.write_transforms(folder, _camera(clip.width, clip.height, scale), torch.from_numpy(times))
    places = scale * np.array(corners, float)
    swing = max(areas) / min(areas)
    if swing > MOST_SWING:
        raise UserError(
            f"{path}: outlines differ in area by a factor of {swing:.2g}, as where the body covers its background in most frames: give an "
            "image of the empty scene (--background), or cut the clip (--start, --end)"
        )
    return Silhouettes(times, first, places.min(axis=0), places.max(axis=0), seen, swing, np.array(centres))


def _fall(centres: np.ndarray, path: Path) -> list[str]:
    """Check the flight of an outline up to its lowest place after the highest; return what is said of its start.

    Raises:
        UserError: Its acceleration is gravity in another unit or direction.
    """
    top = int(np.argmax(centres[:, 2]))
    t, x, y = centres[: top + int(np.argmin(centres[top:, 2])) + 1].T
    check_flight(t, y, -GRAVITY, "y", path.name)
    held = held_rows(t, np.stack([x, y], 1), (0.0, -GRAVITY))
    if not held:
        return []
    return [f"odd: {path.name}: the body is held at first: it keeps its height for longer than a free one can; give --start {t[held]:.4g}"]


def _camera(width: int, height: int, scale: float) -> Cameras:
    """Return a camera so far away that a pixel is `scale` metres at every depth, which looks along -z at the middle of the picture."""
    middle = 0.5 * scale * width, 0.5 * scale * height
    distance = FAR * scale * width
    viewmat = convert.look_at((*middle, distance), (*middle, 0.0))
    K = convert.intrinsics(width, height, focal=distance / scale)
    return Cameras(viewmat[None].float(), K[None].float(), width, height)


def _body(mask: np.ndarray, scale: float, thickness: float | None, path: Path) -> tuple[np.ndarray, float, float, str]:
    """Return particles [m] (P, 3), volume [m^3] and spacing [m] of the body behind an outline, and what was assumed."""
    area = float(mask.sum()) * scale**2
    if thickness is not None:
        volume, words = area * thickness, f"the outline extruded by {1e3 * thickness:g} mm"
    else:
        left, right = _rows(mask, path)
        volume, words = float(np.sum(np.pi / 4 * (right - left) ** 2)) * scale**3, "a body of revolution about the vertical axis"
    spacing = (volume / PARTICLES) ** (1 / 3)
    if thickness is not None:
        spacing = thickness / max(round(thickness / spacing), 1)
    height = mask.shape[0]
    y, x = np.nonzero(mask >= INSIDE)
    low, high = scale * np.array([x.min(), height - y.max() - 1]), scale * np.array([x.max() + 1, height - y.min()])
    axes = []
    for a in range(2):  # a lattice that is centred on the outline
        count = max(round((high[a] - low[a]) / spacing), 1)
        axes.append(0.5 * (low[a] + high[a]) + spacing * (np.arange(count) - 0.5 * (count - 1)))
    reach = thickness if thickness is not None else scale * float((right - left).max())
    count = max(round(reach / spacing), 1)
    axes.append(spacing * (np.arange(count) - 0.5 * (count - 1)))
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    at = (grid[:, :2] / scale - 0.5) * [1, -1] + [0, height - 1]  # pixel centres lie at whole numbers here
    if thickness is not None:
        inside = cv2.remap(mask, *at.astype(np.float32).T[:, :, None], cv2.INTER_LINEAR)[:, 0] >= INSIDE
    else:
        row = np.clip(np.rint(at[:, 1]).astype(int), 0, height - 1)
        middle, radius = scale * 0.5 * (left + right)[row], scale * 0.5 * (right - left)[row]
        inside = np.hypot(grid[:, 0] - middle, grid[:, 2]) <= radius
    if inside.sum() < 8:
        raise UserError(f"{path}: the body is {int(mask.sum())} px large in the first frame, too small for its shape: film closer")
    return grid[inside], volume, spacing, f"{words}: {volume:.4g} m^3"


def _rows(mask: np.ndarray, path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return the left and right end of the body in each row [px], (H,) each; equal where there is no body.

    Raises:
        UserError: The outline has no vertical axis of symmetry.
    """
    width = mask.sum(axis=1)
    columns = np.arange(mask.shape[1]) + 0.5
    axis = float((mask.sum(axis=0) * columns).sum() / mask.sum())
    mirrored = np.stack([np.interp(2 * axis - columns, columns, row) for row in mask])
    overlap = float(np.minimum(mask, mirrored).sum() / np.maximum(mask, mirrored).sum())
    if overlap < SYMMETRIC:
        raise UserError(
            f"{path}: the outline of the first frame overlaps with its mirror image by {overlap:.0%}, so that the body is "
            "none of revolution about the vertical axis: give its depth along the line of sight (--thickness '20 mm')"
        )
    return axis - width / 2, axis + width / 2
