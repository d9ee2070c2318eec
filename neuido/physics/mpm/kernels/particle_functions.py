"""Warp functions of the transfers for kernels that do a whole substep of a particle: gather, motion, scatter, and their adjoints.

The formulas are those of `transfers`, whose kernels do one of these steps each.
"""

import functools
from types import SimpleNamespace

import warp as wp

from neuido.physics.mpm.kernels import stencil, tile_source
from neuido.physics.mpm.kernels.transfers import FAST, LOST
from neuido.physics.runtime.events import COLLAPSED


def functions(real: type, name: str, turns: int) -> SimpleNamespace:
    """Return the functions for one scalar type.

    Args:
        real: `wp.float32`, with sums by the source of `tile_source`, or `wp.float64`, with plain ones.
        name: Name of the Warp module that the functions belong to.
        turns: Turns of loops that are written out, `tile_source.ROLLED` or `tile_source.UNROLLED`.
    """
    vec3 = wp.types.vector(length=3, dtype=real)
    vec4 = wp.types.vector(length=4, dtype=real)
    mat33 = wp.types.matrix(shape=(3, 3), dtype=real)
    mat43 = wp.types.matrix(shape=(4, 3), dtype=real)
    func = functools.partial(wp.func, module=name)
    own = stencil.functions(real, name, native=False)
    spline, spline_slope, first_node, first_moment = own.spline, own.spline_slope, own.first_node, own.first_moment
    stencil_offset, column, in_grid = own.stencil_offset, own.column, own.in_grid

    if real is wp.float32:

        @wp.func_native(tile_source.LOAD4)
        def load4(a: wp.array(dtype=vec4), i: int) -> vec4: ...

        @wp.func_native(tile_source.unrolled(tile_source.GATHER4, turns))
        def moments(velocity: wp.array(dtype=vec4), node: int, ny: int, nz: int, wx: vec3, wy: vec3, wz: vec3) -> mat43: ...

        @wp.func_native(tile_source.unrolled(tile_source.SPREAD_TILE, turns))
        def spread(
            grid: wp.array(dtype=vec4), nx: int, ny: int, nz: int, size_y: int, size_z: int, wx: vec3, wy: vec3, wz: vec3,
            b: vec3, ax: vec3, ay: vec3, az: vec3, mass: real, live: int,
        ): ...  # fmt: skip

    else:
        moments, plain_spread = own.moments, own.spread

        @func
        def load4(a: wp.array(dtype=vec4), i: int):
            return a[i]

        @func
        def spread(
            grid: wp.array(dtype=vec4), nx: int, ny: int, nz: int, size_y: int, size_z: int, wx: vec3, wy: vec3, wz: vec3,
            b: vec3, ax: vec3, ay: vec3, az: vec3, mass: real, live: int,
        ):  # fmt: skip
            if live == 1:
                plain_spread(grid, (nx * size_y + ny) * size_z + nz, size_y, size_z, wx, wy, wz, b, ax, ay, az, mass, 0)

    @func
    def place(x: vec3, s: int, origin: wp.array(dtype=vec3), dx: wp.array(dtype=real), nodes: wp.vec3i):
        """Return the first node of the stencil and the distance to it in cells."""
        cells = (x - origin[s]) / dx[s]
        base = first_node(cells, nodes)
        return base, stencil_offset(cells, base)

    @func
    def gather(
        x: vec3, held: wp.uint8, s: int, origin: wp.array(dtype=vec3), dx: wp.array(dtype=real), nodes: wp.vec3i,
        velocity: wp.array(dtype=vec4),
    ):  # fmt: skip
        """Return velocity and affine velocity of a particle, from the nodes (G2P); zero if it is held."""
        v = vec3(real(0.0), real(0.0), real(0.0))
        C = wp.outer(v, v)
        if held == wp.uint8(0):
            base, f = place(x, s, origin, dx, nodes)
            node = ((s * nodes[0] + base[0]) * nodes[1] + base[1]) * nodes[2] + base[2]
            m = moments(velocity, node, nodes[1], nodes[2], spline(f[0]), spline(f[1]), spline(f[2]))
            v = vec3(m[0, 0], m[0, 1], m[0, 2])
            mx = vec3(m[1, 0], m[1, 1], m[1, 2])
            my = vec3(m[2, 0], m[2, 1], m[2, 2])
            mz = vec3(m[3, 0], m[3, 1], m[3, 2])
            C = (real(4.0) / dx[s]) * wp.matrix_from_cols(mx - f[0] * v, my - f[1] * v, mz - f[2] * v)
        return v, C

    @func
    def watch(
        p: int, s: int, y: vec3, v: vec3, trial: mat33, held: wp.uint8, origin: wp.array(dtype=vec3), dx: wp.array(dtype=real),
        dt: wp.array(dtype=real), nodes: wp.vec3i, step: int, status: wp.array(dtype=wp.int32), lowest: wp.array(dtype=real),
        since: wp.array(dtype=wp.int32),
    ):  # fmt: skip
        """Note a particle that is lost, too fast, not finite or collapsed, as `transfers.grid_to_particles` does."""
        if held == wp.uint8(0):
            J = wp.determinant(trial)
            if J < wp.static(real(COLLAPSED)):
                lowest[p] = wp.min(lowest[p], J)
                if since[p] < 0:
                    since[p] = step
            code = int(0)
            if not (wp.length(v) * dt[s] < dx[s]):
                code = wp.static(FAST)
            if not in_grid(y, origin[s], dx[s], nodes):
                code = wp.max(code, wp.static(LOST))
            if code > 0:
                if wp.atomic_cas(status, 3 * s, 0, code) == 0:
                    status[3 * s + 1] = p
                    status[3 * s + 2] = step

    @func
    def scatter(
        x: vec3, v: vec3, C: mat33, tau: mat33, m: real, volume: real, s: int, origin: wp.array(dtype=vec3), dx: wp.array(dtype=real),
        dt: wp.array(dtype=real), nodes: wp.vec3i, grid: wp.array(dtype=vec4), live: int,
    ):  # fmt: skip
        """Add momentum [kg m/s] and mass [kg] of a particle to its nodes (P2G); all lanes of a warp take part."""
        h = dx[s]
        base, f = place(x, s, origin, dx, nodes)
        hA = h * m * C - (dt[s] * volume * real(4.0) / h) * tau
        b = m * v - hA * f
        spread(grid, s * nodes[0] + base[0], base[1], base[2], nodes[1], nodes[2], spline(f[0]), spline(f[1]), spline(f[2]),
               b, column(hA, 0), column(hA, 1), column(hA, 2), m, live)  # fmt: skip

    @func
    def scatter_adjoint(
        x: vec3, v: vec3, C: mat33, tau: mat33, m: real, volume: real, s: int, origin: wp.array(dtype=vec3), dx: wp.array(dtype=real),
        dt: wp.array(dtype=real), nodes: wp.vec3i, a_grid: wp.array(dtype=vec4),
    ):  # fmt: skip
        """Return what P2G adds to the adjoints of x, v, C, tau and the mass."""
        h = dx[s]
        base, f = place(x, s, origin, dx, nodes)
        wx = spline(f[0])
        wy = spline(f[1])
        wz = spline(f[2])
        ix = first_moment(wx)
        iy = first_moment(wy)
        iz = first_moment(wz)
        gx = spline_slope(f[0])
        gy = spline_slope(f[1])
        gz = spline_slope(f[2])
        ratio = dt[s] * volume * real(4.0) / (h * h)
        hA = h * (m * C - ratio * tau)
        ax = column(hA, 0)
        ay = column(hA, 1)
        az = column(hA, 2)
        bi = m * v - hA * f
        node = ((s * nodes[0] + base[0]) * nodes[1] + base[1]) * nodes[2] + base[2]
        zero = vec3(real(0.0), real(0.0), real(0.0))
        s0 = zero
        sx = zero
        sy = zero
        sz = zero
        slope = zero
        sm = real(0.0)
        for i in range(3):
            bj = bi
            ti = zero
            tiy = zero
            tiz = zero
            pi = real(0.0)
            piy = real(0.0)
            piz = real(0.0)
            mi = real(0.0)
            for j in range(3):
                bk = bj
                tj = zero
                tjz = zero
                pj = real(0.0)
                pjz = real(0.0)
                mj = real(0.0)
                row = node + (i * nodes[1] + j) * nodes[2]
                for k in range(3):
                    g = load4(a_grid, row + k)
                    a = vec3(g[0], g[1], g[2])
                    phi = wp.dot(a, bk) + m * g[3]
                    tj += wz[k] * a
                    tjz += iz[k] * a
                    pj += wz[k] * phi
                    pjz += gz[k] * phi
                    mj += wz[k] * g[3]
                    bk = bk + az
                ti += wy[j] * tj
                tiy += iy[j] * tj
                tiz += wy[j] * tjz
                pi += wy[j] * pj
                piy += gy[j] * pj
                piz += wy[j] * pjz
                mi += wy[j] * mj
                bj = bj + ay
            s0 += wx[i] * ti
            sx += ix[i] * ti
            sy += wx[i] * tiy
            sz += wx[i] * tiz
            slope += vec3(gx[i] * pi, wx[i] * piy, wx[i] * piz)
            sm += wx[i] * mi
            bi = bi + ax
        s1 = h * wp.matrix_from_cols(sx - f[0] * s0, sy - f[1] * s0, sz - f[2] * s0)
        a_x = (slope - wp.transpose(hA) * s0) / h
        return a_x, m * s0, m * s1, -ratio * s1, wp.dot(s0, v) + wp.ddot(s1, C) + sm

    @func
    def gather_adjoint(
        x: vec3, F: mat33, held: wp.uint8, v_next: vec3, C_next: mat33, a_x: vec3, a_v: vec3, a_C: mat33, a_trial: mat33, s: int,
        origin: wp.array(dtype=vec3), dx: wp.array(dtype=real), dt: wp.array(dtype=real), nodes: wp.vec3i,
        velocity: wp.array(dtype=vec4), a_velocity: wp.array(dtype=vec4), live: int,
    ):  # fmt: skip
        """Return the adjoints of x and F before G2P, and add to those of the nodal velocities; all lanes of a warp take part."""
        h = dx[s]
        free = real(1.0)
        if held == wp.uint8(1):
            free = real(0.0)
        base, f = place(x, s, origin, dx, nodes)
        wx = spline(f[0])
        wy = spline(f[1])
        wz = spline(f[2])
        gx = spline_slope(f[0])
        gy = spline_slope(f[1])
        gz = spline_slope(f[2])
        a_F = a_trial + (free * dt[s]) * (wp.transpose(C_next) * a_trial)
        hB = (free * real(4.0) / h) * (a_C + dt[s] * (a_trial * wp.transpose(F)))
        bx = column(hB, 0)
        by = column(hB, 1)
        bz = column(hB, 2)
        q = free * (a_v + dt[s] * a_x) - hB * f
        node = ((s * nodes[0] + base[0]) * nodes[1] + base[1]) * nodes[2] + base[2]
        slope = vec3(real(0.0), real(0.0), real(0.0))
        qi = q
        for i in range(3):
            qj = qi
            pi = real(0.0)
            piy = real(0.0)
            piz = real(0.0)
            for j in range(3):
                qk = qj
                pj = real(0.0)
                pjz = real(0.0)
                row = node + (i * nodes[1] + j) * nodes[2]
                for k in range(3):
                    u = load4(velocity, row + k)
                    phi = wp.dot(qk, vec3(u[0], u[1], u[2]))
                    pj += wz[k] * phi
                    pjz += gz[k] * phi
                    qk = qk + bz
                pi += wy[j] * pj
                piy += gy[j] * pj
                piz += wy[j] * pjz
                qj = qj + by
            slope += vec3(gx[i] * pi, wx[i] * piy, wx[i] * piz)
            qi = qi + bx
        spread(a_velocity, s * nodes[0] + base[0], base[1], base[2], nodes[1], nodes[2], wx, wy, wz, q, bx, by, bz, real(0.0), live)
        return a_x + (slope - wp.transpose(hB) * v_next) / h, a_F

    return SimpleNamespace(
        vec3=vec3, vec4=vec4, mat33=mat33, gather=gather, watch=watch, scatter=scatter, scatter_adjoint=scatter_adjoint,
        gather_adjoint=gather_adjoint,
    )  # fmt: skip
