"""Warp kernels of the contact between grid nodes and solids, with hand-written adjoints.

A solid of the kind `separate` gives a node the impulse of `multibody.press_kernels`, along N, and Coulomb's friction within its cone;
the velocity at which they part is at most `PARTING` cells a substep, if the node came no faster.

A node at signed distance phi of a solid of the kinds `sticky` and `slip`, which hold the body, takes the share s(phi) of the contact: all
of it inside, less of it up to one cell outside. The share makes the motion a smooth function of the pose, so that it has gradients.
Velocities are relative to the solid's own at the node. What a node loses, the solid receives.

The loop over solids carries a velocity. The adjoint recomputes it before each solid, as in `mpm.kernels.grid`.
"""

import functools
from types import SimpleNamespace

import warp as wp

from neuido.physics.colliders import contact as contact_functions
from neuido.physics.colliders import signed_distance
from neuido.physics.colliders.contact import SEPARATE, SLIP
from neuido.physics.runtime.device import start_warp
from neuido.physics.runtime.once import cached

PARTING = 0.125
"""Relative velocity up to which overlapping bodies are driven apart [cells a substep]; a pressure wave makes less than one. Like the other
constants of contact it is a binary fraction, which float32 has exactly."""
DAMPING = 0.0625
"""Share of their normal relative velocity that touching bodies lose in a substep, so that a body which lands comes to rest."""
STATE, TWIST, BODY = 13, 6, 10
"""Numbers of a solid's state (position, quaternion w x y z, velocity, angular velocity), of its twist, and of its mass and inertia."""


def pose_functions(real: type, module: str) -> SimpleNamespace:
    """Return the Warp functions of a solid's pose, `arm_of` and `turn_of`, and the adjoints of turns and poses.

    Args:
        real: `wp.float32` or `wp.float64`.
        module: Name of the Warp module that the functions belong to.
    """
    vec3 = wp.types.vector(length=3, dtype=real)
    vec4 = wp.types.vector(length=4, dtype=real)
    quat = wp.types.quaternion(dtype=real)
    state_vec = wp.types.vector(length=STATE, dtype=wp.float64)
    func = functools.partial(wp.func, module=module)

    @func
    def arm_of(st: state_vec, x: vec3):
        return x - vec3(real(st[0]), real(st[1]), real(st[2]))

    @func
    def turn_of(st: state_vec):
        return quat(real(st[4]), real(st[5]), real(st[6]), real(st[3]))

    @func
    def turn_adjoint(q: quat, y: vec3, a: vec3):
        """Return the adjoint of q (x, y, z, w), not held to unit length, for the adjoint a of `quat_rotate(q, y)`."""
        u = vec3(q[0], q[1], q[2])
        w = q[3]
        # R y = (2 w^2 - 1) y + 2 w u x y + 2 u (u y)
        au = real(2.0) * (w * wp.cross(y, a) + wp.dot(u, y) * a + wp.dot(u, a) * y)
        aw = real(4.0) * w * wp.dot(a, y) + real(2.0) * wp.dot(a, wp.cross(u, y))
        return vec4(au[0], au[1], au[2], aw)

    @func
    def turn_back_adjoint(q: quat, r: vec3, a: vec3):
        """Return the adjoint of q for the adjoint a of `quat_rotate_inv(q, r)`."""
        back = turn_adjoint(quat(-q[0], -q[1], -q[2], q[3]), r, a)
        return vec4(-back[0], -back[1], -back[2], back[3])

    @func
    def pose_adjoint(ar: vec3, aq: vec4):
        """Return the adjoint of a state for the adjoints of the arm and of the turn (x, y, z, w)."""
        out = state_vec()
        for k in range(3):
            out[k] = -wp.float64(ar[k])
            out[4 + k] = wp.float64(aq[k])
        out[3] = wp.float64(aq[3])
        return out

    return SimpleNamespace(
        arm_of=arm_of, turn_of=turn_of, turn_adjoint=turn_adjoint, turn_back_adjoint=turn_back_adjoint, pose_adjoint=pose_adjoint
    )


