"""Nearest points of many frames at once by comparison of all pairs, for a GPU; a tree would have to be built on the CPU for each frame."""

from types import SimpleNamespace

import torch
import warp as wp
from torch import Tensor

from neuido.physics.runtime.device import launch, real_of, start_warp, torch_stream
from neuido.physics.runtime.once import cached


@cached
def build(real: type) -> SimpleNamespace:
    """Return the kernel `nearest` for one scalar type.

    Args:
        real: `wp.float32` or `wp.float64`.
    """
    start_warp()
    vec3 = wp.types.vector(length=3, dtype=real)

    @wp.kernel(module=f"neuido.nearest.{real.__name__}", enable_backward=False)
    def nearest(a: wp.array(dtype=vec3), b: wp.array(dtype=vec3), many: int, others: int, out: wp.array(dtype=real)):
        """Write the squared distance of each point of `a` to the nearest point of `b` in the same frame.

        All threads of a warp read the same point of `b`, so that memory is read once for all of them.
        """
        i = wp.tid()
        first = (i // many) * others
        p = a[i]
        least = wp.length_sq(b[first] - p)
        for j in range(first + 1, first + others):
            least = wp.min(least, wp.length_sq(b[j] - p))
        out[i] = least

    return SimpleNamespace(nearest=nearest)


def nearest_by_pairs(a: Tensor, b: Tensor) -> Tensor:
    """Compute the squared distance of each point to the nearest of other points in the same frame.

    The distances come from differences of coordinates, and not from the less accurate |a|^2 - 2 a b + |b|^2.

    Args:
        a: Points of K frames, (K, P, 3).
        b: Other points of the same frames, (K, Q, 3) with Q >= 1, of the same dtype and device.

    Returns:
        Squared distances in the squared unit of `a`, (K, P).
    """
    frames, many = a.shape[:2]
    a, b = a.detach().contiguous(), b.detach().contiguous()
    out = torch.empty(frames, many, dtype=a.dtype, device=a.device)
    if out.numel():
        with torch_stream(a.device):
            arguments = [a.view(-1, 3), b.view(-1, 3), many, b.shape[1], out.view(-1)]
            launch(build(real_of(a.dtype)).nearest, frames * many, arguments, a.device)
    return out
