"""Warp kernels of the contact between bodies with a velocity field each, with hand-written adjoints.

At a node i, body f has the momentum p, the mass m, and the volume gradient G = sum_p V_p grad w_ip, which points into it and does not
depend on its density. The normal n from a to b is G_b - G_a, normalised, or G_b or -G_a where one of these separates the particles of the
two around the node better by `BETTER`, as the separating axis of two convex bodies does. (At the edge of a block that slides on a plane
the gradient of the block is that of two faces; with the tilted mean the edge would plough.) Each pair that overlaps by o along the normal
(`reach_kernels`) receives

    J_a = -J_b = (m_a m_b / M) (r' - r),   r = v_a - v_b,   M: mass of all bodies at the node,
    r' - r = -P n - min(mu P, |t|) t / |t|,   t = r - (r n) n,   P = PUSH o / dt + DAMPING (r n),

a spring that gives back nearly all that it took, with Coulomb's friction. (An impulse that ends the approach of a node at once is
inelastic.) With M in place of m_a + m_b the impulses of several pairs at a node are stable too. P is limited so that bodies which overlap
from the start part by `PARTING` cells a substep at most.

The loops over the 27 nodes of a particle are not unrolled, which would take a minute to compile. Which axis is the normal is a branch, and
has no derivative. A node belongs to one thread, which visits its pairs one after the other.
"""

import functools
from collections.abc import Callable
from types import SimpleNamespace

import warp as wp

from neuido.physics.colliders.solid_contact import spring_functions
from neuido.physics.multibody import reach_kernels
from neuido.physics.multibody.reach_kernels import FAR
from neuido.physics.runtime.device import start_warp
from neuido.physics.runtime.once import cached

BETTER = 0.1
"""Overlap along an axis that makes another one the normal [cells]. The gradients of evenly filled bodies turn by some degrees from node to
node, which moves an overlap by less; their mean turns less than each."""
PUSH = 0.1875
"""Share of an overlap that the contact takes back in a substep; at 1 an explicit spring would be unstable. With half of it bodies sink in
twice as deep."""


@cached
def build(real: type, stencil: Callable[..., SimpleNamespace]) -> SimpleNamespace:
    """Return the kernels for one scalar type, compiled at their first launch.

    Args:
        real: `wp.float32` or `wp.float64`.
        stencil: Returns the functions of the transfers' weights (`mpm.stencil.functions`).
    """
    start_warp()
    vec3 = wp.types.vector(length=3, dtype=real)
    vec4 = wp.types.vector(length=4, dtype=real)
    name = f"neuido.contact.{real.__name__}"
    func = functools.partial(wp.func, module=name)
    kernel = functools.partial(wp.kernel, module=name, enable_backward=False)
    springs = spring_functions(real, name)
    push_of, change, change_adjoint = springs.push_of, springs.change, springs.change_adjoint
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

    @func
    def sides(a: int, b: int, begin: int, at: int, size: int, tolerance: real, reach: wp.array2d(dtype=real)):
        """Return the factors of the gradients of a and b in the normal from a to b at a node, and the overlap; zero without one."""
        ra = a * size + at
        rb = b * size + at
        n = reach.shape[1] / 4
        by_a = reach[ra, a - begin] + reach[rb, a - begin]
        by_b = reach[ra, b - begin] + reach[rb, b - begin]
        least = reach[ra, n + b - begin] + reach[rb, n + a - begin] - tolerance
        out = vec3(real(-1.0), real(1.0), reach[ra, 3 * n + b - begin] + reach[rb, 3 * n + a - begin])
        if by_a < least and by_a > wp.static(real(0.5 * FAR)):
            least = by_a
            out = vec3(real(-1.0), real(0.0), reach[ra, 2 * n + a - begin] + reach[rb, 2 * n + a - begin])
        if by_b < least and by_b > wp.static(real(0.5 * FAR)):
            out = vec3(real(0.0), real(1.0), reach[ra, 2 * n + b - begin] + reach[rb, 2 * n + b - begin])
        if out[2] < real(0.0):
            out = vec3(real(0.0), real(0.0), real(0.0))
        return out

    @kernel
    def exchange(
        first: wp.array(dtype=wp.int32),
        size: int,
        chunk: int,
        bodies: int,
        dx: wp.array(dtype=real),
        dt: wp.array(dtype=real),
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
                            pressed = wp.static(real(PUSH)) * w[2] / dt[s]
                            J = (qa[3] * qb[3] / total) * change(r, -d / length, pressed, dx[s] / dt[s], mu)
                            given = vec4(J[0], J[1], J[2], real(0.0))
                            out[a * size + node] = out[a * size + node] + given
                            out[b * size + node] = out[b * size + node] - given

    @kernel
    def exchange_adjoint(
        first: wp.array(dtype=wp.int32),
        size: int,
        chunk: int,
        bodies: int,
        dx: wp.array(dtype=real),
        dt: wp.array(dtype=real),
        friction: wp.array2d(dtype=real),
        shared: wp.array(dtype=wp.int32),
        gradient: wp.array(dtype=vec3),
        reach: wp.array2d(dtype=real),
        grid: wp.array(dtype=vec4),
        a_out: wp.array(dtype=vec4),
        a_grid: wp.array(dtype=vec4),
        a_gradient: wp.array(dtype=vec3),
        a_reach: wp.array2d(dtype=real),
        owner: wp.array2d(dtype=wp.int32),
        a_friction: wp.array2d(dtype=real),
    ):
        """Write a_grid and, at shared nodes, a_gradient and a_reach; clear `owner` there; add to a_friction."""
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
                    for c in range(a_reach.shape[1]):
                        a_reach[f * size + node, c] = real(0.0)
                        owner[f * size + node, c] = -1
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
                            n = -d / length  # from b to a, as a is pressed
                            pair = (a - first[s]) * bodies + b - first[s]
                            mu = friction[s, pair]
                            given = wp.static(real(PUSH)) * w[2] / dt[s]
                            cell = dx[s] / dt[s]
                            if push_of(given, wp.dot(r, n), cell) > real(0.0):
                                A = velocity_of(a_out[a * size + node]) - velocity_of(a_out[b * size + node])
                                share = qa[3] * qb[3] / total
                                a_share = wp.dot(A, change(r, n, given, cell, mu))
                                ar, an, a_given, a_mu = change_adjoint(r, n, given, cell, mu, share * A)
                                wp.atomic_add(a_friction, s, pair, a_mu)
                                if a_given != real(0.0):
                                    a_overlap = wp.static(real(PUSH)) * a_given / dt[s]
                                    ca = a_reach.shape[1] / 2 + b - first[s]
                                    cb = a_reach.shape[1] / 2 + a - first[s]
                                    if w[1] == real(0.0):
                                        ca = a - first[s]
                                        cb = ca
                                    elif w[0] == real(0.0):
                                        ca = b - first[s]
                                        cb = ca
                                    a_reach[a * size + node, ca] = a_reach[a * size + node, ca] + a_overlap
                                    a_reach[b * size + node, cb] = a_reach[b * size + node, cb] + a_overlap
                                ad = (wp.dot(n, an) * n - an) / length
                                a_gradient[a * size + node] = a_gradient[a * size + node] + w[0] * ad
                                a_gradient[b * size + node] = a_gradient[b * size + node] + w[1] * ad
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
        **vars(reach_kernels.build(real, name, own)),
        exchange=exchange,
        exchange_adjoint=exchange_adjoint,
    )