def spring_functions(real: type, module: str) -> SimpleNamespace:
    """Return the Warp functions of a contact by a spring with friction: `push_of`, `change` and `change_adjoint`.

    Args:
        real: `wp.float32` or `wp.float64`.
        module: Name of the Warp module that the functions belong to.
    """
    vec3 = wp.types.vector(length=3, dtype=real)
    func = functools.partial(wp.func, module=module)

    @func
    def push_of(given: real, wn: real, cell: real):
        """Return the change of the normal velocity wn by a spring that gives an impulse by mass; cell is a cell a substep."""
        return wp.max(real(0.0), wp.min(given - wp.static(real(DAMPING)) * wn, wp.static(real(PARTING)) * cell - wn))

    @func
    def change(w: vec3, n: vec3, given: real, cell: real, friction: real):
        """Return the change of the relative velocity w of what is pressed along n."""
        wn = wp.dot(w, n)
        push = push_of(given, wn, cell)
        t = w - wn * n
        speed = wp.length(t)
        out = push * n
        if push > real(0.0):
            if speed < friction * push:
                out = out - t
            else:
                out = out - (friction * push / wp.max(speed, real(1.0e-30))) * t
        return out

    @func
    def change_adjoint(w: vec3, n: vec3, given: real, cell: real, friction: real, a: vec3):
        """Return the adjoints of w, n, given and friction for the adjoint a of `change`."""
        aw = vec3()
        an = vec3()
        a_given = real(0.0)
        a_friction = real(0.0)
        wn = wp.dot(w, n)
        push = push_of(given, wn, cell)
        if push > real(0.0):
            t = w - wn * n
            speed = wp.length(t)
            a_push = wp.dot(n, a)
            at = -a
            if speed >= friction * push:
                safe = wp.max(speed, real(1.0e-30))
                e = t / safe
                along = wp.dot(e, a)
                at = (-friction * push / safe) * (a - along * e)
                a_push -= friction * along
                a_friction = -push * along
            a_wn = -a_push
            if given - wp.static(real(DAMPING)) * wn < wp.static(real(PARTING)) * cell - wn:
                a_given = a_push
                a_wn = -wp.static(real(DAMPING)) * a_push
            a_wn -= wp.dot(at, n)
            aw = at + a_wn * n
            an = push * a - wn * at + a_wn * w
        return aw, an, a_given, a_friction

    return SimpleNamespace(push_of=push_of, change=change, change_adjoint=change_adjoint)


