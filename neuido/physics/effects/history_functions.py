"""Warp functions that the kernels of effects share: symmetric matrices in six columns, rotation of a step, bounds of the strain."""

import functools
from typing import Any, NamedTuple

import warp as wp

from neuido.physics.linalg import warp_functions
from neuido.physics.runtime.once import cached

COMPACTED = 0.6
"""Lower bound of the plastic change of volume J_P in `compaction_hardening`: beyond it snow is ice, and a larger factor would need shorter
steps. The value is that of the snow of Taichi's examples (Hu et al. 2018)."""


class HistoryFunctions(NamedTuple):
    """Warp functions for one scalar type, in one Warp module."""

    load: Any
    """(history, p, column) -> symmetric matrix from six columns"""
    store: Any
    """(history, p, column, A): write the symmetric part of A"""
    gather: Any
    """(a_history, p, column) -> the adjoint of a symmetric matrix from those of its columns"""
    spread: Any
    """(a_history, p, column, A): add the adjoint of a symmetric matrix to those of its columns"""
    deviator: Any
    """A -> A - tr(A)/3 I"""
    half_turn: Any
    """(C, dt) -> dt/2 times the angular velocity"""
    rotation: Any
    """half turn -> Cayley's rotation"""
    add_spin_adjoint: Any
    """(a_C, p, C, dt, M): add to the adjoint of C, given the adjoint M of the rotation"""
    mean_of: Any
    """e -> the mean of e, three times"""
    bound: Any
    """F -> an upper bound of the norm of dev ln V, without a principal frame"""
    scale_of: Any
    """(p, s, stiffness, growth) -> the factor of `stiffness` and `stiffness_change` on the elastic stress"""
    compaction_of: Any
    """ln J_P -> 1 - J_P, bounded above by 1 - COMPACTED"""


@cached
def functions(real: type, module: str) -> HistoryFunctions:
    """Return the functions for `wp.float32` or `wp.float64`, in the Warp module of this name."""
    vec3 = wp.types.vector(length=3, dtype=real)
    mat33 = wp.types.matrix(shape=(3, 3), dtype=real)
    func = functools.partial(wp.func, module=module)
    strain = warp_functions.functions(real).strain
    half = wp.constant(real(0.5))
    one = wp.constant(real(1.0))
    two = wp.constant(real(2.0))
    three = wp.constant(real(3.0))
    largest = wp.constant(real(1.0 - COMPACTED))

    @func
    def load(history: wp.array2d(dtype=real), p: int, at: int):
        xx = history[p, at]
        yy = history[p, at + 1]
        zz = history[p, at + 2]
        xy = history[p, at + 3]
        xz = history[p, at + 4]
        yz = history[p, at + 5]
        return mat33(xx, xy, xz, xy, yy, yz, xz, yz, zz)

    @func
    def spread(a_history: wp.array2d(dtype=real), p: int, at: int, A: mat33):
        """Add the adjoint of a symmetric matrix A to those of its columns."""
        a_history[p, at] = a_history[p, at] + A[0, 0]
        a_history[p, at + 1] = a_history[p, at + 1] + A[1, 1]
        a_history[p, at + 2] = a_history[p, at + 2] + A[2, 2]
        a_history[p, at + 3] = a_history[p, at + 3] + two * A[0, 1]
        a_history[p, at + 4] = a_history[p, at + 4] + two * A[0, 2]
        a_history[p, at + 5] = a_history[p, at + 5] + two * A[1, 2]

    @func
    def store(history: wp.array2d(dtype=real), p: int, at: int, A: mat33):
        history[p, at] = A[0, 0]
        history[p, at + 1] = A[1, 1]
        history[p, at + 2] = A[2, 2]
        history[p, at + 3] = half * (A[0, 1] + A[1, 0])
        history[p, at + 4] = half * (A[0, 2] + A[2, 0])
        history[p, at + 5] = half * (A[1, 2] + A[2, 1])

    @func
    def gather(a_history: wp.array2d(dtype=real), p: int, at: int):
        """Return the adjoint of a symmetric matrix, from those of its columns."""
        A = load(a_history, p, at)
        return half * (A + wp.diag(wp.get_diag(A)))

    @func
    def deviator(A: mat33):
        return A - (wp.trace(A) / three) * wp.identity(n=3, dtype=real)

    @func
    def axial(A: mat33):
        return vec3(A[2, 1] - A[1, 2], A[0, 2] - A[2, 0], A[1, 0] - A[0, 1])

    @func
    def half_turn(C: mat33, dt: real):
        """Return dt/2 times the angular velocity."""
        return (real(0.25) * dt) * axial(C)

    @func
    def rotation(q: vec3):
        Q = wp.skew(q)
        return wp.identity(n=3, dtype=real) + (two / (one + wp.dot(q, q))) * (Q + Q * Q)

    @func
    def add_spin_adjoint(a_C: wp.array(dtype=mat33), p: int, C: mat33, dt: real, M: mat33):
        """Add to the adjoint of C, given the adjoint M of the rotation of a step."""
        q = half_turn(C, dt)
        Q = wp.skew(q)
        s = two / (one + wp.dot(q, q))
        a_q = s * axial(M - M * Q - Q * M) - (s * s * wp.ddot(M, Q + Q * Q)) * q
        a_C[p] = a_C[p] + (real(0.25) * dt) * wp.skew(a_q)

    @func
    def mean_of(e: vec3):
        m = (e[0] + e[1] + e[2]) / three
        return vec3(m, m, m)

    @func
    def bound(F: mat33):
        """Return an upper bound of the norm of dev ln V without a principal frame, from the largest slope of ln(1 + x)/2."""
        E = strain(F)
        r = wp.sqrt(wp.ddot(E, E))
        D = deviator(E)
        out = real(1.0e30)
        if r < real(0.9):
            out = half * wp.sqrt(wp.ddot(D, D)) / (one - r)
        return out

    @func
    def scale_of(p: int, s: int, stiffness: wp.array(dtype=real), growth: wp.array(dtype=real)):
        out = one
        if stiffness:
            out = out * stiffness[p]
        if growth:
            out = out * growth[s]
        return out

    @func
    def compaction_of(q: real):
        return wp.min(one - wp.exp(q), largest)

    return HistoryFunctions(
        load, store, gather, spread, deviator, half_turn, rotation, add_spin_adjoint, mean_of, bound, scale_of, compaction_of
    )
