"""Reader and writer of Nerfstudio's `transforms.json`; reader of Blender's `transforms_{train,val,test}.json` (NeRF, D-NeRF, GIC).

neuido adds two keys to a frame: `time` [s] and `view`, the number of the camera. The frames of a view may have different poses: the camera
moves. Frames without `view` belong to the same view if they have the same pose. If all poses differ and no folder has two images of one
time, each folder holds the images of a camera that moves. If frames have neither key, each pose is a view of the same moment.
"""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor

from neuido.data import cameras as convert
from neuido.data.files.parsing import image_size, read_json
from neuido.data.files.values import list_of_mappings, number, path_inside, require_key
from neuido.data.files.writing import write_json, write_png
from neuido.data.formats.layout import MultiView, Shot, assemble, natural_key, read_matrix, viewmat_from_opengl
from neuido.errors import UserError
from neuido.types import Cameras

SPLITS = ("transforms_train.json", "transforms_val.json", "transforms_test.json")
PINHOLES = ("PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV")
DISTORTION = ("k1", "k2", "p1", "p2", "k3")
UNKNOWN_TERMS = ("k4", "k5", "k6", "s1", "s2", "s3", "s4", "b1", "b2")
"""Distortion coefficients that are not supported; they must be zero."""
WIDE = re.compile(r"fish_?eye|ftheta|equirect|panoram|spherical|omnidirect", re.IGNORECASE)
"""What names a lens that is no pinhole, in a key or in the value of one of `LENSES`."""
LENSES = ("lens", "lens_model", "lens_type", "distortion_model", "camera_type", "projection", "projection_type")
FOCAL = {"fl_x", "camera_angle_x", "camera_angle_y"}
ENDINGS = (".png", ".jpg", ".jpeg", ".PNG", ".JPG")


def read(path: Path, *, recording: str | None = None, frame_interval: float | None = None) -> MultiView:
    """Read a Nerfstudio or Blender recording.

    A view is held out if `transforms_val.json` or `transforms_test.json` has it, or if `val_filenames` or `test_filenames` lists it. It
    is held out even if the training file has it too, as in GIC's data.

    Args:
        path: A folder with `transforms.json` or Blender's three files, or one such file.
        recording: Not used.
        frame_interval: Time between frames [s]. It replaces the times of the file.

    Raises:
        UserError: A key or a file is missing, a camera is not a pinhole, or a view has several frames but no times.
    """
    folder, files = (path.parent, [path]) if path.is_file() else (path, _files(path))
    shots: list[Shot] = []
    held_out: set[str] = set()
    poses: dict[tuple, str] = {}
    matrices: dict[str, Tensor] = {}
    seen: set[Path] = set()
    for file in files:
        content = read_json(file)
        if not isinstance(content, dict):
            raise UserError(f"{file} must contain a mapping with a list `frames`")
        kept = {name for key in ("val_filenames", "test_filenames") for name in _names(content, key, file)}
        for i, entry in enumerate(list_of_mappings(require_key(content, "frames", str(file)), f"{file}: frames")):
            where = f"{file.name}: frames[{i}]"
            shot = _shot(entry, content, folder, where, poses, matrices)
            if file.name in SPLITS[1:] or str(entry["file_path"]) in kept:
                held_out.add(shot.view)
            if shot.image not in seen:  # all three files of GIC list the test views
                shots.append(shot)
            seen.add(shot.image)
    if len(poses) == len(shots):
        shots, held_out = _moving_cameras(shots, held_out)
    shots = sorted(_timed(shots, frame_interval, folder), key=lambda shot: natural_key(shot.view))
    return assemble(shots, folder=folder, held_out=held_out, name=folder.resolve().name, format="nerfstudio")


