"""Warp functions for the 27 nodes around a particle: weights, indices, and the sums between particle and nodes.

Weights are products over the axes, so the nodes are summed axis by axis, with about a third of the operations of a plain sum.
"""

import functools
from types import SimpleNamespace

import warp as wp

from neuido.physics.mpm.kernels.reductions import ARRANGE, GATHER, GATHER_ADJOINT, RUN, SPREAD, SPREAD_ADJOINT


def functions(real: type, module: str, *, native: bool) -> SimpleNamespace:
    """Return the functions for one scalar type and one Warp module.

    Args:
        real: `wp.float32` or `wp.float64`.
        module: Name of the Warp module whose kernels call them.
        native: Whether to sum by the C++ and CUDA source of `reductions`; float32 only, and Warp cannot differentiate it.
    """
    vec3 = wp.types.vector(length=3, dtype=real)
    vec4 = wp.types.vector(length=4, dtype=real)
    mat33 = wp.types.matrix(shape=(3, 3), dtype=real)
    mat43 = wp.types.matrix(shape=(4, 3), dtype=real)
    mat54 = wp.types.matrix(shape=(5, 4), dtype=real)
    func = functools.partial(wp.func, module=module)

    @func
    def velocity_of(q: vec4):
        return vec3(q[0], q[1], q[2])

    @func
    def first_moment(w: vec3):
        """Return the weights times the number of the node in the stencil, 0, 1 or 2."""
        return vec3(real(0.0), w[1], real(2.0) * w[2])

    if native:

        @wp.func_native(ARRANGE)
        def arrange(node: int) -> int: ...

        @wp.func_native(RUN)
        def run_of(node: int) -> int: ...

        @wp.func_native(SPREAD)
        def spread(
            grid: wp.array(dtype=vec4), node: int, ny: int, nz: int, wx: vec3, wy: vec3, wz: vec3,
            b: vec3, ax: vec3, ay: vec3, az: vec3, mass: real, run: int,
        ): ...  # fmt: skip

        @wp.func_native(SPREAD_ADJOINT)
        def spread_adjoint(
            grid: wp.array(dtype=vec4), node: int, ny: int, nz: int, wx: vec3, wy: vec3, wz: vec3, gx: vec3, gy: vec3, gz: vec3,
            b: vec3, ax: vec3, ay: vec3, az: vec3, mass: real,
        ) -> mat54: ...  # fmt: skip

        @wp.func_native(GATHER)
        def moments(velocity: wp.array(dtype=vec4), node: int, ny: int, nz: int, wx: vec3, wy: vec3, wz: vec3) -> mat43: ...

        @wp.func_native(GATHER_ADJOINT)
        def moments_adjoint(
            grid: wp.array(dtype=vec4), velocity: wp.array(dtype=vec4), node: int, ny: int, nz: int, wx: vec3, wy: vec3, wz: vec3,
            gx: vec3, gy: vec3, gz: vec3, b: vec3, ax: vec3, ay: vec3, az: vec3, run: int,
        ) -> vec3: ...  # fmt: skip

    else:

        @func
        def arrange(node: int):
            return 0

        @func
        def run_of(node: int):
            return 0

        @func
        def spread(
            grid: wp.array(dtype=vec4), node: int, ny: int, nz: int, wx: vec3, wy: vec3, wz: vec3,
            b: vec3, ax: vec3, ay: vec3, az: vec3, mass: real, run: int,
        ):  # fmt: skip
            bi = b
            for i in range(3):
                bj = bi
                for j in range(3):
                    bk = bj
                    wij = wx[i] * wy[j]
                    row = node + (i * ny + j) * nz
                    for k in range(3):
                        w = wij * wz[k]
                        wp.atomic_add(grid, row + k, vec4(w * bk[0], w * bk[1], w * bk[2], w * mass))
                        bk = bk + az
                    bj = bj + ay
                bi = bi + ax

        @func
        def spread_adjoint(
            grid: wp.array(dtype=vec4), node: int, ny: int, nz: int, wx: vec3, wy: vec3, wz: vec3, gx: vec3, gy: vec3, gz: vec3,
            b: vec3, ax: vec3, ay: vec3, az: vec3, mass: real,
        ):  # fmt: skip
            ix = first_moment(wx)
            iy = first_moment(wy)
            iz = first_moment(wz)
            none = vec4(real(0.0), real(0.0), real(0.0), real(0.0))
            s0 = none
            sx = none
            sy = none
            sz = none
            slope = vec3(real(0.0), real(0.0), real(0.0))
            bi = b
            for i in range(3):
                bj = bi
                ti = none
                tiy = none
                tiz = none
                pi = real(0.0)
                piy = real(0.0)
                piz = real(0.0)
                for j in range(3):
                    bk = bj
                    tj = none
                    tjz = none
                    pj = real(0.0)
                    pjz = real(0.0)
                    row = node + (i * ny + j) * nz
                    for k in range(3):
                        g = grid[row + k]
                        phi = wp.dot(velocity_of(g), bk) + mass * g[3]
                        tj += wz[k] * g
                        tjz += iz[k] * g
                        pj += wz[k] * phi
                        pjz += gz[k] * phi
                        bk = bk + az
                    ti += wy[j] * tj
                    tiy += iy[j] * tj
                    tiz += wy[j] * tjz
                    pi += wy[j] * pj
                    piy += gy[j] * pj
                    piz += wy[j] * pjz
                    bj = bj + ay
                s0 += wx[i] * ti
                sx += ix[i] * ti
                sy += wx[i] * tiy
                sz += wx[i] * tiz
                slope += vec3(gx[i] * pi, wx[i] * piy, wx[i] * piz)
                bi = bi + ax
            return wp.matrix_from_rows(s0, sx, sy, sz, vec4(slope[0], slope[1], slope[2], real(0.0)))

        @func
        def moments_adjoint(
            grid: wp.array(dtype=vec4), velocity: wp.array(dtype=vec4), node: int, ny: int, nz: int, wx: vec3, wy: vec3, wz: vec3,
            gx: vec3, gy: vec3, gz: vec3, b: vec3, ax: vec3, ay: vec3, az: vec3, run: int,
        ):  # fmt: skip
            slope = vec3(real(0.0), real(0.0), real(0.0))
            qi = b
            for i in range(3):
                qj = qi
                pi = real(0.0)
                piy = real(0.0)
                piz = real(0.0)
                for j in range(3):
                    qk = qj
                    pj = real(0.0)
                    pjz = real(0.0)
                    wij = wx[i] * wy[j]
                    row = node + (i * ny + j) * nz
                    for k in range(3):
                        w = wij * wz[k]
                        phi = wp.dot(qk, velocity_of(velocity[row + k]))
                        pj += wz[k] * phi
                        pjz += gz[k] * phi
                        wp.atomic_add(grid, row + k, vec4(w * qk[0], w * qk[1], w * qk[2], real(0.0)))
                        qk = qk + az
                    pi += wy[j] * pj
                    piy += gy[j] * pj
                    piz += wy[j] * pjz
                    qj = qj + ay
                slope += vec3(gx[i] * pi, wx[i] * piy, wx[i] * piz)
                qi = qi + ax
            return slope

        @func
        def moments(velocity: wp.array(dtype=vec4), node: int, ny: int, nz: int, wx: vec3, wy: vec3, wz: vec3):
            ix = first_moment(wx)
            iy = first_moment(wy)
            iz = first_moment(wz)
            v = vec3(real(0.0), real(0.0), real(0.0))
            vx = v
            vy = v
            vz = v
            for i in range(3):
                ui = vec3(real(0.0), real(0.0), real(0.0))
                uiy = ui
                uiz = ui
                for j in range(3):
                    row = node + (i * ny + j) * nz
                    u0 = velocity_of(velocity[row])
                    u1 = velocity_of(velocity[row + 1])
                    u2 = velocity_of(velocity[row + 2])
                    uj = wz[0] * u0 + wz[1] * u1 + wz[2] * u2
                    ui += wy[j] * uj
                    uiy += iy[j] * uj
                    uiz += wy[j] * (iz[1] * u1 + iz[2] * u2)
                v += wx[i] * ui
                vx += ix[i] * ui
                vy += wx[i] * uiy
                vz += wx[i] * uiz
            return wp.matrix_from_rows(v, vx, vy, vz)

    @func
    def spline(f: real):
        """Return the quadratic B-spline weights of the three nodes; f in [0.5, 1.5) is the distance to the first node in cells."""
        a = real(1.5) - f
        b = f - real(1.0)
        c = f - real(0.5)
        return vec3(real(0.5) * a * a, real(0.75) - b * b, real(0.5) * c * c)

    @func
    def spline_slope(f: real):
        """Return the derivatives of the B-spline weights with respect to the position in cells."""
        return vec3(f - real(1.5), real(-2.0) * (f - real(1.0)), f - real(0.5))

    @func
    def first_node(cells: vec3, nodes: wp.vec3i):
        """Return the first node of the stencil of a particle, clamped into the grid; `grid_to_particles` reports lost particles."""
        return wp.vec3i(
            wp.clamp(int(wp.floor(cells[0] - real(0.5))), 0, nodes[0] - 3),
            wp.clamp(int(wp.floor(cells[1] - real(0.5))), 0, nodes[1] - 3),
            wp.clamp(int(wp.floor(cells[2] - real(0.5))), 0, nodes[2] - 3),
        )

    @func
    def flat_index(s: int, node: wp.vec3i, nodes: wp.vec3i):
        return ((s * nodes[0] + node[0]) * nodes[1] + node[1]) * nodes[2] + node[2]

    @func
    def stencil(x: vec3, s: int, origin: wp.array(dtype=vec3), dx: wp.array(dtype=real), nodes: wp.vec3i):
        return flat_index(s, first_node((x - origin[s]) / dx[s], nodes), nodes)

    @func
    def stencil_offset(cells: vec3, base: wp.vec3i):
        """Return the distance to the first node of the stencil in cells."""
        return vec3(cells[0] - real(base[0]), cells[1] - real(base[1]), cells[2] - real(base[2]))

    @func
    def column(A: mat33, c: int):
        return vec3(A[0, c], A[1, c], A[2, c])

    @func
    def extend_span(span: wp.array(dtype=real), at: real):
        """Extend the range in `span` to include a value, unless `span` is empty."""
        if span.shape[0] > 0:
            wp.atomic_min(span, 0, at)
            wp.atomic_max(span, 1, at)

    @func
    def in_grid(y: vec3, origin: vec3, h: real, nodes: wp.vec3i):
        """Return whether the stencil of a particle at y lies in the padded grid."""
        c = y - origin
        least = real(0.5) * h
        return (
            c[0] >= least
            and c[1] >= least
            and c[2] >= least
            and c[0] <= (real(nodes[0]) - real(1.5)) * h
            and c[1] <= (real(nodes[1]) - real(1.5)) * h
            and c[2] <= (real(nodes[2]) - real(1.5)) * h
        )

    return SimpleNamespace(
        velocity_of=velocity_of,
        first_moment=first_moment,
        arrange=arrange,
        run_of=run_of,
        spread=spread,
        spread_adjoint=spread_adjoint,
        moments=moments,
        moments_adjoint=moments_adjoint,
        spline=spline,
        spline_slope=spline_slope,
        first_node=first_node,
        flat_index=flat_index,
        stencil=stencil,
        stencil_offset=stencil_offset,
        column=column,
        extend_span=extend_span,
        in_grid=in_grid,
    )
