"""The frozen operator and the encoder that is trained, as the modules of warm-up and Stage II begin with them."""

from collections.abc import Callable

import torch
from torch import Tensor

from neuido.errors import UserError
from neuido.models.operator.dynamics_operator import IntrinsicDynamicsOperator
from neuido.models.video.encoder import DynamicsEncoder
from neuido.physics.laws.neural.networks import hencky_strain


def open_branch(operator: str, init_from: str | None, vae: str, **sizes) -> tuple[IntrinsicDynamicsOperator, DynamicsEncoder]:
    """A frozen operator, and an encoder that reads latents for it.

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
            encoder.projector.start_at(frozen.latents)
    if encoder.projector.config["latent_dim"] != frozen.latent_dim:
        given = encoder.projector.config["latent_dim"]
        raise UserError(f"model.init_from = {init_from} gives latents of {given} numbers, operator = {operator} takes {frozen.latent_dim}")
    return frozen, encoder


def small_strain_modulus(operator: IntrinsicDynamicsOperator, z: Tensor, strain: float = 3e-3) -> Tensor:
    """P-wave modulus [Pa] (S,) of the laws of z (S, d), as a secant over F_11 = 1 +- strain; differentiable."""
    F = torch.eye(3, dtype=z.dtype, device=z.device).expand(len(z), 2, 3, 3).clone()
    F[:, 0, 0, 0] += strain
    F[:, 1, 0, 0] -= strain
    tau = operator.elastic(z, F)[..., 0, 0]
    return (tau[:, 0] - tau[:, 1]) / (2 * strain)


def implausibility(operator: IntrinsicDynamicsOperator, z: Tensor) -> Tensor:
    """`implausible_stress` of the elastic law of z (d,); zero for all laws of Stage I's kind."""
    modulus = small_strain_modulus(operator, z[None])[0]
    return implausible_stress(lambda F: operator.elastic(z[None], F[None])[0], modulus)


def implausible_stress(stress: Callable[[Tensor], Tensor], modulus: Tensor, samples: int = 48) -> Tensor:
    """How far an elastic law is from one that a rollout survives, at strains up to 0.4.

    A stress that points against its strain, or one more than three times the small-strain modulus times the strain, makes a body explode
    in some later contact, and images say so too late.

    Args:
        stress: F (n, 3, 3) -> tau (n, 3, 3) [Pa], differentiable in the law's parameters.
        modulus: P-wave modulus [Pa], ().
        samples: Deformation gradients, a third each of small, middle and large strains.
    """
    generator = torch.Generator().manual_seed(0)
    spread = torch.tensor([0.03, 0.1, 0.2]).repeat_interleave(samples // 3)[:, None, None]
    F = (torch.eye(3) + spread * torch.randn(3 * (samples // 3), 3, 3, generator=generator)).to(modulus)
    F = F[torch.linalg.det(F) > 0.2]
    tau = stress(F)
    l, A, _ = hencky_strain(F)
    strain = A + l[:, None, None] / 3 * torch.eye(3).to(modulus)
    work = (tau * strain).sum((1, 2)) / (tau.flatten(1).norm(dim=1) * strain.flatten(1).norm(dim=1) + 1e-6)
    stiff = tau.flatten(1).norm(dim=1) / (3 * modulus.clamp(min=1e3) * strain.flatten(1).norm(dim=1))
    return (0.1 - work).relu().mean() + stiff.clamp(min=1).log().square().mean()
