"""Few-shot adaptation of the paper: LoRA on both trunks, and refinement of the latent ("Few-Shot Dynamics Adaptation").

The adapter is a PEFT adapter: `save` writes `adapter_model.safetensors` and `adapter_config.json` in the format of PEFT. Before a rollout
the adapter is merged into the effective networks, so it adds no cost there.
"""

import copy
import os
import uuid
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

from neuido.errors import UserError
from neuido.models.fewshot.method import Method, read_tensors, write_tensors
from neuido.models.fewshot.posterior_start import explore
from neuido.models.inference.law_file import FORMAT as LAW_FORMAT
from neuido.models.inference.law_file import save_law
from neuido.models.inference.pipeline import infer_latent
from neuido.models.inference.prepared_scene import Laws, PreparedScene
from neuido.models.operator.dynamics_operator import IntrinsicDynamicsOperator
from neuido.models.operator.law_properties import Moduli, implausibility, p_wave_modulus, small_strain_moduli
from neuido.models.video.encoder import DynamicsEncoder
from neuido.models.video.flow_vae import read_weights

if TYPE_CHECKING:
    from peft import PeftModel

TARGETS = r"(elastic|plastic)_trunk\.(fc1|fc2|out)"
LATENT, LAW = "latent.safetensors", "law.safetensors"
PEFT_FILES = ("adapter_config.json", "adapter_model.safetensors")


