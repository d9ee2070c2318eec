"""The classical elastic and plastic laws, for one material per scene.

A rollout runs them by the Warp kernels of `classical_kernels`; `twin` is the same law in plain torch.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from neuido.errors import UserError, suggest
from neuido.physics.laws import classical_kernels
from neuido.physics.laws.base import AutogradElastic, AutogradLaw, AutogradPlastic, ElasticLaw, Law, Parameter, PlasticLaw
from neuido.physics.laws.hyperelastic import Fluid, Gent, Hyperfoam, MooneyRivlin
from neuido.physics.laws.parametric import ParametricElastic, ParametricLaw, ParametricPlastic, checked_parameters, lame
from neuido.physics.laws.resets import Snow, VolumetricReset
from neuido.physics.linalg import decompositions as linalg
from neuido.physics.linalg.warp_functions import FLOOR

__all__ = [
    "AutogradElastic",
    "AutogradLaw",
    "AutogradPlastic",
    "DruckerPrager",
    "ElasticLaw",
    "FixedCorotated",
    "Fluid",
    "Gent",
    "Hyperfoam",
    "Identity",
    "Law",
    "MooneyRivlin",
    "NeoHookean",
    "PlasticLaw",
    "Sigma",
    "Snow",
    "StackedElastic",
    "StackedPlastic",
    "VolumetricReset",
    "VonMises",
    "lame",
    "material",
    "stack",
]


class _OfYoung(ParametricElastic):
    columns = 2

    def __init__(self, young: Parameter, poisson: Parameter):
        """
        Args:
            young: Young's modulus [Pa], > 0.
            poisson: Poisson's ratio [-], in (-1, 0.5).

        Raises:
            UserError: A parameter out of its range.
        """
        self.young, self.poisson = checked_parameters(type(self), young=young, poisson=poisson)

    def tensors(self) -> tuple[Tensor, ...]:
        """Return Lamé's parameters mu and lambda [Pa], one tensor (S, 2)."""
        return (torch.stack(lame(self.young, self.poisson), -1),)

    def moduli(self) -> tuple[Tensor, Tensor]:
        mu, lam = self.tensors()[0].unbind(1)
        return mu, lam + 2 / 3 * mu

    def modulus(self) -> Tensor:
        parameters = self.tensors()[0]
        return 2 * parameters[:, 0] + parameters[:, 1]


class FixedCorotated(_OfYoung):
    """Fixed corotated elasticity: tau = 2 mu (F - R) F^T + lambda J (J - 1) I.

    R is the rotation of the polar decomposition F = R S, and J = det F. Source: paper, appendix "Classical Material Models".
    """

    kind = classical_kernels.FIXED_COROTATED

    @staticmethod
    def twin(F: Tensor, parameters: Tensor) -> Tensor:
        mu, lam = parameters.unsqueeze(-2).unbind(-1)
        at = linalg.frame(F)
        sigma = at.sigma
        J = sigma.prod(-1, keepdim=True)
        t = 2 * mu * sigma * (sigma - 1) + lam * J * (J - 1)
        slopes = 2 * mu.unsqueeze(-1) * (sigma.unsqueeze(-1) + sigma.unsqueeze(-2) - 1)
        return linalg.isotropic_stress(F, at, t, slopes)


class Sigma(_OfYoung):
    """Hencky elasticity: tau = U diag(2 mu log sigma + lambda tr(log sigma)) U^T with F = U diag(sigma) V^T.

    The stress is linear in the logarithmic strain. Inside the logarithm, principal stretches are bounded below by
    `warp_functions.FLOOR`. Source: paper, appendix "Classical Material Models", Sigma Elasticity.
    """

    kind = classical_kernels.SIGMA

    @staticmethod
    def twin(F: Tensor, parameters: Tensor) -> Tensor:
        mu, lam = parameters.unsqueeze(-2).unbind(-1)
        at = linalg.frame(F)
        strain = at.sigma.clamp(min=FLOOR).log()
        t = 2 * mu * strain + lam * strain.sum(-1, keepdim=True)
        return linalg.isotropic_stress(F, at, t, 2 * mu.unsqueeze(-1) * linalg.log_difference(at.sigma, FLOOR))


