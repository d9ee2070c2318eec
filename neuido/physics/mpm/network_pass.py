"""Kernels of a whole substep of a particle under objective networks (float32): gather, correction, stress, scatter; and their adjoints.

A warp processes 32 or 16 particles of one scene, as in `fused`, whose networks these kernels contain.
"""

import functools
from types import SimpleNamespace

import warp as wp

from neuido.physics.laws.neural import fused
from neuido.physics.mpm.kernels import particle_functions
from neuido.physics.runtime.device import start_warp
from neuido.physics.runtime.once import cached


@cached
def build(width: int, kind: str, corrects: str | None, turns: int, per_warp: int) -> SimpleNamespace:
    """Return the kernels `advance` and `retreat`.

    Args:
        width: Hidden width of both networks, one of `fused.WIDTHS`.
        kind: Read-out of the elastic law, `fused.STRESS` or `fused.BOUNDED`.
        corrects: Read-out of the plastic law, `fused.CORRECTION` or `fused.RETURN`; None without a plastic law.
        turns: As for `particle_functions.functions`.
        per_warp: Particles of a warp, as for `fused.networks`.
    """
    start_warp()
    name = f"neuido.substep.{width}.{kind}.{corrects or 'elastic'}.{turns}.{per_warp}"
    kernel, adjoint_kernel = fused.kernels_of(name)
    func = functools.partial(wp.func, module=name)
    own, layers = fused.readout(kind, name), fused.networks(width, name, per_warp)
    move = particle_functions.functions(wp.float32, name, turns)
    features_of, stress_of = own.features_of, own.value
    stress_coefficients, stress_gradient = own.coefficients, own.gradient
    inner, inner_adjoint, inner_invariants, outputs = layers.network, layers.network_adjoint, own.strain_invariants, layers.outputs
    gather, watch, scatter = move.gather, move.watch, move.scatter
    gather_adjoint, scatter_adjoint = move.gather_adjoint, move.scatter_adjoint
    vec3, vec4, mat33, vec9, vecK = move.vec3, move.vec4, move.mat33, own.vec9, layers.vecK
    floats, ints = wp.array(dtype=wp.float32), wp.array(dtype=wp.int32)
    vectors, quads, matrices = wp.array(dtype=vec3), wp.array(dtype=vec4), wp.array(dtype=mat33)

    # called, and not written out at each call: a warp runs its code once, so that fetching it takes longer than running it
    shared_code = functools.partial(wp.func, module=name, inline=False)

    @shared_code
    def strain_invariants(F: mat33):
        N, h, l, A, q = inner_invariants(F)
        return N, h, l, A, q

    @shared_code
    def network(x: vec9, shared: int, scene: int, W1: floats, W2: floats, B2: floats, W3: floats, B3: floats):
        return inner(x, shared, scene, W1, W2, B2, W3, B3)

    @shared_code
    def network_adjoint(
        x: vec9, kept: vecK, gy: vec4, shared: int, scene: int, W1: floats, W2T: floats, W3T: floats, W1T: floats,
        warp: int, first: int, last: int, P3: floats, PB: floats, none: floats,
    ):  # fmt: skip
        return inner_adjoint(x, kept, gy, shared, scene, W1, W2T, W3T, W1T, warp, first, last, P3, PB, none, none, none)

    if corrects:
        plastic = fused.correction(own, name, corrects)
        correction_features, correction_of = plastic.features_of, plastic.value
        correction_coefficients, correction_gradient = plastic.coefficients, plastic.gradient

        @func
        def corrected(F: mat33, s: int, shared: int, rows: int, W1: floats, W2: floats, B2: floats, W3: floats, B3: floats, scale: float):
            N, h, l, A, q = strain_invariants(F)
            k = network(correction_features(l, A, q), wp.min(s, shared - 1), wp.min(s, rows - 1), W1, W2, B2, W3, B3)
            return correction_of(F, l, A, q, outputs(k), scale)

        @func
        def corrected_adjoint(
            F: mat33, g: mat33, s: int, warp: int, first: int, last: int, live: int, shared: int, rows: int,
            W1: floats, W2: floats, B2: floats, W3: floats, B3: floats, scale: float, W2T: floats, W3T: floats, W1T: floats,
            P3: floats, PB: floats, none: floats,
        ):  # fmt: skip
            N, h, l, A, q = strain_invariants(F)
            x = correction_features(l, A, q)
            k = network(x, wp.min(s, shared - 1), wp.min(s, rows - 1), W1, W2, B2, W3, B3)
            gy = correction_coefficients(F, l, A, q, outputs(k), scale, g)
            if live == 0:
                gy = vec4(0.0, 0.0, 0.0, 0.0)
            gx = network_adjoint(x, k, gy, wp.min(s, shared - 1), wp.min(s, rows - 1), W1, W2T, W3T, W1T, warp, first, last, P3, PB,
                                 none)  # fmt: skip
            N2, h2, l2, A2, q2 = strain_invariants(F)
            return correction_gradient(F, N2, h2, l2, A2, q2, outputs(k), scale, g, gx)

    else:

        @func
        def corrected(F: mat33, s: int, shared: int, rows: int, W1: floats, W2: floats, B2: floats, W3: floats, B3: floats, scale: float):
            return F

        @func
        def corrected_adjoint(
            F: mat33, g: mat33, s: int, warp: int, first: int, last: int, live: int, shared: int, rows: int,
            W1: floats, W2: floats, B2: floats, W3: floats, B3: floats, scale: float, W2T: floats, W3T: floats, W1T: floats,
            P3: floats, PB: floats, none: floats,
        ):  # fmt: skip
            return g

    @kernel
    def advance(
        scenes: ints, firsts: ints, lasts: ints, held: wp.array(dtype=wp.uint8), origin: vectors, dx: floats, dt: floats, nodes: wp.vec3i,
        mass: floats, volume: floats, velocity: quads, x: vectors, F: matrices,
        x_next: vectors, v_next: vectors, C_next: matrices, trial: matrices, F_next: matrices, tau: matrices, grid: quads,
        step: int, status: ints, lowest: floats, since: ints,
        shared: int, rows: int, W1: floats, W2: floats, B2: floats, W3: floats, B3: floats, scale: float,
        p_shared: int, p_rows: int, PW1: floats, PW2: floats, PB2: floats, PW3: floats, PB3: floats, p_scale: float,
    ):  # fmt: skip
        """From the nodal velocities of a substep to the momentum of the next one; `trial` and `tau` may be absent."""
        tid = wp.tid()
        warp = tid / 32
        p = firsts[warp] + tid % 32
        live = int(1)
        if p >= lasts[warp]:
            live = int(0)
            p = lasts[warp] - 1
        s = scenes[warp]
        hold = held[p]
        v, C = gather(x[p], hold, s, origin, dx, nodes, velocity)
        y = x[p] + dt[s] * v
        before = F[p] + dt[s] * (C * F[p])
        after = corrected(before, s, p_shared, p_rows, PW1, PW2, PB2, PW3, PB3, p_scale)
        if live == 1:
            x_next[p] = y
            v_next[p] = v
            C_next[p] = C
            F_next[p] = after
            if trial:
                trial[p] = before
            watch(p, s, y, v, before, hold, origin, dx, dt, nodes, step, status, lowest, since)
        N, h, l, A, q = strain_invariants(after)
        k = network(features_of(l, A, q), wp.min(s, shared - 1), wp.min(s, rows - 1), W1, W2, B2, W3, B3)
        stress = stress_of(after, l, A, q, outputs(k), scale)
        if live == 1:
            if tau:
                tau[p] = stress
        scatter(y, v, C, stress, mass[p], volume[p], s, origin, dx, dt, nodes, grid, live)

    @adjoint_kernel
    def retreat(
        scenes: ints, firsts: ints, lasts: ints, held: wp.array(dtype=wp.uint8), origin: vectors, dx: floats, dt: floats, nodes: wp.vec3i,
        mass: floats, volume: floats, x_before: vectors, F_before: matrices, trial: matrices, velocity: quads,
        x: vectors, v: vectors, C: matrices, F: matrices, tau: matrices, a_grid: quads, g_x: vectors, g_v: vectors, g_C: matrices,
        g_F: matrices, a_mass: floats, a_x: vectors, a_F: matrices, a_velocity: quads, none: floats,
        shared: int, rows: int, W1: floats, W2: floats, B2: floats, W3: floats, B3: floats, scale: float,
        W2T: floats, W3T: floats, W1T: floats, P3: floats, PB: floats,
        p_shared: int, p_rows: int, PW1: floats, PW2: floats, PB2: floats, PW3: floats, PB3: floats, p_scale: float,
        PW2T: floats, PW3T: floats, PW1T: floats, PP3: floats, PPB: floats,
    ):  # fmt: skip
        """From the adjoint of the momentum of a substep to that of the nodal velocities of the one before.

        x, v, C, F and tau are those that P2G read, `x_before`, `F_before` and `velocity` those that G2P read before. `g_x` to `g_F` are
        the adjoints of a frame, or absent. Updates a_x and a_F, and adds to a_mass, which may be absent, and to a_velocity.
        """
        tid = wp.tid()
        warp = tid / 32
        first = firsts[warp]
        last = lasts[warp]
        p = first + tid % 32
        live = int(1)
        if p >= last:
            live = int(0)
            p = last - 1
        s = scenes[warp]
        ax, av, aC, a_tau, am = scatter_adjoint(x[p], v[p], C[p], tau[p], mass[p], volume[p], s, origin, dx, dt, nodes, a_grid)
        if live == 1:
            if a_mass:
                a_mass[p] = a_mass[p] + am
        N, h, l, A, q = strain_invariants(F[p])
        features = features_of(l, A, q)
        k = network(features, wp.min(s, shared - 1), wp.min(s, rows - 1), W1, W2, B2, W3, B3)
        gy = stress_coefficients(F[p], l, A, q, outputs(k), scale, a_tau)
        if live == 0:
            gy = vec4(0.0, 0.0, 0.0, 0.0)
        gx = network_adjoint(features, k, gy, wp.min(s, shared - 1), wp.min(s, rows - 1), W1, W2T, W3T, W1T, warp, first, last, P3, PB,
                             none)  # fmt: skip
        # computed again, since keeping it would cost registers
        N2, h2, l2, A2, q2 = strain_invariants(F[p])
        aF = a_F[p] + stress_gradient(F[p], N2, h2, l2, A2, q2, outputs(k), scale, a_tau, gx)
        ax = ax + a_x[p]
        if g_x:
            ax = ax + g_x[p]
        if g_v:
            av = av + g_v[p]
        if g_C:
            aC = aC + g_C[p]
        if g_F:
            aF = aF + g_F[p]
        at = F_before[p]
        if trial:
            at = trial[p]
        a_trial = corrected_adjoint(at, aF, s, warp, first, last, live, p_shared, p_rows, PW1, PW2, PB2, PW3, PB3, p_scale,
                                    PW2T, PW3T, PW1T, PP3, PPB, none)  # fmt: skip
        bx, bF = gather_adjoint(x_before[p], F_before[p], held[p], v[p], C[p], ax, av, aC, a_trial, s, origin, dx, dt, nodes,
                                velocity, a_velocity, live)  # fmt: skip
        if live == 1:
            a_x[p] = bx
            a_F[p] = bF

    return SimpleNamespace(advance=advance, retreat=retreat)
