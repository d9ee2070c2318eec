"""Warp kernels of all parametric laws, with hand-written adjoints: those of `classical_kernels`, rubber, foam, fluid and snow.

A rollout takes these kernels where the law of a scene is none of `classical_kernels`, so that those stay small and fast. The rubber laws
and the fluid are rational functions of E = F F^T - I and of J, and need no principal frame. As everywhere, a stress is computed from F - I
and keeps its digits near F = I.
"""

import functools
from typing import Any, NamedTuple

import warp as wp

from neuido.physics.laws import classical_kernels
from neuido.physics.laws.classical_kernels import LOCKED
from neuido.physics.linalg import warp_functions
from neuido.physics.linalg.warp_functions import FLOOR, GAP
from neuido.physics.runtime.device import start_warp
from neuido.physics.runtime.once import cached

MOONEY_RIVLIN, GENT, HYPERFOAM, FLUID = 3, 4, 5, 6
"""Elastic laws, after those of `classical_kernels`."""
VOLUMETRIC_RESET, SNOW = 3, 4
"""Plastic laws, after those of `classical_kernels`."""

GAMMA = 7.0
"""Exponent of `Fluid`'s pressure (Cole 1948)."""
LARGEST = 40.0
"""Upper bound of ln J^(-a b) in `Hyperfoam`, whose exponential would overflow in float32 at 88."""


class ExtendedKernels(NamedTuple):
    """The kernels for one scalar type, with the arguments of `classical_kernels.LawKernels`; `params` has the columns of the widest law."""

    stress: Any
    stress_adjoint: Any
    correct: Any
    correct_adjoint: Any


