"""Properties of a learned law: its small-strain moduli, and a penalty on laws that a rollout would not survive."""

import functools
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from neuido.data.files.values import with_prefix
from neuido.models.operator.dynamics_operator import IntrinsicDynamicsOperator
from neuido.physics.laws.neural.networks import hencky_strain

SECANT = 3e-3
"""Strain of the secants that give small-strain moduli."""
SAMPLES = 48
"""Number of deformation gradients of the penalty, a third each at small, medium and large strains."""


class Moduli(NamedTuple):
    """Elastic constants at small strains."""

    young: float
    """Young's modulus E [Pa]."""
    poisson: float
    """Poisson's ratio [-]."""

    def __str__(self) -> str:
        return f"E = {with_prefix(self.young, 'Pa')}, nu = {self.poisson:.3f} (small strain)"


def small_strain_moduli(operator: IntrinsicDynamicsOperator, z: Tensor, strain: float = SECANT) -> tuple[Tensor, Tensor]:
    """Return Young's modulus [Pa] (S,) and Poisson's ratio [-] (S,) of the elastic laws of z (S, d).

    The Lame parameters are secants over F = I +- strain e_a e_a^T, averaged over the three axes a. For an anisotropic law (the trunk `raw`)
    they are therefore averages.
    """
    axes = strain * torch.diag_embed(torch.eye(3, dtype=z.dtype, device=z.device))
    F = torch.eye(3, dtype=z.dtype, device=z.device) + torch.cat([axes, -axes])
    tau = operator.elastic(z, F.expand(len(z), 6, 3, 3).contiguous()).diagonal(dim1=-2, dim2=-1)
    response = (tau[:, :3] - tau[:, 3:]) / (2 * strain)
    along = response.diagonal(dim1=-2, dim2=-1).mean(-1)
    lam = (response.sum((-2, -1)) - 3 * along) / 6
    mu = (along - lam) / 2
    return mu * (3 * lam + 2 * mu) / (lam + mu), lam / (2 * (lam + mu))


def p_wave_modulus(operator: IntrinsicDynamicsOperator, z: Tensor, strain: float = SECANT) -> Tensor:
    """Return the P-wave modulus [Pa] (S,) of the laws of z (S, d), as a secant over F_11 = 1 +- strain; differentiable."""
    F = _pulls(strain, z.dtype, z.device)
    return _secant(operator.elastic(z, F.expand(len(z), 2, 3, 3).contiguous()), strain)


@functools.lru_cache(maxsize=8)
def _pulls(strain: float, dtype: torch.dtype, device: torch.device) -> Tensor:
    """Return the deformation gradients F_11 = 1 +- strain, (2, 3, 3): constants, as `_probes`."""
    with torch.inference_mode(False), torch.no_grad():
        F = torch.eye(3, dtype=dtype).expand(2, 3, 3).clone()
        F[0, 0, 0] += strain
        F[1, 0, 0] -= strain
    return F.to(device)


def _secant(tau: Tensor, strain: float) -> Tensor:
    """Return the modulus (...) of the stresses (..., 2, 3, 3) at `_pulls`."""
    return (tau[..., 0, 0, 0] - tau[..., 1, 0, 0]) / (2 * strain)


def implausibility(operator: IntrinsicDynamicsOperator, z: Tensor) -> Tensor:
    """Return `implausible_stress` of the elastic law of z (d,); it vanishes for laws like those of Stage I.

    The law is evaluated once, for the modulus and for the penalty: on a GPU the time of such a call is that of its launches.
    """
    pulls, (F, strain) = _pulls(SECANT, z.dtype, z.device), _probes(SAMPLES, z.dtype, z.device)
    tau = operator.elastic(z[None], torch.cat([pulls, F])[None])[0]
    return _penalty(tau[2:], strain, _secant(tau[:2], SECANT))


def implausible_stress(stress: Callable[[Tensor], Tensor], modulus: Tensor) -> Tensor:
    """Return a penalty on elastic laws that a rollout would not survive, evaluated at strains up to 0.4.

    A body becomes unstable in a later contact if the stress opposes the strain, or if it exceeds three times the product of small-strain
    modulus and strain. The images show this too late.

    Args:
        stress: Function from F (n, 3, 3) to tau (n, 3, 3) [Pa], differentiable in the parameters of the law.
        modulus: P-wave modulus [Pa], ().
    """
    F, strain = _probes(SAMPLES, modulus.dtype, modulus.device)
    return _penalty(stress(F), strain, modulus)


def _penalty(tau: Tensor, strain: Tensor, modulus: Tensor) -> Tensor:
    """Return the penalty on the stresses tau (n, 3, 3) at strains (n, 3, 3)."""
    work = (tau * strain).sum((1, 2)) / (tau.flatten(1).norm(dim=1) * strain.flatten(1).norm(dim=1) + 1e-6)
    stiff = tau.flatten(1).norm(dim=1) / (3 * modulus.clamp(min=1e3) * strain.flatten(1).norm(dim=1))
    return (0.1 - work).relu().mean() + stiff.clamp(min=1).log().square().mean()


@functools.lru_cache(maxsize=8)
def _probes(samples: int, dtype: torch.dtype, device: torch.device) -> tuple[Tensor, Tensor]:
    """Return the deformation gradients of `implausible_stress` and their strains, (n, 3, 3) each.

    They are constants: made for each call, they would stop the host until the device is idle.
    """
    generator = torch.Generator().manual_seed(0)
    spread = torch.tensor([0.03, 0.1, 0.2]).repeat_interleave(samples // 3)[:, None, None]
    with torch.inference_mode(False), torch.no_grad():
        F = (torch.eye(3) + spread * torch.randn(3 * (samples // 3), 3, 3, generator=generator)).to(dtype)
        F = F[torch.linalg.det(F) > 0.2]
        l, A, _ = hencky_strain(F)
        strain = A + l[:, None, None] / 3 * torch.eye(3, dtype=dtype)
    return F.to(device), strain.to(device)
