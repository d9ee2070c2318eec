"""Warp kernels of `Effects.spin_decay`, a torque that damps the rotation of a body, with a hand-written adjoint.

The angular velocity w solves I w = L, with the inertia I and the angular momentum L about the centre of mass. The field of forces

    v -= f w x (x - centre),   C -= f [w]x,   f = 1 - exp(-k dt)

takes the share f of the angular momentum in a substep and no linear momentum, since the masses balance about their centre. Particles of
the material point method also rotate within themselves: each adds twice m dx^2/4 to the moments of inertia, and m dx^2/4 times the axial
vector of C - C^T to L. With them L falls by exp(-k dt) exactly. Sums are in float64 and in a fixed order.
"""

import functools
from types import SimpleNamespace

import warp as wp

from neuido.physics.runtime.device import start_warp
from neuido.physics.runtime.once import cached

MOMENTS, ADJOINT_SUMS = 16, 6
"""Numbers in a row of partial sums: mass, m x (3), m v (3), m x x^T (6), m x X v (3); and those of the adjoint."""
STATE, ADJOINT_STATE = 16, 6
"""Numbers in a row of `find_spin`: centre, mean velocity, angular velocity, inverse inertia (6), mass; and of `find_spin_adjoint`."""


@cached
def build(real: type) -> SimpleNamespace:
    """Return the kernels for `wp.float32` or `wp.float64`."""
    start_warp()
    vec3 = wp.types.vector(length=3, dtype=real)
    mat33 = wp.types.matrix(shape=(3, 3), dtype=real)
    name = f"neuido.spin.{real.__name__}"
    func = functools.partial(wp.func, module=name)
    kernel = functools.partial(wp.kernel, module=name, enable_backward=False)
    zero = wp.constant(wp.float64(0.0))
    two = wp.constant(wp.float64(2.0))
    row_of_moments = wp.types.vector(length=MOMENTS, dtype=wp.float64)
    row_of_adjoint = wp.types.vector(length=ADJOINT_SUMS, dtype=wp.float64)

    @func
    def wide(a: vec3):
        return wp.vec3d(wp.float64(a[0]), wp.float64(a[1]), wp.float64(a[2]))

    @func
    def narrow(a: wp.vec3d):
        return vec3(real(a[0]), real(a[1]), real(a[2]))

    @func
    def axial(A: mat33):
        """Return the axial vector of A - A^T."""
        return wide(vec3(A[2, 1] - A[1, 2], A[0, 2] - A[2, 0], A[1, 0] - A[0, 1]))

    @func
    def vector_at(table: wp.array2d(dtype=wp.float64), s: int, first: int):
        return wp.vec3d(table[s, first], table[s, first + 1], table[s, first + 2])

    @func
    def inverse_inertia(state: wp.array2d(dtype=wp.float64), s: int):
        xx, yy, zz = state[s, 9], state[s, 10], state[s, 11]
        xy, xz, yz = state[s, 12], state[s, 13], state[s, 14]
        return wp.mat33d(xx, xy, xz, xy, yy, yz, xz, yz, zz)

    @kernel
    def sum_moments(
        first: wp.array(dtype=wp.int32),
        lanes: int,
        loss: wp.array2d(dtype=real),
        every: bool,
        mass: wp.array(dtype=real),
        spread: wp.array(dtype=real),
        x: wp.array(dtype=vec3),
        v: wp.array(dtype=vec3),
        C: wp.array(dtype=mat33),
        partial: wp.array2d(dtype=wp.float64),
    ):
        """Sum `MOMENTS` over every `lanes`-th particle of a scene; a scene's particles are `first[s]` to `first[s + 1]`.

        `spread` is dx^2/4 of each scene [m^2]; without C the particles do not rotate within themselves. Scenes without a loss are left out
        unless `every` is set.
        """
        t = wp.tid()
        s = t / lanes
        if loss[s, 0] == real(0.0) and not every:
            return
        row = row_of_moments()
        for p in range(first[s] + t % lanes, first[s + 1], lanes):
            m = wp.float64(mass[p])
            y = wide(x[p])
            u = wide(v[p])
            L = m * wp.cross(y, u)
            if C:
                L += m * wp.float64(spread[s]) * axial(C[p])
            row[0] += m
            for a in range(3):
                row[1 + a] += m * y[a]
                row[4 + a] += m * u[a]
                row[7 + a] += m * y[a] * y[a]
                row[13 + a] += L[a]
            row[10] += m * y[0] * y[1]
            row[11] += m * y[0] * y[2]
            row[12] += m * y[1] * y[2]
        for c in range(wp.static(MOMENTS)):
            partial[t, c] = row[c]

    @kernel
    def find_spin(lanes: int, loss: wp.array2d(dtype=real), every: bool, spread: wp.array(dtype=real), inside: bool,
                  partial: wp.array2d(dtype=wp.float64), state: wp.array2d(dtype=wp.float64)):  # fmt: skip
        """Write the `STATE` of the scenes of `sum_moments`; `inside`: whether the particles rotate within themselves."""
        s = wp.tid()
        if loss[s, 0] == real(0.0) and not every:
            return
        row = row_of_moments()
        for lane in range(lanes):
            for c in range(wp.static(MOMENTS)):
                row[c] += partial[s * lanes + lane, c]
        m = row[0]
        x = wp.vec3d(row[1], row[2], row[3]) / m
        v = wp.vec3d(row[4], row[5], row[6]) / m
        xx, yy, zz = row[7] - m * x[0] * x[0], row[8] - m * x[1] * x[1], row[9] - m * x[2] * x[2]
        xy, xz, yz = row[10] - m * x[0] * x[1], row[11] - m * x[0] * x[2], row[12] - m * x[1] * x[2]
        own = zero
        if inside:
            own = two * m * wp.float64(spread[s])
        inertia = wp.mat33d(yy + zz + own, -xy, -xz, -xy, xx + zz + own, -yz, -xz, -yz, xx + yy + own)
        size = wp.trace(inertia)
        inverse = wp.mat33d()
        if wp.determinant(inertia) > wp.float64(1e-24) * size * size * size:  # a point or a needle has no rotation that can be told
            inverse = wp.inverse(inertia)
        w = inverse * (wp.vec3d(row[13], row[14], row[15]) - m * wp.cross(x, v))
        for a in range(3):
            state[s, a] = x[a]
            state[s, 3 + a] = v[a]
            state[s, 6 + a] = w[a]
            state[s, 9 + a] = inverse[a, a]
        state[s, 12] = inverse[0, 1]
        state[s, 13] = inverse[0, 2]
        state[s, 14] = inverse[1, 2]
        state[s, 15] = m

    @kernel
    def damp_spin(
        scene: wp.array(dtype=wp.int32),
        loss: wp.array2d(dtype=real),
        state: wp.array2d(dtype=wp.float64),
        x: wp.array(dtype=vec3),
        v: wp.array(dtype=vec3),
        C: wp.array(dtype=mat33),
        v_out: wp.array(dtype=vec3),
        C_out: wp.array(dtype=mat33),
    ):
        """Write v and C after the torque of a substep; `loss` is f, (S, 1)."""
        p = wp.tid()
        s = scene[p]
        fw = wp.vec3d()
        change = wp.vec3d()
        if loss[s, 0] != real(0.0):  # else there may be no state
            fw = wp.float64(loss[s, 0]) * vector_at(state, s, 6)
            change = wp.cross(fw, wide(x[p]) - vector_at(state, s, 0))
        v_out[p] = v[p] - narrow(change)
        if C:
            C_out[p] = C[p] - wp.skew(narrow(fw))

    @kernel
    def sum_spin_adjoint(
        first: wp.array(dtype=wp.int32),
        lanes: int,
        state: wp.array2d(dtype=wp.float64),
        x: wp.array(dtype=vec3),
        a_v: wp.array(dtype=vec3),
        a_C: wp.array(dtype=mat33),
        partial: wp.array2d(dtype=wp.float64),
    ):
        """Sum over every `lanes`-th particle what the adjoints of v and C say of f w, and the adjoints of v."""
        t = wp.tid()
        s = t / lanes
        centre = vector_at(state, s, 0)
        row = row_of_adjoint()
        for p in range(first[s] + t % lanes, first[s + 1], lanes):
            a = wide(a_v[p])
            turn = wp.cross(wide(x[p]) - centre, a) + axial(a_C[p])
            for c in range(3):
                row[c] += turn[c]
                row[3 + c] += a[c]
        for c in range(wp.static(ADJOINT_SUMS)):
            partial[t, c] = row[c]

    @kernel
    def find_spin_adjoint(
        lanes: int,
        loss: wp.array2d(dtype=real),
        state: wp.array2d(dtype=wp.float64),
        partial: wp.array2d(dtype=wp.float64),
        adjoint: wp.array2d(dtype=wp.float64),
        a_loss: wp.array2d(dtype=real),
    ):
        """Write the adjoint of L and that of the centre over the mass, and add to the adjoint of f."""
        s = wp.tid()
        row = row_of_adjoint()
        for lane in range(lanes):
            for c in range(wp.static(ADJOINT_SUMS)):
                row[c] += partial[s * lanes + lane, c]
        f = wp.float64(loss[s, 0])
        w = vector_at(state, s, 6)
        turn = wp.vec3d(row[0], row[1], row[2])
        of_L = inverse_inertia(state, s) * (-f * turn)
        of_centre = wp.cross(wp.vec3d(row[3], row[4], row[5]), w) * (f / state[s, 15])
        for a in range(3):
            adjoint[s, a] = of_L[a]
            adjoint[s, 3 + a] = of_centre[a]
        a_loss[s, 0] = a_loss[s, 0] - real(wp.dot(w, turn))

    @kernel
    def damp_spin_adjoint(
        scene: wp.array(dtype=wp.int32),
        mass: wp.array(dtype=real),
        spread: wp.array(dtype=real),
        loss: wp.array2d(dtype=real),
        state: wp.array2d(dtype=wp.float64),
        adjoint: wp.array2d(dtype=wp.float64),
        x: wp.array(dtype=vec3),
        v: wp.array(dtype=vec3),
        C: wp.array(dtype=mat33),
        a_mass: wp.array(dtype=real),
        a_x: wp.array(dtype=vec3),
        a_v: wp.array(dtype=vec3),
        a_C: wp.array(dtype=mat33),
    ):
        """Add to a_mass and a_x; turn the adjoints of v and C after the torque into those before it."""
        p = wp.tid()
        s = scene[p]
        m = wp.float64(mass[p])
        d = wp.float64(spread[s])
        w = vector_at(state, s, 6)
        of_L = vector_at(adjoint, s, 0)
        of_centre = vector_at(adjoint, s, 3)
        r = wide(x[p]) - vector_at(state, s, 0)
        u = wide(v[p]) - vector_at(state, s, 3)
        yr = wp.dot(of_L, r)
        wr = wp.dot(w, r)
        yw = wp.dot(of_L, w)
        own = wp.cross(u, of_L) - two * yw * r + wr * of_L + yr * w
        pulled = wp.cross(wide(a_v[p]), w) * (-wp.float64(loss[s, 0]))
        a_x[p] = a_x[p] + narrow(m * own + pulled + m * of_centre)
        momentum = wp.dot(of_L, wp.cross(r, u) + d * axial(C[p]))
        a_mass[p] = a_mass[p] + real(momentum - wp.dot(r, r) * yw + yr * wr - two * d * yw + wp.dot(of_centre, r))
        a_v[p] = a_v[p] + narrow(m * wp.cross(of_L, r))
        a_C[p] = a_C[p] + wp.skew(narrow(m * d * of_L))

    return SimpleNamespace(
        sum_moments=sum_moments,
        find_spin=find_spin,
        damp_spin=damp_spin,
        sum_spin_adjoint=sum_spin_adjoint,
        find_spin_adjoint=find_spin_adjoint,
        damp_spin_adjoint=damp_spin_adjoint,
    )
