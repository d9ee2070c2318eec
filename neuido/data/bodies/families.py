"""The material families of the training data: parameter ranges, random draws, laws, and the effects that depend on the rate.

`elastic`, `plasticine` and `sand` are those of the paper. `rubber` is Mooney-Rivlin, `foam` Ogden-Hill, `fluid` Newtonian and weakly
compressible, `viscoplastic` Herschel-Bulkley (honey, paste), `snow` Stomakhin's.
"""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from neuido.data.files.values import file_name, mapping, number, require_key
from neuido.errors import UserError
from neuido.physics.effects.parameters import Effects
from neuido.physics.laws.base import ElasticLaw, PlasticLaw
from neuido.physics.laws.classical import DruckerPrager, FixedCorotated, Identity, Sigma, VonMises
from neuido.physics.laws.hyperelastic import Fluid, Hyperfoam, MooneyRivlin
from neuido.physics.laws.parametric import lame
from neuido.physics.laws.resets import Snow, VolumetricReset
from neuido.physics.linalg.decompositions import polar
from neuido.types import Particles

PARAMETERS = {
    "elastic": ("young", "poisson"),
    "plasticine": ("young", "poisson", "yield_stress"),
    "sand": ("young", "poisson", "friction_angle"),
    "rubber": ("young", "poisson", "share"),
    "foam": ("young", "poisson", "exponent"),
    "fluid": ("bulk", "viscosity"),
    "viscoplastic": ("young", "poisson", "yield_stress", "viscosity", "index"),
    "snow": ("young", "poisson", "compression", "stretch", "hardening"),
}
"""Parameters of each family: young, bulk and yield_stress [Pa], friction_angle [degrees], viscosity [Pa s], the others [-]. `share` is
c01/(c10 + c01) of Mooney-Rivlin, `exponent` Ogden's; viscosity and `index` n make the shear stress viscosity r (r/r0)^(n - 1) of a shear
rate r, r0 = 1/s; `compression` and `stretch` bound the elastic stretches of snow, and `hardening` is Stomakhin's xi."""
LOGARITHMIC = ("young", "yield_stress", "bulk", "viscosity")
LIMITS = {
    "young": (0.0, math.inf),
    "poisson": (-1.0, 0.5),
    "yield_stress": (0.0, math.inf),
    "friction_angle": (0.0, 90.0),
    "share": (0.0, 1.0),
    "exponent": (0.0, math.inf),
    "bulk": (0.0, math.inf),
    "viscosity": (0.0, math.inf),
    "index": (0.1, math.inf),
    "compression": (0.0, 1.0),
    "stretch": (0.0, math.inf),
    "hardening": (0.0, math.inf),
}
PUBLISHED = {
    "elastic": ("jelly", {"young": 1e5, "poisson": 0.2}),
    "plasticine": ("plasticine", {"young": 3e5, "poisson": 0.25, "yield_stress": 5e3}),
    "sand": ("sand", {"young": 1e6, "poisson": 0.2, "friction_angle": 25.0}),
}
"""NCLaw's published materials (its experiments/configs/env/blob), instance 0 of a family; the other families have none."""


def check_ranges(family: str, ranges: Mapping[str, tuple[float, float]]) -> None:
    """Check the parameter ranges of a material family.

    Args:
        family: One of `PARAMETERS`.
        ranges: (low, high) of each parameter in `PARAMETERS[family]`.

    Raises:
        UserError: The family is unknown, a parameter is missing or unknown, low exceeds high, or a bound is outside `LIMITS`.
    """
    if family not in PARAMETERS:
        raise UserError(f"families has the unknown family {family!r}: choose from {', '.join(PARAMETERS)}")
    if set(ranges) != set(PARAMETERS[family]):
        raise UserError(f"families.{family} must give a range for {', '.join(PARAMETERS[family])}; got {', '.join(ranges) or 'none'}")
    for name, bounds in ranges.items():
        low, high = bounds
        if low > high:
            raise UserError(f"families.{family}.{name} = [{low}, {high}]: the lower bound exceeds the upper bound; swap them")
        floor, ceiling = LIMITS[name]
        if not (floor < low and high < ceiling):
            raise UserError(f"families.{family}.{name} = [{low}, {high}]: both bounds must lie strictly between {floor:g} and {ceiling:g}")


def check_entry(entry: dict[str, Any], where: str) -> None:
    """Check the name, the family and the parameters of an entry of a file that lists bodies of drawn material.

    Raises:
        UserError: A key is missing, the name or the family cannot name a file, or a parameter is not a number.
    """
    for key in ("name", "family"):
        file_name(require_key(entry, key, where), f"{where}.{key}")
    for key, value in mapping(require_key(entry, "parameters", where), f"{where}.parameters").items():
        number(value, f"{where}.parameters.{key}")


