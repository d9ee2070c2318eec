"""Warm-up of the projector: supervised training on flow of simulated clips with known laws, before Stage II (not in the paper).

Stage II sees few scenes, and what it learns from their images does not generalise far. The warm-up sees many cheap clips of `neuido film`.
Its loss compares the law that the frozen operator makes of the inferred latent with samples of the true law, as in Stage I, but with z
from a video.
"""

import hashlib
import json
import warnings
from pathlib import Path
from typing import Any, Literal, NamedTuple

import torch
from lightning.pytorch import LightningModule
from safetensors.torch import save_file
from torch import Tensor

from neuido.data.bodies.families import laws
from neuido.data.clips import Clip, FilmDataModule
from neuido.data.files.writing import atomic_write
from neuido.data.progress import Progress
from neuido.data.weight_files import read_safetensors
from neuido.errors import UserError
from neuido.models.operator.dynamics_operator import IntrinsicDynamicsOperator
from neuido.models.operator.law_properties import p_wave_modulus
from neuido.models.stages.training import open_operator_and_encoder, optimiser_steps, report_and_save
from neuido.models.video.flow import Velocities

STRAIN_FLOOR = 3e-4
"""Floor of the norm of a plastic correction [-] in its relative error."""


class LawErrors(NamedTuple):
    """Errors of the laws of B materials, one number for each, (B,)."""

    stress: Tensor
    """|tau^ - tau| / (|tau^| + |tau| + 1 %), mean over samples: from 0 to 1, equal for twice and for half the true stress."""
    plastic: Tensor
    """The same error of the plastic correction F_hat - F_tr."""
    size: Tensor
    """|log| of the ratio of the RMS stresses, which does not saturate."""

    def total(self, size_weight: float) -> Tensor:
        """Return the training loss, (B,)."""
        return self.stress + self.plastic + size_weight * self.size


def compare_laws(operator: IntrinsicDynamicsOperator, z: Tensor, trial: Tensor, corrected: Tensor, stress: Tensor) -> LawErrors:
    """Compare the laws of z (B, d) with samples of the true laws: trial and corrected F, and stress [Pa], each (B, n, 3, 3)."""
    predicted, returned = operator.elastic(z, corrected), operator.plastic(z, trial)
    norm = stress.flatten(2).norm(dim=2)
    rms = norm.square().mean(1).sqrt()
    floor = 0.01 * rms[:, None] + 1e-3
    other = predicted.flatten(2).norm(dim=2)
    stress_error = (predicted - stress).flatten(2).norm(dim=2) / (norm + other + floor)
    a, b = (returned - trial).flatten(2), (corrected - trial).flatten(2)
    plastic_error = (a - b).norm(dim=2) / (a.norm(dim=2) + b.norm(dim=2) + STRAIN_FLOOR)
    size = ((other.square().mean(1) + 1e-6).sqrt() / (rms + 1e-3)).log().abs()
    return LawErrors(stress_error.mean(1), plastic_error.mean(1), size)