def write(
    folder: Path,
    cameras: Cameras,
    times: Tensor,
    images: Sequence[Sequence[np.ndarray]],
    *,
    views: Sequence[str] | None = None,
    held_out: Sequence[int] = (),
) -> None:
    """Write a recording as `transforms.json` and `images/<view>_<frame>.png`.

    Args:
        folder: Output folder; it is created if it does not exist.
        cameras: V cameras, fixed or with a pose for each of the T frames.
        times: Times of the frames [s], (T,).
        images: images[v][t] is an RGB or RGBA image (H, W, 3 or 4) uint8. Images are accessed one by one, so the sequence may load lazily.
        views: Names of the views; the format requires whole numbers. Default: 0, 1, ...
        held_out: Indices of the views to list under `test_filenames`.
    """
    names = write_transforms(folder, cameras, times, views=views, held_out=held_out)
    for v, name in enumerate(names):
        for t in range(len(times)):
            write_image(folder / f"images/{name}_{t:03d}.png", images[v][t], size=(cameras.width, cameras.height))


def write_transforms(
    folder: Path, cameras: Cameras, times: Tensor, *, views: Sequence[str] | None = None, held_out: Sequence[int] = ()
) -> list[str]:
    """Write `transforms.json` without images; return the names of the views.

    The arguments are those of `write`. The caller writes the images to `images/<view>_<frame>.png`.
    """
    names = list(views) if views is not None else [str(v) for v in range(len(cameras.viewmats))]
    if not all(name.isdigit() for name in names):
        raise UserError(f"the names of views must be whole numbers, got {names}")
    (folder / "images").mkdir(parents=True, exist_ok=True)
    poses = convert.to_opengl(cameras.viewmats.double()).tolist()
    frames: list[dict[str, Any]] = []
    for v, name in enumerate(names):
        K = cameras.Ks[v].double()
        lens = {"fl_x": float(K[0, 0]), "fl_y": float(K[1, 1]), "cx": float(K[0, 2]), "cy": float(K[1, 2])}
        for t, time in enumerate(times.tolist()):
            relative = f"images/{name}_{t:03d}.png"
            pose = poses[v][t] if cameras.moving else poses[v]
            frames.append({"file_path": relative, **lens, "transform_matrix": pose, "time": time, "view": int(name)})
    content: dict[str, Any] = {"camera_model": "OPENCV", "w": cameras.width, "h": cameras.height, "frames": frames}
    if held_out:
        kept = {int(names[v]) for v in held_out}
        content["train_filenames"] = [frame["file_path"] for frame in frames if frame["view"] not in kept]
        content["test_filenames"] = [frame["file_path"] for frame in frames if frame["view"] in kept]
    write_json(folder / "transforms.json", content)
    return names


def write_image(path: Path, image: np.ndarray, *, size: tuple[int, int] | None = None) -> None:
    """Write an RGB or RGBA image (H, W, 3 or 4) uint8 as a PNG file.

    Raises:
        UserError: The array has another shape or type, its (width, height) is not `size`, or the file cannot be written.
    """
    image = np.asarray(image)
    if image.ndim != 3 or image.shape[2] not in (3, 4) or image.dtype != np.uint8 or (size and image.shape[1::-1] != size):
        raise UserError(f"{path.name} must be (H, W, 3 or 4) uint8{f' of size {size}' if size else ''}, got {image.shape} {image.dtype}")
    order = cv2.COLOR_RGB2BGR if image.shape[2] == 3 else cv2.COLOR_RGBA2BGRA
    write_png(path, cv2.cvtColor(image, order))


def _files(folder: Path) -> list[Path]:
    if (folder / "transforms.json").is_file():
        return [folder / "transforms.json"]
    files = [folder / name for name in SPLITS if (folder / name).is_file()]
    if not files:
        raise UserError(f"{folder} has neither transforms.json nor {SPLITS[0]}")
    return files


def _names(content: dict[str, Any], key: str, file: Path) -> list[str]:
    given = content.get(key, [])
    if not isinstance(given, list):
        raise UserError(f"{file}: {key} must be a list of file names")
    return [str(name) for name in given]


