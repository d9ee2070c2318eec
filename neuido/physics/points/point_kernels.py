"""The Warp kernel that moves point masses: one thread integrates one point from its release to its last time.

The scheme is the classical Runge-Kutta one of fourth order, with cubic Hermite interpolation between its steps. An impact on the
floor ends a step where the interpolated path meets the floor, and the rest of the step begins with the velocity after it.
"""

import warp as wp

from neuido.physics.runtime.device import start_warp
from neuido.physics.runtime.once import cached

WIDTHS = {
    "gravity": 3, "uniform_acceleration": 3, "drag_linear": 1, "drag_quadratic": 1, "magnus": 3, "position_force": 1, "position_centre": 3,
    "added_mass": 1, "dry_friction": 1, "local_force": 1, "local_centre": 3, "local_width": 1, "lift": 1, "lift_drag": 1, "disc_normal": 3,
    "pendulum": 2, "floor_normal": 3, "floor_height": 1, "restitution": 1, "restitution_speed": 1, "bounce_friction": 1, "roundness": 1,
    "surface_velocity": 3,
}  # fmt: skip
"""Number of columns of each force in the table of the kernel, in their order."""
COLUMNS = dict(zip(WIDTHS, (sum(list(WIDTHS.values())[:i]) for i in range(len(WIDTHS))), strict=True))
"""First column of each force."""
BISECTIONS = 50
"""Number of bisections that find the time of an impact within a step."""


