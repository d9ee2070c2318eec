"""The stress of a flat specimen: strain energies of the elastic laws and of the effects that act on them, written for the plane.

The deformation gradient of a triangle is F = [[a, b], [c, d]] in the plane and l across it, so that every energy is a function of five
numbers. `effects.constitutive` has the same effects in three dimensions; the tests compare the two.
"""

from collections.abc import Callable, Mapping
from copy import copy
from typing import Any, NamedTuple

import torch
from torch import Tensor

from neuido.errors import UserError, suggest
from neuido.physics.laws.base import ElasticLaw
from neuido.physics.laws.classical_kernels import LOCKED
from neuido.physics.laws.parametric import lame
from neuido.physics.plane.plane_yield import elastic_part, inverse, product

Five = tuple[Tensor, Tensor, Tensor, Tensor, Tensor]
"""Components 11, 12, 21, 22 and 33 of each triangle, (E,) each."""
COMPONENTS = ((0, 0), (0, 1), (1, 0), (1, 1), (2, 2))
"""Components of F that are not fixed by the plane, in their order."""
ROUND = 1e-4
"""Square of the relative difference of two stretches below which a series replaces the logarithm of their ratio; its error is 1e-17."""


class Moduli(NamedTuple):
    """Lamé's parameters and the bulk modulus [Pa]."""

    mu: Tensor
    lam: Tensor

    @property
    def bulk(self) -> Tensor:
        return self.lam + 2 / 3 * self.mu


def linear(F: Five, m: Moduli) -> Tensor:
    """Return the energy of small-strain elasticity [J/m^3]."""
    a, b, c, d, l = F
    trace = a + d + l - 3
    return 0.5 * m.lam * trace**2 + m.mu * ((a - 1) ** 2 + (d - 1) ** 2 + (l - 1) ** 2 + 0.5 * (b + c) ** 2)


def neo_hookean(F: Five, m: Moduli) -> Tensor:
    """Return mu/2 (I1 - 3) - mu ln J + lambda/2 (ln J)^2, the energy of `laws.NeoHookean`."""
    lnJ = _volume(F).log()
    return 0.5 * m.mu * (_square(F) - 3) - m.mu * lnJ + 0.5 * m.lam * lnJ**2


def decoupled_neo_hookean(F: Five, m: Moduli) -> Tensor:
    """Return mu/2 (J^(-2/3) I1 - 3) + K/2 (J - 1)^2, with shape and volume apart."""
    J = _volume(F)
    return 0.5 * m.mu * (J ** (-2 / 3) * _square(F) - 3) + 0.5 * m.bulk * (J - 1) ** 2


def fixed_corotated(F: Five, m: Moduli) -> Tensor:
    """Return mu |F - R|^2 + lambda/2 (J - 1)^2, the energy of `laws.FixedCorotated`."""
    a, b, c, d, l = F
    inner = a * d - b * c
    square = a**2 + b**2 + c**2 + d**2
    return m.mu * (square - 2 * (square + 2 * inner).sqrt() + 2 + (l - 1) ** 2) + 0.5 * m.lam * (inner * l - 1) ** 2


def sigma(F: Five, m: Moduli) -> Tensor:
    """Return mu |ln V|^2 + lambda/2 (ln J)^2, the energy of `laws.Sigma`."""
    a, b, c, d, l = F
    inner = a * d - b * c
    mean = 0.5 * (a**2 + b**2 + c**2 + d**2)
    ratio = (1 - (inner / mean) ** 2).clamp(min=0)
    near = ratio < ROUND
    far = torch.where(near, 0.5, ratio)
    apart = torch.where(near, ratio + 2 / 3 * ratio**2 + 23 / 45 * ratio**3 + 44 / 105 * ratio**4, far.sqrt().atanh() ** 2)
    area, across = inner.log(), l.log()
    return m.mu * (0.5 * area**2 + 0.5 * apart + across**2) + 0.5 * m.lam * (area + across) ** 2


