"""A sparse symbolic law found by regression, as a `Method`.

It stands where VisionLaw's search would (Lin et al. 2025), which needs a language model: no text is generated here. A stress is a
combination of generators times monomials of the strain invariants (`laws.neural.symbolic`), fitted through simulator and renderer; terms
that add little are dropped in rounds, and the rest is fitted again (sequential thresholding, Brunton et al. 2016).
"""

import math
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor, nn

from neuido.errors import UserError
from neuido.models.fewshot.method import Method, require_positive
from neuido.models.inference.prepared_scene import Laws, PreparedScene
from neuido.models.operator.law_properties import implausible_stress
from neuido.physics.laws.classical import lame
from neuido.physics.laws.neural.network_kernels import LINEAR
from neuido.physics.laws.neural.networks import STRAIN_SCALE, STRESS_SCALE, hencky_strain
from neuido.physics.laws.neural.symbolic import DEGREE, SymbolicElastic, SymbolicPlastic, formula, generators, polynomial
from neuido.types import ParticleState

UNREACHABLE, ZERO_RADIUS = 9.0, -30.0
"""Logarithms of a radius that no strain reaches, and of one that is zero."""

STRAIN = 0.3
"""Strain at which a term of any degree with the same number counts as much as the linear ones."""

SAMPLES = 4096
"""Deformation gradients on which the terms are weighed, about."""

REACHED = 1e-3
"""Share of these at the yield surface below which it does not count."""


