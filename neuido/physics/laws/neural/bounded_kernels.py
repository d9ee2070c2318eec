"""Warp functions of the bounded elastic network: a stress that cannot have the wrong sign, whatever the weights are.

With the Hencky strain H = A + l/3 I of `network_kernels`, J = det F and the outputs c0 ... c3 of the network:

    lambda = scale exp(c0),   d = scale exp(c1)                        (exponents clamped to +- EXPONENT)
    p, r = SPREAD (c2, c3) / (sqrt(1 + c2^2) + sqrt(1 + c3^2))         (so |p| + |r| < SPREAD)
    M = d (I + p sqrt(3/2) A/q + r 3 (A^2 - A:A/3 I)/q^2)              (eigenvalues in d (1 +- SPREAD))
    tau = M H + lambda ln(J) I                                         for J >= 0
    tau = d C + lambda ln(1 - J) I,   C = K K^T / (K:K),  K = cof F    for J < 0 (inverted)

The two tensors of M are Chebyshev's polynomials T1 and T2 of the deviator's principal values, which lie in [-1, 1] at any strain. Hence
each principal stress is a positive multiple of its own logarithmic stretch plus lambda ln J: tau : ln V > 0 for every F != I, all stresses
are compressive where no stretch exceeds one and tensile where none is below, and the work along any line of strain grows without bound.
An inverted F is pulled together in all directions, most along its shortest, so that it turns back through zero.

The network sees the strain shortened to the norm `RANGE`, which few samples of the training exceed; beyond it, the coefficients change
no more with the size of the strain.
"""

import functools
import math
from types import SimpleNamespace

import warp as wp

from neuido.physics.laws.neural import network_kernels, readout_kernels
from neuido.physics.linalg import warp_functions
from neuido.physics.runtime.device import start_warp
from neuido.physics.runtime.once import cached

EXPONENT = 7.0
"""Largest exponent: moduli lie between 1/1097 and 1097 times the unit, 91 Pa to 110 MPa."""

SPREAD = 0.95
"""Largest relative distance of a principal modulus from d. Training needs 0.7, of a body crushed to a quarter of its height."""

RANGE = 1.5
"""Largest norm sqrt(l^2 + q^2) of the strain that the network sees [-]; the softest cubes of Stage I exceed it at impact."""

VOLUME_FLOOR = 1e-12
"""Lower bound of J in its logarithm [-]."""

NEAR = (0.7, 1.4)
"""Interval of J in which ln J is computed by a series of J - 1, which keeps its relative accuracy at small strains."""

TERMS = 10
"""Terms of this series; the first one left out is 2e-17 at the ends of `NEAR`."""

SHORTEST = 1e-30
"""Lower bound of K:K [-], so that C is zero for F = 0."""

T1 = math.sqrt(1.5)
"""Factor of A/q, whose principal values lie in +- sqrt(2/3)."""


