"""Scores of the operator on constitutive data (Stage I): responses and their errors, latents of unseen materials, metrics."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torchmetrics import MeanSquaredError, MetricCollection

from neuido.data.progress import Progress
from neuido.models.operator.dynamics_operator import IntrinsicDynamicsOperator
from neuido.models.scoring.losses import relative_errors
from neuido.models.scoring.metrics import MedianRelativeError
from neuido.types import TrajectoryBatch

RESIDUAL_FLOOR = 1e-5
"""Minimum epsilon of a relative plastic error [-], for elastic trajectories, whose residual is zero."""


VISCOSITY_FLOOR = 1e-2
"""Viscosity that counts as none beside the inertia of the bodies of Stage I [Pa s]: ten times that of water."""


def viscosity_errors(predicted: Tensor, target: Tensor) -> Tensor:
    """Return |ln((p + floor) / (t + floor))| of viscosities [Pa s], (M,), with `VISCOSITY_FLOOR`: about the relative error above it."""
    return ((predicted + VISCOSITY_FLOOR).log() - (target + VISCOSITY_FLOOR).log()).abs()


def silhouette(points: Tensor, families: Sequence[str]) -> float:
    """Return the mean silhouette of points (M, d) with respect to their families (Rousseeuw 1987); NaN for fewer than two families."""
    names = list(dict.fromkeys(families))
    if len(names) < 2:
        return math.nan
    member = torch.tensor([[family == name for name in names] for family in families], dtype=torch.float64)
    points = points.detach().double().cpu()
    counts = member.sum(0)
    sums = torch.cdist(points, points) @ member
    own = (sums * member).sum(1) / (counts[member.argmax(1)] - 1).clamp(min=1)
    other = torch.where(member > 0, math.inf, sums / counts).amin(1)
    each = (other - own) / torch.maximum(own, other)
    return float(torch.where(counts[member.argmax(1)] > 1, each, 0.0).mean())


class OperatorResponse(NamedTuple):
    """Response of an operator to a batch of M trajectories with n samples each."""

    stress: Tensor
    """Predicted Kirchhoff stress [Pa], (M, n, 3, 3)."""
    corrected: Tensor
    """Predicted corrected deformation gradient [-], (M, n, 3, 3)."""
    stress_error: Tensor
    """Relative error of the stress, (M, n)."""
    plastic_error: Tensor
    """Relative error of the plastic residual F_hat - F_tr (or of F_hat), (M, n)."""
    stress_epsilon: Tensor
    """Floor of the stress norm of each trajectory [Pa], (M,)."""
    residual_epsilon: Tensor
    """Floor of the residual norm of each trajectory [-], (M,)."""


def evaluate_operator(
    operator: IntrinsicDynamicsOperator,
    z: Tensor,
    batch: TrajectoryBatch,
    stress_epsilon: Tensor,
    residual_epsilon: Tensor,
    plastic_target: str = "residual",
) -> OperatorResponse:
    """Evaluate the operator and its relative errors.

    Args:
        operator: The operator.
        z: Latents (M, d).
        batch: M n samples sorted by trajectory, n for each.
        stress_epsilon: Floor of the stress norm of each trajectory [Pa], (M,).
        residual_epsilon: Floor of the residual norm of each trajectory [-], (M,).
        plastic_target: `residual` compares F_hat - F_tr. `full` compares F_hat, as the paper does; its norm is about sqrt(3), so the error
            is nearly absolute.
    """
    trial, corrected, stress = (t.view(len(z), -1, 3, 3) for t in batch[:3])
    predicted, returned = operator.elastic(z, corrected), operator.plastic(z, trial)
    stress_error = relative_errors(predicted, stress, stress_epsilon[:, None])
    if plastic_target == "residual":
        plastic_error = relative_errors(returned - trial, corrected - trial, residual_epsilon[:, None])
    else:
        plastic_error = relative_errors(returned, corrected)
    return OperatorResponse(predicted, returned, stress_error, plastic_error, stress_epsilon, residual_epsilon)


def fit_latents(
    operator: IntrinsicDynamicsOperator,
    batch: TrajectoryBatch,
    candidates: Tensor,
    stress_epsilon: Tensor,
    residual_epsilon: Tensor,
    *,
    steps: int = 300,
    lr: float = 0.1,
    samples: int = 128,
    plastic_target: str = "residual",
    viscosity: Tensor | None = None,
    viscosity_weight: float = 0.1,
    progress: bool = False,
) -> Tensor:
    """Fit the latents of unseen materials with the weights of the operator frozen.

    Each latent starts at the candidate with the smallest error and is optimised by AdamW with a cosine schedule.

    Args:
        operator: The operator.
        batch: Samples to fit, sorted by material, the same number for each of the M materials.
        candidates: Initial latents to choose from, (K, d), such as those of the training trajectories.
        stress_epsilon: As for `evaluate_operator`, (M,).
        residual_epsilon: As for `evaluate_operator`, (M,).
        steps: Number of steps.
        lr: Initial learning rate.
        samples: Samples of each material in a step; successive steps cycle through all of them.
        plastic_target: As for `evaluate_operator`. The loss that trained the operator gives the best fit.
        viscosity: Viscosity of each material [Pa s], (M,), which is then fitted too; samples of stress do not show it.
        viscosity_weight: Weight of its error (`viscosity_errors`).
        progress: Show progress on stderr.

    Returns:
        Latents (M, d), detached.
    """
    count = len(stress_epsilon)
    trial, corrected, stress = (t.view(count, -1, 3, 3) for t in batch[:3])
    held = trial.shape[1]
    generator = torch.Generator().manual_seed(0)
    order = torch.randperm(held, generator=generator).to(trial.device)

    def errors(z: Tensor, step: int) -> Tensor:
        rows = order[(torch.arange(min(samples, held), device=order.device) + step * samples) % held]
        part = TrajectoryBatch(*(t[:, rows].contiguous() for t in (trial, corrected, stress)), batch.trajectory)
        answers = evaluate_operator(operator, z, part, stress_epsilon, residual_epsilon, plastic_target)
        total = (answers.stress_error + answers.plastic_error).mean(1)
        return total if viscosity is None else total + viscosity_weight * viscosity_errors(operator.viscosity(z), viscosity)

    trainable = [p for p in operator.parameters() if p.requires_grad]
    for parameter in trainable:
        parameter.requires_grad_(False)
    try:
        with torch.no_grad():
            scores = torch.stack([errors(z.expand(count, -1), 0) for z in candidates])
        z = candidates.detach()[scores.argmin(0)].clone().requires_grad_(True)
        optimizer = torch.optim.AdamW([z], lr=lr, weight_decay=0.0)
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
        with Progress("latents of held-out materials", steps, unit="steps", shown=progress) as work:
            for step in range(steps):
                optimizer.zero_grad()
                error = errors(z, step)
                error.sum().backward()
                optimizer.step()
                schedule.step()
                work.update()
                if (step + 1) % max(1, steps // 10) == 0:
                    work.say(f"error {error.mean().item():.4f}")
    finally:
        for parameter in trainable:
            parameter.requires_grad_(True)
    return z.detach()


class ConstitutiveMetrics(nn.Module):
    """Stress MSE [Pa^2] and plastic MSE (mean over components, as in the paper's Table 3), and median relative errors.

    `stress_error` and `plastic_error` are medians over all samples, `plastic_error_yielding` over the samples that yield, and those with
    `/<family>` over the samples of a family. The scores of trivial predictors are included for comparison: `stress_mse_zero` and
    `stress_error_zero/<family>` predict zero stress; `plastic_mse_identity`, `plastic_error_yielding_identity` and
    `plastic_error_identity/<family>` predict no plastic correction. Memory is constant in the number of samples.

    Args:
        prefix: Prefix of the metric names, e.g. `val/`.
        families: Family of each trajectory.
    """

    def __init__(self, prefix: str, families: Sequence[str]):
        super().__init__()
        self.prefix, self.families = prefix, list(families)
        self.names = sorted(set(families))
        response = MetricCollection({"mse": MeanSquaredError(), "error": MedianRelativeError()}, compute_groups=False)
        self.stress = response.clone(prefix=f"{prefix}stress_")
        self.plastic = response.clone(prefix=f"{prefix}plastic_")
        errors = MetricCollection({"yielding": MedianRelativeError()}, compute_groups=False)
        self.yielding = errors.clone(prefix=f"{prefix}plastic_error_")
        zero = MetricCollection({"stress_mse_zero": MeanSquaredError(), "plastic_mse_identity": MeanSquaredError()}, compute_groups=False)
        self.zero = zero.clone(prefix=prefix)
        self.unchanged = errors.clone(prefix=f"{prefix}plastic_error_", postfix="_identity")
        by_family = MetricCollection({name: MedianRelativeError() for name in self.names}, compute_groups=False)
        self.stress_by_family = by_family.clone(prefix=f"{prefix}stress_error/")
        self.plastic_by_family = by_family.clone(prefix=f"{prefix}plastic_error/")
        self.zero_by_family = by_family.clone(prefix=f"{prefix}stress_error_zero/")
        self.yielding_by_family = by_family.clone(prefix=f"{prefix}plastic_error_yielding/")
        self.unchanged_by_family = by_family.clone(prefix=f"{prefix}plastic_error_identity/")

    def update(self, answers: OperatorResponse, batch: TrajectoryBatch) -> None:
        """Add a batch with samples of every trajectory."""
        trial, corrected, stress = (t.view_as(answers.stress) for t in batch[:3])
        self.stress.update(preds=answers.stress.flatten(), target=stress.flatten(), errors=answers.stress_error)
        self.plastic.update(preds=answers.corrected.flatten(), target=corrected.flatten(), errors=answers.plastic_error)
        self.zero["stress_mse_zero"].update(torch.zeros_like(stress).flatten(), stress.flatten())
        self.zero["plastic_mse_identity"].update(trial.flatten(), corrected.flatten())
        residual = (corrected - trial).flatten(-2).norm(dim=-1)
        flows = residual > RESIDUAL_FLOOR
        self.yielding.update(errors=answers.plastic_error[flows])
        unchanged = residual / (residual + answers.residual_epsilon[:, None])
        self.unchanged.update(errors=unchanged[flows])
        size = stress.flatten(-2).norm(dim=-1)
        zero = size / (size + answers.stress_epsilon[:, None])
        for name in self.names:
            rows = [i for i, family in enumerate(self.families) if family == name]
            self.stress_by_family[name].update(answers.stress_error[rows])
            self.plastic_by_family[name].update(answers.plastic_error[rows])
            self.yielding_by_family[name].update(answers.plastic_error[rows][flows[rows]])
            self.zero_by_family[name].update(zero[rows])
            self.unchanged_by_family[name].update(unchanged[rows])

    def compute(self) -> dict[str, Tensor]:
        """Return all scores; those of a family that never yields are left out."""
        scores = {k: v for m in self._all() for k, v in m.compute().items()}
        return {k: v for k, v in scores.items() if "plastic_error_yielding/" not in k or not bool(v.isnan())}

    def reset(self) -> None:
        for collection in self._all():
            collection.reset()

    def _all(self) -> tuple[MetricCollection, ...]:
        whole = self.stress, self.plastic, self.zero, self.yielding, self.unchanged
        plastic = self.plastic_by_family, self.yielding_by_family, self.unchanged_by_family
        return *whole, self.stress_by_family, self.zero_by_family, *plastic


def viscosity_scores(prefix: str, predicted: Tensor, target: Tensor, families: Sequence[str]) -> dict[str, Tensor]:
    """Return the median `viscosity_errors` over all materials and over each family, and those of the best constant.

    Args:
        prefix: Prefix of the names, e.g. `val/`.
        predicted: Predicted viscosities [Pa s], (M,).
        target: True viscosities [Pa s], (M,).
        families: Family of each material.
    """
    constant = target.median().expand_as(target)
    scores = {}
    for suffix, errors in (("", viscosity_errors(predicted, target)), ("_constant", viscosity_errors(constant, target))):
        scores[f"{prefix}viscosity_error{suffix}"] = errors.median()
        for name in sorted(set(families)):
            own = errors[[i for i, family in enumerate(families) if family == name]]
            scores[f"{prefix}viscosity_error{suffix}/{name}"] = own.median()
    return scores
