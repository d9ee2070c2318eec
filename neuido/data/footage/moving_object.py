"""The moving object of a video: its mask in each frame, by the difference from the background, and the centre of the mask."""

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from neuido.data.files.parsing import read_image
from neuido.data.footage.video_frames import Clip, images
from neuido.data.scenes.masks import MIN_DIFFERENCE, mask_centre, mask_on_plain_background
from neuido.errors import UserError

BACKGROUND_FRAMES = 21
"""Frames whose median is the background, evenly spread over the clip."""
NOISE_FACTOR = 6.0
"""Standard deviations of the noise that count as a difference; a normal distribution exceeds them in 2 of 1e9 pixels."""
DIAMETER_ERROR = 0.7
"""Largest error of a diameter that follows from the area [px], measured on drawn discs of four colours and three sizes in H.264."""
MIN_PIXELS = 12
"""Smallest area of an object [px]; the centre of a smaller one is uncertain by more than a tenth of a pixel."""


class Sighting(NamedTuple):
    """The object in one frame."""

    mask: np.ndarray
    """Share of the object in each pixel, (H, W) float32 in [0, 1]; zero everywhere if it was not found."""
    centre: tuple[float, float]
    """Centre of the mask [px], x to the right and y down; NaN if the object was not found."""
    area: float
    """Area of the mask [px]."""
    cut: bool
    """Whether the mask touches the border of the image."""
    others: float
    """Area of the next largest thing that moves, relative to that of the object."""


def background_of(clip: Clip, chosen: np.ndarray, file: Path | None = None) -> np.ndarray:
    """Return the empty scene (H, W, 3), float32 in [0, 1]: an image file, or the median of frames spread over the chosen ones.

    Raises:
        UserError: The image file is malformed or has another size than the video.
    """
    if file is not None:
        raw = read_image(file)
        colour = cv2.cvtColor(raw, cv2.COLOR_GRAY2RGB) if raw.ndim == 2 else cv2.cvtColor(raw[..., :3], cv2.COLOR_BGR2RGB)
        if colour.shape[1::-1] != (clip.width, clip.height):
            raise UserError(
                f"--background {file} has {colour.shape[1]} x {colour.shape[0]} px, {clip.path.name} {clip.width} x {clip.height}"
            )
        return colour.astype(np.float32) / np.iinfo(raw.dtype).max
    spread = np.unique(chosen[np.linspace(0, len(chosen) - 1, min(BACKGROUND_FRAMES, len(chosen))).astype(int)])
    stack = np.stack(list(images(clip, spread)))
    middle = np.empty(stack.shape[1:], np.float32)
    for row in range(0, len(middle), 64):  # a median of all rows at once would need a copy of all frames
        middle[row : row + 64] = np.median(stack[:, row : row + 64], axis=0)
    return middle / 255.0


def sightings(clip: Clip, chosen: np.ndarray, background: np.ndarray) -> Iterator[tuple[np.ndarray, Sighting]]:
    """Yield the image (H, W, 3) uint8 and the object of each chosen frame."""
    for image in images(clip, chosen):
        yield image, find_object(image, background)


def find_object(image: np.ndarray, background: np.ndarray) -> Sighting:
    """Find the largest thing in an image (H, W, 3) uint8 that is not in the background (H, W, 3) in [0, 1]."""
    colours = image.astype(np.float32) / 255.0
    difference = np.abs(colours - background).max(axis=2)
    least = max(MIN_DIFFERENCE, NOISE_FACTOR * 1.4826 * float(np.median(difference)))
    differs = cv2.morphologyEx((difference > least).astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    count, labels, figures, _ = cv2.connectedComponentsWithStats(differs, connectivity=8)
    areas = figures[1:, cv2.CC_STAT_AREA]
    if count < 2 or areas.max() < MIN_PIXELS:
        return Sighting(np.zeros(difference.shape, np.float32), (np.nan, np.nan), 0.0, False, 0.0)
    own = 1 + int(np.argmax(areas))
    left, top, width, height = (int(v) for v in figures[own, :4])
    outline, _ = cv2.findContours((labels == own).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    filled = cv2.drawContours(np.zeros(difference.shape, np.uint8), outline, -1, 1, cv2.FILLED)  # holes: parts of the background's colour
    near = cv2.dilate(filled, np.ones((3, 3), np.uint8))
    # further inside than an outline is blurred, the object is whole whatever its colour
    inside = cv2.erode(filled, np.ones((5, 5), np.uint8))
    mask = np.maximum(inside, near * mask_on_plain_background(colours, background)).astype(np.float32)
    cut = left == 0 or top == 0 or left + width == mask.shape[1] or top + height == mask.shape[0]
    rest = np.delete(areas, own - 1)
    return Sighting(mask, mask_centre(mask), float(mask.sum()), cut, float(rest.max() / areas[own - 1]) if len(rest) else 0.0)
