"""Nerfstudio's `transforms.json` and Blender's `transforms_{train,val,test}.json` (NeRF, D-NeRF, GIC), read and written.

Two keys of a frame are ours: `time` [s] and `view` (which camera). Frames without `view` belong to one view if they have the same
pose. Without `time` and `view`, each pose is a view of one and the same moment.
"""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor

from neuido.data import cameras as convert
from neuido.data.files.parsing import image_size, read_json
from neuido.data.files.values import inside, listed, number, take
from neuido.data.formats.layout import MultiView, Shot, assemble, matrix, natural, opengl
from neuido.errors import UserError
from neuido.types import Cameras

SPLITS = ("transforms_train.json", "transforms_val.json", "transforms_test.json")
PINHOLES = ("PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV")
DISTORTION = ("k1", "k2", "p1", "p2", "k3")
UNKNOWN_TERMS = ("k4", "k5", "k6", "s1", "s2", "s3", "s4", "b1", "b2")
"""Terms of lens models that are not applied; they must be zero."""
FISHEYES = ("is_fisheye", "fisheye", "ftheta_p0", "equirectangular")
FOCAL = {"fl_x", "camera_angle_x", "camera_angle_y"}
ENDINGS = (".png", ".jpg", ".jpeg", ".PNG", ".JPG")


def read(path: Path, *, recording: str | None = None, frame_interval: float | None = None) -> MultiView:
    """Read a folder with `transforms.json`, or with Blender's three files, or one such JSON file.

    Views of `transforms_val.json`, `transforms_test.json`, or of `val_filenames` and `test_filenames`, count as held out, also
    where the training file has them too (GIC's).

    Raises:
        UserError: A missing key or file, a lens that is no pinhole, frames with a view and no time.
    """
    folder, files = (path.parent, [path]) if path.is_file() else (path, _files(path))
    shots: list[Shot] = []
    held_out: set[str] = set()
    poses: dict[tuple, str] = {}
    seen: set[Path] = set()
    for file in files:
        content = read_json(file)
        if not isinstance(content, dict):
            raise UserError(f"{file} must hold a mapping with a list `frames`")
        kept = {name for key in ("val_filenames", "test_filenames") for name in _names(content, key, file)}
        for i, entry in enumerate(listed(take(content, "frames", str(file)), f"{file}: frames")):
            where = f"{file.name}: frames[{i}]"
            shot = _shot(entry, content, folder, where, poses)
            if file.name in SPLITS[1:] or str(entry["file_path"]) in kept:
                held_out.add(shot.view)
            if shot.image not in seen:  # GIC writes the test views into all three files
                shots.append(shot)
            seen.add(shot.image)
    shots = sorted(_timed(shots, frame_interval, folder), key=lambda shot: natural(shot.view))
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
    """Write `transforms.json` and `images/<view>_<frame>.png`.

    Args:
        folder: Where to; made if it is missing.
        cameras: V cameras.
        times: (T,) [s].
        images: images[v][t] is (H, W, 3 or 4) uint8, RGB or RGBA; loaded one by one, so it may be lazy.
        views: Names of the views; whole numbers, as the format wants them. Default: 0, 1, ...
        held_out: Views that are named under `test_filenames`.
    """
    names = write_transforms(folder, cameras, times, views=views, held_out=held_out)
    for v, name in enumerate(names):
        for t in range(len(times)):
            write_image(folder / f"images/{name}_{t:03d}.png", images[v][t], size=(cameras.width, cameras.height))


def write_transforms(
    folder: Path, cameras: Cameras, times: Tensor, *, views: Sequence[str] | None = None, held_out: Sequence[int] = ()
) -> list[str]:
    """Write `transforms.json` alone, for images that are written otherwise; arguments as in `write`. Returns the names of the views."""
    names = list(views) if views is not None else [str(v) for v in range(len(cameras.viewmats))]
    if not all(name.isdigit() for name in names):
        raise UserError(f"views must be whole numbers, got {names}")
    (folder / "images").mkdir(parents=True, exist_ok=True)
    poses = convert.to_opengl(cameras.viewmats.double()).tolist()
    frames: list[dict[str, Any]] = []
    for v, name in enumerate(names):
        K = cameras.Ks[v].double()
        lens = {"fl_x": float(K[0, 0]), "fl_y": float(K[1, 1]), "cx": float(K[0, 2]), "cy": float(K[1, 2])}
        for t, time in enumerate(times.tolist()):
            relative = f"images/{name}_{t:03d}.png"
            frames.append({"file_path": relative, **lens, "transform_matrix": poses[v], "time": time, "view": int(name)})
    content: dict[str, Any] = {"camera_model": "OPENCV", "w": cameras.width, "h": cameras.height, "frames": frames}
    if held_out:
        kept = {int(names[v]) for v in held_out}
        content["train_filenames"] = [frame["file_path"] for frame in frames if frame["view"] not in kept]
        content["test_filenames"] = [frame["file_path"] for frame in frames if frame["view"] in kept]
    (folder / "transforms.json").write_text(json.dumps(content, indent=1))
    return names


