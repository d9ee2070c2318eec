"""A law with effects at material points, in plain torch and differentiable by autograd.

It computes the same as the Warp kernels of this folder, which the tests compare with it. The order is that of a substep (paper, appendix
"Material Point Method"): first the stress of F and of the history; then, from the velocity gradient C and the trial gradient
F_tr = (I + dt C) F, the corrected gradient and the new history.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from neuido.physics.effects import coefficients
from neuido.physics.effects.coefficients import DRUCKER_PRAGER, VON_MISES
from neuido.physics.effects.history_functions import COMPACTED
from neuido.physics.effects.parameters import Effects
from neuido.physics.laws.base import ElasticLaw, PlasticLaw
from neuido.physics.laws.classical_kernels import LOCKED
from neuido.physics.linalg import decompositions as linalg
from neuido.physics.linalg.warp_functions import FLOOR
from neuido.types import Particles


class History(NamedTuple):
    """The history of P particles with B Maxwell branches; zero at the start."""

    branches: Tensor
    """Deviatoric strain of each Maxwell branch [-], (P, B, 3, 3)."""
    alpha: Tensor
    """Accumulated norm of the plastic strain [-], (P,)."""
    backstress: Tensor
    """Kirchhoff backstress [Pa], (P, 3, 3)."""
    e_max: Tensor
    """Largest norm of the deviatoric Hencky strain so far [-], (P,)."""
    compaction: Tensor
    """Logarithm of the plastic change of volume J_P [-], (P,)."""


def spin(C: Tensor, dt: Tensor | float) -> Tensor:
    """Compute the rotation of a step, (I - dt W/2)^-1 (I + dt W/2) with the spin W = (C - C^T) / 2, (P, 3, 3).

    Source: Hughes and Winget 1980, eq. 14.

    Args:
        C: Velocity gradient [1/s], (P, 3, 3).
        dt: Step [s].
    """
    Q = 0.25 * dt * (C - C.mT)
    size = 0.5 * (Q * Q).sum((-2, -1), keepdim=True)
    eye = torch.eye(3, dtype=C.dtype, device=C.device)
    return eye + 2 / (1 + size) * (Q + Q @ Q)


def deviator(A: Tensor) -> Tensor:
    """Return the deviator A - tr(A)/3 I, (..., 3, 3)."""
    eye = torch.eye(3, dtype=A.dtype, device=A.device)
    return A - A.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None] / 3 * eye


def _norm(A: Tensor) -> Tensor:
    """Return the Frobenius norm, (P,); its gradient is zero at A = 0."""
    square = (A * A).sum((-2, -1))
    return torch.where(square > 0, torch.where(square > 0, square, 1.0).sqrt(), 0.0)


def expm(A: Tensor) -> Tensor:
    """Compute exp(A) of matrices with |A| up to 5, (P, 3, 3), by the Taylor polynomial of degree 10 of A/16, squared four times.

    `torch.linalg.matrix_exp` of a single matrix in double precision has errors of up to 1e-10 near |A| = 0.05.
    """
    eye = torch.eye(3, dtype=A.dtype, device=A.device)
    small, out = A / 16, eye
    for n in range(10, 0, -1):
        out = eye + small @ out / n
    for _ in range(4):
        out = out @ out
    return out


def hencky(F: Tensor) -> Tensor:
    """Return the left Hencky strain ln V of F = V R, (P, 3, 3); stretches are bounded below by `warp_functions.FLOOR`."""
    at = linalg.frame(F)
    return linalg.isotropic_stress(F, at, at.sigma.clamp(min=FLOOR).log(), linalg.log_difference(at.sigma, FLOOR))


def compressive(F: Tensor) -> Tensor:
    """Return the negative part of the left Hencky strain, the sum of min(e_i, 0) n_i n_i over its eigenvalues e_i, (P, 3, 3)."""
    at = linalg.frame(F)
    sigma = at.sigma
    e = sigma.clamp(min=FLOOR, max=1.0).log()
    below = sigma < 1
    mixed = below.unsqueeze(-1) ^ below.unsqueeze(-2)
    gap = torch.where(mixed, sigma.unsqueeze(-2) - sigma.unsqueeze(-1), 1.0)
    both = below.unsqueeze(-1) & below.unsqueeze(-2)
    slopes = torch.where(mixed, (e.unsqueeze(-2) - e.unsqueeze(-1)) / gap, torch.where(both, linalg.log_difference(sigma, FLOOR), 0.0))
    return linalg.isotropic_stress(F, at, e, slopes)


def plastic_step(over: Tensor, total: Tensor, eta: Tensor, index: Tensor, dt: Tensor) -> Tensor:
    """Return the step g of plastic flow that solves over = total g + eta (g/dt)^index, (P,), differentiable.

    Args:
        over: Overstress of the trial [Pa], (P,), > 0.
        total: Sum of the moduli that resist the flow [Pa], (P,).
        eta: Viscosity [Pa s], (P,).
        index: Exponent [-], (P,).
        dt: Step [s], (P,).
    """
    with torch.no_grad():
        low, high = torch.zeros_like(over), over / total
        for _ in range(100):  # bisection, so that the twin shares no method with the kernel
            middle = (low + high) / 2
            beyond = total * middle + eta * (middle / dt) ** index > over
            low, high = torch.where(beyond, low, middle), torch.where(beyond, middle, high)
        found = high
        slope = total + eta * index * (found / dt) ** (index - 1) / dt
    # a step of Newton's method from the solution: it changes nothing, and has the derivatives of the implicit function
    return found - (total * found + eta * (found / dt) ** index - over) / slope


class Constitutive:
    """Elasticity, plasticity and effects of P particles.

    The laws and the parameters of the effects have one row for all particles, or one per scene. Effects that are forces (gravity, drag,
    ...) are ignored.

    Args:
        elasticity: Elastic base law.
        plasticity: Plastic base law, or None.
        effects: The effects.
        count: Number of particles P.
        dtype: Scalar type of the tables.
        shear_modulus: Shear modulus of the base law [Pa], () or (S,); `coefficients.shear_modulus` by default.
        particles: The scene of each particle; by default each particle is a scene of its own.

    Raises:
        UserError: As `coefficients.tables`.
    """

    point = False
    """Whether the effects that only a material point has are computed too (`points.point_law`)."""

    def __init__(
        self,
        elasticity: ElasticLaw,
        plasticity: PlasticLaw | None,
        effects: Effects,
        *,
        count: int,
        dtype: torch.dtype = torch.float64,
        shear_modulus: Tensor | float | None = None,
        particles: Particles | None = None,
    ) -> None:
        self.elasticity, self.effects, self.count = elasticity, effects, count
        like = torch.zeros((), dtype=dtype)
        if particles is None:
            particles = Particles(torch.arange(count, dtype=torch.int32), tuple(range(count + 1)))
        else:
            like = like.to(particles.scene.device)
        self.particles, self.like, self.scene = particles, like, particles.scene.long()
        scenes = len(particles.offsets) - 1
        self.tables = coefficients.tables(effects, elasticity, plasticity, scenes, like, shear=shear_modulus, point=self.point)
        self.plasticity = None if self.tables.flow is not None or plasticity is None or plasticity.identity else plasticity
        self._kinds = torch.tensor(self.tables.kinds, device=like.device)[self.scene] if self.tables.kinds else None
        viscosity = effects.viscosity(scenes, like)
        self._viscosity = None if viscosity is None else viscosity[self.scene]
        self._rate = None if effects.stiffness_change is None else effects.rows("stiffness_change", scenes, like)[self.scene, 0]
        self._swelling = None if effects.swelling is None else effects.rows("swelling", scenes, like)[self.scene, 0]
        self._stiffness = effects.particle_stiffness(count, like)

    def start(self) -> History:
        """Return a history of zeros."""
        zero = self.like.new_zeros
        rows = [zero(self.count) for _ in range(3)]
        return History(zero(self.count, self.tables.layout.branches, 3, 3), rows[0], zero(self.count, 3, 3), *rows[1:])

    def _scale(self, time: Tensor | float) -> Tensor:
        """Return the factor of the elastic stress that does not depend on the history, (P,)."""
        scale = self.like.new_ones(self.count)
        if self._stiffness is not None:
            scale = scale * self._stiffness
        if self._rate is not None:
            scale = scale * torch.exp(self._rate * time)
        return scale

    def _elastic(self, F: Tensor, history: History) -> tuple[Tensor, Tensor]:
        """Return the gradient that the elastic law sees, (P, 3, 3), and a factor on its stress, (P,)."""
        return F, self.like.new_ones(self.count)

    def _further(self, F: Tensor) -> Tensor | None:
        """Return a further elastic stress [Pa], (P, 3, 3); None where there is none."""
        return None

    def stress(self, F: Tensor, C: Tensor, history: History, time: Tensor | float = 0.0) -> Tensor:
        """Compute the Kirchhoff stress [Pa], (P, 3, 3), viscous stress included.

        Args:
            F: Elastic deformation gradient, (P, 3, 3).
            C: Velocity gradient [1/s], (P, 3, 3).
            history: The history at F.
            time: Time [s].
        """
        F, factor = self._elastic(F, history)
        tau = self.elasticity(F, self.particles)
        if (further := self._further(F)) is not None:
            tau = tau + further
        scale = self._scale(time) * factor
        if self.tables.material is not None:
            k, c, r, fibre, x, y, z, damage, lock, xi = self.tables.material[self.scene][..., None, None].unbind(1)
            J = torch.linalg.det(F)[:, None, None]
            bbar = J ** (-2 / 3) * (F @ F.mT)
            I1 = bbar.diagonal(dim1=1, dim2=2).sum(-1)[:, None, None]
            square = I1 * bbar - bbar @ bbar
            I2 = square.diagonal(dim1=1, dim2=2).sum(-1)[:, None, None] / 2
            tau = tau + k * (I1 - 3) / (1 - lock * (I1 - 3)).clamp(min=LOCKED) * deviator(bbar) + 3 * c / I2 * deviator(square)
            n = F @ torch.cat([x, y, z], dim=1)
            tau = tau + fibre * ((n * n).sum(1, keepdim=True) - 1) * (n @ n.mT)
            if self.tables.spectral:
                tau = tau + r * compressive(F)
            if self.tables.layout.e_max:
                scale = scale * torch.exp(-damage[:, 0, 0] * history.e_max)
            if self.tables.layout.compaction:
                scale = scale * torch.exp(xi[:, 0, 0] * (-torch.expm1(history.compaction)).clamp(max=1 - COMPACTED))
        if self.tables.branches is not None:
            tau = tau + (self.tables.branches[self.scene, :, 0, None, None] * history.branches).sum(1)
        tau = scale[:, None, None] * tau
        if self._viscosity is not None:
            shear, bulk = self._viscosity[..., None, None].unbind(1)
            D = 0.5 * (C + C.mT)
            tau = tau + torch.linalg.det(F)[:, None, None] * (2 * shear * deviator(D) + 3 * bulk * (D - deviator(D)))
        return tau

    def advance(self, trial: Tensor, C: Tensor, history: History, dt: Tensor | float, time: Tensor | float = 0.0) -> tuple[Tensor, History]:
        """Correct the trial deformation gradient and advance the history by one step.

        Args:
            trial: F_tr = (I + dt C) F, (P, 3, 3).
            C: Velocity gradient of the step [1/s], (P, 3, 3).
            history: The history before the step.
            dt: Step [s], a number or (P,).
            time: Time at the start of the step [s]; `swelling` and the `stiffness_change` of a body that yields depend on it.

        Returns:
            The corrected deformation gradient, (P, 3, 3), and the history after the step.
        """
        dt = torch.as_tensor(dt, dtype=self.like.dtype, device=self.like.device).expand(self.count)
        layout = self.tables.layout
        if self._swelling is not None:
            begun = 1 + self._swelling * time
            trial = (begun / (begun + self._swelling * dt))[:, None, None] * trial
        if self.tables.branches is not None or layout.backstress:
            R = spin(C, dt[:, None, None])
        if self.tables.branches is not None:
            T = self.tables.branches[self.scene, :, 1, None, None]
            x = dt[:, None, None, None] / T
            D = deviator(0.5 * (C + C.mT))[:, None]
            turned = R[:, None] @ history.branches @ R.mT[:, None]
            history = history._replace(branches=torch.exp(-x) * turned - T * torch.expm1(-x) * D)
        if self.tables.flow is not None:
            backstress = R @ history.backstress @ R.mT if layout.backstress else history.backstress
            F, history = self._flow(self.tables.flow[self.scene], trial, history._replace(backstress=backstress), dt, self._scale(time))
        else:
            F = trial if self.plasticity is None else self.plasticity(trial, self.particles)
        if layout.e_max:
            history = history._replace(e_max=torch.maximum(history.e_max, _norm(deviator(hencky(F)))))
        if layout.compaction:
            before, after = (torch.linalg.det(A).clamp(min=FLOOR).log() for A in (trial, F))
            history = history._replace(compaction=history.compaction + before - after)
        return F, history

    def _flow(self, row: Tensor, trial: Tensor, history: History, dt: Tensor, scale: Tensor) -> tuple[Tensor, History]:
        F = trial
        if VON_MISES in self.tables.kinds:
            two_mu, inverse, H, s, H_k, eta = row[:, :6].unbind(1)
            index = row[:, 8]
            two_mu = two_mu * scale
            xi = two_mu[:, None, None] * deviator(hencky(trial)) - history.backstress
            q = _norm(xi)
            soft = torch.exp(-s * history.alpha)
            limited = (inverse > 0) & (self._kinds == VON_MISES)
            limit = (1 / torch.where(limited, inverse, 1.0) + H * history.alpha) * soft
            flows = limited & (q > limit)
            over = torch.where(flows, q - limit, 1.0)
            increment = torch.where(flows, plastic_step(over, two_mu + H_k + H * soft, eta, index, dt), 0.0)
            direction = xi / torch.where(flows, q, 1.0)[:, None, None]
            step = increment[:, None, None] * direction
            F = torch.where(flows[:, None, None], expm(torch.where(flows[:, None, None], -step, 0.0)) @ trial, F)
            history = history._replace(
                alpha=history.alpha + increment if self.tables.layout.alpha else history.alpha,
                backstress=history.backstress + H_k[:, None, None] * step,
            )
        if DRUCKER_PRAGER in self.tables.kinds:
            slope, tip = row[:, 6:7], row[:, 7:8] / scale[:, None]
            at = linalg.frame(trial)
            e = at.sigma.clamp(min=FLOOR).log()
            trace = e.sum(-1, keepdim=True)
            dev = e - trace / 3
            radius = slope * (tip - trace)
            beyond = (trace > tip) & (self._kinds == DRUCKER_PRAGER)[:, None]
            outside = ~beyond & (dev.detach().norm(dim=-1, keepdim=True) > radius) & (self._kinds == DRUCKER_PRAGER)[:, None]
            ratio = radius / torch.where(outside, dev, 1.0).norm(dim=-1, keepdim=True)
            h = torch.where(beyond, (tip / 3).expand_as(e), trace / 3 + ratio * dev)
            slopes = linalg.exp_difference(h) * ratio[..., None] * linalg.log_difference(at.sigma, FLOOR)
            slopes = torch.where(beyond[..., None], 0.0, slopes)
            F = torch.where((beyond | outside)[..., None], linalg.isotropic_map(trial, at, h.exp(), slopes), F)
        return F, history
