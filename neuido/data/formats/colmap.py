"""Reader of COLMAP models, binary (`cameras.bin`, `images.bin`) or text (`cameras.txt`, `images.txt`).

A model holds views of one moment or, if the time between frames is given, the frames of cameras that move. `colmap image_undistorter`
writes it to `sparse/`, `colmap mapper` to `sparse/0/`. Spring-Gaus and NeuMA have binary models. Masks lie in `masks/`. A mask is named
`<image name>.png`, as COLMAP does, or as its image with the suffix `.png`.
"""

import contextlib
import math
import re
import struct
from collections.abc import Iterator, Sequence
from pathlib import Path, PurePosixPath
from typing import NamedTuple

import torch
from torch import Tensor

from neuido.data import cameras as convert
from neuido.data.files.parsing import one_line, read_text
from neuido.data.files.values import path_inside
from neuido.data.formats.layout import MultiView, Shot, assemble, natural_key
from neuido.errors import UserError
from neuido.physics.runtime.limits import check_limit

NAMES = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE", "FULL_OPENCV", "FOV",
         "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "THIN_PRISM_FISHEYE")  # fmt: skip
"""Names of COLMAP's camera models, by model number."""
MODELS = {0: ("f", "cx", "cy"), 1: ("fx", "fy", "cx", "cy"), 2: ("f", "cx", "cy", "k1"), 3: ("f", "cx", "cy", "k1", "k2"),
          4: ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")}  # fmt: skip
"""Parameters of the supported camera models, by model number: SIMPLE_PINHOLE, PINHOLE, SIMPLE_RADIAL, RADIAL and OPENCV."""


class Camera(NamedTuple):
    """A COLMAP camera: image size [px], intrinsic matrix and lens distortion."""

    width: int
    height: int
    K: Tensor
    """(3, 3) float64."""
    distortion: tuple[float, ...]
    """k1, k2, p1, p2."""


class Image(NamedTuple):
    """A registered COLMAP image: file name, camera id and pose."""

    name: str
    camera: int
    viewmat: Tensor
    """World to camera, (4, 4) float64."""


def read_cameras(path: Path) -> dict[int, Camera]:
    """Read the cameras of `cameras.bin` or `cameras.txt`; return them by id.

    Raises:
        UserError: The file is missing or truncated, or a camera model is not a pinhole.
    """
    out = {}
    for number, model, width, height, values in _camera_lines(path) if path.suffix == ".txt" else _camera_records(path):
        given = dict(zip(MODELS[model], values))
        fx, fy = given.get("fx", given.get("f", 0.0)), given.get("fy", given.get("f", 0.0))
        K = torch.tensor([[fx, 0, given["cx"]], [0, fy, given["cy"]], [0, 0, 1]], dtype=torch.float64)
        if not (fx > 0 and fy > 0 and width > 0 and height > 0 and bool(torch.isfinite(K).all())):
            raise UserError(
                f"{path}: camera {number} has the focal lengths {fx:g}, {fy:g} and the size {width} x {height}; all must be positive"
            )
        lens = tuple(given.get(key, 0.0) for key in ("k1", "k2", "p1", "p2"))
        if not all(math.isfinite(term) for term in lens):
            raise UserError(f"{path}: camera {number} has a distortion coefficient that is not finite: {list(lens)}")
        check_limit(width * height, "NEUIDO_MAX_IMAGE_PIXELS", f"{path}: camera {number} has {width} x {height} pixels")
        out[number] = Camera(width, height, K, lens)
    if not out:
        raise UserError(f"{path} contains no camera")
    return out


def _camera_records(path: Path) -> Iterator[tuple[int, int, int, int, tuple[float, ...]]]:
    data = _ByteReader(path)
    for _ in range(data.take("<Q")[0]):
        number, model, width, height = data.take("<iiQQ")
        if model not in MODELS:
            raise _no_pinhole(path, number, NAMES[model] if 0 <= model < len(NAMES) else str(model))
        yield number, model, width, height, data.take(f"<{len(MODELS[model])}d")


def _camera_lines(path: Path) -> Iterator[tuple[int, int, int, int, tuple[float, ...]]]:
    for i, line in enumerate(read_text(path).splitlines(), 1):
        if not line.strip() or line.startswith("#"):
            continue
        with _line_errors(path, i, "CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]"):
            number, name, width, height, *values = line.split()
            if name not in NAMES or NAMES.index(name) not in MODELS:
                raise _no_pinhole(path, number, name)
            model = NAMES.index(name)
            if len(values) != len(MODELS[model]):
                raise UserError(f"{path}, line {i}: {name} has {len(MODELS[model])} parameters, got {len(values)}")
            yield int(number), model, int(width), int(height), tuple(float(value) for value in values)


def _no_pinhole(path: Path, number: int | str, name: str) -> UserError:
    return UserError(f"{path}: camera {number} has the camera model {name}, not a pinhole: run `colmap image_undistorter` first")


@contextlib.contextmanager
def _line_errors(path: Path, line: int, form: str) -> Iterator[None]:
    try:
        yield
    except (ValueError, OverflowError) as error:
        raise UserError(f"{path}, line {line} must have the form {form}: {one_line(error)}") from error


def read_images(path: Path) -> list[Image]:
    """Read the registered images of `images.bin` or `images.txt`, sorted by name.

    Raises:
        UserError: The file is missing or truncated, or a pose is invalid.
    """
    out = []
    for name, camera, pose in _image_lines(path) if path.suffix == ".txt" else _image_records(path):
        try:
            viewmat = convert.from_quaternion(torch.tensor(pose[:4], dtype=torch.float64), torch.tensor(pose[4:], dtype=torch.float64))
        except UserError as error:
            raise UserError(f"{path}: {name}: {error}") from error
        if not bool(torch.isfinite(viewmat).all()):
            raise UserError(f"{path}: the pose of {name} contains a NaN")
        out.append(Image(name, camera, viewmat))
    return sorted(out, key=lambda image: natural_key(image.name))


def _image_records(path: Path) -> Iterator[tuple[str, int, tuple[float, ...]]]:
    data = _ByteReader(path)
    for _ in range(data.take("<Q")[0]):
        _, *pose, camera = data.take("<i7di")
        name = data.text()
        data.skip(24 * data.take("<Q")[0])  # the 2D points of the image
        yield name, camera, tuple(pose)


def _image_lines(path: Path) -> Iterator[tuple[str, int, tuple[float, ...]]]:
    lines = [(i, line) for i, line in enumerate(read_text(path).splitlines(), 1) if not line.startswith("#")]
    while lines and not lines[0][1].strip():  # blank lines between the comments and the first image
        lines.pop(0)
    for i, line in lines[::2]:  # every second line has the 2D points and may be empty
        if not line.strip():
            continue
        with _line_errors(path, i, "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"):
            words = line.split(maxsplit=9)
            yield words[9].strip() if len(words) > 9 else "", int(words[8]), tuple(float(word) for word in words[1:8])


def find_model(path: Path) -> Path | None:
    """Find the model folder of a COLMAP project: `sparse/0`, `sparse` or the project folder; None if there is no model."""
    for folder in (path / "sparse" / "0", path / "sparse", path):
        if any((folder / f"images.{kind}").is_file() for kind in ("bin", "txt")):
            return folder
    return None


def read(path: Path, *, recording: str | None = None, frame_interval: float | None = None) -> MultiView:
    """Read a COLMAP project as views of one moment or, with `frame_interval`, as frames of cameras that move.

    Args:
        path: The project folder. The model lies in `sparse/0`, `sparse` or the folder itself, images lie in `images`, and masks, if there
            are any, in `masks`.
        recording: Not used.
        frame_interval: Time between frames [s]. The images of one folder, or of one of COLMAP's cameras if all lie in one folder, are then
            the frames of a view. The last number in the name of an image is that of its frame.

    Raises:
        UserError: There is no model, a camera model is not a pinhole, an image is missing, or some images have a mask and others none. With
            `frame_interval`, an image has no number, or two images of a view have the same.
    """
    model = find_model(path)
    if model is None:
        raise UserError(f"{path} has no COLMAP model: neither it nor sparse nor sparse/0 has images.bin or images.txt")
    masks = path / "masks" if (path / "masks").is_dir() else None
    return views(model, path / "images", folder=path, name=path.resolve().name, masks=masks, frame_interval=frame_interval)


def views(
    model: Path, pictures: Path, *, folder: Path, name: str, masks: Path | None = None, frame_interval: float | None = None
) -> MultiView:
    """Read the registered images of a model folder; each image is one view, or a frame of one.

    Args:
        model: Folder with `cameras` and `images`, .bin or .txt.
        pictures: Folder of the image files.
        folder: Folder of the recording, for `MultiView.folder`.
        name: Name of the recording.
        masks: Folder of the mask files, if there are any.
        frame_interval: As for `read`.

    Raises:
        UserError: As `read`.
    """
    kind = "bin" if (model / "images.bin").is_file() or not (model / "images.txt").is_file() else "txt"
    cameras, images = model / f"cameras.{kind}", model / f"images.{kind}"
    lenses = read_cameras(cameras)
    shots = []
    found = read_images(images)
    places = _frames_of_videos(found, images, frame_interval) if frame_interval else {image.name: (image.name, 0.0) for image in found}
    for image in found:
        if image.camera not in lenses:
            raise UserError(f"{images}: {image.name} refers to camera {image.camera}, which is not in {cameras.name}")
        lens = lenses[image.camera]
        file = path_inside(pictures, image.name, f"{images}: name")
        mask = None if masks is None else _mask(masks, image.name)
        shots.append(Shot(*places[image.name], file, image.viewmat, lens.K, mask, lens.distortion, (lens.width, lens.height)))
    return assemble(shots, folder=folder, name=name, format="colmap")


def _frames_of_videos(images: Sequence[Image], path: Path, frame_interval: float) -> dict[str, tuple[str, float]]:
    """Return the view and the time [s] of each image by its name: its folder or camera, and its number from the first times the interval.

    COLMAP leaves out images that it cannot place; the numbers keep the times of the others right.
    """
    folders = {str(PurePosixPath(image.name).parent) for image in images}
    numbers: dict[str, tuple[str, int]] = {}
    for image in images:
        digits = re.findall(r"[0-9]+", PurePosixPath(image.name).stem)
        if not digits:
            raise UserError(f"{path}: {image.name} has no number in its name; with frame_interval, the last number is that of its frame")
        view = str(PurePosixPath(image.name).parent) if len(folders) > 1 else str(image.camera)
        numbers[image.name] = view, int(digits[-1])
    first = min((number for _, number in numbers.values()), default=0)
    return {name: (view, (number - first) * frame_interval) for name, (view, number) in numbers.items()}


def _mask(masks: Path, name: str) -> Path:
    """Return the path of an image's mask: `<name>.png`, or the name with its suffix replaced by `.png`."""
    own = path_inside(masks, f"{name}.png", "name")
    return own if own.is_file() else path_inside(masks, name, "name").with_suffix(".png")


class _ByteReader:
    """Sequential reader of a binary file."""

    def __init__(self, path: Path) -> None:
        if not path.is_file():
            raise UserError(f"{path} is missing")
        self.path, self.data, self.at = path, path.read_bytes(), 0

    def take(self, layout: str) -> tuple:
        self.skip(struct.calcsize(layout))
        return struct.unpack_from(layout, self.data, self.at - struct.calcsize(layout))

    def skip(self, count: int) -> None:
        self.at += count
        if self.at > len(self.data):
            raise UserError(
                f"{self.path} is truncated or not a binary COLMAP file: it ends at byte {len(self.data)}, before byte {self.at}"
            )

    def text(self) -> str:
        end = self.data.find(b"\0", self.at)
        if end < 0:
            raise UserError(f"{self.path} is truncated or not a binary COLMAP file: an image name is not terminated")
        raw, self.at = self.data[self.at : end], end + 1
        try:
            return raw.decode("utf-8")
        except UnicodeDecodeError as error:
            raise UserError(f"{self.path} is not a binary COLMAP file: an image name is not UTF-8") from error
