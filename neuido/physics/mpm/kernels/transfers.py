"""Warp kernels of the transfers between particles and grid (P2G, G2P), with hand-written adjoints, for float32 and float64.

A substep (paper, appendix "Material Point Method"; MLS-MPM, Hu et al. 2018) moves P particles of S scenes at once. The grid is one array
over the nodes of all scenes, [scene, x, y, z] with z fastest. Each scene has PAD more nodes on each side of its domain, so that the
quadratic stencil of a particle in the domain lies in the array. A node has four numbers: (momentum, mass) or (velocity, 0).

    particles_to_grid   tau, C, v -> momentum and mass of the nodes          A = m C - dt V0 (4/dx^2) tau
    update_grid         nodal velocity: gravity, body forces, colliders, clamps (in `grid`)
    grid_to_particles   v, C, x, and the trial F_tr = (I + dt C) F

A kernel `*_adjoint` reads the adjoints of the forward kernel's outputs and adds to the adjoints of its inputs. The adjoint of P2G gathers
and needs no atomics; only the adjoint of G2P scatters. Weights are products over the axes, so the 27 nodes are summed axis by axis, with
about a third of the operations of a plain sum.
"""

import functools
from collections.abc import Callable
from types import SimpleNamespace

import warp as wp

from neuido.physics.mpm.kernels import grid as grid_functions
from neuido.physics.mpm.kernels import stencil as stencil_functions
from neuido.physics.runtime.device import start_warp
from neuido.physics.runtime.events import COLLAPSED
from neuido.physics.runtime.once import cached

PAD = 2
"""Nodes added on each side of the domain."""

LOST, FAST = 1, 2
"""Codes in the `status` of a scene: a particle left the padded grid; a particle moved by more than a cell per substep or is not finite."""


