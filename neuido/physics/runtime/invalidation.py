"""Rollouts of many scenes of which some may fail: the frames of those become NaN, and the others stay what they are."""

from collections.abc import Sequence

import torch
from torch import Tensor


def invalidate(frames: Sequence[Tensor], failed: Tensor, scene: Tensor) -> None:
    """Make all frames NaN of every scene in which a particle failed, in place.

    Args:
        frames: (K, P, ...) each.
        failed: Which particles did, (P,) bool.
        scene: Scene of each particle, (P,).
    """
    scene = scene.long()
    broken = torch.zeros(int(scene.max()) + 1, dtype=torch.int32, device=scene.device).index_add_(0, scene, failed.int()) > 0
    if bool(broken.any()):
        for t in frames:
            t[:, broken[scene]] = torch.nan
