"""Warp kernels of the classical laws, with hand-written adjoints.

Every law here is isotropic: with F = U diag(sigma) V^T the stress is U diag(t) U^T and the corrected gradient is U diag(z) V^T. In the
frame of U and V the derivatives are divided differences of t and z. These are finite at repeated singular values, where every rollout
begins (F = I).

The decomposition is that of `warp_functions`. Warp's `svd3` is not used, since its adjoint is wrong near F = I.
"""

from typing import Any, NamedTuple

import warp as wp

from neuido.physics.linalg import warp_functions
from neuido.physics.linalg.warp_functions import FLOOR, GAP
from neuido.physics.runtime.device import start_warp
from neuido.physics.runtime.once import cached

FIXED_COROTATED, SIGMA, NEO_HOOKEAN = 0, 1, 2
IDENTITY, VON_MISES, DRUCKER_PRAGER = 0, 1, 2

LOCKED = 0.05
"""Lower bound of 1 - k (I1bar - 3) in `strain_stiffening`, whose stress would become infinite where that reaches zero."""
FLAT = 0.1
"""det F below which the stretch is computed from the principal frame, since `warp_functions.Functions.stretch` needs det F > 0."""


_WARP_SUM = """
#if defined(__CUDA_ARCH__)
    const unsigned active = __activemask();
    int alike = 0;
    __match_all_sync(active, key, &alike);
    if (active != 0xffffffffu || !alike) return value;
    auto sum = value;
    #pragma unroll
    for (int d = 16; d > 0; d >>= 1) sum += __shfl_xor_sync(active, sum, d);
    return (threadIdx.x & 31) == 0 ? sum : decltype(sum)(0);
#else
    return value;
#endif
"""


class LawFunctions(NamedTuple):
    """Warp functions of one particle for one scalar type; the law is given by its number and its parameters."""

    stress: Any
    """(F, kind, mu, lambda) -> tau"""
    stress_gradient: Any
    """(F, kind, mu, lambda, adjoint of tau) -> adjoints of F, mu and lambda"""
    correct: Any
    """(F, kind, parameter) -> corrected F"""
    correction_gradient: Any
    """(F, kind, parameter, adjoint of the corrected F) -> adjoints of F and of the parameter"""
    warp_sum: Any
    """(value, key) -> on a GPU its sum over the warp in the first lane and zero in the others, if all have the same key; else the value"""


class LawKernels(NamedTuple):
    """The kernels for one scalar type; each comment lists the arguments.

    `kinds` (S,) int32 has the number of each scene's law and `params` (S, n) its parameters. A particle of scene s reads row
    min(s, S - 1).
    """

    stress: Any
    """(F, kinds, params (S, 2) [mu, lambda], scene, tau)"""
    stress_adjoint: Any
    """(F, kinds, params, scene, grad_tau, grad_F, grad_params or None); adds to both gradients"""
    correct: Any
    """(F, kinds, params (S, 1), scene, corrected)"""
    correct_adjoint: Any
    """(F, kinds, params, scene, grad_corrected, grad_F, grad_params or None); adds to both gradients"""
    functions: LawFunctions
    """The same for one particle, for kernels that do more than evaluate a law."""


