"""Warp kernels that move solids by a substep: free bodies by impulses and gravity, the others by their given twists.

The kernels have no loop that carries a value, so Warp's own adjoints are right; finite differences check them. All is float64: at short
substeps a slow plate would not move in float32.
"""

import functools
from types import SimpleNamespace

import warp as wp

from neuido.physics.colliders import signed_distance
from neuido.physics.colliders.solid_contact import BODY, STATE, TWIST
from neuido.physics.runtime.device import start_warp
from neuido.physics.runtime.once import cached

RECOVERY = 0.25
"""Share of the depth of a free body in a plane that critical damping takes back in a substep; at 1 explicit contact would be unstable."""


@cached
def build(real: type) -> SimpleNamespace:
    """Return the kernels `push` and `collide` (contact of free bodies with planes and with solids) and `advance`.

    `real` is the type of gravity and planes.
    """
    start_warp()
    vec3 = wp.types.vector(length=3, dtype=real)
    vec4 = wp.types.vector(length=4, dtype=real)
    state_vec = wp.types.vector(length=STATE, dtype=wp.float64)
    twist_vec = wp.types.vector(length=TWIST, dtype=wp.float64)
    body_vec = wp.types.vector(length=BODY, dtype=wp.float64)
    name = f"neuido.rigid.{real.__name__}"
    func = functools.partial(wp.func, module=name)
    kernel = functools.partial(wp.kernel, module=name, enable_backward=True)
    f64 = wp.float64
    distance = signed_distance.functions(wp.float64, name).distance

    @func
    def turn_of(st: state_vec):
        return wp.quatd(st[4], st[5], st[6], st[3])

    @func
    def inertia_of(b: body_vec):
        return wp.mat33d(b[1], b[2], b[3], b[4], b[5], b[6], b[7], b[8], b[9])

    @func
    def turned(q: wp.quatd, v: wp.vec3d, inertia: wp.mat33d):
        """Return the inertia, given in the axes of the body, times a vector in those of the scene."""
        return wp.quat_rotate(q, inertia * wp.quat_rotate_inv(q, v))

    @func
    def rotation_by(a: wp.vec3d):
        """Return the quaternion of the rotation vector 2 a."""
        square = wp.dot(a, a)
        scale = f64(1.0) - square / f64(6.0)
        w = f64(1.0) - square / f64(2.0)
        if square > f64(1e-8):
            size = wp.sqrt(square)
            scale = wp.sin(size) / size
            w = wp.cos(size)
        return wp.quatd(scale * a[0], scale * a[1], scale * a[2], w)

    @kernel
    def push(
        step: int,
        dt: wp.array(dtype=real),
        state: wp.array3d(dtype=state_vec),
        body: wp.array2d(dtype=body_vec),
        points: wp.array3d(dtype=wp.vec4d),
        sharing: wp.array2d(dtype=wp.int32),
        damping: wp.array2d(dtype=wp.float64),
        plane: wp.array2d(dtype=vec4),
        kind: wp.array2d(dtype=wp.int32),
        friction: wp.array2d(dtype=real),
        pushed: wp.array3d(dtype=twist_vec),
    ):
        """Add the impulses of the planes on the touch points of free bodies to `pushed[step]`; the thread counts scene, body, point, plane.

        The contact is a damped spring on the effective mass at the point, critically for no restitution, and never pulls. Friction is
        Coulomb's.
        """
        count = points.shape[2] * plane.shape[1]
        i = wp.tid()
        s = i / (points.shape[1] * count)
        c = (i / count) % points.shape[1]
        p = (i / plane.shape[1]) % points.shape[2]
        k = i % plane.shape[1]
        b = body[s, c]
        at = points[s, c, p]
        if b[0] > f64(0.0) and at[3] >= f64(0.0) and kind[s, k] > 0:
            st = state[step, s, c]
            q = turn_of(st)
            row = plane[s, k]
            n = wp.vec3d(f64(row[0]), f64(row[1]), f64(row[2]))
            arm = wp.quat_rotate(q, wp.vec3d(at[0], at[1], at[2])) - at[3] * n
            gap = wp.dot(n, wp.vec3d(st[0], st[1], st[2]) + arm) - f64(row[3])
            if gap < f64(0.0):
                h = f64(dt[s])
                spin = wp.vec3d(st[10], st[11], st[12])
                v = wp.vec3d(st[7], st[8], st[9]) + wp.cross(spin, arm)
                vn = wp.dot(v, n)
                lever = wp.cross(arm, n)
                mobility = f64(1.0) / b[0] + wp.dot(lever, turned(q, lever, wp.inverse(inertia_of(b))))
                mass = f64(1.0) / (mobility * f64(sharing[s, c]))
                rate = f64(wp.static(RECOVERY))
                jn = mass * (-rate * rate * gap / h - f64(2.0) * rate * damping[s, c] * vn)
                if jn > f64(0.0):
                    t = v - vn * n
                    speed = wp.length(t)
                    grip = mass
                    if kind[s, k] != 1 and speed * mass > f64(friction[s, k]) * jn:
                        grip = f64(friction[s, k]) * jn / speed
                    J = jn * n - grip * t
                    L = wp.cross(arm, J)
                    wp.atomic_add(pushed, step, s, c, twist_vec(J[0], J[1], J[2], L[0], L[1], L[2]))

    @kernel
    def collide(
        step: int,
        dt: wp.array(dtype=real),
        state: wp.array3d(dtype=state_vec),
        twist: wp.array3d(dtype=twist_vec),
        body: wp.array2d(dtype=body_vec),
        points: wp.array3d(dtype=wp.vec4d),
        sharing: wp.array2d(dtype=wp.int32),
        damping: wp.array2d(dtype=wp.float64),
        friction: wp.array2d(dtype=wp.float64),
        shape: wp.array2d(dtype=wp.int32),
        size: wp.array2d(dtype=wp.vec4d),
        info: wp.array2d(dtype=wp.vec4i),
        samples: wp.array(dtype=wp.vec4d),
        pushed: wp.array3d(dtype=twist_vec),
    ):
        """Add the impulses of the touch points of free bodies on other solids to `pushed[step]`, equal and opposite at one place.

        The thread counts scene, body, point, solid. The spring is that of `push` on the effective mass of both; of two free bodies, whose
        points may touch both ways, each way has half of it. The pair has the mean friction and the larger restitution of the two.
        """
        solids = points.shape[1]
        count = points.shape[2] * solids
        i = wp.tid()
        s = i / (solids * count)
        c = (i / count) % solids
        p = (i / solids) % points.shape[2]
        d = i % solids
        b = body[s, c]
        at = points[s, c, p]
        if b[0] > f64(0.0) and at[3] >= f64(0.0) and shape[s, d] > 0 and d != c:
            st = state[step, s, c]
            other = state[step, s, d]
            q = turn_of(st)
            turn = turn_of(other)
            centre = wp.vec3d(st[0], st[1], st[2])
            place = wp.vec3d(other[0], other[1], other[2])
            point = wp.quat_rotate(q, wp.vec3d(at[0], at[1], at[2]))
            found = distance(shape[s, d], size[s, d], samples, info[s, d], wp.quat_rotate_inv(turn, centre + point - place))
            gap = found[3] - at[3]
            if gap < f64(0.0):
                n = wp.quat_rotate(turn, wp.vec3d(found[0], found[1], found[2]))
                arm = point - at[3] * n
                reach = centre + arm - place
                h = f64(dt[s])
                v = wp.vec3d(st[7], st[8], st[9]) + wp.cross(wp.vec3d(st[10], st[11], st[12]), arm)
                lever = wp.cross(arm, n)
                mobility = f64(1.0) / b[0] + wp.dot(lever, turned(q, lever, wp.inverse(inertia_of(b))))
                half = f64(1.0)
                e = body[s, d]
                if e[0] > f64(0.0):
                    v = v - wp.vec3d(other[7], other[8], other[9]) - wp.cross(wp.vec3d(other[10], other[11], other[12]), reach)
                    lift = wp.cross(reach, n)
                    mobility = mobility + f64(1.0) / e[0] + wp.dot(lift, turned(turn, lift, wp.inverse(inertia_of(e))))
                    half = f64(0.5)
                else:
                    t = twist[wp.min(step, twist.shape[0] - 1), s, d]
                    v = v - wp.vec3d(t[0], t[1], t[2]) - wp.cross(wp.vec3d(t[3], t[4], t[5]), reach)
                vn = wp.dot(v, n)
                mass = half / (mobility * f64(sharing[s, c]))
                rate = f64(wp.static(RECOVERY))
                ratio = wp.min(damping[s, c], damping[s, d])
                jn = mass * (-rate * rate * gap / h - f64(2.0) * rate * ratio * vn)
                if jn > f64(0.0):
                    along = v - vn * n
                    speed = wp.length(along)
                    mu = f64(0.5) * (friction[s, c] + friction[s, d])
                    grip = mass
                    if speed * mass > mu * jn:
                        grip = mu * jn / speed
                    J = jn * n - grip * along
                    L = wp.cross(arm, J)
                    K = -wp.cross(reach, J)
                    wp.atomic_add(pushed, step, s, c, twist_vec(J[0], J[1], J[2], L[0], L[1], L[2]))
                    wp.atomic_add(pushed, step, s, d, twist_vec(-J[0], -J[1], -J[2], K[0], K[1], K[2]))

    @kernel
    def advance(
        step: int,
        dt: wp.array(dtype=real),
        pull: wp.array2d(dtype=vec3),
        twist: wp.array3d(dtype=twist_vec),
        body: wp.array2d(dtype=body_vec),
        impulse: wp.array3d(dtype=twist_vec),
        pushed: wp.array3d(dtype=twist_vec),
        state: wp.array3d(dtype=state_vec),
        state_next: wp.array3d(dtype=state_vec),
    ):
        """Write `state_next[step + 1]` from `state[step]`, which are the same array; `pull` is gravity, with a row for each substep or one.

        A free body keeps its angular momentum: the angular velocity follows from it in the new rotation.
        """
        i = wp.tid()
        s = i / body.shape[1]
        c = i % body.shape[1]
        st = state[step, s, c]
        b = body[s, c]
        h = f64(dt[s])
        q = turn_of(st)
        x = wp.vec3d(st[0], st[1], st[2])
        if b[0] > f64(0.0):
            J = impulse[step, s, c] + pushed[step, s, c]
            g = pull[wp.min(step, pull.shape[0] - 1), s]
            v = wp.vec3d(st[7], st[8], st[9]) + wp.vec3d(J[0], J[1], J[2]) / b[0] + h * wp.vec3d(f64(g[0]), f64(g[1]), f64(g[2]))
            inertia = inertia_of(b)
            inverse = wp.inverse(inertia)
            L = turned(q, wp.vec3d(st[10], st[11], st[12]), inertia) + wp.vec3d(J[3], J[4], J[5])
            middle = turned(q, L, inverse)
            turn = wp.normalize(rotation_by(f64(0.5) * h * middle) * q)
            w = turned(turn, L, inverse)
            y = x + h * v
            state_next[step + 1, s, c] = state_vec(y[0], y[1], y[2], turn[3], turn[0], turn[1], turn[2], v[0], v[1], v[2], w[0], w[1], w[2])
        else:
            t = twist[wp.min(step, twist.shape[0] - 1), s, c]
            y = x + h * wp.vec3d(t[0], t[1], t[2])
            turn = wp.normalize(rotation_by(f64(0.5) * h * wp.vec3d(t[3], t[4], t[5])) * q)
            state_next[step + 1, s, c] = state_vec(y[0], y[1], y[2], turn[3], turn[0], turn[1], turn[2], t[0], t[1], t[2], t[3], t[4], t[5])

    return SimpleNamespace(push=push, collide=collide, advance=advance)
