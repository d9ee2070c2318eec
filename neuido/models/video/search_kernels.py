"""Warp kernels of optical flow for many pairs of images at once: dense inverse search and its variational refinement.

Kroeger et al., "Fast Optical Flow using Dense Inverse Search" (2016); Brox et al., "High Accuracy Optical Flow Estimation" (2004). A thread
has one patch or one pixel of one pair. Videos lie one after the other: pair p of videos of T frames has the frames p + p // (T - 1) and the
next one. Sequential parts of the original are parallel here: patches compare the flows of their neighbours after a first search, and the
relaxation of the refinement takes red and black pixels in turn.
"""

import functools
from types import SimpleNamespace

import warp as wp

from neuido.physics.runtime.device import start_warp
from neuido.physics.runtime.once import cached

PATCH = 8
"""Side of a patch [px]."""
COLOUR, GRADIENT, SMOOTH = 2.5, 5.0, 10.0
"""Weights of constant brightness, of constant gradient, and of smoothness, halved as they enter the equations (5, 10 and 20 in DIS)."""
OVER = 1.6
"""Factor of the successive over-relaxation."""
SHORTEST = 0.1
"""Share of a Gauss-Newton step below which a patch is no longer moved: steps that do not help are halved."""
NORM, ROUND = 0.01, 1e-4
"""Squares of the constants that bound the normalisation by a gradient, and the robust functions, from below."""