@cached
def kernels(real: type, *, enable_backward: bool = False, builtin_svd: bool = False) -> LawKernels:
    """Build the kernels for `wp.float32` or `wp.float64`.

    Args:
        real: The scalar type.
        enable_backward: Let Warp generate adjoints of the forward kernels too, for tests.
        builtin_svd: Decompose by Warp's `svd3` in place of the Jacobi iteration, whose loop Warp cannot differentiate; for tests.
    """
    start_warp()
    mat = wp.types.matrix((3, 3), real)
    vec = wp.types.vector(3, real)
    floor = wp.constant(real(FLOOR))
    gap = wp.constant(real(GAP))
    flat = wp.constant(real(FLAT))
    zero = wp.constant(real(0.0))
    half = wp.constant(real(0.5))
    one = wp.constant(real(1.0))
    two = wp.constant(real(2.0))
    own = warp_functions.functions(real, builtin_svd=builtin_svd)
    log1p, exp_slope, strain, volume_change, cofactor = own.log1p, own.exp_slope, own.strain, own.volume_change, own.cofactor
    frame, compose, bounded, hencky = own.frame, own.compose, own.bounded, own.hencky
    inverse_stretch, log_difference, stretch = own.inverse_stretch, own.log_difference, own.stretch
    series_limit, log_stretch, exp_minus_one = own.series_limit, own.log_stretch, own.exp_minus_one

    @wp.func_native(_WARP_SUM)
    def warp_sum(value: real, key: wp.int32) -> real: ...

    @wp.func
    def corotated_in_frame(Fp: mat, mu: real, lam: real):
        U, d, _V = frame(Fp)
        dJ = d[0] + d[1] + d[2] + d[0] * d[1] + d[0] * d[2] + d[1] * d[2] + d[0] * d[1] * d[2]
        bulk = lam * (one + dJ) * dJ
        k = two * mu
        return compose(U, vec(k * (one + d[0]) * d[0] + bulk, k * (one + d[1]) * d[1] + bulk, k * (one + d[2]) * d[2] + bulk))

    @wp.func
    def corotated_by_stretch(Fp: mat, mu: real, lam: real):
        """Return tau = 2 mu (V^2 - V) + lambda J (J - 1) I without a principal frame, in a fifth of the time."""
        dJ = volume_change(Fp)
        out = mat()
        if one + dJ > flat:
            E = strain(Fp)
            out = (two * mu) * (E - stretch(E, dJ)) + (lam * (one + dJ) * dJ) * wp.identity(n=3, dtype=real)
        else:
            out = corotated_in_frame(Fp, mu, lam)
        return out

    @wp.func
    def has_stretch(Fp: mat, kind: wp.int32):
        """Return whether `corotated_gradient` applies."""
        return wp.static(not builtin_svd) and kind == FIXED_COROTATED and one + volume_change(Fp) > flat

    @wp.func
    def corotated_gradient(Fp: mat, mu: real, lam: real, A: mat):
        """Return the adjoints of F, mu and lambda without a principal frame.

        With S = A + A^T that of F is 2 mu (S - X) F + lambda (2 J - 1) tr(A) cof F, where V X + X V = S. By the Cayley-Hamilton theorem
        X = (V^2 S - V S V + S V^2 + I1 (S V - V S) + I2 S) (2 I1 V^2 + 2 J I)^-1, with the invariants of V.
        """
        eye = wp.identity(n=3, dtype=real)
        dJ = volume_change(Fp)
        E = strain(Fp)
        D = stretch(E, dJ)
        V = eye + D
        b = eye + E
        first = real(3.0) + wp.trace(D)
        second = half * (first * first - wp.trace(b))
        S = A + wp.transpose(A)
        SV = S * V
        VS = wp.transpose(SV)
        bS = b * S
        X = bS + wp.transpose(bS) - V * SV + first * (SV - VS) + second * S
        X = X * wp.inverse((two * first) * b + (two * (one + dJ)) * eye)
        trace = A[0, 0] + A[1, 1] + A[2, 2]
        grad = (two * mu) * ((S - half * (X + wp.transpose(X))) * Fp) + (trace * lam * (one + two * dJ)) * cofactor(Fp)
        return grad, wp.ddot(S, E - D), trace * (one + dJ) * dJ

    @wp.func
    def hencky_in_frame(Fp: mat, mu: real, lam: real):
        U, d, _V = frame(Fp)
        e = hencky(d)
        bulk = lam * (e[0] + e[1] + e[2])
        k = two * mu
        return compose(U, vec(k * e[0] + bulk, k * e[1] + bulk, k * e[2] + bulk))

    @wp.func
    def hencky_by_series(Fp: mat, mu: real, lam: real):
        """Return tau = 2 mu ln V + lambda ln(J) I; small strains need no principal frame."""
        E = strain(Fp)
        out = mat()
        if wp.ddot(E, E) <= series_limit * series_limit:
            out = (two * mu) * log_stretch(E) + (lam * log1p(volume_change(Fp))) * wp.identity(n=3, dtype=real)
        else:
            out = hencky_in_frame(Fp, mu, lam)
        return out

    corotated = corotated_in_frame if builtin_svd else corotated_by_stretch
    logarithmic = hencky_in_frame if builtin_svd else hencky_by_series

    @wp.func
    def stress_of(Fp: mat, kind: wp.int32, mu: real, lam: real):
        """Return the Kirchhoff stress [Pa]."""
        out = mat()
        if kind == NEO_HOOKEAN:
            dJ = bounded(volume_change(Fp))
            out = mu * strain(Fp) + (lam * log1p(dJ)) * wp.identity(n=3, dtype=real)
        elif kind == FIXED_COROTATED:
            out = corotated(Fp, mu, lam)
        else:
            out = logarithmic(Fp, mu, lam)
        return out

    @wp.func
    def stress_gradient(Fp: mat, kind: wp.int32, mu: real, lam: real, A: mat):
        """Return the adjoints of F, mu and lambda from the adjoint A of the stress."""
        trace = A[0, 0] + A[1, 1] + A[2, 2]
        grad = mat()
        shear = real(0.0)
        bulk = real(0.0)
        if kind == NEO_HOOKEAN:
            dJ = volume_change(Fp)
            grad = mu * ((A + wp.transpose(A)) * Fp)
            if one + dJ > floor:
                grad = grad + (trace * lam / (one + dJ)) * cofactor(Fp)
            shear = wp.ddot(A, strain(Fp))
            bulk = trace * log1p(bounded(dJ))
        elif has_stretch(Fp, kind):
            grad, shear, bulk = corotated_gradient(Fp, mu, lam, A)
        else:
            U, d, V = frame(Fp)
            A = wp.transpose(U) * A * U
            sigma = vec(one + d[0], one + d[1], one + d[2])
            B = mat()
            if kind == FIXED_COROTATED:
                dJ = d[0] + d[1] + d[2] + d[0] * d[1] + d[0] * d[2] + d[1] * d[2] + d[0] * d[1] * d[2]
                cof = vec(sigma[1] * sigma[2], sigma[0] * sigma[2], sigma[0] * sigma[1])
                bulk = trace * (one + dJ) * dJ
                for i in range(3):
                    shear += two * A[i, i] * sigma[i] * d[i]
                    B[i, i] = A[i, i] * two * mu * (sigma[i] + d[i]) + trace * lam * (one + two * dJ) * cof[i]
                    for j in range(3):
                        if i != j:
                            total = wp.max(sigma[i] + sigma[j], gap)
                            B[i, j] = (A[i, j] + A[j, i]) * sigma[j] * two * mu * (one - one / total)
            else:
                e = hencky(d)
                inv = inverse_stretch(d)
                bulk = trace * (e[0] + e[1] + e[2])
                for i in range(3):
                    shear += two * A[i, i] * e[i]
                    B[i, i] = (A[i, i] * two * mu + trace * lam) * inv[i]
                    for j in range(3):
                        if i != j:
                            total = wp.max(sigma[i] + sigma[j], gap)
                            B[i, j] = (A[i, j] + A[j, i]) * sigma[j] * two * mu * log_difference(d[i], d[j]) / total
            grad = U * B * wp.transpose(V)
        return grad, shear, bulk

    @wp.kernel(enable_backward=enable_backward, module="unique")
    def stress(
        F: wp.array(dtype=mat),
        kinds: wp.array(dtype=wp.int32),
        params: wp.array2d(dtype=real),
        scene: wp.array(dtype=wp.int32),
        tau: wp.array(dtype=mat),
    ):
        p = wp.tid()
        s = wp.min(scene[p], params.shape[0] - 1)
        tau[p] = stress_of(F[p], kinds[s], params[s, 0], params[s, 1])

    @wp.kernel(enable_backward=False, module="unique")
    def stress_adjoint(
        F: wp.array(dtype=mat),
        kinds: wp.array(dtype=wp.int32),
        params: wp.array2d(dtype=real),
        scene: wp.array(dtype=wp.int32),
        grad_tau: wp.array(dtype=mat),
        grad_F: wp.array(dtype=mat),
        grad_params: wp.array2d(dtype=real),
    ):
        p = wp.tid()
        s = wp.min(scene[p], params.shape[0] - 1)
        grad, shear, bulk = stress_gradient(F[p], kinds[s], params[s, 0], params[s, 1], grad_tau[p])
        grad_F[p] = grad_F[p] + grad
        if grad_params:
            shear = warp_sum(shear, s)
            bulk = warp_sum(bulk, s)
            if shear != zero or bulk != zero:
                wp.atomic_add(grad_params, s, 0, shear)
                wp.atomic_add(grad_params, s, 1, bulk)

    @wp.func
    def limit(q: real, trace: real, kind: wp.int32, param: real):
        """Return the state and radius of yield for |dev e| = q; state 0: elastic, 1: return to |dev e| = radius, 2: to the identity."""
        radius = param
        if kind == DRUCKER_PRAGER:
            radius = -param * trace
        state = wp.int32(0)
        if q > radius:
            state = wp.int32(1)
        if kind == DRUCKER_PRAGER and trace > zero:
            state = wp.int32(2)
        return state, radius

    @wp.func
    def flow(e: vec, kind: wp.int32, param: real):
        """Return the state of yield, tr e, |dev e| and the radius of yield for the principal Hencky strains e."""
        trace = e[0] + e[1] + e[2]
        m = trace / real(3.0)
        q = wp.sqrt((e[0] - m) * (e[0] - m) + (e[1] - m) * (e[1] - m) + (e[2] - m) * (e[2] - m))
        state, radius = limit(q, trace, kind, param)
        return state, trace, q, radius

    @wp.func
    def return_in_frame(Fp: mat, kind: wp.int32, param: real):
        U, d, V = frame(Fp)
        e = hencky(d)
        state, trace, q, radius = flow(e, kind, param)
        out = Fp
        if state > 0:
            # add z - sigma to F, so that only the plastic increment carries the rounding error of U and V
            c0 = -d[0]
            c1 = -d[1]
            c2 = -d[2]
            if state == 1:
                m = trace / real(3.0)
                shrink = radius / q - one
                x = shrink * (e[0] - m)
                c0 = wp.exp(e[0]) * x * exp_slope(x) + wp.max(floor - one - d[0], zero)
                x = shrink * (e[1] - m)
                c1 = wp.exp(e[1]) * x * exp_slope(x) + wp.max(floor - one - d[1], zero)
                x = shrink * (e[2] - m)
                c2 = wp.exp(e[2]) * x * exp_slope(x) + wp.max(floor - one - d[2], zero)
            out = Fp + U * wp.diag(vec(c0, c1, c2)) * wp.transpose(V)
        return out

    @wp.func
    def return_by_series(Fp: mat, kind: wp.int32, param: real):
        """Return the corrected gradient; small strains need no frame: F + (exp(X) - 1) F with X the plastic increment of -ln V."""
        E = strain(Fp)
        out = Fp
        if wp.ddot(E, E) <= series_limit * series_limit:
            L = log_stretch(E)
            dJ = volume_change(Fp)
            trace = log1p(dJ)
            D = L - (trace / real(3.0)) * wp.identity(n=3, dtype=real)
            q = wp.sqrt(wp.ddot(D, D))
            state, radius = limit(q, trace, kind, param)
            if state == 1:
                out = Fp + exp_minus_one((radius / q - one) * D) * Fp
            if state == 2:
                out = Fp + exp_minus_one(-L) * Fp
        else:
            out = return_in_frame(Fp, kind, param)
        return out

    returned = return_in_frame if builtin_svd else return_by_series

    @wp.func
    def corrected_of(Fp: mat, kind: wp.int32, param: real):
        """Return the corrected gradient."""
        out = Fp
        if kind != IDENTITY:
            out = returned(Fp, kind, param)
        return out

    @wp.func
    def correction_gradient(Fp: mat, kind: wp.int32, param: real, A: mat):
        """Return the adjoints of F and of the parameter from the adjoint A of the corrected gradient."""
        grad = A
        share = zero
        if kind != IDENTITY:
            U, d, V = frame(Fp)
            e = hencky(d)
            state, trace, q, radius = flow(e, kind, param)
            if state != 0:
                A = wp.transpose(U) * A * V
                B = mat()
                if state == 2:
                    for i in range(3):
                        for j in range(3):
                            if i != j:
                                B[i, j] = (A[i, j] - A[j, i]) / wp.max(two + d[i] + d[j], gap)
                else:
                    m = trace / real(3.0)
                    ratio = radius / q
                    inv = inverse_stretch(d)
                    n = vec((e[0] - m) / q, (e[1] - m) / q, (e[2] - m) / q)
                    z = vec(wp.exp(m + radius * n[0]), wp.exp(m + radius * n[1]), wp.exp(m + radius * n[2]))
                    g = vec(A[0, 0] * z[0], A[1, 1] * z[1], A[2, 2] * z[2])
                    along = wp.dot(g, n)
                    mean = (g[0] + g[1] + g[2]) / real(3.0)
                    # derivatives of the radius: with respect to the trace of the strain, and to the law's parameter
                    slope = zero
                    weight = one
                    if kind == DRUCKER_PRAGER:
                        slope = -param
                        weight = -trace
                    for i in range(3):
                        B[i, i] = inv[i] * (mean + slope * along + ratio * (g[i] - mean - along * n[i]))
                        for j in range(3):
                            if i != j:
                                x = ratio * (e[j] - e[i])
                                sym = z[i] * exp_slope(x) * ratio * log_difference(d[i], d[j])
                                skew = (z[i] + z[j]) / wp.max(two + d[i] + d[j], gap)
                                B[i, j] = half * (sym * (A[i, j] + A[j, i]) + skew * (A[i, j] - A[j, i]))
                    share = weight * along
                grad = U * B * wp.transpose(V)
        return grad, share

    @wp.kernel(enable_backward=enable_backward, module="unique")
    def correct(
        F: wp.array(dtype=mat),
        kinds: wp.array(dtype=wp.int32),
        params: wp.array2d(dtype=real),
        scene: wp.array(dtype=wp.int32),
        corrected: wp.array(dtype=mat),
    ):
        p = wp.tid()
        s = wp.min(scene[p], params.shape[0] - 1)
        corrected[p] = corrected_of(F[p], kinds[s], params[s, 0])

    @wp.kernel(enable_backward=False, module="unique")
    def correct_adjoint(
        F: wp.array(dtype=mat),
        kinds: wp.array(dtype=wp.int32),
        params: wp.array2d(dtype=real),
        scene: wp.array(dtype=wp.int32),
        grad_corrected: wp.array(dtype=mat),
        grad_F: wp.array(dtype=mat),
        grad_params: wp.array2d(dtype=real),
    ):
        p = wp.tid()
        s = wp.min(scene[p], params.shape[0] - 1)
        grad, share = correction_gradient(F[p], kinds[s], params[s, 0], grad_corrected[p])
        grad_F[p] = grad_F[p] + grad
        if grad_params:
            share = warp_sum(share, s)
            if share != zero:
                wp.atomic_add(grad_params, s, 0, share)

    functions = LawFunctions(stress_of, stress_gradient, corrected_of, correction_gradient, warp_sum)
    return LawKernels(stress, stress_adjoint, correct, correct_adjoint, functions)
