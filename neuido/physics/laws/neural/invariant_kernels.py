"""Warp kernels of NCLaw's networks before and after the matrix products (Ma et al. 2023), with hand-written adjoints.

With F = U diag(sigma) V^T, sigma descending, and R = U V^T:

    features (13)   sigma - 1, F^T F - I, det F - 1
    outputs  (9)    Y, of which X = sym(Y)
    elastic         tau = scale R X F^T
    plastic         F_hat = F + scale R X

The derivative of R divides by sigma_i + sigma_j and is valid at F = I. The derivative of sigma does not exist where two singular values
are equal, since the networks treat them by rank. There, each gets the mean of their gradients, which does not depend on the choice of the
singular vectors.
"""

import functools
from types import SimpleNamespace

import warp as wp

from neuido.physics.linalg import warp_functions
from neuido.physics.linalg.warp_functions import GAP
from neuido.physics.runtime.device import start_warp
from neuido.physics.runtime.once import cached

FEATURES = 13

TIE = 4.0
"""Largest difference of two singular values that count as equal, in machine epsilons."""

EPSILON = {wp.float32: 2.0**-23, wp.float64: 2.0**-52}
"""Machine epsilon of each scalar type."""


@cached
def build(real: type) -> SimpleNamespace:
    """Return the kernels for `wp.float32` or `wp.float64`; features (P, 13), outputs (P, 9)."""
    start_warp()
    mat = wp.types.matrix((3, 3), real)
    vec = wp.types.vector(3, real)
    own = warp_functions.functions(real)
    frame, volume_change, cofactor = own.frame, own.volume_change, own.cofactor
    name = f"neuido.invariants.{real.__name__}"
    func = functools.partial(wp.func, module=name)
    kernel = functools.partial(wp.kernel, module=name, enable_backward=False)
    tie = wp.constant(real(TIE * EPSILON[real]))
    gap = wp.constant(real(GAP))
    one = wp.constant(real(1.0))
    half = wp.constant(real(0.5))

    @func
    def symmetric(Y: wp.array2d(dtype=real), p: int):
        X = mat()
        for i in range(3):
            for j in range(3):
                X[i, j] = half * (Y[p, 3 * i + j] + Y[p, 3 * j + i])
        return X

    @func
    def rotation_adjoint(U: mat, d: vec, V: mat, g: mat):
        """Return the adjoint of F from the adjoint g of its rotation R."""
        A = wp.transpose(U) * g * V
        B = mat()
        for i in range(3):
            for j in range(3):
                B[i, j] = (A[i, j] - A[j, i]) / wp.max(d[i] + d[j] + one + one, gap)
        return U * B * wp.transpose(V)

    @func
    def stretch_adjoint(U: mat, d: vec, V: mat, g: vec):
        """Return the adjoint of F from the adjoint g of its singular values."""
        if d[0] - d[1] <= tie and d[1] - d[2] <= tie:
            m = (g[0] + g[1] + g[2]) / real(3.0)
            g = vec(m, m, m)
        elif d[0] - d[1] <= tie:
            m = half * (g[0] + g[1])
            g = vec(m, m, g[2])
        elif d[1] - d[2] <= tie:
            m = half * (g[1] + g[2])
            g = vec(g[0], m, m)
        return U * wp.diag(g) * wp.transpose(V)

    @kernel
    def features(F: wp.array(dtype=mat), X: wp.array2d(dtype=real), R: wp.array(dtype=mat)):
        p = wp.tid()
        Fp = F[p]
        U, d, V = frame(Fp)
        R[p] = U * wp.transpose(V)
        G = Fp - wp.identity(n=3, dtype=real)
        E = G + wp.transpose(G) + wp.transpose(G) * G
        for i in range(3):
            X[p, i] = d[i]
            for j in range(3):
                X[p, 3 + 3 * i + j] = E[i, j]
        X[p, 12] = volume_change(Fp)

    @kernel
    def stress(F: wp.array(dtype=mat), R: wp.array(dtype=mat), Y: wp.array2d(dtype=real), scale: real, tau: wp.array(dtype=mat)):
        p = wp.tid()
        tau[p] = scale * (R[p] * symmetric(Y, p) * wp.transpose(F[p]))

    @kernel
    def correction(F: wp.array(dtype=mat), R: wp.array(dtype=mat), Y: wp.array2d(dtype=real), scale: real, out: wp.array(dtype=mat)):
        p = wp.tid()
        out[p] = F[p] + scale * (R[p] * symmetric(Y, p))

    @kernel
    def outputs_adjoint(
        F: wp.array(dtype=mat), R: wp.array(dtype=mat), scale: real, elastic: int, g_out: wp.array(dtype=mat), g_Y: wp.array2d(dtype=real)
    ):
        """Write the adjoint of the network's outputs."""
        p = wp.tid()
        g = g_out[p]
        if elastic == 1:
            g = g * F[p]
        A = scale * (wp.transpose(R[p]) * g)
        for i in range(3):
            for j in range(3):
                g_Y[p, 3 * i + j] = half * (A[i, j] + A[j, i])

    @kernel
    def gradient_adjoint(
        F: wp.array(dtype=mat),
        R: wp.array(dtype=mat),
        Y: wp.array2d(dtype=real),
        scale: real,
        elastic: int,
        g_out: wp.array(dtype=mat),
        g_X: wp.array2d(dtype=real),
        g_F: wp.array(dtype=mat),
    ):
        """Add to the adjoint of F the contributions of the read-out, the rotation and the features; g_X is the adjoint of the features."""
        p = wp.tid()
        Fp = F[p]
        g = g_out[p]
        X = symmetric(Y, p)
        direct = g
        if elastic == 1:
            direct = scale * (wp.transpose(g) * R[p] * X)
            g = g * Fp
        U, d, V = frame(Fp)
        E = mat()
        for i in range(3):
            for j in range(3):
                E[i, j] = g_X[p, 3 + 3 * i + j] + g_X[p, 3 + 3 * j + i]
        own_part = rotation_adjoint(U, d, V, scale * (g * X)) + stretch_adjoint(U, d, V, vec(g_X[p, 0], g_X[p, 1], g_X[p, 2]))
        g_F[p] = g_F[p] + direct + own_part + Fp * E + g_X[p, 12] * cofactor(Fp)

    return SimpleNamespace(
        features=features, stress=stress, correction=correction, outputs_adjoint=outputs_adjoint, gradient_adjoint=gradient_adjoint
    )
