"""Kernels compiled side by side before the first launch, on a GPU: one after the other they take longer than a short diagnosis' fits."""

from collections.abc import Iterator

import torch
import warp as wp

from neuido.physics import effect_kernels, element_kernels, kernels, law_kernels
from neuido.physics.device import real_of


def load_for_bodies(device: torch.device | str, dtype: torch.dtype = torch.float32) -> None:
    """Compile, or take from the cache, what rollouts of bodies by either method launch: a thread a module, on a GPU.

    On a CPU nothing is done: there Warp compiles a module in less time alone, and many are never asked for.
    """
    device = torch.device(device)
    if device.type != "cuda":
        return
    modules = list({kernel.module.name: kernel.module for kernel in _launched(real_of(dtype))}.values())
    wp.force_load(wp.device_from_torch(torch.empty(0, device=device).device), modules, max_workers=len(modules))


def _launched(real: type) -> Iterator[wp.Kernel]:
    """The kernels of both methods, their laws and their effects, without the adjoints of the laws."""
    for built in (kernels.build(real), element_kernels.build(real), effect_kernels.build(real)):
        yield from (one for one in vars(built).values() if isinstance(one, wp.Kernel))
    laws = law_kernels.kernels(real)
    yield from (laws.stress, laws.correct)
