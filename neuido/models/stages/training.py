"""What the training modules share: the length of a run, and what they leave at its end."""

import math
from collections.abc import Callable, Mapping
from typing import Any

from lightning.pytorch import LightningModule, Trainer
from lightning.pytorch.utilities import rank_zero_only

from neuido.errors import UserError
from neuido.models.operator.dynamics_operator import IntrinsicDynamicsOperator
from neuido.models.video.encoder import DynamicsEncoder


def optimiser_steps(trainer: Trainer) -> int:
    """Return optimiser steps of a whole run.

    `trainer.estimated_stepping_batches` would do, but it sets up the loaders before Lightning restores their state, and a run
    resumed in the middle of an epoch would then start that epoch anew.
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
    """Return what the last validation logged, by names that begin with `val/`."""
    return {name: float(value) for name, value in module.trainer.callback_metrics.items() if name.startswith("val/")}


@rank_zero_only
def report_and_save(
    module: LightningModule,
    save: Callable[[str, dict[str, Any]], None],
    card: Mapping[str, Any],
    figures: Mapping[str, float] | None = None,
) -> None:
    """Print the figures of a validation and, where `save_to` names a file, write what was trained.

    Args:
        module: At the end of its fit; it has the hyperparameter `save_to`.
        save: Takes the file and its card.
        card: What the card says beside the figures.
        figures: By names that begin with `val/`; those of the last validation where absent.
    """
    figures = validation_scores(module) if figures is None else figures
    for name, value in figures.items():
        if name.count("/") == 1:  # not of single scenes
            module.print(f"{name:40s} {value:.4g}")
    if module.hparams.save_to is not None:
        save(module.hparams.save_to, {**card, "figures": dict(figures)})


def open_operator_and_encoder(operator: str, init_from: str | None, vae: str, **sizes) -> tuple[IntrinsicDynamicsOperator, DynamicsEncoder]:
    """Open a frozen operator, and an encoder that infers latents for it.

    Args:
        operator: File of `IntrinsicDynamicsOperator.save`, or `pretrained`.
        init_from: File of `DynamicsEncoder.save`, or `pretrained`, whose own VAE and sizes then count; none: a new projector, near
            the mean latent of Stage I.
        vae: Of a new projector, see `video_vae.open_vae`.
        sizes: Options of a new `DynamicsEncoder`.

    Raises:
        UserError: A file that is missing, or latents of different lengths.
    """
    frozen = IntrinsicDynamicsOperator.load(operator)
    frozen.eval().requires_grad_(False)
    if init_from is not None:
        encoder = DynamicsEncoder.load(init_from)
    else:
        encoder = DynamicsEncoder(vae, latent_dim=frozen.latent_dim, **sizes)
        if len(frozen.latents) > 1:
            encoder.projector.start_near(frozen.latents)
    encoder.check_latents(frozen.latent_dim, f"model.init_from = {init_from}")
    return frozen, encoder
