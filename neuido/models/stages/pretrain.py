"""Stage I: train trunks, heads and one latent for each trajectory on constitutive data (paper, "Dynamics Operator Pretraining")."""

from typing import Any, Literal

import torch
from lightning.pytorch.utilities import rank_zero_only
from torch import Tensor, nn

from neuido.errors import UserError
from neuido.models.operator.dynamics_operator import IntrinsicDynamicsOperator
from neuido.models.stages.operator_scores import (
    RESIDUAL_FLOOR,
    ConstitutiveMetrics,
    OperatorResponse,
    evaluate_operator,
    fit_latents,
    silhouette,
    viscosity_errors,
    viscosity_scores,
)
from neuido.models.stages.training import SteadyModule, optimiser_steps, validation_scores
from neuido.types import TrajectoryBatch


class PretrainModule(SteadyModule):
    """Train the operator on constitutive data (Stage I).

    The data module yields balanced batches. It provides `names`, `families`, `stress_rms`, `residual_rms` and `viscosity` of the
    trajectories, and the same of the held-out instances with the prefix `instance_` (`neuido.data.trajectories.trajectory_module`).

    Args:
        trajectory_count: Number of training trajectories, M (linked to the data by the command line).
        trunk: `objective`, `bounded`, `general` or `raw` (as of `IntrinsicDynamicsOperator`).
        latent_dim: d (paper: 128).
        basis_dim: Number of basis functions D (the paper does not say).
        hidden_dim: Width of the trunks (the paper does not say).
        head_dim: Width of the heads (the paper does not say).
        viscous: Learn the viscosity of each material with a third head (the paper has none).
        viscosity_weight: Weight of the error of its logarithm in the loss.
        latent_std: Initial standard deviation of the latents (paper: 1). Components that do not affect the laws keep their initial noise;
            with 0.1 the families are separate in the latent space itself (`neuido latents`).
        lr: Learning rate of trunks and heads, for AdamW with a cosine schedule to zero over the run (paper).
        latent_lr_factor: Learning rate of the latents as a multiple of `lr`.
        latent_decay: Weight decay of the latents. It counteracts the random drift that Adam causes along directions without effect on the
            laws.
        latent_decay_to: Target of this decay: `zero`, or the mean of the `family`.
        weight_decay: Weight decay of trunks and heads.
        relative_epsilon: Floor of the relative loss, as a fraction of the RMS of the trajectory (about 1 %).
        plastic_target: `residual`: relative error of F_hat - F_tr; `full`: relative error of F_hat, as in the paper.
        instance_steps: Steps that fit the latents of the held-out instances at the end; 0 skips them.
        instance_lr: Learning rate of these steps.
        instance_samples: Samples of each instance in each of these steps.
        save_to: File for the operator at the end of a fit (safetensors); without one, only Lightning writes checkpoints.
        init_from: Operator to start from: a file of `IntrinsicDynamicsOperator.save` of the same sizes, or `pretrained`.
        compile: Compile the trunks with torch.compile.
    """

    def __init__(
        self,
        trajectory_count: int,
        trunk: Literal["raw", "objective", "bounded", "general"] = "objective",
        latent_dim: int = 128,
        basis_dim: int = 64,
        hidden_dim: int = 64,
        head_dim: int = 128,
        viscous: bool = False,
        viscosity_weight: float = 0.1,
        latent_std: float = 1.0,
        lr: float = 3e-3,
        latent_lr_factor: float = 10.0,
        latent_decay: float = 0.0,
        latent_decay_to: Literal["zero", "family"] = "zero",
        weight_decay: float = 1e-4,
        relative_epsilon: float = 0.01,
        plastic_target: Literal["residual", "full"] = "residual",
        instance_steps: int = 300,
        instance_lr: float = 0.1,
        instance_samples: int = 128,
        save_to: str | None = None,
        init_from: str | None = None,
        compile: bool = False,
    ):
        super().__init__()
        for name, value in (
            ("trajectory_count", trajectory_count),
            ("latent_std", latent_std),
            ("lr", lr),
            ("relative_epsilon", relative_epsilon),
            ("viscosity_weight", viscosity_weight),
        ):
            if value <= 0:
                raise UserError(f"model.{name} = {value}: it must be positive")
        if latent_decay < 0:
            raise UserError(f"model.latent_decay = {latent_decay}: it must not be negative")
        if latent_decay_to not in ("zero", "family"):
            raise UserError(f"model.latent_decay_to = {latent_decay_to!r}: choose zero or family")
        if plastic_target not in ("residual", "full"):
            raise UserError(f"model.plastic_target = {plastic_target!r}: choose residual or full")
        self.save_hyperparameters()
        sizes = {"trunk": trunk, "latent_dim": latent_dim, "basis_dim": basis_dim, "hidden_dim": hidden_dim, "head_dim": head_dim}
        self.operator = IntrinsicDynamicsOperator(**sizes, viscous=viscous)  # type: ignore[arg-type]
        self.latents = nn.Parameter(latent_std * torch.randn(trajectory_count, latent_dim))
        if init_from is not None:
            self._start_from(init_from)
        if compile:
            for each in (self.operator.elastic_trunk, self.operator.plastic_trunk):
                each.hidden = torch.compile(each.hidden)  # type: ignore[method-assign]
        self.register_buffer("stress_epsilon", torch.ones(trajectory_count))
        self.register_buffer("residual_epsilon", torch.full((trajectory_count,), RESIDUAL_FLOOR))
        self.register_buffer("viscosity", torch.zeros(trajectory_count), persistent=False)
        self.register_buffer("family_mean", torch.eye(trajectory_count), persistent=False)
        self.families: list[str] = []

    def _start_from(self, init_from: str) -> None:
        loaded = IntrinsicDynamicsOperator.load(init_from)
        if loaded.config != self.operator.config:
            raise UserError(f"model.init_from = {init_from} has {loaded.config}; this model has {self.operator.config}")
        self.operator.load_state_dict(loaded.state_dict())
        if len(loaded.latents) == len(self.latents):
            self.latents.data.copy_(loaded.latents)

    # Fitting.

    def setup(self, stage: str) -> None:
        data = self.trainer.datamodule
        count = self.hparams.trajectory_count
        if data.trajectory_count != count:
            raise UserError(f"model.trajectory_count = {count}, but the data have {data.trajectory_count} trajectories")
        self.stress_epsilon.copy_(self.hparams.relative_epsilon * data.stress_rms)
        self.residual_epsilon.copy_(self._residual_epsilon(data.residual_rms))
        self.viscosity.copy_(data.viscosity)
        alike = torch.tensor([[a == b for b in data.families] for a in data.families], dtype=torch.float32, device=self.device)
        self.family_mean = alike / alike.sum(1, keepdim=True)
        self.metrics = ConstitutiveMetrics("test/" if stage == "test" else "val/", data.families)

    def _residual_epsilon(self, rms: Tensor) -> Tensor:
        return self.hparams.relative_epsilon * rms + RESIDUAL_FLOOR

    def configure_optimizers(self) -> dict[str, Any]:
        decay = self.hparams.latent_decay if self.hparams.latent_decay_to == "zero" else 0.0
        groups = [
            {"params": list(self.operator.parameters()), "weight_decay": self.hparams.weight_decay},
            {"params": [self.latents], "lr": self.hparams.lr * self.hparams.latent_lr_factor, "weight_decay": decay},
        ]
        optimizer = torch.optim.AdamW(groups, lr=self.hparams.lr, fused=self.latents.is_cuda)
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, optimiser_steps(self.trainer))
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}

    def optimizer_step(self, epoch: int, batch_idx: int, optimizer: Any, optimizer_closure: Any = None) -> None:
        super().optimizer_step(epoch, batch_idx, optimizer, optimizer_closure)
        if self.hparams.latent_decay_to == "family":
            rate = optimizer.param_groups[-1]["lr"] * self.hparams.latent_decay  # decoupled, as in AdamW
            with torch.no_grad():
                self.latents.lerp_(self.family_mean @ self.latents, rate)

    def training_step(self, batch: TrajectoryBatch, batch_idx: int) -> Tensor:
        answers = self._evaluate(batch, self.hparams.plastic_target)
        stress, plastic = answers.stress_error.mean(), answers.plastic_error.mean()
        if self.global_step % self.trainer.log_every_n_steps == 0:
            values = {"train/stress_loss": stress.detach(), "train/plastic_loss": plastic.detach()}
            self.log_dict(values, prog_bar=True)
        if not self.hparams.viscous:
            return stress + plastic
        viscosity = viscosity_errors(self.operator.viscosity(self.latents), self.viscosity).mean()
        if self.global_step % self.trainer.log_every_n_steps == 0:
            self.log("train/viscosity_loss", viscosity.detach())
        return stress + plastic + self.hparams.viscosity_weight * viscosity

    def _evaluate(self, batch: TrajectoryBatch, target: str = "residual") -> OperatorResponse:
        """Evaluate a batch of training trajectories; scores always compare residuals, whatever the loss compares."""
        return evaluate_operator(self.operator, self.latents, batch, self.stress_epsilon, self.residual_epsilon, target)

    def on_train_end(self) -> None:
        """Score the held-out instances, log the scores, and write the operator with the scores in its card."""
        figures = validation_scores(self) | {k: float(v) for k, v in self.score_instances().items()}
        self._publish(figures)

    @rank_zero_only
    def _publish(self, figures: dict[str, float]) -> None:
        instance = {k: v for k, v in figures.items() if k.startswith("instance/")}
        for logger in self.trainer.loggers:
            if instance:
                logger.log_metrics(instance, step=self.global_step)
                logger.save()
        for name, value in figures.items():
            self.print(f"{name:40s} {value:.4g}")
        data = self.trainer.datamodule
        self.operator.set_latents(self.latents.detach().cpu(), data.names, data.families)
        if self.hparams.save_to is not None:
            setup = getattr(data, "index", {}).get("setup", {})
            self.operator.save(self.hparams.save_to, {"stage": "I", "steps": self.global_step, "data": setup, "figures": figures})

    # Validation: held-out particles and time steps. Test: held-out instances as well.

    def validation_step(self, batch: TrajectoryBatch, batch_idx: int) -> None:
        self.metrics.update(self._evaluate(batch), batch)

    def on_validation_epoch_end(self) -> None:
        self._log_scores("val/")

    def _log_scores(self, prefix: str) -> None:
        """Log the scores of the validation samples, the viscosities, and the silhouette of the latents."""
        data = self.trainer.datamodule
        self.log_dict(self.metrics.compute())
        self.metrics.reset()
        self.log(f"{prefix}silhouette", silhouette(self.latents, data.families))
        if self.hparams.viscous:
            self.log_dict(viscosity_scores(prefix, self.operator.viscosity(self.latents), self.viscosity, data.families))

    def test_step(self, batch: TrajectoryBatch, batch_idx: int) -> None:
        self.metrics.update(self._evaluate(batch), batch)

    def on_test_epoch_end(self) -> None:
        self._log_scores("test/")
        self.log_dict(self.score_instances())

    def score_instances(self) -> dict[str, Tensor]:
        """Fit a latent to each held-out instance with all weights frozen, and score it on the held-out samples of the instance."""
        data = self.trainer.datamodule
        if self.hparams.instance_steps == 0 or not data.instance_names:
            return {}
        with torch.inference_mode(False), torch.enable_grad():
            to_fit, to_score = (TrajectoryBatch(*(t.to(self.device) for t in part)) for part in data.instance_batches())
            epsilons = (
                (self.hparams.relative_epsilon * data.instance_stress_rms).to(self.device),
                self._residual_epsilon(data.instance_residual_rms).to(self.device),
            )
            viscosity = data.instance_viscosity.to(self.device) if self.hparams.viscous else None
            z = fit_latents(
                self.operator,
                to_fit,
                self.latents.detach(),
                *epsilons,
                steps=self.hparams.instance_steps,
                lr=self.hparams.instance_lr,
                samples=self.hparams.instance_samples,
                plastic_target=self.hparams.plastic_target,
                viscosity=viscosity,
                viscosity_weight=self.hparams.viscosity_weight,
                progress=self.trainer.is_global_zero,
            )
            metrics = ConstitutiveMetrics("instance/", data.instance_families).to(self.device)
            with torch.no_grad():
                metrics.update(evaluate_operator(self.operator, z, to_score, *epsilons), to_score)
                scores = metrics.compute()
                if viscosity is not None:
                    scores |= viscosity_scores("instance/", self.operator.viscosity(z), viscosity, data.instance_families)
        return scores
