"""Shared parts of the training modules: steps that are skipped, the number of steps, final reports, and opening of operator and encoder."""

import math
import sys
from collections.abc import Callable, Mapping
from typing import Any

import torch
from lightning.pytorch import LightningModule, Trainer
from lightning.pytorch.utilities import rank_zero_only
from torch import Tensor

from neuido.errors import UserError
from neuido.models.operator.dynamics_operator import IntrinsicDynamicsOperator
from neuido.models.video.encoder import DynamicsEncoder

SKIPPED_IN_A_ROW = 50
"""Steps with a gradient that is not finite after which a training ends: single bad scenes are passed over, bad weights are not."""


class SteadyModule(LightningModule):
    """Base class of trainings that never step on a loss or a gradient that is not finite.

    Such a step is skipped, said on standard error and logged as `train/failed`. One infinite component is enough to make all weights NaN:
    clipping multiplies it by zero. The backward pass of a rollout may overflow where the rollout itself does not.
    """

    skipped = 0
    """Number of steps that were skipped."""
    _skipped_in_a_row = 0

    def on_before_backward(self, loss: Tensor) -> None:
        """Make the gradient of a loss that is not finite NaN, which all processes of a training see."""
        if loss.requires_grad:
            loss.register_hook(lambda gradient: torch.where(loss.detach().isfinite(), gradient, torch.nan))

    def on_before_optimizer_step(self, optimizer: torch.optim.Optimizer) -> None:
        """Skip a step whose gradient is not finite.

        Raises:
            UserError: That happened `SKIPPED_IN_A_ROW` times in a row.
        """
        if is_finite(gradients := gradients_of(optimizer)):
            self._skipped_in_a_row = 0
            return
        optimizer.zero_grad(set_to_none=True)  # zeros would still move the weights, by the momentum
        self.skipped += 1
        self._skipped_in_a_row += 1
        self.log("train/failed", 1.0, batch_size=1)
        if self._skipped_in_a_row >= SKIPPED_IN_A_ROW:
            raise UserError(
                f"the training ends: at step {self.global_step} the gradient was not finite, as in the {SKIPPED_IN_A_ROW - 1} before; "
                f"lower model.lr = {self.hparams.get('lr')}, or start from other weights"
            )
        if self.trainer.is_global_zero:
            bad = sum(not is_finite([gradient]) for gradient in gradients)
            print(f"step {self.global_step} is skipped: {bad} of {len(gradients)} gradients are not finite", file=sys.stderr)


def gradients_of(optimizer: torch.optim.Optimizer) -> list[Tensor]:
    """Return the gradients of all parameters that have one."""
    return [p.grad for group in optimizer.param_groups for p in group["params"] if p.grad is not None]


def is_finite(gradients: list[Tensor]) -> bool:
    """Return whether no gradient holds a NaN or an infinity."""
    return not gradients or bool(torch.stack([g.isfinite().all() for g in gradients]).all())


def optimiser_steps(trainer: Trainer) -> int:
    """Return the number of optimiser steps of a whole run.

    `trainer.estimated_stepping_batches` is not used because it sets up the loaders before Lightning restores their state: a run resumed
    within an epoch would then restart that epoch.
    """
    bounds = [trainer.max_steps] if trainer.max_steps > 0 else []
    if trainer.max_epochs is not None and trainer.max_epochs > 0:
        batches, limit = len(trainer.datamodule.train_dataloader()), trainer.limit_train_batches
        batches = min(batches, limit) if isinstance(limit, int) else int(batches * limit)
        bounds.append(trainer.max_epochs * math.ceil(batches / trainer.accumulate_grad_batches))
    if not bounds:
        raise UserError("trainer.max_epochs and trainer.max_steps are both unlimited: the cosine schedule needs an end")
    return max(1, min(bounds))


def validation_scores(module: LightningModule) -> dict[str, float]:
    """Return the metrics that the last validation logged under `val/`."""
    return {name: float(value) for name, value in module.trainer.callback_metrics.items() if name.startswith("val/")}


@rank_zero_only
def report_and_save(
    module: LightningModule,
    save: Callable[[str, dict[str, Any]], None],
    card: Mapping[str, Any],
    figures: Mapping[str, float] | None = None,
) -> None:
    """Print the validation metrics and write the trained model to the file `save_to`, if there is one.

    Args:
        module: Trained module with the hyperparameter `save_to`.
        save: Function that takes the file and its card.
        card: Entries of the card in addition to the metrics.
        figures: Metrics under names that begin with `val/`; those of the last validation where absent.
    """
    figures = validation_scores(module) if figures is None else figures
    for name, value in figures.items():
        if name.count("/") == 1:  # skip the metrics of single scenes
            module.print(f"{name:40s} {value:.4g}")
    if module.hparams.save_to is not None:
        save(module.hparams.save_to, {**card, "figures": dict(figures)})


def open_operator_and_encoder(
    operator: str, init_from: str | None, vae: str, *, of_another: bool = False, **sizes
) -> tuple[IntrinsicDynamicsOperator, DynamicsEncoder]:
    """Open a frozen operator, and an encoder that infers its latents.

    Args:
        operator: File of `IntrinsicDynamicsOperator.save`, or `pretrained`.
        init_from: File of `DynamicsEncoder.save`, or `pretrained`; it brings its own VAE and sizes. Without one, a new projector starts
            near the mean latent of Stage I.
        vae: VAE of a new encoder, as in `video_vae.open_vae`.
        of_another: Whether the encoder may have been trained for another operator, as a start.
        sizes: Other options of a new `DynamicsEncoder`.

    Raises:
        UserError: A file is missing, or the encoder is not one for the operator.
    """
    frozen = IntrinsicDynamicsOperator.load(operator)
    frozen.eval().requires_grad_(False)
    if init_from is not None:
        encoder = DynamicsEncoder.load(init_from)
    else:
        encoder = DynamicsEncoder(vae, latent_dim=frozen.latent_dim, **sizes)
        if len(frozen.latents) > 1:
            encoder.projector.start_near(frozen.latents)
    encoder.check_operator(frozen, f"model.init_from = {init_from}", weights=not of_another)
    return frozen, encoder
