"""Warp kernels of a body whose stress-free size grows or shrinks, with a hand-written adjoint.

The size is g(t) = 1 + rate t times the first one, and the elastic gradient F_e = F / g. A rollout carries F_e, so each substep multiplies
the trial gradient by g(t) / g(t + dt) = 1 - e; `Effects.shrinkage` is e.
"""

import functools
from types import SimpleNamespace

import warp as wp

from neuido.physics.runtime.device import start_warp
from neuido.physics.runtime.once import cached


@cached
def build(real: type) -> SimpleNamespace:
    """Return the kernels for `wp.float32` or `wp.float64`."""
    start_warp()
    mat33 = wp.types.matrix(shape=(3, 3), dtype=real)
    kernel = functools.partial(wp.kernel, module=f"neuido.swelling.{real.__name__}", enable_backward=False)
    one = wp.constant(real(1.0))

    @kernel
    def swell(scene: wp.array(dtype=wp.int32), shrinkage: wp.array(dtype=real), rest: wp.array(dtype=mat33), F: wp.array(dtype=mat33)):
        """Multiply F by 1 - e; `rest`, if given, accumulates what the rounding of F leaves out."""
        p = wp.tid()
        whole = F[p]
        change = -shrinkage[scene[p]] * whole
        if rest:
            change += rest[p]
        smaller = whole + change
        if rest:
            rest[p] = change - (smaller - whole)
        F[p] = smaller

    @kernel
    def swell_adjoint(
        scene: wp.array(dtype=wp.int32),
        dt: wp.array(dtype=real),
        shrinkage: wp.array(dtype=real),
        F: wp.array(dtype=mat33),
        C_next: wp.array(dtype=mat33),
        a_F: wp.array(dtype=mat33),
        a_shrinkage: wp.array(dtype=real),
    ):
        """Turn the adjoint of the result into that of (I + dt C) F, with F before the substep and C after it; add to a_shrinkage."""
        p = wp.tid()
        s = scene[p]
        wp.atomic_add(a_shrinkage, s, -wp.ddot(a_F[p], F[p] + dt[s] * (C_next[p] * F[p])))
        a_F[p] = (one - shrinkage[s]) * a_F[p]

    @kernel
    def elastic_part(scene: wp.array(dtype=wp.int32), size: wp.array(dtype=real), F: wp.array(dtype=mat33)):
        """Divide the gradient of an element by the stress-free size g."""
        i = wp.tid()
        F[i] = F[i] / size[scene[i]]

    return SimpleNamespace(swell=swell, swell_adjoint=swell_adjoint, elastic_part=elastic_part)