def write_image(path: Path, image: np.ndarray, *, size: tuple[int, int] | None = None) -> None:
    """Write RGB or RGBA (H, W, 3 or 4) uint8 as PNG."""
    image = np.asarray(image)
    if image.ndim != 3 or image.shape[2] not in (3, 4) or image.dtype != np.uint8 or (size and image.shape[1::-1] != size):
        raise UserError(f"{path.name} must be (H, W, 3 or 4) uint8{f' of size {size}' if size else ''}, got {image.shape} {image.dtype}")
    order = cv2.COLOR_RGB2BGR if image.shape[2] == 3 else cv2.COLOR_RGBA2BGRA
    if not cv2.imwrite(str(path), cv2.cvtColor(image, order)):
        raise UserError(f"cannot write the image {path}")


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


def _shot(own: dict[str, Any], shared: dict[str, Any], folder: Path, where: str, poses: dict[tuple, str]) -> Shot:
    """Return a frame; what it does not say is taken from the keys of the file."""
    entry = shared | own
    image = _image(folder, take(entry, "file_path", where), where)
    viewmat = opengl(take(entry, "transform_matrix", where), f"{where}.transform_matrix")
    model = entry.get("camera_model", "OPENCV")
    if model not in PINHOLES:
        raise UserError(f"{where}.camera_model = {model!r} is no pinhole; undistort the images first (one of {', '.join(PINHOLES)})")
    for key in FISHEYES:
        if entry.get(key):
            raise UserError(f"{where}.{key} = {entry[key]!r}: a fisheye or panoramic lens is no pinhole; undistort the images first")
    size = _size(entry, where) if "w" in entry and "h" in entry else image_size(image)
    K = _lens(own, shared, size, where)
    lens = _distortion(own, shared, where)
    mask = inside(folder, entry["mask_path"], f"{where}.mask_path") if "mask_path" in entry else None
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
    """Return k1, k2, p1, p2, k3 of a frame, of single keys or of `distortion_params` (k1, k2, k3, k4, p1, p2, as Nerfstudio has them)."""
    entry = shared | own
    terms = {key: number(entry.get(key, 0.0), f"{where}.{key}") for key in (*DISTORTION, *UNKNOWN_TERMS)}
    if (given := entry.get("distortion_params")) is not None:
        values = matrix(given, f"{where}.distortion_params", (6,)).tolist()
        for key, value in zip(("k1", "k2", "k3", "k4", "p1", "p2"), values):
            if key in entry and terms[key] != value:
                raise UserError(f"{where}: {key} = {terms[key]:g} and distortion_params say different things; leave one out")
            terms[key] = value
    for key in UNKNOWN_TERMS:
        if terms[key] != 0:
            raise UserError(f"{where}.{key} = {terms[key]:g}: this term of a lens is not applied; undistort the images first")
    return tuple(terms[key] for key in DISTORTION)


def _size(entry: dict[str, Any], where: str) -> tuple[int, int]:
    width, height = (number(entry[key], f"{where}.{key}", least=1) for key in ("w", "h"))
    return int(width), int(height)


def _lens(own: dict[str, Any], shared: dict[str, Any], size: tuple[int, int], where: str) -> Tensor:
    """Return K of a frame; a focal length of the frame, in pixels or as an angle, comes before that of the file."""
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
        raise UserError(f"{where} has neither fl_x nor camera_angle_x: the focal length is not known")
    cx, cy = (number(entry.get(key, half / 2), f"{where}.{key}") for key, half in (("cx", width), ("cy", height)))
    return torch.tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], dtype=torch.float64)


def _image(folder: Path, given: Any, where: str) -> Path:
    """Return the path of an image; Blender leaves its ending away."""
    path = inside(folder, given, f"{where}.file_path")
    if path.suffix.lower() in (".png", ".jpg", ".jpeg"):
        return path
    return next((path.with_name(path.name + end) for end in ENDINGS if path.with_name(path.name + end).is_file()), path)


def _timed(shots: list[Shot], frame_interval: float | None, folder: Path) -> list[Shot]:
    """Return the shots with times: those of the file, else one moment, else the order in each view."""
    timeless = [shot for shot in shots if np.isnan(shot.time)]
    if timeless and len(timeless) < len(shots):
        raise UserError(f"{folder}: {len(timeless)} of {len(shots)} frames have no time ({timeless[0].image.name}): give all or none one")
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
        raise UserError(f"{folder}: the frames of a view have no time: add `time` (s) to each, or give the option frame_interval")
    return [
        shot._replace(time=k * frame_interval)
        for group in groups.values()
        for k, shot in enumerate(sorted(group, key=lambda shot: natural(shot.image.name)))
    ]
