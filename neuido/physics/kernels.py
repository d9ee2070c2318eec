"""Warp kernels of one MLS-MPM substep and their hand-written adjoints, for float32 and float64, CPU and CUDA.

A substep (paper, appendix "Material Point Method"; the MLS form of Hu et al. 2018) moves P particles of S scenes at once.
Scene s has its own slab `grid[s]` of the four-dimensional grid, padded by PAD nodes on each side so that the quadratic
stencil of a particle in the domain never leaves it.

    particles_to_grid   tau, C, v -> momentum and mass of the nodes          k = 4/dx^2, A = m C - dt V0 k tau
    update_grid         nodal velocity: gravity, body forces, colliders, clamps
    grid_to_particles   v, C, x, and the trial F_tr = (I + dt C) F

`*_adjoint` kernels take the adjoint of what the forward kernel wrote and add to the adjoint of what it read. The adjoint of
the scatter is a gather and has no atomics; only the adjoint of the gather scatters.
"""

import functools
from types import SimpleNamespace

import torch
import warp as wp

PAD = 2
"""Nodes added on each side of the domain."""

STICKY, SLIP, SEPARATE = 1, 2, 3
CONTACTS = {"sticky": STICKY, "slip": SLIP, "separate": SEPARATE}

LOST, FAST = 1, 2
"""Codes in status[0]: a particle outside the padded grid; one that moves by more than a cell a substep, or is not finite."""

BODY_FORCE_SIZE = 6
"""Columns of the body-force table: linear drag [1/s], quadratic drag [1/m], pull [1/s^2], its centre x, y, z [m]."""


def start_warp() -> None:
    """Initialise Warp without its banner; safe to call again."""
    wp.config.log_level = max(wp.config.log_level, wp.LOG_WARNING)
    wp.init()


def real_of(dtype: torch.dtype) -> type:
    """The Warp scalar type of a torch float type."""
    return {torch.float32: wp.float32, torch.float64: wp.float64}[dtype]