@cached
def build(real: type) -> SimpleNamespace:
    """Return the kernels `meet` and `meet_adjoint` for one scalar type of the grid; poses, twists and impulses are always float64."""
    start_warp()
    vec2 = wp.types.vector(length=2, dtype=real)
    vec3 = wp.types.vector(length=3, dtype=real)
    vec4 = wp.types.vector(length=4, dtype=real)
    state_vec = wp.types.vector(length=STATE, dtype=wp.float64)
    twist_vec = wp.types.vector(length=TWIST, dtype=wp.float64)
    body_vec = wp.types.vector(length=BODY, dtype=wp.float64)
    name = f"neuido.solids.{real.__name__}"
    func = functools.partial(wp.func, module=name)
    kernel = functools.partial(wp.kernel, module=name, enable_backward=False)
    own = signed_distance.functions(real, name)
    distance, distance_adjoint = own.distance, own.distance_adjoint
    met = contact_functions.functions(real, name)
    contact, contact_adjoint = met.contact, met.contact_adjoint
    pose = pose_functions(real, name)
    arm_of, turn_of, pose_adjoint = pose.arm_of, pose.turn_of, pose.pose_adjoint
    turn_adjoint, turn_back_adjoint = pose.turn_adjoint, pose.turn_back_adjoint
    spring = spring_functions(real, name)
    change, change_adjoint = spring.change, spring.change_adjoint

    @func
    def node_place(c: wp.vec4i, origin: vec3, h: real):
        return origin + vec3(real(c[0]), real(c[1]), real(c[2])) * h

    @func
    def share_of(phi: real, h: real):
        """Return the share of the contact at a distance, and its derivative [1/m], which is continuous too."""
        t = wp.clamp(phi / h, real(0.0), real(1.0))
        rest = real(1.0) - t
        return vec2(rest * rest * (real(1.0) + real(2.0) * t), real(-6.0) * t * rest / h)

    @func
    def twist_of(st: state_vec, twist: wp.array3d(dtype=twist_vec), body: wp.array2d(dtype=body_vec), step: int, s: int, c: int):
        """Return the velocity and angular velocity of a solid: its own if it is free, else the given one."""
        out = twist[wp.min(step, twist.shape[0] - 1), s, c]
        if body[s, c][0] > wp.float64(0.0):
            for a in range(6):
                out[a] = st[7 + a]
        return out

    @func
    def linear(t: twist_vec):
        return vec3(real(t[0]), real(t[1]), real(t[2]))

    @func
    def angular(t: twist_vec):
        return vec3(real(t[3]), real(t[4]), real(t[5]))

    @func
    def after(
        u: vec3, x: vec3, h: real, s: int, c: int, step: int, state: wp.array3d(dtype=state_vec), twist: wp.array3d(dtype=twist_vec),
        body: wp.array2d(dtype=body_vec), friction: wp.array2d(dtype=wp.float64), shape: wp.array2d(dtype=wp.int32),
        kind: wp.array2d(dtype=wp.int32), size: wp.array2d(dtype=vec4), reach: wp.array2d(dtype=real), info: wp.array2d(dtype=wp.vec4i),
        samples: wp.array(dtype=vec4), pressed: vec3, m: real, dt: real,
    ):  # fmt: skip
        """Return the velocity of a node after the contact with solid c, from the velocity u before."""
        out = u
        st = state[step, s, c]
        r = arm_of(st, x)
        if kind[s, c] == wp.static(SEPARATE):
            P = wp.length(pressed)
            if P > real(0.0):
                t = twist_of(st, twist, body, step, s, c)
                out = u + change(u - linear(t) - wp.cross(angular(t), r), pressed / P, P / m, h / dt, real(friction[s, c]))
        elif kind[s, c] > 0 and wp.length(r) < reach[s, c] + h:
            q = turn_of(st)
            at = distance(shape[s, c], size[s, c], samples, info[s, c], wp.quat_rotate_inv(q, r))
            if at[3] < h:
                t = twist_of(st, twist, body, step, s, c)
                own_velocity = linear(t) + wp.cross(angular(t), r)
                n = wp.quat_rotate(q, vec3(at[0], at[1], at[2]))
                w = u - own_velocity
                share = share_of(at[3], h)[0]
                out = u + share * (contact(w, n, kind[s, c], real(friction[s, c])) - w)
        return out

    @kernel
    def meet(
        step: int,
        origin: wp.array(dtype=vec3),
        dx: wp.array(dtype=real),
        index: wp.array(dtype=wp.vec4i),
        state: wp.array3d(dtype=state_vec),
        twist: wp.array3d(dtype=twist_vec),
        body: wp.array2d(dtype=body_vec),
        friction: wp.array2d(dtype=wp.float64),
        shape: wp.array2d(dtype=wp.int32),
        kind: wp.array2d(dtype=wp.int32),
        size: wp.array2d(dtype=vec4),
        reach: wp.array2d(dtype=real),
        info: wp.array2d(dtype=wp.vec4i),
        samples: wp.array(dtype=vec4),
        dt: wp.array(dtype=real),
        pressed: wp.array2d(dtype=vec3),
        grid: wp.array(dtype=vec4),
        velocity: wp.array(dtype=vec4),
        impulse: wp.array3d(dtype=twist_vec),
    ):
        """Change the velocity of the nodes in contact, and add what they lose, impulse and angular impulse, to `impulse[step]`."""
        node = wp.tid()
        m = grid[node][3]
        if m > real(0.0):
            s = index[node][3]
            h = dx[s]
            x = node_place(index[node], origin[s], h)
            g = velocity[node]
            out = vec3(g[0], g[1], g[2])
            changed = bool(False)
            for c in range(kind.shape[1]):
                u = out
                out = after(
                    u, x, h, s, c, step, state, twist, body, friction, shape, kind, size, reach, info, samples, pressed[node, c], m, dt[s]
                )
                J = m * (u - out)
                if wp.length_sq(J) > real(0.0):
                    changed = True
                    L = wp.cross(arm_of(state[step, s, c], x), J)
                    lost = twist_vec()
                    for a in range(3):
                        lost[a] = wp.float64(J[a])
                        lost[3 + a] = wp.float64(L[a])
                    wp.atomic_add(impulse, step, s, c, lost)
            if changed:
                velocity[node] = vec4(out[0], out[1], out[2], real(0.0))

    @func
    def before(
        start: vec3, x: vec3, h: real, s: int, c: int, step: int, state: wp.array3d(dtype=state_vec), twist: wp.array3d(dtype=twist_vec),
        body: wp.array2d(dtype=body_vec), friction: wp.array2d(dtype=wp.float64), shape: wp.array2d(dtype=wp.int32),
        kind: wp.array2d(dtype=wp.int32), size: wp.array2d(dtype=vec4), reach: wp.array2d(dtype=real), info: wp.array2d(dtype=wp.vec4i),
        samples: wp.array(dtype=vec4), pressed: wp.array2d(dtype=vec3), m: real, dt: real, node: int,
    ):  # fmt: skip
        """Return the velocity of a node before the contact with solid c, from the velocity before all."""
        u = start
        for e in range(c):
            u = after(u, x, h, s, e, step, state, twist, body, friction, shape, kind, size, reach, info, samples, pressed[node, e], m, dt)
        return u

    @func
    def normal_adjoint(v: vec3, n: vec3, kind: int, a: vec3):
        """Return the adjoint of n from the adjoint a of the result of `contact`."""
        vn = wp.dot(v, n)
        out = vec3(real(0.0), real(0.0), real(0.0))
        if kind == wp.static(SLIP):
            out = -vn * a - wp.dot(a, n) * v
        return out

    @func
    def add_motion_adjoint(
        step: int, s: int, c: int, r: vec3, spin: vec3, ar: vec3, aq: vec4, aw: vec3, body: wp.array2d(dtype=body_vec),
        a_state: wp.array3d(dtype=state_vec), a_twist: wp.array3d(dtype=twist_vec),
    ):  # fmt: skip
        """Add to the adjoints of a solid: ar of the arm r, aq of the turn, and aw of the velocity relative to the solid's at r."""
        of_state = pose_adjoint(ar + wp.cross(spin, aw), aq)
        a_spin = -wp.cross(r, aw)
        of_twist = twist_vec()
        for k in range(3):
            of_twist[k] = -wp.float64(aw[k])
            of_twist[3 + k] = wp.float64(a_spin[k])
        if body[s, c][0] > wp.float64(0.0):
            for k in range(6):
                of_state[7 + k] = of_twist[k]
        else:
            wp.atomic_add(a_twist, wp.min(step, a_twist.shape[0] - 1), s, c, of_twist)
        wp.atomic_add(a_state, step, s, c, of_state)

    @kernel
    def meet_adjoint(
        step: int,
        origin: wp.array(dtype=vec3),
        dx: wp.array(dtype=real),
        index: wp.array(dtype=wp.vec4i),
        state: wp.array3d(dtype=state_vec),
        twist: wp.array3d(dtype=twist_vec),
        body: wp.array2d(dtype=body_vec),
        friction: wp.array2d(dtype=wp.float64),
        shape: wp.array2d(dtype=wp.int32),
        kind: wp.array2d(dtype=wp.int32),
        size: wp.array2d(dtype=vec4),
        reach: wp.array2d(dtype=real),
        info: wp.array2d(dtype=wp.vec4i),
        samples: wp.array(dtype=vec4),
        dt: wp.array(dtype=real),
        pressed: wp.array2d(dtype=vec3),
        grid: wp.array(dtype=vec4),
        free: wp.array(dtype=vec4),
        a_velocity: wp.array(dtype=vec4),
        a_impulse: wp.array3d(dtype=twist_vec),
        a_state: wp.array3d(dtype=state_vec),
        a_twist: wp.array3d(dtype=twist_vec),
        a_friction: wp.array2d(dtype=wp.float64),
        a_pressed: wp.array2d(dtype=vec3),
    ):
        """Turn a_velocity into the adjoint before the contact, with that of the node's mass last; write a_pressed; add to the others.

        `free` has the velocities before the contact.
        """
        node = wp.tid()
        m = grid[node][3]
        if m > real(0.0):
            s = index[node][3]
            h = dx[s]
            x = node_place(index[node], origin[s], h)
            g = free[node]
            start = vec3(g[0], g[1], g[2])
            av = a_velocity[node]
            a = vec3(av[0], av[1], av[2])
            a_mass = real(0.0)
            count = kind.shape[1]
            for r_c in range(count):
                c = count - 1 - r_c
                st = state[step, s, c]
                r = arm_of(st, x)
                t = twist_of(st, twist, body, step, s, c)
                spin = angular(t)
                mu = real(friction[s, c])
                ai = a_impulse[step, s, c]
                aL = vec3(real(ai[3]), real(ai[4]), real(ai[5]))
                aJ = vec3(real(ai[0]), real(ai[1]), real(ai[2])) + wp.cross(aL, r)
                touched = bool(False)
                ar = vec3()
                aq = vec4()
                aw = vec3()
                P = wp.length(pressed[node, c])
                a_pressed[node, c] = vec3()
                if kind[s, c] == wp.static(SEPARATE):
                    if P > real(0.0):
                        touched = True
                        u = before(
                            start, x, h, s, c, step, state, twist, body, friction, shape, kind, size, reach, info, samples, pressed, m,
                            dt[s], node
                        )  # fmt: skip
                        w = u - linear(t) - wp.cross(spin, r)
                        n = pressed[node, c] / P
                        given = P / m
                        cell = h / dt[s]
                        # the impulse J = -m moved and its moment r x J
                        moved = change(w, n, given, cell, mu)
                        ar = wp.cross(-m * moved, aL)
                        aw, an, a_given, a_mu = change_adjoint(w, n, given, cell, mu, a - m * aJ)
                        wp.atomic_add(a_friction, s, c, wp.float64(a_mu))
                        a_pressed[node, c] = (a_given / m) * n + (an - wp.dot(n, an) * n) / P
                        a_mass = a_mass - wp.dot(moved, aJ) - a_given * given / m
                elif kind[s, c] > 0 and wp.length(r) < reach[s, c] + h:
                    q = turn_of(st)
                    y = wp.quat_rotate_inv(q, r)
                    at = distance(shape[s, c], size[s, c], samples, info[s, c], y)
                    if at[3] < h:
                        touched = True
                        u = before(
                            start, x, h, s, c, step, state, twist, body, friction, shape, kind, size, reach, info, samples, pressed, m,
                            dt[s], node
                        )  # fmt: skip
                        local = vec3(at[0], at[1], at[2])
                        n = wp.quat_rotate(q, local)
                        w = u - linear(t) - wp.cross(spin, r)
                        slope = share_of(at[3], h)
                        share = slope[0]
                        lost = contact(w, n, kind[s, c], mu) - w
                        # the impulse J = -m share lost and its moment r x J
                        a_lost = share * (a - m * aJ)
                        a_phi = slope[1] * wp.dot(lost, a - m * aJ)
                        b = contact_adjoint(w, n, kind[s, c], mu, a_lost)
                        aw = vec3(b[0], b[1], b[2]) - a_lost
                        an = normal_adjoint(w, n, kind[s, c], a_lost)
                        ay = distance_adjoint(shape[s, c], size[s, c], samples, info[s, c], y, local, wp.quat_rotate_inv(q, an), a_phi)
                        aq = turn_adjoint(q, local, an) + turn_back_adjoint(q, r, ay)
                        ar = wp.cross(-(m * share) * lost, aL) + wp.quat_rotate(q, ay)
                        a_mass = a_mass - share * wp.dot(lost, aJ)
                if touched:
                    a = a + aw
                    add_motion_adjoint(step, s, c, r, spin, ar, aq, aw, body, a_state, a_twist)
            a_velocity[node] = vec4(a[0], a[1], a[2], a_mass)

    return SimpleNamespace(meet=meet, meet_adjoint=meet_adjoint)
