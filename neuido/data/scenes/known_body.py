"""Reader of filmed experiments whose particles are known (`particles.npz`), so that no reconstruction is needed."""

import os
from collections.abc import Sequence
from dataclasses import replace

from neuido.data.measured.experiment import Recording, read_experiment
from neuido.data.scenes.filmed_scene import VisualScene, load_views
from neuido.errors import UserError
from neuido.types import MultiViewBatch


def load_known_body(
    folder: str | os.PathLike,
    *,
    recording: str | None = None,
    dt: float | None = None,
    crop: Sequence[int] | None = None,
    **options,
) -> VisualScene:
    """Read a recording of an experiment that has both images and particles.

    The body is rendered from its particles: its silhouette can be compared with the images, its colours cannot.

    Args:
        folder: The experiment folder.
        recording: Name of the recording; None: the only one with images.
        dt: Substep [s]; None: that of the experiment.
        crop: Part of the images to use [px]: left, top, right, bottom, after resizing to `width`.
        options: `views`, `frame_step`, `frame_count`, `width`, `background` and `frame_interval` of `load_views`.

    Raises:
        UserError: There is no such recording, it lacks images or particles, or `dt` or `crop` is invalid.
    """
    experiment = read_experiment(folder)
    filmed = [one.name for one in experiment.recordings if one.video is not None]
    if recording is None and len(filmed) != 1:
        raise UserError(f"{folder} has {len(filmed)} recordings with images ({', '.join(filmed)}): give the option recording")
    chosen: Recording = experiment[recording or filmed[0]]
    if chosen.body is None or chosen.video is None:
        lacking = "particles.npz" if chosen.body is None else "transforms.json"
        raise UserError(f"recording {chosen.name} of {folder} lacks {lacking}, which body: particles needs")
    if dt is not None and not dt > 0:
        raise UserError(f"dt = {dt} must be positive")
    batch = load_views(experiment.folder, recording=chosen.name, **options)
    scene = chosen.scene if dt is None else replace(chosen.scene, dt=dt)
    if crop is not None:
        batch = crop_images(batch, crop)
    return VisualScene(experiment.name, scene, experiment.model["density"], experiment.model, chosen.body, None, batch, None)


def crop_images(batch: MultiViewBatch, crop: Sequence[int]) -> MultiViewBatch:
    """Crop images to the columns [left, right) and rows [top, bottom); shift the principal points of the cameras accordingly.

    Raises:
        UserError: `crop` is not four whole numbers, or not a part of the images.
    """
    height, width = batch.images.shape[2:4]
    if len(crop) != 4 or any(isinstance(n, bool) or not isinstance(n, int) for n in crop):
        raise UserError(f"crop = {crop} must be left, top, right, bottom in whole pixels")
    left, top, right, bottom = crop
    if not (0 <= left < right <= width and 0 <= top < bottom <= height):
        raise UserError(f"crop = {list(crop)} must lie within the images of {width} x {height} pixels")
    Ks = batch.cameras.Ks.clone()
    Ks[:, 0, 2] -= left
    Ks[:, 1, 2] -= top
    cameras = batch.cameras._replace(Ks=Ks, width=right - left, height=bottom - top)
    images, masks = batch.images[:, :, top:bottom, left:right], batch.masks[:, :, top:bottom, left:right]
    return batch._replace(images=images.contiguous(), masks=masks.contiguous(), cameras=cameras)