@functools.cache
def build(real: type, enable_backward: bool = False) -> SimpleNamespace:
    """The kernels for one scalar type, compiled on first launch.

    Args:
        real: `wp.float32` or `wp.float64`.
        enable_backward: Also generate Warp's own adjoints (the oracle of the tests).

    Returns:
        A namespace of kernels and of the vector types `vec3`, `vec4`, `mat33`.
    """
    start_warp()
    vec3 = wp.types.vector(length=3, dtype=real)
    vec4 = wp.types.vector(length=4, dtype=real)
    mat33 = wp.types.matrix(shape=(3, 3), dtype=real)
    name = f"neuido.mpm.{real.__name__}.{'autodiff' if enable_backward else 'adjoint'}"
    func = functools.partial(wp.func, module=name)
    kernel = functools.partial(wp.kernel, module=name, enable_backward=enable_backward)
    adjoint_kernel = functools.partial(wp.kernel, module=name, enable_backward=False)

    @func
    def spline(f: real):
        """Quadratic B-spline weights of the three nodes; f in [0.5, 1.5) is the distance to the first one in cells."""
        a = real(1.5) - f
        b = f - real(1.0)
        c = f - real(0.5)
        return vec3(real(0.5) * a * a, real(0.75) - b * b, real(0.5) * c * c)

    @func
    def spline_slope(f: real):
        """Their derivative with respect to the position in cells."""
        return vec3(f - real(1.5), real(-2.0) * (f - real(1.0)), f - real(0.5))

    @func
    def first_node(x: vec3, origin: vec3, inv_dx: real, nx: int, ny: int, nz: int):
        """The lowest node of a particle's stencil, clamped into the grid (a lost particle is flagged elsewhere)."""
        i = int(wp.floor((x[0] - origin[0]) * inv_dx - real(0.5)))
        j = int(wp.floor((x[1] - origin[1]) * inv_dx - real(0.5)))
        k = int(wp.floor((x[2] - origin[2]) * inv_dx - real(0.5)))
        return wp.vec3i(wp.clamp(i, 0, nx - 3), wp.clamp(j, 0, ny - 3), wp.clamp(k, 0, nz - 3))

    @func
    def offset_in_cells(x: vec3, origin: vec3, inv_dx: real, base: wp.vec3i):
        f = (x - origin) * inv_dx
        return vec3(f[0] - real(base[0]), f[1] - real(base[1]), f[2] - real(base[2]))

    @func
    def arm(i: int, j: int, k: int, f: vec3, h: real):
        """From the particle to node (i, j, k) of its stencil [m]."""
        return vec3(real(i) - f[0], real(j) - f[1], real(k) - f[2]) * h

    @func
    def contact(v: vec3, n: vec3, kind: int, friction: real):
        """Velocity of a node inside a collider, from its velocity before."""
        vn = wp.dot(v, n)
        out = v
        if kind == wp.static(STICKY):
            out = vec3(real(0.0), real(0.0), real(0.0))
        elif kind == wp.static(SLIP):
            out = v - vn * n
        elif kind == wp.static(SEPARATE):
            if vn < real(0.0):
                t = v - vn * n
                speed = wp.length(t)
                if speed <= -friction * vn:
                    out = vec3(real(0.0), real(0.0), real(0.0))
                else:
                    out = t * (real(1.0) + friction * vn / wp.max(speed, real(1.0e-30)))
        return out

    @func
    def contact_adjoint(v: vec3, n: vec3, kind: int, friction: real, a: vec3):
        """Adjoint of `contact`: that of v (first three) and of the friction (last)."""
        vn = wp.dot(v, n)
        out = vec4(a[0], a[1], a[2], real(0.0))
        if kind == wp.static(STICKY):
            out = vec4(real(0.0), real(0.0), real(0.0), real(0.0))
        elif kind == wp.static(SLIP):
            b = a - wp.dot(a, n) * n
            out = vec4(b[0], b[1], b[2], real(0.0))
        elif kind == wp.static(SEPARATE):
            if vn < real(0.0):
                t = v - vn * n
                speed = wp.length(t)
                if speed <= -friction * vn:
                    out = vec4(real(0.0), real(0.0), real(0.0), real(0.0))
                else:
                    s = wp.max(speed, real(1.0e-30))
                    e = t / s
                    ea = wp.dot(e, a)
                    at = a + (friction * vn / s) * (a - ea * e)
                    at = at - wp.dot(at, n) * n
                    b = at + (friction * ea) * n
                    out = vec4(b[0], b[1], b[2], vn * ea)
        return out

    @kernel
    def add_viscous_stress(
        scene: wp.array(dtype=wp.int32),
        viscosity: wp.array2d(dtype=real),
        C: wp.array(dtype=mat33),
        F: wp.array(dtype=mat33),
        tau: wp.array(dtype=mat33),
    ):
        """tau += J (2 eta dev D + zeta tr(D) I), D = sym C: Kelvin-Voigt, columns eta (shear) and zeta (bulk) in Pa s."""
        p = wp.tid()
        s = wp.min(scene[p], viscosity.shape[0] - 1)
        D = real(0.5) * (C[p] + wp.transpose(C[p]))
        t = wp.trace(D)
        eta = viscosity[s, 0]
        i3 = wp.identity(n=3, dtype=real)
        tau[p] = tau[p] + wp.determinant(F[p]) * (real(2.0) * eta * D + (viscosity[s, 1] - real(2.0) / real(3.0) * eta) * t * i3)

    @adjoint_kernel
    def add_viscous_stress_adjoint(
        scene: wp.array(dtype=wp.int32),
        viscosity: wp.array2d(dtype=real),
        C: wp.array(dtype=mat33),
        F: wp.array(dtype=mat33),
        a_tau: wp.array(dtype=mat33),
        a_C: wp.array(dtype=mat33),
        a_F: wp.array(dtype=mat33),
        a_viscosity: wp.array2d(dtype=real),
    ):
        p = wp.tid()
        s = wp.min(scene[p], viscosity.shape[0] - 1)
        D = real(0.5) * (C[p] + wp.transpose(C[p]))
        t = wp.trace(D)
        J = wp.determinant(F[p])
        eta = viscosity[s, 0]
        zeta = viscosity[s, 1]
        A = real(0.5) * (a_tau[p] + wp.transpose(a_tau[p]))
        tA = wp.trace(A)
        AD = wp.ddot(A, D)
        shear = real(2.0) * (AD - t * tA / real(3.0))
        i3 = wp.identity(n=3, dtype=real)
        a_C[p] = a_C[p] + J * (real(2.0) * eta * (A - (tA / real(3.0)) * i3) + zeta * tA * i3)
        c0 = vec3(F[p][0, 0], F[p][1, 0], F[p][2, 0])
        c1 = vec3(F[p][0, 1], F[p][1, 1], F[p][2, 1])
        c2 = vec3(F[p][0, 2], F[p][1, 2], F[p][2, 2])
        cofactor = wp.matrix_from_cols(wp.cross(c1, c2), wp.cross(c2, c0), wp.cross(c0, c1))
        a_F[p] = a_F[p] + (eta * shear + zeta * t * tA) * cofactor
        wp.atomic_add(a_viscosity, s, 0, J * shear)
        wp.atomic_add(a_viscosity, s, 1, J * t * tA)

    @kernel
    def particles_to_grid(
        scene: wp.array(dtype=wp.int32),
        origin: wp.array(dtype=vec3),
        dx: wp.array(dtype=real),
        dt: wp.array(dtype=real),
        mass: wp.array(dtype=real),
        volume: wp.array(dtype=real),
        x: wp.array(dtype=vec3),
        v: wp.array(dtype=vec3),
        C: wp.array(dtype=mat33),
        tau: wp.array(dtype=mat33),
        grid: wp.array4d(dtype=vec4),
    ):
        """Nodes get (momentum [kg m/s], mass [kg]); `grid` must be zero before."""
        p = wp.tid()
        s = scene[p]
        h = dx[s]
        m = mass[p]
        base = first_node(x[p], origin[s], real(1.0) / h, grid.shape[1], grid.shape[2], grid.shape[3])
        f = offset_in_cells(x[p], origin[s], real(1.0) / h, base)
        wx = spline(f[0])
        wy = spline(f[1])
        wz = spline(f[2])
        A = m * C[p] - (dt[s] * volume[p] * real(4.0) / (h * h)) * tau[p]
        for i in range(3):
            for j in range(3):
                for k in range(3):
                    w = wx[i] * wy[j] * wz[k]
                    d = arm(i, j, k, f, h)
                    q = w * (m * v[p] + A * d)
                    wp.atomic_add(grid, s, base[0] + i, base[1] + j, base[2] + k, vec4(q[0], q[1], q[2], w * m))

    @adjoint_kernel
    def particles_to_grid_adjoint(
        scene: wp.array(dtype=wp.int32),
        origin: wp.array(dtype=vec3),
        dx: wp.array(dtype=real),
        dt: wp.array(dtype=real),
        mass: wp.array(dtype=real),
        volume: wp.array(dtype=real),
        x: wp.array(dtype=vec3),
        v: wp.array(dtype=vec3),
        C: wp.array(dtype=mat33),
        tau: wp.array(dtype=mat33),
        a_grid: wp.array4d(dtype=vec4),
        a_mass: wp.array(dtype=real),
        a_x: wp.array(dtype=vec3),
        a_v: wp.array(dtype=vec3),
        a_C: wp.array(dtype=mat33),
        a_tau: wp.array(dtype=mat33),
    ):
        """Adds to a_mass and a_x; writes a_v, a_C and a_tau."""
        p = wp.tid()
        s = scene[p]
        h = dx[s]
        m = mass[p]
        ratio = dt[s] * real(4.0) / (h * h)
        base = first_node(x[p], origin[s], real(1.0) / h, a_grid.shape[1], a_grid.shape[2], a_grid.shape[3])
        f = offset_in_cells(x[p], origin[s], real(1.0) / h, base)
        wx = spline(f[0])
        wy = spline(f[1])
        wz = spline(f[2])
        gx = spline_slope(f[0])
        gy = spline_slope(f[1])
        gz = spline_slope(f[2])
        A = m * C[p] - (ratio * volume[p]) * tau[p]
        At = wp.transpose(A)
        s0 = vec3(real(0.0), real(0.0), real(0.0))
        sx = vec3(real(0.0), real(0.0), real(0.0))
        s1 = wp.outer(s0, s0)
        sm = real(0.0)
        for i in range(3):
            for j in range(3):
                for k in range(3):
                    w = wx[i] * wy[j] * wz[k]
                    slope = vec3(gx[i] * wy[j] * wz[k], wx[i] * gy[j] * wz[k], wx[i] * wy[j] * gz[k]) / h
                    d = arm(i, j, k, f, h)
                    g = a_grid[s, base[0] + i, base[1] + j, base[2] + k]
                    a = vec3(g[0], g[1], g[2])
                    s0 += w * a
                    s1 += wp.outer(w * a, d)
                    sm += w * g[3]
                    sx += (wp.dot(a, m * v[p] + A * d) + m * g[3]) * slope - w * (At * a)
        a_v[p] = m * s0
        a_C[p] = m * s1
        a_tau[p] = -(ratio * volume[p]) * s1
        a_x[p] = a_x[p] + sx
        a_mass[p] = a_mass[p] + wp.dot(s0, v[p]) + wp.ddot(s1, C[p]) + sm

    @func
    def push(v0: vec3, x: vec3, dt: real, g: vec3, force: wp.array2d(dtype=real), row: int):
        """Nodal velocity after gravity and the body forces; drag is implicit in its size, so any coefficient is stable."""
        centre = vec3(force[row, 3], force[row, 4], force[row, 5])
        u = v0 + dt * (g - force[row, 2] * (x - centre))
        return u / (real(1.0) + dt * (force[row, 0] + force[row, 1] * wp.length(u)))

    @func
    def clamped(x: vec3, s: int, lower: wp.array2d(dtype=vec3), upper: wp.array2d(dtype=vec3)):
        inside = bool(False)
        for b in range(lower.shape[1]):
            l = lower[s, b]
            u = upper[s, b]
            if x[0] >= l[0] and x[1] >= l[1] and x[2] >= l[2] and x[0] <= u[0] and x[1] <= u[1] and x[2] <= u[2]:
                inside = True
        return inside

    @func
    def inside_plane(x: vec3, point: vec3, normal: vec3, h: real):
        # a node that lies on the plane to rounding counts as inside
        return wp.dot(x - point, normal) <= real(1.0e-4) * h

    @func
    def collide(
        v: vec3,
        x: vec3,
        h: real,
        s: int,
        count: int,
        point: wp.array2d(dtype=vec3),
        normal: wp.array2d(dtype=vec3),
        kind: wp.array2d(dtype=wp.int32),
        friction: wp.array2d(dtype=real),
    ):
        """The velocity after the first `count` colliders, in their order."""
        out = v
        for c in range(count):
            if kind[s, c] > 0:
                if inside_plane(x, point[s, c], normal[s, c], h):
                    out = contact(out, normal[s, c], kind[s, c], friction[s, c])
        return out

    @kernel
    def update_grid(
        origin: wp.array(dtype=vec3),
        dx: wp.array(dtype=real),
        dt: wp.array(dtype=real),
        gravity: wp.array(dtype=vec3),
        force: wp.array2d(dtype=real),
        point: wp.array2d(dtype=vec3),
        normal: wp.array2d(dtype=vec3),
        kind: wp.array2d(dtype=wp.int32),
        friction: wp.array2d(dtype=real),
        lower: wp.array2d(dtype=vec3),
        upper: wp.array2d(dtype=vec3),
        grid: wp.array4d(dtype=vec4),
        velocity: wp.array4d(dtype=vec3),
    ):
        s, i, j, k = wp.tid()
        g = grid[s, i, j, k]
        out = vec3(real(0.0), real(0.0), real(0.0))
        if g[3] > real(0.0):
            x = origin[s] + vec3(real(i), real(j), real(k)) * dx[s]
            if not clamped(x, s, lower, upper):
                v0 = vec3(g[0], g[1], g[2]) / g[3]
                u = push(v0, x, dt[s], gravity[s], force, s)
                out = collide(u, x, dx[s], s, kind.shape[1], point, normal, kind, friction)
        velocity[s, i, j, k] = out

    @adjoint_kernel
    def update_grid_adjoint(
        origin: wp.array(dtype=vec3),
        dx: wp.array(dtype=real),
        dt: wp.array(dtype=real),
        gravity: wp.array(dtype=vec3),
        force: wp.array2d(dtype=real),
        point: wp.array2d(dtype=vec3),
        normal: wp.array2d(dtype=vec3),
        kind: wp.array2d(dtype=wp.int32),
        friction: wp.array2d(dtype=real),
        lower: wp.array2d(dtype=vec3),
        upper: wp.array2d(dtype=vec3),
        grid: wp.array4d(dtype=vec4),
        a_velocity: wp.array4d(dtype=vec3),
        a_grid: wp.array4d(dtype=vec4),
        a_gravity: wp.array(dtype=vec3),
        a_force: wp.array2d(dtype=real),
        a_friction: wp.array2d(dtype=real),
        parameters: bool,
    ):
        """Writes a_grid; adds to the adjoints of gravity, body forces and friction where `parameters` is set."""
        s, i, j, k = wp.tid()
        g = grid[s, i, j, k]
        out = vec4(real(0.0), real(0.0), real(0.0), real(0.0))
        if g[3] > real(0.0):
            h = dx[s]
            x = origin[s] + vec3(real(i), real(j), real(k)) * h
            if not clamped(x, s, lower, upper):
                v0 = vec3(g[0], g[1], g[2]) / g[3]
                u = push(v0, x, dt[s], gravity[s], force, s)
                a = a_velocity[s, i, j, k]
                planes = kind.shape[1]
                for r in range(planes):
                    c = planes - 1 - r
                    if kind[s, c] > 0:
                        if inside_plane(x, point[s, c], normal[s, c], h):
                            before = collide(u, x, h, s, c, point, normal, kind, friction)
                            b = contact_adjoint(before, normal[s, c], kind[s, c], friction[s, c], a)
                            a = vec3(b[0], b[1], b[2])
                            if parameters:
                                wp.atomic_add(a_friction, s, c, b[3])
                # the implicit drag: v = u / D, D = 1 + dt (c1 + c2 |u|)
                centre = vec3(force[s, 3], force[s, 4], force[s, 5])
                u = v0 + dt[s] * (gravity[s] - force[s, 2] * (x - centre))
                speed = wp.length(u)
                D = real(1.0) + dt[s] * (force[s, 0] + force[s, 1] * speed)
                aD = -wp.dot(a, u) / (D * D)
                au = a / D
                if speed > real(0.0):
                    au = au + (aD * dt[s] * force[s, 1] / speed) * u
                if parameters:
                    wp.atomic_add(a_gravity, s, dt[s] * au)
                    wp.atomic_add(a_force, s, 0, dt[s] * aD)
                    wp.atomic_add(a_force, s, 1, dt[s] * speed * aD)
                    wp.atomic_add(a_force, s, 2, -dt[s] * wp.dot(au, x - centre))
                    wp.atomic_add(a_force, s, 3, dt[s] * force[s, 2] * au[0])
                    wp.atomic_add(a_force, s, 4, dt[s] * force[s, 2] * au[1])
                    wp.atomic_add(a_force, s, 5, dt[s] * force[s, 2] * au[2])
                out = vec4(au[0], au[1], au[2], -wp.dot(au, v0)) / g[3]
        a_grid[s, i, j, k] = out

    @kernel
    def grid_to_particles(
        scene: wp.array(dtype=wp.int32),
        held: wp.array(dtype=wp.uint8),
        origin: wp.array(dtype=vec3),
        dx: wp.array(dtype=real),
        dt: wp.array(dtype=real),
        velocity: wp.array4d(dtype=vec3),
        x: wp.array(dtype=vec3),
        F: wp.array(dtype=mat33),
        x_next: wp.array(dtype=vec3),
        v_next: wp.array(dtype=vec3),
        C_next: wp.array(dtype=mat33),
        F_trial: wp.array(dtype=mat33),
        step: int,
        status: wp.array(dtype=wp.int32),
    ):
        """Gather; a particle that is lost, too fast or not finite leaves its code, index and step in `status`."""
        p = wp.tid()
        s = scene[p]
        h = dx[s]
        zero = vec3(real(0.0), real(0.0), real(0.0))
        if held[p] == wp.uint8(1):
            x_next[p] = x[p]
            v_next[p] = zero
            C_next[p] = wp.outer(zero, zero)
            F_trial[p] = F[p]
            return
        base = first_node(x[p], origin[s], real(1.0) / h, velocity.shape[1], velocity.shape[2], velocity.shape[3])
        f = offset_in_cells(x[p], origin[s], real(1.0) / h, base)
        wx = spline(f[0])
        wy = spline(f[1])
        wz = spline(f[2])
        v = zero
        B = wp.outer(zero, zero)
        for i in range(3):
            for j in range(3):
                for k in range(3):
                    w = wx[i] * wy[j] * wz[k]
                    d = arm(i, j, k, f, h)
                    g = velocity[s, base[0] + i, base[1] + j, base[2] + k]
                    v += w * g
                    B += wp.outer(w * g, d)
        C = (real(4.0) / (h * h)) * B
        y = x[p] + dt[s] * v
        x_next[p] = y
        v_next[p] = v
        C_next[p] = C
        F_trial[p] = F[p] + dt[s] * (C * F[p])
        code = int(0)
        if not (wp.length(v) * dt[s] < h):
            code = wp.static(FAST)
        for axis in range(3):
            cell = (y[axis] - origin[s][axis]) / h
            if not (cell >= real(0.5) and cell <= real(velocity.shape[axis + 1]) - real(1.5)):
                code = wp.max(code, wp.static(LOST))
        if code > 0:
            if wp.atomic_cas(status, 0, 0, code) == 0:
                status[1] = p
                status[2] = step

    @adjoint_kernel
    def grid_to_particles_adjoint(
        scene: wp.array(dtype=wp.int32),
        held: wp.array(dtype=wp.uint8),
        origin: wp.array(dtype=vec3),
        dx: wp.array(dtype=real),
        dt: wp.array(dtype=real),
        velocity: wp.array4d(dtype=vec3),
        x: wp.array(dtype=vec3),
        F: wp.array(dtype=mat33),
        C_next: wp.array(dtype=mat33),
        a_x_next: wp.array(dtype=vec3),
        a_v_next: wp.array(dtype=vec3),
        a_C_next: wp.array(dtype=mat33),
        a_F_trial: wp.array(dtype=mat33),
        a_velocity: wp.array4d(dtype=vec3),
        a_x: wp.array(dtype=vec3),
        a_F: wp.array(dtype=mat33),
    ):
        """Adds to a_velocity (zero before); writes a_x and a_F."""
        p = wp.tid()
        s = scene[p]
        h = dx[s]
        if held[p] == wp.uint8(1):
            a_x[p] = a_x_next[p]
            a_F[p] = a_F_trial[p]
            return
        base = first_node(x[p], origin[s], real(1.0) / h, velocity.shape[1], velocity.shape[2], velocity.shape[3])
        f = offset_in_cells(x[p], origin[s], real(1.0) / h, base)
        wx = spline(f[0])
        wy = spline(f[1])
        wz = spline(f[2])
        gx = spline_slope(f[0])
        gy = spline_slope(f[1])
        gz = spline_slope(f[2])
        aF = a_F_trial[p]
        a_F[p] = aF + dt[s] * (wp.transpose(C_next[p]) * aF)
        aB = (real(4.0) / (h * h)) * (a_C_next[p] + dt[s] * (aF * wp.transpose(F[p])))
        aBt = wp.transpose(aB)
        av = a_v_next[p] + dt[s] * a_x_next[p]
        ax = a_x_next[p]
        for i in range(3):
            for j in range(3):
                for k in range(3):
                    w = wx[i] * wy[j] * wz[k]
                    slope = vec3(gx[i] * wy[j] * wz[k], wx[i] * gy[j] * wz[k], wx[i] * wy[j] * gz[k]) / h
                    d = arm(i, j, k, f, h)
                    u = velocity[s, base[0] + i, base[1] + j, base[2] + k]
                    q = av + aB * d
                    ax += wp.dot(q, u) * slope - w * (aBt * u)
                    wp.atomic_add(a_velocity, s, base[0] + i, base[1] + j, base[2] + k, w * q)
        a_x[p] = ax

    return SimpleNamespace(
        vec3=vec3,
        vec4=vec4,
        mat33=mat33,
        module=name,
        add_viscous_stress=add_viscous_stress,
        add_viscous_stress_adjoint=add_viscous_stress_adjoint,
        particles_to_grid=particles_to_grid,
        particles_to_grid_adjoint=particles_to_grid_adjoint,
        update_grid=update_grid,
        update_grid_adjoint=update_grid_adjoint,
        grid_to_particles=grid_to_particles,
        grid_to_particles_adjoint=grid_to_particles_adjoint,
    )
