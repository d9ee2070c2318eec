"""Clips of one motion from several fixed cameras become a recording: images with masks, cameras, times and the initial velocity."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import torch

from neuido.data import cameras as convert
from neuido.data.footage.board_cameras import board_cameras
from neuido.data.footage.contact_sheet import Sheet
from neuido.data.footage.filming import SAME_ASPECT, Filming, View, chosen_frames
from neuido.data.footage.known_cameras import reconstructed_cameras, recorded_cameras
from neuido.data.footage.moving_object import background_of, sightings
from neuido.data.footage.synchronisation import start_times
from neuido.data.footage.video_frames import Clip, read_clip
from neuido.data.formats import nerfstudio
from neuido.data.scenes.filmed_scene import Motion, write_motion
from neuido.data.scenes.multiview import UP
from neuido.data.scenes.view_geometry import mean_misfit, triangulate
from neuido.errors import UserError
from neuido.types import Cameras

VELOCITY_FRAMES = 7
"""Frames from which the initial velocity is estimated, by a parabola."""
MIDDLE = 0.5
"""Place of the body in x and z of the unit cube [m], the default domain of `neuido reconstruct`."""
ROOMY = 0.8
"""Extent of a motion [m] that leaves room for the body in that domain."""


def write_views(
    paths: Sequence[Path],
    folder: Path,
    filming: Filming,
    *,
    scale: float | None,
    up: str,
    floor: float | None,
    frame_rate: float | None,
    sheet: Sheet,
    held_out: Sequence[int] = (),
) -> list[str]:
    """Write the clips of one motion as a recording in an existing folder; return the lines of the summary.

    The coordinates are metres with +y up. The body starts in the middle of x and z of the unit cube, and the floor is at y = 0.

    Args:
        paths: The video files, one per camera.
        folder: The folder to fill.
        filming: The user's options.
        scale: Metres per unit of the cameras; 1 if None.
        up: Axis of the cameras' frame that points up; for a board `z` if it lies flat and `y` if it stands upright.
        floor: Height of the floor in the cameras' frame after rotation [m]; None: 0 for a board that lies flat, else unknown.
        frame_rate: True frames per second of slow-motion videos.
        sheet: Collects frames for the contact sheet.
        held_out: Indices of the views that are only scored.

    Raises:
        UserError: A clip cannot be read, cameras cannot be found, the clips do not overlap in time, or nothing moves.
    """
    if up not in UP:
        raise UserError(f"--up {up} must be one of {', '.join(UP)}")
    if frame_rate is not None and filming.synchronise == "audio":
        raise UserError("--synchronise audio goes by the clock of the files, which --frame_rate replaces: give flash, or --offsets (s)")
    clips = [read_clip(path, frame_rate=frame_rate) for path in paths]
    if len(clips) < 2:
        raise UserError(f"--cameras {filming.cameras} needs the clips of at least two cameras, got {paths[0].name} alone")
    views, notes = _views(clips, filming)
    if filming.cameras == "colmap" and scale is None:
        notes.append("lengths are in COLMAP's own unit, not in metres: give --scale; after a free fall, `neuido check` estimates it")
    late, words = start_times(clips, filming.synchronise, filming.offsets)
    notes.append(words)
    frames, times, gap = _common_frames(clips, late, filming)
    interval = float(np.median(np.diff(times)))
    notes.append(f"{len(clips)} views, {len(times)} frames every {1e3 * interval:.4g} ms, up to {1e3 * gap:.2g} ms apart between views")
    size = (clips[0].width, clips[0].height)
    cameras = _cameras(clips, views, size)
    cameras = convert.move(cameras, scale=scale or 1.0, rotation=torch.tensor(UP[up]).double())
    centres, whole = np.full((len(clips), len(times), 2), np.nan), np.zeros((len(clips), len(times)), bool)
    (folder / "images").mkdir()
    for v, (clip, view, own) in enumerate(zip(clips, views, frames)):
        background = background_of(clip, np.arange(len(clip.times)), filming.background_file)
        for t, (image, found) in enumerate(sightings(clip, own, background)):
            sheet.add(clip.path.name, t, len(times), image, found.mask, f"{times[t]:.3f} s")
            rgba = np.dstack([image, np.rint(255 * found.mask).astype(np.uint8)])
            centres[v, t], whole[v, t] = found.centre, found.area > 0 and not found.cut
            rgba, centres[v, t] = _straight(rgba, centres[v, t], view)
            ratio = size[0] / clip.width
            centres[v, t] *= ratio
            if ratio != 1:
                rgba = cv2.resize(rgba, size, interpolation=cv2.INTER_AREA)
            nerfstudio.write_image(folder / f"images/{v}_{t:03d}.png", rgba, size=size)
        if not whole[v].any():
            raise UserError(f"{clip.path}: nothing whole moves in front of the background: give an image of the empty scene (--background)")
    x = triangulate(centres, whole, cameras)
    if (met := int(np.isfinite(x).all(axis=1).sum())) < 3:
        raise UserError(f"two cameras see the object whole in {met} frames, at least 3 are needed: film wider views")
    if first := int(np.isfinite(x).all(axis=1).argmax()):
        moment = clips[0].times[frames[0][first]] - clips[0].times[0]
        raise UserError(
            f"two cameras see the object from {moment:.3g} s of {clips[0].path.name} on: give --start {np.ceil(1e3 * moment) / 1e3:g}"
        )
    misfit = mean_misfit(x, centres, whole, cameras)
    shift, motion = _placed(x, times, floor if floor is not None else 0.0 if filming.cameras == "board" and up == "z" else None)
    cameras = convert.move(cameras, shift=(shift[0], shift[1], shift[2]))
    nerfstudio.write_transforms(folder, cameras, torch.from_numpy(times), held_out=held_out)
    write_motion(motion, folder)
    notes.append(f"centres of the views meet within {misfit:.2g} px (root mean square): it holds errors of cameras, clocks and masks")
    notes.append("velocity at the start {:.3g}, {:.3g}, {:.3g} m/s in motion.yaml".format(*motion.velocity))
    reach = float(np.nanmax(np.ptp(x[np.isfinite(x).all(axis=1)], axis=0)))
    if reach > ROOMY:
        notes.append(
            f"the body moves over {reach:.2g} m, and the default domain is 1 m wide: give `neuido reconstruct` a larger one (--setting)"
        )
    return notes


def _views(clips: Sequence[Clip], filming: Filming) -> tuple[list[View], list[str]]:
    if filming.cameras == "board":
        return board_cameras(clips, filming)
    if filming.cameras == "colmap":
        return reconstructed_cameras(clips, filming)
    path = Path(str(filming.cameras)).expanduser()
    if not path.exists():
        raise UserError(f"--cameras {filming.cameras} is neither board, colmap nor a recording: it does not exist")
    return recorded_cameras(path, clips)


def _common_frames(clips: Sequence[Clip], late: np.ndarray, filming: Filming) -> tuple[list[np.ndarray], np.ndarray, float]:
    """Return the frames of each clip that belong together, their times from 0 [s], and the largest time between two of them [s].

    The frames are those of the first clip between `start` and `end` that every clip has.
    """
    clocks = [clip.times + offset for clip, offset in zip(clips, late)]
    wanted = clocks[0][chosen_frames(clips[0], filming)]
    slack = max(clip.interval for clip in clips) / 2
    wanted = wanted[(wanted >= max(clock[0] for clock in clocks) - slack) & (wanted <= min(clock[-1] for clock in clocks) + slack)]
    if len(wanted) < 3:
        raise UserError(
            f"{clips[0].path}: the clips share {len(wanted)} frames between --start and --end: check --offsets or --synchronise; they last "
            f"{', '.join(f'{clock[0]:.3g} to {clock[-1]:.3g}' for clock in clocks)} s on the common clock"
        )
    frames = [np.abs(clock[None] - wanted[:, None]).argmin(axis=1) for clock in clocks]
    for clip, own in zip(clips, frames):
        if (np.diff(own) <= 0).any():
            raise UserError(f"{clip.path} has fewer frames per second than {clips[0].path.name}: name the slowest clip first")
    gap = max(float(np.abs(clock[own] - wanted).max()) for clock, own in zip(clocks, frames))
    return frames, wanted - wanted[0], gap


def _cameras(clips: Sequence[Clip], views: Sequence[View], size: tuple[int, int]) -> Cameras:
    Ks = []
    for clip, view in zip(clips, views):
        ratio = np.array([size[0] / clip.width, size[1] / clip.height, 1.0])
        if abs(ratio[0] / ratio[1] - 1) > SAME_ASPECT:
            raise UserError(f"{clip.path} has {clip.width} x {clip.height} px, another aspect ratio than {clips[0].path.name}: crop one")
        Ks.append(view.K * ratio[:, None])
    viewmats = torch.from_numpy(np.stack([view.viewmat for view in views]))
    return Cameras(viewmats.float(), torch.from_numpy(np.stack(Ks)).float(), *size)


def _straight(rgba: np.ndarray, centre: np.ndarray, view: View) -> tuple[np.ndarray, np.ndarray]:
    """Undistort an image and a point [px] to a pinhole with the same K."""
    if not any(view.distortion):
        return rgba, centre
    lens, K = np.array(view.distortion), view.K - np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    point = cv2.undistortPoints((centre - 0.5).reshape(1, 1, 2), K, lens, P=K).ravel() + 0.5 if np.isfinite(centre).all() else centre
    return cv2.undistort(rgba, K, lens), point


def _placed(x: np.ndarray, times: np.ndarray, floor: float | None) -> tuple[np.ndarray, Motion]:
    """Return the shift of the coordinates, and the motion at the first frame in shifted coordinates."""
    seen = np.flatnonzero(np.isfinite(x).all(axis=1))[:VELOCITY_FRAMES]
    basis = np.stack([times[seen] ** power for power in range(3)], 1)
    start, velocity, _ = np.linalg.lstsq(basis, x[seen], rcond=None)[0]
    shift = np.array([MIDDLE, MIDDLE, MIDDLE]) - start
    if floor is not None:
        shift[1] = -floor
    place, speed = (start + shift).tolist(), velocity.tolist()
    return shift, Motion(velocity=(speed[0], speed[1], speed[2]), centre=(place[0], place[1], place[2]))
