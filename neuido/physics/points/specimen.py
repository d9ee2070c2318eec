"""A law with effects for several parameter sets at once."""

from typing import NamedTuple

import torch

from neuido.physics.effects.parameters import Effects
from neuido.physics.laws.base import ElasticLaw, PlasticLaw
from neuido.physics.laws.parametric import ParametricElastic
from neuido.physics.points.point_law import PointLaw
from neuido.types import Particles, brief_fields


class Specimen(NamedTuple):
    """A law with effects for P parameter sets."""

    elasticity: ElasticLaw
    """Elastic law."""
    plasticity: PlasticLaw | None
    """Plastic law; None: purely elastic."""
    effects: Effects
    """Effects beyond the laws; those that are forces are ignored."""
    points: int
    """Number of parameter sets P; each parameter of the laws and effects has one row for all, or P rows."""
    incompressible: bool = False
    """Whether the volume is constant, and the pressure such that the lateral stress is zero."""

    def law(self, each: int = 1) -> PointLaw:
        """Return the law for `each` particles per parameter set; those of one set are consecutive."""
        P = self.points
        particles = Particles(torch.arange(P, dtype=torch.int32).repeat_interleave(each), tuple(range(0, P * each + 1, each)))
        return PointLaw(self.elasticity, self.plasticity, self.effects, count=P * each, particles=particles)

    def __repr__(self) -> str:
        return brief_fields(self)


def is_classical(law: ElasticLaw) -> bool:
    """Return whether an elastic law is one of the isotropic classical ones."""
    return isinstance(law, ParametricElastic)
