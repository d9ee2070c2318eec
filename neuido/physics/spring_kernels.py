"""Warp kernels of a mass-spring step and its adjoint. A thread owns a mass and reads the springs at it, so nothing is added atomically.

A spring between i and j with l = |x_j - x_i|, d = (x_j - x_i) / l and s = l / L - 1 pulls i by T d and j by -T d,

    T = k (l - L) (1 + |s|)^p + c (v_j - v_i) d        (Spring-Gaus, `compute_force`; p = 0: Hooke)

The step is semi-implicit Euler: v* = v + dt (g + f / m), x* = x + dt v*; then contact: a mass inside a plane is put onto it, its velocity
into the plane becomes zero, and the share `grip` of the tangential one is left (Spring-Gaus, `apply_bc`).
"""

import functools
from types import SimpleNamespace

import warp as wp

from neuido.physics.device import start_warp
from neuido.physics.grid_kernels import SLIP, STICKY

SHORTEST = 1e-9
"""Lower bound of a spring's length in a denominator [m]."""


@functools.cache
def build(real: type) -> SimpleNamespace:
    """The kernels for `wp.float32` or `wp.float64`.

    Springs come as lists: those of mass i stand at offsets[i]:offsets[i + 1] of `others` (the mass at the other end) and `springs` (which
    spring it is); each spring stands in two lists.
    """
    start_warp()
    vec3 = wp.types.vector(length=3, dtype=real)
    vec4 = wp.types.vector(length=4, dtype=real)
    name = f"neuido.springs.{real.__name__}"
    func = functools.partial(wp.func, module=name)
    kernel = functools.partial(wp.kernel, module=name, enable_backward=False)
    ints = wp.array(dtype=wp.int32)
    reals = wp.array(dtype=real)
    vecs = wp.array(dtype=vec3)
    planes_of = wp.array(dtype=vec4)
    zero = wp.constant(real(0.0))
    one = wp.constant(real(1.0))
    shortest = wp.constant(real(SHORTEST))

    @func
    def normal_of(plane: vec4):
        return vec3(plane[0], plane[1], plane[2])

    @func
    def touch(plane: vec4, kind: int, grip: real, x: vec3, v: vec3):
        """Position and velocity after one plane."""
        n = normal_of(plane)
        depth = plane[3] - wp.dot(n, x)
        if kind != 0 and depth >= zero:
            x = x + depth * n
            along = wp.dot(n, v)
            rest = v - along * n
            if kind == STICKY:
                v = vec3(zero, zero, zero)
            elif kind == SLIP:
                v = rest
            else:
                v = grip * rest + wp.max(along, zero) * n
        return x, v

    @kernel
    def step(
        dt: real, gravity: vec3, power: real, offsets: ints, others: ints, springs: ints, rest: reals, mass: reals, planes: planes_of,
        kinds: ints, stiffness: reals, damping: reals, grip: reals, x: vecs, v: vecs, before: vecs, x_next: vecs, v_next: vecs,
    ):  # fmt: skip
        """Writes the velocity before contact, and position and velocity after it."""
        i = wp.tid()
        force = vec3(zero, zero, zero)
        for e in range(offsets[i], offsets[i + 1]):
            j = others[e]
            s = springs[e]
            delta = x[j] - x[i]
            length = wp.max(wp.length(delta), shortest)
            d = delta / length
            stretch = length / rest[s] - one
            pull = stiffness[s] * (length - rest[s]) * wp.pow(one + wp.abs(stretch), power)
            force += (pull + damping[s] * wp.dot(v[j] - v[i], d)) * d
        moved = v[i] + dt * (gravity + force / mass[i])
        before[i] = moved
        place = x[i] + dt * moved
        for k in range(planes.shape[0]):
            place, moved = touch(planes[k], kinds[k], grip[0], place, moved)
        x_next[i] = place
        v_next[i] = moved

    @kernel
    def contact_adjoint(
        dt: real, mass: reals, planes: planes_of, kinds: ints, grip: reals, x: vecs, before: vecs, g_x_next: vecs, g_v_next: vecs,
        g_x: vecs, g_v: vecs, g_force: vecs, g_grip: reals,
    ):  # fmt: skip
        """Writes what reaches x and v past the forces, and the adjoint of the force; adds to the mass's share of that of `grip`."""
        i = wp.tid()
        gx = g_x_next[i]
        gv = g_v_next[i]
        share = zero
        for back in range(planes.shape[0]):
            k = planes.shape[0] - 1 - back
            v = before[i]
            place = x[i] + dt * v
            for earlier in range(k):
                place, v = touch(planes[earlier], kinds[earlier], grip[0], place, v)
            n = normal_of(planes[k])
            if kinds[k] != 0 and planes[k][3] - wp.dot(n, place) >= zero:
                gx = gx - wp.dot(gx, n) * n
                across = gv - wp.dot(gv, n) * n
                if kinds[k] == STICKY:
                    gv = vec3(zero, zero, zero)
                elif kinds[k] == SLIP:
                    gv = across
                else:
                    along = wp.dot(n, v)
                    share += wp.dot(v - along * n, across)
                    inward = wp.dot(gv, n)
                    gv = grip[0] * across
                    if along > zero:
                        gv = gv + inward * n
        gv = gv + dt * gx
        g_x[i] = gx
        g_v[i] = gv
        g_force[i] = (dt / mass[i]) * gv
        g_grip[i] = g_grip[i] + share

    @kernel
    def springs_adjoint(
        power: real, offsets: ints, others: ints, springs: ints, rest: reals, stiffness: reals, damping: reals, x: vecs, v: vecs,
        g_force: vecs, g_x: vecs, g_v: vecs, g_stiffness: reals, g_damping: reals,
    ):  # fmt: skip
        """Adds to the adjoints of x and v, and, from the end with the smaller index, to those of the springs."""
        i = wp.tid()
        gx = g_x[i]
        gv = g_v[i]
        for e in range(offsets[i], offsets[i + 1]):
            j = others[e]
            s = springs[e]
            delta = x[j] - x[i]
            speed = v[j] - v[i]
            length = wp.max(wp.length(delta), shortest)
            d = delta / length
            stretch = length / rest[s] - one
            growth = wp.pow(one + wp.abs(stretch), power)
            shape = (length - rest[s]) * growth
            slope = growth * (one + power * wp.abs(stretch) / (one + wp.abs(stretch)))
            rate = wp.dot(speed, d)
            q = g_force[i] - g_force[j]
            u = wp.dot(q, d)
            tension = stiffness[s] * shape + damping[s] * rate
            gx -= (stiffness[s] * slope * u) * d + (tension / length) * (q - u * d) + (damping[s] * u / length) * (speed - rate * d)
            gv -= (damping[s] * u) * d
            if i < j:
                g_stiffness[s] = g_stiffness[s] + shape * u
                g_damping[s] = g_damping[s] + rate * u
        g_x[i] = gx
        g_v[i] = gv

    return SimpleNamespace(step=step, contact_adjoint=contact_adjoint, springs_adjoint=springs_adjoint, vec3=vec3)
