"""Optical flow, and its encoding as three-channel images for the video encoder (paper, "Branch Network").

The flow is computed by dense inverse search (DIS): by OpenCV, or of all frames of all videos at once by `parallel_flow`, on a GPU too.
The default encoding preserves the magnitude, because speed is the cue for stiffness. The colour wheel of Tora, which is normalised frame by
frame and loses the magnitude, is an option.
"""

import hashlib
import math
import os
import warnings
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor

from neuido.data.cameras import refuse_moving
from neuido.data.files.parsing import read_arrays
from neuido.data.files.writing import write_arrays
from neuido.errors import UserError
from neuido.models.video.parallel_flow import parallel_flow
from neuido.types import Cameras

PRESETS = {
    "ultrafast": cv2.DISOPTICAL_FLOW_PRESET_ULTRAFAST,
    "fast": cv2.DISOPTICAL_FLOW_PRESET_FAST,
    "medium": cv2.DISOPTICAL_FLOW_PRESET_MEDIUM,
}
ENCODINGS = ("velocity", "wheel")
METHODS = ("opencv", "parallel")
GREY = (0.299, 0.587, 0.114)
"""Weights of red, green and blue in the brightness, as OpenCV has them."""
cv2.setNumThreads(1)  # videos are processed in parallel; threads within an image would compete

SECTORS = (15, 6, 4, 11, 13, 6)
"""Number of hues of the Middlebury colour wheel from red to yellow, green, cyan, blue, magenta and back (Baker et al. 2011)."""


def optical_flow(
    images: Tensor | Sequence[Tensor],
    *,
    preset: str = "medium",
    threads: int | None = None,
    method: str = "opencv",
    device: str | torch.device | None = None,
) -> Tensor:
    """Compute the dense flow from each frame to the next [px per frame] by DIS.

    Args:
        images: RGB in [0, 1], (..., T, H, W, 3), T >= 2; or videos (T, H, W, 3) of one shape, which need no copy in one place.
        preset: `ultrafast`, `fast` or `medium`.
        threads: Number of threads; the number of cores where absent.
        method: `opencv` (on the CPU), or `parallel` (`parallel_flow`, which agrees with it to a hundredth of the motion).
        device: Device for `parallel`; that of the images where absent.

    Returns:
        Flow (..., T - 1, H, W, 2), float32; x points right, y down. On the CPU, or on the device of `parallel`.

    Raises:
        UserError: There are fewer than two frames, images are smaller than 16 pixels, or the preset or the method is unknown.
    """
    for name, value, known in (("preset", preset, PRESETS), ("method", method, METHODS)):
        if value not in known:
            raise UserError(f"flow {name} = {value!r}; one of {', '.join(known)}")
    leading = images.shape[:-4] if isinstance(images, Tensor) else (len(images),)
    if isinstance(images, Tensor):
        videos = list(images.detach().reshape(-1, *images.shape[-4:])) if images.ndim > 3 else [images]
    else:
        videos = [video.detach() for video in images]
    first = videos[0]
    if first.ndim != 4 or first.shape[-1] != 3 or len(first) < 2:
        raise UserError(f"flow needs videos (..., T, H, W, 3) of at least 2 frames, got {(*leading, *first.shape)}")
    if min(first.shape[1:3]) < 16:
        raise UserError(f"flow needs images of at least 16 pixels a side, got {first.shape[2]} x {first.shape[1]}")
    workers = threads or os.cpu_count() or 1
    with ThreadPoolExecutor(workers) as pool:
        grey = _brightness(videos, pool)
        if method == "parallel":
            flow = parallel_flow(grey.to(first.device if device is None else device), preset)
        else:
            flow = _pairwise(grey.cpu().numpy(), preset, pool, workers)
    return flow.view(*leading, len(first) - 1, *first.shape[1:3], 2)