ENERGIES: dict[str, Callable[[Five, Moduli], Tensor]] = {
    "linear": linear, "neo_hookean": neo_hookean, "decoupled_neo_hookean": decoupled_neo_hookean, "fixed_corotated": fixed_corotated,
    "sigma": sigma,
}  # fmt: skip
"""Energy of each elastic law that a plane specimen may declare."""
PARAMETERS = {
    "volumetric": ("share",),
    "geometric_nonlinearity": ("share",),
    "strain_stiffening": ("k",),
    "second_invariant": ("c",),
    "fibre": ("c", "azimuth", "elevation"),
    "stiffness_gradient": ("x", "y"),
    "yield": ("inverse",),
}
"""Parameters of the effects of the library that act in a plane specimen."""
EFFECTS = tuple(PARAMETERS)
"""Effects of the library that a plane specimen shows."""
LARGE = "decoupled_neo_hookean"
"""Law that `geometric_nonlinearity` leads to, with the same moduli."""


class PlaneLaw:
    """An elastic law with effects for the triangles of a plane specimen.

    Args:
        elasticity: `law` (a key of `ENERGIES`), `young` [Pa] and `poisson`; numbers or tensors of one value, which gradients reach.
        effects: Parameters of effects (`EFFECTS`) by name, such as {"strain_stiffening.k": 0.1}; numbers or tensors of one value.
        centres: Centres of the triangles at rest [m], (E, 2); `stiffness_gradient` needs them.

    Raises:
        UserError: The law or an effect is unknown, or a parameter is out of its range.
    """

    def __init__(self, elasticity: Mapping[str, Any], effects: Mapping[str, Any] | None = None, *, centres: Tensor | None = None) -> None:
        name = str(elasticity.get("law"))
        if name not in ENERGIES:
            raise UserError(f"elasticity.law = {name!r} is not known{suggest(name, ENERGIES) or ';'} choose one of {', '.join(ENERGIES)}")
        young, poisson = (torch.as_tensor(elasticity[key], dtype=torch.float64).reshape(()) for key in ("young", "poisson"))
        if not float(young.detach()) > 0 or not -1 < float(poisson.detach()) < 0.5:
            raise UserError(f"young = {young.item():g} must be positive, and poisson = {poisson.item():g} between -1 and 0.5")
        self.name = name
        self.moduli = Moduli(*lame(young, poisson))
        self._values = {key: torch.as_tensor(value, dtype=torch.float64).reshape(()) for key, value in (effects or {}).items()}
        for key in self._values:
            effect, _, part = key.partition(".")
            if effect not in EFFECTS:
                raise UserError(f"{key} is no effect of a plane specimen: choose from {', '.join(EFFECTS)}")
            if part not in PARAMETERS[effect]:
                raise UserError(f"{key} is not a parameter of {effect} in the plane, which has {', '.join(PARAMETERS[effect])}")
        self._named = {key.partition(".")[0] for key in self._values}
        self.turns = name == "linear" and self._named <= {"fibre", "stiffness_gradient"}
        """Whether the energy stays finite where a triangle turns inside out, as in small-strain elasticity at large strain."""
        self.yields = float(self._value("yield", "inverse").detach()) > 0
        """Whether the stress depends on what was before, so that a motion is followed in parts (`after`)."""
        self.plastic: Tensor | None = None
        """Inverse of the plastic part of the gradient before the step, (E, 5); None where nothing yielded."""
        self._differentiable = any(t.requires_grad for t in (young, poisson, *self._values.values()))
        self._factor = None
        if "stiffness_gradient" in self._named:
            if centres is None:
                raise UserError("stiffness_gradient needs the centres of the triangles")
            slope = torch.stack([self._value("stiffness_gradient", a) for a in "xy"])
            extent = (centres.amax(0) - centres.amin(0)).max()
            self._factor = torch.exp((centres - centres.mean(0)) @ slope / extent)  # as `effects.linear_gradient`

    def _value(self, effect: str, part: str) -> Tensor:
        return self._values.get(f"{effect}.{part}", torch.zeros((), dtype=torch.float64))

    def after(self, F: Tensor) -> "PlaneLaw":
        """Return the law after a step to gradients (E, 5); it is this one where nothing can yield."""
        if not self.yields:
            return self
        own = copy(self)
        own.plastic = torch.stack(product(inverse(F.unbind(1)), self._elastic(F.unbind(1))), 1)  # type: ignore[arg-type]
        return own

    def _elastic(self, F: Five) -> Five:
        """Return the elastic part of gradients."""
        trial = F if self.plastic is None else product(F, self.plastic.unbind(1))  # type: ignore[arg-type]
        two_mu = 2 * self.moduli.mu * (1.0 if self._factor is None else self._factor)
        return elastic_part(trial, two_mu, self._value("yield", "inverse"))

    def _first(self, F: Five, *, create_graph: bool) -> tuple[Tensor, ...]:
        """Return the first Piola-Kirchhoff stress [Pa] of gradients that need derivatives; that of the elastic part, P F_e^T F^-T."""
        if not self.yields:
            return torch.autograd.grad(self.energy(F).sum(), F, create_graph=create_graph)
        own = tuple(part.requires_grad_() if part.is_leaf else part for part in self._elastic(F))
        P = torch.autograd.grad(self.energy(own).sum(), own, create_graph=True)  # type: ignore[arg-type]
        a, b, c, d, l = own
        p, q, r, s, m = product(P, (a, c, b, d, l))  # type: ignore[arg-type]
        i, j, k, n, o = inverse(F)
        return product((p, q, r, s, m), (i, k, j, n, o))

    def energy(self, F: Five) -> Tensor:
        """Return the strain energy of each triangle per volume at rest [J/m^3], (E,)."""
        W, m = ENERGIES[self.name](F, self.moduli), self.moduli
        share = self._value("volumetric", "share")
        if "geometric_nonlinearity" in self._named:
            large = ENERGIES[LARGE](F, m)
            if "volumetric" in self._named:
                large = large + share * (neo_hookean(F, m) - large)
            W = W + self._value("geometric_nonlinearity", "share") * (large - W)
        elif "volumetric" in self._named:
            W = W + share * self._other_volume(F, W)
        if "strain_stiffening" in self._named:
            W = W + m.mu * _stiffened(_volume(F) ** (-2 / 3) * _square(F) - 3, self._value("strain_stiffening", "k"))
        if "second_invariant" in self._named:
            a, b, c, d, l = F
            I2 = (a**2 + b**2 + c**2 + d**2) * l**2 + (a * d - b * c) ** 2
            W = W + 1.5 * m.mu * self._value("second_invariant", "c") * (_volume(F) ** (-4 / 3) * I2 / 3).log()
        if "fibre" in self._named:
            a, b, c, d, _ = F
            at = self._value("fibre", "elevation")
            x, y = at.cos() * self._value("fibre", "azimuth").cos(), at.sin()
            W = W + 0.25 * self._value("fibre", "c") * ((a * x + b * y) ** 2 + (c * x + d * y) ** 2 - 1) ** 2
        return W if self._factor is None else W * self._factor

    def _other_volume(self, F: Five, W: Tensor) -> Tensor:
        """Return what replaces the dependence on the volume by the other one in use, (E,)."""
        m = self.moduli
        if self.name in ("neo_hookean", "decoupled_neo_hookean"):
            return (decoupled_neo_hookean if self.name == "neo_hookean" else neo_hookean)(F, m) - W
        J = _volume(F)
        change = 0.5 * m.lam * (J.log() ** 2 - (J - 1) ** 2)
        return -change if self.name == "sigma" else change

    def stress(self, F: Tensor) -> Tensor:
        """Return the first Piola-Kirchhoff stress [Pa], (E, 5), of gradients (E, 5); differentiable in both and in the parameters."""
        kept = F.requires_grad or self._differentiable
        with torch.enable_grad():
            at = [part.contiguous() if part.requires_grad else part.detach().contiguous().requires_grad_() for part in F.unbind(1)]
            P = self._first(tuple(at), create_graph=kept)  # type: ignore[arg-type]
        return torch.stack(P, 1) if kept else torch.stack(P, 1).detach()

    def across(self, F: Tensor) -> tuple[Tensor, Tensor]:
        """Return the stress across the plane (E,) [Pa] and its derivative by the stretch of the thickness (E,), both detached."""
        with torch.enable_grad():
            stretch = F[:, 4].detach().requires_grad_()
            P = self.stress(torch.cat([F[:, :4].detach(), stretch[:, None]], 1))[:, 4]
            slope = torch.autograd.grad(P.sum(), stretch)[0]
        return P.detach(), slope

    def tangent(self, F: Tensor) -> tuple[Tensor, Tensor]:
        """Return the stress (E, 5) [Pa] and its derivative by the gradient (E, 5, 5), both detached."""
        with torch.enable_grad():
            at = [part.detach().contiguous().requires_grad_() for part in F.unbind(1)]
            P = self._first(tuple(at), create_graph=True)  # type: ignore[arg-type]
            rows = [torch.autograd.grad(P[i].sum(), at, retain_graph=i < 4, materialize_grads=True) for i in range(5)]
        return torch.stack(P, 1).detach(), torch.stack([torch.stack(row, 1) for row in rows], 1)