def draw_parameters(family: str, ranges: Mapping[str, tuple[float, float]], random: np.random.Generator) -> dict[str, float]:
    """Draw random parameters of a family: those of `LOGARITHMIC` log-uniformly over their ranges, the others uniformly."""
    drawn = {}
    for name in PARAMETERS[family]:
        low, high = ranges[name]
        u = random.random()
        drawn[name] = float(low * (high / low) ** u) if name in LOGARITHMIC else float(low + (high - low) * u)
    return drawn


def laws(family: str, parameters: list[dict[str, float]]) -> tuple[ElasticLaw, PlasticLaw]:
    """Build the batched elastic and plastic law of S materials of one family; `effects` returns what depends on the rate.

    Args:
        family: One of `PARAMETERS`.
        parameters: Parameters of each of the S materials, as in `PARAMETERS`.
    """
    given = _columns(family, parameters)
    if family == "fluid":
        return Fluid(given["bulk"]), VolumetricReset()
    stiffness = {name: given[name] for name in ("young", "poisson")}
    shear, _ = lame(**stiffness)
    if family == "elastic":
        return FixedCorotated(**stiffness), Identity()
    if family == "rubber":
        bulk = given["young"] / (3 * (1 - 2 * given["poisson"]))
        return MooneyRivlin(shear / 2 * (1 - given["share"]), shear / 2 * given["share"], bulk), Identity()
    if family == "foam":
        return Hyperfoam(shear, given["exponent"], given["poisson"]), Identity()
    if family == "snow":
        return FixedCorotated(**stiffness), Snow(given["compression"], given["stretch"])
    if family == "sand":
        return Sigma(**stiffness), DruckerPrager(given["friction_angle"], **stiffness)
    return Sigma(**stiffness), VonMises(given["yield_stress"], **stiffness)


def effects(family: str, parameters: list[dict[str, float]]) -> Effects | None:
    """Return the effects beside the laws of S materials of one family, for `Simulator.rollout(..., effects=)`; None without any.

    A fluid has a viscosity; a viscoplastic material a rate-dependent yield stress with a power-law index; snow hardens as it is compacted.

    Args:
        family: One of `PARAMETERS`.
        parameters: As for `laws`.
    """
    given = _columns(family, parameters)
    if family == "fluid":
        return Effects(viscosity_shear=given["viscosity"])
    if family == "viscoplastic":
        # the norms of stress and strain rate in simple shear are sqrt(2) times the shear stress and 1/sqrt(2) times the shear rate
        index = given["index"]
        return Effects(rate_yield=given["viscosity"] * 2 ** ((index + 1) / 2), yield_index=index)
    if family == "snow":
        return Effects(compaction_hardening=given["hardening"])
    return None


def _columns(family: str, parameters: list[dict[str, float]]) -> dict[str, Tensor]:
    """Return each parameter of a family as a tensor (S,)."""
    return {name: torch.tensor([p[name] for p in parameters], dtype=torch.float64) for name in PARAMETERS[family]}


def evaluate(law: ElasticLaw | PlasticLaw, F: Tensor) -> Tensor:
    """Evaluate a law in float64 at float32 deformation gradients F (..., 3, 3); return float32 of the same shape."""
    if isinstance(law, Identity):
        return F
    flat = F.reshape(-1, 3, 3).double()
    everywhere = Particles(torch.zeros(len(flat), dtype=torch.int32, device=F.device), (0, len(flat)))
    out = torch.empty_like(flat)
    law.forward(law.tensors(), flat, out, everywhere)
    return out.float().reshape(F.shape)


def sample_laws(elastic: ElasticLaw, plastic: PlasticLaw, F: Tensor, C: Tensor, dt: float) -> tuple[Tensor, Tensor, Tensor]:
    """Sample the laws of one material at the trial gradients of a substep: trial and corrected F, and Kirchhoff stress [Pa].

    The laws are evaluated in float64 at the trial gradients in float32, so the targets are exact for what is stored. The correction of a
    fluid keeps the rotation of the trial gradient here, which its stress does not feel: so it is frame-indifferent, as those of the other
    families are.

    Args:
        elastic, plastic: The laws.
        F: Deformation gradients before the substep, (..., 3, 3).
        C: Velocity gradients in it [1/s], (..., 3, 3).
        dt: The substep [s].

    Returns:
        Three tensors of the shape of F, float32.
    """
    trial = (F.double() + dt * C.double() @ F.double()).float()
    corrected = evaluate(plastic, trial)
    if isinstance(plastic, VolumetricReset):
        corrected = (polar(trial.double())[0] @ corrected.double()).float()
    return trial, corrected, evaluate(elastic, corrected)