class WarmupModule(LightningModule):
    """Train the projector so that the law inferred from a clip matches the law that made it; operator and VAE are frozen.

    The data module is a `FilmDataModule` with `frames: 0`.

    Args:
        operator: File of the operator, or `pretrained`.
        init_from: Encoder to start from; without one, a new projector starts near the mean latent of Stage I.
        vae: VAE of a new encoder: a file, `pretrained`, or `cogvideox:` and a source.
        flow_size, flow_encoding, speed_scale, width, heads, conditions, dropout: Options of a new encoder (`DynamicsEncoder`).
        lr: Learning rate of AdamW, with a cosine schedule to zero over the run.
        weight_decay: Weight decay of the projector.
        size_weight: Weight of `LawErrors.size` in the loss.
        mirror: Augment with mirrored clips.
        noise: Standard deviation of the noise added to the (normalised) flow latents in training.
        samples: Samples of the law of each clip in a step.
        cache: Folder for cached flow latents of the clips.
        save_to: File for the encoder at the end of a fit.
    """

    def __init__(
        self,
        operator: str = "pretrained",
        init_from: str | None = None,
        vae: str = "pretrained",
        flow_size: int = 64,
        flow_encoding: Literal["velocity", "wheel"] = "velocity",
        speed_scale: float = 2.0,
        width: int = 96,
        heads: int = 4,
        conditions: bool = True,
        dropout: float = 0.1,
        lr: float = 1e-3,
        weight_decay: float = 0.01,
        size_weight: float = 0.3,
        mirror: bool = True,
        noise: float = 0.05,
        samples: int = 64,
        cache: str | None = None,
        save_to: str | None = None,
    ):
        super().__init__()
        if lr <= 0 or samples < 1 or size_weight < 0 or noise < 0:
            raise UserError(f"model.lr = {lr} must be positive, samples = {samples} at least 1, size_weight and noise not negative")
        self.save_hyperparameters()
        flow = {"flow_size": flow_size, "flow_encoding": flow_encoding, "speed_scale": speed_scale}
        sizes = {"width": width, "heads": heads, "conditions": conditions, "dropout": dropout}
        self.operator, self.encoder = open_operator_and_encoder(operator, init_from, vae, of_another=True, **flow, **sizes)  # type: ignore[arg-type]
        self._clips: dict[str, Tensor] = {}
        self._rows: list[tuple[LawErrors, Tensor, Tensor, Tensor]] = []

    def configure_optimizers(self) -> dict[str, Any]:
        parameters = self.encoder.projector.parameters()
        optimizer = torch.optim.AdamW(parameters, lr=self.hparams.lr, weight_decay=self.hparams.weight_decay)
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, optimiser_steps(self.trainer))
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}

    def on_fit_start(self) -> None:
        self._load()

    def on_validation_start(self) -> None:
        self._load()

    def _load(self) -> None:
        """Embed all clips once, as the VAE is frozen; the key of the cache covers the VAE, the flow encoding and the clips."""
        if self._clips:
            return
        data: FilmDataModule = self.trainer.datamodule
        parts: dict[str, list[Tensor]] = {
            name: [] for name in ("volume", "conditions", "trial", "corrected", "stress", "modulus", "elastic")
        }
        cache = None if self.hparams.cache is None else Path(self.hparams.cache) / f"clips-{self._key(data)}"
        with Progress("flow latents", len(data.clips), unit="clips", shown=self.trainer.is_global_zero) as work:
            for number, entry in enumerate(data.clips):
                clip = data.read(number)
                volume, conditions = self._embed(clip, None if cache is None else cache / f"{entry['name']}.safetensors")
                parts["volume"].append(volume)
                parts["conditions"].append(conditions)
                for name in ("trial", "corrected", "stress"):
                    parts[name].append(getattr(clip, name))
                parts["elastic"].append(torch.tensor(entry["family"] == "elastic"))
                parts["modulus"].append(laws(entry["family"], [entry["parameters"]])[0].modulus().float()[0])
                work.update()
        self._clips = {name: torch.stack(rows).to(self.device) for name, rows in parts.items()}

    def _key(self, data: FilmDataModule) -> str:
        key = hashlib.sha256(json.dumps([self.encoder.flow, data.index, self.hparams.mirror], sort_keys=True).encode())
        for tensor in self.encoder.vae.state_dict().values():
            key.update(tensor.cpu().contiguous().numpy().tobytes())
        return key.hexdigest()[:24]

    def _embed(self, clip: Clip, kept: Path | None) -> tuple[Tensor, Tensor]:
        """Return flow latents (1, or 2 with the mirrored clip, V, channels, T', h, w) and conditions (V, 2)."""
        if kept is not None and kept.is_file():
            try:
                found, metadata = read_safetensors(kept)
                if metadata.get("digest") == _digest(found["volume"], found["conditions"]):
                    return found["volume"], found["conditions"]
            except (UserError, KeyError, TypeError):  # numpy has no type for every one of torch's
                pass
            warnings.warn(f"{kept} is damaged or of another version, and is computed again", stacklevel=2)
        seen = [clip.flow.float()]
        if self.hparams.mirror:
            seen.append(seen[0].flip(3) * seen[0].new_tensor([-1.0, 1.0]))
        pairs = [self.encoder.embed(Velocities(flow, clip.cell, clip.frame_interval)) for flow in seen]
        volume, conditions = torch.stack([volume for volume, _ in pairs]).cpu(), pairs[0][1].cpu()
        if kept is not None:
            with atomic_write(kept) as hidden:
                save_file({"volume": volume, "conditions": conditions}, hidden, metadata={"digest": _digest(volume, conditions)})
        return volume, conditions

    def training_step(self, numbers: Tensor, batch_idx: int) -> Tensor:
        clips, count = self._clips, len(numbers)
        _, sides, views = clips["volume"].shape[:3]
        side, view = (torch.randint(n, (count,), device=self.device) for n in (sides, views))
        volume = clips["volume"][numbers, side, view]
        volume = volume + self.hparams.noise * torch.randn_like(volume)
        z = self.encoder.projector(volume, clips["conditions"][numbers, view])
        rows = torch.randint(clips["trial"].shape[1], (self.hparams.samples,), device=self.device)
        errors = compare_laws(self.operator, z, *(clips[name][numbers][:, rows] for name in ("trial", "corrected", "stress")))
        values = {"train/stress": errors.stress, "train/plastic": errors.plastic, "train/size": errors.size}
        self.log_dict({name: value.detach().mean() for name, value in values.items()}, prog_bar=True)
        return errors.total(self.hparams.size_weight).mean()

    def validation_step(self, numbers: Tensor, batch_idx: int) -> None:
        """Infer one z from all views of a clip, as in Stage II, and score its law."""
        clips = self._clips
        volume, conditions = clips["volume"][numbers, 0], clips["conditions"][numbers]
        views = volume.shape[1]
        z = self.encoder.projector(volume.flatten(0, 1), conditions.flatten(0, 1)).unflatten(0, (-1, views)).mean(1)
        errors = compare_laws(self.operator, z, *(clips[name][numbers] for name in ("trial", "corrected", "stress")))
        self._rows.append((errors, p_wave_modulus(self.operator, z), clips["modulus"][numbers], clips["elastic"][numbers]))

    def on_validation_epoch_end(self) -> None:
        columns = list(zip(*self._rows))
        errors = LawErrors(*(torch.cat(column) for column in zip(*columns[0])))
        found, true, elastic = (torch.cat(column) for column in columns[1:])
        self._rows.clear()
        error = (found.clamp(min=1.0) / true).log().abs()
        values = {"val/stress": errors.stress.mean(), "val/plastic": errors.plastic.mean(), "val/size": errors.size.mean()}
        values |= {"val/modulus_error": error.median().exp() - 1, "val/modulus_order": _spearman(found, true)}
        if bool(elastic.any()):  # a material that flows does not reveal its stiffness
            own = _spearman(found[elastic], true[elastic])
            values |= {"val/modulus_error_elastic": error[elastic].median().exp() - 1, "val/modulus_order_elastic": own}
        self.log_dict(values, prog_bar=True, sync_dist=True)

    def on_train_end(self) -> None:
        report_and_save(self, self.encoder.save, {"stage": "warm-up", "operator": self.operator.fingerprint(), "steps": self.global_step})


def _spearman(a: Tensor, b: Tensor) -> Tensor:
    """Return Spearman's rank correlation of two vectors; NaN for fewer than three numbers."""
    if len(a) < 3:
        return a.new_tensor(float("nan"))
    ranks = torch.stack([v.argsort().argsort().to(torch.float32) for v in (a, b)])
    return torch.corrcoef(ranks)[0, 1]


def _digest(*tensors: Tensor) -> str:
    """Return the SHA-256 of tensors, as hexadecimal digits."""
    return hashlib.sha256(b"".join(t.contiguous().numpy().tobytes() for t in tensors)).hexdigest()
