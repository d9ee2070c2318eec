"""Invalidation of the scenes that failed in a rollout of several scenes."""

from collections.abc import Sequence

import torch
from torch import Tensor


def invalidate(frames: Sequence[Tensor], failed: Tensor, scene: Tensor) -> None:
    """Set all frames of the scenes in which a particle failed to NaN, in place; other scenes are unchanged.

    Args:
        frames: Frames of each quantity, (K, P, ...).
        failed: Which particles failed, (P,) bool.
        scene: The scene of each particle, (P,).
    """
    scene = scene.long()
    broken = torch.zeros(int(scene.max()) + 1, dtype=torch.int32, device=scene.device).index_add_(0, scene, failed.int()) > 0
    if bool(broken.any()):
        for t in frames:
            t[:, broken[scene]] = torch.nan
