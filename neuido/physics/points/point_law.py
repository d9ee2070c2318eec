"""A law at material points with the effects that laboratories see, beyond those that bodies have (`effects.point_library`).

All of it is plain torch and differentiable by autograd.
"""

from typing import Any, NamedTuple

import torch
from torch import Tensor

from neuido.errors import UserError
from neuido.physics.effects.coefficients import VON_MISES, shear_modulus
from neuido.physics.effects.constitutive import Constitutive, History, deviator, expm, hencky, spin
from neuido.physics.laws.classical import VonMises
from neuido.physics.linalg import decompositions as linalg
from neuido.physics.linalg.warp_functions import FLOOR
from neuido.physics.points.plastic_step import BACKSTRESSES, Flow, PlasticStep

FLOW = ("creep", "nonlinear_backstress", "cyclic_hardening", "rate_power")
"""Effects on the plastic flow."""
MEMORY = ("mullins", "permanent_set")
"""Effects of the largest strain so far."""
DENSE = 0.02
"""Least distance of a compressive strain from the locking strain of `compaction`, relative to the latter, in its denominator."""
ALIKE = 1e-6
"""Relative difference of two stretches below which a divided difference is a derivative."""


class PointHistory(NamedTuple):
    """The history of P particles: that of `effects.constitutive.History`, and what the further effects remember."""

    branches: Tensor
    alpha: Tensor
    backstress: Tensor
    e_max: Tensor
    compaction: Tensor
    backs: Tensor
    """Backstresses that saturate [Pa], (P, K, 3, 3)."""
    x_max: Tensor
    """Largest I1bar - 3 so far [-], (P,)."""
    set: Tensor
    """ln U at the largest norm of the deviatoric strain so far [-], (P, 3, 3)."""


