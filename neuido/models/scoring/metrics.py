"""Metrics of laws and motions for torchmetrics: distances of point sets, and medians over samples."""

from typing import Any

import torch
from torch import Tensor
from torchmetrics import Metric

from neuido.physics.linalg.nearest import nearest_by_pairs


class MedianRelativeError(Metric):
    """Median of per-sample relative errors, computed from a histogram of their logarithm.

    The 1024 bins cover 1e-8 to 1e4, so the median is accurate to 1.4 % and memory is constant in the number of samples. States are summed
    over processes. A median in the lowest bin is reported as 0.

    Args:
        below: Lower end of the histogram; smaller errors fall into the first bin.
        above: Upper end of the histogram; larger errors fall into the last bin.
        bins: Number of bins.
    """

    full_state_update = False
    higher_is_better = False

    def __init__(self, below: float = 1e-8, above: float = 1e4, bins: int = 1024, **kwargs: Any):
        super().__init__(**kwargs)
        low, high = torch.log(torch.tensor([below, above], dtype=torch.float64)).tolist()
        self.low, self.width, self.bins = low, (high - low) / bins, bins
        self.add_state("histogram", default=torch.zeros(bins, dtype=torch.long), dist_reduce_fx="sum")

    def update(self, errors: Tensor) -> None:
        """Add relative errors (...,) >= 0; NaN counts as infinite."""
        x = (torch.where(errors.isnan(), float("inf"), errors.detach()).flatten().log() - self.low) / self.width
        index = x.clamp(0, self.bins - 1).long()
        self.histogram.index_add_(0, index, torch.ones_like(index))

    def compute(self) -> Tensor:
        """Return the median [-]; NaN without samples."""
        total = self.histogram.sum()
        if total == 0:
            return torch.tensor(float("nan"), device=self.histogram.device)
        index = (self.histogram.cumsum(0) * 2 >= total).float().argmax()
        median = torch.exp(self.low + (index.float() + 0.5) * self.width)
        return torch.where(index == 0, torch.zeros_like(median), median)


def nearest_squared(a: Tensor, b: Tensor) -> Tensor:
    """Return the squared distance of each point to the nearest point of the other set [unit of a, squared].

    The CPU uses a k-d tree for each frame; a GPU compares all pairs of all frames in one launch (`physics.linalg.nearest`).

    Args:
        a: Points (P, 3), or frames of points (..., P, 3).
        b: Points (Q, 3), or the same number of frames (..., Q, 3).

    Returns:
        (P,), or (..., P).

    Raises:
        ValueError: The numbers of frames differ, or `b` has no point.
    """
    if a.shape[:-2] != b.shape[:-2] or a.shape[-1] != 3 or b.shape[-1] != 3 or not b.shape[-2]:
        raise ValueError(f"points of shapes {tuple(a.shape)} and {tuple(b.shape)}; expected (..., P, 3) and (..., Q, 3) with Q >= 1")
    frames, others = a.detach().reshape(-1, *a.shape[-2:]), b.detach().reshape(-1, *b.shape[-2:]).to(a)
    if a.is_cuda:
        return nearest_by_pairs(frames, others).reshape(a.shape[:-1])
    from scipy.spatial import cKDTree

    found = [torch.from_numpy(cKDTree(y.numpy()).query(x.numpy())[0]) for x, y in zip(frames, others)]
    return torch.stack(found).square().to(a.dtype).reshape(a.shape[:-1])


def chamfer_distance(a: Tensor, b: Tensor) -> Tensor:
    """Return the mean squared nearest distance from a (..., P, 3) to b (..., Q, 3) plus that from b to a, (...) [unit of a, squared]."""
    return nearest_squared(a, b).mean(-1) + nearest_squared(b, a).mean(-1)


def resampling_floor(points: Tensor, seed: int = 0) -> Tensor:
    """Return the Chamfer distance between two random halves of a point set (..., P, 3), (...): the score of a resampled perfect prediction.

    The halves are sparser than the set. Nearest distances in three dimensions scale with P^(-1/3), so the squared distance is multiplied by
    2^(-2/3). All frames are split in the same way.
    """
    count = points.shape[-2]
    order, half = torch.randperm(count, generator=torch.Generator().manual_seed(seed)).to(points.device), count // 2
    return chamfer_distance(points[..., order[:half], :], points[..., order[half : 2 * half], :]) * 2 ** (-2 / 3)


class ChamferDistance(Metric):
    """Chamfer distance (squared, sum of both directions), mean over frames, times `scale`.

    `scale = 1e4` with coordinates in the unit cube gives the unit of the paper's tables.
    """

    full_state_update = False
    higher_is_better = False
    total: Tensor
    frames: Tensor

    def __init__(self, scale: float = 1e4, **kwargs: Any):
        super().__init__(**kwargs)
        self.scale = scale
        self.add_state("total", default=torch.zeros((), dtype=torch.float64), dist_reduce_fx="sum")
        self.add_state("frames", default=torch.zeros((), dtype=torch.long), dist_reduce_fx="sum")

    def update(self, prediction: Tensor, target: Tensor) -> None:
        """Add one frame of points (P, 3) and (Q, 3), or K frames (K, P, 3) and (K, Q, 3)."""
        distances = chamfer_distance(prediction, target)
        self.total += distances.double().sum()
        self.frames += distances.numel()

    def compute(self) -> Tensor:
        """Return the mean over frames times `scale`."""
        return self.scale * self.total / self.frames


class MatchedRMSE(Metric):
    """Root mean square distance of corresponding particles over all frames [unit of the points]."""

    full_state_update = False
    higher_is_better = False
    total: Tensor
    points: Tensor

    def __init__(self, **kwargs: Any):
        super().__init__(**kwargs)
        self.add_state("total", default=torch.zeros((), dtype=torch.float64), dist_reduce_fx="sum")
        self.add_state("points", default=torch.zeros((), dtype=torch.long), dist_reduce_fx="sum")

    def update(self, prediction: Tensor, target: Tensor) -> None:
        """Add points (..., P, 3) and the corresponding target points."""
        square = (prediction - target).square().sum(-1)
        self.total += square.double().sum()
        self.points += square.numel()

    def compute(self) -> Tensor:
        return (self.total / self.points).sqrt()