class NeoHookean(_OfYoung):
    """Neo-Hookean elasticity: tau = mu (F F^T - I) + lambda ln(J) I with J = det F.

    Inside the logarithm, J is bounded below by `warp_functions.FLOOR`. Source: PAC-NeRF (Li et al. 2023).
    """

    kind = classical_kernels.NEO_HOOKEAN

    @staticmethod
    def twin(F: Tensor, parameters: Tensor) -> Tensor:
        mu, lam = parameters[..., None, None].unbind(-3)
        eye = torch.eye(3, dtype=F.dtype, device=F.device)
        J = torch.linalg.det(F)[..., None, None].clamp(min=FLOOR)
        return mu * (F @ F.mT - eye) + lam * J.log() * eye


class Identity(ParametricPlastic):
    """No plasticity: the corrected gradient is the trial F (paper, appendix, Identity Plasticity)."""

    kind = classical_kernels.IDENTITY
    identity = True

    def tensors(self) -> tuple[Tensor, ...]:
        """Return one placeholder (1, 1), since the law has no parameters."""
        return (torch.zeros(1, 1, dtype=torch.float64),)

    @staticmethod
    def twin(F: Tensor, parameters: Tensor) -> Tensor:
        return F.clone()


def _return(F: Tensor, at: linalg.Frame, radius: Tensor, strain: Tensor, elastic: Tensor) -> Tensor:
    """Return F with the norm of its deviatoric Hencky strain scaled to `radius` (..., 1), and F itself where `elastic` (...)."""
    mean = strain.mean(-1, keepdim=True)
    deviator = strain - mean
    # inside the yield surface the ratio is not used; a norm of 1 keeps its derivative finite at zero strain
    norm = torch.where(elastic.unsqueeze(-1), torch.ones_like(deviator), deviator).norm(dim=-1, keepdim=True)
    ratio = radius / norm
    h = mean + ratio * deviator
    slopes = linalg.exp_difference(h) * ratio.unsqueeze(-1) * linalg.log_difference(at.sigma, FLOOR)
    return torch.where(elastic[..., None, None], F, linalg.isotropic_map(F, at, h.exp(), slopes))


class VonMises(ParametricPlastic):
    """Von Mises plasticity: metal, clay.

    A deviatoric Hencky strain of norm above tau_Y / (2 mu) is scaled back to that norm. F is unchanged inside the yield surface, and
    det F never changes (for stretches above `warp_functions.FLOOR`). Source: paper, appendix, Von Mises Plasticity.
    """

    kind = classical_kernels.VON_MISES

    def __init__(self, yield_stress: Parameter, young: Parameter, poisson: Parameter):
        """
        Args:
            yield_stress: tau_Y [Pa], > 0, the norm of the deviatoric Kirchhoff stress at yield.
            young: Young's modulus [Pa], > 0.
            poisson: Poisson's ratio [-], in (-1, 0.5).

        Raises:
            UserError: A parameter out of its range.
        """
        self.yield_stress, self.young, self.poisson = checked_parameters(
            type(self), yield_stress=yield_stress, young=young, poisson=poisson
        )

    def tensors(self) -> tuple[Tensor, ...]:
        """Return the strain at yield tau_Y / (2 mu) [-], one tensor (S, 1)."""
        mu, _ = lame(self.young, self.poisson)
        return ((self.yield_stress / (2 * mu)).unsqueeze(-1),)

    @staticmethod
    def twin(F: Tensor, parameters: Tensor) -> Tensor:
        at = linalg.frame(F)
        strain = at.sigma.clamp(min=FLOOR).log()
        deviator = (strain - strain.mean(-1, keepdim=True)).detach().norm(dim=-1)
        return _return(F, at, parameters, strain, deviator <= parameters[..., 0].detach())


