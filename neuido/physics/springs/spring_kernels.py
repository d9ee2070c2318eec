"""Warp kernels of a mass-spring step and of its adjoint.

Several threads (`lanes`) share the springs of a mass. Each writes its part of the force, and a second kernel adds the parts: no atomics.

A spring between i and j with l = |x_j - x_i|, d = (x_j - x_i) / l and s = l / L - 1 pulls i by T d and j by -T d,

    T = k (l - L) (1 + |s|)^p + c (v_j - v_i) d        (Spring-Gaus, `compute_force`; p = 0: Hooke)

The step is semi-implicit Euler: v* = v + dt (g + f / m), x* = x + dt v*. Then contact: a mass inside a plane is moved onto it, its velocity
into the plane becomes zero, and its tangential velocity is multiplied by `grip` (Spring-Gaus, `apply_bc`).
"""

import functools
from types import SimpleNamespace

import warp as wp

from neuido.physics.colliders.contact import SLIP, STICKY
from neuido.physics.runtime.device import start_warp
from neuido.physics.runtime.once import cached

SHORTEST = 1e-9
"""Lower bound of the length of a spring in a denominator [m]."""


@cached
def build(real: type) -> SimpleNamespace:
    """Return the kernels for `wp.float32` or `wp.float64`.

    The springs of mass i are the entries offsets[i]:offsets[i + 1] of `others` (mass at the other end) and `springs` (index of the
    spring), so that each spring is listed twice. Thread t of `pull` and `pull_adjoint` takes every `lanes`-th spring of mass t / lanes.
    `n` is the step, and x and v hold all steps.
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
    frames = wp.array2d(dtype=vec3)
    planes_of = wp.array(dtype=vec4)
    zero = wp.constant(real(0.0))
    one = wp.constant(real(1.0))
    shortest = wp.constant(real(SHORTEST))

    @func
    def normal_of(plane: vec4):
        return vec3(plane[0], plane[1], plane[2])

    @func
    def touch(plane: vec4, kind: int, grip: real, x: vec3, v: vec3):
        """Return position and velocity after contact with one plane."""
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
    def pull(
        n: int, power: real, offsets: ints, others: ints, springs: ints, rest: reals, stiffness: reals, damping: reals, x: frames,
        v: frames, lanes: int, parts: vecs,
    ):  # fmt: skip
        """Write the part of the force on a mass that one thread computes."""
        t = wp.tid()
        i = t // lanes
        force = vec3(zero, zero, zero)
        for e in range(offsets[i] + t % lanes, offsets[i + 1], lanes):
            j = others[e]
            s = springs[e]
            delta = x[n, j] - x[n, i]
            length = wp.max(wp.length(delta), shortest)
            d = delta / length
            stretch = length / rest[s] - one
            tension = stiffness[s] * (length - rest[s]) * wp.pow(one + wp.abs(stretch), power)
            force += (tension + damping[s] * wp.dot(v[n, j] - v[n, i], d)) * d
        parts[t] = force

    @kernel
    def move(
        n: int, dt: real, gravity: vec3, mass: reals, planes: planes_of, kinds: ints, grip: reals, x: frames, v: frames, lanes: int,
        parts: vecs, before: frames, left_out: vecs,
    ):  # fmt: skip
        """Write the velocity before contact, and the next position and velocity; `left_out`, if given, accumulates what x rounds off."""
        i = wp.tid()
        force = vec3(zero, zero, zero)
        for k in range(lanes):
            force += parts[i * lanes + k]
        moved = v[n, i] + dt * (gravity + force / mass[i])
        before[n, i] = moved
        step = dt * moved
        if left_out:
            step += left_out[i]
        place = x[n, i] + step
        if left_out:
            left_out[i] = step - (place - x[n, i])
        for k in range(planes.shape[0]):
            place, moved = touch(planes[k], kinds[k], grip[0], place, moved)
        x[n + 1, i] = place
        v[n + 1, i] = moved

    @kernel
    def contact_adjoint(
        n: int, dt: real, mass: reals, planes: planes_of, kinds: ints, grip: reals, x: frames, before: frames, g_x: vecs, g_v: vecs,
        g_force: vecs, g_grip: reals,
    ):  # fmt: skip
        """Propagate the adjoints of the next x and v back through contact and motion, in place.

        Writes the adjoint of the force, and adds to the mass's part of the adjoint of `grip`.
        """
        i = wp.tid()
        gx = g_x[i]
        gv = g_v[i]
        share = zero
        for back in range(planes.shape[0]):
            k = planes.shape[0] - 1 - back
            v = before[n, i]
            place = x[n, i] + dt * v
            for earlier in range(k):
                place, v = touch(planes[earlier], kinds[earlier], grip[0], place, v)
            normal = normal_of(planes[k])
            if kinds[k] != 0 and planes[k][3] - wp.dot(normal, place) >= zero:
                gx = gx - wp.dot(gx, normal) * normal
                across = gv - wp.dot(gv, normal) * normal
                if kinds[k] == STICKY:
                    gv = vec3(zero, zero, zero)
                elif kinds[k] == SLIP:
                    gv = across
                else:
                    along = wp.dot(normal, v)
                    share += wp.dot(v - along * normal, across)
                    inward = wp.dot(gv, normal)
                    gv = grip[0] * across
                    if along > zero:
                        gv = gv + inward * normal
        gv = gv + dt * gx
        g_x[i] = gx
        g_v[i] = gv
        g_force[i] = (dt / mass[i]) * gv
        g_grip[i] = g_grip[i] + share

    @kernel
    def pull_adjoint(
        n: int, power: real, offsets: ints, others: ints, springs: ints, rest: reals, stiffness: reals, damping: reals, x: frames,
        v: frames, g_force: vecs, lanes: int, parts_x: vecs, parts_v: vecs, g_stiffness: reals, g_damping: reals,
    ):  # fmt: skip
        """Write the part of the adjoints of x and v that one thread computes.

        The thread of the end with the smaller index adds to the adjoints of stiffness and damping.
        """
        t = wp.tid()
        i = t // lanes
        gx = vec3(zero, zero, zero)
        gv = vec3(zero, zero, zero)
        for e in range(offsets[i] + t % lanes, offsets[i + 1], lanes):
            j = others[e]
            s = springs[e]
            delta = x[n, j] - x[n, i]
            speed = v[n, j] - v[n, i]
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
        parts_x[t] = gx
        parts_v[t] = gv

    @kernel
    def gather(n: int, lanes: int, parts_x: vecs, parts_v: vecs, own_x: frames, own_v: frames, g_x: vecs, g_v: vecs):
        """Add the parts of all threads of a mass, and the gradient of this frame, to the adjoints of x and v."""
        i = wp.tid()
        gx = g_x[i] + own_x[n, i]
        gv = g_v[i] + own_v[n, i]
        for k in range(lanes):
            gx += parts_x[i * lanes + k]
            gv += parts_v[i * lanes + k]
        g_x[i] = gx
        g_v[i] = gv

    kernels = {"pull": pull, "move": move, "contact_adjoint": contact_adjoint, "pull_adjoint": pull_adjoint, "gather": gather}
    return SimpleNamespace(**kernels, vec3=vec3)
