"""COLMAP's binary `cameras.bin` and `images.bin`, as Spring-Gaus and NeuMA carry them: a set of views of one moment."""

import struct
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from neuido.data import cameras as convert
from neuido.data.files.values import inside
from neuido.data.formats.layout import MultiView, Shot, assemble, natural
from neuido.errors import UserError

MODELS = {0: ("f", "cx", "cy"), 1: ("fx", "fy", "cx", "cy"), 2: ("f", "cx", "cy", "k1"), 3: ("f", "cx", "cy", "k1", "k2"),
          4: ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")}  # fmt: skip
"""Parameters of SIMPLE_PINHOLE, PINHOLE, SIMPLE_RADIAL, RADIAL and OPENCV; the other models are no pinholes."""


class Camera(NamedTuple):
    width: int
    height: int
    K: Tensor
    """(3, 3) float64."""
    distortion: tuple[float, ...]
    """k1, k2, p1, p2."""


class Image(NamedTuple):
    name: str
    camera: int
    viewmat: Tensor
    """World to camera, (4, 4) float64."""


def read_cameras(path: Path) -> dict[int, Camera]:
    """Return the cameras of `cameras.bin` by their id.

    Raises:
        UserError: The file is missing, cut short, or has a lens that is no pinhole.
    """
    data = _Bytes(path)
    out = {}
    for _ in range(data.take("<Q")[0]):
        number, model, width, height = data.take("<iiQQ")
        if model not in MODELS:
            raise UserError(f"{path}: camera {number} has the lens model {model}, no pinhole: undistort the images with COLMAP first")
        given = dict(zip(MODELS[model], data.take(f"<{len(MODELS[model])}d")))
        fx, fy = given.get("fx", given.get("f", 0.0)), given.get("fy", given.get("f", 0.0))
        K = torch.tensor([[fx, 0, given["cx"]], [0, fy, given["cy"]], [0, 0, 1]], dtype=torch.float64)
        if not (fx > 0 and fy > 0 and width > 0 and height > 0 and bool(torch.isfinite(K).all())):
            raise UserError(f"{path}: camera {number} has focal lengths {fx:g}, {fy:g} and the size {width} x {height}")
        out[number] = Camera(width, height, K, tuple(given.get(key, 0.0) for key in ("k1", "k2", "p1", "p2")))
    if not out:
        raise UserError(f"{path} holds no camera")
    return out


def read_images(path: Path) -> list[Image]:
    """Return the registered images of `images.bin`, by name.

    Raises:
        UserError: The file is missing or cut short.
    """
    data = _Bytes(path)
    out = []
    for _ in range(data.take("<Q")[0]):
        _, *pose, camera = data.take("<i7di")
        name = data.text()
        data.skip(24 * data.take("<Q")[0])  # its 2D points
        viewmat = convert.from_quaternion(torch.tensor(pose[:4], dtype=torch.float64), torch.tensor(pose[4:], dtype=torch.float64))
        if not bool(torch.isfinite(viewmat).all()):
            raise UserError(f"{path}: the pose of {name} holds a NaN")
        out.append(Image(name, camera, viewmat))
    return sorted(out, key=lambda image: natural(image.name))


def read(path: Path, *, recording: str | None = None, frame_interval: float | None = None) -> MultiView:
    """Read a COLMAP project: `sparse/0/*.bin` (or the two files in the folder itself) and the pictures in `images`."""
    model = path / "sparse" / "0" if (path / "sparse" / "0").is_dir() else path
    return views(model, path / "images", folder=path, name=path.resolve().name)


def views(model: Path, pictures: Path, *, folder: Path, name: str, masks: Path | None = None) -> MultiView:
    """Return the registered images of a model folder, each one a view; masks, where there are any, are PNG files of the same names."""
    lenses = read_cameras(model / "cameras.bin")
    shots = []
    sizes = set()
    for image in read_images(model / "images.bin"):
        if image.camera not in lenses:
            raise UserError(f"{model / 'images.bin'}: {image.name} names camera {image.camera}, which cameras.bin lacks")
        lens = lenses[image.camera]
        sizes.add((lens.width, lens.height))
        file = inside(pictures, image.name, f"{model / 'images.bin'}: name")
        mask = None if masks is None else inside(masks, image.name, "name").with_suffix(".png")
        shots.append(Shot(image.name, 0.0, file, image.viewmat, lens.K, mask, lens.distortion))
    if len(sizes) > 1:
        raise UserError(f"{model} has images of {len(sizes)} sizes ({sorted(sizes)[:2]} ...); all views must have one")
    return assemble(shots, size=next(iter(sizes), None), folder=folder, name=name, format="colmap")


class _Bytes:
    """A binary file, read from its beginning."""

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
            raise UserError(f"{self.path} is cut short or no binary COLMAP file: it ends at byte {len(self.data)}, not {self.at}")

    def text(self) -> str:
        end = self.data.find(b"\0", self.at)
        if end < 0:
            raise UserError(f"{self.path} is cut short or no binary COLMAP file: a name has no end")
        raw, self.at = self.data[self.at : end], end + 1
        try:
            return raw.decode("utf-8")
        except UnicodeDecodeError as error:
            raise UserError(f"{self.path} is no binary COLMAP file: a name is not text") from error