class LowRankAdaptation(Method):
    """Fit LoRA adapters of both trunks jointly with the latent z of the scene.

    Args:
        operator: File of the operator, or `pretrained`; its weights stay frozen.
        start: Initial z: `encoder` (its zero-shot estimate), `posterior` (of about `start_draws` laws that this estimate leaves possible,
            the one whose images are nearest: `posterior_start`), `mean` (of the latents of Stage I), the name of a family (the mean of its
            latents, e.g. `elastic`) or of a single latent, or a law file of `neuido predict`.
        init_from: File of the encoder, or `pretrained`; only read for `start: encoder` and `posterior`.
        start_draws: Number of laws that `start: posterior` simulates, about.
        rank: LoRA rank r (paper: 16); 0: no adapter, only z is refined.
        alpha: LoRA alpha (paper: 16); the low-rank update is scaled by alpha / r.
        lr: Learning rate of the adapter.
        latent_lr: Learning rate of z.
        prior_weight: Weight of the squared distance of z from its initial value, mean over the components of z.
        plausibility_weight: Weight of the penalty on elastic laws that a rollout would not survive (`law_properties.implausibility`);
            paper: 0.
        seed: Seed of the random factor of LoRA, and of the draws of `start: posterior`. The other factor is zero, so the fit starts at the
            unchanged law.
    """

    def __init__(
        self,
        operator: str = "pretrained",
        start: str = "encoder",
        init_from: str = "pretrained",
        start_draws: int = 160,
        rank: int = 16,
        alpha: float = 16.0,
        lr: float = 3e-3,
        latent_lr: float = 3e-2,
        prior_weight: float = 0.0,
        plausibility_weight: float = 1.0,
        seed: int = 0,
    ):
        super().__init__()
        for name, value in {"rank": rank, "prior_weight": prior_weight, "plausibility_weight": plausibility_weight, "lr": lr,
                            "latent_lr": latent_lr}.items():  # fmt: skip
            if not value >= 0:
                raise UserError(f"model.method.{name} = {value}: it must not be negative")
        for name, value in {"alpha": alpha, "start_draws": start_draws}.items():
            if not value > 0:
                raise UserError(f"model.method.{name} = {value}: it must be positive")
        self.start, self.rank, self.alpha, self.lr, self.latent_lr, self.seed = start, rank, alpha, lr, latent_lr, seed
        self.prior_weight, self.plausibility_weight, self.start_draws = prior_weight, plausibility_weight, start_draws
        self.tuned: nn.Module = IntrinsicDynamicsOperator.load(operator).eval().requires_grad_(False)
        self.fingerprint = self.operator.fingerprint()
        if start in ("encoder", "posterior"):
            encoder = DynamicsEncoder.load(init_from).requires_grad_(False)
            encoder.check_operator(self.operator, f"model.method.init_from = {init_from}")
            object.__setattr__(self, "encoder", encoder)  # shared by all scenes, not part of a checkpoint
        else:
            self._named_start()

    @property
    def operator(self) -> IntrinsicDynamicsOperator:
        """The operator, with the adapter layers in its trunks."""
        return self.tuned if isinstance(self.tuned, IntrinsicDynamicsOperator) else self.tuned.get_base_model()

    def _named_start(self) -> Tensor:
        """Return the latent that `start` names: the mean, a family, a trajectory of Stage I, or a law file."""
        latents = self.operator.latents
        own = [i for i, family in enumerate(self.operator.latent_families) if self.start in ("mean", family)]
        if own:
            return latents[own].mean(0)
        if not self.start.endswith(".safetensors"):
            if self.start not in self.operator.latent_names:
                families = sorted(set(self.operator.latent_families))
                known = ", ".join(["encoder", "posterior", "mean", *families, *self.operator.latent_names[:3]])
                raise UserError(f"model.method.start = {self.start!r}: one of {known}, ..., or a law file (.safetensors)")
            return self.operator.latent(self.start)
        _, tensors, _ = read_weights(self.start, (LAW_FORMAT,), "model.method.start")
        if "z" not in tensors or tensors["z"].shape != (self.operator.latent_dim,):
            raise UserError(f"model.method.start = {self.start} holds no latent of {self.operator.latent_dim} numbers")
        return tensors["z"]

    def build(self, scene: PreparedScene) -> None:
        """Create z at its initial value, and an adapter whose update is zero."""
        device = scene.images.device
        self.tuned.to(device)
        if self.encoder is not None:
            z = infer_latent(self.encoder.to(device), self.operator, scene, repeat=1).z
            if self.start == "posterior":
                z = explore(scene, self.operator, z, self.start_draws, self.seed).best
        else:
            z = self._named_start()
        self.z = nn.Parameter(z.detach().clone().to(device))
        self.origin: Tensor
        self.register_buffer("origin", self.z.detach().clone())
        if self.rank:
            from peft import LoraConfig, get_peft_model

            config = LoraConfig(r=self.rank, lora_alpha=self.alpha, target_modules=TARGETS)  # type: ignore[arg-type]
            with torch.random.fork_rng(devices=[]):
                torch.manual_seed(self.seed)
                self.tuned = get_peft_model(self.tuned.cpu(), config)

    def laws(self, scene: PreparedScene) -> Laws:
        return self.operator.laws(self.z)

    def parameter_groups(self) -> list[dict[str, Any]]:
        adapter = [p for name, p in self.trainable().items() if name != "z"]
        groups = [{"params": adapter, "lr": self.lr}, {"params": [self.z], "lr": self.latent_lr}]
        return [group for group in groups if group["params"]]

    def regulariser(self) -> Tensor | float:
        total = self.prior_weight * (self.z - self.origin).square().mean()
        if self.plausibility_weight:
            total = total + self.plausibility_weight * implausibility(self.operator, self.z)
        return total

    def recovery_loss(self) -> Tensor:
        """Return the squared distance of z from the mean latent of Stage I, whose law can be simulated, and of the adapter from zero."""
        stable = self.operator.latents.mean(0).to(self.z) if len(self.operator.latents) else torch.zeros_like(self.z)
        adapter = [p.square().mean() for name, p in self.trainable().items() if "lora_B" in name]
        return (self.z - stable).square().mean() + sum(adapter)

    def merged(self) -> IntrinsicDynamicsOperator:
        """Return an operator whose weights include the adapter, merged by PEFT."""
        tuned = copy.deepcopy(self.tuned)
        return tuned if isinstance(tuned, IntrinsicDynamicsOperator) else tuned.merge_and_unload()

    @torch.no_grad()
    def describe(self) -> dict[str, Any]:
        modulus = p_wave_modulus(self.operator, torch.stack([self.origin, self.z]))
        moved = float((self.z - self.origin).norm())
        return {"modulus": float(modulus[1]), "latent_moved": moved, "rank": self.rank, "latent": self.z.tolist()}

    def summary(self) -> str:
        with torch.no_grad():
            young, poisson = small_strain_moduli(self.operator, self.z.detach()[None])
        return str(Moduli(float(young[0]), float(poisson[0])))

    def save(self, folder: Path) -> None:
        """Write the two PEFT files, z, the law (`law_file.save_law`), and `method.json`."""
        folder.mkdir(parents=True, exist_ok=True)
        if self.rank:
            hidden = folder / f".{uuid.uuid4().hex}.tmp"
            self.tuned.save_pretrained(str(hidden), save_embedding_layers=False)
            for name in PEFT_FILES:
                os.replace(hidden / name, folder / name)
            for rest in hidden.iterdir():  # an empty model card
                rest.unlink()
            hidden.rmdir()
        write_tensors(folder / LATENT, {"z": self.z.detach().cpu().clone(), "origin": self.origin.cpu().clone()})
        save_law(folder / LAW, self.operator, self.z.detach())
        self.write_card(folder)

    def card(self) -> dict[str, Any]:
        return super().card() | {"operator": self.fingerprint}

    def load(self, folder: Path) -> None:
        """Load what `save` wrote; the stored rank takes precedence over the option.

        Raises:
            UserError: A file is missing or damaged, or the adapter belongs to another operator.
        """
        content = self.check_card(folder)
        if content.get("operator") != self.fingerprint:
            raise UserError(f"model.adapter: {folder} belongs to another operator ({content.get('operator')}, not {self.fingerprint})")
        latent = read_tensors(folder / LATENT)
        for name in ("z", "origin"):
            if name not in latent or latent[name].shape != self.z.shape:
                raise UserError(f"model.adapter: {folder / LATENT} holds no {name} of {len(self.z)} numbers")
        device = self.z.device
        with torch.no_grad():
            self.z.copy_(latent["z"])
            self.origin.copy_(latent["origin"])
        plain = copy.deepcopy(self.tuned)
        if not isinstance(plain, IntrinsicDynamicsOperator):
            plain = plain.unload()
            vars(plain).pop("peft_config", None)  # otherwise PEFT would consider it a second adapter
        self.rank = 0
        self.tuned = plain
        if (folder / PEFT_FILES[0]).exists() or content.get("found", {}).get("rank"):
            adapted = load_adapter(plain, folder).to(device)
            self.tuned, self.rank = adapted, int(adapted.peft_config["default"].r)


def load_adapter(operator: IntrinsicDynamicsOperator, folder: Path) -> "PeftModel":
    """Wrap the operator with an adapter in PEFT's format.

    Raises:
        UserError: A file is missing, damaged, or made for other layers.
    """
    from peft import PeftModel

    for name in PEFT_FILES:  # PEFT would try to download missing files
        if not (folder / name).is_file():
            raise UserError(f"model.adapter: {folder / name} is missing")
    try:
        return PeftModel.from_pretrained(operator, str(folder), is_trainable=True, torch_device="cpu")
    except (ValueError, RuntimeError, KeyError, TypeError, OSError) as error:
        raise UserError(f"model.adapter: {folder} holds no LoRA of this operator: {str(error).splitlines()[0]}") from error
    except Exception as error:
        if type(error).__name__ != "SafetensorError":
            raise
        raise UserError(f"model.adapter: {folder / PEFT_FILES[1]} is not a safetensors file: {error}") from error
