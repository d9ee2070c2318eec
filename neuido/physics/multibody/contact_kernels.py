"""Warp kernels of the contact between bodies with a velocity field each, with hand-written adjoints.

At a node i, body f has the momentum p, the mass m, and the volume gradient G = sum_p V_p grad w_ip, which points into it and does not
depend on its density. The normal from a to b is G_b - G_a, normalised, or G_b or -G_a where one of these separates the particles of the two
around the node better by `BETTER`, as the separating axis of two convex bodies does. (At the edge of a block that slides on a plane the
gradient of the block is that of two faces; with the tilted mean the edge would plough.) Each pair that touches along the normal and
approaches receives

    J_a = -J_b = (m_a m_b / M) (r' - r),   r = v_a - v_b,   M: mass of all bodies at the node,

where r' is r after contact with Coulomb's friction. For two bodies this is the impulse that makes their velocities agree. With M
in place of m_a + m_b the impulses of several pairs at a node, all computed from the velocities before, dissipate too.

The loops over the 27 nodes of a particle are not unrolled, which would take a minute to compile. Whether a pair touches is a branch, and
has no derivative. A node belongs to one thread, which visits its pairs one after the other.
"""

import functools
from collections.abc import Callable
from types import SimpleNamespace

import warp as wp

from neuido.physics.runtime.device import start_warp
from neuido.physics.runtime.once import cached

FAR = -1.0e30
"""Reach of a body without particles near a node [m]."""
BETTER = 0.1
"""Overlap along an axis that makes another one the normal [cells]. The gradients of evenly filled bodies turn by some degrees from node to
node, which moves an overlap by less; their mean turns less than each."""


