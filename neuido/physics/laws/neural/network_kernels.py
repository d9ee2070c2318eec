"""Warp kernels of the objective networks before and after the matrix products: strain features, read-outs and their adjoints.

The Hencky strain is computed without SVD. With G = F - I,

    e = (G + G^T + G G^T) / 2 = (b - I) / 2,   N = (I + e)^-1,   h = e N        (eigenvalues of h: tanh ln sigma)
    H = h + h^3/3 + h^5/5 + h^7/7 ~ ln V,      l = tr H,   A = H - l/3 I,   q = sqrt(A:A + DELTA^2)

The network maps nine features of the invariants to coefficients c:

    elastic (4)   tau = scale (c0 l I + c1 A + c2 dev(A A)/q + c3 (A:A)/q I)
    plastic (3)   r_d = scale c0 + c1 max(-l, 0),   r_v = scale c2              (radii of the elastic domain)
                  f = clamp(1 - r_d/q, 0, 1),   u = clamp(l - r_v, 0, l) where l > 0, else 0
                  F_hat = exp(-u/3) exp(-f A) F

With constant coefficients the laws are Hencky elasticity, von Mises plasticity (c0) and Drucker-Prager plasticity (c1, with c2 = 0).
The exponential of a symmetric matrix is the Taylor polynomial of degree 4 of a quarter of the matrix, squared twice.
"""

import functools
import math
from types import SimpleNamespace

import warp as wp

from neuido.physics.laws.neural import readout_kernels
from neuido.physics.runtime.device import start_warp
from neuido.physics.runtime.once import cached

DELTA = 1e-5
"""Lower bound of the deviatoric strain q [-], which keeps its derivative finite at F = I."""

FINE, COARSE, LINEAR = 1e-3, 3e-2, 10.0
"""Scales of the features: strains at which a fine and a coarse asinh begin to bend [-], and the factor of the linear features."""

LODE = 3.0 * math.sqrt(6.0)
"""Factor of det A / q^3 in the Lode parameter, which then lies in [-1, 1]."""

FEATURES, STRESS_COEFFICIENTS, YIELD_COEFFICIENTS = 9, 4, 3


