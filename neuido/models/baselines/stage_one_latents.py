"""Latents of the frozen operator without an encoder: the mean of Stage I, a random latent, and a latent fitted to images (UniPhy)."""

from typing import Any, Literal

import torch
from torch import nn

from neuido.data.files.renamed_options import renamed_options
from neuido.errors import UserError
from neuido.models.fewshot.method import Method, require_positive
from neuido.models.inference.prepared_scene import Laws, PreparedScene
from neuido.models.operator.dynamics_operator import IntrinsicDynamicsOperator
from neuido.models.operator.law_properties import p_wave_modulus


class LatentMethod(Method):
    """Base class of methods that choose a latent z of the frozen operator.

    Args:
        operator: File of the operator, or `pretrained`.
    """

    z: torch.Tensor

    def __init__(self, operator: str = "pretrained"):
        super().__init__()
        self.operator = IntrinsicDynamicsOperator.load(operator).eval().requires_grad_(False)
        if not len(self.operator.latents):
            raise UserError(f"model.method.operator = {operator} holds no latents of Stage I to start from")

    def laws(self, scene: PreparedScene) -> Laws:
        return self.operator.laws(self.z)

    def describe(self) -> dict[str, Any]:
        with torch.no_grad():
            modulus = float(p_wave_modulus(self.operator, self.z[None])[0])
        return {"modulus": modulus, "z": self.z.detach().cpu().tolist()}


class MeanLatent(LatentMethod):
    """Use the mean latent of Stage I for every scene; nothing is learned."""

    steps = 0

    def build(self, scene: PreparedScene) -> None:
        self.register_buffer("z", self.operator.latents.mean(0))


@renamed_options(of="distribution")
class RandomLatent(LatentMethod):
    """Use a random latent; nothing is learned.

    Args:
        operator: File of the operator, or `pretrained`.
        distribution: `normal` draws from a normal distribution with the mean and standard deviation of Stage I's latents; `trained`
            picks one of Stage I's latents.
        seed: Seed of the draw.
    """

    steps = 0

    def __init__(self, operator: str = "pretrained", distribution: Literal["normal", "trained"] = "normal", seed: int = 0):
        super().__init__(operator)
        self.distribution, self.seed = distribution, seed

    def build(self, scene: PreparedScene) -> None:
        generator, latents = torch.Generator().manual_seed(self.seed), self.operator.latents
        z = self.operator.random_latents(1, generator)[0]
        if self.distribution == "trained":
            z = latents[int(torch.randint(len(latents), (), generator=generator))].clone()
        self.register_buffer("z", z)


class UniPhy(LatentMethod):
    """Fit only the latent, starting at the mean latent, by gradients through simulator and renderer (UniPhy, Mittal et al. 2025).

    Trunks and heads are frozen. The weights of UniPhy's operator are not published, so ours, which is trained in the same way, is used.

    Args:
        operator: File of the operator, or `pretrained`.
        lr: Learning rate of the latent.
    """

    steps = 100

    def __init__(self, operator: str = "pretrained", lr: float = 0.05):
        super().__init__(operator)
        require_positive(lr=lr)
        self.lr = lr

    def build(self, scene: PreparedScene) -> None:
        self.z = nn.Parameter(self.operator.latents.mean(0).clone())