def functions(real: type, name: str) -> SimpleNamespace:
    """Return the functions of `network_kernels`, with features, stress and the adjoints of this law.

    Args:
        real: `wp.float32` or `wp.float64`.
        name: Name of the Warp module that the functions belong to.
    """
    base = network_kernels.functions(real, name)
    vec3, vec4, vec9, mat33 = base.vec3, base.vec4, base.vec9, base.mat33
    plain_features, features_adjoint, cofactor = base.features_of, base.features_adjoint, base.cofactor
    hencky_adjoint, strain_adjoint, symmetric = base.hencky_adjoint, base.strain_adjoint, base.symmetric
    volume_change = warp_functions.functions(real).volume_change
    func = functools.partial(wp.func, module=name)
    zero, one = wp.constant(real(0.0)), wp.constant(real(1.0))
    near_low, near_high = wp.constant(real(NEAR[0])), wp.constant(real(NEAR[1]))
    longest, floor, shortest = wp.constant(real(RANGE)), wp.constant(real(VOLUME_FLOOR)), wp.constant(real(SHORTEST))
    exponent, spread, t1 = wp.constant(real(EXPONENT)), wp.constant(real(SPREAD)), wp.constant(real(T1))
    third, ninth, sixth = wp.constant(real(1.0 / 3.0)), wp.constant(real(1.0 / 9.0)), wp.constant(real(1.0 / 6.0))
    two, three = wp.constant(real(2.0)), wp.constant(real(3.0))

    @func
    def features_of(l: real, A: mat33, q: real):
        s = wp.min(one, longest / wp.sqrt(l * l + q * q))
        return plain_features(s * l, s * A, s * q)

    @func
    def bounded_features_adjoint(l: real, A: mat33, q: real, X: vec9):
        """Return the adjoints of l, q and A from the adjoint X of the features."""
        r = wp.sqrt(l * l + q * q)
        s = wp.min(one, longest / r)
        gl, gq, gA = features_adjoint(s * l, s * A, s * q, X)
        gl *= s
        gq *= s
        gA *= s
        if r > longest:
            along = (gl * l + gq * q + wp.ddot(gA, A)) / (r * r)
            gl -= along * l
            gq -= along * q
        return gl, gq, gA

    @func
    def log_volume(F: mat33, J: real):
        result = zero
        if J > near_low and J < near_high:
            v = volume_change(F)
            t = v / (two + v)
            w = t * t
            for i in range(wp.static(TERMS)):
                result = result * w + one / real(2 * (wp.static(TERMS - 1) - i) + 1)
            result = two * t * result
        else:
            result = wp.log(wp.max(J, floor))
        return result

    @func
    def moduli(c: vec4, scale: real):
        """Return lambda, d, p and r."""
        n = spread / (wp.sqrt(one + c[2] * c[2]) + wp.sqrt(one + c[3] * c[3]))
        lam = scale * wp.exp(wp.clamp(c[0], -exponent, exponent))
        d = scale * wp.exp(wp.clamp(c[1], -exponent, exponent))
        return lam, d, n * c[2], n * c[3]

    @func
    def moduli_adjoint(c: vec4, lam: real, d: real, p: real, r: real, g_lam: real, g_d: real, g_p: real, g_r: real):
        """Return the adjoint of c."""
        n2 = wp.sqrt(one + c[2] * c[2])
        n3 = wp.sqrt(one + c[3] * c[3])
        n = n2 + n3
        shrink = (g_p * p + g_r * r) / n
        out = vec4(zero, zero, g_p * spread / n - shrink * c[2] / n2, g_r * spread / n - shrink * c[3] / n3)
        if wp.abs(c[0]) < exponent:
            out[0] = g_lam * lam
        if wp.abs(c[1]) < exponent:
            out[1] = g_d * d
        return out

    @func
    def pull(F: mat33):
        """Return C, K and K:K of an inverted F."""
        K = cofactor(F)
        t = wp.max(wp.ddot(K, K), shortest)
        return (K * wp.transpose(K)) / t, K, t

    @func
    def cofactor_adjoint(F: mat33, g: mat33):
        """Return the adjoint of F from the adjoint g of its cofactor."""
        f0 = vec3(F[0, 0], F[0, 1], F[0, 2])
        f1 = vec3(F[1, 0], F[1, 1], F[1, 2])
        f2 = vec3(F[2, 0], F[2, 1], F[2, 2])
        g0 = vec3(g[0, 0], g[0, 1], g[0, 2])
        g1 = vec3(g[1, 0], g[1, 1], g[1, 2])
        g2 = vec3(g[2, 0], g[2, 1], g[2, 2])
        return wp.matrix_from_rows(
            wp.cross(g1, f2) + wp.cross(f1, g2), wp.cross(f2, g0) + wp.cross(g2, f0), wp.cross(g0, f1) + wp.cross(f0, g1)
        )

    @func
    def stress_of(F: mat33, l: real, A: mat33, q: real, c: vec4, scale: real):
        lam, d, p, r = moduli(c, scale)
        J = wp.determinant(F)
        tau = wp.identity(n=3, dtype=real)
        if J < zero:
            C, K, t = pull(F)
            tau = d * C + (lam * wp.log(one - J)) * tau
        else:
            # M H in powers of A, by the Cayley-Hamilton theorem A^3 = (A:A)/2 A + det(A) I
            a = wp.ddot(A, A)
            P = t1 * d * p / q
            R = three * d * r / (q * q)
            x0 = d * l * third + R * (wp.determinant(A) - l * a * ninth) + lam * log_volume(F, J)
            tau = x0 * tau + (d + P * l * third + R * a * sixth) * A + (P + R * l * third) * (A * A)
        return tau

    @func
    def stress_coefficients(F: mat33, l: real, A: mat33, q: real, c: vec4, scale: real, g_tau: mat33):
        """Return the adjoint of the coefficients c."""
        lam, d, p, r = moduli(c, scale)
        J = wp.determinant(F)
        t = wp.trace(g_tau)
        out = vec4(zero, zero, zero, zero)
        if J < zero:
            C, K, k = pull(F)
            out = moduli_adjoint(c, lam, d, p, r, t * wp.log(one - J), wp.ddot(g_tau, C), zero, zero)
        else:
            a = wp.ddot(A, A)
            g1 = wp.ddot(g_tau, A)
            g2 = wp.ddot(g_tau, A * A)
            gP = g1 * l * third + g2
            gR = g1 * a * sixth + g2 * l * third + t * (wp.determinant(A) - l * a * ninth)
            gP *= t1 / q
            gR *= three / (q * q)
            out = moduli_adjoint(c, lam, d, p, r, t * log_volume(F, J), g1 + t * l * third + gP * p + gR * r, gP * d, gR * d)
        return out

    @func
    def stress_gradient(F: mat33, N: mat33, h: mat33, l: real, A: mat33, q: real, c: vec4, scale: real, g_tau: mat33, X: vec9):
        """Return the adjoint of F through the stress and through the features; X is the adjoint of the features."""
        lam, d, p, r = moduli(c, scale)
        J = wp.determinant(F)
        g = symmetric(g_tau)
        t = wp.trace(g)
        gl, gq, gA = bounded_features_adjoint(l, A, q, X)
        gF = mat33()
        if J < zero:
            C, K, k = pull(F)
            gK = (two * d / k) * ((g - wp.ddot(g, C) * wp.identity(n=3, dtype=real)) * K)
            gF = cofactor_adjoint(F, gK) - (lam * t / (one - J)) * K
        else:
            a = wp.ddot(A, A)
            D = wp.determinant(A)
            P = t1 * d * p / q
            R = three * d * r / (q * q)
            g1 = wp.ddot(g, A)
            g2 = wp.ddot(g, A * A)
            gP = g1 * l * third + g2
            gR = g1 * a * sixth + g2 * l * third + t * (D - l * a * ninth)
            gl += (g1 * P + g2 * R + t * d) * third - t * R * a * ninth
            gq -= (gP * P + two * gR * R) / q
            ga = g1 * R * sixth - t * R * l * ninth
            gA += (d + P * l * third + R * a * sixth) * g + (two * (P + R * l * third)) * symmetric(g * A)
            gA += (two * ga) * A + (t * R) * cofactor(A)
            if J > floor:
                gF = (lam * t / J) * cofactor(F)
        return gF + strain_adjoint(F, N, h, hencky_adjoint(gl, gq, gA, A, q))

    own = vars(base) | {
        "plain_features": plain_features,
        "features_of": features_of,
        "stress_of": stress_of,
        "stress_coefficients": stress_coefficients,
        "stress_gradient": stress_gradient,
    }
    return SimpleNamespace(**own)


@cached
def build(real: type, enable_backward: bool = False) -> SimpleNamespace:
    """Return the elastic kernels of this law for one scalar type, as `network_kernels.build` has them for the objective one.

    Args:
        real: `wp.float32` or `wp.float64`.
        enable_backward: Let Warp generate adjoints too, for tests.
    """
    start_warp()
    name = f"neuido.bounded.{real.__name__}.{'autodiff' if enable_backward else 'adjoint'}"
    return readout_kernels.elastic_kernels(functions(real, name), real, name, enable_backward)