def functions(real: type, name: str) -> SimpleNamespace:
    """Return the Warp functions of one particle, for the kernels of this file and of `fused`.

    Args:
        real: `wp.float32` or `wp.float64`.
        name: Name of the Warp module that the functions belong to.
    """
    mat33 = wp.types.matrix(shape=(3, 3), dtype=real)
    vec3 = wp.types.vector(length=3, dtype=real)
    vec4 = wp.types.vector(length=4, dtype=real)
    vec9 = wp.types.vector(length=9, dtype=real)
    func = functools.partial(wp.func, module=name)

    @func
    def identity():
        return wp.identity(n=3, dtype=real)

    @func
    def asinh(x: real):
        y = wp.abs(x)
        y = wp.log(y + wp.sqrt(y * y + real(1.0)))
        if x < real(0.0):
            y = -y
        return y

    @func
    def asinh_slope(x: real):
        return real(1.0) / wp.sqrt(x * x + real(1.0))

    @func
    def symmetric(m: mat33):
        return real(0.5) * (m + wp.transpose(m))

    @func
    def tanh_strain(F: mat33):
        """Return N = (I + e)^-1 and h = e N."""
        G = F - identity()
        e = real(0.5) * (G + wp.transpose(G) + G * wp.transpose(G))
        N = wp.inverse(identity() + e)
        return N, symmetric(e * N)

    @func
    def hencky(h: mat33):
        """Return H = artanh(h) to the seventh order."""
        h2 = h * h
        T = real(wp.static(1.0 / 5.0)) * identity() + real(wp.static(1.0 / 7.0)) * h2
        return h + h * h2 * (real(wp.static(1.0 / 3.0)) * identity() + h2 * T)

    @func
    def norm(A: mat33):
        return wp.sqrt(wp.ddot(A, A) + real(wp.static(DELTA * DELTA)))

    @func
    def strain_adjoint(F: mat33, N: mat33, h: mat33, gH: mat33):
        """Return the adjoint of F from the adjoint of H."""
        h2 = h * h
        T = real(wp.static(1.0 / 5.0)) * identity() + real(wp.static(1.0 / 7.0)) * h2
        U = real(wp.static(1.0 / 3.0)) * identity() + h2 * T
        V = identity() + h2 * U
        gV = h * gH
        gU = h2 * gV
        gh2 = gV * U + (h2 * gU) * real(wp.static(1.0 / 7.0)) + gU * T
        gh = symmetric(gH * V) + real(2.0) * symmetric(h * symmetric(gh2))
        return N * gh * N * F

    @func
    def cofactor(A: mat33):
        """Return d det(A) / dA of a symmetric A."""
        a = vec3(A[0, 0], A[0, 1], A[0, 2])
        b = vec3(A[1, 0], A[1, 1], A[1, 2])
        c = vec3(A[2, 0], A[2, 1], A[2, 2])
        return wp.matrix_from_rows(wp.cross(b, c), wp.cross(c, a), wp.cross(a, b))

    @func
    def exponential(M: mat33):
        Y = real(0.25) * M
        E = identity() + Y * (identity() + real(0.5) * Y * (identity() + real(wp.static(1.0 / 3.0)) * Y * (identity() + real(0.25) * Y)))
        E = E * E
        return E * E

    @func
    def exponential_adjoint(M: mat33, g: mat33):
        """Return the adjoint of the symmetric M from the adjoint g of exp(M)."""
        Y = real(0.25) * M
        C = identity() + real(0.25) * Y
        B = identity() + real(wp.static(1.0 / 3.0)) * Y * C
        A = identity() + real(0.5) * Y * B
        E1 = identity() + Y * A
        E2 = E1 * E1
        g = real(2.0) * symmetric(E2 * symmetric(g))
        g = real(2.0) * symmetric(E1 * g)
        gA = Y * g
        gB = real(0.5) * Y * gA
        gC = real(wp.static(1.0 / 3.0)) * Y * gB
        gY = g * A + real(0.5) * gA * B + real(wp.static(1.0 / 3.0)) * gB * C + real(0.25) * gC
        return real(0.25) * symmetric(gY)

    @func
    def strain_invariants(F: mat33):
        """Return N, h, and the trace l, the deviator A and its norm q of the Hencky strain."""
        N, h = tanh_strain(F)
        H = hencky(h)
        l = wp.trace(H)
        A = H - (l / real(3.0)) * identity()
        return N, h, l, A, norm(A)

    @func
    def features_of(l: real, A: mat33, q: real):
        d = wp.determinant(A)
        x = vec9()
        x[0] = real(0.25) * asinh(l * real(wp.static(1.0 / FINE)))
        x[1] = asinh(l * real(wp.static(1.0 / COARSE)))
        x[2] = real(0.25) * asinh(q * real(wp.static(1.0 / FINE)))
        x[3] = asinh(q * real(wp.static(1.0 / COARSE)))
        x[4] = l / wp.sqrt(l * l + q * q)
        x[5] = real(LODE) * d / (q * q * q)
        x[6] = real(LINEAR) * l
        x[7] = real(LINEAR) * q
        x[8] = real(LINEAR) * d / (q * q)
        return x

    @func
    def features_adjoint(l: real, A: mat33, q: real, X: vec9):
        """Return the adjoints of l, q and A (through det A) from the adjoint X of the features."""
        d = wp.determinant(A)
        r2 = l * l + q * q
        r3 = r2 * wp.sqrt(r2)
        q2 = q * q
        gl = (
            X[0] * real(wp.static(0.25 / FINE)) * asinh_slope(l * real(wp.static(1.0 / FINE)))
            + X[1] * real(wp.static(1.0 / COARSE)) * asinh_slope(l * real(wp.static(1.0 / COARSE)))
            + X[4] * q2 / r3
            + X[6] * real(LINEAR)
        )
        gq = (
            X[2] * real(wp.static(0.25 / FINE)) * asinh_slope(q * real(wp.static(1.0 / FINE)))
            + X[3] * real(wp.static(1.0 / COARSE)) * asinh_slope(q * real(wp.static(1.0 / COARSE)))
            - X[4] * l * q / r3
            - X[5] * real(wp.static(3.0 * LODE)) * d / (q2 * q2)
            + X[7] * real(LINEAR)
            - X[8] * real(wp.static(2.0 * LINEAR)) * d / (q2 * q)
        )
        gd = X[5] * real(LODE) / (q2 * q) + X[8] * real(LINEAR) / q2
        return gl, gq, gd * cofactor(A)

    @func
    def hencky_adjoint(gl: real, gq: real, gA: mat33, A: mat33, q: real):
        """Return the adjoint of H from the adjoints of l, q and A."""
        g = gA + (gq / q) * A
        return symmetric(g) + ((gl - wp.trace(g) / real(3.0)) * identity())

    @func
    def stress_of(F: mat33, l: real, A: mat33, q: real, c: vec4, scale: real):
        a = wp.ddot(A, A)
        D = A * A - (a / real(3.0)) * identity()
        return scale * ((c[0] * l + c[3] * a / q) * identity() + c[1] * A + (c[2] / q) * D)

    @func
    def stress_coefficients(F: mat33, l: real, A: mat33, q: real, c: vec4, scale: real, g_tau: mat33):
        """Return the adjoint of the coefficients c."""
        a = wp.ddot(A, A)
        D = A * A - (a / real(3.0)) * identity()
        g = scale * g_tau
        t = wp.trace(g)
        return vec4(l * t, wp.ddot(g, A), wp.ddot(g, D) / q, a / q * t)

    @func
    def stress_gradient(F: mat33, N: mat33, h: mat33, l: real, A: mat33, q: real, c: vec4, scale: real, g_tau: mat33, X: vec9):
        """Return the adjoint of F through the generators and through the features; X is the adjoint of the features."""
        a = wp.ddot(A, A)
        gl, gq, gA = features_adjoint(l, A, q, X)
        g = symmetric(scale * g_tau)
        t = wp.trace(g)
        gl += c[0] * t
        gD = (c[2] / q) * (g - (t / real(3.0)) * identity())
        gA += c[1] * g + real(2.0) * symmetric(gD * A) + (real(2.0) * c[3] * t / q) * A
        gq -= (c[2] * (wp.ddot(g, A * A) - a * t / real(3.0)) + c[3] * a * t) / (q * q)
        return strain_adjoint(F, N, h, hencky_adjoint(gl, gq, gA, A, q))

    @func
    def flow(l: real, q: real, c: vec4, scale: real):
        """Return the deviatoric fraction f before and after clamping, and the volumetric correction u."""
        x = real(1.0) - (scale * c[0] + c[1] * wp.max(-l, real(0.0))) / q
        f = wp.clamp(x, real(0.0), real(1.0))
        u = real(0.0)
        if l > real(0.0):
            u = wp.clamp(l - scale * c[2], real(0.0), l)
        return x, f, u

    @func
    def correction_of(F: mat33, l: real, A: mat33, q: real, c: vec4, scale: real):
        x, f, u = flow(l, q, c, scale)
        return wp.exp(-u / real(3.0)) * (exponential(-f * A) * F)

    @func
    def flow_adjoint(F: mat33, A: mat33, f: real, u: real, g: mat33):
        """Return the adjoints of f, u, M = -f A, and F as the right factor of exp(M) F."""
        M = -f * A
        E = exponential(M)
        s = wp.exp(-u / real(3.0))
        gM = exponential_adjoint(M, s * g * wp.transpose(F))
        return -wp.ddot(gM, A), -s * wp.ddot(g, E * F) / real(3.0), gM, s * E * g

    @func
    def correction_coefficients(F: mat33, l: real, A: mat33, q: real, c: vec4, scale: real, straight_through: int, g_out: mat33):
        """Return the adjoint of the coefficients c.

        With `straight_through` it is passed at an active clamp if descent leads back into the range.
        """
        x, f, u = flow(l, q, c, scale)
        gf, gu, gM, gF = flow_adjoint(F, A, f, u, g_out)
        if x < real(0.0) and not (straight_through == 1 and gf < real(0.0)):
            gf = real(0.0)
        if x > real(1.0) and not (straight_through == 1 and gf > real(0.0)):
            gf = real(0.0)
        r = scale * c[2]
        if l <= real(0.0):
            gu = real(0.0)
        elif r > l and not (straight_through == 1 and gu < real(0.0)):
            gu = real(0.0)
        elif r < real(0.0) and not (straight_through == 1 and gu > real(0.0)):
            gu = real(0.0)
        return vec4(-gf * scale / q, -gf * wp.max(-l, real(0.0)) / q, -gu * scale, real(0.0))

    @func
    def correction_gradient(F: mat33, N: mat33, h: mat33, l: real, A: mat33, q: real, c: vec4, scale: real, g_out: mat33, X: vec9):
        """Return the adjoint of F through the return map and through the features; X is the adjoint of the features."""
        x, f, u = flow(l, q, c, scale)
        gf, gu, gM, gF = flow_adjoint(F, A, f, u, g_out)
        gl, gq, gA = features_adjoint(l, A, q, X)
        gA -= f * gM
        if x > real(0.0) and x < real(1.0):
            gq += gf * (real(1.0) - x) / q
            if l < real(0.0):
                gl += gf * c[1] / q
        if l > real(0.0) and scale * c[2] < l:
            gl += gu
        return gF + strain_adjoint(F, N, h, hencky_adjoint(gl, gq, gA, A, q))

    return SimpleNamespace(
        vec3=vec3,
        vec4=vec4,
        vec9=vec9,
        mat33=mat33,
        symmetric=symmetric,
        cofactor=cofactor,
        exponential=exponential,
        exponential_adjoint=exponential_adjoint,
        strain_invariants=strain_invariants,
        strain_adjoint=strain_adjoint,
        hencky_adjoint=hencky_adjoint,
        features_of=features_of,
        features_adjoint=features_adjoint,
        stress_of=stress_of,
        stress_coefficients=stress_coefficients,
        stress_gradient=stress_gradient,
        correction_of=correction_of,
        correction_coefficients=correction_coefficients,
        correction_gradient=correction_gradient,
    )


@cached
def build(real: type, enable_backward: bool = False) -> SimpleNamespace:
    """Return the kernels for one scalar type, compiled on first launch; features (P, 9), coefficients (P, 4) or (P, 3).

    Args:
        real: `wp.float32` or `wp.float64`.
        enable_backward: Let Warp generate adjoints too, for tests.
    """
    start_warp()
    name = f"neuido.networks.{real.__name__}.{'autodiff' if enable_backward else 'adjoint'}"
    own = functions(real, name)
    elastic = readout_kernels.elastic_kernels(own, real, name, enable_backward)
    plastic = readout_kernels.plastic_kernels(own, real, name, enable_backward, YIELD_COEFFICIENTS)
    return SimpleNamespace(**vars(plastic) | vars(elastic))
