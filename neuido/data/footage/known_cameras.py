"""Cameras of several views from a recording that has them, or from COLMAP run on one frame of each clip."""

import tempfile
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from neuido.data import cameras as convert
from neuido.data.files.writing import write_png
from neuido.data.footage.filming import SAME_ASPECT, Filming, View, chosen_frames
from neuido.data.footage.video_frames import Clip, images
from neuido.data.formats import colmap
from neuido.data.formats.layout import MultiView
from neuido.data.scenes.readers import read_recording
from neuido.errors import UserError
from neuido.physics.runtime.lazy import import_extra


def recorded_cameras(path: Path, clips: Sequence[Clip]) -> tuple[list[View], list[str]]:
    """Take the cameras from a recording whose views are named like the clips; return them and a line for the summary.

    Args:
        path: A recording in any format that `neuido.read_recording` reads, such as a COLMAP project with one image per clip.
        clips: The clips. The view of `left.mp4` is `left`, or an image `left.png`.

    Raises:
        UserError: The recording cannot be read, a clip has no view of its name, or the image sizes have other aspect ratios.
    """
    found = read_recording(path)
    return views_of(found, [clip.path for clip in clips], f"--cameras {path}", [(clip.width, clip.height) for clip in clips]), [
        f"cameras of {path} ({found.format})"
    ]


def reconstructed_cameras(clips: Sequence[Clip], filming: Filming) -> tuple[list[View], list[str]]:
    """Reconstruct the cameras with COLMAP from the first frame of each clip; return them and a line for the summary.

    Raises:
        UserError: pycolmap is not installed, or COLMAP does not register all clips.
    """
    pycolmap = import_extra("pycolmap", "--cameras colmap", extra="colmap")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "images").mkdir()
        for clip in clips:
            image = next(images(clip, chosen_frames(clip, filming)[:1]))
            write_png(folder / "images" / f"{clip.path.stem}.png", cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
        pycolmap.logging.minloglevel = pycolmap.logging.Level.FATAL.value
        pycolmap.extract_features(folder / "database.db", folder / "images", camera_mode=pycolmap.CameraMode.PER_IMAGE)
        pycolmap.match_exhaustive(folder / "database.db")
        models = pycolmap.incremental_mapping(folder / "database.db", folder / "images", folder)
        largest = max(models.values(), key=lambda model: model.num_reg_images(), default=None)
        if largest is None or largest.num_reg_images() < len(clips):
            count = 0 if largest is None else largest.num_reg_images()
            raise UserError(
                f"--cameras colmap: COLMAP places {count} of {len(clips)} views: put more texture into the scene and the cameras closer "
                "together, or use a printed board (--cameras board)"
            )
        (folder / "sparse").mkdir(exist_ok=True)
        largest.write(folder / "sparse")
        found = colmap.views(folder / "sparse", folder / "images", folder=folder, name="clips")
        error = float(largest.compute_mean_reprojection_error())
        sizes = [(clip.width, clip.height) for clip in clips]
        return views_of(found, [clip.path for clip in clips], "--cameras colmap", sizes), [
            f"cameras by COLMAP, {largest.num_points3D()} points within {error:.2g} px"
        ]


def views_of(found: MultiView, files: Sequence[Path], option: str, sizes: Sequence[tuple[int, int]] | None = None) -> list[View]:
    """Return the camera of each file, that of the view of its name.

    Args:
        found: A recording.
        files: Clips or tables; the view of `left.mp4` is `left`, or an image `left.png`.
        option: The user's option in messages.
        sizes: Width and height of the images of each file [px]; None: those of the recording.

    Raises:
        UserError: A file has no view of its name, an image size has another aspect ratio, or the cameras move.
    """
    convert.refuse_moving(found.cameras, option, "clips need one pose for each view; give a recording of fixed cameras")
    stems = {path.stem: v for v, row in enumerate(found.images) for path in row[:1] if path is not None}
    stems |= {Path(view).stem: v for v, view in enumerate(found.views)} | {view: v for v, view in enumerate(found.views)}
    views = []
    for file, (width, height) in zip(files, sizes or [(found.cameras.width, found.cameras.height)] * len(files)):
        if file.stem not in stems:
            raise UserError(f"{option} has no view {file.stem!r} for {file.name}: it has {', '.join(list(stems)[:12])}")
        v = stems[file.stem]
        ratio = np.array([width / found.cameras.width, height / found.cameras.height, 1.0])
        if abs(ratio[0] / ratio[1] - 1) > SAME_ASPECT:
            raise UserError(
                f"{file} has {width} x {height} px, its camera in {option} {found.cameras.width} x {found.cameras.height}, "
                "another aspect ratio"
            )
        lens = () if found.distortion is None else tuple(found.distortion[v].tolist())
        views.append(View(found.cameras.viewmats[v].double().numpy(), found.cameras.Ks[v].double().numpy() * ratio[:, None], lens))
    return views
