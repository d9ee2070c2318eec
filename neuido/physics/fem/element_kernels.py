"""Warp kernels of linear tetrahedra: kinematics, nodal forces, motion and contact of the nodes, average nodal volume change.

The gradients of an element's shape functions are stored as G = Ds^-1 with Ds = [x1 - x0, x2 - x0, x3 - x0]. The nodal force is
-V0 tau grad N, with the Kirchhoff stress tau and the initial volume V0 (Belytschko, Liu and Moran, Nonlinear Finite Elements, sec. 4.5).
Each node sums the forces of its elements itself: the order of the sum is fixed, and no atomics are needed.
"""

import functools
from types import SimpleNamespace

import warp as wp

from neuido.physics.colliders import contact as contact_functions
from neuido.physics.mpm.kernels import grid as mpm_grid
from neuido.physics.runtime.device import start_warp
from neuido.physics.runtime.events import COLLAPSED
from neuido.physics.runtime.once import cached


@cached
def build(real: type) -> SimpleNamespace:
    """Return the kernels for `wp.float32` or `wp.float64`; body forces are those of `mpm.grid`."""
    start_warp()
    vec3 = wp.types.vector(length=3, dtype=real)
    vec4 = wp.types.vector(length=4, dtype=real)
    mat33 = wp.types.matrix(shape=(3, 3), dtype=real)
    module = f"neuido.elements.{real.__name__}"
    func = functools.partial(wp.func, module=module)
    kernel = functools.partial(wp.kernel, module=module, enable_backward=False)
    grid = mpm_grid.build(real)
    push = grid.functions.push
    met = contact_functions.functions(real, module)
    contact, damp_contact = met.contact, met.damp_contact
    zero = wp.constant(real(0.0))

    @func
    def edges(e: wp.vec4i, x: wp.array(dtype=vec3)):
        x0 = x[e[0]]
        return wp.matrix_from_cols(x[e[1]] - x0, x[e[2]] - x0, x[e[3]] - x0)

    @kernel
    def reference(elements: wp.array(dtype=wp.vec4i), x: wp.array(dtype=vec3), gradients: wp.array(dtype=mat33)):
        """Write G of the initial positions."""
        e = wp.tid()
        gradients[e] = wp.inverse(edges(elements[e], x))

    @kernel
    def kinematics(
        elements: wp.array(dtype=wp.vec4i),
        x: wp.array(dtype=vec3),
        v: wp.array(dtype=vec3),
        shape: wp.array(dtype=mat33),
        rate: bool,
        gradients: wp.array(dtype=mat33),
        C: wp.array(dtype=mat33),
        F: wp.array(dtype=mat33),
        step: int,
        volume: wp.array(dtype=real),
        lowest: wp.array(dtype=real),
        since: wp.array(dtype=wp.int32),
    ):
        """Write G, F = Ds `shape`, and with `rate` the velocity gradient C.

        C is the gradient of the new velocity at the old positions, so that F is (I + dt C) times the last F. F is not accumulated from
        C: its error stays bounded where an element is nearly inverted and G is large for a moment.

        An element whose det F, or whose volume over the initial `volume`, is below `COLLAPSED` leaves the smallest one in `lowest` and the
        first such step in `since`: where it flows its elastic F is sound while its shape is not.
        """
        i = wp.tid()
        e = elements[i]
        D = edges(e, x)
        if rate:
            C[i] = edges(e, v) * gradients[i]
        f = D * shape[i]
        F[i] = f
        J = wp.min(wp.determinant(f), wp.determinant(D) / (real(6.0) * volume[i]))
        if J < wp.static(real(COLLAPSED)):
            lowest[i] = wp.min(lowest[i], J)
            if since[i] < 0:
                since[i] = step
        gradients[i] = wp.inverse(D)

    @kernel
    def reshape(
        scene: wp.array(dtype=wp.int32),
        size: wp.array(dtype=real),
        trial: wp.array(dtype=mat33),
        F: wp.array(dtype=mat33),
        gradients: wp.array(dtype=mat33),
        shape: wp.array(dtype=mat33),
    ):
        """Write the stress-free shape G F of the elements whose F was corrected by plastic flow; `size`: what swelling divides F by."""
        i = wp.tid()
        change = F[i] - trial[i]
        if wp.ddot(change, change) != zero:
            own = gradients[i] * F[i]
            if size:
                own = size[scene[i]] * own
            shape[i] = own

    @kernel
    def corner_forces(
        volume: wp.array(dtype=real),
        gradients: wp.array(dtype=mat33),
        tau: wp.array(dtype=mat33),
        force: wp.array(dtype=vec3),
    ):
        """Write the force of each element on its four nodes [N]."""
        i = wp.tid()
        H = (-volume[i]) * (tau[i] * wp.transpose(gradients[i]))
        a = vec3(H[0, 0], H[1, 0], H[2, 0])
        b = vec3(H[0, 1], H[1, 1], H[2, 1])
        c = vec3(H[0, 2], H[1, 2], H[2, 2])
        force[4 * i] = -(a + b + c)
        force[4 * i + 1] = a
        force[4 * i + 2] = b
        force[4 * i + 3] = c

    @func
    def touch(
        v0: vec3,
        x: vec3,
        s: int,
        h: real,
        plane: wp.array2d(dtype=vec4),
        kind: wp.array2d(dtype=wp.int32),
        friction: wp.array2d(dtype=real),
        force: wp.array2d(dtype=real),
    ):
        """Return the velocity of a node after contact, such that it ends its step on a plane and not behind it."""
        v = v0
        for c in range(kind.shape[1]):
            if kind[s, c] > 0:
                n = vec3(plane[s, c][0], plane[s, c][1], plane[s, c][2])
                gap = wp.dot(n, x) - plane[s, c][3]
                if gap + h * wp.dot(n, v) <= zero or gap <= zero:
                    reach = (-wp.max(gap, zero) / h) * n
                    v = contact(v - reach, n, kind[s, c], friction[s, c]) + reach
                    if force.shape[1] > 6:
                        v = damp_contact(v, n, h, force, s)
        return v

    @kernel
    def move(
        first: wp.array(dtype=wp.int32),
        corner: wp.array(dtype=wp.int32),
        scene: wp.array(dtype=wp.int32),
        held: wp.array(dtype=wp.uint8),
        mass: wp.array(dtype=real),
        dt: wp.array(dtype=real),
        gravity: wp.array(dtype=vec3),
        forces: wp.array2d(dtype=real),
        plane: wp.array2d(dtype=vec4),
        kind: wp.array2d(dtype=wp.int32),
        friction: wp.array2d(dtype=real),
        force: wp.array(dtype=vec3),
        x: wp.array(dtype=vec3),
        v: wp.array(dtype=vec3),
        rest: wp.array(dtype=vec3),
    ):
        """Advance the nodes by symplectic Euler: the velocity from the forces, then the position from the new velocity.

        `rest`, if given, accumulates what the rounding of x leaves out.
        """
        i = wp.tid()
        if held[i] == wp.uint8(1):
            v[i] = vec3(zero, zero, zero)
            return
        s = scene[i]
        h = dt[s]
        f = vec3(zero, zero, zero)
        for k in range(first[i], first[i + 1]):
            f += force[corner[k]]
        u = push(v[i] + (h / mass[i]) * f, x[i], h, gravity[s], forces, s)
        u = touch(u, x[i], s, h, plane, kind, friction, forces)
        step = h * u
        if rest:
            step += rest[i]
        y = x[i] + step
        if rest:
            rest[i] = step - (y - x[i])
        v[i] = u
        x[i] = y

    @kernel
    def node_mean(
        first: wp.array(dtype=wp.int32),
        corner: wp.array(dtype=wp.int32),
        weight: wp.array(dtype=real),
        value: wp.array(dtype=real),
        out: wp.array(dtype=real),
    ):
        """Write the mean of a value over the elements around each node, weighted by their volumes."""
        i = wp.tid()
        total = zero
        around = zero
        for k in range(first[i], first[i + 1]):
            e = corner[k] / 4
            total += weight[e] * value[e]
            around += weight[e]
        out[i] = total / around

    @kernel
    def volume_change(F: wp.array(dtype=mat33), J: wp.array(dtype=real)):
        """Write J = det F."""
        i = wp.tid()
        J[i] = wp.determinant(F[i])

    @kernel
    def smooth(
        elements: wp.array(dtype=wp.vec4i),
        nodal: wp.array(dtype=real),
        F: wp.array(dtype=mat33),
        J: wp.array(dtype=real),
        J_mean: wp.array(dtype=real),
        F_mean: wp.array(dtype=mat33),
    ):
        """Write F with the mean volume change of the element's nodes in place of its own."""
        i = wp.tid()
        e = elements[i]
        m = real(0.25) * (nodal[e[0]] + nodal[e[1]] + nodal[e[2]] + nodal[e[3]])
        J_mean[i] = m
        F_mean[i] = wp.cbrt(m / J[i]) * F[i]

    @kernel
    def pressure(tau: wp.array(dtype=mat33), J_mean: wp.array(dtype=real), out: wp.array(dtype=real)):
        """Write the derivative of the energy with respect to the mean volume change [Pa]."""
        i = wp.tid()
        out[i] = wp.trace(tau[i]) / (real(3.0) * J_mean[i])

    @kernel
    def spread_pressure(
        elements: wp.array(dtype=wp.vec4i),
        nodal: wp.array(dtype=real),
        J: wp.array(dtype=real),
        tau: wp.array(dtype=mat33),
    ):
        """Write the stress whose forces are the gradient of the smoothed energy: the deviator, and the mean pressure of the nodes."""
        i = wp.tid()
        e = elements[i]
        p = J[i] * real(0.25) * (nodal[e[0]] + nodal[e[1]] + nodal[e[2]] + nodal[e[3]])
        t = tau[i]
        tau[i] = t + (p - wp.trace(t) / real(3.0)) * wp.identity(n=3, dtype=real)

    return SimpleNamespace(
        reference=reference,
        kinematics=kinematics,
        reshape=reshape,
        corner_forces=corner_forces,
        move=move,
        node_mean=node_mean,
        volume_change=volume_change,
        smooth=smooth,
        pressure=pressure,
        spread_pressure=spread_pressure,
        add_viscous_stress=grid.add_viscous_stress,
    )