def _brightness(videos: list[Tensor], pool: ThreadPoolExecutor) -> Tensor:
    """Return the brightness of V videos in bytes, (V, T, H, W) uint8, on their device; on the CPU frame by frame in several threads."""
    first = videos[0]
    out = torch.empty((len(videos), *first.shape[:-1]), dtype=torch.uint8, device=first.device)
    if first.is_cuda:
        weights = first.new_tensor(GREY)
        for video, part in zip(videos, out):
            part.copy_((255 * (video @ weights)).round().clamp(0, 255))
        return out

    def convert(pair: tuple[Tensor, Tensor]) -> None:  # a tenth of the time of torch's products
        grey = cv2.cvtColor(pair[0].float().contiguous().numpy(), cv2.COLOR_RGB2GRAY)
        cv2.convertScaleAbs(np.maximum(grey, 0, out=grey), dst=pair[1].numpy(), alpha=255)

    list(pool.map(convert, [(frame, own) for video, part in zip(videos, out) for frame, own in zip(video, part)]))
    return out


def _pairwise(grey: np.ndarray, preset: str, pool: ThreadPoolExecutor, workers: int) -> Tensor:
    """Return the flow of OpenCV's DIS, (V (T - 1), H, W, 2), of bytes (V, T, H, W), with some pairs of frames in each task."""
    count = grey.shape[1] - 1
    share = max(1, count * len(grey) // (2 * workers))  # about two tasks a thread

    def pairs(part: tuple[np.ndarray, int]) -> list[np.ndarray]:
        video, first = part
        search = cv2.DISOpticalFlow_create(PRESETS[preset])
        return [search.calc(a, b, None) for a, b in zip(video[first : first + share], video[first + 1 : min(first + share, count) + 1])]

    parts = [(video, k) for video in grey for k in range(0, count, share)]
    return torch.from_numpy(np.stack([flow for found in pool.map(pairs, parts) for flow in found]))  # OpenCV releases the GIL


class Velocities(NamedTuple):
    """Velocities of a body measured in V videos."""

    flow: Tensor
    """Velocity in the image plane (x right, y down) at the depth of the body [m/s], (V, T - 1, S, S, 2); zero outside the body."""
    cell: Tensor
    """Side of each of the S x S cells at the depth of the body [m], (V,)."""
    frame_interval: float
    """Time between two frames [s]."""

    def __repr__(self) -> str:
        views, steps, side = self.flow.shape[:3]
        return f"Velocities({views} views, {steps} steps of {self.frame_interval:.3g} s, {side} x {side} cells)"


def body_window(masks: Tensor, margin: float = 0.1) -> tuple[int, int, int]:
    """Return top, left and side [px] of a square in the image that contains the body in all frames of a video.

    Args:
        masks: Masks (T, H, W); the body is where they exceed one half.
        margin: Margin on each side, as a fraction of the side of the body.
    """
    height, width = masks.shape[-2:]
    seen = (masks > 0.5).any(0)
    rows, columns = seen.any(1).nonzero()[:, 0], seen.any(0).nonzero()[:, 0]
    if not len(rows):
        return 0, 0, min(height, width)
    ends = [(int(axis[0]), int(axis[-1]) + 1) for axis in (rows, columns)]
    side = min(math.ceil(max(high - low for low, high in ends) * (1 + 2 * margin)), height, width)
    top, left = (min(max((low + high - side) // 2, 0), full - side) for (low, high), full in zip(ends, (height, width)))
    return top, left, side


def measure_velocities(
    images: Tensor | Sequence[Tensor],
    masks: Tensor | Sequence[Tensor],
    times: Tensor | Sequence[float],
    cameras: Cameras,
    centre: Tensor,
    *,
    size: int = 64,
    preset: str = "medium",
    cache: str | os.PathLike | None = None,
    threads: int | None = None,
    method: str = "opencv",
    device: str | torch.device | None = None,
) -> Velocities:
    """Measure the velocities in videos within a square around the body, masked by its silhouette.

    Args:
        images: RGB in [0, 1], (V, T, H, W, 3), or V videos.
        masks: Coverage of each pixel by the body, (V, T, H, W), or V videos; ones if unknown.
        times: Evenly spaced times [s], (T,).
        cameras: Cameras of the V views.
        centre: Centre of the body [m], (3,).
        size: Number of cells S along each side.
        preset: As in `optical_flow`.
        cache: Folder for cached flow, under a key of all inputs that affect it; no cache where absent.
        threads, method, device: As in `optical_flow`.

    Raises:
        UserError: As in `optical_flow`, `pixel_length` and `frame_interval_of`.
    """
    interval, pixel = frame_interval_of(times), pixel_length(cameras, centre)
    path = None
    if cache is not None:
        key = hashlib.sha256(repr(((len(images), *images[0].shape), preset, size, *([] if method == "opencv" else [method]))).encode())
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            for part in pool.map(lambda video: as_bytes(video[None]).cpu().numpy(), [*images, *masks]):
                key.update(part)
        path = Path(cache) / f"flow-{key.hexdigest()[:24]}.npz"
    found = _read_cache(path)
    if found is None:
        found = _crop_flow(optical_flow(images, preset=preset, threads=threads, method=method, device=device), masks, size)
        if path is not None:
            write_arrays(path, {"flow": found[0].cpu().numpy(), "side": found[1].numpy()}, compressed=False)
    flow, side = found
    return Velocities(flow * (pixel / interval).to(flow.device)[:, None, None, None, None], pixel * side / size, interval)


def as_bytes(images: Tensor) -> Tensor:
    """Convert images or masks in [0, 1] to bytes, (V, T, ...) uint8, frame by frame to save memory; the views in parallel on the CPU."""
    out = torch.empty(images.shape, dtype=torch.uint8, device=images.device)

    def convert(view: tuple[Tensor, Tensor]) -> None:
        for frame, part in zip(*view):
            if frame.is_cuda:
                part.copy_((255 * frame).round_())
            else:  # one thread of NumPy a view
                np.rint(np.float32(255) * frame.numpy(), out=part.numpy(), casting="unsafe")

    pairs = zip(images.detach(), out)
    if images.is_cuda:
        for pair in pairs:
            convert(pair)
    else:
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            for _ in pool.map(convert, pairs):
                pass
    return out


def _crop_flow(flow: Tensor, masks: Tensor | Sequence[Tensor], size: int) -> tuple[Tensor, Tensor]:
    """Return the masked flow (V, T - 1, S, S, 2) in pixels of the full image, and the sides of the windows [px], (V,)."""
    out, sides = [], []
    for each, mask, (top, left, side) in zip(flow, masks, _windows(masks)):
        cut = (slice(None), slice(top, top + side), slice(left, left + side))
        part = (each[cut] * mask[:-1][cut].to(each.device)[..., None]).permute(0, 3, 1, 2)
        out.append(torch.nn.functional.interpolate(part, size=(size, size), mode="bilinear", antialias=True).permute(0, 2, 3, 1))
        sides.append(float(side))
    return torch.stack(out), torch.tensor(sides)


def _windows(masks: Tensor | Sequence[Tensor]) -> list[tuple[int, int, int]]:
    """Return the `body_window` of each video; on the CPU, where each frame is read once, in several threads."""
    if masks[0].is_cuda:
        return [body_window(mask) for mask in masks]
    frames = [frame for mask in masks for frame in mask]
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        seen = list(pool.map(lambda frame: frame > 0.5, frames))
    count = len(masks[0])
    return [body_window(torch.stack(seen[k : k + count]).any(0)[None].float()) for k in range(0, len(seen), count)]


def _read_cache(path: Path | None) -> tuple[Tensor, Tensor] | None:
    if path is None or not path.is_file():
        return None
    try:
        arrays = read_arrays(path, ("flow", "side"))
        if arrays["flow"].ndim != 5 or arrays["side"].shape != arrays["flow"].shape[:1] or not np.isfinite(arrays["flow"]).all():
            raise UserError(f"{path} holds no flow")
        return torch.from_numpy(arrays["flow"]), torch.from_numpy(arrays["side"])
    except UserError as error:
        warnings.warn(f"the cached flow is computed again: {error}", stacklevel=3)
        path.unlink(missing_ok=True)
        return None


def pixel_length(cameras: Cameras, centre: Tensor) -> Tensor:
    """Return the size of a pixel of each camera at the depth of a point [m], (V,).

    Args:
        cameras: V cameras.
        centre: The point, such as the centre of the body [m], (3,).

    Raises:
        UserError: The point lies behind a camera, or cameras move.
    """
    refuse_moving(cameras, "the recording", "optical flow would hold their motion too; adapt a law to it instead (neuido fit)")
    view = cameras.viewmats.double()
    depth = (view[:, 2, :3] @ centre.to(view)) + view[:, 2, 3]
    if bool((depth <= 0).any()):
        raise UserError(f"{int((depth <= 0).sum())} of {len(depth)} cameras have the body behind them; check their matrices")
    return (depth / cameras.Ks[:, 0, 0].double()).float()


def flow_image(flow: Tensor, scale: float) -> Tensor:
    """Encode velocities as three channels in [-1, 1]: the two components and the magnitude, divided by a fixed scale.

    Args:
        flow: Velocities [m/s], (..., H, W, 2).
        scale: Speed that is encoded as one [m/s], the same for all videos of a data set.

    Returns:
        Images (..., H, W, 3).
    """
    scaled = flow / scale
    return torch.cat([scaled, scaled.norm(dim=-1, keepdim=True)], -1).clamp(-1, 1)


def colour_wheel(flow: Tensor) -> Tensor:
    """Encode flow as Middlebury colour images in [-1, 1], normalised frame by frame (the input of the paper, after Tora).

    Args:
        flow: Flow in any unit, (..., H, W, 2).

    Returns:
        RGB (..., H, W, 3); pixels at rest are white.
    """
    largest = flow.norm(dim=-1).amax((-2, -1))[..., None, None, None].clamp(min=1e-12)
    u, v = (flow / largest).unbind(-1)
    radius = (u * u + v * v).sqrt()[..., None].clamp(max=1)
    wheel = _wheel().to(flow)
    at = (torch.atan2(-v, -u) / math.pi + 1) / 2 * (len(wheel) - 1)
    low = at.floor().long().clamp(max=len(wheel) - 1)
    part = (at - low)[..., None]
    colour = (1 - part) * wheel[low] + part * wheel[(low + 1) % len(wheel)]
    return 2 * (1 - radius * (1 - colour)) - 1


def _wheel() -> Tensor:
    """Return the RGB values of the colour wheel, (55, 3)."""
    rows = []
    for sector, steps in enumerate(SECTORS):
        rise = torch.arange(steps) / steps
        colour = torch.zeros(steps, 3)
        full, moving = ((0, 1), (1, 0), (1, 2), (2, 1), (2, 0), (0, 2))[sector]
        colour[:, full] = 1
        colour[:, moving] = rise if sector % 2 == 0 else 1 - rise
        rows.append(colour)
    return torch.cat(rows)


def encode_flow(flow: Tensor, *, encoding: str = "velocity", speed_scale: float = 2.0) -> Tensor:
    """Encode flow as videos for a 3D VAE, with a first frame at rest so that there is one frame per image (Tora).

    Args:
        flow: Flow of V videos [m/s], (V, T - 1, H, W, 2).
        encoding: `velocity` (`flow_image`) or `wheel` (`colour_wheel`).
        speed_scale: Speed that is encoded as one [m/s].

    Returns:
        Videos (V, 3, T, H, W) in [-1, 1].

    Raises:
        UserError: The encoding is unknown, or the scale is not positive.
    """
    if encoding not in ENCODINGS:
        raise UserError(f"flow encoding = {encoding!r}; one of {', '.join(ENCODINGS)}")
    if not speed_scale > 0:
        raise UserError(f"speed_scale = {speed_scale:g} must be positive")
    padded = torch.cat([torch.zeros_like(flow[:, :1]), flow], 1)
    video = colour_wheel(padded) if encoding == "wheel" else flow_image(padded, speed_scale)
    return video.permute(0, 4, 1, 2, 3).contiguous()


def frame_interval_of(times: Tensor | Sequence[float]) -> float:
    """Return the time between two frames [s]; the times must be even to 1 %.

    Raises:
        UserError: There is only one frame, or the times are uneven.
    """
    times = torch.as_tensor(times, dtype=torch.float64)
    if len(times) < 2:
        raise UserError(f"a video needs at least 2 frames, got {len(times)}")
    steps = times.diff()
    mean = float(steps.mean())
    if mean <= 0 or float((steps - mean).abs().max()) > 0.01 * mean:
        raise UserError(f"frames are between {float(steps.min()):.4g} and {float(steps.max()):.4g} s apart; they must be evenly spaced")
    return mean