class SparseLaw(Method):
    """28 terms of stress and three of a yield surface (cohesion, friction, a limit of expansion), fitted and thinned out.

    The start is Hencky's law. Where the scene's believed model yields (NeuMA chooses its networks by it too), there is a yield surface that
    is reached early: one that no particle reaches would never learn.

    Args:
        young, poisson: Start of the two linear terms [Pa], [-].
        yields: Whether there is a yield surface; `auto`: by the believed model.
        cohesion: Start of its radius in Hencky strain [-].
        friction: Start of the radius's growth with compression [-].
        expansion: Start of the largest expansion [-].
        threshold: Share of the stress's root mean square below which a term is dropped; of the radius, below which a yield term is.
        interval: Steps before the first round, and between two.
        rounds: Rounds of dropping; after the last one what is left is fitted to the end.
        sparsity: Weight of the sum of the sizes of all terms but the two linear ones.
        plausibility_weight: Keeps the stress where it can run (`law_properties.implausible_stress`).
        stiffness_rate, shape_rate, yield_rate: Rates of the stress's decimal logarithm, of its terms, and of the logarithms of the radii.

    Raises:
        UserError: A number outside its range.
    """

    steps = 300

    def __init__(
        self,
        young: float = 1e5,
        poisson: float = 0.25,
        yields: Literal["auto", "yes", "no"] = "auto",
        cohesion: float = 3e-2,
        friction: float = 0.2,
        expansion: float = 3e-2,
        threshold: float = 0.05,
        interval: int = 40,
        rounds: int = 4,
        sparsity: float = 1e-3,
        plausibility_weight: float = 1.0,
        stiffness_rate: float = 0.03,
        shape_rate: float = 0.02,
        yield_rate: float = 0.05,
    ):
        super().__init__()
        radii = {"cohesion": cohesion, "friction": friction, "expansion": expansion}
        require_positive(young=young, **radii, stiffness_rate=stiffness_rate, shape_rate=shape_rate, yield_rate=yield_rate)
        for name, value, most in (("poisson", poisson, 0.5), ("threshold", threshold, 1.0)):
            if not 0 < value < most:
                raise UserError(f"model.method.{name} = {value}: it must lie between 0 and {most:g}")
        if interval < 1 or min(rounds, sparsity, plausibility_weight) < 0:
            raise UserError(
                f"model.method: interval = {interval} must be 1 or more, rounds = {rounds} and sparsity = {sparsity} not negative"
            )
        self.young, self.poisson, self.yields, self.radii = young, poisson, yields, tuple(radii.values())
        self.threshold, self.interval, self.rounds, self.sparsity = threshold, interval, rounds, sparsity
        self.plausibility_weight = plausibility_weight
        self.rates = (stiffness_rate, shape_rate, yield_rate)

    def build(self, scene: PreparedScene) -> None:
        mu, lam = (float(t) for t in lame(torch.tensor(self.young), torch.tensor(self.poisson)))
        shape = torch.zeros(4, 7)
        shape[0, 0], shape[1, 0] = 1.0, 2 * mu / (lam + 2 * mu / 3)
        yields = self.yields == "yes" or (self.yields == "auto" and scene.source.model["plasticity"]["law"] != "identity")
        radii = [math.log10(radius / unit) for radius, unit in zip(self.radii, (STRAIN_SCALE, 1.0, STRAIN_SCALE))]
        self.level = nn.Parameter(torch.tensor(math.log10((lam + 2 * mu / 3) / STRESS_SCALE)))
        self.shape = nn.Parameter(shape)
        self.surface = nn.Parameter(torch.tensor(radii if yields else [UNREACHABLE, ZERO_RADIUS, UNREACHABLE]))
        self.register_buffer("gain", (1 / (LINEAR * STRAIN)) ** torch.tensor(DEGREE))
        self.register_buffer("active", torch.ones(4, 7))
        self.register_buffer("runs", torch.zeros((), dtype=torch.int64))
        self.register_buffer("keep", torch.ones(4, 7))
        self.register_buffer("becomes", torch.full((3,), math.nan))

    def coefficients(self) -> Tensor:
        """Return the coefficients of the stress terms, (4, 7); zero where a term was dropped."""
        return 10**self.level * self.active * self.shape * self.gain

    def laws(self, scene: PreparedScene) -> Laws:
        return SymbolicElastic(self.coefficients()[None]), SymbolicPlastic(10 ** self.surface[None, :, None])

    def rollout(self, scene: PreparedScene, frames: int, **options) -> ParticleState:
        """Simulate as `Method.rollout`; after each `interval` rollouts with gradients, select terms and drop the others before the next
        rollout.
        """
        fitting = torch.is_grad_enabled()
        if fitting:
            if self._selection_is_due():
                self.prune_terms()
            self.runs += 1
        motion = super().rollout(scene, frames, **options)
        if fitting and self._selection_is_due():
            F = motion.F.detach()[1:].reshape(-1, 3, 3)
            self.select_terms(F[:: max(1, len(F) // SAMPLES)])
        return motion

    def _selection_is_due(self) -> bool:
        runs = int(self.runs)
        return 0 < runs <= self.interval * self.rounds and runs % self.interval == 0

    @torch.no_grad()
    def select_terms(self, F: Tensor) -> None:
        """Select the terms that matter at deformation gradients (n, 3, 3) of a motion under the present law."""
        parts = torch.einsum("nk,ngij,gk->ngkij", polynomial(F), generators(F), self.coefficients())
        total = parts.sum((1, 2)).square().mean().sqrt()
        shares = parts.square().mean((0, 3, 4)).sqrt() / total.clamp(min=1e-30)
        self.keep.copy_(shares >= self.threshold)
        self.keep.view(-1)[shares.argmax()] = 1.0
        l, _, q = hencky_strain(F)
        c0, c1, c2 = (10**self.surface).unbind()
        cohesion, friction = STRAIN_SCALE * c0, c1 * (-l).clamp(min=0)
        flowed = q >= 0.98 * (cohesion + friction)  # a particle that flows is left at the surface
        share = (cohesion / (cohesion + friction))[flowed].mean()  # NaN where none flows: both comparisons are false
        never, expands = flowed.float().mean() < REACHED, (l >= 0.98 * STRAIN_SCALE * c2).float().mean() >= REACHED
        becomes = [torch.full_like(share, math.nan) for _ in range(3)]
        becomes[0] = becomes[0].masked_fill(share < self.threshold, ZERO_RADIUS).masked_fill(never, UNREACHABLE)
        becomes[1] = becomes[1].masked_fill((share > 1 - self.threshold) | never, ZERO_RADIUS)
        becomes[2] = becomes[2].masked_fill(~expands, UNREACHABLE)
        self.becomes.copy_(torch.stack(becomes))

    @torch.no_grad()
    def prune_terms(self) -> None:
        """Remove the terms that `select_terms` did not select."""
        self.active.mul_(self.keep)
        self.shape.mul_(self.active)
        self.surface.copy_(torch.where(self.becomes.isnan(), self.surface, self.becomes))

    def parameter_groups(self) -> list[dict[str, Any]]:
        return [{"params": [p], "lr": rate} for p, rate in zip((self.level, self.shape, self.surface), self.rates)]

    def regulariser(self) -> Tensor:
        size = (self.active * self.shape).abs()
        law = SymbolicElastic(self.coefficients()[None])
        return self.sparsity * (size.sum() - size[:2, 0].sum()) + self.plausibility_weight * implausible_stress(law, law.modulus()[0])

    def recovery_loss(self) -> Tensor:
        """Return the absolute distance of the remaining parameters from their start."""
        alive = (torch.ones_like(self.level), self.active, (self.surface.abs() < UNREACHABLE - 1).detach())
        ways = [(p - start.to(p)).mul(part).abs().sum() for p, start, part in zip(self.trainable().values(), self._start, alive)]
        return torch.stack(ways).sum()

    def save(self, folder: Path) -> None:
        with torch.no_grad():
            self.shape.mul_(self.active)  # zeros say what was dropped
        super().save(folder)

    def load(self, folder: Path) -> None:
        super().load(folder)
        self.active.copy_(self.shape != 0)

    def describe(self) -> dict[str, Any]:
        with torch.no_grad():
            stress, surface = self.coefficients(), 10**self.surface
            found = {"modulus": float(SymbolicElastic(stress[None]).modulus()[0]), "terms": int((stress != 0).sum())}
            radii = (STRAIN_SCALE * surface[0], surface[1], STRAIN_SCALE * surface[2])
        limits = {name: float(value) for name, value in zip(("cohesion", "friction", "expansion"), radii) if 1e-9 < float(value) < 1e3}
        return {"stress_kPa": formula(stress), **found, **limits}
