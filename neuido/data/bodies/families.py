"""The three families of materials that training data are made of: ranges of their parameters, and their laws."""

import math
from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor

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
    """Raise UserError for an unknown family, or for ranges of other parameters, reversed ranges and impossible ones."""
    if family not in PARAMETERS:
        raise UserError(f"unknown family {family!r} in families: choose from {', '.join(PARAMETERS)}")
    if set(ranges) != set(PARAMETERS[family]):
        raise UserError(f"families.{family} must give {', '.join(PARAMETERS[family])}, got {', '.join(ranges) or 'nothing'}")
    for name, bounds in ranges.items():
        low, high = bounds
        if low > high:
            raise UserError(f"families.{family}.{name} runs backwards: [{low}, {high}]; put the smaller figure first")
        floor, ceiling = LIMITS[name]
        if not (floor < low and high < ceiling):
            bounds = f"strictly between {floor:g} and {ceiling:g}"
            raise UserError(f"families.{family}.{name} = [{low}, {high}] is impossible: it must lie {bounds}")


def draw_parameters(family: str, ranges: Mapping[str, tuple[float, float]], random: np.random.Generator) -> dict[str, float]:
    """Draw the parameters of a family, each uniform over its range or log-uniform."""
    drawn = {}
    for name in PARAMETERS[family]:
        low, high = ranges[name]
        u = random.random()
        drawn[name] = float(low * (high / low) ** u) if name in LOGARITHMIC else float(low + (high - low) * u)
    return drawn


def laws(family: str, parameters: list[dict[str, float]]) -> tuple[ElasticLaw, PlasticLaw]:
    """Return the laws of several instances of one family as one batched pair (S = len(parameters))."""
    columns = {name: torch.tensor([p[name] for p in parameters], dtype=torch.float64) for name in PARAMETERS[family]}
    stiffness = {name: columns[name] for name in ("young", "poisson")}
    if family == "elastic":
        return FixedCorotated(**stiffness), Identity()
    return Sigma(**stiffness), VonMises(**columns) if family == "plasticine" else DruckerPrager(**columns)


def evaluate(law: ElasticLaw | PlasticLaw, F: Tensor) -> Tensor:
    """Evaluate a law of float32 F (..., 3, 3) in float64; return float32."""
    if isinstance(law, Identity):
        return F
    flat = F.reshape(-1, 3, 3).double()
    everywhere = Particles(torch.zeros(len(flat), dtype=torch.int32, device=F.device), (0, len(flat)))
    out = torch.empty_like(flat)
    law.forward(law.tensors(), flat, out, everywhere)
    return out.float().reshape(F.shape)
