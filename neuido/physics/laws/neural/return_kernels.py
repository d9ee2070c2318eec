"""Warp functions of the full return map: a correction of any isotropic form, whatever the weights are.

With the Hencky strain H = A + l/3 I of `network_kernels`, its norm q and the outputs c0 ... c3 of the network:

    f = clamp(1 - (scale c0 + c1 max(-l, 0)) / q, 0, 1)                 (share of the deviator that is taken back)
    g = SKEW c3 / sqrt(1 + c3^2)                                        (how it leans from the deviator to its square)
    u = clamp(l - scale c2, 0, l) for l > 0,  clamp(l + CRUSH scale c2, l, 0) for l < 0
    F_hat = exp(-u/3) exp(-f (A + g sqrt(6) (A^2 - A:A/3 I) / q)) F

The return map of `network_kernels` is the case g = 0 without a limit under compression. Three numbers f, g and u give any isotropic
correction of three principal strains; snow, whose stretches are clamped one by one, needs all three. Where f and u are clamped to zero,
F is unchanged.
"""

import math
from types import SimpleNamespace

import warp as wp

from neuido.physics.laws.neural import network_kernels, readout_kernels
from neuido.physics.runtime.device import start_warp
from neuido.physics.runtime.once import cached

SKEW = 2.0
"""Largest ratio of the second tensor to the first; both have principal values of up to q sqrt(2/3)."""

CRUSH = 10.0
"""Unit of the limit of compression over that of the other radii: a limit of 1.5, beyond all strains, is c2 = 15."""

ROOT = math.sqrt(6.0)
"""Factor of (A^2 - A:A/3 I) / q, whose principal values then lie in +- q sqrt(2/3), as those of A do."""

COEFFICIENTS = 4


def functions(base: SimpleNamespace, real: type, name: str) -> SimpleNamespace:
    """Return the correction of one particle and the adjoints of coefficients and F, as `network_kernels.functions` has them.

    Args:
        base: The result of `network_kernels.functions` or `bounded_kernels.functions` for this type and module.
        real: `wp.float32` or `wp.float64`.
        name: Name of the Warp module that the functions belong to.
    """
    vec4, vec9, mat33 = base.vec4, base.vec9, base.mat33
    exponential, exponential_adjoint, symmetric = base.exponential, base.exponential_adjoint, base.symmetric
    features_adjoint, hencky_adjoint, strain_adjoint = base.features_adjoint, base.hencky_adjoint, base.strain_adjoint
    func = wp.func(module=name)
    zero, one, third = wp.constant(real(0.0)), wp.constant(real(1.0)), wp.constant(real(1.0 / 3.0))
    skew, crush, root = wp.constant(real(SKEW)), wp.constant(real(CRUSH)), wp.constant(real(ROOT))

    @func
    def return_flow(l: real, q: real, c: vec4, scale: real):
        """Return the share f before and after clamping, the lean times `ROOT`, and the volumetric correction u."""
        x = one - (scale * c[0] + c[1] * wp.max(-l, zero)) / q
        u = wp.clamp(l + crush * scale * c[2], l, zero)
        if l > zero:
            u = wp.clamp(l - scale * c[2], zero, l)
        return x, wp.clamp(x, zero, one), root * skew * c[3] / wp.sqrt(one + c[3] * c[3]), u

    @func
    def second(A: mat33, q: real):
        return (A * A - (wp.ddot(A, A) * third) * wp.identity(n=3, dtype=real)) / q

    @func
    def correction_of(F: mat33, l: real, A: mat33, q: real, c: vec4, scale: real):
        x, f, k, u = return_flow(l, q, c, scale)
        return wp.exp(-u * third) * (exponential(-f * (A + k * second(A, q))) * F)

    @func
    def return_adjoint(F: mat33, M: mat33, u: real, g: mat33):
        """Return the adjoints of M and u, and of F as the right factor of exp(M) F."""
        E = exponential(M)
        s = wp.exp(-u * third)
        return exponential_adjoint(M, s * g * wp.transpose(F)), -s * wp.ddot(g, E * F) * third, s * E * g

    @func
    def correction_coefficients(F: mat33, l: real, A: mat33, q: real, c: vec4, scale: real, straight_through: int, g_out: mat33):
        """Return the adjoint of the coefficients c.

        With `straight_through` it is passed at an active clamp if descent leads back into the range.
        """
        x, f, k, u = return_flow(l, q, c, scale)
        D = second(A, q)
        gM, gu, gF = return_adjoint(F, -f * (A + k * D), u, g_out)
        gf = -wp.ddot(gM, A + k * D)
        if x < zero and not (straight_through == 1 and gf < zero):
            gf = zero
        if x > one and not (straight_through == 1 and gf > zero):
            gf = zero
        # the adjoint of the limit r of the size of l
        gr = gu * crush * scale
        r = crush * scale * c[2]
        if l > zero:
            gr = -gu * scale
            r = scale * c[2]
        if r > wp.abs(l) and not (straight_through == 1 and gr > zero):
            gr = zero
        if r < zero and not (straight_through == 1 and gr < zero):
            gr = zero
        n = one + c[3] * c[3]
        return vec4(-gf * scale / q, -gf * wp.max(-l, zero) / q, gr, -f * wp.ddot(gM, D) * root * skew / (n * wp.sqrt(n)))

    @func
    def correction_gradient(F: mat33, N: mat33, h: mat33, l: real, A: mat33, q: real, c: vec4, scale: real, g_out: mat33, X: vec9):
        """Return the adjoint of F through the return map and through the features; X is the adjoint of the features."""
        x, f, k, u = return_flow(l, q, c, scale)
        D = second(A, q)
        gM, gu, gF = return_adjoint(F, -f * (A + k * D), u, g_out)
        gl, gq, gA = features_adjoint(l, A, q, X)
        gD = -f * k * gM
        gA += -f * gM + (real(2.0) / q) * symmetric(gD * A) - (real(2.0) * third * wp.trace(gD) / q) * A
        gq -= wp.ddot(gD, D) / q
        if x > zero and x < one:
            gf = -wp.ddot(gM, A + k * D)
            gq += gf * (one - x) / q
            if l < zero:
                gl += gf * c[1] / q
        r = crush * scale * c[2]
        if l > zero:
            r = scale * c[2]
        if r < wp.abs(l):
            gl += gu
        return gF + strain_adjoint(F, N, h, hencky_adjoint(gl, gq, gA, A, q))

    return SimpleNamespace(
        correction_of=correction_of, correction_coefficients=correction_coefficients, correction_gradient=correction_gradient
    )


@cached
def build(real: type, enable_backward: bool = False) -> SimpleNamespace:
    """Return the kernels of this law for one scalar type, as `network_kernels.build` has them; coefficients (P, 4).

    Args:
        real: `wp.float32` or `wp.float64`.
        enable_backward: Let Warp generate adjoints too, for tests.
    """
    start_warp()
    name = f"neuido.returns.{real.__name__}.{'autodiff' if enable_backward else 'adjoint'}"
    base = network_kernels.functions(real, name)
    own = SimpleNamespace(**vars(base) | vars(functions(base, real, name)))
    plastic = readout_kernels.plastic_kernels(own, real, name, enable_backward, COEFFICIENTS)
    return SimpleNamespace(**vars(plastic), features=network_kernels.build(real, enable_backward).features)
