"""Sparse regression of a symbolic law, as a `Method`.

It replaces the search of VisionLaw (Lin et al. 2025), which needs a language model. The stress is a linear combination of tensor
generators times monomials of the strain invariants (`laws.neural.symbolic`), fitted through simulator and renderer. Terms that contribute
little are removed in rounds, and the remaining terms are fitted again (sequential thresholding, Brunton et al. 2016).
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
"""Decimal logarithms of a yield radius that no strain reaches, and of a vanishing one."""

STRAIN = 0.3
"""Strain at which equal coefficients give terms of all degrees the same size."""

SAMPLES = 4096
"""Approximate number of deformation gradients on which terms are selected."""

REACHED = 1e-3
"""Fraction of these at the yield surface below which the surface counts as not reached."""


class SparseLaw(Method):
    """Fit 28 stress terms and three parameters of a yield surface (cohesion, friction, expansion limit) with sequential thresholding.

    The initial law is Hencky's. If the declared model of the scene is plastic (the criterion by which NeuMA selects its networks), the fit
    starts with a yield surface that is reached early, because a surface that no particle reaches has no gradient.

    Args:
        young, poisson: Initial values of the two linear terms [Pa], [-].
        yields: Whether there is a yield surface; `auto` follows the declared model.
        cohesion: Initial radius of the yield surface in Hencky strain [-].
        friction: Initial growth of the radius with compression [-].
        expansion: Initial limit of the expansion [-].
        threshold: Fraction of the RMS stress below which a stress term is removed, and fraction of the radius for a yield term.
        interval: Steps before the first round and between rounds.
        rounds: Number of rounds; after the last one the remaining terms are fitted until the end.
        sparsity: Weight of the L1 norm of all terms except the two linear ones.
        plausibility_weight: Weight of the penalty on stresses that a rollout would not survive (`law_properties.implausible_stress`).
        stiffness_rate, shape_rate, yield_rate: Learning rates of the decimal logarithm of the stress, of its terms, and of the logarithms
            of the radii.

    Raises:
        UserError: A number is out of range.
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
        for name, value, upper in (("poisson", poisson, 0.5), ("threshold", threshold, 1.0)):
            if not 0 < value < upper:
                raise UserError(f"model.method.{name} = {value}: it must lie between 0 and {upper:g}")
        if interval < 1 or min(rounds, sparsity, plausibility_weight) < 0:
            raise UserError(
                f"model.method: interval = {interval} must be at least 1, rounds = {rounds} and sparsity = {sparsity} not negative"
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
        self.gain: Tensor
        self.active: Tensor
        self.runs: Tensor
        self.keep: Tensor
        self.becomes: Tensor
        self.register_buffer("gain", (1 / (LINEAR * STRAIN)) ** torch.tensor(DEGREE))
        self.register_buffer("active", torch.ones(4, 7))
        self.register_buffer("runs", torch.zeros((), dtype=torch.int64))
        self.register_buffer("keep", torch.ones(4, 7))
        self.register_buffer("becomes", torch.full((3,), math.nan))

    def coefficients(self) -> Tensor:
        """Return the coefficients of the stress terms, (4, 7); zero for removed terms."""
        return 10**self.level * self.active * self.shape * self.gain

    def laws(self, scene: PreparedScene) -> Laws:
        return SymbolicElastic(self.coefficients()[None]), SymbolicPlastic(10 ** self.surface[None, :, None])

    def rollout(self, scene: PreparedScene, frames: int, **options) -> ParticleState:
        """Simulate as `Method.rollout`, with a round of term selection.

        After every `interval` rollouts with gradients the terms are selected; the others are removed before the next rollout.
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
        """Select the terms that matter at the deformation gradients (n, 3, 3) of a motion with the current law."""
        parts = torch.einsum("nk,ngij,gk->ngkij", polynomial(F), generators(F), self.coefficients())
        total = parts.sum((1, 2)).square().mean().sqrt()
        shares = parts.square().mean((0, 3, 4)).sqrt() / total.clamp(min=1e-30)
        self.keep.copy_(shares >= self.threshold)
        self.keep.view(-1)[shares.argmax()] = 1.0
        l, _, q = hencky_strain(F)
        c0, c1, c2 = (10**self.surface).unbind()
        cohesion, friction = STRAIN_SCALE * c0, c1 * (-l).clamp(min=0)
        flowed = q >= 0.98 * (cohesion + friction)  # plastic flow leaves a particle at the surface
        share = (cohesion / (cohesion + friction))[flowed].mean()  # NaN without flow, so that both comparisons are false
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
        """Return the L1 distance of the remaining parameters from their initial values."""
        alive = (torch.ones_like(self.level), self.active, (self.surface.abs() < UNREACHABLE - 1).detach())
        ways = [(p - start.to(p)).mul(part).abs().sum() for p, start, part in zip(self.trainable().values(), self._start, alive)]
        return torch.stack(ways).sum()

    def save(self, folder: Path) -> None:
        with torch.no_grad():
            self.shape.mul_(self.active)  # zeros mark the removed terms
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
