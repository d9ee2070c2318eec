"""Symbolic laws: an isotropic stress with polynomial coefficients, and a yield surface with constant ones.

They have the form of the objective networks (`network_kernels`), with a polynomial in place of the network. With the trace l, the
deviator A and its norm q of the left Hencky strain, and r = det A / q^2:

    stress   tau = 1e5 Pa (c0 l I + c1 A + c2 dev(A A)/q + c3 (A:A)/q I), each c a polynomial with the terms `TERMS`
    yield    |dev| radius 1e-2 c0 + c1 max(-l, 0) for q, volumetric radius 1e-2 c2 for l > 0, each c a constant

In a term, l, q and r are multiplied by 10. An engine owns its buffers, so that a rollout may be captured in a CUDA graph.
"""

from collections.abc import Hashable, Sequence

import torch
from torch import Tensor

from neuido.errors import UserError
from neuido.physics.laws.base import ElasticLaw, Engine, EngineLaw, PlasticLaw
from neuido.physics.laws.neural import networks
from neuido.physics.laws.neural.layers import linear, linear_adjoint
from neuido.physics.laws.neural.network_kernels import LINEAR, STRESS_COEFFICIENTS, YIELD_COEFFICIENTS
from neuido.types import Particles

TERMS = ("1", "l", "q", "r", "l^2", "l q", "q^2")
"""Terms of the polynomials, the columns of the coefficients."""
GENERATORS = ("l I", "A", "dev(A A)/q", "(A:A)/q I")
"""Tensors that the polynomials multiply, the rows of the coefficients."""
DEGREE = (0, 1, 1, 1, 2, 2, 2)
"""Degree of each term."""
FIRST = 6
"""First of the three feature columns 10 l, 10 q and 10 r."""


class SymbolicEngine(Engine):
    """The engine of a symbolic law, with its own buffers.

    Args:
        law: The law.
        tensors: Result of `law.tensors()`, in the dtype and on the device of the rollout.
        particles: The scene of each particle.
    """

    law: "_Symbolic"

    def __init__(self, law: "_Symbolic", tensors: Sequence[Tensor], particles: Particles):
        super().__init__(law, [t.detach() for t in tensors], particles)
        (W,) = self.tensors
        count = particles.offsets[-1]
        self.x, self.gx = W.new_zeros(count, 9), W.new_zeros(count, 9)  # the adjoint of columns without a term stays zero
        self.terms, self.g_terms = (W.new_ones(count, W.shape[-1]) for _ in range(2))
        self.c, self.gc = (W.new_empty(count, W.shape[1]) for _ in range(2))

    def _evaluate(self, F: Tensor) -> None:
        if self.terms.shape[1] > 1:
            networks.launch(networks.kernels(F).features, F, F, self.x)
            self.terms[:, 1:4].copy_(self.x[:, FIRST:])
            l, q = self.x[:, FIRST], self.x[:, FIRST + 1]
            for column, (a, b) in zip((4, 5, 6), ((l, l), (l, q), (q, q))):
                torch.mul(a, b, out=self.terms[:, column])
        linear(self.terms, self.tensors[0], None, self.particles.offsets, self.c)

    def forward(self, F: Tensor, out: Tensor) -> None:
        self._evaluate(F)
        k = networks.kernels(F)
        networks.launch(k.stress if self.law.elastic else k.correction, F, F, self.c, self.law.scale, out)

    def adjoint(self, F: Tensor, grad_out: Tensor, grad_F: Tensor) -> None:
        self._evaluate(F)
        k, scale = networks.kernels(F), self.law.scale
        if self.law.elastic:
            networks.launch(k.stress_coefficients_adjoint, F, F, self.c, scale, grad_out, self.gc)
        else:
            networks.launch(k.correction_coefficients_adjoint, F, F, self.c, scale, 0, grad_out, self.gc)
        linear_adjoint(self.terms, self.tensors[0], self.gc, self.particles.offsets, None, self.g_terms, self.grads[0], None)
        if self.terms.shape[1] > 1:
            g, (l, q) = self.g_terms, self.x[:, FIRST : FIRST + 2].unbind(1)
            self.gx[:, FIRST:].copy_(g[:, 1:4])
            self.gx[:, FIRST].addcmul_(g[:, 4], l, value=2).addcmul_(g[:, 5], q)
            self.gx[:, FIRST + 1].addcmul_(g[:, 6], q, value=2).addcmul_(g[:, 5], l)
        adjoint = k.stress_adjoint if self.law.elastic else k.correction_adjoint
        networks.launch(adjoint, F, F, self.c, scale, grad_out, self.gx, grad_F)