class DruckerPrager(ParametricPlastic):
    """Drucker-Prager plasticity: sand without cohesion.

    Under compression, a strain outside the cone of friction is returned to the cone. Under expansion the elastic stretch is reset to the
    identity, so that sand does not resist. F is unchanged inside the cone. Source: paper, appendix, Drucker-Prager Plasticity.
    """

    kind = classical_kernels.DRUCKER_PRAGER

    def __init__(self, friction_angle: Parameter, young: Parameter, poisson: Parameter):
        """
        Args:
            friction_angle: phi_f [degrees], in (0, 90).
            young: Young's modulus [Pa], > 0.
            poisson: Poisson's ratio [-], in (-1, 0.5).

        Raises:
            UserError: A parameter out of its range.
        """
        self.friction_angle, self.young, self.poisson = checked_parameters(
            type(self), friction_angle=friction_angle, young=young, poisson=poisson
        )

    def tensors(self) -> tuple[Tensor, ...]:
        """Return the slope of the cone in Hencky strain, alpha (3 lambda + 2 mu) / (2 mu) [-], one tensor (S, 1)."""
        mu, lam = lame(self.young, self.poisson)
        sine = torch.sin(torch.deg2rad(self.friction_angle))
        alpha = math.sqrt(2 / 3) * 2 * sine / (3 - sine)
        return ((alpha * (3 * lam + 2 * mu) / (2 * mu)).unsqueeze(-1),)

    @staticmethod
    def twin(F: Tensor, parameters: Tensor) -> Tensor:
        at = linalg.frame(F)
        strain = at.sigma.clamp(min=FLOOR).log()
        trace = strain.sum(-1, keepdim=True)
        deviator = (strain - trace / 3).detach().norm(dim=-1)
        radius = -parameters * trace
        expanding = trace.squeeze(-1) > 0
        elastic = expanding | (deviator <= radius.squeeze(-1))
        rotation = linalg.isotropic_map(F, at, torch.ones_like(strain), torch.zeros_like(F))
        return torch.where(expanding[..., None, None], rotation, _return(F, at, radius, strain, elastic))


class _Stacked(ParametricLaw):
    def __init__(self, laws: Sequence[ParametricLaw]):
        self.laws = tuple(laws)

    def tensors(self) -> tuple[Tensor, ...]:
        """Return the parameters of all laws, one tensor (S, n); rows of laws with fewer than n parameters end in zeros."""
        rows = [law.tensors()[0] for law in self.laws]
        width = max(own.shape[1] for own in rows)
        return (torch.cat([torch.nn.functional.pad(own, (0, width - own.shape[1])) for own in rows]),)

    def scene_laws(self) -> tuple[type[ParametricLaw], ...]:
        return sum((law.scene_laws() for law in self.laws), ())

    def __repr__(self) -> str:
        return f"{type(self).__name__}({', '.join(map(repr, self.laws))})"


class StackedElastic(_Stacked, ParametricElastic):
    """Elastic laws of several scenes as one law, so that the scenes run in one kernel launch; made by `stack`.

    Args:
        laws: Classical elastic laws, each for one or several scenes.
    """

    laws: tuple[ParametricElastic, ...]

    def moduli(self) -> tuple[Tensor, Tensor]:
        shear, bulk = zip(*(law.moduli() for law in self.laws))
        return torch.cat(shear), torch.cat(bulk)

    def modulus(self) -> Tensor:
        return torch.cat([law.modulus() for law in self.laws])


class StackedPlastic(_Stacked, ParametricPlastic):
    """Plastic laws of several scenes as one law, so that the scenes run in one kernel launch; made by `stack`.

    Args:
        laws: Classical plastic laws, each for one or several scenes.
    """

    def __init__(self, laws: Sequence[ParametricLaw]):
        super().__init__(laws)
        self.identity = all(law.identity for law in self.laws)