def _shot(
    own: dict[str, Any], shared: dict[str, Any], folder: Path, where: str, poses: dict[tuple, str], matrices: dict[str, Tensor]
) -> Shot:
    """Read one entry of `frames`; keys that it lacks are taken from the top level of the file.

    `poses` holds the names of unnamed views by their pose, `matrices` the poses of the file that were converted before: a fixed camera
    has one for all its frames.
    """
    entry = shared | own
    image = _image(folder, require_key(entry, "file_path", where), where)
    written = require_key(entry, "transform_matrix", where)
    viewmat = matrices.get(repr(written))
    if viewmat is None:
        viewmat = matrices[repr(written)] = viewmat_from_opengl(written, f"{where}.transform_matrix")
    model = entry.get("camera_model", "OPENCV")
    if model not in PINHOLES:
        raise UserError(f"{where}.camera_model = {model!r} must be one of {', '.join(PINHOLES)}: undistort the images first")
    for key, value in entry.items():
        if value and (WIDE.search(key) or (key in LENSES and WIDE.search(str(value)))):
            raise UserError(
                f"{where}.{key[:40]} = {str(value)[:40]!r}: fisheye and panoramic lenses are not supported: undistort the images first"
            )
    if "rolling_shutter" in entry and np.any(entry["rolling_shutter"]):
        raise UserError(f"{where}.rolling_shutter = {str(entry['rolling_shutter'])[:60]} is not supported: film with a global shutter")
    size = _size(entry, where) if "w" in entry and "h" in entry else image_size(image)
    K = _lens(own, shared, size, where)
    lens = _distortion(own, shared, where)
    mask = path_inside(folder, entry["mask_path"], f"{where}.mask_path") if "mask_path" in entry else None
    if "view" in entry:
        view = entry["view"]
        if isinstance(view, bool) or not isinstance(view, int | str):
            raise UserError(f"{where}.view must be a whole number, got {view!r}")
        view = str(view)
    else:
        pose = tuple(np.round(viewmat.numpy(), 6).ravel()) + tuple(np.round(K.numpy(), 3).ravel())
        view = poses.setdefault(pose, str(len(poses)))
    time = number(entry["time"], f"{where}.time", least=0.0) if "time" in entry else float("nan")
    return Shot(view, time, image, viewmat, K, mask, lens, size)


def _distortion(own: dict[str, Any], shared: dict[str, Any], where: str) -> tuple[float, ...]:
    """Read k1, k2, p1, p2, k3 of a frame from single keys or from Nerfstudio's `distortion_params` (k1, k2, k3, k4, p1, p2)."""
    entry = shared | own
    terms = {key: number(entry.get(key, 0.0), f"{where}.{key}") for key in (*DISTORTION, *UNKNOWN_TERMS)}
    if (given := entry.get("distortion_params")) is not None:
        values = read_matrix(given, f"{where}.distortion_params", (6,)).tolist()
        for key, value in zip(("k1", "k2", "k3", "k4", "p1", "p2"), values):
            if key in entry and terms[key] != value:
                raise UserError(f"{where}: {key} = {terms[key]:g} contradicts distortion_params: remove one of them")
            terms[key] = value
    for key in UNKNOWN_TERMS:
        if terms[key] != 0:
            raise UserError(f"{where}.{key} = {terms[key]:g} is not supported: undistort the images first")
    return tuple(terms[key] for key in DISTORTION)


def _size(entry: dict[str, Any], where: str) -> tuple[int, int]:
    width, height = (number(entry[key], f"{where}.{key}", least=1) for key in ("w", "h"))
    return int(width), int(height)


