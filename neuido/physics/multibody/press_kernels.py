"""Warp kernels of the normal contact between particles and solids of the kind `separate`, with hand-written adjoints.

A particle extends by half its edge e, the cube root of its volume. Where it overlaps a solid by o = e/2 - phi, phi the signed distance of
its centre, a spring gives it the impulse `PUSH` m o / dt along the normal of the solid, which the nodes around it share as they share its
momentum. So contact begins where the surfaces meet, wherever the nodes lie, and gives back the energy that it took. (A node that stops as
soon as it lies within a cell of the solid begins half a cell early: a ball of ten cells a radius pressed 1.7 times as hard as Hertz's.)
`solid_contact` adds friction, and gives the solid what the nodes lose.
"""

import functools
from collections.abc import Callable
from types import SimpleNamespace

import warp as wp

from neuido.physics.colliders import signed_distance
from neuido.physics.colliders.contact import SEPARATE
from neuido.physics.colliders.solid_contact import STATE, pose_functions
from neuido.physics.multibody.contact_kernels import PUSH
from neuido.physics.runtime.device import start_warp
from neuido.physics.runtime.once import cached


@cached
def build(real: type, stencil: Callable[..., SimpleNamespace]) -> SimpleNamespace:
    """Return the kernels `press` and `press_adjoint` for one scalar type.

    Args:
        real: `wp.float32` or `wp.float64`.
        stencil: Returns the functions of the transfers' weights (`mpm.stencil.functions`).
    """
    start_warp()
    vec3 = wp.types.vector(length=3, dtype=real)
    vec4 = wp.types.vector(length=4, dtype=real)
    state_vec = wp.types.vector(length=STATE, dtype=wp.float64)
    name = f"neuido.press.{real.__name__}"
    kernel = functools.partial(wp.kernel, module=name, enable_backward=False)
    shapes = signed_distance.functions(real, name)
    distance, distance_adjoint = shapes.distance, shapes.distance_adjoint
    pose = pose_functions(real, name)
    arm_of, turn_of, pose_adjoint = pose.arm_of, pose.turn_of, pose.pose_adjoint
    turn_adjoint, turn_back_adjoint = pose.turn_adjoint, pose.turn_back_adjoint
    own = stencil(real, name, native=False)
    spline, spline_slope, first_node = own.spline, own.spline_slope, own.first_node
    stencil_offset, flat_index = own.stencil_offset, own.flat_index

    @kernel
    def press(
        step: int,
        field: wp.array(dtype=wp.int32),
        scene: wp.array(dtype=wp.int32),
        origin: wp.array(dtype=vec3),
        dx: wp.array(dtype=real),
        dt: wp.array(dtype=real),
        x: wp.array(dtype=vec3),
        volume: wp.array(dtype=real),
        mass: wp.array(dtype=real),
        nodes: wp.vec3i,
        state: wp.array3d(dtype=state_vec),
        shape: wp.array2d(dtype=wp.int32),
        kind: wp.array2d(dtype=wp.int32),
        size: wp.array2d(dtype=vec4),
        reach: wp.array2d(dtype=real),
        info: wp.array2d(dtype=wp.vec4i),
        samples: wp.array(dtype=vec4),
        pressed: wp.array2d(dtype=vec3),
    ):
        """Add to `pressed` the impulse [N s] that each solid gives each node."""
        p = wp.tid()
        f = field[p]
        s = scene[p]
        half = real(0.5) * wp.cbrt(volume[p])
        for c in range(kind.shape[1]):
            if kind[s, c] == wp.static(SEPARATE):
                st = state[step, s, c]
                r = arm_of(st, x[p])
                if wp.length(r) < reach[s, c] + half:
                    q = turn_of(st)
                    at = distance(shape[s, c], size[s, c], samples, info[s, c], wp.quat_rotate_inv(q, r))
                    if at[3] < half:
                        n = wp.quat_rotate(q, vec3(at[0], at[1], at[2]))
                        J = (wp.static(real(PUSH)) * mass[p] * (half - at[3]) / dt[f]) * n
                        cells = (x[p] - origin[f]) / dx[f]
                        base = first_node(cells, nodes)
                        o = stencil_offset(cells, base)
                        wx = spline(o[0])
                        wy = spline(o[1])
                        wz = spline(o[2])
                        node = flat_index(f, base, nodes)
                        for e in range(27):
                            row = node + ((e / 9) * nodes[1] + e / 3 % 3) * nodes[2] + e % 3
                            wp.atomic_add(pressed, row, c, wx[e / 9] * wy[e / 3 % 3] * wz[e % 3] * J)

    @kernel
    def press_adjoint(
        step: int,
        field: wp.array(dtype=wp.int32),
        scene: wp.array(dtype=wp.int32),
        origin: wp.array(dtype=vec3),
        dx: wp.array(dtype=real),
        dt: wp.array(dtype=real),
        x: wp.array(dtype=vec3),
        volume: wp.array(dtype=real),
        mass: wp.array(dtype=real),
        nodes: wp.vec3i,
        state: wp.array3d(dtype=state_vec),
        shape: wp.array2d(dtype=wp.int32),
        kind: wp.array2d(dtype=wp.int32),
        size: wp.array2d(dtype=vec4),
        reach: wp.array2d(dtype=real),
        info: wp.array2d(dtype=wp.vec4i),
        samples: wp.array(dtype=vec4),
        a_pressed: wp.array2d(dtype=vec3),
        a_state: wp.array3d(dtype=state_vec),
        a_x: wp.array(dtype=vec3),
        a_mass: wp.array(dtype=real),
    ):
        """Add to a_state, a_x and a_mass."""
        p = wp.tid()
        f = field[p]
        s = scene[p]
        half = real(0.5) * wp.cbrt(volume[p])
        for c in range(kind.shape[1]):
            if kind[s, c] == wp.static(SEPARATE):
                st = state[step, s, c]
                r = arm_of(st, x[p])
                if wp.length(r) < reach[s, c] + half:
                    q = turn_of(st)
                    y = wp.quat_rotate_inv(q, r)
                    at = distance(shape[s, c], size[s, c], samples, info[s, c], y)
                    if at[3] < half:
                        local = vec3(at[0], at[1], at[2])
                        n = wp.quat_rotate(q, local)
                        scale = wp.static(real(PUSH)) * mass[p] / dt[f]
                        J = (scale * (half - at[3])) * n
                        h = dx[f]
                        cells = (x[p] - origin[f]) / h
                        base = first_node(cells, nodes)
                        o = stencil_offset(cells, base)
                        wx = spline(o[0])
                        wy = spline(o[1])
                        wz = spline(o[2])
                        gx = spline_slope(o[0])
                        gy = spline_slope(o[1])
                        gz = spline_slope(o[2])
                        node = flat_index(f, base, nodes)
                        aJ = vec3(real(0.0), real(0.0), real(0.0))
                        aw = vec3(real(0.0), real(0.0), real(0.0))
                        for e in range(27):
                            i = e / 9
                            j = e / 3 % 3
                            k = e % 3
                            a = a_pressed[node + (i * nodes[1] + j) * nodes[2] + k, c]
                            aJ += wx[i] * wy[j] * wz[k] * a
                            aw += wp.dot(J, a) * vec3(gx[i] * wy[j] * wz[k], wx[i] * gy[j] * wz[k], wx[i] * wy[j] * gz[k])
                        along = wp.dot(n, aJ)
                        a_mass[p] = a_mass[p] + scale / mass[p] * (half - at[3]) * along
                        an = (scale * (half - at[3])) * aJ
                        ay = distance_adjoint(
                            shape[s, c], size[s, c], samples, info[s, c], y, local, wp.quat_rotate_inv(q, an), -scale * along
                        )
                        ar = wp.quat_rotate(q, ay)
                        aq = turn_adjoint(q, local, an) + turn_back_adjoint(q, r, ay)
                        a_x[p] = a_x[p] + aw / h + ar
                        wp.atomic_add(a_state, step, s, c, pose_adjoint(ar, aq))

    return SimpleNamespace(press=press, press_adjoint=press_adjoint)