@cached
def build():
    """Return the kernel that moves point masses in float64."""
    start_warp()
    module = "neuido.points"
    vec3, table, real = wp.vec3d, wp.array2d(dtype=wp.float64), wp.float64
    c_g, c_u, c_lin, c_quad, c_mag = (wp.constant(COLUMNS[k]) for k in list(WIDTHS)[:5])
    c_pull, c_pc, c_add, c_dry = (wp.constant(COLUMNS[k]) for k in ("position_force", "position_centre", "added_mass", "dry_friction"))
    c_loc, c_lc, c_lw = (wp.constant(COLUMNS[k]) for k in ("local_force", "local_centre", "local_width"))
    c_lift, c_ld, c_n, c_pend = (wp.constant(COLUMNS[k]) for k in ("lift", "lift_drag", "disc_normal", "pendulum"))
    c_fn, c_fh, c_e, c_es = (wp.constant(COLUMNS[k]) for k in ("floor_normal", "floor_height", "restitution", "restitution_speed"))
    c_mu, c_round, c_surface = (wp.constant(COLUMNS[k]) for k in ("bounce_friction", "roundness", "surface_velocity"))
    bisections = wp.constant(BISECTIONS)

    @wp.func(module=module)
    def triple(p: table, i: int, c: int):
        return vec3(p[i, c], p[i, c + 1], p[i, c + 2])

    @wp.func(module=module)
    def acceleration(x: vec3, v: vec3, t: real, i: int, p: table, knots: wp.array2d(dtype=vec3), interval: real, h: real, resting: int):
        one, zero = real(1.0), real(0.0)
        speed = wp.length(v)
        a = triple(p, i, c_g) / (one + p[i, c_add]) + triple(p, i, c_u) - (p[i, c_lin] + p[i, c_quad] * speed) * v
        a = a + wp.cross(triple(p, i, c_mag), v) - p[i, c_pull] * (x - triple(p, i, c_pc))
        dry = p[i, c_dry]
        if dry != zero:  # smooth over the change of speed that it causes in a step, within which the scheme is stable
            a = a - dry * v / wp.sqrt(speed * speed + dry * dry * h * h)
        if p[i, c_loc] != zero:
            r = (x - triple(p, i, c_lc)) / p[i, c_lw]
            a = a - p[i, c_loc] * wp.exp(real(0.5) * (one - wp.dot(r, r))) * r
        if p[i, c_lift] != zero or p[i, c_ld] != zero:
            if speed > zero:
                n, ahead = triple(p, i, c_n), v / speed
                s = -wp.dot(n, ahead)
                across = n + s * ahead
                size = wp.length(across)
                if size > real(1.0e-12):
                    a = a + speed * speed * p[i, c_lift] * s / size * across
                a = a - speed * speed * p[i, c_ld] * s * s * ahead
        if p[i, c_pend + 1] > zero:
            a = a - vec3(p[i, c_pend] * wp.sin(x[0] / p[i, c_pend + 1]), zero, zero)
        if interval > zero:
            count = knots.shape[1]
            u = wp.clamp(t / interval, zero, real(count - 1))
            low = wp.min(int(u), wp.max(count - 2, 0))
            a = a + (one - (u - real(low))) * knots[i, low] + (u - real(low)) * knots[i, wp.min(low + 1, count - 1)]
        if resting == 1:
            normal = triple(p, i, c_fn)
            a = a - wp.min(wp.dot(a, normal), zero) * normal
        return a

    @wp.func(module=module)
    def place(x0: vec3, v0: vec3, x1: vec3, v1: vec3, u: real, h: real):
        two, three = real(2.0), real(3.0)
        a, b = v0 * h, v1 * h
        return x0 + u * a + u * u * (three * (x1 - x0) - two * a - b) + u * u * u * (two * (x0 - x1) + a + b)

    @wp.func(module=module)
    def advance(x: vec3, v: vec3, t: real, k: real, i: int, p: table, knots: wp.array2d(dtype=vec3), interval: real, h: real, resting: int):
        two, half = real(2.0), real(0.5) * k
        a1 = acceleration(x, v, t, i, p, knots, interval, h, resting)
        v2 = v + half * a1
        a2 = acceleration(x + half * v, v2, t + half, i, p, knots, interval, h, resting)
        v3 = v + half * a2
        a3 = acceleration(x + half * v2, v3, t + half, i, p, knots, interval, h, resting)
        v4 = v + k * a3
        a4 = acceleration(x + k * v3, v4, t + k, i, p, knots, interval, h, resting)
        sixth = k / real(6.0)
        return x + sixth * (v + two * v2 + two * v3 + v4), v + sixth * (a1 + two * a2 + two * a3 + a4)

    @wp.func(module=module)
    def after_impact(v: vec3, surface: vec3, i: int, p: table):
        """Return velocity and surface velocity (spin times radius) after an impact: Garwin 1969, Cross 2002."""
        one, zero = real(1.0), real(0.0)
        n = triple(p, i, c_fn)
        inward = -wp.dot(v, n)
        e = wp.clamp(p[i, c_e] * wp.pow(inward, -p[i, c_es]), zero, one)
        slip = v + inward * n - wp.cross(surface, n)
        size = wp.length(slip)
        out = v + (one + e) * inward * n
        mu, beta = p[i, c_mu], p[i, c_round]
        if mu > zero and size > zero:
            push = wp.min(mu * (one + e) * inward, size * beta / (one + beta))
            out = out - push / size * slip
            if beta > zero:
                surface = surface + push / (size * beta) * wp.cross(n, slip)
        return out, surface

    @wp.kernel(module=module, enable_backward=False)
    def move(
        times: table, position: wp.array(dtype=vec3), velocity: wp.array(dtype=vec3), release: wp.array(dtype=real), p: table,
        knots: wp.array2d(dtype=vec3), interval: real, step: real, out: wp.array2d(dtype=vec3),
    ):  # fmt: skip
        i = wp.tid()
        zero, one = real(0.0), real(1.0)
        x, v = one * position[i], one * velocity[i]  # products, since a plain name would stay an alias of what it is taken from
        t, begun = real(0.0), one * release[i]
        last = times.shape[1] - 1
        n = triple(p, i, c_fn)
        floor = wp.dot(n, n) > zero
        surface = triple(p, i, c_surface)
        resting = int(0)
        left = one * step
        k = int(0)
        while k <= last and times[i, k] - begun <= zero:
            out[i, k] = x
            k = k + 1
        hit = int(0)  # 1: the next attempt ends at an impact
        took = one * step
        while k <= last:
            stuck = int(0)  # dry friction holds a body that is slow and that no other force could move
            if p[i, c_dry] > zero and wp.length(v) < p[i, c_dry] * step:
                still = vec3()
                if wp.length(acceleration(x, still, t + begun, i, p, knots, interval, step, resting)) <= p[i, c_dry]:
                    stuck = int(1)
            xn, vn = advance(x, v, t + begun, took, i, p, knots, interval, step, resting)
            if stuck == 1:
                xn = one * x
                vn = vec3()
                v = vec3()
            if hit == 0 and floor and resting == 0 and wp.dot(n, xn) < p[i, c_fh] and wp.dot(n, vn) < zero:
                low, high = real(0.0), real(1.0)
                if wp.dot(n, x) > p[i, c_fh] - real(1.0e-9):
                    for _ in range(bisections):
                        middle = real(0.5) * (low + high)
                        if wp.dot(n, place(x, v, xn, vn, middle, took)) > p[i, c_fh]:
                            low = middle
                        else:
                            high = middle
                took = high * took
                hit = int(1)
            else:
                while k <= last and times[i, k] - begun <= t + took and took > zero:
                    out[i, k] = place(x, v, xn, vn, (times[i, k] - begun - t) / took, took)
                    k = k + 1
                x = xn
                v = vn
                t = t + took
                left = left - took
                if hit == 1:
                    hit = int(0)
                    x = x + (p[i, c_fh] - wp.dot(n, x)) * n
                    if wp.dot(v, n) < zero:
                        v, surface = after_impact(v, surface, i, p)
                    if wp.dot(v, n) < real(0.5) * step * wp.length(triple(p, i, c_g)):  # bounces within a step: it stays on the floor
                        v = v - wp.dot(v, n) * n
                        resting = int(1)
                if left <= real(1.0e-12) * step:
                    left = one * step
                took = one * left

    return move
