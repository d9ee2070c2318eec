"""Reader of NeuMA's data: synthetic scenes (`data_dynamic.json`, `eval_dynamic.json`), real scenes (`dynamics/`) and assets.

The rotations of synthetic scenes may contain a scale, 0.41 in BouncyBall. It does not change the images and is removed.
"""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from neuido.data import cameras as convert
from neuido.data.files.parsing import image_size, read_arrays, read_json
from neuido.data.files.values import list_of_mappings, path_inside, require_key
from neuido.data.formats import colmap
from neuido.data.formats.layout import MultiView, Shot, assemble, natural_key, read_intrinsics, read_matrix, viewmat_from_opengl
from neuido.errors import UserError

INTERVALS = {"bouncyball": 1e-3, "jellyduck": 1e-3, "claycat": 5e-4, "honeybottle": 5e-4, "rubberpawn": 5e-4, "sandfish": 5e-4}
"""Time between frames [s] of the six synthetic scenes: one substep of NeuMA's experiments/configs/synthetic."""
REAL_INTERVAL = 1 / 120
"""Time between frames [s] of the real scenes, which Spring-Gaus filmed at 120 Hz. NeuMA itself integrates 0.01 s per frame."""
NAME = re.compile(r"^(.+)_(-?[0-9]+)$")


class Assets(NamedTuple):
    """Assets of a NeuMA scene beside its images; a field is None if its file does not exist."""

    x: Tensor | None = None
    """Positions of the particles at t = 0 in the simulation domain [m], (P, 3) float32."""
    v: Tensor | None = None
    """Velocities of the particles [m/s], (P, 3) float32."""
    volume: Tensor | None = None
    """Volumes of the particles [m^3], (P,) float32."""
    bindings: Tensor | None = None
    """Weight of each particle for each of K Gaussians, sparse (K, P) float32."""
    gaussians: Path | None = None
    """Path of `kernels.ply`, a 3DGS PLY file."""
    particles: Path | None = None
    """Path of `particles.ply`, in the world coordinates of the cameras."""


def read(path: Path, *, recording: str | None = None, frame_interval: float | None = None) -> MultiView:
    """Read a synthetic or real scene of NeuMA; the views of `eval_dynamic.json` are held out.

    Args:
        path: The folder of the scene.
        recording: Not used.
        frame_interval: Time between frames [s]. Default: `INTERVALS` for NeuMA's synthetic scenes, 1/120 s for real ones.

    Raises:
        UserError: A key or a file is missing, a file name is not `<view>_<step>`, or the frame interval is unknown.
    """
    if (path / "data_dynamic.json").is_file():
        return _synthetic(path, frame_interval)
    return _real(path, frame_interval or REAL_INTERVAL)


def read_assets(path: Path) -> Assets:
    """Read the files that exist of a folder `assets/<name>`: `init.pt`, `bindings.pt`, `particles.npz` and the PLY files.

    Raises:
        UserError: The folder does not exist, a file is malformed, or the shapes of its arrays do not match.
    """
    if not path.is_dir():
        raise UserError(f"the folder {path} is missing")
    x = v = volume = bindings = None
    if (path / "init.pt").is_file():
        file = path / "init.pt"
        content = _load(file, ("init_x", "init_v"))
        x, v = content["init_x"].float(), content["init_v"].float()
        v = v.expand(len(x), 3).contiguous() if v.ndim == 1 and v.shape == (3,) and x.ndim == 2 else v
        if x.ndim != 2 or x.shape[1] != 3 or v.shape != x.shape or not bool(torch.isfinite(x).all() & torch.isfinite(v).all()):
            raise UserError(f"{file}: init_x and init_v must be finite (P, 3), got {tuple(x.shape)} and {tuple(v.shape)}")
    if (path / "bindings.pt").is_file():
        bindings = _bindings(path / "bindings.pt", None if x is None else len(x))
    if (path / "particles.npz").is_file():
        volume = _volume(path / "particles.npz", None if x is None else len(x))
    gaussians, particles = ((path / name) if (path / name).is_file() else None for name in ("kernels.ply", "particles.ply"))
    return Assets(x, v, volume, bindings, gaussians, particles)


def _synthetic(path: Path, frame_interval: float | None) -> MultiView:
    interval = frame_interval or INTERVALS.get(path.resolve().name.lower())
    if interval is None:
        raise UserError(f"the frames of {path.resolve().name} have no times: give frame_interval (s). Scenes with a default: "
                        f"{', '.join(INTERVALS)}")  # fmt: skip
    shots, held_out = [], set()
    for set_name in ("data_dynamic", "eval_dynamic"):
        file = path / f"{set_name}.json"
        if not file.is_file():
            continue
        part = []
        for i, entry in enumerate(list_of_mappings(read_json(file), str(file))):
            where = f"{file.name}[{i}]"
            image = path_inside(path, require_key(entry, "file_path", where), f"{where}.file_path")
            view, step = _view_and_step(image, where)
            if step < 0:
                continue
            viewmat = viewmat_from_opengl(require_key(entry, "c2w", where), f"{where}.c2w")
            K = read_intrinsics(require_key(entry, "intrinsic", where), f"{where}.intrinsic")
            part.append(Shot(view, step * interval, image, viewmat, K))
        part.sort(key=lambda shot: natural_key(shot.view))
        shots += part
        held_out |= {shot.view for shot in part} if set_name == "eval_dynamic" else set()
    return assemble(shots, folder=path, name=path.resolve().name, format="neuma", held_out=held_out)


