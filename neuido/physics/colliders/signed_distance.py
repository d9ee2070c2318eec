"""Warp functions for the signed distance of solids and its gradient in their own axes, and the adjoint of both with respect to the place.

Primitives are exact. A mesh has samples of gradient and distance on a lattice, a height field has slopes and heights at its corners; both
are linear between them, the distance of a height field being the height above it times the cosine of its slope.
"""

import functools
from types import SimpleNamespace

import warp as wp

from neuido.physics.colliders.solids import CAPSULE, CUBOID, CYLINDER, HALF_SPACE, HEIGHT_FIELD, MESH, SPHERE

FAR = 1.0e9
"""Distance [m] of a place for which a solid has no samples."""


def functions(real: type, module: str) -> SimpleNamespace:
    """Return the Warp functions `distance` and `distance_adjoint`.

    Args:
        real: `wp.float32` or `wp.float64`.
        module: Name of the Warp module that the functions belong to.
    """
    vec3 = wp.types.vector(length=3, dtype=real)
    vec4 = wp.types.vector(length=4, dtype=real)
    vec2 = wp.types.vector(length=2, dtype=real)
    func = functools.partial(wp.func, module=module)

    @func
    def sign(a: real):
        out = real(1.0)
        if a < real(0.0):
            out = real(-1.0)
        return out

    @func
    def unit(q: vec3):
        """Return q over its length, and the y axis for zero."""
        size = wp.length(q)
        out = vec3(real(0.0), real(1.0), real(0.0))
        if size > real(0.0):
            out = q / size
        return out

    @func
    def ball(q: vec3, radius: real):
        """Return normal and distance of a ball around 0."""
        n = unit(q)
        return vec4(n[0], n[1], n[2], wp.length(q) - radius)

    @func
    def off_axis(y: vec3, half: real):
        """Return the vector to y from the nearest point of a segment of the y axis."""
        return vec3(y[0], y[1] - wp.clamp(y[1], -half, half), y[2])

    @func
    def cuboid(y: vec3, half: vec3):
        d = vec3(wp.abs(y[0]) - half[0], wp.abs(y[1]) - half[1], wp.abs(y[2]) - half[2])
        largest = wp.max(d)
        out = vec4(real(0.0), real(0.0), real(0.0), largest)
        if largest > real(0.0):
            q = vec3(real(0.0), real(0.0), real(0.0))
            for a in range(3):
                q[a] = sign(y[a]) * wp.max(d[a], real(0.0))
            out = ball(q, real(0.0))
        elif d[0] == largest:
            out[0] = sign(y[0])
        elif d[1] == largest:
            out[1] = sign(y[1])
        else:
            out[2] = sign(y[2])
        return out

    @func
    def cylinder(y: vec3, radius: real, half: real):
        across = unit(vec3(y[0], real(0.0), y[2]))
        if y[0] == real(0.0) and y[2] == real(0.0):
            across = vec3(real(1.0), real(0.0), real(0.0))
        side = wp.sqrt(y[0] * y[0] + y[2] * y[2]) - radius
        cap = wp.abs(y[1]) - half
        up = vec3(real(0.0), sign(y[1]), real(0.0))
        n = across
        at = side
        if side > real(0.0) and cap > real(0.0):
            at = wp.sqrt(side * side + cap * cap)
            n = (side * across + cap * up) / at
        elif cap > side:
            n = up
            at = cap
        return vec4(n[0], n[1], n[2], at)

    @func
    def interpolate(samples: wp.array(dtype=vec4), info: wp.vec4i, c: vec3):
        """Return, as rows, the samples at c cells from the first corner and their derivatives along the three axes [1/cell].

        `info` has the first sample and the numbers of samples along the axes; z is the fastest, and one sample along y means none.
        """
        i = wp.clamp(int(wp.floor(c[0])), 0, wp.max(info[1] - 2, 0))
        j = wp.clamp(int(wp.floor(c[1])), 0, wp.max(info[2] - 2, 0))
        k = wp.clamp(int(wp.floor(c[2])), 0, wp.max(info[3] - 2, 0))
        f = vec3(c[0] - real(i), c[1] - real(j), c[2] - real(k))
        zero = vec4(real(0.0), real(0.0), real(0.0), real(0.0))
        value = zero
        along_x = zero
        along_y = zero
        along_z = zero
        slope = vec2(real(-1.0), real(1.0))
        wx = vec2(real(1.0) - f[0], f[0])
        wy = vec2(real(1.0) - f[1], f[1])
        wz = vec2(real(1.0) - f[2], f[2])
        for a in range(2):
            for b in range(2):
                row = info[0] + ((i + a) * info[2] + wp.min(j + b, info[2] - 1)) * info[3] + k
                for d in range(2):
                    sample = samples[row + d]
                    value += (wx[a] * wy[b] * wz[d]) * sample
                    along_x += (slope[a] * wy[b] * wz[d]) * sample
                    along_y += (wx[a] * slope[b] * wz[d]) * sample
                    along_z += (wx[a] * wy[b] * slope[d]) * sample
        return wp.matrix_from_rows(value, along_x, along_y, along_z)

    @func
    def cells_of(shape: int, size: vec4, y: vec3):
        """Return the place of y among the samples of a mesh (`size`: spacing, first corner) or a height field (spacings, first corner)."""
        out = vec3((y[0] - size[1]) / size[0], (y[1] - size[2]) / size[0], (y[2] - size[3]) / size[0])
        if shape == wp.static(HEIGHT_FIELD):
            out = vec3((y[0] - size[2]) / size[0], real(0.0), (y[2] - size[3]) / size[1])
        return out

    @func
    def sampled(info: wp.vec4i, c: vec3):
        """Return whether a place lies among the samples."""
        return (
            c[0] >= real(0.0)
            and c[1] >= real(0.0)
            and c[2] >= real(0.0)
            and c[0] <= real(info[1] - 1)
            and c[1] <= real(info[2] - 1)
            and c[2] <= real(info[3] - 1)
        )

    @func
    def distance(shape: int, size: vec4, samples: wp.array(dtype=vec4), info: wp.vec4i, y: vec3):
        """Return the unit normal (first three numbers) and the signed distance (last) [m] of a solid at y."""
        out = vec4(real(0.0), real(1.0), real(0.0), real(wp.static(FAR)))
        if shape == wp.static(HALF_SPACE):
            out[3] = y[1]
        elif shape == wp.static(SPHERE):
            out = ball(y, size[0])
        elif shape == wp.static(CUBOID):
            out = cuboid(y, vec3(size[0], size[1], size[2]))
        elif shape == wp.static(CAPSULE):
            out = ball(off_axis(y, size[1]), size[0])
        elif shape == wp.static(CYLINDER):
            out = cylinder(y, size[0], size[1])
        else:
            c = cells_of(shape, size, y)
            if sampled(info, c):
                at = interpolate(samples, info, c)
                if shape == wp.static(MESH):
                    n = unit(vec3(at[0, 0], at[0, 1], at[0, 2]))
                    out = vec4(n[0], n[1], n[2], at[0, 3])
                else:
                    n = unit(vec3(-at[0, 0], real(1.0), -at[0, 1]))
                    out = vec4(n[0], n[1], n[2], (y[1] - at[0, 3]) * n[1])
        return out

    @func
    def across_normal(n: vec3, b: vec3):
        return b - wp.dot(n, b) * n

    @func
    def ball_adjoint(q: vec3, b: vec3):
        """Return the adjoint of q for the adjoint b of the normal of a ball."""
        size = wp.length(q)
        out = vec3(real(0.0), real(0.0), real(0.0))
        if size > real(0.0):
            out = across_normal(q / size, b) / size
        return out

    @func
    def cuboid_adjoint(y: vec3, half: vec3, b: vec3):
        q = vec3(real(0.0), real(0.0), real(0.0))
        for a in range(3):
            q[a] = sign(y[a]) * wp.max(wp.abs(y[a]) - half[a], real(0.0))
        out = ball_adjoint(q, b)
        for a in range(3):
            if q[a] == real(0.0):
                out[a] = real(0.0)
        return out

    @func
    def cylinder_adjoint(y: vec3, radius: real, half: real, b: vec3):
        out = vec3(real(0.0), real(0.0), real(0.0))
        reach = wp.sqrt(y[0] * y[0] + y[2] * y[2])
        if reach > real(0.0):
            across = vec3(y[0] / reach, real(0.0), y[2] / reach)
            around = vec3(-across[2], real(0.0), across[0])
            side = reach - radius
            cap = wp.abs(y[1]) - half
            if side > real(0.0) and cap > real(0.0):
                up = vec3(real(0.0), sign(y[1]), real(0.0))
                at = wp.sqrt(side * side + cap * cap)
                n = (side * across + cap * up) / at
                flat = b - wp.dot(around, b) * around
                out = across_normal(n, flat) / at + (side / at / reach * wp.dot(around, b)) * around
            elif side >= cap:
                out = (wp.dot(around, b) / reach) * around
        return out

    @func
    def sampled_adjoint(shape: int, size: vec4, samples: wp.array(dtype=vec4), info: wp.vec4i, y: vec3, b: vec3, a: real):
        out = vec3(real(0.0), real(0.0), real(0.0))
        c = cells_of(shape, size, y)
        if sampled(info, c):
            at = interpolate(samples, info, c)
            g = vec4(real(0.0), real(0.0), real(0.0), a)  # the adjoint of the interpolated sample
            scale = vec3(size[0], size[0], size[0])
            if shape == wp.static(MESH):
                inner = ball_adjoint(vec3(at[0, 0], at[0, 1], at[0, 2]), b)
                g = vec4(inner[0], inner[1], inner[2], a)
            else:
                w = vec3(-at[0, 0], real(1.0), -at[0, 1])
                n = unit(w)
                inner = ball_adjoint(w, b + vec3(real(0.0), a * (y[1] - at[0, 3]), real(0.0)))
                g = vec4(-inner[0], -inner[2], real(0.0), -a * n[1])
                out = vec3(real(0.0), a * n[1], real(0.0))
                scale = vec3(size[0], real(1.0), size[1])
            for d in range(3):
                if info[d + 1] > 1:
                    row = vec4(at[d + 1, 0], at[d + 1, 1], at[d + 1, 2], at[d + 1, 3])
                    out[d] = out[d] + wp.dot(row, g) / scale[d]
        return out

    @func
    def distance_adjoint(shape: int, size: vec4, samples: wp.array(dtype=vec4), info: wp.vec4i, y: vec3, n: vec3, b: vec3, a: real):
        """Return the adjoint of y for the adjoints b of the normal and a of the distance; n is the normal at y."""
        out = a * n
        if shape == wp.static(SPHERE):
            out = out + ball_adjoint(y, b)
        elif shape == wp.static(CUBOID):
            out = out + cuboid_adjoint(y, vec3(size[0], size[1], size[2]), b)
        elif shape == wp.static(CAPSULE):
            q = off_axis(y, size[1])
            inner = ball_adjoint(q, b)
            if wp.abs(y[1]) < size[1]:
                inner[1] = real(0.0)
            out = out + inner
        elif shape == wp.static(CYLINDER):
            out = out + cylinder_adjoint(y, size[0], size[1], b)
        elif shape >= wp.static(HEIGHT_FIELD):
            out = sampled_adjoint(shape, size, samples, info, y, b, a)
        return out

    return SimpleNamespace(distance=distance, distance_adjoint=distance_adjoint)
