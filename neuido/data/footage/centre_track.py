"""One view of a thing that moves: the centre of its mask in each frame, as a motion in pixels or metres with y up."""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from neuido.data.footage.contact_sheet import Sheet
from neuido.data.footage.filming import Filming, chosen_frames
from neuido.data.footage.moving_object import DIAMETER_ERROR, background_of, sightings
from neuido.data.footage.video_frames import read_clip
from neuido.errors import UserError

AREA_RANGE = 0.5, 2.0
"""Areas, relative to the median, at which a frame shows the object whole and alone."""
RIVAL = 0.5
"""Area of a second moving thing, relative to the object, from which on the two may be taken for each other."""
RIVAL_SHARE = 0.3
"""Share of the frames with such a rival at which a video is refused."""


class Centres(NamedTuple):
    """The centre of the object in T frames."""

    t: np.ndarray
    """Times in the clock of the video [s], (T,)."""
    x: np.ndarray
    """x to the right and y up from the lower left corner of the picture, (T, 2)."""
    unit: str
    """Unit of `x`: `pixel`, or `m` if the diameter gave the scale."""
    notes: list[str]
    """What was found, for the summary."""
    scale_error: float
    """Relative error of a scale that follows from the diameter; 0 if the scale is given."""


def read_centres(path: Path, filming: Filming, *, frame_rate: float | None, diameter: float | None, scaled: bool, sheet: Sheet) -> Centres:
    """Follow the object of a video from one fixed camera.

    Args:
        path: The video file.
        filming: The user's options.
        frame_rate: True frames per second of a slow-motion video.
        diameter: Diameter of the object [m]; without a scale, it gives metres per pixel by the area of the mask.
        scaled: Whether the user gave metres per pixel.
        sheet: Collects frames for the contact sheet.

    Returns:
        The centres, NaN where the object was not found whole.

    Raises:
        UserError: The video cannot be read, nothing moves in it, several things do, or neither scale nor diameter is known.
    """
    clip = read_clip(path, frame_rate=frame_rate)
    chosen = chosen_frames(clip, filming)
    background = background_of(clip, np.arange(len(clip.times)), filming.background_file)
    centre, area, cut, others = (np.zeros((len(chosen), n)) for n in (2, 1, 1, 1))
    for i, (image, found) in enumerate(sightings(clip, chosen, background)):
        centre[i], area[i], cut[i], others[i] = found.centre, found.area, found.cut, found.others
        sheet.add(path.name, i, len(chosen), image, found.mask, f"{clip.times[chosen[i]] - clip.times[0]:.3f} s")
    area, cut, others = area[:, 0], cut[:, 0] > 0, others[:, 0]
    seen = area > 0
    if seen.sum() < 3:
        raise UserError(
            f"{path}: something moves in {seen.sum()} of {len(seen)} frames; is the camera fixed, and the object unlike the background? "
            "Give an image of the empty scene (--background)"
        )
    rivals = float((others[seen] > RIVAL).mean())
    if rivals > RIVAL_SHARE:
        raise UserError(
            f"{path}: two things of similar size differ from the background in {rivals:.0%} of the frames: cut the clip (--start, --end), "
            "or give an image of the empty scene (--background) if the object rests for most of it"
        )
    whole = seen & ~cut
    if whole.sum() < 3:
        raise UserError(f"{path}: the object is whole in {whole.sum()} frames and leaves the picture in {cut.sum()}: film a wider view")
    usual = float(np.median(area[whole]))
    odd = whole & ((area < AREA_RANGE[0] * usual) | (area > AREA_RANGE[1] * usual))
    whole &= ~odd
    size = 2 * np.sqrt(usual / np.pi)
    rate = f"{1 / clip.interval:.4g} frames/s {'as given' if frame_rate else 'by the times of the video'}"
    notes = [f"video of {clip.width} x {clip.height} px, {len(chosen)} frames, {rate}",
             f"an object of {size:.3g} px across, found in {int(seen.sum())} frames"]  # fmt: skip
    for count, words in ((int(cut.sum()), "cut by the border"), (int(odd.sum()), "with half or twice the usual area")):
        if count:
            notes.append(f"{count} frames in which it is {words} are left out")
    x = np.stack([centre[:, 0], clip.height - centre[:, 1]], 1)
    x[~whole] = np.nan
    unit, error = "pixel", 0.0
    if not scaled:
        if diameter is None:
            raise UserError(f"{path.name} needs its scale: give --scale (metres per pixel), or --diameter of the object (m)")
        x, unit, error = x * (diameter / size), "m", DIAMETER_ERROR / size
        notes.append(f"scale {diameter / size:.5g} m per pixel by the diameter of the object, within {error:.1%} (--scale replaces it)")
    return Centres(clip.times[chosen], x, unit, notes, error)
