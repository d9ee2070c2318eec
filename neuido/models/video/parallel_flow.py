"""Optical flow of all pairs of frames of all videos together, by dense inverse search in Warp kernels, on a GPU or a CPU."""

import math
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from neuido.models.video.search_kernels import PATCH, build
from neuido.physics.runtime.device import launch, start_warp, torch_stream


class Search(NamedTuple):
    """Numbers of a preset, as in OpenCV's DIS."""

    finest: int
    """Halvings of the image at the finest scale that is searched."""
    stride: int
    """Distance of the patches [px]."""
    iterations: int
    """Largest number of steps of a patch at a scale."""
    refinements: int
    """Linearisations of the robust weights in the variational refinement of a scale."""


PRESETS = {"ultrafast": Search(2, 4, 12, 0), "fast": Search(2, 4, 16, 5), "medium": Search(1, 3, 25, 5)}
RELAXATIONS = 5
"""Relaxations of each linearisation."""


def parallel_flow(grey: Tensor, preset: str = "medium") -> Tensor:
    """Compute the flow from each frame to the next [px per frame].

    Args:
        grey: Brightness from 0 to 255 of V videos, (V, T, H, W), whose device does the work.
        preset: `ultrafast`, `fast` or `medium`.

    Returns:
        Flow (V, T - 1, H, W, 2), float32 on the device; x points right, y down.
    """
    options, (videos, frames, height, width) = PRESETS[preset], grey.shape
    coarsest = max(0, int(math.log2(max(height, width) / (4 * PATCH)) + 0.5))
    coarsest = min(coarsest, int(math.log2(min(height, width) / PATCH)) - 1)
    pyramid = [grey.reshape(-1, height, width).float()]
    for _ in range(coarsest):
        pyramid.append(functional.avg_pool2d(pyramid[-1][:, None], 2, ceil_mode=True, count_include_pad=False)[:, 0].contiguous())
    pairs = videos * (frames - 1)
    start_warp()  # nothing else may have used Warp before
    flow = torch.zeros(pairs, *pyramid[-1].shape[1:], 2, device=grey.device)
    with torch_stream(grey.device):
        for scale in range(coarsest, min(options.finest, coarsest) - 1, -1):
            flow = _resized(flow, pyramid[scale].shape[1:])
            flow = _searched(pyramid[scale], frames - 1, flow, options)
            if options.refinements:
                _refine(pyramid[scale], frames - 1, flow, options.refinements)
    return _resized(flow, (height, width)).view(videos, frames - 1, height, width, 2)


def _resized(flow: Tensor, size: tuple[int, ...] | torch.Size) -> Tensor:
    """Return flow (P, H, W, 2) in another number of pixels, in their unit."""
    before = flow.shape[1:3]
    if tuple(before) == tuple(size):
        return flow
    factor = flow.new_tensor([size[1] / before[1], size[0] / before[0]])
    grown = functional.interpolate(flow.permute(0, 3, 1, 2), size=tuple(size), mode="bilinear", align_corners=False)
    return (grown.permute(0, 2, 3, 1) * factor).contiguous()


def _searched(image: Tensor, steps: int, flow: Tensor, options: Search) -> Tensor:
    """Return the flow of each pixel after a search that begins with the given one."""
    kernels, device, stride = build(), image.device, options.stride
    pairs, height, width = flow.shape[:3]
    rows, columns = 1 + (height - PATCH) // stride, 1 + (width - PATCH) // stride
    first, second = (flow.new_empty(pairs, rows, columns, 2) for _ in range(2))
    half, slopes = -(-options.iterations // 2), image.new_empty(*image.shape, 2)
    launch(kernels.differentiate, image.numel(), [image, slopes], device)
    for neighbours, given, found in ((0, flow, first), (1, first, second)):
        launch(
            kernels.search, pairs * rows * columns, [image, slopes, steps, rows, columns, stride, half, neighbours, given, found], device
        )
    out = torch.empty_like(flow)
    launch(kernels.densify, pairs * height * width, [image, steps, stride, second, out], device)
    return out


def _refine(image: Tensor, steps: int, flow: Tensor, refinements: int) -> None:
    """Add the step that lowers the energy of Brox et al. to the flow, linearised about where it begins."""
    kernels, device, pixels = build(), image.device, flow[..., 0].numel()
    mean, change, smooth = (torch.empty_like(flow[..., 0]) for _ in range(3))
    step, right, matrix = torch.zeros_like(flow), torch.empty_like(flow), flow.new_empty(*flow.shape[:3], 3)
    launch(kernels.take_there, pixels, [image, steps, flow, mean, change], device)
    for _ in range(refinements):
        launch(kernels.linearise, pixels, [mean, change, flow, step, matrix, right, smooth], device)
        for k in range(2 * RELAXATIONS):
            launch(kernels.relax, pixels, [flow, matrix, right, smooth, k % 2, step], device)
    flow += step