@cached
def build() -> SimpleNamespace:
    """All kernels, compiled on first launch."""
    start_warp()
    name = "neuido.flow"
    func = functools.partial(wp.func, module=name)
    kernel = functools.partial(wp.kernel, module=name, enable_backward=False)
    images = wp.array(dtype=float, ndim=3)
    flows = wp.array(dtype=wp.vec2, ndim=3)

    @func
    def place_of(thread: int, rows: int, columns: int):
        """Return the image or pair of a thread, and its row and column there."""
        return thread // (rows * columns), (thread // columns) % rows, thread % columns

    @func
    def at(image: images, n: int, y: int, x: int):
        """Read a pixel; outside, the nearest one."""
        return image[n, wp.clamp(y, 0, image.shape[1] - 1), wp.clamp(x, 0, image.shape[2] - 1)]

    @func
    def between(image: images, n: int, y: float, x: float):
        """Interpolate between four pixels."""
        row = int(wp.floor(y))
        column = int(wp.floor(x))
        b = y - float(row)
        a = x - float(column)
        upper = (1.0 - a) * at(image, n, row, column) + a * at(image, n, row, column + 1)
        lower = (1.0 - a) * at(image, n, row + 1, column) + a * at(image, n, row + 1, column + 1)
        return (1.0 - b) * upper + b * lower

    @func
    def slope(image: images, n: int, y: int, x: int):
        """Differentiate in x and y, over one pixel on each side."""
        return wp.vec2(0.5 * (at(image, n, y, x + 1) - at(image, n, y, x - 1)), 0.5 * (at(image, n, y + 1, x) - at(image, n, y - 1, x)))

    @kernel
    def differentiate(image: images, slopes: flows):
        """Differentiate all images by Sobel's masks, which the search takes."""
        n, y, x = place_of(wp.tid(), image.shape[1], image.shape[2])
        along = 2.0 * (at(image, n, y, x + 1) - at(image, n, y, x - 1))
        down = 2.0 * (at(image, n, y + 1, x) - at(image, n, y - 1, x))
        for side in range(2):
            s = 2 * side - 1
            along += at(image, n, y + s, x + 1) - at(image, n, y + s, x - 1)
            down += at(image, n, y + 1, x + s) - at(image, n, y - 1, x + s)
        slopes[n, y, x] = wp.vec2(along, down) / 8.0

    @func
    def mismatch(image: images, slopes: flows, first: int, top: int, left: int, u: wp.vec2):
        """Sum up the squared differences of a patch from where the flow takes it, without their mean, and what moves it."""
        total = float(0.0)
        square = float(0.0)
        gradient = wp.vec2(0.0, 0.0)
        mean = wp.vec2(0.0, 0.0)
        for k in range(wp.static(PATCH * PATCH)):
            y = top + k // wp.static(PATCH)
            x = left + k % wp.static(PATCH)
            d = between(image, first + 1, float(y) + u[1], float(x) + u[0]) - image[first, y, x]
            g = slopes[first, y, x]
            total += d
            square += d * d
            gradient += d * g
            mean += g
        share = total / wp.static(float(PATCH * PATCH))
        moved = gradient - share * mean
        return wp.vec3(square - share * total, moved[0], moved[1])

    @func
    def curvature(slopes: flows, first: int, top: int, left: int):
        """Sum up the matrix of the normal equations of a patch, (xx, xy, yy), without the mean of the slopes."""
        m = wp.vec3(0.0, 0.0, 0.0)
        mean = wp.vec2(0.0, 0.0)
        for k in range(wp.static(PATCH * PATCH)):
            g = slopes[first, top + k // wp.static(PATCH), left + k % wp.static(PATCH)]
            m += wp.vec3(g[0] * g[0], g[0] * g[1], g[1] * g[1])
            mean += g
        return m - wp.vec3(mean[0] * mean[0], mean[0] * mean[1], mean[1] * mean[1]) / wp.static(float(PATCH * PATCH))

    @kernel
    def search(
        image: images,
        slopes: flows,
        steps: int,
        rows: int,
        columns: int,
        stride: int,
        iterations: int,
        neighbours: int,
        start: flows,
        found: flows,
    ):
        """Move each patch by Gauss-Newton steps from where a flow per pixel, or its neighbours, begin."""
        p, i, j = place_of(wp.tid(), rows, columns)
        first = p + p // steps
        top = i * stride
        left = j * stride
        u = wp.vec2(0.0, 0.0)
        best = wp.vec3(0.0, 0.0, 0.0)
        if neighbours == 0:
            u = start[p, top + wp.static(PATCH // 2), left + wp.static(PATCH // 2)]
            best = mismatch(image, slopes, first, top, left, u)
        else:
            u = start[p, i, j]
            best = mismatch(image, slopes, first, top, left, u)
            for k in range(4):
                a = wp.clamp(i + (k - 1) * ((k + 1) % 2), 0, rows - 1)
                b = wp.clamp(j + (k - 2) * (k % 2), 0, columns - 1)
                other = start[p, a, b]
                cost = mismatch(image, slopes, first, top, left, other)
                if cost[0] < best[0]:
                    best = cost
                    u = other
        m = curvature(slopes, first, top, left)
        det = m[0] * m[2] - m[1] * m[1]
        begun = u
        if det > 1.0e-3:
            length = float(1.0)
            for _ in range(iterations):
                if length > wp.static(SHORTEST):
                    ahead = u - length * wp.vec2(m[2] * best[1] - m[1] * best[2], m[0] * best[2] - m[1] * best[1]) / det
                    cost = mismatch(image, slopes, first, top, left, ahead)
                    if cost[0] < best[0]:
                        u = ahead
                        best = cost
                    else:
                        length = 0.5 * length
        if wp.length(u - begun) > wp.static(float(PATCH)):
            u = begun
        found[p, i, j] = u

    @kernel
    def densify(image: images, steps: int, stride: int, patches: flows, flow: flows):
        """Set the flow of each pixel to the mean of the patches over it, each with its weight by how well it matches here."""
        p, y, x = place_of(wp.tid(), flow.shape[1], flow.shape[2])
        first = p + p // steps
        rows = patches.shape[1]
        columns = patches.shape[2]
        i1 = wp.min(y // stride, rows - 1)
        j1 = wp.min(x // stride, columns - 1)
        i0 = wp.clamp((y - wp.static(PATCH) + stride) // stride, 0, i1)
        j0 = wp.clamp((x - wp.static(PATCH) + stride) // stride, 0, j1)
        total = wp.vec2(0.0, 0.0)
        weights = float(0.0)
        for i in range(i0, i1 + 1):
            for j in range(j0, j1 + 1):
                u = patches[p, i, j]
                d = between(image, first + 1, float(y) + u[1], float(x) + u[0]) - image[first, y, x]
                weight = 1.0 / wp.max(1.0, wp.abs(d))
                total += weight * u
                weights += weight
        flow[p, y, x] = total / weights

    @kernel
    def take_there(image: images, steps: int, flow: flows, mean: images, change: images):
        """Follow the flow: the mean of both images and their difference at each pixel."""
        p, y, x = place_of(wp.tid(), flow.shape[1], flow.shape[2])
        first = p + p // steps
        u = flow[p, y, x]
        here = image[first, y, x]
        there = between(image, first + 1, float(y) + u[1], float(x) + u[0])
        mean[p, y, x] = 0.5 * (here + there)
        change[p, y, x] = there - here

    @kernel
    def linearise(
        mean: images,
        change: images,
        flow: flows,
        step: flows,
        matrix: wp.array(dtype=wp.vec3, ndim=3),
        right: flows,
        smooth: images,
    ):
        """Set up the equations of the step at each pixel, with the robust weights at the present step."""
        height = flow.shape[1]
        width = flow.shape[2]
        p, y, x = place_of(wp.tid(), height, width)
        d = step[p, y, x]
        g = slope(mean, p, y, x)
        t = change[p, y, x]
        norm = g[0] * g[0] + g[1] * g[1] + wp.static(NORM)
        e = t + wp.dot(g, d)
        w = wp.static(COLOUR) / wp.sqrt(e * e / norm + wp.static(ROUND)) / norm
        m = w * wp.vec3(g[0] * g[0], g[0] * g[1], g[1] * g[1]) + wp.vec3(wp.static(NORM), 0.0, wp.static(NORM))
        b = -w * t * g
        east = slope(mean, p, y, x + 1)
        west = slope(mean, p, y, x - 1)
        south = slope(mean, p, y + 1, x)
        north = slope(mean, p, y - 1, x)
        xx = 0.5 * (east[0] - west[0])
        xy = 0.5 * (south[0] - north[0])
        yy = 0.5 * (south[1] - north[1])
        turn = slope(change, p, y, x)
        norm_x = xx * xx + xy * xy + wp.static(NORM)
        norm_y = yy * yy + xy * xy + wp.static(NORM)
        ex = turn[0] + xx * d[0] + xy * d[1]
        ey = turn[1] + xy * d[0] + yy * d[1]
        w = wp.static(GRADIENT) / wp.sqrt(ex * ex / norm_x + ey * ey / norm_y + wp.static(ROUND))
        m += w * wp.vec3(xx * xx / norm_x + xy * xy / norm_y, xx * xy / norm_x + xy * yy / norm_y, xy * xy / norm_x + yy * yy / norm_y)
        b -= w * wp.vec2(xx * turn[0] / norm_x + xy * turn[1] / norm_y, xy * turn[0] / norm_x + yy * turn[1] / norm_y)
        here = flow[p, y, x] + d
        over = wp.min(x + 1, width - 1)
        under = wp.min(y + 1, height - 1)
        dx = flow[p, y, over] + step[p, y, over] - here
        dy = flow[p, under, x] + step[p, under, x] - here
        matrix[p, y, x] = m
        right[p, y, x] = b
        smooth[p, y, x] = wp.static(SMOOTH) / wp.sqrt(wp.dot(dx, dx) + wp.dot(dy, dy) + wp.static(ROUND))

    @kernel
    def relax(
        flow: flows,
        matrix: wp.array(dtype=wp.vec3, ndim=3),
        right: flows,
        smooth: images,
        colour: int,
        step: flows,
    ):
        """Relax the step of the pixels of one colour of a chessboard."""
        height = flow.shape[1]
        width = flow.shape[2]
        p, y, x = place_of(wp.tid(), height, width)
        if (x + y) % 2 == colour:
            b = right[p, y, x]
            m = matrix[p, y, x]
            own = flow[p, y, x]
            ties = float(0.0)
            pull = wp.vec2(0.0, 0.0)
            if x + 1 < width:
                ties += smooth[p, y, x]
                pull += smooth[p, y, x] * (flow[p, y, x + 1] + step[p, y, x + 1] - own)
            if y + 1 < height:
                ties += smooth[p, y, x]
                pull += smooth[p, y, x] * (flow[p, y + 1, x] + step[p, y + 1, x] - own)
            if x > 0:
                ties += smooth[p, y, x - 1]
                pull += smooth[p, y, x - 1] * (flow[p, y, x - 1] + step[p, y, x - 1] - own)
            if y > 0:
                ties += smooth[p, y - 1, x]
                pull += smooth[p, y - 1, x] * (flow[p, y - 1, x] + step[p, y - 1, x] - own)
            d = step[p, y, x]
            du = d[0] + wp.static(OVER) * ((b[0] + pull[0] - m[1] * d[1]) / (m[0] + ties) - d[0])
            dv = d[1] + wp.static(OVER) * ((b[1] + pull[1] - m[1] * du) / (m[2] + ties) - d[1])
            step[p, y, x] = wp.vec2(du, dv)

    return SimpleNamespace(
        differentiate=differentiate, search=search, densify=densify, take_there=take_there, linearise=linearise, relax=relax
    )
