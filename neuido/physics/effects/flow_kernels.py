"""Warp kernels of plastic flow with hardening, softening, backstress, rate dependence or cohesion, and their hand-written adjoints.

Von Mises (Simo and Hughes, Computational Inelasticity, chapters 2 and 3, in Hencky strain):

    xi = 2 mu dev ln V - beta,   n = xi/|xi|,   yield stress (Y + H alpha) exp(-s alpha)
    dgamma (2 mu + H_k + H exp(-s alpha)) + eta (dgamma/dt)^n = max(|xi| - yield stress, 0)
    F = exp(-dgamma n) F_tr,   alpha += dgamma,   beta += H_k dgamma n

The step is exact, except that softening is explicit. n is `yield_index`; for n = 1 the step has a closed form, otherwise Newton's method
finds its logarithm.

Drucker-Prager with cohesion: |dev ln V| <= slope (tip - tr ln V); a strain beyond the tip is returned to the tip.
"""

import functools
from types import SimpleNamespace

import warp as wp

from neuido.physics.effects import history_functions
from neuido.physics.laws import classical_kernels
from neuido.physics.linalg import warp_functions
from neuido.physics.linalg.warp_functions import GAP
from neuido.physics.runtime.device import start_warp
from neuido.physics.runtime.once import cached

STEPS = 8
"""Steps of Newton's method for `yield_index`. It starts within ln 2 of a convex function's root and converges quadratically."""


