"""Training of the flow VAE on optical flow of simulated clips (`neuido film`)."""

import math
from typing import Any

import torch
from torch import Tensor

from neuido.data.clips import FlowBatch
from neuido.errors import UserError
from neuido.models.stages.training import SteadyModule, optimiser_steps, report_and_save, validation_scores
from neuido.models.video.flow import encode_flow
from neuido.models.video.flow_vae import FlowVAE


class FlowVAEModule(SteadyModule):
    """Train the VAE to reconstruct flow videos, with a weak KL prior; the weights of the best validation are kept.

    Args:
        width: Width of the VAE.
        latent_channels: Number of latent channels (CogVideoX: 16).
        lr: Learning rate of AdamW, with a short warm-up and a cosine schedule to zero over the run.
        weight_decay: Weight decay of all weights.
        kl_weight: Weight of the KL divergence from N(0, 1), mean over the latent numbers.
        motion_weight: Additional weight of moving pixels; most of a flow video does not move.
        flow_encoding: `velocity` or `wheel`.
        speed_scale: Speed that is encoded as one [m/s].
        save_to: File for the VAE at the end of a fit; without one, only Lightning writes checkpoints.
    """

    def __init__(
        self,
        width: int = 32,
        latent_channels: int = 16,
        lr: float = 1e-3,
        weight_decay: float = 1e-4,
        kl_weight: float = 1e-5,
        motion_weight: float = 4.0,
        flow_encoding: str = "velocity",
        speed_scale: float = 2.0,
        save_to: str | None = None,
    ):
        super().__init__()
        if lr <= 0 or kl_weight < 0 or motion_weight < 0:
            raise UserError(f"model.lr = {lr} must be positive, kl_weight = {kl_weight} and motion_weight = {motion_weight} not negative")
        self.save_hyperparameters()
        self.vae = FlowVAE(width, latent_channels)
        self.latent_sum = torch.zeros(3, dtype=torch.float64)
        self.best: dict[str, Any] = {}  # weights of the smallest validation error, so that one bad step late in a run does little harm

    def configure_optimizers(self) -> dict[str, Any]:
        optimizer = torch.optim.AdamW(self.parameters(), lr=self.hparams.lr, weight_decay=self.hparams.weight_decay, betas=(0.9, 0.99))
        total = optimiser_steps(self.trainer)
        first = min(100, max(1, total // 10))  # without a warm-up the first steps scatter the latents for good

        def rate(step: int) -> float:
            return min((step + 1) / first, 0.5 + 0.5 * math.cos(math.pi * min(1.0, step / total)))

        schedule = torch.optim.lr_scheduler.LambdaLR(optimizer, rate)
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}

    def video(self, batch: FlowBatch) -> Tensor:
        """Encode the flow of a batch as videos (B, 3, t + 1, S, S) in [-1, 1]."""
        return encode_flow(batch.flow, encoding=self.hparams.flow_encoding, speed_scale=self.hparams.speed_scale)

    def losses(self, video: Tensor, *, sample: bool) -> tuple[Tensor, Tensor, Tensor]:
        """Return the weighted squared error, the mean KL divergence of a latent number, and the latent means."""
        mean, variance = self.vae.posterior(video)
        latent = mean + (0.5 * variance).exp() * torch.randn_like(mean) if sample else mean
        error = (self.vae.reconstruct(latent) - video).square()
        # pixels at rest are white in the colour wheel and zero in the velocity encoding
        rest = 1.0 if self.hparams.flow_encoding == "wheel" else 0.0
        moves = ((video - rest).abs().amax(1, keepdim=True) > 0.01).float()
        weight = 1 + self.hparams.motion_weight * moves
        divergence = 0.5 * (mean.square() + variance.exp() - 1 - variance).mean()
        return (weight * error).sum() / weight.expand_as(error).sum(), divergence, mean

    def training_step(self, batch: FlowBatch, batch_idx: int) -> Tensor:
        error, divergence, _ = self.losses(self.video(batch), sample=True)
        self.log_dict({"train/error": error, "train/divergence": divergence}, prog_bar=True)
        return error + self.hparams.kl_weight * divergence

    def validation_step(self, batch: FlowBatch, batch_idx: int) -> None:
        video = self.video(batch)
        error, divergence, mean = self.losses(video, sample=False)
        rest = 1.0 if self.hparams.flow_encoding == "wheel" else 0.0
        energy = (video - rest).square().mean().clamp(min=1e-12)
        explained = 1 - (self.vae.reconstruct(mean) - video).square().mean() / energy
        self.log_dict({"val/error": error, "val/divergence": divergence, "val/explained": explained}, prog_bar=True, sync_dist=True)
        mean = mean.double()
        self.latent_sum += torch.stack([torch.ones_like(mean).sum(), mean.sum(), mean.square().sum()]).cpu()

    def on_validation_epoch_start(self) -> None:
        self.latent_sum.zero_()

    def on_validation_epoch_end(self) -> None:
        """Set the scale of the latents from the held-out clips."""
        count, total, squares = self.latent_sum.tolist()
        self.vae.scale.fill_(max(squares / count - (total / count) ** 2, 1e-12) ** -0.5)

    def on_validation_end(self) -> None:
        figures = validation_scores(self)
        if figures and not figures["val/error"] >= self.best.get("figures", {}).get("val/error", math.inf):
            weights = {name: t.detach().cpu().clone() for name, t in self.vae.state_dict().items()}
            self.best = {"steps": self.global_step, "figures": figures, "weights": weights}

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        checkpoint["best"] = self.best

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        self.best = checkpoint.get("best", {})

    def on_train_end(self) -> None:
        best = self.best or {"steps": self.global_step, "figures": {}, "weights": self.vae.state_dict()}
        self.vae.load_state_dict(best["weights"])
        flow = {"flow_encoding": self.hparams.flow_encoding, "speed_scale": self.hparams.speed_scale}
        report_and_save(self, self.vae.save, {"steps": best["steps"], "flow": flow}, best["figures"])
