"""Warp functions for 3x3 matrices: the principal frame of F, and strains that are accurate near F = I.

Warp's `svd3` is not used for two reasons: its adjoint is wrong near F = I, and in float32 its singular values have an error of 1e-6 (a
stress of 1 Pa for E = 1 MPa at rest). Here the frame comes from a Jacobi iteration on the strain F F^T - I, computed from F - I. The
stretches minus one then keep their relative accuracy, and on the CPU it is faster.
"""

from typing import Any, NamedTuple

import warp as wp

from neuido.physics.runtime.once import cached

FLOOR = 1e-3
"""Lower bound of a principal stretch, or of J in the neo-Hookean law, in a logarithm; below it the gradient is zero."""
GAP = 1e-6
"""Lower bound of sigma_i + sigma_j in a denominator; only an inverted F comes near it."""


class Functions(NamedTuple):
    """Warp functions for one scalar type; none carries an adjoint of its own."""

    log1p: Any
    """ln(1 + x)"""
    log_slope: Any
    """ln(1 + x) / x, 1 at x = 0"""
    exp_slope: Any
    """(exp(x) - 1) / x, 1 at x = 0"""
    strain: Any
    """F F^T - I"""
    volume_change: Any
    """det F - 1"""
    cofactor: Any
    """det(F) F^-T"""
    frame: Any
    """F -> (U, sigma - 1, V): rotations U and V, sigma descending, sigma_3 with the sign of det F"""
    compose: Any
    """(U, d) -> U diag(d) U^T, exactly symmetric"""
    eigen: Any
    """symmetric A -> (values, U), in no order"""
    hencky: Any
    """sigma - 1 -> ln sigma, sigma bounded below by FLOOR"""
    inverse_stretch: Any
    """sigma - 1 -> 1 / sigma, the derivative of `hencky`; zero below FLOOR"""
    log_difference: Any
    """(x, y) -> (ln(1 + y) - ln(1 + x)) / (y - x) of the bounded logarithm"""
    bounded: Any
    """max(x, FLOOR - 1), but NaN for NaN"""
    stretch: Any
    """(F F^T - I, det F - 1) -> V - I of the left stretch V, exactly symmetric; for det F > 0"""
    series_limit: Any
    """Largest norm of F F^T - I for which the series of `log_stretch` is accurate"""
    log_stretch: Any
    """F F^T - I -> ln V, exactly symmetric, by a series for small strains"""
    exp_minus_one: Any
    """symmetric X -> exp(X) - I by a series, for |X| up to `series_limit`"""


