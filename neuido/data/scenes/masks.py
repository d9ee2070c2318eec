"""Object masks: read from files of any usual encoding, or computed from a plain or a known background."""

from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor

from neuido.data.files.parsing import image_size, read_image
from neuido.errors import UserError

MIN_DIFFERENCE = 0.06  # fraction of the colour range; noise and soft shadows change less


def mask_centre(mask: np.ndarray) -> tuple[float, float]:
    """Return the centre [px] of a mask (H, W) that is not empty; x to the right and y down, pixel centres at half-integers."""
    x, y = (float((mask.sum(axis=axis) * (np.arange(mask.shape[1 - axis]) + 0.5)).sum() / mask.sum()) for axis in (0, 1))
    return x, y


def mask_channel(path: Path) -> np.ndarray:
    """Read a mask file as the object's share of each pixel, (H, W) float32 in [0, 1].

    The mask is the alpha channel if it is not opaque everywhere, the non-zero indices of a palette image, or else the largest channel. A
    file with zero and one other value is a binary mask, whatever that value is. With more values it is a soft mask.

    Raises:
        UserError: The file is not an image, or its values are labels of several objects.
    """
    labels = _palette_indices(path)
    if labels is not None:
        return (labels != 0).astype(np.float32)
    raw = read_image(path)
    if raw.ndim == 3 and raw.shape[2] in (2, 4) and bool((raw[..., -1] < np.iinfo(raw.dtype).max).any()):
        plane = raw[..., -1]
    else:
        plane = raw if raw.ndim == 2 else raw[..., :3].max(axis=2)
    values = np.unique(plane)
    if len(values) == 1 and values[0] > 0:
        return np.ones(plane.shape, np.float32)
    if len(values) == 2 and values[0] == 0:
        return (plane > 0).astype(np.float32)
    if values[-1] <= 20 and len(values) > 2 and (np.diff(values) == 1).all():
        raise UserError(
            f"{path} has the values {', '.join(map(str, values[:5]))}{', ...' if len(values) > 5 else ''}: labels of several objects; "
            "write a mask of one object with the values 0 and 255"
        )
    return plane.astype(np.float32) / np.iinfo(raw.dtype).max


def _palette_indices(path: Path) -> np.ndarray | None:
    """Read the indices (H, W) of a palette image; return None for any other image."""
    from PIL import Image

    image_size(path)  # raises if the file is missing or too large
    try:
        with Image.open(path) as image:
            return np.asarray(image) if image.mode == "P" and "transparency" not in image.info else None
    except Exception:  # OpenCV may read what Pillow cannot
        return None


def rim_colour(rims: np.ndarray) -> np.ndarray:
    """Estimate the colour (3,) of a plain background from border pixels of images (N, 3).

    Raises:
        UserError: More than 20 % of the pixels differ from the median colour.
    """
    colour = np.median(rims, axis=0).astype(np.float32)
    far = float((np.abs(rims - colour).max(axis=1) > MIN_DIFFERENCE).mean())
    if far > 0.2:
        raise UserError(
            f"the images have no masks, and {far:.0%} of their border pixels differ from one colour: give an alpha channel, mask_path in "
            "transforms.json, or masks/<image name>.png beside a COLMAP model"
        )
    return colour


def mask_on_plain_background(image: np.ndarray, colour: np.ndarray) -> np.ndarray:
    """Compute the mask (H, W) of an object in front of a plain background, for an image (H, W, 3).

    A pixel at the outline mixes object and background. Its value is its difference from the background, divided by the largest difference
    within two pixels. Further inside, the value is one.
    """
    difference = np.abs(image - colour).max(axis=2)
    differs = (difference > MIN_DIFFERENCE).astype(np.float32)
    window = np.ones((5, 5), np.uint8)
    inside = cv2.erode(differs, window, borderType=cv2.BORDER_CONSTANT, borderValue=1.0)
    largest = cv2.dilate(difference, window, borderType=cv2.BORDER_CONSTANT, borderValue=0.0)
    return np.maximum(inside, differs * difference / np.maximum(largest, MIN_DIFFERENCE))


def mask_from_empty(image: np.ndarray, empty: np.ndarray) -> np.ndarray:
    """Compute a binary mask (H, W): the pixels in which an image differs from that of the empty scene, median-filtered."""
    differs = (np.abs(image - empty).max(axis=2) > MIN_DIFFERENCE).astype(np.uint8)
    return cv2.medianBlur(differs, 3).astype(np.float32)


def masks_from_background(images: Tensor) -> tuple[Tensor, Tensor]:
    """Compute the background colour (3,) and the masks (V, T, H, W) in [0, 1] of images (V, T, H, W, 3) with a plain background.

    The colour is the median of the border pixels of the first frames.

    Raises:
        UserError: The border pixels do not have one colour.
    """
    first = images[:, 0].numpy()
    rims = [part.reshape(-1, 3) for part in (first[:, 0], first[:, -1], first[:, :, 0], first[:, :, -1])]
    colour = rim_colour(np.concatenate(rims))
    masks = [[torch.from_numpy(mask_on_plain_background(image.numpy(), colour)) for image in view] for view in images]
    return torch.from_numpy(colour), torch.stack([torch.stack(view) for view in masks])
