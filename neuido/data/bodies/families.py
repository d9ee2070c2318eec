"""The three material families of the training data (elastic, plasticine, sand): parameter ranges, random draws and laws."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from neuido.data.files.values import file_name, mapping, number, require_key
from neuido.errors import UserError
from neuido.physics.laws.base import ElasticLaw, PlasticLaw
from neuido.physics.laws.classical import DruckerPrager, FixedCorotated, Identity, Sigma, VonMises
from neuido.types import Particles

PARAMETERS = {
    "elastic": ("young", "poisson"),
    "plasticine": ("young", "poisson", "yield_stress"),
    "sand": ("young", "poisson", "friction_angle"),
}
LOGARITHMIC = ("young", "yield_stress")
LIMITS = {"young": (0.0, math.inf), "poisson": (-1.0, 0.5), "yield_stress": (0.0, math.inf), "friction_angle": (0.0, 90.0)}
PUBLISHED = {
    "elastic": ("jelly", {"young": 1e5, "poisson": 0.2}),
    "plasticine": ("plasticine", {"young": 3e5, "poisson": 0.25, "yield_stress": 5e3}),
    "sand": ("sand", {"young": 1e6, "poisson": 0.2, "friction_angle": 25.0}),
}
"""NCLaw's published materials (its experiments/configs/env/blob), instance 0 of each family."""


def check_ranges(family: str, ranges: Mapping[str, tuple[float, float]]) -> None:
    """Check the parameter ranges of a material family.

    Args:
        family: `elastic`, `plasticine` or `sand`.
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
    """Draw random parameters of a family: `young` and `yield_stress` log-uniformly over their ranges, the others uniformly."""
    drawn = {}
    for name in PARAMETERS[family]:
        low, high = ranges[name]
        u = random.random()
        drawn[name] = float(low * (high / low) ** u) if name in LOGARITHMIC else float(low + (high - low) * u)
    return drawn


def laws(family: str, parameters: list[dict[str, float]]) -> tuple[ElasticLaw, PlasticLaw]:
    """Build the batched elastic and plastic law of S materials of one family.

    Args:
        family: `elastic`, `plasticine` or `sand`.
        parameters: Parameters of each of the S materials: young and yield_stress [Pa], poisson [-], friction_angle [degrees].
    """
    columns = {name: torch.tensor([p[name] for p in parameters], dtype=torch.float64) for name in PARAMETERS[family]}
    stiffness = {name: columns[name] for name in ("young", "poisson")}
    if family == "elastic":
        return FixedCorotated(**stiffness), Identity()
    return Sigma(**stiffness), VonMises(**columns) if family == "plasticine" else DruckerPrager(**columns)


def evaluate(law: ElasticLaw | PlasticLaw, F: Tensor) -> Tensor:
    """Evaluate a law in float64 at float32 deformation gradients F (..., 3, 3); return float32 of the same shape."""
    if isinstance(law, Identity):
        return F
    flat = F.reshape(-1, 3, 3).double()
    everywhere = Particles(torch.zeros(len(flat), dtype=torch.int32, device=F.device), (0, len(flat)))
    out = torch.empty_like(flat)
    law.forward(law.tensors(), flat, out, everywhere)
    return out.float().reshape(F.shape)