class PointLaw(Constitutive):
    """Elasticity, plasticity and all effects of a law at P material points; the arguments are those of `Constitutive`."""

    point = True

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        named = {name.partition(".")[0] for name in self.effects.point or {}}
        self.named = named
        """Effects of `point_library` that are given."""
        self.flows = bool(named & set(FLOW))
        self.remembers = bool(named & {*FLOW, *MEMORY}) or self.tables.layout.width > 0 or self.tables.flow is not None
        """Whether the stress depends on what came before."""
        if self.flows and self.tables.flow is None:
            self.tables = self.tables._replace(flow=self.yields(), kinds=(VON_MISES,) * (len(self.particles.offsets) - 1))
            self.plasticity = None
        if "cyclic_hardening" in named:
            self.tables = self.tables._replace(layout=self.tables.layout._replace(alpha=True))

    def yields(self) -> Tensor:
        """Return `Tables.flow` of the declared plasticity alone, (S, 8).

        Raises:
            UserError: The plasticity is neither that of von Mises nor none.
        """
        two_mu = 2 * self.shear()
        zero = torch.zeros_like(two_mu)
        inverse = zero
        if self.plasticity is not None:
            if not isinstance(self.plasticity, VonMises):
                raise UserError(f"{min(self.named)} needs a declared von_mises plasticity, or an elastic body")
            inverse = 1 / (two_mu * self.plasticity.tensors()[0].to(two_mu)[:, 0])
        return torch.stack([two_mu, inverse, *[zero] * 6], dim=1)

    def shear(self) -> Tensor:
        """Return the shear modulus of the base law of each scene [Pa], (S,)."""
        scenes = len(self.particles.offsets) - 1
        return shear_modulus(self.elasticity).to(self.like).reshape(-1).expand(scenes)

    def value(self, effect: str, part: str) -> Tensor:
        """Return a parameter of each particle, (P,); zero where absent."""
        scenes = len(self.particles.offsets) - 1
        return self.effects.point_rows(effect, part, scenes, self.like)[self.scene]

    def start(self) -> PointHistory:
        zero = self.like.new_zeros
        backs = BACKSTRESSES if "nonlinear_backstress" in self.named else 0
        return PointHistory(*super().start(), zero(self.count, backs, 3, 3), zero(self.count), zero(self.count, 3, 3))

    def _elastic(self, F: Tensor, history: PointHistory) -> tuple[Tensor, Tensor]:  # type: ignore[override]
        factor = self.like.new_ones(self.count)
        if "permanent_set" in self.named:
            F = F @ expm(-self.value("permanent_set", "share")[:, None, None] * history.set)
        if "mullins" in self.named:
            share, width = self.value("mullins", "share"), self.value("mullins", "width")
            reach = torch.where((width > 0) & (history.x_max > 0), width * history.x_max, 1.0)
            factor = 1 - share * torch.erf((history.x_max - _excess(F)).clamp(min=0) / reach)
        return F, factor

    def _further(self, F: Tensor) -> Tensor | None:
        if "compaction" not in self.named:
            return None
        k, lock = self.value("compaction", "k"), self.value("compaction", "lock")
        return compacted(F, 2 * self.shear()[self.scene] * k, torch.where(lock > 0, lock, 1.0))

    def advance(self, trial: Tensor, C: Tensor, history: PointHistory, dt: Tensor | float, time: Tensor | float = 0.0):  # type: ignore[override]
        if history.backs.shape[1]:
            step = torch.as_tensor(dt, dtype=self.like.dtype).expand(self.count)
            R = spin(C, step[:, None, None])[:, None]
            history = history._replace(backs=R @ history.backs @ R.mT)
        F, history = super().advance(trial, C, history, dt, time)  # type: ignore[arg-type, assignment]
        if "permanent_set" in self.named:
            e = hencky(F.mT)
            larger = (deviator(e) ** 2).sum((-2, -1)) > (deviator(history.set) ** 2).sum((-2, -1))
            history = history._replace(set=torch.where(larger[:, None, None], e, history.set))
        if "mullins" in self.named:
            history = history._replace(x_max=torch.maximum(history.x_max, _excess(self._elastic(F, history)[0])))
        return F, history

    def _flow(self, row: Tensor, trial: Tensor, history: Any, dt: Tensor, scale: Tensor) -> tuple[Tensor, History]:
        if not self.flows:
            return super()._flow(row, trial, history, dt, scale)
        flow = Flow(row[:, :6].unbind(1), self.value, history.backs.shape[1])
        trial_stress = (row[:, 0] * scale)[:, None, None] * deviator(hencky(trial)) - history.backstress
        step = PlasticStep(flow, trial_stress.flatten(1), history.backs.flatten(2), history.alpha, dt, scale)
        size = step.solved()
        moved, theta = step.along(size)
        moved = moved.reshape(-1, 3, 3)
        history = history._replace(
            alpha=history.alpha + size if self.tables.layout.alpha else history.alpha,
            backstress=history.backstress + flow.H_k[:, None, None] * moved,
            backs=theta[:, :, None, None] * (history.backs + flow.h[:, :, None, None] * moved[:, None]),
        )
        flows = (size > 0)[:, None, None]
        return torch.where(flows, expm(torch.where(flows, -moved, 0.0)) @ trial, trial), history


def _excess(F: Tensor) -> Tensor:
    """Return I1bar - 3 of F (P, 3, 3)."""
    J = torch.linalg.det(F)
    return (J ** (-2 / 3) * (F * F).sum((-2, -1)) - 3).clamp(min=0)


def compacted(F: Tensor, modulus: Tensor, lock: Tensor) -> Tensor:
    """Return the stress of `compaction`, -modulus x^2/(lock - x) along each principal compressive strain x, (P, 3, 3) [Pa].

    Args:
        F: Deformation gradient, (P, 3, 3).
        modulus: [Pa], (P,).
        lock: Locking strain [-], (P,).
    """
    at = linalg.frame(F)
    sigma = at.sigma.clamp(min=FLOOR)
    x = -sigma.clamp(max=1.0).log()
    lock, modulus = lock[:, None], modulus[:, None]
    left = lock - x
    room = left.clamp(min=DENSE * lock)
    t = -modulus * x**2 / room
    slope = (2 * x / room + torch.where(left > DENSE * lock, x**2 / room**2, 0.0)) * modulus / sigma
    gap = sigma.unsqueeze(-2) - sigma.unsqueeze(-1)
    near = gap.abs() < ALIKE * sigma.unsqueeze(-1)
    steep = 0.5 * (slope.unsqueeze(-1) + slope.unsqueeze(-2))
    slopes = torch.where(near, steep, (t.unsqueeze(-2) - t.unsqueeze(-1)) / torch.where(near, 1.0, gap))
    return linalg.isotropic_stress(F, at, t, slopes)
