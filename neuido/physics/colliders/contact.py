"""Kinds of contact: Warp functions for the velocity of a node inside a collider, and their adjoints.

`sticky` sets the velocity to zero, `slip` removes its normal part, `separate` removes an inward normal part and brakes the tangential one
with Coulomb's friction (Stomakhin et al. 2013, eq. 8). A node sticks where its tangential speed is strictly below what friction takes:
without friction a node never sticks, also at a tangential speed of zero, where a gradient of the tangential velocity would be lost.
"""

import functools
from types import SimpleNamespace

import warp as wp

STICKY, SLIP, SEPARATE = 1, 2, 3
CONTACTS = {"sticky": STICKY, "slip": SLIP, "separate": SEPARATE}
"""Number of each kind of contact in the tables of the kernels; 0 means no collider."""


def functions(real: type, module: str) -> SimpleNamespace:
    """Return the Warp functions `contact`, `contact_adjoint`, `damp_contact` and `normal_of`.

    Args:
        real: `wp.float32` or `wp.float64`.
        module: Name of the Warp module that the functions belong to.
    """
    vec3 = wp.types.vector(length=3, dtype=real)
    vec4 = wp.types.vector(length=4, dtype=real)
    func = functools.partial(wp.func, module=module)

    @func
    def contact(v: vec3, n: vec3, kind: int, friction: real):
        """Return the velocity of a node inside a collider after contact, from the velocity v before.

        n is the unit normal that points out of the collider.
        """
        vn = wp.dot(v, n)
        out = v
        if kind == wp.static(STICKY):
            out = vec3(real(0.0), real(0.0), real(0.0))
        elif kind == wp.static(SLIP):
            out = v - vn * n
        elif kind == wp.static(SEPARATE):
            if vn < real(0.0):
                t = v - vn * n
                speed = wp.length(t)
                if speed < -friction * vn:
                    out = vec3(real(0.0), real(0.0), real(0.0))
                else:
                    out = t * (real(1.0) + friction * vn / wp.max(speed, real(1.0e-30)))
        return out

    @func
    def contact_adjoint(v: vec3, n: vec3, kind: int, friction: real, a: vec3):
        """Return the adjoints of v (first three numbers) and of the friction (last) from the adjoint a of the result of `contact`."""
        vn = wp.dot(v, n)
        out = vec4(a[0], a[1], a[2], real(0.0))
        if kind == wp.static(STICKY):
            out = vec4(real(0.0), real(0.0), real(0.0), real(0.0))
        elif kind == wp.static(SLIP):
            b = a - wp.dot(a, n) * n
            out = vec4(b[0], b[1], b[2], real(0.0))
        elif kind == wp.static(SEPARATE):
            if vn < real(0.0):
                t = v - vn * n
                speed = wp.length(t)
                if speed < -friction * vn:
                    out = vec4(real(0.0), real(0.0), real(0.0), real(0.0))
                else:
                    s = wp.max(speed, real(1.0e-30))
                    e = t / s
                    ea = wp.dot(e, a)
                    at = a + (friction * vn / s) * (a - ea * e)
                    at = at - wp.dot(at, n) * n
                    b = at + (friction * ea) * n
                    out = vec4(b[0], b[1], b[2], vn * ea)
        return out

    @func
    def damp_contact(v: vec3, n: vec3, dt: real, force: wp.array2d(dtype=real), row: int):
        """Return the velocity of a node in contact after the effects stick and restitution.

        `force` is `Effects.force_table`, with the two rates [1/s] in columns 9 and 10.
        """
        out = wp.exp(-dt * force[row, 9]) * v
        vn = wp.dot(out, n)
        if vn > real(0.0):
            out = out + ((wp.exp(-dt * force[row, 10]) - real(1.0)) * vn) * n
        return out

    @func
    def normal_of(plane: vec4):
        """Return the normal of a plane, the first three numbers of its row."""
        return vec3(plane[0], plane[1], plane[2])

    return SimpleNamespace(contact=contact, contact_adjoint=contact_adjoint, damp_contact=damp_contact, normal_of=normal_of)
