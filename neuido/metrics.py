"""Metrics of laws and of motions, as torchmetrics: distances of point sets, and medians over samples."""

from typing import Any

import torch
from torch import Tensor
from torchmetrics import Metric


class MedianRelativeError(Metric):
    """Median of per-sample relative errors, from a histogram of their logarithm.

    1024 bins over 1e-8 to 1e4, so the reported median is exact to 1.4 % of itself and the memory does not grow with the samples. States
    add up over processes. An error below 1e-8 counts as 1e-8, and the median is then reported as 0.

    Args:
        below: The lowest error told apart.
        above: The highest.
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
        """Add relative errors (...,) >= 0. NaN counts as the highest."""
        x = (torch.where(errors.isnan(), float("inf"), errors.detach()).flatten().log() - self.low) / self.width
        index = x.clamp(0, self.bins - 1).long()
        self.histogram.index_add_(0, index, torch.ones_like(index))

    def compute(self) -> Tensor:
        """The median [-], NaN without samples."""
        total = self.histogram.sum()
        if total == 0:
            return torch.tensor(float("nan"), device=self.histogram.device)
        index = (self.histogram.cumsum(0) * 2 >= total).float().argmax()
        median = torch.exp(self.low + (index.float() + 0.5) * self.width)
        return torch.where(index == 0, torch.zeros_like(median), median)


def nearest_squared(a: Tensor, b: Tensor, chunk: int = 4096) -> Tensor:
    """Squared distance of each point of a (P, 3) to its nearest of b (Q, 3), (P,) [unit of a, squared].

    On the CPU by a k-d tree, on a GPU by blocks of all pairs.

    Args:
        a: Points (P, 3).
        b: Points (Q, 3).
        chunk: Points of `a` at a time.
    """
    if not a.is_cuda:
        from scipy.spatial import cKDTree

        distance, _ = cKDTree(b.detach().numpy()).query(a.detach().numpy())
        return torch.from_numpy(distance).square().to(a.dtype)
    # Exact differences: the shortcut |a|^2 + |b|^2 - 2 a.b loses distances below 3e-4 in float32.
    return torch.cat([torch.cdist(part, b, compute_mode="donot_use_mm_for_euclid_dist").amin(1).square() for part in a.split(chunk)])


def chamfer_distance(a: Tensor, b: Tensor) -> Tensor:
    """Mean squared nearest distance from a (P, 3) to b (Q, 3) plus that from b to a [unit of a, squared]."""
    return nearest_squared(a, b).mean() + nearest_squared(b, a).mean()


def resampling_floor(points: Tensor, seed: int = 0) -> Tensor:
    """The Chamfer distance between two random halves of a point set (P, 3): what a perfect law drawn anew would score.

    Halves are sparser than the set; nearest distances in three dimensions go with P^(-1/3), so the value is multiplied by 2^(-2/3).
    """
    order = torch.randperm(len(points), generator=torch.Generator().manual_seed(seed)).to(points.device)
    half = len(points) // 2
    return chamfer_distance(points[order[:half]], points[order[half : 2 * half]]) * 2 ** (-2 / 3)


def matched_rmse(a: Tensor, b: Tensor) -> Tensor:
    """Root mean square distance of particles that correspond, (..., P, 3) -> (); over frames and particles."""
    return (a - b).square().sum(-1).mean().sqrt()


class ChamferDistance(Metric):
    """Chamfer distance, mean over frames: squared, both directions summed, times `scale`.

    With `scale = 1e4` and coordinates of the unit cube this is the unit of the paper's tables.
    """

    full_state_update = False
    higher_is_better = False

    def __init__(self, scale: float = 1e4, **kwargs: Any):
        super().__init__(**kwargs)
        self.scale = scale
        self.add_state("total", default=torch.zeros((), dtype=torch.float64), dist_reduce_fx="sum")
        self.add_state("frames", default=torch.zeros((), dtype=torch.long), dist_reduce_fx="sum")

    def update(self, prediction: Tensor, target: Tensor) -> None:
        """Add frames: points (P, 3) and (Q, 3), or K frames of them (K, P, 3) and (K, Q, 3)."""
        for a, b in zip(prediction.reshape(-1, *prediction.shape[-2:]), target.reshape(-1, *target.shape[-2:]), strict=True):
            self.total += chamfer_distance(a, b).double()
            self.frames += 1

    def compute(self) -> Tensor:
        """Mean over frames times `scale`."""
        return self.scale * self.total / self.frames


class MatchedRMSE(Metric):
    """Root mean square distance of corresponding particles over all frames [unit of the points]."""

    full_state_update = False
    higher_is_better = False

    def __init__(self, **kwargs: Any):
        super().__init__(**kwargs)
        self.add_state("total", default=torch.zeros((), dtype=torch.float64), dist_reduce_fx="sum")
        self.add_state("points", default=torch.zeros((), dtype=torch.long), dist_reduce_fx="sum")

    def update(self, prediction: Tensor, target: Tensor) -> None:
        """Add points (..., P, 3) and their counterparts."""
        square = (prediction - target).square().sum(-1)
        self.total += square.double().sum()
        self.points += square.numel()

    def compute(self) -> Tensor:
        return (self.total / self.points).sqrt()
