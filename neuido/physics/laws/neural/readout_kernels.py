"""Warp kernels around the networks of objective laws: features, read-outs and their adjoints, from the functions of one particle."""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp


def _rows(own: SimpleNamespace, real: type, name: str) -> tuple[Any, Any]:
    """Return the functions that read a row of four coefficients, or of nine feature adjoints."""
    vec4, vec9 = own.vec4, own.vec9

    @wp.func(module=name)
    def row4(c: wp.array2d(dtype=real), p: int):
        last = real(0.0)
        if c.shape[1] > 3:
            last = c[p, 3]
        return vec4(c[p, 0], c[p, 1], c[p, 2], last)

    @wp.func(module=name)
    def row9(X: wp.array2d(dtype=real), p: int):
        x = vec9()
        for i in range(9):
            x[i] = X[p, i]
        return x

    return row4, row9


def elastic_kernels(own: SimpleNamespace, real: type, name: str, enable_backward: bool) -> SimpleNamespace:
    """Return the kernels of an elastic law: features (P, 9), stress from coefficients (P, 4), and their adjoints.

    Args:
        own: Functions of one particle, as `functions` returns them.
        real: `wp.float32` or `wp.float64`.
        name: Name of the Warp module.
        enable_backward: Let Warp generate adjoints too.
    """
    mat33, strain_invariants, features_of, stress_of = own.mat33, own.strain_invariants, own.features_of, own.stress_of
    stress_coefficients, stress_gradient = own.stress_coefficients, own.stress_gradient
    row4, row9 = _rows(own, real, name)
    kernel = functools.partial(wp.kernel, module=name, enable_backward=enable_backward)
    # a module of their own: a run without gradients never compiles them
    adjoint_kernel = functools.partial(wp.kernel, module=f"{name}.backward", enable_backward=enable_backward)

    @kernel
    def features(F: wp.array(dtype=mat33), X: wp.array2d(dtype=real)):
        p = wp.tid()
        N, h, l, A, q = strain_invariants(F[p])
        x = features_of(l, A, q)
        for i in range(9):
            X[p, i] = x[i]

    @kernel
    def stress(F: wp.array(dtype=mat33), c: wp.array2d(dtype=real), scale: real, tau: wp.array(dtype=mat33)):
        p = wp.tid()
        N, h, l, A, q = strain_invariants(F[p])
        tau[p] = stress_of(F[p], l, A, q, row4(c, p), scale)

    @adjoint_kernel
    def stress_coefficients_adjoint(
        F: wp.array(dtype=mat33),
        c: wp.array2d(dtype=real),
        scale: real,
        g_tau: wp.array(dtype=mat33),
        g_c: wp.array2d(dtype=real),
    ):
        """Write the adjoint of the coefficients c."""
        p = wp.tid()
        N, h, l, A, q = strain_invariants(F[p])
        g = stress_coefficients(F[p], l, A, q, row4(c, p), scale, g_tau[p])
        for i in range(4):
            g_c[p, i] = g[i]

    @adjoint_kernel
    def stress_adjoint(
        F: wp.array(dtype=mat33),
        c: wp.array2d(dtype=real),
        scale: real,
        g_tau: wp.array(dtype=mat33),
        g_X: wp.array2d(dtype=real),
        g_F: wp.array(dtype=mat33),
    ):
        """Add to the adjoint of F."""
        p = wp.tid()
        N, h, l, A, q = strain_invariants(F[p])
        g_F[p] = g_F[p] + stress_gradient(F[p], N, h, l, A, q, row4(c, p), scale, g_tau[p], row9(g_X, p))

    return SimpleNamespace(
        mat33=mat33,
        features=features,
        stress=stress,
        stress_coefficients_adjoint=stress_coefficients_adjoint,
        stress_adjoint=stress_adjoint,
    )


def plastic_kernels(own: SimpleNamespace, real: type, name: str, enable_backward: bool, coefficients: int) -> SimpleNamespace:
    """Return the kernels of a plastic law: features (P, 9), corrected gradient from coefficients (P, n), and their adjoints.

    Args:
        own: Functions of one particle, as `functions` returns them.
        real: `wp.float32` or `wp.float64`.
        name: Name of the Warp module.
        enable_backward: Let Warp generate adjoints too.
        coefficients: Number n of coefficients, 3 or 4.
    """
    mat33, strain_invariants, correction_of = own.mat33, own.strain_invariants, own.correction_of
    correction_coefficients, correction_gradient = own.correction_coefficients, own.correction_gradient
    row4, row9 = _rows(own, real, name)
    kernel = functools.partial(wp.kernel, module=name, enable_backward=enable_backward)
    # a module of their own: a run without gradients never compiles them
    adjoint_kernel = functools.partial(wp.kernel, module=f"{name}.backward", enable_backward=enable_backward)

    @kernel
    def correction(F: wp.array(dtype=mat33), c: wp.array2d(dtype=real), scale: real, out: wp.array(dtype=mat33)):
        p = wp.tid()
        N, h, l, A, q = strain_invariants(F[p])
        out[p] = correction_of(F[p], l, A, q, row4(c, p), scale)

    @adjoint_kernel
    def correction_coefficients_adjoint(
        F: wp.array(dtype=mat33),
        c: wp.array2d(dtype=real),
        scale: real,
        straight_through: int,
        g_out: wp.array(dtype=mat33),
        g_c: wp.array2d(dtype=real),
    ):
        """Write the adjoint of the coefficients c."""
        p = wp.tid()
        N, h, l, A, q = strain_invariants(F[p])
        g = correction_coefficients(F[p], l, A, q, row4(c, p), scale, straight_through, g_out[p])
        for i in range(wp.static(coefficients)):
            g_c[p, i] = g[i]

    @adjoint_kernel
    def correction_adjoint(
        F: wp.array(dtype=mat33),
        c: wp.array2d(dtype=real),
        scale: real,
        g_out: wp.array(dtype=mat33),
        g_X: wp.array2d(dtype=real),
        g_F: wp.array(dtype=mat33),
    ):
        """Add to the adjoint of F."""
        p = wp.tid()
        N, h, l, A, q = strain_invariants(F[p])
        g_F[p] = g_F[p] + correction_gradient(F[p], N, h, l, A, q, row4(c, p), scale, g_out[p], row9(g_X, p))

    return SimpleNamespace(
        mat33=mat33,
        correction=correction,
        correction_coefficients_adjoint=correction_coefficients_adjoint,
        correction_adjoint=correction_adjoint,
    )
