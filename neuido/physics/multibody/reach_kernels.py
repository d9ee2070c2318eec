"""How far the particles of each body extend beyond a node along the axes of contact: Warp kernels and their adjoint.

The reach of a body along a unit axis u is the largest u y + e/2 of its particles around the node, y: place relative to the node, e: edge,
the cube root of the volume. The overlap of two bodies is the sum of their reaches along the normal and against it; it chooses the normal.
The overlap that pushes counts a particle aside of the axis less: u y + e/2 - |y - (u y) u|^2 / (2 ROUND h), as a ball of `ROUND` cells that
rolls on the particles would. Two balls of eight cells would else touch 0.8 cells early three cells beside their axis, and be pressed
a third too hard against Hertz.
"""

import functools
from types import SimpleNamespace

import warp as wp

FAR = -1.0e30
"""Reach of a body without particles near a node [m]."""
ROUND = 2.5
"""Radius of the ball [cells]: as wide as the stencil of a node, and smaller than a body that the grid resolves. On a plane filled with
two particles a cell it lowers the reach by 0.03 cells at most. With 2 the force of two balls is 4 % nearer to Hertz's, with 2 and 3 the
friction of a sliding block is 6 % off; with 2.5 it is right to 1 %."""


def build(real: type, name: str, own: SimpleNamespace) -> SimpleNamespace:
    """Return the kernels for one scalar type.

    Args:
        real: `wp.float32` or `wp.float64`.
        name: Warp module that they belong to.
        own: Functions of the transfers' weights in this module.
    """
    vec2 = wp.types.vector(length=2, dtype=real)
    vec3 = wp.types.vector(length=3, dtype=real)
    func = functools.partial(wp.func, module=name)
    kernel = functools.partial(wp.kernel, module=name, enable_backward=False)
    first_node, flat_index = own.first_node, own.flat_index
    same = 1e-12 if real is wp.float64 else 1e-5  # rounding of a reach [cells], which differs between kernels

    @func
    def axis(f: int, c: int, bodies: int, begin: int, row: int, size: int, gradient: wp.array(dtype=vec3)):
        """Return the axis, not normalised, of column c for body f at a node: the gradient of body c, or the mean of it and that of f."""
        out = gradient[(begin + c % bodies) * size + row]
        if c >= bodies:
            out = out - gradient[f * size + row]
        elif begin + c == f:
            out = -out
        return out

    @func
    def reach_of(u: vec3, arm: vec3, half: real, h: real):
        """Return the reach of a particle along u, and that of the rolling ball."""
        along = wp.dot(u, arm)
        aside = wp.length_sq(arm) - along * along
        return vec2(along + half, along + half - aside / (wp.static(real(2.0 * ROUND)) * h))

    @func
    def arm_of(x: vec3, origin: vec3, base: wp.vec3i, c: int, h: real):
        """Return the place of a particle relative to node c of its stencil [m]."""
        return x - (origin + vec3(real(base[0] + c / 9), real(base[1] + c / 3 % 3), real(base[2] + c % 3)) * h)

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
        """Find the reach of each body at the shared nodes [m].

        With B bodies, columns 0 to 2 B - 1 are the plain reach along the axes of `axis`, the other 2 B those of the rolling ball.
        """
        p = wp.tid()
        f = field[p]
        s = scene[p]
        h = dx[f]
        base = first_node((x[p] - origin[f]) / h, nodes)
        size = nodes[0] * nodes[1] * nodes[2]
        local = flat_index(0, base, nodes)
        half = real(0.5) * wp.cbrt(volume[p])
        bodies = reach.shape[1] / 4
        for c in range(27):
            row = local + ((c / 9) * nodes[1] + c / 3 % 3) * nodes[2] + c % 3
            if shared[s * size + row] > 1:
                arm = arm_of(x[p], origin[f], base, c, h)
                for g in range(first[s + 1] - first[s]):
                    for part in range(2):
                        d = axis(f, g + part * bodies, bodies, first[s], row, size, gradient)
                        length = wp.length(d)
                        if length > real(0.0):
                            own = reach_of(d / length, arm, half, h)
                            wp.atomic_max(reach, f * size + row, g + part * bodies, own[0])
                            wp.atomic_max(reach, f * size + row, g + (part + 2) * bodies, own[1])

    @kernel
    def find_owner(
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
        a_reach: wp.array2d(dtype=real),
        owner: wp.array2d(dtype=wp.int32),
    ):
        """Find the particle that has the largest reach of the rolling ball, where that has an adjoint; of several the last one."""
        p = wp.tid()
        f = field[p]
        s = scene[p]
        h = dx[f]
        base = first_node((x[p] - origin[f]) / h, nodes)
        size = nodes[0] * nodes[1] * nodes[2]
        local = flat_index(0, base, nodes)
        half = real(0.5) * wp.cbrt(volume[p])
        bodies = reach.shape[1] / 4
        for c in range(27):
            row = local + ((c / 9) * nodes[1] + c / 3 % 3) * nodes[2] + c % 3
            if shared[s * size + row] > 1:
                arm = arm_of(x[p], origin[f], base, c, h)
                for g in range(first[s + 1] - first[s]):
                    for part in range(2):
                        column = g + part * bodies
                        if a_reach[f * size + row, column] != real(0.0):
                            d = axis(f, column, bodies, first[s], row, size, gradient)
                            own = reach_of(d / wp.length(d), arm, half, h)
                            if own[1] >= reach[f * size + row, column + 2 * bodies] - wp.static(real(same)) * h:
                                wp.atomic_max(owner, f * size + row, column, p)

    @kernel
    def find_reach_adjoint(
        field: wp.array(dtype=wp.int32),
        scene: wp.array(dtype=wp.int32),
        origin: wp.array(dtype=vec3),
        dx: wp.array(dtype=real),
        x: wp.array(dtype=vec3),
        nodes: wp.vec3i,
        first: wp.array(dtype=wp.int32),
        shared: wp.array(dtype=wp.int32),
        gradient: wp.array(dtype=vec3),
        a_reach: wp.array2d(dtype=real),
        owner: wp.array2d(dtype=wp.int32),
        a_gradient: wp.array(dtype=vec3),
        a_x: wp.array(dtype=vec3),
    ):
        """Add to a_gradient and a_x."""
        p = wp.tid()
        f = field[p]
        s = scene[p]
        h = dx[f]
        base = first_node((x[p] - origin[f]) / h, nodes)
        size = nodes[0] * nodes[1] * nodes[2]
        local = flat_index(0, base, nodes)
        bodies = a_reach.shape[1] / 2
        a_place = vec3(real(0.0), real(0.0), real(0.0))
        for c in range(27):
            row = local + ((c / 9) * nodes[1] + c / 3 % 3) * nodes[2] + c % 3
            if shared[s * size + row] > 1:
                arm = arm_of(x[p], origin[f], base, c, h)
                for g in range(first[s + 1] - first[s]):
                    for part in range(2):
                        column = g + part * bodies
                        if owner[f * size + row, column] == p:
                            a = a_reach[f * size + row, column]
                            d = axis(f, column, bodies, first[s], row, size, gradient)
                            length = wp.length(d)
                            u = d / length
                            along = wp.dot(u, arm)
                            a_place += a * (u - (arm - along * u) / (wp.static(real(ROUND)) * h))
                            au = (a * (real(1.0) + along / (wp.static(real(ROUND)) * h))) * arm
                            ad = (au - wp.dot(u, au) * u) / length
                            of = (first[s] + g) * size + row
                            if part == 0 and first[s] + g == f:
                                ad = -ad
                            wp.atomic_add(a_gradient, of, ad)
                            if part == 1:
                                wp.atomic_add(a_gradient, f * size + row, -ad)
        a_x[p] = a_x[p] + a_place

    return SimpleNamespace(find_reach=find_reach, find_owner=find_owner, find_reach_adjoint=find_reach_adjoint)