def _real(path: Path, interval: float) -> MultiView:
    lens = colmap.read_cameras(path / "sparse" / "0" / "cameras.bin")
    calibrated = read_json(path / "cameras_calib.json")
    if not isinstance(calibrated, dict):
        raise UserError(f"{path / 'cameras_calib.json'} must be a mapping of views to rvecs and tvecs")
    if not (path / "dynamics").is_dir():
        raise UserError(f"{path} is not a NeuMA scene: it has neither data_dynamic.json nor the folder dynamics")
    shots = []
    images = sorted((file for file in (path / "dynamics").iterdir() if file.suffix == ".jpg"), key=lambda file: natural_key(file.name))
    size = image_size(images[0]) if images else (1, 1)
    K = dynamic_lens(next(iter(lens.values())), size)
    for image in images:
        view, step = _view_and_step(image, f"{path / 'dynamics'}")
        if step < 0:
            continue
        viewmat = extrinsics(calibrated, view, path / "cameras_calib.json")
        shots.append(Shot(view, step * interval, image, viewmat, K, path / "dynamic_masks" / f"{image.stem}.png"))
    return assemble(shots, size=size, folder=path, name=path.resolve().name, format="neuma")


def dynamic_lens(static: colmap.Camera, size: tuple[int, int]) -> Tensor:
    """Return the intrinsic matrix of a video whose images have the `size` (width, height) [px].

    The focal lengths are those of the still camera, scaled to the video; the principal point is the image centre. NeuMA and Spring-Gaus
    swap the two focal lengths, which differ by 0.04 %; here they are not swapped.
    """
    width, height = size
    fx, fy = float(static.K[0, 0]) * width / static.width, float(static.K[1, 1]) * height / static.height
    return torch.tensor([[fx, 0, width / 2], [0, fy, height / 2], [0, 0, 1]], dtype=torch.float64)


def extrinsics(calibrated: dict[str, Any], view: str, file: Path) -> Tensor:
    """Return the world-to-camera matrix (4, 4) of a view from its OpenCV `rvecs` and `tvecs`.

    Args:
        calibrated: Content of `cameras_calib.json`: a mapping of views to `rvecs` and `tvecs` of shape (3,), (3, 1), (1, 3) or (1, 3, 1).
        view: Name of the view.
        file: Path of the file, for error messages.

    Raises:
        UserError: The view or one of its vectors is missing or malformed.
    """
    entry = calibrated.get(view)
    if not isinstance(entry, dict):
        raise UserError(f"{file} lacks the view {view!r}")
    vectors = [
        read_matrix(
            require_key(entry, key, f"{file.name}: {view}"), f"{file.name}: {view}.{key}", (3,), (3, 1), (1, 3), (1, 3, 1)
        ).flatten()
        for key in ("rvecs", "tvecs")
    ]
    return convert.from_rodrigues(*vectors)


def _view_and_step(image: Path, where: str) -> tuple[str, int]:
    match = NAME.match(image.stem)
    if match is None:
        raise UserError(f"{where}: the file name {image.name!r} must have the form <view>_<step>{image.suffix}")
    return match[1], int(match[2])


def _load(path: Path, keys: tuple[str, ...]) -> dict[str, Any]:
    """Load a dictionary with these keys from a torch.save file, weights only."""
    try:
        with torch.serialization.safe_globals([torch.Size]):
            content = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch raises exceptions of many types for malformed or unsafe files
        raise UserError(
            f"{path} is not a torch.save file of tensors: {str(error).splitlines()[0] if str(error) else type(error).__name__}"
        ) from error
    for key in keys:
        if not isinstance(content, dict) or key not in content:
            raise UserError(f"{path} lacks the entry {key!r}")
        if key != "bindings_size" and not isinstance(content[key], Tensor):
            raise UserError(f"{path}: {key} must be a tensor")
    return content


def _bindings(path: Path, particle_count: int | None) -> Tensor:
    content = _load(path, ("bindings_ind", "bindings_val", "bindings_size"))
    index, value, size = content["bindings_ind"], content["bindings_val"], tuple(int(n) for n in _flat(content["bindings_size"]))
    if index.ndim != 2 or len(index) != 2 or value.shape != index.shape[1:] or len(size) != 2 or index.dtype != torch.int64:
        raise UserError(f"{path}: bindings_ind {tuple(index.shape)}, bindings_val {tuple(value.shape)}, bindings_size {size} do not match")
    if bool((index < 0).any() | (index >= torch.tensor(size)[:, None]).any()) or particle_count not in (None, size[1]):
        raise UserError(f"{path}: an index is outside bindings_size = {size}, or init.pt has {particle_count} particles")
    return torch.sparse_coo_tensor(index, value.float(), size, check_invariants=True).coalesce()


def _flat(size: Any) -> Iterator[Any]:
    if isinstance(size, Tensor | tuple | list):
        yield from size


def _volume(path: Path, particle_count: int | None) -> Tensor:
    arrays = read_arrays(path, ("p_x", "vol"), what="archive with p_x and vol")
    points, volume = arrays["p_x"], np.asarray(arrays["vol"], dtype=np.float32)
    if points.ndim != 2 or points.shape[1] != 3 or particle_count not in (None, len(points)):
        raise UserError(f"{path}: p_x has the shape {points.shape}; it must be ({particle_count or 'P'}, 3)")
    if volume.size not in (1, len(points)) or not (np.isfinite(volume).all() and (volume > 0).all()):
        raise UserError(f"{path}: vol must hold one positive volume, or one for each of {len(points)} particles")
    return torch.from_numpy(np.broadcast_to(volume.reshape(-1), (len(points),)).copy())
