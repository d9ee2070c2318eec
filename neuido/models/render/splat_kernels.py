"""Warp kernels of Gaussian splatting, all but the pixels: projection, its hand-written adjoint, and the lists of the tiles.

C images, one for each frame f and view v (c = f V + v), show N Gaussians each. What crosses kernels is one row a Gaussian and image,
c N + n, called a splat:

    centre   (x, y, opacity, limit)     pixel coordinates; limit = ln(255 opacity), below zero where the splat is not drawn
    conic    (a, b, c)                  the inverse of its covariance in pixels: sigma = (a dx^2 + c dy^2) / 2 + b dx dy
    box      (x0, y0, x1, y1)           the pixels that it may reach, from the first to the last + 1

A splat counts at a pixel where opacity exp(-sigma) >= 1/255, that is sigma <= limit. The tiles of its box (on CUDA those alone that the
ellipse sigma = limit really meets) hold every such pixel, so the lists of the tiles change nothing in the image.

    project            -> centre, conic, box, depth
    CUDA: count, emit (keys: tile and depth), a sort, ranges    CPU: a sort by depth, then tally and fill
    (compose_kernels)  -> the pixels; its adjoint adds to ROWS rows of four numbers a splat:
                          x, y, a, b | c, opacity, -, - | red, green, blue, -
    project_adjoint    -> gradients of means and covariances, summed over the views
"""

import functools
from types import SimpleNamespace

import warp as wp

from neuido.physics.runtime.device import start_warp
from neuido.physics.runtime.once import cached

CUT = 1.0 / 255.0
"""Smallest alpha that counts (3DGS, gsplat)."""

ROWS = 3
"""Rows of four numbers in the gradient of a splat; the last one only where colours want theirs."""

SLACK = 1e-3
"""By how much sigma may exceed the limit before a tile is left out: rounding must not cost a pixel."""


