"""From a family and its properties to a latent of the operator: regression over the materials of Stage I (not in the paper).

A latent that a network predicts from a video may lie where the operator was never trained. This one does not: it is a smooth function of
the properties through the latents of Stage I.
"""

from collections.abc import Mapping
from typing import NamedTuple

import torch
from torch import Tensor

from neuido.data.trajectories.generation import Setup, plan
from neuido.errors import UserError
from neuido.models.operator.dynamics_operator import IntrinsicDynamicsOperator
from neuido.models.stages.true_properties import properties_of
from neuido.models.video.material_properties import UNITS, to_scale

LENGTH = 3.0
"""Length scale of the Gaussian kernel, in standard deviations of the properties of a family."""
RIDGE = 1e-2
"""Variance of a latent that the properties do not explain, relative to the one that they do."""


class FamilyLatents(NamedTuple):
    """The materials of one family in Stage I."""

    names: tuple[str, ...]
    """Properties that the family has."""
    centre: Tensor
    """Mean of each property on the scale of `to_scale`, (p,) float64."""
    spread: Tensor
    """Standard deviation, (p,)."""
    points: Tensor
    """Standardised properties of the materials, (M, p)."""
    mean: Tensor
    """Mean latent, (d,)."""
    weights: Tensor
    """Latents, less their mean, in terms of the kernel, (M, d)."""

    def __call__(self, properties: Mapping[str, float]) -> Tensor:
        """Return the latent (d,) of properties; one that is not given has its mean, one beyond the materials is drawn back to them."""
        given = [to_scale(name, properties[name]) if name in properties else float(c) for name, c in zip(self.names, self.centre)]
        point = (torch.tensor(given, dtype=torch.float64) - self.centre) / self.spread
        point = point.clamp(self.points.amin(0), self.points.amax(0))
        return (self.mean + (_kernel(point[None], self.points) @ self.weights)[0]).float()


def property_latents(operator: IntrinsicDynamicsOperator) -> dict[str, FamilyLatents]:
    """Return a map from properties to latents for each family of an operator.

    Raises:
        UserError: The card of the operator does not say which materials it was trained on, or says of others.
    """
    families: dict[str, FamilyLatents] = {}
    found = {name: (family, parameters) for name, family, parameters in materials_of(operator)}
    for family in dict.fromkeys(operator.latent_families):
        own = [name for name, each in zip(operator.latent_names, operator.latent_families) if each == family]
        if not set(own) <= set(found):
            raise UserError("the operator has latents of materials that its card does not describe: train it again with `neuido fit`")
        rows = [properties_of(*found[name]) for name in own]
        names = tuple(name for name in UNITS if all(name in row for row in rows))
        values = torch.tensor([[to_scale(name, row[name]) for name in names] for row in rows], dtype=torch.float64)
        centre, spread = values.mean(0), values.std(0).clamp(min=1e-9)
        points = (values - centre) / spread
        z = torch.stack([operator.latent(name) for name in own]).detach().cpu().double()
        covariance = _kernel(points, points) + RIDGE * torch.eye(len(points), dtype=torch.float64)
        families[family] = FamilyLatents(names, centre, spread, points, z.mean(0), torch.linalg.solve(covariance, z - z.mean(0)))
    return families


def _kernel(a: Tensor, b: Tensor) -> Tensor:
    return (-torch.cdist(a, b).square() / (2 * LENGTH**2)).exp()


def materials_of(operator: IntrinsicDynamicsOperator) -> list[tuple[str, str, dict[str, float]]]:
    """Return name, family and parameters of the materials that the card of an operator says it was trained on."""
    content = operator.card.get("data")
    if not isinstance(content, dict) or not operator.latent_names:
        raise UserError("the operator's card does not say which materials it was trained on: train it again with `neuido fit`")
    try:
        families = {family: {name: tuple(pair) for name, pair in ranges.items()} for family, ranges in content["families"].items()}
        rest = {name: tuple(value) if isinstance(value, list) else value for name, value in content.items() if name != "families"}
        return [(each.name, each.family, each.parameters) for each in plan(Setup(families=families, **rest))]
    except (TypeError, KeyError, AttributeError) as error:
        raise UserError("the operator's card is of another version: train it again with `neuido fit`") from error
