"""Plastic laws that reset the elastic gradient: of a fluid to a pure change of volume, of snow to bounded stretches.

A rollout runs them by the Warp kernels of `extended_kernels`; `twin` is the same law in plain torch.
"""

import torch
from torch import Tensor

from neuido.physics.laws import extended_kernels
from neuido.physics.laws.base import Parameter
from neuido.physics.laws.parametric import ParametricPlastic, checked_parameters
from neuido.physics.linalg import decompositions as linalg
from neuido.physics.linalg.warp_functions import FLOOR


class VolumetricReset(ParametricPlastic):
    """Fluid: the corrected gradient is J^(1/3) I with J = det F, bounded below by `warp_functions.FLOOR`.

    A fluid remembers its volume and nothing else. Source: Stomakhin et al. 2014, Augmented MPM for phase-change and varied materials.
    """

    kind = extended_kernels.VOLUMETRIC_RESET

    def tensors(self) -> tuple[Tensor, ...]:
        """Return one placeholder (1, 1), since the law has no parameters."""
        return (torch.zeros(1, 1, dtype=torch.float64),)

    @staticmethod
    def twin(F: Tensor, parameters: Tensor) -> Tensor:
        J = torch.linalg.det(F)[..., None, None].clamp(min=FLOOR)
        return J ** (1 / 3) * torch.eye(3, dtype=F.dtype, device=F.device)


class Snow(ParametricPlastic):
    """Snow: principal stretches of the elastic gradient are clamped to [1 - compression, 1 + stretch].

    F is unchanged where no stretch is clamped. The hardening of compacted snow is the effect `compaction_hardening`. Source: Stomakhin et
    al. 2013, A material point method for snow simulation, section 5; there compression is 0.025 and stretch 0.0075.
    """

    kind = extended_kernels.SNOW
    columns = 2

    def __init__(self, compression: Parameter, stretch: Parameter):
        """
        Args:
            compression: Critical compression theta_c [-], in (0, 1).
            stretch: Critical stretch theta_s [-], > 0.

        Raises:
            UserError: A parameter out of its range.
        """
        self.compression, self.stretch = checked_parameters(type(self), compression=compression, stretch=stretch)

    def tensors(self) -> tuple[Tensor, ...]:
        """Return the critical compression and the critical stretch [-], one tensor (S, 2)."""
        return (torch.stack([self.compression, self.stretch], -1),)

    @staticmethod
    def twin(F: Tensor, parameters: Tensor) -> Tensor:
        low, high = (1 - parameters[..., :1]), (1 + parameters[..., 1:])
        at = linalg.frame(F)
        z = torch.maximum(torch.minimum(at.sigma, high), low)
        inside = (at.sigma >= low) & (at.sigma <= high)
        gap = at.sigma.unsqueeze(-2) - at.sigma.unsqueeze(-1)
        apart = gap != 0
        slopes = torch.where(apart, (z.unsqueeze(-2) - z.unsqueeze(-1)) / torch.where(apart, gap, 1.0), inside.unsqueeze(-1).to(F))
        corrected = linalg.isotropic_map(F, at, z, slopes)
        return torch.where(inside.all(-1)[..., None, None], F, corrected)