def stack(laws: Sequence[Law]) -> StackedElastic | StackedPlastic:
    """Combine classical laws into one law, so that scenes with different materials run in one kernel launch.

    Args:
        laws: Elastic laws, or plastic laws, of one or several scenes each.

    Returns:
        A law for the scenes of all `laws`, in their order.

    Raises:
        UserError: No laws, elastic and plastic laws together, or a law that is not classical.
    """
    names = [type(law).__name__ for law in laws]
    elastic = [law for law in laws if isinstance(law, ParametricElastic)]
    plastic = [law for law in laws if isinstance(law, ParametricPlastic)]
    if not laws or len(elastic) + len(plastic) < len(laws):
        raise UserError(f"stack() takes one or more classical laws, got {names}; run other laws in a simulator of their own")
    if not plastic:
        return StackedElastic(elastic)
    if not elastic:
        return StackedPlastic(plastic)
    raise UserError(f"stack() takes elastic laws or plastic laws, not both: {names}")


_OF_YOUNG = ("young", "poisson")
_ELASTIC = {
    "fixed_corotated": (FixedCorotated, _OF_YOUNG),
    "sigma": (Sigma, _OF_YOUNG),
    "neo_hookean": (NeoHookean, _OF_YOUNG),
    "mooney_rivlin": (MooneyRivlin, ("c10", "c01", "bulk")),
    "gent": (Gent, ("shear", "limit", "bulk")),
    "hyperfoam": (Hyperfoam, ("shear", "exponent", "poisson")),
    "fluid": (Fluid, ("bulk",)),
}
_PLASTIC = {
    "identity": (Identity, ()),
    "von_mises": (VonMises, ("yield_stress",)),
    "drucker_prager": (DruckerPrager, ("friction_angle",)),
    "volumetric_reset": (VolumetricReset, ()),
    "snow": (Snow, ("compression", "stretch")),
}
_WITH_STIFFNESS = ("von_mises", "drucker_prager")
"""Plastic laws that need Young's modulus and Poisson's ratio of the elasticity."""


def _named(section: str, given: Mapping[str, Any], laws: dict) -> tuple[type, dict[str, Any]]:
    name = given.get("law")
    if not isinstance(name, str) or name not in laws:
        raise UserError(f"{section}.law = {name!r} is not known{suggest(str(name), laws) or ';'} choose one of {', '.join(laws)}")
    law, accepted = laws[name]
    for key in given:
        if key not in ("law", *accepted):
            raise UserError(f"{section}.{key} is not a key of {name}; it takes {', '.join(('law', *accepted))}")
    for key in accepted:
        if key not in given:
            raise UserError(f"{section}.{key} is missing; {name} takes {', '.join(('law', *accepted))}")
    return law, {key: given[key] for key in accepted}


def material(elasticity: Mapping[str, Any], plasticity: Mapping[str, Any] | None = None) -> tuple[ElasticLaw, PlasticLaw]:
    """Create an elastic and a plastic law from the sections of an experiment or scene file.

    Args:
        elasticity: `law` with its parameters, numbers or tensors (S,): fixed_corotated, sigma or neo_hookean with `young` [Pa] and
            `poisson`; mooney_rivlin (`c10`, `c01`, `bulk` [Pa]), gent (`shear`, `bulk` [Pa], `limit`), hyperfoam (`shear` [Pa],
            `exponent`, `poisson`), fluid (`bulk` [Pa]).
        plasticity: `law`: identity, von_mises with `yield_stress` [Pa], drucker_prager with `friction_angle` [degrees], volumetric_reset,
            or snow with `compression` and `stretch`. von_mises and drucker_prager take `young` and `poisson` of the elasticity. None:
            identity.

    Raises:
        UserError: An unknown law, an unknown or missing key, a parameter out of its range, or a plastic law without the moduli it needs.
    """
    law, elastic = _named("elasticity", elasticity, _ELASTIC)
    pair = law(**elastic)
    plasticity = plasticity or {"law": "identity"}
    law, own = _named("plasticity", plasticity, _PLASTIC)
    if plasticity["law"] in _WITH_STIFFNESS:
        if set(elastic) != set(_OF_YOUNG):
            raise UserError(
                f"plasticity.law = {plasticity['law']} needs an elasticity of young and poisson (sigma, fixed_corotated or neo_hookean), "
                f"not {elasticity['law']}"
            )
        own |= elastic
    return pair, law(**own)
