"""The stress of an isotropic law where the third axis stays: `PointLaw` in numpy, for stretches along the axes and for simple shear.

A path of hundreds of rows is computed row by row; small arrays take a tenth of the time that tensors do. The tests compare it with
`PointLaw`.
"""

import numpy as np
import torch

from neuido.physics.effects.coefficients import DRUCKER_PRAGER
from neuido.physics.laws.classical import FixedCorotated, NeoHookean, Sigma, VonMises
from neuido.physics.laws.classical_kernels import LOCKED
from neuido.physics.points.plane_tensors import (
    UNIT,
    as_matrix,
    dev,
    isotropic,
    left_cauchy,
    matmul,
    right_cauchy,
    square,
    trace,
    turned,
)
from neuido.physics.points.plastic_step import BACKSTRESSES, Flow, PlasticStep
from neuido.physics.points.point_law import DENSE
from neuido.physics.points.specimen import Specimen

LAWS = (NeoHookean, Sigma, FixedCorotated)
"""Elastic laws that are computed here."""
AT_REST = np.array([1.0, 0.0, 0.0, 1.0, 1.0])
"""The identity as a matrix."""


class PlaneEngine:
    """The stress of P parameter sets, `copies` states each; see `rig.Engine`.

    A state is a list of arrays (P, ...): total strains, the elastic F, Maxwell branches, alpha, backstress, e_max, backstresses that
    saturate, x_max, and ln U at the largest strain.
    """

    def __init__(self, specimen: Specimen, copies: int, *, shear: bool) -> None:
        self.points, self.copies, self.shear = specimen.points, copies, shear
        law = specimen.law()
        self.named, tables = law.named, law.tables
        self.kind = type(specimen.elasticity)
        self.values: dict[tuple[str, str], np.ndarray] = {}
        for name in specimen.effects.point or {}:
            effect, _, part = name.partition(".")
            self.values[effect, part] = self._each(law.value(effect, part))
        mu, lam = specimen.elasticity.tensors()[0].double().detach().unbind(-1)
        self.mu, self.lam = self._each(mu)[:, None], self._each(lam)[:, None]
        self.material = None if tables.material is None else self._each(tables.material)
        self.branches = None if tables.branches is None else self._each(tables.branches)
        flow = tables.flow if tables.flow is not None or law.plasticity is None else law.yields()
        self.layout = tables.layout
        self.backs = BACKSTRESSES if "nonlinear_backstress" in self.named else 0
        self.flow = None if flow is None else Flow(np, tuple(self._each(flow[:, :6]).T), self.value, self.backs)
        effects, like = specimen.effects, torch.zeros((), dtype=torch.float64)
        viscosity = effects.viscosity(self.points, like)
        self.viscosity = None if viscosity is None else self._each(viscosity)
        names = ("stiffness_change", "swelling")
        self.growth, self.swelling = (
            None if getattr(effects, n) is None else self._each(effects.rows(n, self.points, like)[:, 0]) for n in names
        )

    @staticmethod
    def serves(specimen: Specimen) -> bool:
        """Return whether a specimen is one of those that this engine knows."""
        flows = specimen.plasticity is None or specimen.plasticity.identity or isinstance(specimen.plasticity, VonMises)
        e = specimen.effects
        cone = DRUCKER_PRAGER in specimen.law().tables.kinds
        return flows and not cone and type(specimen.elasticity) in LAWS and e.fibre is None and e.stiffness is None

    def _each(self, rows: torch.Tensor) -> np.ndarray:
        """Return rows (P, ...) or (1, ...) for every copy, (P * copies, ...)."""
        own = rows.detach().double().expand(self.points, *rows.shape[1:]).numpy()
        return np.repeat(own, self.copies, 0)

    def value(self, effect: str, part: str) -> np.ndarray:
        """Return a parameter of an effect of `point_library`, (P * copies,); zero where absent."""
        return self.values.get((effect, part), np.zeros(self.points * self.copies))

    def start(self) -> list[np.ndarray]:
        """Return the state at rest."""
        P, zero, B, K = self.points, np.zeros, self.layout.branches, self.backs
        F = np.broadcast_to(AT_REST, (P, 5))
        return [zero((P, 4)), F, zero((P, B, 4)), zero(P), zero((P, 4)), zero(P), zero((P, K, 4)), zero(P), zero((P, 4))]

    def advance(self, begun: list[np.ndarray], total: np.ndarray, dt: float, now: float) -> tuple[np.ndarray, list[np.ndarray]]:
        """Return the stress and the states after a step; see `rig.Engine`."""
        before, F, q, alpha, beta, e_max, backs, x_max, kept = (np.repeat(part, self.copies, 0) for part in begun)
        new = total.reshape(-1, 4)
        step = new - before
        D = step.copy()
        if self.shear:
            slide = step[:, 3]
            one, zero = np.ones_like(slide), np.zeros_like(slide)
            F = matmul(np.stack([one, slide, zero, one, one], -1), F)
            D[:, 3] = slide / np.sqrt(2.0)
            if self.branches is not None or self.flow is not None:
                tangent = 0.25 * slide  # half of the half angle of the step, as in `constitutive.spin`
                sine, cosine = 2 * tangent / (1 + tangent**2), (1 - tangent**2) / (1 + tangent**2)
                beta = turned(beta, sine, cosine)
                q, backs = (turned(own, sine[:, None], cosine[:, None]) for own in (q, backs))
        else:
            F = F * np.exp(step[:, [0, 0, 1, 1, 2]])
        scale = np.ones(len(F)) if self.growth is None else np.exp(self.growth * now)
        if self.swelling is not None:
            size = 1 + self.swelling * now
            F = F * (size / (size + self.swelling * dt))[:, None]
        if self.branches is not None:
            T = self.branches[..., 1:]
            x = dt / T
            q = np.exp(-x) * q - T * np.expm1(-x) * dev(D)[:, None] / dt
        if self.flow is not None:
            f = self.flow
            trial = (f.two_mu * scale)[:, None] * dev(_log_stretch(left_cauchy(F))) - beta
            flow = PlasticStep(f, trial, backs, alpha, np.full(len(F), dt), scale)
            size = flow.solved()
            if size.any():
                moved, theta = flow.along(size)
                F = matmul(as_matrix(isotropic(-moved, np.exp)), F)
                alpha, beta = alpha + size if self.layout.alpha else alpha, beta + f.H_k[:, None] * moved
                if self.backs:
                    backs = theta[:, :, None] * (backs + f.h[:, :, None] * moved[:, None])
        if self.layout.e_max:
            e_max = np.maximum(e_max, np.sqrt((dev(_log_stretch(left_cauchy(F))) ** 2).sum(-1)))
        elastic = F
        if "permanent_set" in self.named:
            e = _log_stretch(right_cauchy(F))
            larger = (dev(e) ** 2).sum(-1) > (dev(kept) ** 2).sum(-1)
            kept = np.where(larger[:, None], e, kept)
            elastic = matmul(F, as_matrix(isotropic(-self.value("permanent_set", "share")[:, None] * kept, np.exp)))
        b = left_cauchy(elastic)
        J = np.sqrt((b[:, 0] * b[:, 1] - 0.5 * b[:, 3] ** 2) * b[:, 2])[:, None]
        bbar = J ** (-2 / 3) * b
        excess = np.maximum(trace(bbar)[:, 0] - 3, 0.0)
        if "mullins" in self.named:
            x_max = np.maximum(x_max, excess)
        t = self._stress(b, J, bbar, excess, q, e_max, x_max, now + dt)
        if self.viscosity is not None:
            shear, bulk = (own[:, None] for own in self.viscosity.T)
            t = t + J * (2 * shear * dev(D) + 3 * bulk * (D - dev(D))) / dt
        t = np.concatenate([t[:, :3], t[:, 3:] / np.sqrt(2.0)], -1).reshape(*total.shape[:-1], 4)
        return t, [new, F, q, alpha, beta, e_max, backs, x_max, kept]

    def _stress(
        self, b: np.ndarray, J: np.ndarray, bbar: np.ndarray, excess: np.ndarray, q: np.ndarray, e_max: np.ndarray, x_max: np.ndarray,
        time: float,
    ) -> np.ndarray:  # fmt: skip
        """Return the Kirchhoff stress without viscosity, (P, 4)."""
        mu, lam = self.mu, self.lam
        asymmetric = self.material is not None and bool(self.material[:, 2].any())
        if self.kind is NeoHookean:
            t = mu * (b - UNIT) + lam * np.log(J) * UNIT
        elif self.kind is Sigma:
            t = 2 * mu * _log_stretch(b) + lam * np.log(J) * UNIT
        else:
            t = 2 * mu * (b - isotropic(b, np.sqrt)) + lam * J * (J - 1) * UNIT
        scale = np.ones(len(b)) if self.growth is None else np.exp(self.growth * time)
        if self.material is not None:
            k, c, r, _f, _x, _y, _z, damage, lock = (column[:, None] for column in self.material.T)
            x = excess[:, None]
            t = t + k * x / np.maximum(1 - lock * x, LOCKED) * dev(bbar)
            if c.any():
                second = trace(bbar) * bbar - square(bbar)
                t = t + 3 * c / (trace(second) / 2) * dev(second)
            if asymmetric:
                t = t + r * isotropic(_log_stretch(b), lambda e: np.minimum(e, 0.0))
            if self.layout.e_max:
                scale = scale * np.exp(-damage[:, 0] * e_max)
        if "compaction" in self.named:
            lock = self.value("compaction", "lock")
            lock = np.where(lock > 0, lock, 1.0)
            squeezed = isotropic(_log_stretch(b), lambda e: _dense(np.maximum(-e, 0.0), lock))
            t = t - 2 * mu * self.value("compaction", "k")[:, None] * squeezed
        if "mullins" in self.named:
            share, width = self.value("mullins", "share"), self.value("mullins", "width")
            reach = np.where((width > 0) & (x_max > 0), width * x_max, 1.0)
            scale = scale * (1 - share * torch.erf(torch.from_numpy((x_max - excess) / reach)).numpy())
        if self.branches is not None:
            t = t + (self.branches[..., :1] * q).sum(1)
        return scale[:, None] * t


def _log_stretch(b: np.ndarray) -> np.ndarray:
    """Return ln V of b = V V, or ln U of U U, symmetric."""
    return isotropic(b, lambda value: 0.5 * np.log(value))


def _dense(x: np.ndarray, lock: np.ndarray) -> np.ndarray:
    return x**2 / np.maximum(lock - x, DENSE * lock)
