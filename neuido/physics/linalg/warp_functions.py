"""Warp functions for 3x3 matrices: the principal frame of F, and strains that keep their digits near F = I.

Warp's `svd3` has two faults here: its adjoint is wrong near F = I, and in float32 its singular values carry an error of 1e-6 (1 Pa for
E = 1 MPa at rest). The frame below comes from a Jacobi iteration on the strain F F^T - I, formed from F - I, so that the stretches
minus one keep their relative accuracy, and it is faster on the CPU.
"""

from typing import Any, NamedTuple

import warp as wp

from neuido.physics.runtime.once import cached

FLOOR = 1e-3
"""Lower bound of a principal stretch (of J in neo-Hookean) in a logarithm; below it the logarithm is constant, its gradient zero."""
GAP = 1e-6
"""Lower bound of sigma_i + sigma_j in a denominator; only an inverted F can come near it."""


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
    """Its derivative, 1 / sigma, or zero below FLOOR"""
    log_difference: Any
    """(x, y) -> (ln(1 + y) - ln(1 + x)) / (y - x) of the bounded logarithm"""
    bounded: Any
    """max(x, FLOOR - 1), NaN kept"""
    stretch: Any
    """(F F^T - I, det F - 1) -> V - I of the left stretch V, exactly symmetric; for det F > 0"""
    slight: Any
    """Largest norm of F F^T - I for `log_stretch`."""
    log_stretch: Any
    """F F^T - I -> ln V, exactly symmetric, by a series for slight strains"""
    exp_excess: Any
    """symmetric X -> exp(X) - I by a series, |X| at most `slight`"""


@cached
def functions(real: type, *, builtin_svd: bool = False) -> Functions:
    """Build the functions for `wp.float32` or `wp.float64`.

    `builtin_svd` puts Warp's own `svd3` in place of the Jacobi iteration, whose data-dependent loop Warp cannot differentiate; for tests.
    """
    mat = wp.types.matrix((3, 3), real)
    vec = wp.types.vector(3, real)
    # Largest strain at which stretches are taken from the strain; beyond it they are lengths of the rows of U^T F.
    small_strain = wp.constant(real(0.5))
    # Square of the relative size at which an off-diagonal strain counts as zero.
    converged = wp.constant(real(1e-14 if real is wp.float32 else 1e-33))
    # Square of the relative size of a Newton step whose successor is below the rounding.
    halved = wp.constant(real(1e-8 if real is wp.float32 else 1e-17))
    slight = wp.constant(real(0.1 if real is wp.float32 else 2e-3))
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

        # The rows of U^T F are sigma_i v_i; Gram-Schmidt from the largest makes V a rotation and leaves the sign of det F to sigma_3.
        FT = wp.transpose(F)
        w0 = FT * u0
        w1 = FT * u1
        w2 = FT * u2
        v0 = wp.normalize(w0)
        p = w1 - wp.dot(w1, v0) * v0
        if wp.length_sq(p) <= converged * wp.length_sq(w0):
            # F has rank one: any direction across v0 serves.
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
        """max(x, FLOOR - 1), but NaN stays NaN."""
        result = x
        if x < floor - one:
            result = floor - one
        return result

    @wp.func
    def hencky(excess: vec):
        """Logarithms of the principal stretches, bounded below."""
        return vec(log1p(bounded(excess[0])), log1p(bounded(excess[1])), log1p(bounded(excess[2])))

    @wp.func
    def stretch(E: mat, dJ: real):
        # Newton on the trace p of V - I: with its second and third invariants q and r, tr E = 2 p + p^2 - 2 q, det V = 1 + p + q + r, and
        # g(p) = 0 is the second invariant of E. From above, where it starts, Newton falls to the largest root; g' = 2 det(tr(V) I - V).
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
        # Cayley and Hamilton (Hoger and Carlson, Q. Appl. Math. 42, 1984), less I
        return (((two + p) * (two + p) - q) / D) * E - (one / D) * (E * E) + ((real(4.0) + p) * r / D) * wp.identity(n=3, dtype=real)

    @wp.func
    def log_stretch(E: mat):
        Z = E * wp.inverse(E + two * wp.identity(n=3, dtype=real))  # ln V = artanh Z
        W = Z * Z
        L = Z + Z * (W * (wp.identity(n=3, dtype=real) / real(3.0) + W / real(5.0)))
        return half * (L + wp.transpose(L))

    @wp.func
    def exp_excess(X: mat):
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
        """(ln(1 + y) - ln(1 + x)) / (y - x) of the bounded logarithm."""
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
        slight,
        log_stretch,
        exp_excess,
    )