@cached
def build(real: type, stencil: Callable[..., SimpleNamespace]) -> SimpleNamespace:
    """Return the kernels for one scalar type, compiled at their first launch.

    Args:
        real: `wp.float32` or `wp.float64`.
        stencil: Returns the functions of the transfers' weights (`mpm.stencil.functions`).
    """
    start_warp()
    vec2 = wp.types.vector(length=2, dtype=real)
    vec3 = wp.types.vector(length=3, dtype=real)
    vec4 = wp.types.vector(length=4, dtype=real)
    name = f"neuido.contact.{real.__name__}"
    func = functools.partial(wp.func, module=name)
    kernel = functools.partial(wp.kernel, module=name, enable_backward=False)
    own = stencil(real, name, native=False)
    spline, spline_slope, first_node, stencil_offset = own.spline, own.spline_slope, own.first_node, own.stencil_offset
    flat_index, velocity_of = own.flat_index, own.velocity_of

    @kernel
    def find_shared(
        first: wp.array(dtype=wp.int32),
        size: int,
        chunk: int,
        grid: wp.array(dtype=vec4),
        shared: wp.array(dtype=wp.int32),
        gradient: wp.array(dtype=vec3),
        reach: wp.array2d(dtype=real),
    ):
        """Mark the nodes that several bodies reach, and clear what `add_gradients` and `find_reach` write there."""
        begin = wp.tid() * chunk
        for at in range(begin, begin + chunk):
            s = at // size
            count = int(0)
            for f in range(first[s], first[s + 1]):
                if grid[f * size + at - s * size][3] > real(0.0):
                    count += 1
            shared[at] = count
            if count > 1:
                for f in range(first[s], first[s + 1]):
                    gradient[f * size + at - s * size] = vec3(real(0.0), real(0.0), real(0.0))
                    for c in range(reach.shape[1]):
                        reach[f * size + at - s * size, c] = wp.static(real(FAR))

    @kernel
    def add_gradients(
        field: wp.array(dtype=wp.int32),
        scene: wp.array(dtype=wp.int32),
        origin: wp.array(dtype=vec3),
        dx: wp.array(dtype=real),
        x: wp.array(dtype=vec3),
        volume: wp.array(dtype=real),
        nodes: wp.vec3i,
        shared: wp.array(dtype=wp.int32),
        gradient: wp.array(dtype=vec3),
    ):
        """Add V_p grad w_ip [m^2] of the particles at shared nodes."""
        p = wp.tid()
        f = field[p]
        h = dx[f]
        cells = (x[p] - origin[f]) / h
        base = first_node(cells, nodes)
        o = stencil_offset(cells, base)
        wx = spline(o[0])
        wy = spline(o[1])
        wz = spline(o[2])
        gx = spline_slope(o[0])
        gy = spline_slope(o[1])
        gz = spline_slope(o[2])
        mine = flat_index(f, base, nodes)
        its = flat_index(scene[p], base, nodes)
        scale = -volume[p] / h  # the slope is that in the position of the particle
        for c in range(27):
            i = c // 9
            j = c // 3 % 3
            k = c % 3
            row = (i * nodes[1] + j) * nodes[2]
            if shared[its + row + k] > 1:
                g = vec3(gx[i] * wy[j] * wz[k], wx[i] * gy[j] * wz[k], wx[i] * wy[j] * gz[k])
                wp.atomic_add(gradient, mine + row + k, scale * g)

    @kernel
    def add_gradients_adjoint(
        field: wp.array(dtype=wp.int32),
        scene: wp.array(dtype=wp.int32),
        origin: wp.array(dtype=vec3),
        dx: wp.array(dtype=real),
        x: wp.array(dtype=vec3),
        volume: wp.array(dtype=real),
        nodes: wp.vec3i,
        shared: wp.array(dtype=wp.int32),
        a_gradient: wp.array(dtype=vec3),
        a_x: wp.array(dtype=vec3),
    ):
        """Add to a_x."""
        p = wp.tid()
        f = field[p]
        h = dx[f]
        cells = (x[p] - origin[f]) / h
        base = first_node(cells, nodes)
        o = stencil_offset(cells, base)
        wx = spline(o[0])
        wy = spline(o[1])
        wz = spline(o[2])
        gx = spline_slope(o[0])
        gy = spline_slope(o[1])
        gz = spline_slope(o[2])
        bend = vec3(real(1.0), real(-2.0), real(1.0))
        mine = flat_index(f, base, nodes)
        its = flat_index(scene[p], base, nodes)
        sx = real(0.0)
        sy = real(0.0)
        sz = real(0.0)
        for c in range(27):
            i = c // 9
            j = c // 3 % 3
            k = c % 3
            row = (i * nodes[1] + j) * nodes[2]
            if shared[its + row + k] > 1:
                a = a_gradient[mine + row + k]
                xy = gx[i] * gy[j] * wz[k]
                xz = gx[i] * wy[j] * gz[k]
                yz = wx[i] * gy[j] * gz[k]
                sx += bend[i] * wy[j] * wz[k] * a[0] + xy * a[1] + xz * a[2]
                sy += xy * a[0] + wx[i] * bend[j] * wz[k] * a[1] + yz * a[2]
                sz += xz * a[0] + yz * a[1] + wx[i] * wy[j] * bend[k] * a[2]
        a_x[p] = a_x[p] - (volume[p] / (h * h)) * vec3(sx, sy, sz)

    @kernel
    def find_reach(
        field: wp.array(dtype=wp.int32),
        scene: wp.array(dtype=wp.int32),
        origin: wp.array(dtype=vec3),
        dx: wp.array(dtype=real),
        x: wp.array(dtype=vec3),
        volume: wp.array(dtype=real),
        nodes: wp.vec3i,
        first: wp.array(dtype=wp.int32),
        shared: wp.array(dtype=wp.int32),
        gradient: wp.array(dtype=vec3),
        reach: wp.array2d(dtype=real),
    ):
        """Find how far the particles of a body extend beyond each shared node [m]: out of itself, and into each other body.

        Column c of `reach` is along the gradient of body c of the scene, column B + c along the mean of it and that of the body itself, B
        bodies in all. A particle extends by half its edge, the cube root of its volume.
        """
        p = wp.tid()
        f = field[p]
        s = scene[p]
        h = dx[f]
        base = first_node((x[p] - origin[f]) / h, nodes)
        size = nodes[0] * nodes[1] * nodes[2]
        local = flat_index(0, base, nodes)
        half = real(0.5) * wp.pow(volume[p], real(1.0 / 3.0))
        for c in range(27):
            i = c // 9
            j = c // 3 % 3
            k = c % 3
            row = local + (i * nodes[1] + j) * nodes[2] + k
            if shared[s * size + row] > 1:
                arm = x[p] - (origin[f] + vec3(real(base[0] + i), real(base[1] + j), real(base[2] + k)) * h)
                for g in range(first[s], first[s + 1]):
                    d = gradient[g * size + row]
                    length = wp.length(d)
                    if length > real(0.0):
                        along = wp.dot(d, arm) / length
                        if g == f:
                            along = -along
                        wp.atomic_max(reach, f * size + row, g - first[s], along + half)
                    d = d - gradient[f * size + row]
                    length = wp.length(d)
                    if length > real(0.0):
                        wp.atomic_max(reach, f * size + row, reach.shape[1] / 2 + g - first[s], wp.dot(d, arm) / length + half)

    @func
    def sides(a: int, b: int, begin: int, at: int, size: int, tolerance: real, reach: wp.array2d(dtype=real)):
        """Return the factors of the gradients of a and b in the normal from a to b at a node; zero where the bodies do not touch."""
        ra = a * size + at
        rb = b * size + at
        half = reach.shape[1] / 2
        by_a = reach[ra, a - begin] + reach[rb, a - begin]
        by_b = reach[ra, b - begin] + reach[rb, b - begin]
        overlap = reach[ra, half + b - begin] + reach[rb, half + a - begin]
        out = vec2(real(-1.0), real(1.0))
        least = overlap - tolerance
        if by_a < least and by_a > wp.static(real(0.5 * FAR)):
            least = by_a
            overlap = by_a
            out = vec2(real(-1.0), real(0.0))
        if by_b < least and by_b > wp.static(real(0.5 * FAR)):
            overlap = by_b
            out = vec2(real(0.0), real(1.0))
        if overlap < real(0.0):
            out = vec2(real(0.0), real(0.0))
        return out

    @func
    def change(r: vec3, n: vec3, friction: real):
        """Return the change of the relative velocity r by contact; n points from the first body to the second."""
        rn = wp.dot(r, n)
        out = vec3(real(0.0), real(0.0), real(0.0))
        if rn > real(0.0):
            t = r - rn * n
            speed = wp.length(t)
            if speed < friction * rn:
                out = -r
            else:
                out = -rn * (n + (friction / wp.max(speed, real(1.0e-30))) * t)
        return out

    @kernel
    def exchange(
        first: wp.array(dtype=wp.int32),
        size: int,
        chunk: int,
        bodies: int,
        dx: wp.array(dtype=real),
        friction: wp.array2d(dtype=real),
        shared: wp.array(dtype=wp.int32),
        gradient: wp.array(dtype=vec3),
        reach: wp.array2d(dtype=real),
        grid: wp.array(dtype=vec4),
        out: wp.array(dtype=vec4),
    ):
        """Write momentum and mass of the nodes after contact."""
        begin = wp.tid() * chunk
        for at in range(begin, begin + chunk):
            s = at // size
            node = at - s * size
            for f in range(first[s], first[s + 1]):
                out[f * size + node] = grid[f * size + node]
            if shared[at] > 1:
                total = real(0.0)
                for f in range(first[s], first[s + 1]):
                    total += grid[f * size + node][3]
                for a in range(first[s], first[s + 1]):
                    qa = grid[a * size + node]
                    for b in range(a + 1, first[s + 1]):
                        qb = grid[b * size + node]
                        w = sides(a, b, first[s], node, size, wp.static(real(BETTER)) * dx[s], reach)
                        d = w[0] * gradient[a * size + node] + w[1] * gradient[b * size + node]
                        length = wp.length(d)
                        if length > real(0.0) and qa[3] > real(0.0) and qb[3] > real(0.0):
                            r = velocity_of(qa) / qa[3] - velocity_of(qb) / qb[3]
                            mu = friction[s, (a - first[s]) * bodies + b - first[s]]
                            J = (qa[3] * qb[3] / total) * change(r, d / length, mu)
                            push = vec4(J[0], J[1], J[2], real(0.0))
                            out[a * size + node] = out[a * size + node] + push
                            out[b * size + node] = out[b * size + node] - push

    @kernel
    def exchange_adjoint(
        first: wp.array(dtype=wp.int32),
        size: int,
        chunk: int,
        bodies: int,
        dx: wp.array(dtype=real),
        friction: wp.array2d(dtype=real),
        shared: wp.array(dtype=wp.int32),
        gradient: wp.array(dtype=vec3),
        reach: wp.array2d(dtype=real),
        grid: wp.array(dtype=vec4),
        a_out: wp.array(dtype=vec4),
        a_grid: wp.array(dtype=vec4),
        a_gradient: wp.array(dtype=vec3),
        a_friction: wp.array2d(dtype=real),
    ):
        """Write a_grid and, at shared nodes, a_gradient; add to a_friction."""
        begin = wp.tid() * chunk
        for at in range(begin, begin + chunk):
            s = at // size
            node = at - s * size
            for f in range(first[s], first[s + 1]):
                a_grid[f * size + node] = a_out[f * size + node]
            if shared[at] > 1:
                total = real(0.0)
                for f in range(first[s], first[s + 1]):
                    total += grid[f * size + node][3]
                    a_gradient[f * size + node] = vec3(real(0.0), real(0.0), real(0.0))
                a_total = real(0.0)
                for a in range(first[s], first[s + 1]):
                    qa = grid[a * size + node]
                    for b in range(a + 1, first[s + 1]):
                        qb = grid[b * size + node]
                        w = sides(a, b, first[s], node, size, wp.static(real(BETTER)) * dx[s], reach)
                        d = w[0] * gradient[a * size + node] + w[1] * gradient[b * size + node]
                        length = wp.length(d)
                        if length > real(0.0) and qa[3] > real(0.0) and qb[3] > real(0.0):
                            va = velocity_of(qa) / qa[3]
                            vb = velocity_of(qb) / qb[3]
                            r = va - vb
                            n = d / length
                            pair = (a - first[s]) * bodies + b - first[s]
                            mu = friction[s, pair]
                            rn = wp.dot(r, n)
                            if rn > real(0.0):
                                A = velocity_of(a_out[a * size + node]) - velocity_of(a_out[b * size + node])
                                share = qa[3] * qb[3] / total
                                a_share = wp.dot(A, change(r, n, mu))
                                t = r - rn * n
                                speed = wp.length(t)
                                ar = -share * A
                                if speed >= mu * rn:
                                    safe = wp.max(speed, real(1.0e-30))
                                    e = t / safe
                                    eA = wp.dot(e, A)
                                    at_ = (-mu * rn * share / safe) * (A - eA * e)
                                    arn = -share * (wp.dot(n, A) + mu * eA) - wp.dot(at_, n)
                                    an = -rn * (share * A + at_) + arn * r
                                    ar = at_ + arn * n
                                    ad = (an - wp.dot(n, an) * n) / length
                                    a_gradient[a * size + node] = a_gradient[a * size + node] + w[0] * ad
                                    a_gradient[b * size + node] = a_gradient[b * size + node] + w[1] * ad
                                    wp.atomic_add(a_friction, s, pair, -rn * share * eA)
                                ba = ar / qa[3]
                                bb = -ar / qb[3]
                                ma = -wp.dot(ba, va) + a_share * qb[3] / total
                                mb = -wp.dot(bb, vb) + a_share * qa[3] / total
                                a_grid[a * size + node] = a_grid[a * size + node] + vec4(ba[0], ba[1], ba[2], ma)
                                a_grid[b * size + node] = a_grid[b * size + node] + vec4(bb[0], bb[1], bb[2], mb)
                                a_total -= a_share * share / total
                for f in range(first[s], first[s + 1]):
                    a_grid[f * size + node] = a_grid[f * size + node] + vec4(real(0.0), real(0.0), real(0.0), a_total)

    return SimpleNamespace(
        find_shared=find_shared,
        add_gradients=add_gradients,
        add_gradients_adjoint=add_gradients_adjoint,
        find_reach=find_reach,
        exchange=exchange,
        exchange_adjoint=exchange_adjoint,
    )
