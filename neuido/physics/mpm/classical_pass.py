"""Kernels of a whole substep of a particle under classical laws: gather, correction, stress, scatter; and their adjoints.

A warp processes 32 particles of one scene. The gradients of the laws' parameters are summed by warp.
"""

import functools
from types import SimpleNamespace

import warp as wp

from neuido.physics.laws import classical_kernels
from neuido.physics.mpm.kernels import particle_functions
from neuido.physics.runtime.device import start_warp
from neuido.physics.runtime.once import cached


@cached
def build(real: type, corrects: bool, turns: int) -> SimpleNamespace:
    """Return the kernels `advance` and `retreat`, as `network_pass` has them.

    Args:
        real: `wp.float32` or `wp.float64`.
        corrects: Whether there is a plastic law.
        turns: As for `particle_functions.functions`.
    """
    start_warp()
    name = f"neuido.substep.{real.__name__}.{'corrected' if corrects else 'elastic'}.{turns}"
    kernel = functools.partial(wp.kernel, module=name, enable_backward=False)
    # a module of their own: a run without gradients never compiles them
    adjoint_kernel = functools.partial(wp.kernel, module=f"{name}.backward", enable_backward=False)
    func = functools.partial(wp.func, module=name)
    law, move = classical_kernels.kernels(real).functions, particle_functions.functions(real, name, turns)
    stress_of, stress_gradient, correct, correction_gradient, warp_sum = law
    gather, watch, scatter = move.gather, move.watch, move.scatter
    gather_adjoint, scatter_adjoint = move.gather_adjoint, move.scatter_adjoint
    mat33 = move.mat33
    reals, ints, tables = wp.array(dtype=real), wp.array(dtype=wp.int32), wp.array2d(dtype=real)
    vectors, quads, matrices = wp.array(dtype=move.vec3), wp.array(dtype=move.vec4), wp.array(dtype=mat33)

    @func
    def add_share(shares: tables, warp: int, column: int, value: real):
        total = warp_sum(value, 0)
        if total != real(0.0):
            wp.atomic_add(shares, warp, column, total)

    if corrects:

        @func
        def corrected(F: mat33, s: int, kinds: ints, params: tables):
            row = wp.min(s, params.shape[0] - 1)
            return correct(F, kinds[row], params[row, 0])

        @func
        def corrected_adjoint(F: mat33, g: mat33, s: int, kinds: ints, params: tables):
            row = wp.min(s, params.shape[0] - 1)
            a, share = correction_gradient(F, kinds[row], params[row, 0], g)
            return a, share

    else:

        @func
        def corrected(F: mat33, s: int, kinds: ints, params: tables):
            return F

        @func
        def corrected_adjoint(F: mat33, g: mat33, s: int, kinds: ints, params: tables):
            return g, real(0.0)

    @kernel
    def advance(
        scenes: ints, firsts: ints, lasts: ints, held: wp.array(dtype=wp.uint8), origin: vectors, dx: reals, dt: reals, nodes: wp.vec3i,
        mass: reals, volume: reals, velocity: quads, x: vectors, F: matrices,
        x_next: vectors, v_next: vectors, C_next: matrices, trial: matrices, F_next: matrices, tau: matrices, grid: quads,
        step: int, status: ints, lowest: reals, since: ints, kinds: ints, params: tables, p_kinds: ints, p_params: tables,
    ):  # fmt: skip
        """As in `network_pass`; `kinds` and `params` as in `classical_kernels`."""
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
        after = corrected(before, s, p_kinds, p_params)
        row = wp.min(s, params.shape[0] - 1)
        stress = stress_of(after, kinds[row], params[row, 0], params[row, 1])
        if live == 1:
            x_next[p] = y
            v_next[p] = v
            C_next[p] = C
            F_next[p] = after
            if trial:
                trial[p] = before
            if tau:
                tau[p] = stress
            watch(p, s, y, v, before, hold, origin, dx, dt, nodes, step, status, lowest, since)
        scatter(y, v, C, stress, mass[p], volume[p], s, origin, dx, dt, nodes, grid, live)

    @adjoint_kernel
    def retreat(
        scenes: ints, firsts: ints, lasts: ints, held: wp.array(dtype=wp.uint8), origin: vectors, dx: reals, dt: reals, nodes: wp.vec3i,
        mass: reals, volume: reals, x_before: vectors, F_before: matrices, trial: matrices, velocity: quads,
        x: vectors, v: vectors, C: matrices, F: matrices, tau: matrices, a_grid: quads, g_x: vectors, g_v: vectors, g_C: matrices,
        g_F: matrices, a_mass: reals, a_x: vectors, a_F: matrices, a_velocity: quads,
        kinds: ints, params: tables, shares: tables, p_kinds: ints, p_params: tables, p_shares: tables,
    ):  # fmt: skip
        """As in `network_pass`; `shares` and `p_shares` are the gradients of the parameters by warp, added to, or absent."""
        tid = wp.tid()
        warp = tid / 32
        p = firsts[warp] + tid % 32
        live = int(1)
        if p >= lasts[warp]:
            live = int(0)
            p = lasts[warp] - 1
        s = scenes[warp]
        ax, av, aC, a_tau, am = scatter_adjoint(x[p], v[p], C[p], tau[p], mass[p], volume[p], s, origin, dx, dt, nodes, a_grid)
        if live == 1:
            if a_mass:
                a_mass[p] = a_mass[p] + am
        row = wp.min(s, params.shape[0] - 1)
        aF, shear, bulk = stress_gradient(F[p], kinds[row], params[row, 0], params[row, 1], a_tau)
        if shares:
            if live == 0:
                shear = real(0.0)
                bulk = real(0.0)
            add_share(shares, warp, 0, shear)
            add_share(shares, warp, 1, bulk)
        aF = aF + a_F[p]
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
        a_trial, share = corrected_adjoint(at, aF, s, p_kinds, p_params)
        if p_shares:
            if live == 0:
                share = real(0.0)
            add_share(p_shares, warp, 0, share)
        bx, bF = gather_adjoint(x_before[p], F_before[p], held[p], v[p], C[p], ax, av, aC, a_trial, s, origin, dx, dt, nodes,
                                velocity, a_velocity, live)  # fmt: skip
        if live == 1:
            a_x[p] = bx
            a_F[p] = bF

    return SimpleNamespace(advance=advance, retreat=retreat)