@cached
def build(real: type, enable_backward: bool = False) -> SimpleNamespace:
    """Return all kernels of a substep for one scalar type, compiled at their first launch.

    Args:
        real: `wp.float32` or `wp.float64`.
        enable_backward: Let Warp generate adjoints of the forward kernels too, for tests.

    Returns:
        A namespace of kernels, with those of `grid`.
    """
    start_warp()
    vec3 = wp.types.vector(length=3, dtype=real)
    vec4 = wp.types.vector(length=4, dtype=real)
    mat33 = wp.types.matrix(shape=(3, 3), dtype=real)
    name = f"neuido.mpm.{real.__name__}.{'autodiff' if enable_backward else 'adjoint'}"
    kernel = functools.partial(wp.kernel, module=name, enable_backward=enable_backward)
    # a module of their own: a run without gradients never compiles them
    adjoint_kernel = functools.partial(wp.kernel, module=f"{name}.backward", enable_backward=False)

    own = stencil_functions.functions(real, name, native=real is wp.float32 and not enable_backward)
    arrange, run_of, spline = own.arrange, own.run_of, own.spline
    spread, spread_adjoint, moments, moments_adjoint = own.spread, own.spread_adjoint, own.moments, own.moments_adjoint
    spline_slope, first_node, flat_index, stencil = own.spline_slope, own.first_node, own.flat_index, own.stencil
    stencil_offset, column, extend_span, in_grid = own.stencil_offset, own.column, own.extend_span, own.in_grid

    @kernel
    def particles_to_grid(
        scene: wp.array(dtype=wp.int32),
        origin: wp.array(dtype=vec3),
        dx: wp.array(dtype=real),
        dt: wp.array(dtype=real),
        nodes: wp.vec3i,
        mass: wp.array(dtype=real),
        volume: wp.array(dtype=real),
        x: wp.array(dtype=vec3),
        v: wp.array(dtype=vec3),
        C: wp.array(dtype=mat33),
        tau: wp.array(dtype=mat33),
        grid: wp.array(dtype=vec4),
    ):
        """Add momentum [kg m/s] and mass [kg] of the particles to the nodes; `grid` must be zero before."""
        p = wp.tid()
        p += arrange(stencil(x[p], scene[p], origin, dx, nodes))
        s = scene[p]
        h = dx[s]
        m = mass[p]
        cells = (x[p] - origin[s]) / h
        base = first_node(cells, nodes)
        f = stencil_offset(cells, base)
        wx = spline(f[0])
        wy = spline(f[1])
        wz = spline(f[2])
        hA = h * m * C[p] - (dt[s] * volume[p] * real(4.0) / h) * tau[p]
        ax = column(hA, 0)
        ay = column(hA, 1)
        az = column(hA, 2)
        bi = m * v[p] - hA * f
        node = flat_index(s, base, nodes)
        spread(grid, node, nodes[1], nodes[2], wx, wy, wz, bi, ax, ay, az, m, run_of(node))

    @adjoint_kernel
    def particles_to_grid_adjoint(
        scene: wp.array(dtype=wp.int32),
        origin: wp.array(dtype=vec3),
        dx: wp.array(dtype=real),
        dt: wp.array(dtype=real),
        nodes: wp.vec3i,
        mass: wp.array(dtype=real),
        volume: wp.array(dtype=real),
        x: wp.array(dtype=vec3),
        v: wp.array(dtype=vec3),
        C: wp.array(dtype=mat33),
        tau: wp.array(dtype=mat33),
        a_grid: wp.array(dtype=vec4),
        a_mass: wp.array(dtype=real),
        a_x: wp.array(dtype=vec3),
        a_v: wp.array(dtype=vec3),
        a_C: wp.array(dtype=mat33),
        a_tau: wp.array(dtype=mat33),
    ):
        """Add to a_mass and a_x; write a_v, a_C and a_tau."""
        p = wp.tid()
        s = scene[p]
        h = dx[s]
        m = mass[p]
        cells = (x[p] - origin[s]) / h
        base = first_node(cells, nodes)
        f = stencil_offset(cells, base)
        wx = spline(f[0])
        wy = spline(f[1])
        wz = spline(f[2])
        gx = spline_slope(f[0])
        gy = spline_slope(f[1])
        gz = spline_slope(f[2])
        ratio = dt[s] * volume[p] * real(4.0) / (h * h)
        hA = h * (m * C[p] - ratio * tau[p])
        first = m * v[p] - hA * f
        node = flat_index(s, base, nodes)
        sums = spread_adjoint(a_grid, node, nodes[1], nodes[2], wx, wy, wz, gx, gy, gz,
                              first, column(hA, 0), column(hA, 1), column(hA, 2), m)  # fmt: skip
        s0 = vec3(sums[0, 0], sums[0, 1], sums[0, 2])
        sx = vec3(sums[1, 0], sums[1, 1], sums[1, 2])
        sy = vec3(sums[2, 0], sums[2, 1], sums[2, 2])
        sz = vec3(sums[3, 0], sums[3, 1], sums[3, 2])
        slope = vec3(sums[4, 0], sums[4, 1], sums[4, 2])
        s1 = h * wp.matrix_from_cols(sx - f[0] * s0, sy - f[1] * s0, sz - f[2] * s0)
        a_v[p] = m * s0
        a_C[p] = m * s1
        a_tau[p] = -ratio * s1
        a_x[p] = a_x[p] + (slope - wp.transpose(hA) * s0) / h
        a_mass[p] = a_mass[p] + wp.dot(s0, v[p]) + wp.ddot(s1, C[p]) + sums[0, 3]

    def gather_kernel(decorate: Callable, compensated: bool) -> wp.Kernel:
        """Return G2P, built with or without the rests of x and F, whose branches all others would pay for."""

        @decorate
        def grid_to_particles(
            scene: wp.array(dtype=wp.int32),
            held: wp.array(dtype=wp.uint8),
            origin: wp.array(dtype=vec3),
            dx: wp.array(dtype=real),
            dt: wp.array(dtype=real),
            nodes: wp.vec3i,
            velocity: wp.array(dtype=vec4),
            x: wp.array(dtype=vec3),
            F: wp.array(dtype=mat33),
            x_next: wp.array(dtype=vec3),
            v_next: wp.array(dtype=vec3),
            C_next: wp.array(dtype=mat33),
            F_trial: wp.array(dtype=mat33),
            step: int,
            status: wp.array(dtype=wp.int32),
            span: wp.array(dtype=real),
            lowest: wp.array(dtype=real),
            since: wp.array(dtype=wp.int32),
            rest_x: wp.array(dtype=vec3),
            rest_F: wp.array(dtype=mat33),
        ):
            """Compute x, v, C and the trial F of the particles from the nodal velocities.

            The first particle of a scene that is lost, too fast or not finite writes a code, its index and the step into `status`. If
            `span` is not empty, it becomes the smallest and the largest x of the particles. A particle with a trial det F below
            `COLLAPSED` writes the smallest det F into `lowest` and the first such step into `since`. If `compensated`, `rest_x` and
            `rest_F` accumulate what the rounding of x and F leaves out.
            """
            p = wp.tid()
            s = scene[p]
            h = dx[s]
            zero = vec3(real(0.0), real(0.0), real(0.0))
            if held[p] == wp.uint8(1):
                x_next[p] = x[p]
                extend_span(span, x[p][0])
                v_next[p] = zero
                C_next[p] = wp.outer(zero, zero)
                F_trial[p] = F[p]
                return
            cells = (x[p] - origin[s]) / h
            base = first_node(cells, nodes)
            f = stencil_offset(cells, base)
            wx = spline(f[0])
            wy = spline(f[1])
            wz = spline(f[2])
            node = flat_index(s, base, nodes)
            m = moments(velocity, node, nodes[1], nodes[2], wx, wy, wz)
            v = m[0]
            C = (real(4.0) / h) * wp.matrix_from_cols(m[1] - f[0] * v, m[2] - f[1] * v, m[3] - f[2] * v)
            move = dt[s] * v
            change = dt[s] * (C * F[p])
            if wp.static(compensated):
                move += rest_x[p]
                change += rest_F[p]
            y = x[p] + move
            trial = F[p] + change
            if wp.static(compensated):
                rest_x[p] = move - (y - x[p])
                rest_F[p] = change - (trial - F[p])
            x_next[p] = y
            extend_span(span, y[0])
            v_next[p] = v
            C_next[p] = C
            F_trial[p] = trial
            J = wp.determinant(trial)
            if J < wp.static(real(COLLAPSED)):
                lowest[p] = wp.min(lowest[p], J)
                if since[p] < 0:
                    since[p] = step
            code = int(0)
            if not (dt[s] * dt[s] * wp.dot(v, v) < h * h):
                code = wp.static(FAST)
            if not in_grid(y, origin[s], h, nodes):
                code = wp.max(code, wp.static(LOST))
            if code > 0:
                if wp.atomic_cas(status, 3 * s, 0, code) == 0:
                    status[3 * s + 1] = p
                    status[3 * s + 2] = step

        return grid_to_particles

    grid_to_particles = gather_kernel(kernel, False)
    with_rests = gather_kernel(functools.partial(wp.kernel, module=f"{name}.rests", enable_backward=False), True)

    @adjoint_kernel
    def grid_to_particles_adjoint(
        scene: wp.array(dtype=wp.int32),
        held: wp.array(dtype=wp.uint8),
        origin: wp.array(dtype=vec3),
        dx: wp.array(dtype=real),
        dt: wp.array(dtype=real),
        nodes: wp.vec3i,
        velocity: wp.array(dtype=vec4),
        x: wp.array(dtype=vec3),
        F: wp.array(dtype=mat33),
        v_next: wp.array(dtype=vec3),
        C_next: wp.array(dtype=mat33),
        a_x_next: wp.array(dtype=vec3),
        a_v_next: wp.array(dtype=vec3),
        a_C_next: wp.array(dtype=mat33),
        a_F_trial: wp.array(dtype=mat33),
        a_velocity: wp.array(dtype=vec4),
        a_x: wp.array(dtype=vec3),
        a_F: wp.array(dtype=mat33),
    ):
        """Write a_x and a_F, and add to a_velocity, which must be zero before."""
        p = wp.tid()
        p += arrange(stencil(x[p], scene[p], origin, dx, nodes))
        s = scene[p]
        h = dx[s]
        free = real(1.0)  # a held particle takes part with nothing: the lanes of a warp add together
        if held[p] == wp.uint8(1):
            free = real(0.0)
        cells = (x[p] - origin[s]) / h
        base = first_node(cells, nodes)
        f = stencil_offset(cells, base)
        wx = spline(f[0])
        wy = spline(f[1])
        wz = spline(f[2])
        gx = spline_slope(f[0])
        gy = spline_slope(f[1])
        gz = spline_slope(f[2])
        aF = a_F_trial[p]
        a_F[p] = aF + (free * dt[s]) * (wp.transpose(C_next[p]) * aF)
        hB = (free * real(4.0) / h) * (a_C_next[p] + dt[s] * (aF * wp.transpose(F[p])))
        first = free * (a_v_next[p] + dt[s] * a_x_next[p]) - hB * f
        node = flat_index(s, base, nodes)
        slope = moments_adjoint(a_velocity, velocity, node, nodes[1], nodes[2], wx, wy, wz, gx, gy, gz,
                                first, column(hB, 0), column(hB, 1), column(hB, 2), run_of(node))  # fmt: skip
        a_x[p] = a_x_next[p] + (slope - wp.transpose(hB) * v_next[p]) / h

    @adjoint_kernel
    def trial_gradient(
        scene: wp.array(dtype=wp.int32),
        dt: wp.array(dtype=real),
        F: wp.array(dtype=mat33),
        C_next: wp.array(dtype=mat33),
        F_trial: wp.array(dtype=mat33),
    ):
        """Recompute the trial gradient as in `grid_to_particles`."""
        p = wp.tid()
        F_trial[p] = F[p] + dt[scene[p]] * (C_next[p] * F[p])

    return SimpleNamespace(
        module=name,
        trial_gradient=trial_gradient,
        particles_to_grid=particles_to_grid,
        particles_to_grid_adjoint=particles_to_grid_adjoint,
        grid_to_particles=grid_to_particles,
        grid_to_particles_with_rests=with_rests,
        grid_to_particles_adjoint=grid_to_particles_adjoint,
        **vars(grid_functions.build(real, enable_backward)),
    )
