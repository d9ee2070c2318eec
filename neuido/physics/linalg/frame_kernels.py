"""Warp kernel of the principal frame of many matrices."""

from types import SimpleNamespace

import warp as wp

from neuido.physics.linalg import warp_functions
from neuido.physics.runtime.device import start_warp
from neuido.physics.runtime.once import cached


@cached
def build(real: type) -> SimpleNamespace:
    """Return the kernel `decompose` for `wp.float32` or `wp.float64`.

    It takes F (n) and writes U (n), sigma (n) with the sign of det F on the last, and V (n).
    """
    start_warp()
    mat = wp.types.matrix((3, 3), real)
    vec = wp.types.vector(3, real)
    one = wp.constant(real(1.0))
    frame = warp_functions.functions(real).frame

    @wp.kernel(enable_backward=False, module="unique")
    def decompose(F: wp.array(dtype=mat), U: wp.array(dtype=mat), sigma: wp.array(dtype=vec), V: wp.array(dtype=mat)):
        p = wp.tid()
        u, excess, v = frame(F[p])
        U[p] = u
        sigma[p] = vec(one + excess[0], one + excess[1], one + excess[2])
        V[p] = v

    return SimpleNamespace(decompose=decompose)
