"""Warp kernels that blend the splats of `splat_kernels` into pixels, front to back, and their hand-written adjoints.

Two forms with one meaning, to rounding. `compose` has one thread a pixel: on CUDA a block is one tile, a warp is 8 x 4 of its pixels, and
the adjoint adds up over the warp before it touches memory. `compose_tile` has one thread a tile, which takes splat by splat: on the CPU
faster, since a splat is read once and visits only the pixels of its box.
"""

import functools
from types import SimpleNamespace

import warp as wp

from neuido.models.render.splat_kernels import ROWS
from neuido.physics.runtime.device import start_warp
from neuido.physics.runtime.once import cached

OPAQUE = 0.999
"""Largest alpha (gsplat)."""

STOP = 1e-4
"""A pixel is finished where its transmittance would fall to this (3DGS, gsplat)."""

ANY = """
#if defined(__CUDA_ARCH__)
    return __any_sync(0xffffffffu, here) != 0;
#else
    return here;
#endif
"""

HIGHEST = """
#if defined(__CUDA_ARCH__)
    int highest = value;
    for (int offset = 16; offset > 0; offset >>= 1) highest = max(highest, __shfl_xor_sync(0xffffffffu, highest, offset));
    return highest;
#else
    return value;
#endif
"""

ADD = """
#if defined(__CUDA_ARCH__)
    auto v = value;
    for (int k = 0; k < 4; ++k)
        if (k < count)
            for (int offset = 16; offset > 0; offset >>= 1) v[k] += __shfl_xor_sync(0xffffffffu, v[k], offset);
    if ((threadIdx.x & 31) == 0)
        for (int k = 0; k < 4; ++k)
            if (k < count) atomicAdd(&rows.data[row].c[k], v[k]);
#else
    for (int k = 0; k < count; ++k) rows.data[row].c[k] += value[k];
#endif
"""
"""The first `count` of four numbers, summed over the warp, which must call it as one."""