class _Symbolic(EngineLaw):
    strain_limit = networks.STRAIN_LIMIT
    elastic: bool
    outputs: int
    columns: int
    scale: float

    def __init__(self, coefficients: Tensor):
        if coefficients.ndim != 3 or tuple(coefficients.shape[1:]) != (self.outputs, self.columns):
            needed = f"(S, {self.outputs}, {self.columns})"
            raise UserError(f"{type(self).__name__}: the coefficients have shape {tuple(coefficients.shape)}; needed {needed}")
        self.coefficients = coefficients

    def tensors(self) -> tuple[Tensor, ...]:
        """Return the coefficients."""
        return (self.coefficients,)

    def engine(self, tensors: Sequence[Tensor], particles: Particles) -> Engine:
        return SymbolicEngine(self, tensors, particles)

    def key(self, tensors: Sequence[Tensor]) -> Hashable:
        return type(self).__name__

    def _at(self, F: Tensor, particles: Particles | None) -> Tensor:
        """Evaluate the polynomials for each F in plain torch, (..., outputs)."""
        W = self.coefficients.to(F.dtype)
        terms = polynomial(F)[..., : self.columns]
        if len(W) == 1:
            return terms @ W[0].T
        if particles is None:
            raise UserError(f"{type(self).__name__} has {len(W)} scenes: give `particles`, the scene of each F")
        return (W[particles.scene.long()] @ terms[..., None])[..., 0]

    def __repr__(self) -> str:
        if self.elastic and len(self.coefficients) == 1:
            return f"{type(self).__name__}(tau/kPa = {formula(self.coefficients[0])})"
        return f"{type(self).__name__}({len(self.coefficients)} scenes)"


class SymbolicElastic(_Symbolic, ElasticLaw):
    """An isotropic elastic law with polynomial coefficients; the module has the formula.

    Args:
        coefficients: Coefficient of each term (`TERMS`) of each generator (`GENERATORS`), (S, 4, 7).

    Raises:
        UserError: Another shape.
    """

    elastic, outputs, columns, scale = True, STRESS_COEFFICIENTS, len(TERMS), networks.STRESS_SCALE

    def __call__(self, F: Tensor, particles: Particles | None = None) -> Tensor:
        return networks.isotropic_stress(F, self._at(F, particles), self.scale)

    def modulus(self) -> Tensor:
        """Return the P-wave modulus at rest [Pa], (S,): 1e5 (c0 + 2/3 c1) of the constant terms."""
        return self.scale * (self.coefficients[:, 0, 0] + 2 / 3 * self.coefficients[:, 1, 0])


class SymbolicPlastic(_Symbolic, PlasticLaw):
    """A return map with constant yield radii; the module has the formula.

    Args:
        coefficients: The constants c0, c1 and c2, (S, 3, 1).

    Raises:
        UserError: Another shape.
    """

    elastic, outputs, columns, identity, scale = False, YIELD_COEFFICIENTS, 1, False, networks.STRAIN_SCALE

    def __call__(self, F: Tensor, particles: Particles | None = None) -> Tensor:
        return networks.return_map(F, self._at(F, particles), self.scale)


def polynomial(F: Tensor) -> Tensor:
    """Evaluate the terms of the polynomials in plain torch.

    Args:
        F: Deformation gradient [-], (..., 3, 3).

    Returns:
        Values of the terms in the order of `TERMS` [-], (..., 7).
    """
    l, q, r = networks.strain_features(*networks.hencky_strain(F))[..., FIRST:].unbind(-1)
    return torch.stack([torch.ones_like(l), l, q, r, l * l, l * q, q * q], -1)


def generators(F: Tensor) -> Tensor:
    """Evaluate the tensors that the polynomials multiply, in plain torch.

    Args:
        F: Deformation gradient [-], (..., 3, 3).

    Returns:
        The tensors in the order of `GENERATORS` [-], (..., 4, 3, 3).
    """
    units = torch.eye(4, dtype=F.dtype, device=F.device)
    return torch.stack([networks.isotropic_stress(F, unit.expand(*F.shape[:-2], 4), 1.0) for unit in units], -3)


def formula(coefficients: Tensor) -> str:
    """Format the stress tau [kPa] of one scene as a formula.

    Args:
        coefficients: As for `SymbolicElastic`, (4, 7); terms with a coefficient of zero are left out.
    """
    parts = []
    for row, generator in zip(coefficients.detach().cpu().tolist(), GENERATORS):
        for value, term, degree in zip(row, TERMS, DEGREE):
            if value:
                factor = 1e-3 * networks.STRESS_SCALE * LINEAR**degree * value
                parts.append(f"{factor:+.4g} {'' if term == '1' else term + ' '}{generator}")
    return " ".join(parts) or "0"