@cached
def kernels(real: type) -> ExtendedKernels:
    """Build the kernels for `wp.float32` or `wp.float64`."""
    start_warp()
    name = f"neuido.laws.{real.__name__}"
    func = functools.partial(wp.func, module=name)
    kernel = functools.partial(wp.kernel, module=name, enable_backward=False)
    mat = wp.types.matrix((3, 3), real)
    vec = wp.types.vector(3, real)
    tables, ints, matrices = wp.array2d(dtype=real), wp.array(dtype=wp.int32), wp.array(dtype=mat)
    zero, half, one = (wp.constant(real(x)) for x in (0.0, 0.5, 1.0))
    two, three = wp.constant(real(2.0)), wp.constant(real(3.0))
    floor, gap = wp.constant(real(FLOOR)), wp.constant(real(GAP))
    locked, largest, gamma = wp.constant(real(LOCKED)), wp.constant(real(LARGEST)), wp.constant(real(GAMMA))
    own = warp_functions.functions(real)
    log1p, exp_slope, strain, volume_change, cofactor = own.log1p, own.exp_slope, own.strain, own.volume_change, own.cofactor
    frame, compose, bounded, hencky = own.frame, own.compose, own.bounded, own.hencky
    inverse_stretch, log_difference = own.inverse_stretch, own.log_difference
    base = classical_kernels.kernels(real).functions
    base_stress, base_stress_gradient, base_correct, base_correction_gradient, warp_sum = base
    last_elastic = wp.constant(classical_kernels.NEO_HOOKEAN)
    last_plastic = wp.constant(classical_kernels.DRUCKER_PRAGER)

    @func
    def parameter(params: tables, s: int, column: int):
        value = zero
        if column < params.shape[1]:
            value = params[s, column]
        return value

    @func
    def expm1(x: real):
        return x * exp_slope(x)

    @func
    def deviator(A: mat):
        return A - (wp.trace(A) / three) * wp.identity(n=3, dtype=real)

    @func
    def foam(e: vec, shear: real, a: real, b: real):
        """Return the principal stresses of `Hyperfoam` for the Hencky strains e, and ln J^(-a b), bounded."""
        rise = wp.min(-a * b * (e[0] + e[1] + e[2]), largest)
        bulk = expm1(rise)
        k = two * shear / a
        return vec(k * (expm1(a * e[0]) - bulk), k * (expm1(a * e[1]) - bulk), k * (expm1(a * e[2]) - bulk)), rise

    @func
    def stress_of(F: mat, kind: int, a: real, b: real, c: real):
        """Return the Kirchhoff stress [Pa] of a law with the parameters a, b, c."""
        out = mat()
        if kind <= last_elastic:
            out = base_stress(F, kind, a, b)
        elif kind == HYPERFOAM:
            U, d, _V = frame(F)
            t, _rise = foam(hencky(d), a, b, c)
            out = compose(U, t)
        elif kind == FLUID:
            dJ = bounded(volume_change(F))
            out = (a / gamma * (dJ - expm1((one - gamma) * log1p(dJ)))) * wp.identity(n=3, dtype=real)
        else:
            E = strain(F)
            dJ = bounded(volume_change(F))
            s = wp.exp(-two / three * log1p(dJ))
            e1 = wp.trace(E)
            if kind == GENT:
                x = s * (three + e1) - three
                out = (a * s / wp.max(one - x / b, locked)) * deviator(E)
            else:
                out = deviator((two * a * s + two * b * s * s * (one + e1)) * E - (two * b * s * s) * (E * E))
            out = out + (half * c * dJ * (two + dJ)) * wp.identity(n=3, dtype=real)
        return out

    @func
    def foam_gradient(F: mat, A: mat, shear: real, a: real, b: real):
        """Return the adjoints of F and of the three parameters of `Hyperfoam`."""
        U, d, V = frame(F)
        e = hencky(d)
        t, rise = foam(e, shear, a, b)
        A = wp.transpose(U) * A * U
        inv = inverse_stretch(d)
        trace = wp.trace(A)
        total = e[0] + e[1] + e[2]
        bulk = zero
        if rise < largest:
            bulk = wp.exp(rise)
        B = mat()
        of_t = A[0, 0] * t[0] + A[1, 1] * t[1] + A[2, 2] * t[2]
        of_a = (two * shear / a) * b * total * bulk * trace - of_t / a
        for i in range(3):
            power = wp.exp(a * e[i])
            of_a += (two * shear / a) * A[i, i] * e[i] * power
            B[i, i] = (two * shear) * (A[i, i] * power + trace * b * bulk) * inv[i]
            for j in range(3):
                if i != j:
                    slope = (two * shear) * power * exp_slope(a * (e[j] - e[i])) * log_difference(d[i], d[j])
                    B[i, j] = (A[i, j] + A[j, i]) * (one + d[j]) * slope / wp.max(two + d[i] + d[j], gap)
        return U * B * wp.transpose(V), vec(of_t / shear, of_a, two * shear * total * bulk * trace)

    @func
    def stress_gradient(F: mat, kind: int, a: real, b: real, c: real, A: mat):
        """Return the adjoints of F and of the three parameters from the adjoint A of the stress."""
        grad = mat()
        share = vec()
        if kind <= last_elastic:
            g, shear, bulk = base_stress_gradient(F, kind, a, b, A)
            grad = g
            share = vec(shear, bulk, zero)
        elif kind == HYPERFOAM:
            g, own_share = foam_gradient(F, A, a, b, c)
            grad = g
            share = own_share
        else:
            trace = wp.trace(A)
            raw = volume_change(F)
            dJ = bounded(raw)
            J = one + dJ
            log_J = log1p(dJ)
            a_J = zero
            if kind == FLUID:
                share[0] = trace / gamma * (dJ - expm1((one - gamma) * log_J))
                a_J = trace * a / gamma * (one + (gamma - one) * wp.exp(-gamma * log_J))
            else:
                E = strain(F)
                s = wp.exp(-two / three * log_J)
                e1 = wp.trace(E)
                D = deviator(half * (A + wp.transpose(A)))
                first = wp.ddot(D, E)
                a_s = zero
                G = mat()
                if kind == GENT:
                    x = s * (three + e1) - three
                    left = one - x / b
                    gain = one / wp.max(left, locked)
                    G = (a * s * gain) * D
                    a_s = a * gain * first
                    share[0] = s * gain * first
                    if left > locked:
                        a_x = a * s * first * gain * gain / b
                        G = G + (a_x * s) * wp.identity(n=3, dtype=real)
                        a_s += a_x * (three + e1)
                        share[1] = -a_x * x / b
                else:
                    DE = D * E
                    second = (one + e1) * first - wp.ddot(DE, E)
                    G = (two * a * s + two * b * s * s * (one + e1)) * D
                    G = G + (two * b * s * s) * (first * wp.identity(n=3, dtype=real) - DE - wp.transpose(DE))
                    a_s = two * a * first + real(4.0) * b * s * second
                    share[0] = two * s * first
                    share[1] = two * s * s * second
                grad = two * (G * F)
                a_J = c * J * trace - two / three * a_s * s / J
                share[2] = half * dJ * (two + dJ) * trace
            if one + raw > floor:
                grad = grad + a_J * cofactor(F)
        return grad, share

    @func
    def within(F: mat, compression: real, stretch: real):
        """Return whether no principal stretch can be outside its bounds, without a principal frame."""
        E = strain(F)
        least = wp.min(compression * (two - compression), stretch * (two + stretch))
        return wp.ddot(E, E) < least * least and wp.determinant(F) > zero

    @func
    def clamped(d: real, compression: real, stretch: real):
        """Return d in [-compression, stretch], but NaN for NaN."""
        out = d
        if d < -compression:
            out = -compression
        if d > stretch:
            out = stretch
        return out

    @func
    def correct_of(F: mat, kind: int, a: real, b: real):
        """Return the corrected gradient of a law with the parameters a, b."""
        out = F
        if kind == VOLUMETRIC_RESET:
            x = expm1(log1p(bounded(volume_change(F))) / three)
            out = (one + x) * wp.identity(n=3, dtype=real)
        elif kind == SNOW:
            if not within(F, a, b):
                U, d, V = frame(F)
                move = vec(clamped(d[0], a, b) - d[0], clamped(d[1], a, b) - d[1], clamped(d[2], a, b) - d[2])
                if move[0] != zero or move[1] != zero or move[2] != zero:
                    out = F + U * wp.diag(move) * wp.transpose(V)
        elif kind <= last_plastic:
            out = base_correct(F, kind, a)
        return out

    @func
    def snow_gradient(F: mat, A: mat, a: real, b: real):
        """Return the adjoints of F and of the two parameters of `Snow`."""
        U, d, V = frame(F)
        M = wp.transpose(U) * A * V
        z = vec(clamped(d[0], a, b), clamped(d[1], a, b), clamped(d[2], a, b))
        B = mat()
        share = vec()
        for i in range(3):
            if z[i] == d[i]:
                B[i, i] = M[i, i]
            elif d[i] < zero:
                share[0] += -M[i, i]
            else:
                share[1] += M[i, i]
            for j in range(3):
                if i != j:
                    sym = zero
                    if d[i] != d[j]:
                        sym = (z[j] - z[i]) / (d[j] - d[i])
                    elif z[i] == d[i]:
                        sym = one
                    skew = (two + z[i] + z[j]) / wp.max(two + d[i] + d[j], gap)
                    B[i, j] = half * (sym * (M[i, j] + M[j, i]) + skew * (M[i, j] - M[j, i]))
        return U * B * wp.transpose(V), share

    @func
    def correction_gradient(F: mat, kind: int, a: real, b: real, A: mat):
        """Return the adjoints of F and of the parameters from the adjoint A of the corrected gradient."""
        grad = A
        share = vec()
        if kind == VOLUMETRIC_RESET:
            dJ = volume_change(F)
            grad = mat()
            if one + dJ > floor:
                grad = (wp.trace(A) / three * wp.exp(-two / three * log1p(dJ))) * cofactor(F)
        elif kind == SNOW:
            if not within(F, a, b):
                g, own_share = snow_gradient(F, A, a, b)
                grad = g
                share = own_share
        elif kind <= last_plastic:
            g, first = base_correction_gradient(F, kind, a, A)
            grad = g
            share[0] = first
        return grad, share

    @func
    def add_share(grad_params: tables, s: int, share: vec):
        for column in range(3):
            value = warp_sum(share[column], s)
            if column < grad_params.shape[1] and value != zero:
                wp.atomic_add(grad_params, s, column, value)

    @kernel
    def stress(F: matrices, kinds: ints, params: tables, scene: ints, tau: matrices):
        p = wp.tid()
        s = wp.min(scene[p], params.shape[0] - 1)
        tau[p] = stress_of(F[p], kinds[s], params[s, 0], parameter(params, s, 1), parameter(params, s, 2))

    @kernel
    def stress_adjoint(F: matrices, kinds: ints, params: tables, scene: ints, grad_tau: matrices, grad_F: matrices, grad_params: tables):
        p = wp.tid()
        s = wp.min(scene[p], params.shape[0] - 1)
        grad, share = stress_gradient(F[p], kinds[s], params[s, 0], parameter(params, s, 1), parameter(params, s, 2), grad_tau[p])
        grad_F[p] = grad_F[p] + grad
        if grad_params:
            add_share(grad_params, s, share)

    @kernel
    def correct(F: matrices, kinds: ints, params: tables, scene: ints, corrected: matrices):
        p = wp.tid()
        s = wp.min(scene[p], params.shape[0] - 1)
        corrected[p] = correct_of(F[p], kinds[s], params[s, 0], parameter(params, s, 1))

    @kernel
    def correct_adjoint(
        F: matrices, kinds: ints, params: tables, scene: ints, grad_corrected: matrices, grad_F: matrices, grad_params: tables
    ):
        p = wp.tid()
        s = wp.min(scene[p], params.shape[0] - 1)
        grad, share = correction_gradient(F[p], kinds[s], params[s, 0], parameter(params, s, 1), grad_corrected[p])
        grad_F[p] = grad_F[p] + grad
        if grad_params:
            add_share(grad_params, s, share)

    return ExtendedKernels(stress, stress_adjoint, correct, correct_adjoint)