@cached
def build(real: type) -> SimpleNamespace:
    """Return the kernels for `wp.float32` or `wp.float64`."""
    start_warp()
    vec3 = wp.types.vector(length=3, dtype=real)
    mat33 = wp.types.matrix(shape=(3, 3), dtype=real)
    name = f"neuido.flow.{real.__name__}"
    func = functools.partial(wp.func, module=name)
    kernel = functools.partial(wp.kernel, module=name, enable_backward=False)
    own = warp_functions.functions(real)
    frame, compose, eigen, hencky, exp_slope = own.frame, own.compose, own.eigen, own.hencky, own.exp_slope
    inverse_stretch, log_difference = own.inverse_stretch, own.log_difference
    shared = history_functions.functions(real, name)
    load, store, gather, spread, deviator = shared.load, shared.store, shared.gather, shared.spread, shared.deviator
    half_turn, rotation, add_spin_adjoint = shared.half_turn, shared.rotation, shared.add_spin_adjoint
    mean_of, bound, scale_of = shared.mean_of, shared.bound, shared.scale_of
    zero = wp.constant(real(0.0))
    half = wp.constant(real(0.5))
    one = wp.constant(real(1.0))
    two = wp.constant(real(2.0))
    three = wp.constant(real(3.0))
    gap = wp.constant(real(GAP))
    MISES = wp.constant(classical_kernels.VON_MISES)
    NEWTON = wp.constant(STEPS)
    CONE = wp.constant(classical_kernels.DRUCKER_PRAGER)

    @func
    def may_flow(F: mat33, beta: mat33, two_mu: real, limit: real):
        return two_mu * bound(F) + wp.sqrt(wp.ddot(beta, beta)) > limit

    @func
    def overstress(e: vec3, U: mat33, beta: mat33, two_mu: real):
        return compose(U, two_mu * (e - mean_of(e))) - beta

    @func
    def principal(N: mat33, U: mat33, turned: bool):
        """Return eigenvalues and eigenvectors of the flow direction N; without a backstress the eigenvectors are those of the strain."""
        n = wp.get_diag(wp.transpose(U) * N * U)
        Z = U
        if turned:
            n, Z = eigen(N)
        return n, Z

    @func
    def plastic_step(over: real, total: real, eta: real, n: real, h: real):
        """Return dgamma for the overstress over = total dgamma + eta (dgamma/h)^n, over > 0."""
        out = over / (total + eta / h)
        if n != one and eta > zero:
            # ln(total e^y + eta (e^y/h)^n) is convex in y = ln dgamma, and its slope lies between 1 and n
            y = wp.min(wp.log(over / total), wp.log(h) + wp.log(over / eta) / n)
            for _step in range(NEWTON):
                linear = total * wp.exp(y)
                power = eta * wp.exp(n * (y - wp.log(h)))
                y -= wp.log((linear + power) / over) * (linear + power) / (linear + n * power)
            out = wp.exp(y)
        return out

    @func
    def step_slope(step: real, total: real, eta: real, n: real, h: real):
        """Return the derivative of the overstress with respect to dgamma, total + eta n (dgamma/h)^(n - 1)/h."""
        out = total + eta / h
        if n != one:
            out = total + eta * n * wp.pow(step / h, n - one) / h
        return out

    @kernel
    def flow(
        scene: wp.array(dtype=wp.int32),
        dt: wp.array(dtype=real),
        kinds: wp.array(dtype=wp.int32),
        table: wp.array2d(dtype=real),
        stiffness: wp.array(dtype=real),
        growth: wp.array(dtype=real),
        alpha_column: int,
        backstress_column: int,
        F: wp.array(dtype=mat33),
        C: wp.array(dtype=mat33),
        history: wp.array2d(dtype=real),
        F_next: wp.array(dtype=mat33),
        history_next: wp.array2d(dtype=real),
    ):
        """Correct a trial F by von Mises or Drucker-Prager flow, and write the history after the step."""
        p = wp.tid()
        s = scene[p]
        Fp = F[p]
        kind = kinds[s]
        out = Fp
        scale = scale_of(p, s, stiffness, growth)
        alpha = zero
        if alpha_column >= 0:
            alpha = history[p, alpha_column]
        beta = mat33()
        if backstress_column >= 0:
            R = rotation(half_turn(C[p], dt[s]))
            beta = R * load(history, p, backstress_column) * wp.transpose(R)
        if kind == MISES:
            two_mu = table[s, 0] * scale
            soft = wp.exp(-table[s, 3] * alpha)
            limit = (one / table[s, 1] + table[s, 2] * alpha) * soft
            if table[s, 1] > zero and may_flow(Fp, beta, two_mu, limit):
                U, d, _V = frame(Fp)
                N = overstress(hencky(d), U, beta, two_mu)
                q = wp.sqrt(wp.ddot(N, N))
                if q > limit:
                    step = plastic_step(q - limit, two_mu + table[s, 4] + table[s, 2] * soft, table[s, 5], table[s, 8], dt[s])
                    N = N / q
                    n, Z = principal(N, U, backstress_column >= 0)
                    x = -step * n
                    change = compose(Z, vec3(x[0] * exp_slope(x[0]), x[1] * exp_slope(x[1]), x[2] * exp_slope(x[2])))
                    out = Fp + change * Fp
                    alpha += step
                    beta = beta + (table[s, 4] * step) * N
        elif kind == CONE:
            U, d, V = frame(Fp)
            e = hencky(d)
            trace = e[0] + e[1] + e[2]
            mean = mean_of(e)
            q = wp.length(e - mean)
            tip = table[s, 7] / scale
            radius = table[s, 6] * (tip - trace)
            if trace > tip:
                z = (tip / three) * exp_slope(tip / three)
                out = Fp + U * wp.diag(vec3(z - d[0], z - d[1], z - d[2])) * wp.transpose(V)
            elif q > radius:
                x = (radius / q - one) * (e - mean)
                c = vec3(x[0] * exp_slope(x[0]), x[1] * exp_slope(x[1]), x[2] * exp_slope(x[2]))
                out = Fp + U * wp.diag(wp.cw_mul(vec3(wp.exp(e[0]), wp.exp(e[1]), wp.exp(e[2])), c)) * wp.transpose(V)
        F_next[p] = out
        if alpha_column >= 0:
            history_next[p, alpha_column] = alpha
        if backstress_column >= 0:
            store(history_next, p, backstress_column, beta)

    @kernel
    def flow_adjoint(
        scene: wp.array(dtype=wp.int32),
        dt: wp.array(dtype=real),
        kinds: wp.array(dtype=wp.int32),
        table: wp.array2d(dtype=real),
        stiffness: wp.array(dtype=real),
        growth: wp.array(dtype=real),
        alpha_column: int,
        backstress_column: int,
        F: wp.array(dtype=mat33),
        C: wp.array(dtype=mat33),
        history: wp.array2d(dtype=real),
        a_F_next: wp.array(dtype=mat33),
        a_history_next: wp.array2d(dtype=real),
        a_F: wp.array(dtype=mat33),
        a_C: wp.array(dtype=mat33),
        a_history: wp.array2d(dtype=real),
        a_table: wp.array2d(dtype=real),
        a_stiffness: wp.array(dtype=real),
        a_growth: wp.array(dtype=real),
    ):
        """Add to the adjoints of all inputs of `flow`; a_F is the adjoint of the trial gradient."""
        p = wp.tid()
        s = scene[p]
        Fp = F[p]
        kind = kinds[s]
        A = a_F_next[p]
        scale = scale_of(p, s, stiffness, growth)
        a_log = zero
        alpha = zero
        a_alpha = zero
        if alpha_column >= 0:
            alpha = history[p, alpha_column]
            a_alpha = a_history_next[p, alpha_column]
        beta = mat33()
        a_beta = mat33()
        R = wp.identity(n=3, dtype=real)
        if backstress_column >= 0:
            R = rotation(half_turn(C[p], dt[s]))
            beta = R * load(history, p, backstress_column) * wp.transpose(R)
            a_beta = gather(a_history_next, p, backstress_column)
        grad = A
        if kind == MISES:
            two_mu = table[s, 0] * scale
            soft = wp.exp(-table[s, 3] * alpha)
            hard = one / table[s, 1] + table[s, 2] * alpha
            if table[s, 1] > zero and may_flow(Fp, beta, two_mu, hard * soft):
                U, d, V = frame(Fp)
                e = hencky(d)
                X = overstress(e, U, beta, two_mu)
                q = wp.sqrt(wp.ddot(X, X))
                if q > hard * soft:
                    H_k = table[s, 4]
                    eta = table[s, 5]
                    index = table[s, 8]
                    total = two_mu + H_k + table[s, 2] * soft
                    step = plastic_step(q - hard * soft, total, eta, index, dt[s])
                    N = X / q
                    n, Z = principal(N, U, backstress_column >= 0)
                    x = -step * n
                    P = compose(Z, vec3(wp.exp(x[0]), wp.exp(x[1]), wp.exp(x[2])))
                    grad = P * A
                    S = A * wp.transpose(Fp)
                    S = wp.transpose(Z) * (half * (S + wp.transpose(S))) * Z
                    for i in range(3):
                        for l in range(3):
                            S[i, l] = S[i, l] * wp.exp(x[i]) * exp_slope(x[l] - x[i])
                    S = Z * S * wp.transpose(Z)
                    bN = wp.ddot(a_beta, N)
                    a_step = a_alpha + H_k * bN - wp.ddot(S, N)
                    a_N = step * (H_k * a_beta - S)
                    a_q = a_step / step_slope(step, total, eta, index, dt[s])
                    a_total = -a_q * step
                    power = wp.pow(step / dt[s], index)
                    a_X = (one / q) * (a_N - wp.ddot(a_N, N) * N) + a_q * N
                    a_soft = a_total * table[s, 2] - a_q * hard
                    dev = e - mean_of(e)
                    L = wp.transpose(U) * a_X * U
                    a_two_mu = a_total + L[0, 0] * dev[0] + L[1, 1] * dev[1] + L[2, 2] * dev[2]
                    wp.atomic_add(a_table, s, 0, a_two_mu * scale)
                    wp.atomic_add(a_table, s, 1, a_q * soft / (table[s, 1] * table[s, 1]))
                    wp.atomic_add(a_table, s, 2, a_total * soft - a_q * alpha * soft)
                    wp.atomic_add(a_table, s, 3, -a_soft * alpha * soft)
                    wp.atomic_add(a_table, s, 4, a_total + step * bN)
                    wp.atomic_add(a_table, s, 5, -a_q * power)
                    if power > zero:
                        wp.atomic_add(a_table, s, 8, -a_q * eta * power * wp.log(step / dt[s]))
                    a_log = a_two_mu * two_mu
                    a_alpha = a_alpha - a_q * table[s, 2] * soft - a_soft * table[s, 3] * soft
                    a_beta = a_beta - a_X
                    L = two_mu * deviator(L)
                    B = mat33()
                    inv = inverse_stretch(d)
                    for i in range(3):
                        B[i, i] = L[i, i] * inv[i]
                        for l in range(3):
                            if i != l:
                                pair = wp.max(two + d[i] + d[l], gap)
                                B[i, l] = (L[i, l] + L[l, i]) * (one + d[l]) * log_difference(d[i], d[l]) / pair
                    grad = grad + U * B * wp.transpose(V)
        elif kind == CONE:
            U, d, V = frame(Fp)
            e = hencky(d)
            trace = e[0] + e[1] + e[2]
            mean = mean_of(e)
            q = wp.length(e - mean)
            tip = table[s, 7] / scale
            radius = table[s, 6] * (tip - trace)
            M = wp.transpose(U) * A * V
            B = mat33()
            if trace > tip:
                size = wp.exp(tip / three)
                for i in range(3):
                    for l in range(3):
                        if i != l:
                            B[i, l] = size * (M[i, l] - M[l, i]) / wp.max(two + d[i] + d[l], gap)
                grad = U * B * wp.transpose(V)
                a_tip = wp.trace(M) * size / three
                wp.atomic_add(a_table, s, 7, a_tip / scale)
                a_log = -a_tip * tip
            elif q > radius:
                ratio = radius / q
                n = (e - mean) / q
                inv = inverse_stretch(d)
                z = vec3(wp.exp(mean[0] + radius * n[0]), wp.exp(mean[0] + radius * n[1]), wp.exp(mean[0] + radius * n[2]))
                g = wp.cw_mul(wp.get_diag(M), z)
                along = wp.dot(g, n)
                g_mean = mean_of(g)
                for i in range(3):
                    B[i, i] = inv[i] * (g_mean[i] - table[s, 6] * along + ratio * (g[i] - g_mean[i] - along * n[i]))
                    for l in range(3):
                        if i != l:
                            sym = z[i] * exp_slope(ratio * (e[l] - e[i])) * ratio * log_difference(d[i], d[l])
                            skew = (z[i] + z[l]) / wp.max(two + d[i] + d[l], gap)
                            B[i, l] = half * (sym * (M[i, l] + M[l, i]) + skew * (M[i, l] - M[l, i]))
                grad = U * B * wp.transpose(V)
                wp.atomic_add(a_table, s, 6, (tip - trace) * along)
                wp.atomic_add(a_table, s, 7, table[s, 6] * along / scale)
                a_log = -table[s, 6] * along * tip
        a_F[p] = a_F[p] + grad
        if stiffness:
            a_stiffness[p] = a_stiffness[p] + a_log / stiffness[p]
        if growth:
            wp.atomic_add(a_growth, s, a_log / growth[s])
        if alpha_column >= 0:
            a_history[p, alpha_column] = a_history[p, alpha_column] + a_alpha
        if backstress_column >= 0:
            aR = a_beta * R
            spread(a_history, p, backstress_column, wp.transpose(R) * aR)
            add_spin_adjoint(a_C, p, C[p], dt[s], two * (aR * load(history, p, backstress_column)))

    return SimpleNamespace(flow=flow, flow_adjoint=flow_adjoint)
