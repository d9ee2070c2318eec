"""Warm-up of the projector: supervised training on flow of simulated clips with known laws, before Stage II (not in the paper).

Stage II sees few scenes, and what it learns from their images does not generalise far. The warm-up sees many cheap clips of `neuido film`.
Its loss compares the law that the frozen operator makes of the inferred latent with samples of the true law, as in Stage I, but with z
from a video. Beside the projector it trains the reader, which predicts family and properties with their uncertainty (`video.reader`).
"""

import hashlib
import json
import math
import warnings
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor

from neuido.data.bodies.families import laws
from neuido.data.clips import Clip, FilmDataModule
from neuido.data.progress import Progress
from neuido.data.weight_files import read_safetensors, write_safetensors
from neuido.errors import UserError
from neuido.models.operator.dynamics_operator import IntrinsicDynamicsOperator
from neuido.models.operator.law_properties import p_wave_modulus
from neuido.models.stages.training import SteadyModule, open_operator_and_encoder, optimiser_steps, report_and_save
from neuido.models.stages.true_properties import effective_viscosity, properties_of
from neuido.models.video.material_properties import LENGTH_POWERS, LOGARITHMIC, UNITS, to_scale
from neuido.models.video.reader import NORMAL, Distribution, Reader

READ, EMBEDDED = 64, 16
"""Clips that are read, and videos that the VAE embeds, at a time."""
VISCOSITY_FLOOR = 0.3
"""Floor of a viscosity [Pa s] in its logarithmic error: water and less do not show in a splash of half a metre."""
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


