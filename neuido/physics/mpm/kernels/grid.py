"""Warp kernels of the grid update (gravity, body forces, colliders, clamps) and of viscous stress, with hand-written adjoints.

The loop over colliders carries a velocity from plane to plane. Warp's autodiff of such dynamic loops is silently wrong, so the adjoint here
recomputes the velocity before each plane.
"""

import functools
from types import SimpleNamespace

import warp as wp

from neuido.physics.colliders import contact as contact_functions
from neuido.physics.runtime.once import cached


@cached
def build(real: type, enable_backward: bool = False) -> SimpleNamespace:
    """Return the kernels for one scalar type; arguments as in `transfers.build`.

    `Effects.force_table` has the body forces of each scene: linear drag [1/s], quadratic drag [1/m], pull [1/s^2] and its centre x, y, z
    [m], (S, 6), and optionally the Magnus vector, stick and restitution [1/s], (S, 11).
    """
    vec3 = wp.types.vector(length=3, dtype=real)
    vec4 = wp.types.vector(length=4, dtype=real)
    mat33 = wp.types.matrix(shape=(3, 3), dtype=real)
    name = f"neuido.grid.{real.__name__}.{'autodiff' if enable_backward else 'adjoint'}"
    func = functools.partial(wp.func, module=name)
    kernel = functools.partial(wp.kernel, module=name, enable_backward=enable_backward)
    # a module of their own: a run without gradients never compiles them
    adjoint_kernel = functools.partial(wp.kernel, module=f"{name}.backward", enable_backward=False)
    adjoint_free = functools.partial(wp.kernel, module=name, enable_backward=False)

    met = contact_functions.functions(real, name)
    contact, contact_adjoint, damp_contact, normal_of = met.contact, met.contact_adjoint, met.damp_contact, met.normal_of

    @kernel
    def add_viscous_stress(
        scene: wp.array(dtype=wp.int32),
        viscosity: wp.array2d(dtype=real),
        C: wp.array(dtype=mat33),
        F: wp.array(dtype=mat33),
        tau: wp.array(dtype=mat33),
    ):
        """Add the Kelvin-Voigt stress J (2 eta dev D + zeta tr(D) I) with D = sym C to tau; `viscosity` has eta and zeta [Pa s]."""
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

    @func
    def node_position(c: wp.vec4i, origin: vec3, h: real):
        """Return the position of a node [m] from its three indices."""
        return origin + vec3(real(c[0]), real(c[1]), real(c[2])) * h

    @func
    def rotate(v: vec3, q: vec3):
        """Return v rotated by Cayley's rotation of the half-angle vector q, so that a force normal to v does no work."""
        t = wp.cross(q, v)
        return v + (real(2.0) / (real(1.0) + wp.dot(q, q))) * (t + wp.cross(q, t))

    @func
    def rotate_adjoint(v: vec3, q: vec3, a: vec3):
        """Return the adjoint of q for the adjoint a of the result; the adjoint of v is `rotate(a, -q)`."""
        s = real(2.0) / (real(1.0) + wp.dot(q, q))
        t = wp.cross(q, v)
        both = wp.dot(a, t + wp.cross(q, t))
        return s * (wp.cross(v, a) + wp.cross(t, a) + wp.cross(v, wp.cross(a, q))) - (s * s * both) * q

    @func
    def push(v0: vec3, x: vec3, dt: real, g: vec3, force: wp.array2d(dtype=real), row: int):
        """Return the nodal velocity after gravity and body forces; drag is integrated implicitly, so any coefficient is stable."""
        centre = vec3(force[row, 3], force[row, 4], force[row, 5])
        u = v0 + dt * (g - force[row, 2] * (x - centre))
        if force.shape[1] > 6:
            u = rotate(u, real(0.5) * dt * vec3(force[row, 6], force[row, 7], force[row, 8]))
        return u / (real(1.0) + dt * (force[row, 0] + force[row, 1] * wp.length(u)))

    @func
    def is_clamped(x: vec3, s: int, lower: wp.array2d(dtype=vec3), upper: wp.array2d(dtype=vec3), margin: real):
        """Return whether x lies in a clamp, or within `margin` of one."""
        inside = bool(False)
        around = vec3(margin, margin, margin)
        for b in range(lower.shape[1]):
            l = lower[s, b] - around
            u = upper[s, b] + around
            if x[0] >= l[0] and x[1] >= l[1] and x[2] >= l[2] and x[0] <= u[0] and x[1] <= u[1] and x[2] <= u[2]:
                inside = True
        return inside

    @func
    def collide(
        v: vec3,
        x: vec3,
        s: int,
        count: int,
        plane: wp.array2d(dtype=vec4),
        kind: wp.array2d(dtype=wp.int32),
        friction: wp.array2d(dtype=real),
        dt: real,
        force: wp.array2d(dtype=real),
    ):
        """Return the nodal velocity after the first `count` colliders."""
        out = v
        for c in range(count):
            n = normal_of(plane[s, c])
            if wp.dot(n, x) <= plane[s, c][3]:
                out = contact(out, n, kind[s, c], friction[s, c])
                if force.shape[1] > 6:
                    if kind[s, c] > 0:
                        out = damp_contact(out, n, dt, force, s)
        return out

    @adjoint_free
    def mark_nodes(
        origin: wp.array(dtype=vec3),
        dx: wp.array(dtype=real),
        plane: wp.array2d(dtype=vec4),
        lower: wp.array2d(dtype=vec3),
        upper: wp.array2d(dtype=vec3),
        index: wp.array(dtype=wp.vec4i),
        near: wp.array(dtype=wp.uint8),
    ):
        """Mark the nodes in a collider or a clamp, or within half a cell of one; `update_grid` looks at these alone more closely."""
        node = wp.tid()
        s = index[node][3]
        x = node_position(index[node], origin[s], dx[s])
        margin = real(0.5) * dx[s]
        found = int(0)
        for c in range(plane.shape[1]):
            if wp.dot(normal_of(plane[s, c]), x) <= plane[s, c][3] + margin:
                found = 1
        if is_clamped(x, s, lower, upper, margin):
            found = 1
        near[node] = wp.uint8(found)

    @kernel
    def update_grid(
        origin: wp.array(dtype=vec3),
        dx: wp.array(dtype=real),
        dt: wp.array(dtype=real),
        gravity: wp.array(dtype=vec3),
        force: wp.array2d(dtype=real),
        plane: wp.array2d(dtype=vec4),
        kind: wp.array2d(dtype=wp.int32),
        friction: wp.array2d(dtype=real),
        lower: wp.array2d(dtype=vec3),
        upper: wp.array2d(dtype=vec3),
        index: wp.array(dtype=wp.vec4i),
        near: wp.array(dtype=wp.uint8),
        chunk: int,
        grid: wp.array(dtype=vec4),
        velocity: wp.array(dtype=vec4),
        clear: bool,
    ):
        """Compute the velocity of each node from its momentum and mass; zero for an empty node. `near` is that of `mark_nodes`.

        `clear` empties the nodes for the next scatter, and leaves what an empty one has: no particle gives it weight.
        """
        first = wp.tid() * chunk
        for node in range(first, first + chunk):
            g = grid[node]
            out = vec3(real(0.0), real(0.0), real(0.0))
            if g[3] > real(0.0):
                if clear:
                    grid[node] = vec4(real(0.0), real(0.0), real(0.0), real(0.0))
                s = index[node][3]
                x = node_position(index[node], origin[s], dx[s])
                v0 = vec3(g[0], g[1], g[2]) / g[3]
                out = push(v0, x, dt[s], gravity[s], force, s)
                if near[node] != wp.uint8(0):
                    if is_clamped(x, s, lower, upper, real(0.0)):
                        out = vec3(real(0.0), real(0.0), real(0.0))
                    else:
                        out = collide(out, x, s, kind.shape[1], plane, kind, friction, dt[s], force)
            if g[3] > real(0.0) or not clear:
                velocity[node] = vec4(out[0], out[1], out[2], real(0.0))

    @adjoint_kernel
    def update_grid_adjoint(
        origin: wp.array(dtype=vec3),
        dx: wp.array(dtype=real),
        dt: wp.array(dtype=real),
        gravity: wp.array(dtype=vec3),
        force: wp.array2d(dtype=real),
        plane: wp.array2d(dtype=vec4),
        kind: wp.array2d(dtype=wp.int32),
        friction: wp.array2d(dtype=real),
        lower: wp.array2d(dtype=vec3),
        upper: wp.array2d(dtype=vec3),
        index: wp.array(dtype=wp.vec4i),
        near: wp.array(dtype=wp.uint8),
        chunk: int,
        grid: wp.array(dtype=vec4),
        a_velocity: wp.array(dtype=vec4),
        a_grid: wp.array(dtype=vec4),
        a_gravity: wp.array(dtype=vec3),
        a_force: wp.array2d(dtype=real),
        a_friction: wp.array2d(dtype=real),
        parameters: bool,
        clear: bool,
    ):
        """Write a_grid; add to the adjoints of gravity, body forces and friction where `parameters` is set.

        `clear` empties a_velocity for the next scatter; only a node with mass has anything there.
        """
        first = wp.tid() * chunk
        for node in range(first, first + chunk):
            g = grid[node]
            out = vec4(real(0.0), real(0.0), real(0.0), real(0.0))
            if g[3] > real(0.0):
                s = index[node][3]
                x = node_position(index[node], origin[s], dx[s])
                planes = int(0)
                free = bool(True)
                if near[node] != wp.uint8(0):
                    planes = kind.shape[1]
                    free = not is_clamped(x, s, lower, upper, real(0.0))
                if free:
                    v0 = vec3(g[0], g[1], g[2]) / g[3]
                    u = push(v0, x, dt[s], gravity[s], force, s)
                    av = a_velocity[node]
                    a = vec3(av[0], av[1], av[2])
                    for r in range(planes):
                        c = planes - 1 - r
                        n = normal_of(plane[s, c])
                        if wp.dot(n, x) <= plane[s, c][3]:
                            before = collide(u, x, s, c, plane, kind, friction, dt[s], force)
                            if force.shape[1] > 6:
                                if kind[s, c] > 0:
                                    after = contact(before, n, kind[s, c], friction[s, c])
                                    keep = wp.exp(-dt[s] * force[s, 9])
                                    bounce = wp.exp(-dt[s] * force[s, 10])
                                    vn = wp.dot(after, n)
                                    an = wp.dot(a, n)
                                    lost = wp.dot(a, after)
                                    if vn > real(0.0):
                                        lost = lost + (bounce - real(1.0)) * vn * an
                                        a = a + ((bounce - real(1.0)) * an) * n
                                        if parameters:
                                            wp.atomic_add(a_force, s, 10, -dt[s] * keep * bounce * vn * an)
                                    a = keep * a
                                    if parameters:
                                        wp.atomic_add(a_force, s, 9, -dt[s] * keep * lost)
                            b = contact_adjoint(before, n, kind[s, c], friction[s, c], a)
                            a = vec3(b[0], b[1], b[2])
                            if parameters:
                                wp.atomic_add(a_friction, s, c, b[3])
                    # the implicit drag: v = u / D, D = 1 + dt (c1 + c2 |u|)
                    centre = vec3(force[s, 3], force[s, 4], force[s, 5])
                    u = v0 + dt[s] * (gravity[s] - force[s, 2] * (x - centre))
                    q = vec3(real(0.0), real(0.0), real(0.0))
                    straight = u
                    if force.shape[1] > 6:
                        q = real(0.5) * dt[s] * vec3(force[s, 6], force[s, 7], force[s, 8])
                        u = rotate(u, q)
                    speed = wp.length(u)
                    D = real(1.0) + dt[s] * (force[s, 0] + force[s, 1] * speed)
                    aD = -wp.dot(a, u) / (D * D)
                    au = a / D
                    if speed > real(0.0):
                        au = au + (aD * dt[s] * force[s, 1] / speed) * u
                    if force.shape[1] > 6:
                        if parameters:
                            aq = real(0.5) * dt[s] * rotate_adjoint(straight, q, au)
                            wp.atomic_add(a_force, s, 6, aq[0])
                            wp.atomic_add(a_force, s, 7, aq[1])
                            wp.atomic_add(a_force, s, 8, aq[2])
                        au = rotate(au, -q)
                    if parameters:
                        wp.atomic_add(a_gravity, s, dt[s] * au)
                        wp.atomic_add(a_force, s, 0, dt[s] * aD)
                        wp.atomic_add(a_force, s, 1, dt[s] * speed * aD)
                        wp.atomic_add(a_force, s, 2, -dt[s] * wp.dot(au, x - centre))
                        wp.atomic_add(a_force, s, 3, dt[s] * force[s, 2] * au[0])
                        wp.atomic_add(a_force, s, 4, dt[s] * force[s, 2] * au[1])
                        wp.atomic_add(a_force, s, 5, dt[s] * force[s, 2] * au[2])
                    out = vec4(au[0], au[1], au[2], -wp.dot(au, v0)) / g[3]
                if clear:
                    a_velocity[node] = vec4(real(0.0), real(0.0), real(0.0), real(0.0))
            a_grid[node] = out

    return SimpleNamespace(
        add_viscous_stress=add_viscous_stress,
        add_viscous_stress_adjoint=add_viscous_stress_adjoint,
        mark_nodes=mark_nodes,
        update_grid=update_grid,
        update_grid_adjoint=update_grid_adjoint,
        functions=SimpleNamespace(push=push),
    )