@cached
def build(real: type, tile: int, appearance: bool = False) -> SimpleNamespace:
    """All kernels for one scalar type and tile size, compiled on first launch.

    Args:
        real: `wp.float32` or `wp.float64`.
        tile: Side of a tile in pixels, a multiple of 8. On CUDA 16: a block of 256 threads is one tile.
        appearance: The adjoints also give the gradients of opacities and colours.

    Returns:
        A namespace of kernels.
    """
    start_warp()
    vec3 = wp.types.vector(length=3, dtype=real)
    vec4 = wp.types.vector(length=4, dtype=real)
    name = f"neuido.compose.{real.__name__}.{tile}.{'appearance' if appearance else 'geometry'}"
    func = functools.partial(wp.func, module=name)
    kernel = functools.partial(wp.kernel, module=name, enable_backward=False)
    pixels = tile * tile
    half = 0.5

    @wp.func_native(ANY)
    def any_in_warp(here: bool) -> bool: ...

    @wp.func_native(HIGHEST)
    def highest_in_warp(value: int) -> int: ...

    @wp.func_native(ADD)
    def add(rows: wp.array(dtype=vec4), row: int, value: vec4, count: int): ...

    @func
    def pixel_of(thread: int, columns: int):
        """Column and line of a thread's pixel in its image; 32 threads are 8 x 4 pixels."""
        block = thread // wp.static(pixels)
        t = thread - block * wp.static(pixels)
        w = t // 32
        l = t - w * 32
        line = block // columns
        return wp.vec2i(
            (block - line * columns) * wp.static(tile) + (w % wp.static(tile // 8)) * 8 + l % 8,
            line * wp.static(tile) + (w // wp.static(tile // 8)) * 4 + l // 8,
        )

    @kernel
    def compose(
        tile_range: wp.array(dtype=wp.vec2i),
        splats: wp.array(dtype=wp.int32),
        centre: wp.array(dtype=vec4),
        conic: wp.array(dtype=vec3),
        colours: wp.array(dtype=vec3),
        frame_stride: int,
        view_stride: int,
        gaussians: int,
        views: int,
        width: int,
        height: int,
        columns: int,
        tiles: int,
        colour: wp.array(dtype=vec3),
        transmittance: wp.array(dtype=real),
        last: wp.array(dtype=wp.int32),
    ):
        i = wp.tid()
        image = i // (tiles * wp.static(pixels))
        p = pixel_of(i - image * (tiles * wp.static(pixels)), columns)
        if p[0] >= width or p[1] >= height:
            return
        f = image // views
        shift = f * frame_stride + (image - f * views) * view_stride - image * gaussians
        px = real(p[0]) + real(half)
        py = real(p[1]) + real(half)
        span = tile_range[i // wp.static(pixels)]
        T = real(1.0)
        end = int(0)
        total = vec3(real(0.0), real(0.0), real(0.0))
        for k in range(span[0], span[1]):
            g = splats[k]
            c = centre[g]
            q = conic[g]
            dx = c[0] - px
            dy = c[1] - py
            sigma = real(half) * (q[0] * dx * dx + q[2] * dy * dy) + q[1] * dx * dy
            if sigma <= c[3]:
                alpha = wp.min(real(wp.static(OPAQUE)), c[2] * wp.exp(-sigma))
                below = T * (real(1.0) - alpha)
                if below <= real(wp.static(STOP)):
                    break
                total += (alpha * T) * colours[g + shift]
                T = below
                end = k + 1
        at = (image * height + p[1]) * width + p[0]
        colour[at] = total
        transmittance[at] = T
        last[at] = end

    @kernel
    def compose_adjoint(
        tile_range: wp.array(dtype=wp.vec2i),
        splats: wp.array(dtype=wp.int32),
        centre: wp.array(dtype=vec4),
        conic: wp.array(dtype=vec3),
        colours: wp.array(dtype=vec3),
        frame_stride: int,
        view_stride: int,
        gaussians: int,
        views: int,
        width: int,
        height: int,
        columns: int,
        tiles: int,
        transmittance: wp.array(dtype=real),
        last: wp.array(dtype=wp.int32),
        a_colour: wp.array(dtype=vec3),
        passed: wp.array(dtype=real),
        rows: wp.array(dtype=vec4),
    ):
        """Back to front; `behind` is the gradient that goes to what shows behind the splat, at first `passed`, minus a_alpha times the
        transmittance. Adds to `rows`.
        """
        i = wp.tid()
        image = i // (tiles * wp.static(pixels))
        p = pixel_of(i - image * (tiles * wp.static(pixels)), columns)
        f = image // views
        shift = f * frame_stride + (image - f * views) * view_stride - image * gaussians
        px = real(p[0]) + real(half)
        py = real(p[1]) + real(half)
        first = tile_range[i // wp.static(pixels)][0]
        end = int(0)
        T = real(1.0)
        behind = real(0.0)
        a = vec3(real(0.0), real(0.0), real(0.0))
        if p[0] < width and p[1] < height:
            at = (image * height + p[1]) * width + p[0]
            end = last[at]
            T = transmittance[at]
            a = a_colour[at]
            behind = passed[at]
        highest = highest_in_warp(end)
        for j in range(highest - first):
            k = highest - 1 - j
            g = splats[k]
            c = centre[g]
            q = conic[g]
            dx = c[0] - px
            dy = c[1] - py
            sigma = real(half) * (q[0] * dx * dx + q[2] * dy * dy) + q[1] * dx * dy
            here = k < end and sigma <= c[3]
            if any_in_warp(here):
                geometry = vec4(real(0.0), real(0.0), real(0.0), real(0.0))
                rest = vec4(real(0.0), real(0.0), real(0.0), real(0.0))
                tint = vec4(real(0.0), real(0.0), real(0.0), real(0.0))
                if here:
                    density = wp.exp(-sigma)
                    alpha = wp.min(real(wp.static(OPAQUE)), c[2] * density)
                    past = real(1.0) / (real(1.0) - alpha)
                    T = T * past
                    weight = alpha * T
                    gain = wp.dot(colours[g + shift], a)
                    a_a = T * gain - behind * past
                    behind += weight * gain
                    if wp.static(appearance):
                        tint = vec4(weight * a[0], weight * a[1], weight * a[2], real(0.0))
                    if c[2] * density <= real(wp.static(OPAQUE)):
                        s = -alpha * a_a
                        geometry = vec4(s * (q[0] * dx + q[1] * dy), s * (q[1] * dx + q[2] * dy), real(half) * s * dx * dx, s * dx * dy)
                        rest = vec4(real(half) * s * dy * dy, density * a_a, real(0.0), real(0.0))
                add(rows, wp.static(ROWS) * g, geometry, 4)
                if wp.static(appearance):
                    add(rows, wp.static(ROWS) * g + 1, rest, 2)
                    add(rows, wp.static(ROWS) * g + 2, tint, 3)
                else:
                    add(rows, wp.static(ROWS) * g + 1, rest, 1)

    @kernel
    def compose_tile(
        tile_range: wp.array(dtype=wp.vec2i),
        splats: wp.array(dtype=wp.int32),
        centre: wp.array(dtype=vec4),
        conic: wp.array(dtype=vec3),
        box: wp.array(dtype=wp.vec4i),
        colours: wp.array(dtype=vec3),
        frame_stride: int,
        view_stride: int,
        gaussians: int,
        views: int,
        width: int,
        height: int,
        columns: int,
        tiles: int,
        colour: wp.array(dtype=vec3),
        transmittance: wp.array(dtype=real),
        last: wp.array(dtype=wp.int32),
    ):
        """`compose` with one thread a tile, for the CPU: each splat visits only the pixels of its box. Colour 0 and transmittance 1
        before; a finished pixel has its transmittance negative meanwhile.
        """
        i = wp.tid()
        image = i // tiles
        line = (i - image * tiles) // columns
        x0 = (i - image * tiles - line * columns) * wp.static(tile)
        y0 = line * wp.static(tile)
        x1 = wp.min(x0 + wp.static(tile), width)
        y1 = wp.min(y0 + wp.static(tile), height)
        f = image // views
        shift = f * frame_stride + (image - f * views) * view_stride - image * gaussians
        first = image * height
        left = (x1 - x0) * (y1 - y0)
        for k in range(tile_range[i][0], tile_range[i][1]):
            g = splats[k]
            c = centre[g]
            q = conic[g]
            tint = colours[g + shift]
            b = box[g]
            for y in range(wp.max(b[1], y0), wp.min(b[3], y1)):
                dy = c[1] - real(y) - real(half)
                for x in range(wp.max(b[0], x0), wp.min(b[2], x1)):
                    at = (first + y) * width + x
                    T = transmittance[at]
                    dx = c[0] - real(x) - real(half)
                    sigma = real(half) * (q[0] * dx * dx + q[2] * dy * dy) + q[1] * dx * dy
                    if T > real(0.0) and sigma <= c[3]:
                        alpha = wp.min(real(wp.static(OPAQUE)), c[2] * wp.exp(-sigma))
                        below = T * (real(1.0) - alpha)
                        if below <= real(wp.static(STOP)):
                            transmittance[at] = -T
                            left -= 1
                        else:
                            colour[at] = colour[at] + (alpha * T) * tint
                            transmittance[at] = below
                            last[at] = k + 1
            if left == 0:
                break
        for y in range(y0, y1):
            for x in range(x0, x1):
                at = (first + y) * width + x
                transmittance[at] = wp.abs(transmittance[at])

    @kernel
    def compose_tile_adjoint(
        tile_range: wp.array(dtype=wp.vec2i),
        splats: wp.array(dtype=wp.int32),
        centre: wp.array(dtype=vec4),
        conic: wp.array(dtype=vec3),
        box: wp.array(dtype=wp.vec4i),
        colours: wp.array(dtype=vec3),
        frame_stride: int,
        view_stride: int,
        gaussians: int,
        views: int,
        width: int,
        height: int,
        columns: int,
        tiles: int,
        transmittance: wp.array(dtype=real),
        last: wp.array(dtype=wp.int32),
        a_colour: wp.array(dtype=vec3),
        behind: wp.array(dtype=real),
        rows: wp.array(dtype=vec4),
    ):
        """Adjoint of `compose_tile`; overwrites `transmittance` and `behind`, which begins as minus a_alpha times the transmittance."""
        i = wp.tid()
        image = i // tiles
        line = (i - image * tiles) // columns
        x0 = (i - image * tiles - line * columns) * wp.static(tile)
        y0 = line * wp.static(tile)
        x1 = wp.min(x0 + wp.static(tile), width)
        y1 = wp.min(y0 + wp.static(tile), height)
        f = image // views
        shift = f * frame_stride + (image - f * views) * view_stride - image * gaussians
        first = image * height
        start = tile_range[i][0]
        end = start
        for y in range(y0, y1):
            for x in range(x0, x1):
                end = wp.max(end, last[(first + y) * width + x])
        for j in range(end - start):
            k = end - 1 - j
            g = splats[k]
            c = centre[g]
            q = conic[g]
            tint = colours[g + shift]
            sx = real(0.0)
            sy = real(0.0)
            sxx = real(0.0)
            sxy = real(0.0)
            syy = real(0.0)
            so = real(0.0)
            st = vec3(real(0.0), real(0.0), real(0.0))
            b = box[g]
            for y in range(wp.max(b[1], y0), wp.min(b[3], y1)):
                dy = c[1] - real(y) - real(half)
                for x in range(wp.max(b[0], x0), wp.min(b[2], x1)):
                    at = (first + y) * width + x
                    dx = c[0] - real(x) - real(half)
                    sigma = real(half) * (q[0] * dx * dx + q[2] * dy * dy) + q[1] * dx * dy
                    if k < last[at] and sigma <= c[3]:
                        a = a_colour[at]
                        density = wp.exp(-sigma)
                        alpha = wp.min(real(wp.static(OPAQUE)), c[2] * density)
                        past = real(1.0) / (real(1.0) - alpha)
                        T = transmittance[at] * past
                        transmittance[at] = T
                        gain = wp.dot(tint, a)
                        a_a = T * gain - behind[at] * past
                        behind[at] = behind[at] + alpha * T * gain
                        if wp.static(appearance):
                            st += (alpha * T) * a
                        if c[2] * density <= real(wp.static(OPAQUE)):
                            s = -alpha * a_a
                            sx += s * dx
                            sy += s * dy
                            sxx += s * dx * dx
                            sxy += s * dx * dy
                            syy += s * dy * dy
                            so += density * a_a
            row = wp.static(ROWS) * g
            rows[row] = rows[row] + vec4(q[0] * sx + q[1] * sy, q[1] * sx + q[2] * sy, real(half) * sxx, sxy)
            rows[row + 1] = rows[row + 1] + vec4(real(half) * syy, so, real(0.0), real(0.0))
            if wp.static(appearance):
                rows[row + 2] = rows[row + 2] + vec4(st[0], st[1], st[2], real(0.0))

    return SimpleNamespace(
        compose=compose, compose_adjoint=compose_adjoint, compose_tile=compose_tile, compose_tile_adjoint=compose_tile_adjoint
    )
