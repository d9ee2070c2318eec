"""Warp kernels of the effects that act on the stress, with hand-written adjoints.

`coefficients.Tables` defines the columns of the tables; an absent table is None. All terms except `tension_compression` are rational
functions of E = F F^T - I and need no principal frame.
"""

import functools
from types import SimpleNamespace

import warp as wp

from neuido.physics.effects import history_functions, history_kernels
from neuido.physics.laws.classical_kernels import LOCKED
from neuido.physics.linalg import warp_functions
from neuido.physics.linalg.warp_functions import GAP
from neuido.physics.runtime.device import start_warp
from neuido.physics.runtime.once import cached


@cached
def build(real: type) -> SimpleNamespace:
    """Return the kernels for `wp.float32` or `wp.float64`, those of `history_kernels` included."""
    start_warp()
    vec3 = wp.types.vector(length=3, dtype=real)
    mat33 = wp.types.matrix(shape=(3, 3), dtype=real)
    name = f"neuido.effects.{real.__name__}"
    func = functools.partial(wp.func, module=name)
    kernel = functools.partial(wp.kernel, module=name, enable_backward=False)
    own = warp_functions.functions(real)
    log1p, exp_slope, strain, volume_change, cofactor = own.log1p, own.exp_slope, own.strain, own.volume_change, own.cofactor
    frame, compose, hencky = own.frame, own.compose, own.hencky
    inverse_stretch, log_difference = own.inverse_stretch, own.log_difference
    zero = wp.constant(real(0.0))
    one = wp.constant(real(1.0))
    two = wp.constant(real(2.0))
    three = wp.constant(real(3.0))
    four = wp.constant(real(4.0))
    six = wp.constant(real(6.0))
    locked = wp.constant(real(LOCKED))
    gap = wp.constant(real(GAP))
    shared = history_functions.functions(real, name)
    load, spread, deviator, scale_of = shared.load, shared.spread, shared.deviator, shared.scale_of
    compaction_of = shared.compaction_of

    @func
    def volume_factor(F: mat33):
        """Return J^(-2/3) - 1."""
        x = -two / three * log1p(volume_change(F))
        return x * exp_slope(x)

    @func
    def negative(e: vec3):
        return wp.min(e, vec3(zero, zero, zero))

    @func
    def negative_difference(x: real, y: real):
        """Return the divided difference of min(ln(1 + x), 0): (min(ln(1 + y), 0) - min(ln(1 + x), 0)) / (y - x)."""
        out = zero
        if x < zero and y < zero:
            out = log_difference(x, y)
        elif x < zero:
            out = log_difference(x, zero) * x / (x - y)
        elif y < zero:
            out = log_difference(y, zero) * y / (y - x)
        return out

    @func
    def extra_stress(F: mat33, material: wp.array2d(dtype=real), s: int, spectral: bool):
        """Return the stress of strain stiffening, second invariant, fibres and tension-compression asymmetry [Pa].

        A term with a coefficient of zero is skipped: the stretches of an inverted body have no logarithm, but the base law may admit it.
        """
        tau = mat33()
        k = material[s, 0]
        c = material[s, 1]
        if k != zero or c != zero:
            E = strain(F)
            jm = volume_factor(F)
            j = one + jm
            tr = wp.trace(E)
            x = three * jm + j * tr
            gain = x / wp.max(one - material[s, 8] * x, locked)
            m = six * c / (six + four * tr + tr * tr - wp.ddot(E, E))
            tau = deviator((k * gain * j + m * (one + tr)) * E - m * (E * E))
        fibre = material[s, 3]
        n = F * vec3(material[s, 4], material[s, 5], material[s, 6])
        tau = tau + (fibre * (wp.dot(n, n) - one)) * wp.outer(n, n)
        if spectral and material[s, 2] != zero:
            U, d, _V = frame(F)
            tau = tau + compose(U, material[s, 2] * negative(hencky(d)))
        return tau

    @func
    def unscaled_stress(
        p: int,
        s: int,
        base: wp.array(dtype=mat33),
        F: wp.array(dtype=mat33),
        material: wp.array2d(dtype=real),
        branches: wp.array3d(dtype=real),
        spectral: bool,
        all_branches: bool,
        history: wp.array2d(dtype=real),
    ):
        """Return the sum of the stresses of the base law, `extra_stress` and the Maxwell branches [Pa], before any factor.

        `all_branches` is as in `history_kernels`.
        """
        out = base[p]
        if material:
            out = out + extra_stress(F[p], material, s, spectral)
        if branches:
            for b in range(branches.shape[1]):
                if all_branches or branches[s, b, 0] != zero:
                    out = out + branches[s, b, 0] * load(history, p, 6 * b)
        return out

    @func
    def total_scale(
        p: int,
        s: int,
        stiffness: wp.array(dtype=real),
        growth: wp.array(dtype=real),
        material: wp.array2d(dtype=real),
        history: wp.array2d(dtype=real),
        e_max_column: int,
        compaction_column: int,
    ):
        """Return the factor on the stress: stiffness, growth, damage and compaction."""
        out = scale_of(p, s, stiffness, growth)
        if e_max_column >= 0 and material[s, 7] != zero:
            out = out * wp.exp(-material[s, 7] * history[p, e_max_column])
        if compaction_column >= 0:
            out = out * wp.exp(material[s, 9] * compaction_of(history[p, compaction_column]))
        return out

    @kernel
    def add_effect_stress(
        scene: wp.array(dtype=wp.int32),
        stiffness: wp.array(dtype=real),
        growth: wp.array(dtype=real),
        material: wp.array2d(dtype=real),
        branches: wp.array3d(dtype=real),
        spectral: bool,
        e_max_column: int,
        compaction_column: int,
        all_branches: bool,
        F: wp.array(dtype=mat33),
        history: wp.array2d(dtype=real),
        tau: wp.array(dtype=mat33),
    ):
        """Add the stresses of the effects to tau, and scale the sum: tau = scale (tau + extra stress + Maxwell branches)."""
        p = wp.tid()
        s = scene[p]
        t = unscaled_stress(p, s, tau, F, material, branches, spectral, all_branches, history)
        tau[p] = total_scale(p, s, stiffness, growth, material, history, e_max_column, compaction_column) * t

    @kernel
    def add_effect_stress_adjoint(
        scene: wp.array(dtype=wp.int32),
        stiffness: wp.array(dtype=real),
        growth: wp.array(dtype=real),
        material: wp.array2d(dtype=real),
        branches: wp.array3d(dtype=real),
        spectral: bool,
        e_max_column: int,
        compaction_column: int,
        F: wp.array(dtype=mat33),
        history: wp.array2d(dtype=real),
        base: wp.array(dtype=mat33),
        a_tau: wp.array(dtype=mat33),
        a_F: wp.array(dtype=mat33),
        a_history: wp.array2d(dtype=real),
        a_stiffness: wp.array(dtype=real),
        a_growth: wp.array(dtype=real),
        a_material: wp.array2d(dtype=real),
        a_branches: wp.array3d(dtype=real),
    ):
        """Turn a_tau into the adjoint of the base law's stress, and add to the other adjoints.

        `base`, the stress of the base law, is read only with stiffness, growth, damage or compaction.
        """
        p = wp.tid()
        s = scene[p]
        A = a_tau[p]
        scale = total_scale(p, s, stiffness, growth, material, history, e_max_column, compaction_column)
        G = (real(0.5) * scale) * (A + wp.transpose(A))
        if stiffness or growth or e_max_column >= 0 or compaction_column >= 0:
            t = unscaled_stress(p, s, base, F, material, branches, spectral, True, history)
            a_log = scale * wp.ddot(A, t)
            if stiffness:
                a_stiffness[p] = a_stiffness[p] + a_log / stiffness[p]
            if growth:
                wp.atomic_add(a_growth, s, a_log / growth[s])
            if e_max_column >= 0:
                wp.atomic_add(a_material, s, 7, -a_log * history[p, e_max_column])
                a_history[p, e_max_column] = a_history[p, e_max_column] - a_log * material[s, 7]
            if compaction_column >= 0:
                q = history[p, compaction_column]
                compaction = compaction_of(q)
                wp.atomic_add(a_material, s, 9, a_log * compaction)
                if compaction == one - wp.exp(q):
                    a_history[p, compaction_column] = a_history[p, compaction_column] - a_log * material[s, 9] * wp.exp(q)
        if branches:
            for b in range(branches.shape[1]):
                wp.atomic_add(a_branches, s, b, 0, wp.ddot(G, load(history, p, 6 * b)))
                spread(a_history, p, 6 * b, branches[s, b, 0] * G)
        if material:
            Fp = F[p]
            E = strain(Fp)
            jm = volume_factor(Fp)
            j = one + jm
            tr = wp.trace(E)
            k = material[s, 0]
            c = material[s, 1]
            D = deviator(G)
            DE = D * E
            d1 = wp.trace(DE)
            d2 = wp.ddot(DE, E)
            x = three * jm + j * tr
            left = one - material[s, 8] * x
            gain = x / wp.max(left, locked)
            slope = one / locked
            by_lock = zero
            if left > locked:
                slope = one / (left * left)
                by_lock = gain * gain
            q = six + four * tr + tr * tr - wp.ddot(E, E)
            m = six * c / q
            second = (one + tr) * d1 - d2
            a_j = k * (gain + slope * j * (three + tr)) * d1
            a_E = (k * gain * j + m * (one + tr)) * D - m * (DE + wp.transpose(DE)) + (two * m * second / q) * E
            a_E = a_E + (k * slope * j * j * d1 + m * d1 - m * second * (four + two * tr) / q) * wp.identity(n=3, dtype=real)
            J = one + volume_change(Fp)
            grad = two * (a_E * Fp) - (two / three * a_j * j / J) * cofactor(Fp)
            wp.atomic_add(a_material, s, 0, gain * j * d1)
            wp.atomic_add(a_material, s, 1, six / q * second)
            wp.atomic_add(a_material, s, 8, k * by_lock * j * d1)

            fibre = material[s, 3]
            a0 = vec3(material[s, 4], material[s, 5], material[s, 6])
            n = Fp * a0
            Gn = G * n
            along = wp.dot(n, Gn)
            excess = wp.dot(n, n) - one
            a_n = (two * fibre) * (along * n + excess * Gn)
            grad = grad + wp.outer(a_n, a0)
            a_a0 = wp.transpose(Fp) * a_n
            wp.atomic_add(a_material, s, 3, excess * along)
            wp.atomic_add(a_material, s, 4, a_a0[0])
            wp.atomic_add(a_material, s, 5, a_a0[1])
            wp.atomic_add(a_material, s, 6, a_a0[2])

            if spectral:
                U, d, V = frame(Fp)
                B = wp.transpose(U) * G * U
                e = negative(hencky(d))
                inv = inverse_stretch(d)
                r = material[s, 2]
                M = mat33()
                for i in range(3):
                    if d[i] < zero:
                        M[i, i] = r * B[i, i] * inv[i]
                    for l in range(3):
                        if i != l:
                            total = wp.max(two + d[i] + d[l], gap)
                            M[i, l] = two * B[i, l] * (one + d[l]) * r * negative_difference(d[i], d[l]) / total
                grad = grad + U * M * wp.transpose(V)
                wp.atomic_add(a_material, s, 2, B[0, 0] * e[0] + B[1, 1] * e[1] + B[2, 2] * e[2])
            a_F[p] = a_F[p] + grad
        a_tau[p] = scale * A

    return SimpleNamespace(
        add_effect_stress=add_effect_stress,
        add_effect_stress_adjoint=add_effect_stress_adjoint,
        **vars(history_kernels.build(real)),
    )