@cached
def functions(real: type, *, builtin_svd: bool = False) -> Functions:
    """Return the functions for `wp.float32` or `wp.float64`.

    Args:
        real: The scalar type.
        builtin_svd: Decompose by Warp's `svd3` in place of the Jacobi iteration, whose loop Warp cannot differentiate; for tests.
    """
    mat = wp.types.matrix((3, 3), real)
    vec = wp.types.vector(3, real)
    # largest strain at which stretches are computed from the strain; above it they are the lengths of the rows of U^T F
    small_strain = wp.constant(real(0.5))
    # square of the relative size at which an off-diagonal strain counts as zero
    converged = wp.constant(real(1e-14 if real is wp.float32 else 1e-33))
    # square of the relative size of a Newton step after which the next one would be below the rounding error
    halved = wp.constant(real(1e-8 if real is wp.float32 else 1e-17))
    series_limit = wp.constant(real(0.1 if real is wp.float32 else 2e-3))
    zero = wp.constant(real(0.0))
    half = wp.constant(real(0.5))
    one = wp.constant(real(1.0))
    two = wp.constant(real(2.0))
    floor = wp.constant(real(FLOOR))

    @wp.func
    def log1p(x: real):
        u = one + x
        result = x
        if u != one:
            result = wp.log(u) * x / (u - one)
        return result

    @wp.func
    def log_slope(x: real):
        u = one + x
        result = one
        if u != one:
            result = wp.log(u) / (u - one)
        return result

    @wp.func
    def exp_slope(x: real):
        u = wp.exp(x)
        result = one
        if u != one:
            if u > real(0.25) and u < real(4.0):
                result = (u - one) / wp.log(u)
            else:
                result = (u - one) / x
        return result

    @wp.func
    def givens(app: real, aqq: real, apq: real):
        t = real(0.0)
        if apq != zero:
            theta = half * (aqq - app) / apq
            t = one / (wp.abs(theta) + wp.sqrt(theta * theta + one))
            if theta < zero:
                t = -t
        c = one / wp.sqrt(t * t + one)
        return c, t * c, t

    @wp.func
    def strain(F: mat):
        G = F - wp.identity(n=3, dtype=real)
        GT = wp.transpose(G)
        return G + GT + G * GT

    @wp.func
    def volume_change(F: mat):
        a = F[0, 0] - one
        b = F[1, 1] - one
        c = F[2, 2] - one
        trace = a + b + c
        minors = a * b - F[0, 1] * F[1, 0] + a * c - F[0, 2] * F[2, 0] + b * c - F[1, 2] * F[2, 1]
        det = a * (b * c - F[1, 2] * F[2, 1]) - F[0, 1] * (F[1, 0] * c - F[1, 2] * F[2, 0]) + F[0, 2] * (F[1, 0] * F[2, 1] - b * F[2, 0])
        return trace + minors + det

    @wp.func
    def cofactor(F: mat):
        r0 = vec(F[0, 0], F[0, 1], F[0, 2])
        r1 = vec(F[1, 0], F[1, 1], F[1, 2])
        r2 = vec(F[2, 0], F[2, 1], F[2, 2])
        return wp.matrix_from_rows(wp.cross(r1, r2), wp.cross(r2, r0), wp.cross(r0, r1))

    @wp.func
    def eigen(E: mat):
        a = E[0, 0]
        b = E[1, 1]
        c = E[2, 2]
        ab = E[0, 1]
        ac = E[0, 2]
        bc = E[1, 2]
        u0 = vec(one, zero, zero)
        u1 = vec(zero, one, zero)
        u2 = vec(zero, zero, one)
        sweep = wp.int32(0)
        while sweep < 15 and ab * ab + ac * ac + bc * bc > converged * (a * a + b * b + c * c):
            cs, sn, t = givens(a, b, ab)
            a = a - t * ab
            b = b + t * ab
            ab = zero
            x = cs * ac - sn * bc
            bc = sn * ac + cs * bc
            ac = x
            u = cs * u0 - sn * u1
            u1 = sn * u0 + cs * u1
            u0 = u

            cs, sn, t = givens(a, c, ac)
            a = a - t * ac
            c = c + t * ac
            ac = zero
            x = cs * ab - sn * bc
            bc = sn * ab + cs * bc
            ab = x
            u = cs * u0 - sn * u2
            u2 = sn * u0 + cs * u2
            u0 = u

            cs, sn, t = givens(b, c, bc)
            b = b - t * bc
            c = c + t * bc
            bc = zero
            x = cs * ab - sn * ac
            ac = sn * ab + cs * ac
            ab = x
            u = cs * u1 - sn * u2
            u2 = sn * u1 + cs * u2
            u1 = u
            sweep += 1
        return vec(a, b, c), wp.matrix_from_cols(u0, u1, u2)

    @wp.func
    def jacobi_frame(F: mat):
        values, vectors = eigen(strain(F))
        a = values[0]
        b = values[1]
        c = values[2]
        u0 = vec(vectors[0, 0], vectors[1, 0], vectors[2, 0])
        u1 = vec(vectors[0, 1], vectors[1, 1], vectors[2, 1])
        u2 = vec(vectors[0, 2], vectors[1, 2], vectors[2, 2])
        if a < b:
            x = a
            a = b
            b = x
            u = u0
            u0 = u1
            u1 = -u
        if a < c:
            x = a
            a = c
            c = x
            u = u0
            u0 = u2
            u2 = -u
        if b < c:
            x = b
            b = c
            c = x
            u = u1
            u1 = u2
            u2 = -u

        # the rows of U^T F are sigma_i v_i; Gram-Schmidt from the largest makes V a rotation, and sigma_3 gets the sign of det F
        FT = wp.transpose(F)
        w0 = FT * u0
        w1 = FT * u1
        w2 = FT * u2
        v0 = wp.normalize(w0)
        p = w1 - wp.dot(w1, v0) * v0
        if wp.length_sq(p) <= converged * wp.length_sq(w0):
            # F has rank one: any direction normal to v0 will do
            axis = vec(one, zero, zero)
            if wp.abs(v0[0]) > real(0.7):
                axis = vec(zero, one, zero)
            p = wp.cross(v0, axis)
        v1 = wp.normalize(p)
        v2 = wp.cross(v0, v1)
        excess = vec(wp.dot(w0, v0) - one, wp.dot(w1, v1) - one, wp.dot(w2, v2) - one)
        if wp.max(a, -c) < small_strain:
            excess = vec(a / (one + wp.sqrt(one + a)), b / (one + wp.sqrt(one + b)), c / (one + wp.sqrt(one + c)))
        return wp.matrix_from_cols(u0, u1, u2), excess, wp.matrix_from_cols(v0, v1, v2)

    @wp.func
    def builtin_frame(F: mat):
        U, sigma, V = wp.svd3(F)
        flip_u = one
        if wp.determinant(U) < zero:
            flip_u = -one
        flip_v = one
        if wp.determinant(V) < zero:
            flip_v = -one
        U = U * wp.diag(vec(one, one, flip_u))
        V = V * wp.diag(vec(one, one, flip_v))
        return U, vec(sigma[0] - one, sigma[1] - one, sigma[2] * flip_u * flip_v - one), V

    frame = builtin_frame if builtin_svd else jacobi_frame

    @wp.func
    def compose(U: mat, d: vec):
        u0 = vec(U[0, 0], U[1, 0], U[2, 0])
        u1 = vec(U[0, 1], U[1, 1], U[2, 1])
        u2 = vec(U[0, 2], U[1, 2], U[2, 2])
        return wp.outer(u0, u0) * d[0] + wp.outer(u1, u1) * d[1] + wp.outer(u2, u2) * d[2]

    @wp.func
    def bounded(x: real):
        """Return max(x, FLOOR - 1), but NaN for NaN."""
        result = x
        if x < floor - one:
            result = floor - one
        return result

    @wp.func
    def hencky(excess: vec):
        """Return the logarithms of the principal stretches, bounded below by FLOOR."""
        return vec(log1p(bounded(excess[0])), log1p(bounded(excess[1])), log1p(bounded(excess[2])))

    @wp.func
    def stretch(E: mat, dJ: real):
        # Newton's method for p = tr(V - I). With the second and third invariants q and r of V - I: tr E = 2 p + p^2 - 2 q and
        # det V = 1 + p + q + r; g(p) = 0 is the equation for the second invariant of E. Started from above, it converges to the largest
        # root; g' = 2 det(tr(V) I - V).
        e1 = wp.trace(E)
        size = wp.ddot(E, E)
        e2 = half * (e1 * e1 - size)
        p = real(3.0) * e1 / (wp.sqrt(real(9.0) + real(3.0) * e1) + real(3.0))
        q = real(0.0)
        r = real(0.0)
        D = real(8.0)
        move = one
        n = wp.int32(0)
        while n < 12 and move * move > halved * size:
            q = p + half * (p * p - e1)
            r = dJ - p - q
            D = (real(3.0) + p) * (real(3.0) + two * p + q) - one - dJ
            move = half * (q * (real(4.0) + two * p + q) - two * r * (real(3.0) + p) - e2) / D
            p -= move
            n += 1
        q = p + half * (p * p - e1)
        r = dJ - p - q
        D = (real(3.0) + p) * (real(3.0) + two * p + q) - one - dJ
        # V - I by the Cayley-Hamilton theorem (Hoger and Carlson, Q. Appl. Math. 42, 1984)
        return (((two + p) * (two + p) - q) / D) * E - (one / D) * (E * E) + ((real(4.0) + p) * r / D) * wp.identity(n=3, dtype=real)

    @wp.func
    def log_stretch(E: mat):
        Z = E * wp.inverse(E + two * wp.identity(n=3, dtype=real))  # ln V = artanh Z
        W = Z * Z
        L = Z + Z * (W * (wp.identity(n=3, dtype=real) / real(3.0) + W / real(5.0)))
        return half * (L + wp.transpose(L))

    @wp.func
    def exp_minus_one(X: mat):
        eye = wp.identity(n=3, dtype=real)
        out = eye + X / real(5.0)
        out = eye + X * out / real(4.0)
        out = eye + X * out / real(3.0)
        return X * (eye + X * out / two)

    @wp.func
    def inverse_stretch(excess: vec):
        """Return the derivative of `hencky`."""
        result = vec(zero, zero, zero)
        for i in range(3):
            if one + excess[i] > floor:
                result[i] = one / (one + excess[i])
        return result

    @wp.func
    def log_difference(x: real, y: real):
        """Return (ln(1 + y) - ln(1 + x)) / (y - x) of the bounded logarithm."""
        low = floor - one
        cx = bounded(x)
        cy = bounded(y)
        slope = log_slope((cy - cx) / (one + cx)) / (one + cx)
        share = one
        if x < low or y < low:
            share = zero
            if x > low or y > low:
                share = (cy - cx) / (y - x)
        return slope * share

    return Functions(
        log1p,
        log_slope,
        exp_slope,
        strain,
        volume_change,
        cofactor,
        frame,
        compose,
        eigen,
        hencky,
        inverse_stretch,
        log_difference,
        bounded,
        stretch,
        series_limit,
        log_stretch,
        exp_minus_one,
    )
