"""Kernels of the transfers alone, with the sums of `particle_functions`, between launches of laws of any kind."""

import functools
from types import SimpleNamespace

import warp as wp

from neuido.physics.mpm.kernels import particle_functions
from neuido.physics.runtime.device import start_warp
from neuido.physics.runtime.once import cached


@cached
def build(real: type, turns: int) -> SimpleNamespace:
    """Return the kernels `pull` (G2P and the trial gradient), `push` (P2G) and their adjoints, for one scalar type."""
    start_warp()
    name = f"neuido.substep.{real.__name__}.transfers.{turns}"
    kernel = functools.partial(wp.kernel, module=name, enable_backward=False)
    # a module of their own: a run without gradients never compiles them
    adjoint_kernel = functools.partial(wp.kernel, module=f"{name}.backward", enable_backward=False)
    move = particle_functions.functions(real, name, turns)
    gather, watch, scatter = move.gather, move.watch, move.scatter
    gather_adjoint, scatter_adjoint = move.gather_adjoint, move.scatter_adjoint
    reals, ints, held_type = wp.array(dtype=real), wp.array(dtype=wp.int32), wp.array(dtype=wp.uint8)
    vectors, quads, matrices = wp.array(dtype=move.vec3), wp.array(dtype=move.vec4), wp.array(dtype=move.mat33)

    @kernel
    def pull(
        scenes: ints, firsts: ints, lasts: ints, held: held_type, origin: vectors, dx: reals, dt: reals, nodes: wp.vec3i,
        mass: reals, volume: reals, velocity: quads, x: vectors, F: matrices, x_next: vectors, v_next: vectors, C_next: matrices,
        trial: matrices, step: int, status: ints, lowest: reals, since: ints,
    ):  # fmt: skip
        tid = wp.tid()
        warp = tid / 32
        p = firsts[warp] + tid % 32
        if p < lasts[warp]:
            s = scenes[warp]
            v, C = gather(x[p], held[p], s, origin, dx, nodes, velocity)
            y = x[p] + dt[s] * v
            after = F[p] + dt[s] * (C * F[p])
            x_next[p] = y
            v_next[p] = v
            C_next[p] = C
            trial[p] = after
            watch(p, s, y, v, after, held[p], origin, dx, dt, nodes, step, status, lowest, since)

    @kernel
    def push(
        scenes: ints, firsts: ints, lasts: ints, held: held_type, origin: vectors, dx: reals, dt: reals, nodes: wp.vec3i,
        mass: reals, volume: reals, x: vectors, v: vectors, C: matrices, tau: matrices, grid: quads,
    ):  # fmt: skip
        tid = wp.tid()
        warp = tid / 32
        p = firsts[warp] + tid % 32
        live = int(1)
        if p >= lasts[warp]:
            live = int(0)
            p = lasts[warp] - 1
        scatter(x[p], v[p], C[p], tau[p], mass[p], volume[p], scenes[warp], origin, dx, dt, nodes, grid, live)

    @adjoint_kernel
    def push_adjoint(
        scenes: ints, firsts: ints, lasts: ints, held: held_type, origin: vectors, dx: reals, dt: reals, nodes: wp.vec3i,
        mass: reals, volume: reals, x: vectors, v: vectors, C: matrices, tau: matrices, a_grid: quads,
        a_mass: reals, a_x: vectors, a_v: vectors, a_C: matrices, a_tau: matrices,
    ):  # fmt: skip
        """Add to a_x and to a_mass, which may be absent; write the others."""
        tid = wp.tid()
        warp = tid / 32
        p = firsts[warp] + tid % 32
        if p < lasts[warp]:
            bx, bv, bC, bt, bm = scatter_adjoint(x[p], v[p], C[p], tau[p], mass[p], volume[p], scenes[warp], origin, dx, dt, nodes, a_grid)
            a_x[p] = a_x[p] + bx
            a_v[p] = bv
            a_C[p] = bC
            a_tau[p] = bt
            if a_mass:
                a_mass[p] = a_mass[p] + bm

    @adjoint_kernel
    def pull_adjoint(
        scenes: ints, firsts: ints, lasts: ints, held: held_type, origin: vectors, dx: reals, dt: reals, nodes: wp.vec3i,
        mass: reals, volume: reals, velocity: quads, x: vectors, F: matrices, v_next: vectors, C_next: matrices,
        a_v: vectors, a_C: matrices, a_trial: matrices, a_x: vectors, a_F: matrices, a_velocity: quads,
    ):  # fmt: skip
        """Update a_x, write a_F, which may be a_trial, and add to a_velocity."""
        tid = wp.tid()
        warp = tid / 32
        p = firsts[warp] + tid % 32
        live = int(1)
        if p >= lasts[warp]:
            live = int(0)
            p = lasts[warp] - 1
        bx, bF = gather_adjoint(x[p], F[p], held[p], v_next[p], C_next[p], a_x[p], a_v[p], a_C[p], a_trial[p], scenes[warp], origin,
                                dx, dt, nodes, velocity, a_velocity, live)  # fmt: skip
        if live == 1:
            a_x[p] = bx
            a_F[p] = bF

    return SimpleNamespace(pull=pull, push=push, push_adjoint=push_adjoint, pull_adjoint=pull_adjoint)