class WarmupModule(SteadyModule):
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
        scale: Largest factor by which the mirrored clip is enlarged or reduced, 1: none. At the same gravity and density, times scale with
            the root of lengths, moduli with lengths and viscosities with their power of 1.5: the law of the scaled clip is known.
        shortest: Least share of the frames that a training step sees, drawn anew.
        reader: Train a reader of family and properties too.
        reader_width: Width of the reader.
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
        scale: float = 1.4,
        shortest: float = 0.5,
        reader: bool = True,
        reader_width: int = 192,
        noise: float = 0.05,
        samples: int = 64,
        cache: str | None = None,
        save_to: str | None = None,
    ):
        super().__init__()
        if lr <= 0 or samples < 1 or size_weight < 0 or noise < 0:
            raise UserError(f"model.lr = {lr} must be positive, samples = {samples} at least 1, size_weight and noise not negative")
        if scale < 1 or not 0 < shortest <= 1:
            raise UserError(f"model.scale = {scale} must be at least 1, and shortest = {shortest} above 0 and at most 1")
        self.save_hyperparameters()
        flow = {"flow_size": flow_size, "flow_encoding": flow_encoding, "speed_scale": speed_scale}
        sizes = {"width": width, "heads": heads, "conditions": conditions, "dropout": dropout}
        self.operator, self.encoder = open_operator_and_encoder(operator, init_from, vae, of_another=True, **flow, **sizes)  # type: ignore[arg-type]
        self._clips: dict[str, Tensor] = {}
        self._rows: list[tuple[LawErrors, Tensor, Tensor, Tensor]] = []
        self._read: list[tuple[Distribution, Tensor]] = []

    def setup(self, stage: str) -> None:
        """Make the reader, which needs the names of the families; an encoder to start from keeps its own if they are the same."""
        data: FilmDataModule = self.trainer.datamodule
        families = list(dict.fromkeys(entry["family"] for entry in data.clips))
        if self.hparams.init_from is None:
            self.encoder.flow["flow_preset"] = data.index.get("plan", {}).get("flow_preset", self.encoder.flow["flow_preset"])
        old = self.encoder.reader
        if self.hparams.reader and (old is None or old.config["families"] != families):
            options = {"channels": self.encoder.vae.channels, "width": self.hparams.reader_width, "dropout": self.hparams.dropout}
            self.encoder.reader = Reader(families, **options).to(self.device)

    def configure_optimizers(self) -> dict[str, Any]:
        parameters = [p for p in self.encoder.parameters() if p.requires_grad]  # the VAE is frozen
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
        parts: dict[str, list[Tensor]] = {name: [] for name in ("volume", "conditions", "trial", "corrected", "stress")}
        cache = None if self.hparams.cache is None else Path(self.hparams.cache) / f"clips-{self._key(data)}"
        numbers = range(len(data.clips))
        with Progress("flow latents", len(numbers), unit="clips", shown=self.trainer.is_global_zero) as work, ThreadPoolExecutor(8) as pool:
            for start in numbers[::READ]:
                part = numbers[start : start + READ]
                clips = list(pool.map(data.read, part))
                kept = [None if cache is None else cache / f"{data.clips[i]['name']}.safetensors" for i in part]
                for clip, pair in zip(clips, self._embed(clips, part, kept)):
                    for name, value in zip(("volume", "conditions"), pair):
                        parts[name].append(value)
                    for name in ("trial", "corrected", "stress"):
                        parts[name].append(getattr(clip, name))
                work.update(len(part))
        found = {name: torch.stack(rows) for name, rows in parts.items()} | self._truth(data)
        self._clips = {name: t.to(self.device) for name, t in found.items()}

    def _truth(self, data: FilmDataModule) -> dict[str, Tensor]:
        """Return family, modulus, viscosity and the standardised properties of each clip; the reader is told their mean and spread."""
        families = list(dict.fromkeys(entry["family"] for entry in data.clips))
        names, rows = tuple(UNITS), []
        for entry in data.clips:
            own = properties_of(entry["family"], entry["parameters"])
            rows.append([to_scale(name, own[name]) if name in own else math.nan for name in names])
        properties = torch.tensor(rows)
        present = ~properties.isnan()
        family = torch.tensor([families.index(entry["family"]) for entry in data.clips])
        if (reader := self.encoder.reader) is not None:
            used, there = properties[: data.training_count], present[: data.training_count]
            for p in range(len(names)):
                own = used[there[:, p], p]
                if len(own) > 1:
                    reader.centre[p], reader.spread[p] = own.mean(), own.std().clamp(min=1e-6)
            known = torch.stack([present[family == f].any(0) for f in range(len(families))])
            reader.known.copy_(known)
            properties = (properties - reader.centre.cpu()) / reader.spread.cpu()
        modulus = [laws(entry["family"], [entry["parameters"]])[0].modulus().float()[0] for entry in data.clips]
        viscosity = [effective_viscosity(entry["family"], entry["parameters"]) for entry in data.clips]
        return {
            "family": family,
            "properties": properties.where(present, 0.0),  # no loss sees these
            "present": present.float(),
            "modulus": torch.stack(modulus),
            "viscosity": torch.tensor(viscosity),
            "elastic": torch.tensor([entry["family"] == "elastic" for entry in data.clips]),
            "grow": torch.tensor([[1.0, self._enlargement(i)][: 1 + self.hparams.mirror] for i in range(len(data.clips))]),
        }

    def _enlargement(self, number: int) -> float:
        """Return the factor on lengths of the mirrored clip of a number."""
        u = torch.rand((), generator=torch.Generator().manual_seed(number)).item()
        return self.hparams.scale ** (2 * u - 1)

    def _key(self, data: FilmDataModule) -> str:
        options = [self.encoder.flow, data.index, self.hparams.mirror, self.hparams.scale]
        key = hashlib.sha256(json.dumps(options, sort_keys=True).encode())
        for tensor in self.encoder.vae.state_dict().values():
            key.update(tensor.cpu().contiguous().numpy().tobytes())
        return key.hexdigest()[:24]

    def _embed(self, clips: list[Clip], numbers: Sequence[int], kept: list[Path | None]) -> list[tuple[Tensor, Tensor]]:
        """Return flow latents (1, or 2 with the mirrored clip, V, channels, T', h, w) and conditions (1 or 2, V, 2) of each clip."""
        found = [_read_kept(path) for path in kept]
        missing = [k for k, pair in enumerate(found) if pair is None]
        flows, cells, intervals = [], [], []
        for k in missing:
            clip = clips[k]
            variants = [(clip.flow.float(), 1.0)]
            if self.hparams.mirror:
                grow = self._enlargement(numbers[k])
                variants.append((clip.flow.float().flip(3) * (clip.cell.new_tensor([-1.0, 1.0]) * grow**0.5), grow))
            for flow, grow in variants:
                flows.append(flow)
                cells.append(clip.cell * grow)
                intervals.append(torch.full_like(clip.cell, clip.frame_interval * grow**0.5))
        if missing:
            sides, views = 1 + self.hparams.mirror, len(flows[0])
            volume, conditions = self.encoder.embed_flow(torch.cat(flows), torch.cat(intervals), torch.cat(cells), batch=EMBEDDED)
            for k, v, c in zip(missing, volume.cpu().split(sides * views), conditions.cpu().split(sides * views)):
                found[k] = v.unflatten(0, (sides, views)), c.unflatten(0, (sides, views))
                if (path := kept[k]) is not None:
                    tensors = {"volume": found[k][0].contiguous(), "conditions": found[k][1].contiguous()}
                    write_safetensors(path, tensors, {"digest": _digest(*tensors.values())})
        return found  # type: ignore[return-value]

    def training_step(self, numbers: Tensor, batch_idx: int) -> Tensor:
        clips, count = self._clips, len(numbers)
        _, sides, views = clips["volume"].shape[:3]
        side = torch.randint(sides, (count,), device=self.device)
        shown = int(torch.randint(1, views + 1, ()))
        chosen = torch.rand(count, views, device=self.device).argsort(1)[:, :shown]
        place = (numbers[:, None], side[:, None], chosen)
        volume, conditions = clips["volume"][place], clips["conditions"][place]
        frames = volume.shape[3]
        kept = int(torch.randint(math.ceil(self.hparams.shortest * frames), frames + 1, ()))
        volume = volume[:, :, :, :kept] if torch.rand(()) < 0.5 else volume  # the VAE is causal: what was embedded of a shorter video
        volume = volume + self.hparams.noise * torch.randn_like(volume)
        z = self.encoder.projector(volume[:, 0], conditions[:, 0])
        rows = torch.randint(clips["trial"].shape[1], (self.hparams.samples,), device=self.device)
        trial, corrected, stress = (clips[name][numbers][:, rows] for name in ("trial", "corrected", "stress"))
        grow = clips["grow"][numbers, side]
        errors = compare_laws(self.operator, z, trial, corrected, stress * grow[:, None, None, None])
        values = {"train/stress": errors.stress, "train/plastic": errors.plastic, "train/size": errors.size}
        loss = errors.total(self.hparams.size_weight).mean()
        viscous = self._viscosity_error(z, clips["viscosity"][numbers] * grow ** LENGTH_POWERS["viscosity"])
        if viscous is not None:
            values["train/viscosity"] = viscous
            loss = loss + self.hparams.size_weight * viscous.mean()
        if (reader := self.encoder.reader) is not None:
            powers = torch.tensor([LENGTH_POWERS[name] for name in reader.properties], device=self.device)
            target = clips["properties"][numbers] + grow.log()[:, None] * powers / reader.spread
            read = reader.loss(reader(volume, conditions), clips["family"][numbers], target, clips["present"][numbers])
            values["train/reader"] = read
            loss = loss + read
        self.log_dict({name: value.detach().mean() for name, value in values.items()}, prog_bar=True)
        return loss

    def _viscosity_error(self, z: Tensor, viscosity: Tensor) -> Tensor | None:
        """Return the logarithmic error of the operator's viscosity, (B,); None for an operator without one."""
        if self.operator.viscosity_head is None:
            return None
        return ((self.operator.viscosity(z) + VISCOSITY_FLOOR) / (viscosity + VISCOSITY_FLOOR)).log().abs()

    def validation_step(self, numbers: Tensor, batch_idx: int) -> None:
        """Infer one z from all views of a clip, as in Stage II, and score its law; and read the clip."""
        clips = self._clips
        volume, conditions = clips["volume"][numbers, 0], clips["conditions"][numbers, 0]
        views = volume.shape[1]
        z = self.encoder.projector(volume.flatten(0, 1), conditions.flatten(0, 1)).unflatten(0, (-1, views)).mean(1)
        errors = compare_laws(self.operator, z, *(clips[name][numbers] for name in ("trial", "corrected", "stress")))
        self._rows.append((errors, p_wave_modulus(self.operator, z), clips["modulus"][numbers], clips["elastic"][numbers]))
        if self.encoder.reader is not None:
            self._read.append((self.encoder.reader(volume, conditions), numbers))

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
        self.log_dict(values | self._reader_scores(), prog_bar=True, sync_dist=True)

    def _reader_scores(self) -> dict[str, Tensor]:
        """Return how often the reader names the family, its median factors on the properties, and the cover of its intervals."""
        rows, self._read = self._read, []
        if not rows or (reader := self.encoder.reader) is None:
            return {}
        found = Distribution(*(torch.cat(parts) for parts in zip(*(own for own, _ in rows))))
        numbers = torch.cat([own for _, own in rows])
        family, target, present = (self._clips[name][numbers] for name in ("family", "properties", "present"))
        row, chosen = torch.arange(len(family), device=family.device), found.logits.argmax(1)
        values = {"val/family": (chosen == family).float().mean()}
        error = target - found.mean[row, chosen]
        inside = error.abs() <= NORMAL * reader.interval_scale * found.log_std[row, chosen].exp()
        valid = present.bool() & reader.known[chosen].bool()
        for p, name in enumerate(reader.properties):
            if bool(valid[:, p].any()):
                size = (reader.spread[p] * error[valid[:, p], p]).abs().median()
                values[f"val/{name}_factor" if name in LOGARITHMIC else f"val/{name}_error"] = size.exp() if name in LOGARITHMIC else size
                values[f"val/{name}_covered"] = inside[valid[:, p], p].float().mean()
        for f, name in enumerate(reader.families):
            own = valid[:, 0] & (family == f)
            if bool(own.any()):
                values[f"val/young_factor/{name}"] = (reader.spread[0] * error[own, 0]).abs().median().exp()
            if bool((family == f).any()):
                values[f"val/family/{name}"] = (chosen == f)[family == f].float().mean()
        return values

    @torch.no_grad()
    def _calibrate(self) -> None:
        """Calibrate the reader on the held-out clips, and tell it what the features of training clips are."""
        reader, data, clips = self.encoder.reader, self.trainer.datamodule, self._clips
        if reader is None or not clips:
            return
        self.eval()
        views: list[Tensor] = []
        for numbers in torch.arange(len(data.clips), device=self.device).split(READ):
            volume, conditions = clips["volume"][numbers, 0], clips["conditions"][numbers, 0]
            features = reader.describe(volume.flatten(0, 1), conditions.flatten(0, 1))
            views.append(torch.cat([features, conditions.flatten(0, 1)], 1).unflatten(0, volume.shape[:2]))
        features = torch.cat(views)
        own = slice(data.training_count, None)
        found = reader.predict(features[own, :, :-2].mean(1))
        reader.calibrate(found, clips["family"][own], clips["properties"][own], clips["present"][own])
        reader.familiarise(features[: data.training_count].flatten(0, 1), features[own].flatten(0, 1))

    def on_train_end(self) -> None:
        self._calibrate()
        report_and_save(self, self.encoder.save, {"stage": "warm-up", "operator": self.operator.fingerprint(), "steps": self.global_step})


def _spearman(a: Tensor, b: Tensor) -> Tensor:
    """Return Spearman's rank correlation of two vectors; NaN for fewer than three numbers."""
    if len(a) < 3:
        return a.new_tensor(float("nan"))
    ranks = torch.stack([v.argsort().argsort().to(torch.float32) for v in (a, b)])
    return torch.corrcoef(ranks)[0, 1]


def _read_kept(path: Path | None) -> tuple[Tensor, Tensor] | None:
    """Return the flow latents and conditions of a file of the cache; None where there is none, or a damaged one."""
    if path is None or not path.is_file():
        return None
    try:
        found, metadata = read_safetensors(path)
        if metadata.get("digest") == _digest(found["volume"], found["conditions"]):
            return found["volume"], found["conditions"]
    except (UserError, KeyError, TypeError):  # numpy has no type for every one of torch's
        pass
    warnings.warn(f"{path} is damaged or of another version, and is computed again", stacklevel=2)
    return None


def _digest(*tensors: Tensor) -> str:
    """Return the SHA-256 of tensors, as hexadecimal digits."""
    return hashlib.sha256(b"".join(t.contiguous().numpy().tobytes() for t in tensors)).hexdigest()
