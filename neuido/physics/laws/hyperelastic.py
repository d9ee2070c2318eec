"""Elastic laws of rubber (Mooney-Rivlin, Gent), of compressible foam (Ogden-Hill) and of a weakly compressible fluid.

A rollout runs them by the Warp kernels of `extended_kernels`; `twin` is the same law in plain torch. J = det F is bounded below by
`warp_functions.FLOOR`, so that an inverted body has a finite stress.

The bulk energy of both rubber laws is U = bulk/4 (J^2 - 1 - 2 ln J) of Simo and Taylor (1982), which grows without bound as J goes to zero
or to infinity; its Kirchhoff stress is bulk/2 (J^2 - 1) I.
"""

import torch
from torch import Tensor

from neuido.physics.laws import extended_kernels
from neuido.physics.laws.base import Parameter
from neuido.physics.laws.classical_kernels import LOCKED
from neuido.physics.laws.extended_kernels import GAMMA, LARGEST
from neuido.physics.laws.parametric import ParametricElastic, checked_parameters
from neuido.physics.linalg import decompositions as linalg
from neuido.physics.linalg.warp_functions import FLOOR


def _volume(F: Tensor) -> Tensor:
    """Return J = det F, bounded below by `FLOOR`, (..., 1, 1)."""
    return torch.linalg.det(F)[..., None, None].clamp(min=FLOOR)


def _rubber(F: Tensor, first: Tensor, second: Tensor, bulk: Tensor) -> Tensor:
    """Return 2 first dev(bbar) + 2 second dev(I1bar bbar - bbar^2) + bulk/2 (J^2 - 1) I, (..., 3, 3)."""
    J, eye = _volume(F), torch.eye(3, dtype=F.dtype, device=F.device)
    b = J ** (-2 / 3) * (F @ F.mT)
    M = 2 * first * b + 2 * second * (_trace(b) * b - b @ b)
    return M - _trace(M) / 3 * eye + bulk / 2 * (J.square() - 1) * eye


def _trace(A: Tensor) -> Tensor:
    return A.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None]


class MooneyRivlin(ParametricElastic):
    """Mooney-Rivlin rubber: W = c10 (I1bar - 3) + c01 (I2bar - 3) + U(J).

    I1bar and I2bar are the invariants of bbar = J^(-2/3) F F^T. The stress is tau = 2 c10 dev(bbar) + 2 c01 dev(I1bar bbar - bbar^2) +
    bulk/2 (J^2 - 1) I. The shear modulus at rest is 2 (c10 + c01). Source: Mooney 1940; Rivlin 1948.
    """

    kind = extended_kernels.MOONEY_RIVLIN
    columns = 3

    def __init__(self, c10: Parameter, c01: Parameter, bulk: Parameter):
        """
        Args:
            c10: First modulus [Pa], > 0.
            c01: Second modulus [Pa], >= 0; zero is a nearly incompressible neo-Hookean law.
            bulk: Bulk modulus at rest [Pa], > 0.

        Raises:
            UserError: A parameter out of its range.
        """
        self.c10, self.c01, self.bulk = checked_parameters(type(self), c10=c10, c01=c01, bulk=bulk)

    def tensors(self) -> tuple[Tensor, ...]:
        """Return c10, c01 and the bulk modulus [Pa], one tensor (S, 3)."""
        return (torch.stack([self.c10, self.c01, self.bulk], -1),)

    def moduli(self) -> tuple[Tensor, Tensor]:
        return 2 * (self.c10 + self.c01), self.bulk

    @staticmethod
    def twin(F: Tensor, parameters: Tensor) -> Tensor:
        return _rubber(F, *parameters[..., None, None].unbind(-3))


class Gent(ParametricElastic):
    """Gent's rubber of limited extensibility: W = -shear limit/2 ln(1 - (I1bar - 3)/limit) + U(J).

    The stress is tau = shear dev(bbar) / (1 - (I1bar - 3)/limit) + bulk/2 (J^2 - 1) I. It would be infinite where I1bar - 3 reaches the
    limit. The denominator is therefore bounded below by `classical_kernels.LOCKED` (0.05), as in the effect `strain_stiffening`: from
    I1bar - 3 = 0.95 limit on, the law is a neo-Hookean one of 20 times the shear modulus. Source: Gent 1996.
    """

    kind = extended_kernels.GENT
    columns = 3

    def __init__(self, shear: Parameter, limit: Parameter, bulk: Parameter):
        """
        Args:
            shear: Shear modulus at rest [Pa], > 0.
            limit: J_m, the value of I1bar - 3 that the chains of the rubber cannot exceed [-], > 0; 30 to 100 for natural rubber.
            bulk: Bulk modulus at rest [Pa], > 0.

        Raises:
            UserError: A parameter out of its range.
        """
        self.shear, self.limit, self.bulk = checked_parameters(type(self), shear=shear, limit=limit, bulk=bulk)

    def tensors(self) -> tuple[Tensor, ...]:
        """Return the shear modulus [Pa], the limit [-] and the bulk modulus [Pa], one tensor (S, 3)."""
        return (torch.stack([self.shear, self.limit, self.bulk], -1),)

    def moduli(self) -> tuple[Tensor, Tensor]:
        return self.shear, self.bulk

    @staticmethod
    def twin(F: Tensor, parameters: Tensor) -> Tensor:
        shear, limit, bulk = parameters[..., None, None].unbind(-3)
        x = _volume(F) ** (-2 / 3) * _trace(F @ F.mT) - 3
        first = shear / 2 / (1 - x / limit).clamp(min=LOCKED)
        return _rubber(F, first, torch.zeros_like(first), bulk)