@cached
def build(real: type, tile: int) -> SimpleNamespace:
    """All kernels for one scalar type and tile size, compiled on first launch.

    Args:
        real: `wp.float32` or `wp.float64`.
        tile: Side of a tile in pixels.

    Returns:
        A namespace of kernels.
    """
    start_warp()
    vec3 = wp.types.vector(length=3, dtype=real)
    vec4 = wp.types.vector(length=4, dtype=real)
    mat33 = wp.types.matrix(shape=(3, 3), dtype=real)
    mat44 = wp.types.matrix(shape=(4, 4), dtype=real)
    name = f"neuido.splat.{real.__name__}.{tile}"
    func = functools.partial(wp.func, module=name)
    kernel = functools.partial(wp.kernel, module=name, enable_backward=False)
    half = 0.5

    @func
    def rows_of(view: mat44, K: mat33, p: vec3, width: int, height: int):
        """Return the two rows of the projection's Jacobian times the rotation, and the clamped x/z and y/z (gsplat: 1.3 x the image)."""
        fx = K[0, 0]
        fy = K[1, 1]
        w = real(width)
        h = real(height)
        u = wp.clamp(p[0] / p[2], -(K[0, 2] + real(0.15) * w) / fx, (w - K[0, 2] + real(0.15) * w) / fx)
        v = wp.clamp(p[1] / p[2], -(K[1, 2] + real(0.15) * h) / fy, (h - K[1, 2] + real(0.15) * h) / fy)
        z = vec3(view[2, 0], view[2, 1], view[2, 2])
        rx = (fx / p[2]) * (vec3(view[0, 0], view[0, 1], view[0, 2]) - u * z)
        ry = (fy / p[2]) * (vec3(view[1, 0], view[1, 1], view[1, 2]) - v * z)
        return rx, ry, u, v

    @func
    def in_camera(view: mat44, x: vec3):
        return vec3(
            view[0, 0] * x[0] + view[0, 1] * x[1] + view[0, 2] * x[2] + view[0, 3],
            view[1, 0] * x[0] + view[1, 1] * x[1] + view[1, 2] * x[2] + view[1, 3],
            view[2, 0] * x[0] + view[2, 1] * x[1] + view[2, 2] * x[2] + view[2, 3],
        )

    @func
    def symmetric(A: mat33):
        return real(half) * (A + wp.transpose(A))

    @kernel
    def project(
        means: wp.array(dtype=vec3),
        covariances: wp.array(dtype=mat33),
        opacities: wp.array(dtype=real),
        opacity_stride: int,
        viewmats: wp.array(dtype=mat44),
        Ks: wp.array(dtype=mat33),
        gaussians: int,
        width: int,
        height: int,
        near: real,
        far: real,
        eps2d: real,
        centre: wp.array(dtype=vec4),
        conic: wp.array(dtype=vec3),
        box: wp.array(dtype=wp.vec4i),
        depth: wp.array(dtype=real),
        status: wp.array(dtype=wp.int32),
    ):
        """Write every row; status[0] counts the Gaussians whose numbers are not finite."""
        i = wp.tid()
        views = viewmats.shape[0]
        image = i // gaussians
        n = i - image * gaussians
        f = image // views
        view = viewmats[image - f * views]
        K = Ks[image - f * views]
        x = means[f * gaussians + n]
        S = symmetric(covariances[f * gaussians + n])
        opacity = opacities[f * opacity_stride + n]
        p = in_camera(view, x)
        centre[i] = vec4(real(0.0), real(0.0), real(0.0), real(-1.0))
        conic[i] = vec3(real(0.0), real(0.0), real(0.0))
        box[i] = wp.vec4i(0, 0, 0, 0)
        depth[i] = far
        size = wp.length_sq(p) + wp.ddot(S, S) + opacity
        if not (size - size == real(0.0)):
            wp.atomic_add(status, 0, 1)
            return
        if not (p[2] >= near and p[2] <= far and opacity >= real(wp.static(CUT))):
            return
        rx, ry, u, v = rows_of(view, K, p, width, height)
        xx = wp.dot(rx, S * rx) + eps2d
        xy = wp.dot(rx, S * ry)
        yy = wp.dot(ry, S * ry) + eps2d
        det = xx * yy - xy * xy
        if not (det > real(0.0)):
            return
        limit = wp.log(opacity / real(wp.static(CUT)))
        cx = K[0, 0] * p[0] / p[2] + K[0, 2]
        cy = K[1, 1] * p[1] / p[2] + K[1, 2]
        reach = real(2.0) * limit + real(wp.static(2.0 * SLACK))
        hx = wp.sqrt(reach * xx)
        hy = wp.sqrt(reach * yy)
        w = real(width)
        h = real(height)
        x0 = int(wp.clamp(wp.ceil(cx - hx - real(half)), real(0.0), w))
        y0 = int(wp.clamp(wp.ceil(cy - hy - real(half)), real(0.0), h))
        x1 = int(wp.clamp(wp.floor(cx + hx + real(half)), real(0.0), w))
        y1 = int(wp.clamp(wp.floor(cy + hy + real(half)), real(0.0), h))
        if x1 <= x0 or y1 <= y0:
            return
        centre[i] = vec4(cx, cy, opacity, limit)
        conic[i] = vec3(yy / det, -xy / det, xx / det)
        box[i] = wp.vec4i(x0, y0, x1, y1)
        depth[i] = p[2]

    @func
    def tiles_of(b: wp.vec4i):
        """Tiles that a box of pixels meets, in the same order."""
        up = wp.static(tile - 1)
        side = wp.static(tile)
        return wp.vec4i(b[0] // side, b[1] // side, (b[2] + up) // side, (b[3] + up) // side)

    @func
    def meets(c: vec4, q: vec3, column: int, line: int):
        """Whether the ellipse of a splat meets the pixel centres of a tile: the least sigma over the rectangle lies on a facing edge."""
        x0 = real(column * wp.static(tile)) + real(half)
        y0 = real(line * wp.static(tile)) + real(half)
        x1 = x0 + real(wp.static(tile - 1))
        y1 = y0 + real(wp.static(tile - 1))
        ex = c[0] - wp.clamp(c[0], x0, x1)
        ey = c[1] - wp.clamp(c[1], y0, y1)
        least = real(0.0)
        if ex != real(0.0) or ey != real(0.0):
            least = real(1.0e30)
            if ex != real(0.0):
                d = wp.clamp(-q[1] * ex / q[2], c[1] - y1, c[1] - y0)
                least = wp.min(least, real(half) * (q[0] * ex * ex + q[2] * d * d) + q[1] * ex * d)
            if ey != real(0.0):
                d = wp.clamp(-q[1] * ey / q[0], c[0] - x1, c[0] - x0)
                least = wp.min(least, real(half) * (q[0] * d * d + q[2] * ey * ey) + q[1] * ey * d)
        return least <= c[3] + real(wp.static(SLACK))

    @kernel
    def count(centre: wp.array(dtype=vec4), conic: wp.array(dtype=vec3), box: wp.array(dtype=wp.vec4i), tiles: wp.array(dtype=wp.int32)):
        """Tiles that each splat meets."""
        i = wp.tid()
        b = tiles_of(box[i])
        c = centre[i]
        q = conic[i]
        found = int(0)
        for line in range(b[1], b[3]):
            for column in range(b[0], b[2]):
                if meets(c, q, column, line):
                    found += 1
        tiles[i] = found

    @kernel
    def emit(
        centre: wp.array(dtype=vec4),
        conic: wp.array(dtype=vec3),
        box: wp.array(dtype=wp.vec4i),
        depth: wp.array(dtype=real),
        ends: wp.array(dtype=wp.int64),
        gaussians: int,
        columns: int,
        tiles: int,
        keys: wp.array(dtype=wp.int64),
        splats: wp.array(dtype=wp.int32),
    ):
        """One key a splat and tile: the tile above, the depth below, whose bits as a float order as the number does."""
        i = wp.tid()
        b = tiles_of(box[i])
        if b[2] <= b[0]:
            return
        c = centre[i]
        q = conic[i]
        slot = wp.int64(0)
        if i > 0:
            slot = ends[i - 1]
        first = (i // gaussians) * tiles
        low = wp.int64(wp.cast(wp.float32(depth[i]), wp.int32))
        for line in range(b[1], b[3]):
            for column in range(b[0], b[2]):
                if meets(c, q, column, line):
                    if slot < wp.int64(keys.shape[0]):
                        keys[int(slot)] = (wp.int64(first + line * columns + column) << wp.int64(32)) | low
                        splats[int(slot)] = i
                    slot += wp.int64(1)

    @kernel
    def ranges(keys: wp.array(dtype=wp.int64), tile_range: wp.array(dtype=wp.vec2i)):
        """First and last + 1 entry of each tile in the sorted list; tiles without one keep (0, 0)."""
        i = wp.tid()
        here = int(keys[i] >> wp.int64(32))
        if here >= tile_range.shape[0]:
            return
        if i == 0 or int(keys[i - 1] >> wp.int64(32)) != here:
            tile_range[here][0] = i
        if i == keys.shape[0] - 1 or int(keys[i + 1] >> wp.int64(32)) != here:
            tile_range[here][1] = i + 1

    @kernel
    def tally(box: wp.array(dtype=wp.vec4i), gaussians: int, columns: int, tiles: int, length: wp.array(dtype=wp.int32)):
        """Length of the list of each tile, one thread an image."""
        image = wp.tid()
        for n in range(gaussians):
            b = tiles_of(box[image * gaussians + n])
            for line in range(b[1], b[3]):
                for column in range(b[0], b[2]):
                    at = image * tiles + line * columns + column
                    length[at] = length[at] + 1

    @kernel
    def fill(
        box: wp.array(dtype=wp.vec4i),
        order: wp.array(dtype=wp.int32),
        gaussians: int,
        columns: int,
        tiles: int,
        slot: wp.array(dtype=wp.int32),
        splats: wp.array(dtype=wp.int32),
    ):
        """Fill the lists, one thread an image in the order of depth (2 N entries an image, of which the first N count); `slot`
        goes from the first entry of each tile to its end.
        """
        image = wp.tid()
        for k in range(gaussians):
            i = image * gaussians + order[2 * image * gaussians + k]
            b = tiles_of(box[i])
            for line in range(b[1], b[3]):
                for column in range(b[0], b[2]):
                    at = image * tiles + line * columns + column
                    splats[slot[at]] = i
                    slot[at] = slot[at] + 1

    @func
    def inverse_adjoint(q: vec3, a_a: real, a_b: real, a_c: real):
        """-Q A Q for the symmetric Q = (a, b; b, c) and A = (a_a, a_b / 2; a_b / 2, a_c): from the conic to the covariance in pixels."""
        h = real(half) * a_b
        xx = q[0] * a_a + q[1] * h
        xy = q[0] * h + q[1] * a_c
        yx = q[1] * a_a + q[2] * h
        yy = q[1] * h + q[2] * a_c
        return -(xx * q[0] + xy * q[1]), -(xx * q[1] + xy * q[2]), -(yx * q[1] + yy * q[2])

    @kernel
    def project_adjoint(
        means: wp.array(dtype=vec3),
        covariances: wp.array(dtype=mat33),
        viewmats: wp.array(dtype=mat44),
        Ks: wp.array(dtype=mat33),
        gaussians: int,
        width: int,
        height: int,
        centre: wp.array(dtype=vec4),
        conic: wp.array(dtype=vec3),
        rows: wp.array(dtype=vec4),
        a_means: wp.array(dtype=vec3),
        a_covariances: wp.array(dtype=mat33),
    ):
        """Write both gradients; that of a covariance is symmetric."""
        i = wp.tid()
        views = viewmats.shape[0]
        f = i // gaussians
        n = i - f * gaussians
        S = symmetric(covariances[i])
        zero = vec3(real(0.0), real(0.0), real(0.0))
        a_x = zero
        a_S = wp.outer(zero, zero)
        for j in range(views):
            g = (f * views + j) * gaussians + n
            if centre[g][3] >= real(0.0):
                view = viewmats[j]
                K = Ks[j]
                p = in_camera(view, means[i])
                q = conic[g]
                first = rows[wp.static(ROWS) * g]
                a_xx, a_xy, a_yy = inverse_adjoint(q, first[2], first[3], rows[wp.static(ROWS) * g + 1][0])
                rx, ry, u, v = rows_of(view, K, p, width, height)
                Sx = S * rx
                Sy = S * ry
                a_S += a_xx * wp.outer(rx, rx) + a_yy * wp.outer(ry, ry) + a_xy * (wp.outer(rx, ry) + wp.outer(ry, rx))
                ax = real(2.0) * (a_xx * Sx + a_xy * Sy)
                ay = real(2.0) * (a_xy * Sx + a_yy * Sy)
                z = vec3(view[2, 0], view[2, 1], view[2, 2])
                fx = K[0, 0] / p[2]
                fy = K[1, 1] / p[2]
                a_z = -(wp.dot(ax, rx) + wp.dot(ay, ry)) / p[2]
                a_px = first[0] * fx
                a_py = first[1] * fy
                a_z -= (a_px * p[0] + a_py * p[1]) / p[2]
                if u == p[0] / p[2]:
                    a_u = -fx * wp.dot(ax, z)
                    a_px += a_u / p[2]
                    a_z -= a_u * u / p[2]
                if v == p[1] / p[2]:
                    a_v = -fy * wp.dot(ay, z)
                    a_py += a_v / p[2]
                    a_z -= a_v * v / p[2]
                a_x += a_px * vec3(view[0, 0], view[0, 1], view[0, 2]) + a_py * vec3(view[1, 0], view[1, 1], view[1, 2]) + a_z * z
        a_means[i] = a_x
        a_covariances[i] = a_S

    return SimpleNamespace(
        project=project,
        count=count,
        emit=emit,
        ranges=ranges,
        tally=tally,
        fill=fill,
        project_adjoint=project_adjoint,
    )