def _lens(own: dict[str, Any], shared: dict[str, Any], size: tuple[int, int], where: str) -> Tensor:
    """Return the intrinsic matrix of a frame. Its focal length, in pixels or as an angle, takes precedence over that of the file."""
    width, height = size
    entry = shared | own
    keys = next((given for given in (own, shared) if FOCAL & set(given)), {})
    if "fl_x" in keys:
        fx = number(keys["fl_x"], f"{where}.fl_x", above=0.0)
        fy = number(keys.get("fl_y", fx), f"{where}.fl_y", above=0.0)
    elif keys:
        focal = {}
        for key, side in (("camera_angle_x", width), ("camera_angle_y", height)):
            if key in keys:
                angle = number(keys[key], f"{where}.{key}", above=0.0)
                try:
                    focal[key] = float(convert.intrinsics(side, side, angle=angle)[0, 0])
                except UserError as error:
                    raise UserError(f"{where}.{key}: {error}") from error
        fx = focal.get("camera_angle_x", focal.get("camera_angle_y", 0.0))
        fy = focal.get("camera_angle_y", fx)
    else:
        raise UserError(f"{where} has neither fl_x nor camera_angle_x: give one of them for the focal length")
    cx, cy = (number(entry.get(key, half / 2), f"{where}.{key}") for key, half in (("cx", width), ("cy", height)))
    return torch.tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], dtype=torch.float64)


def _image(folder: Path, given: Any, where: str) -> Path:
    """Return the path of an image, with the suffix that Blender omits."""
    path = path_inside(folder, given, f"{where}.file_path")
    if path.suffix.lower() in (".png", ".jpg", ".jpeg"):
        return path
    return next((path.with_name(path.name + end) for end in ENDINGS if path.with_name(path.name + end).is_file()), path)


def _moving_cameras(shots: list[Shot], held_out: set[str]) -> tuple[list[Shot], set[str]]:
    """Make the images of a folder one view where all poses differ, and a folder has at most one image of a time.

    Args:
        shots: Images with known times that name no view, and of which no two have the same pose.
        held_out: Names of the views that are held out. A folder is held out if all its images are; one of which some are stays as it is.

    Returns:
        The shots and the views that are held out, as given if the images are no frames of moving cameras.
    """
    folders: dict[Path, list[Shot]] = {}
    for shot in shots:
        folders.setdefault(shot.image.parent, []).append(shot)
    groups = [folders[folder] for folder in sorted(folders, key=lambda folder: natural_key(str(folder)))]
    if any(len({shot.time for shot in group}) < len(group) or np.isnan([shot.time for shot in group]).any() for group in groups):
        return shots, held_out
    kept = [{shot.view in held_out for shot in group} for group in groups]
    if len(shots) == len(groups) or any(len(answers) > 1 for answers in kept):
        return shots, held_out
    named = [shot._replace(view=str(v)) for v, group in enumerate(groups) for shot in group]
    return named, {str(v) for v, answers in enumerate(kept) if True in answers}


def _timed(shots: list[Shot], frame_interval: float | None, folder: Path) -> list[Shot]:
    """Assign a time to each shot: that of the file, zero if a view has one shot, else its position in its view times `frame_interval`."""
    timeless = [shot for shot in shots if np.isnan(shot.time)]
    if timeless and len(timeless) < len(shots):
        raise UserError(
            f"{folder}: {len(timeless)} of {len(shots)} frames have no time ({timeless[0].image.name}): give all frames a time, or none"
        )
    if frame_interval is not None and not timeless:
        order = {time: k for k, time in enumerate(sorted({shot.time for shot in shots}))}
        return [shot._replace(time=order[shot.time] * frame_interval) for shot in shots]
    if not timeless:
        return shots
    groups: dict[str, list[Shot]] = {}
    for shot in shots:
        groups.setdefault(shot.view, []).append(shot)
    if all(len(group) == 1 for group in groups.values()):
        return [shot._replace(time=0.0) for shot in shots]
    if frame_interval is None:
        raise UserError(f"{folder}: a view has several frames without a time: add `time` (s) to each frame, or give frame_interval")
    return [
        shot._replace(time=k * frame_interval)
        for group in groups.values()
        for k, shot in enumerate(sorted(group, key=lambda shot: natural_key(shot.image.name)))
    ]