class SpatialLaw:
    """An elastic law of three dimensions, or one's own, for the triangles of a plane specimen.

    Args:
        law: The law, for one scene.
    """

    turns = False

    def __init__(self, law: ElasticLaw) -> None:
        self.law = law

    def stress(self, F: Tensor) -> Tensor:
        """Return the first Piola-Kirchhoff stress [Pa], (E, 5), of gradients (E, 5)."""
        a, b, c, d, l = F.unbind(1)
        zero = torch.zeros_like(l)
        whole = torch.stack([torch.stack(row, 1) for row in ((a, b, zero), (c, d, zero), (zero, zero, l))], 1)
        P = torch.linalg.solve(whole, self.law(whole).mT).mT  # tau F^-T
        return torch.stack([P[:, i, j] for i, j in COMPONENTS], 1)

    def across(self, F: Tensor) -> tuple[Tensor, Tensor]:
        """Return the stress across the plane (E,) [Pa] and its derivative by the stretch of the thickness (E,), both detached."""
        with torch.enable_grad():
            stretch = F[:, 4].detach().requires_grad_()
            P = self.stress(torch.cat([F[:, :4].detach(), stretch[:, None]], 1))[:, 4]
            slope = torch.autograd.grad(P.sum(), stretch)[0]
        return P.detach(), slope

    def tangent(self, F: Tensor) -> tuple[Tensor, Tensor]:
        """Return the stress (E, 5) [Pa] and its derivative by the gradient (E, 5, 5), both detached."""
        with torch.enable_grad():
            at = F.detach().requires_grad_()
            P = self.stress(at)
            rows = [torch.autograd.grad(P[:, i].sum(), at, retain_graph=i < 4)[0] for i in range(5)]
        return P.detach(), torch.stack(rows, 1)


def _square(F: Five) -> Tensor:
    """Return I1 = |F|^2, (E,)."""
    a, b, c, d, l = F
    return a**2 + b**2 + c**2 + d**2 + l**2


def _volume(F: Five) -> Tensor:
    """Return J = det F, (E,)."""
    a, b, c, d, l = F
    return (a * d - b * c) * l


def _stiffened(x: Tensor, k: Tensor) -> Tensor:
    """Return the energy of `strain_stiffening` over mu for x = I1bar - 3, (E,): half the integral of k x/(1 - k x), bounded at `LOCKED`."""
    if float(k.detach()) == 0:
        return 0.25 * k * x**2  # the first order, for its derivative by k
    free = 1 - k * x
    end = (1 - LOCKED) / k
    inside = torch.where(free > LOCKED, free, 0.5)
    beyond = -torch.as_tensor(LOCKED).log() / k - end + 0.5 * k / LOCKED * (x**2 - end**2)
    return 0.5 * torch.where(free > LOCKED, -inside.log() / k - x, beyond)