class Hyperfoam(ParametricElastic):
    """Ogden-Hill foam of one term: W = 2 shear/a^2 (s1^a + s2^a + s3^a - 3 + (J^(-a b) - 1)/b) with the stretches s_i, a = exponent.

    b = poisson/(1 - 2 poisson); the ratio of lateral contraction is that of small strains at every strain. The principal stresses are
    tau_i = 2 shear/a (s_i^a - J^(-a b)). For b > 0 the energy grows without bound as J goes to zero or a stretch to infinity; J^(-a b) is
    bounded at exp(`extended_kernels.LARGEST`). The bulk modulus at rest is 2 shear (1/3 + b). Source: Hill 1978; Storåkers 1986.
    """

    kind = extended_kernels.HYPERFOAM
    columns = 3

    def __init__(self, shear: Parameter, exponent: Parameter, poisson: Parameter):
        """
        Args:
            shear: Shear modulus at rest [Pa], > 0.
            exponent: a [-], > 0; 2 to 8 for polymer foams, 2 is close to a Blatz-Ko material.
            poisson: Poisson's ratio [-], in (-1, 0.5).

        Raises:
            UserError: A parameter out of its range.
        """
        self.shear, self.exponent, self.poisson = checked_parameters(type(self), shear=shear, exponent=exponent, poisson=poisson)

    def tensors(self) -> tuple[Tensor, ...]:
        """Return the shear modulus [Pa], the exponent [-] and b [-], one tensor (S, 3)."""
        return (torch.stack([self.shear, self.exponent, self.poisson / (1 - 2 * self.poisson)], -1),)

    def moduli(self) -> tuple[Tensor, Tensor]:
        return self.shear, 2 * self.shear * (1 / 3 + self.poisson / (1 - 2 * self.poisson))

    @staticmethod
    def twin(F: Tensor, parameters: Tensor) -> Tensor:
        shear, a, b = parameters.unsqueeze(-2).unbind(-1)
        at = linalg.frame(F)
        e = at.sigma.clamp(min=FLOOR).log()
        volume = torch.expm1((-a * b * e.sum(-1, keepdim=True)).clamp(max=LARGEST))
        t = 2 * shear / a * (torch.expm1(a * e) - volume)
        slopes = (2 * shear).unsqueeze(-1) * linalg.exp_difference(a * e) * linalg.log_difference(at.sigma, FLOOR)
        return linalg.isotropic_stress(F, at, t, slopes)


class Fluid(ParametricElastic):
    """Weakly compressible fluid: pressure p = bulk/7 (J^-7 - 1), Kirchhoff stress tau = -J p I.

    The energy W = bulk/7 (J + J^-6/6 - 7/6) grows without bound as J goes to zero or to infinity. The tension of a stretched fluid is
    bounded by bulk/7. There is no viscosity: add the effect `viscosity_shear`. There is no memory of shape: use it with
    `VolumetricReset`, which removes the shear from F. Source: Tait's equation with Cole's exponent (Cole 1948; Monaghan 1994).
    """

    kind = extended_kernels.FLUID

    def __init__(self, bulk: Parameter):
        """
        Args:
            bulk: Bulk modulus at rest [Pa], > 0. The speed of sound is sqrt(bulk/density); ten times the fastest flow keeps the change of
                density below one per cent.

        Raises:
            UserError: The parameter is out of its range.
        """
        (self.bulk,) = checked_parameters(type(self), bulk=bulk)

    def tensors(self) -> tuple[Tensor, ...]:
        """Return the bulk modulus [Pa], one tensor (S, 1)."""
        return (self.bulk.unsqueeze(-1),)

    def moduli(self) -> tuple[Tensor, Tensor]:
        return torch.zeros_like(self.bulk), self.bulk

    @staticmethod
    def twin(F: Tensor, parameters: Tensor) -> Tensor:
        J = _volume(F)
        return parameters[..., None] / GAMMA * (J - J ** (1 - GAMMA)) * torch.eye(3, dtype=F.dtype, device=F.device)
