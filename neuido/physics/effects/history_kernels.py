"""Warp kernels that advance the history of a particle (Maxwell branches, largest strain, compaction), with hand-written adjoints.

Plastic flow is in `flow_kernels`. `coefficients.Layout` defines the columns of the history, `coefficients.Tables` those of the tables.
"""

import functools
from types import SimpleNamespace

import warp as wp

from neuido.physics.effects import flow_kernels, history_functions
from neuido.physics.linalg import warp_functions
from neuido.physics.linalg.warp_functions import FLOOR
from neuido.physics.runtime.device import start_warp
from neuido.physics.runtime.once import cached


@cached
def build(real: type) -> SimpleNamespace:
    """Return the kernels for `wp.float32` or `wp.float64`."""
    start_warp()
    mat33 = wp.types.matrix(shape=(3, 3), dtype=real)
    name = f"neuido.history.{real.__name__}"
    func = functools.partial(wp.func, module=name)
    kernel = functools.partial(wp.kernel, module=name, enable_backward=False)
    own = warp_functions.functions(real)
    frame, hencky, exp_slope, inverse_stretch = own.frame, own.hencky, own.exp_slope, own.inverse_stretch
    shared = history_functions.functions(real, name)
    load, store, gather, spread, deviator = shared.load, shared.store, shared.gather, shared.spread, shared.deviator
    half_turn, rotation, add_spin_adjoint = shared.half_turn, shared.rotation, shared.add_spin_adjoint
    mean_of, bound = shared.mean_of, shared.bound
    log1p, volume_change, cofactor, bounded = own.log1p, own.volume_change, own.cofactor, own.bounded
    zero = wp.constant(real(0.0))
    half = wp.constant(real(0.5))
    one = wp.constant(real(1.0))
    floor = wp.constant(real(FLOOR))
    two = wp.constant(real(2.0))

    @kernel
    def relax(
        scene: wp.array(dtype=wp.int32),
        dt: wp.array(dtype=real),
        branches: wp.array3d(dtype=real),
        all_branches: bool,
        C: wp.array(dtype=mat33),
        history: wp.array2d(dtype=real),
        history_next: wp.array2d(dtype=real),
    ):
        """Advance each Maxwell branch: e = exp(-dt/T) R e R^T + T (1 - exp(-dt/T)) dev D, exact for a constant D in the rotating frame.

        Without `all_branches`, branches of weight zero are skipped. A backward pass needs them for the gradient of the weight.
        """
        p = wp.tid()
        s = scene[p]
        h = dt[s]
        R = rotation(half_turn(C[p], h))
        D = deviator(half * (C[p] + wp.transpose(C[p])))
        for b in range(branches.shape[1]):
            if all_branches or branches[s, b, 0] != zero:
                x = h / branches[s, b, 1]
                e = R * load(history, p, 6 * b) * wp.transpose(R)
                store(history_next, p, 6 * b, wp.exp(-x) * e + (h * exp_slope(-x)) * D)

    @kernel
    def relax_adjoint(
        scene: wp.array(dtype=wp.int32),
        dt: wp.array(dtype=real),
        branches: wp.array3d(dtype=real),
        C: wp.array(dtype=mat33),
        history: wp.array2d(dtype=real),
        a_history_next: wp.array2d(dtype=real),
        a_C: wp.array(dtype=mat33),
        a_history: wp.array2d(dtype=real),
        a_branches: wp.array3d(dtype=real),
    ):
        p = wp.tid()
        s = scene[p]
        h = dt[s]
        R = rotation(half_turn(C[p], h))
        D = deviator(half * (C[p] + wp.transpose(C[p])))
        a_R = mat33()
        a_D = mat33()
        for b in range(branches.shape[1]):
            T = branches[s, b, 1]
            x = h / T
            decay = wp.exp(-x)
            reach = h * exp_slope(-x)
            e = load(history, p, 6 * b)
            Y = gather(a_history_next, p, 6 * b)
            YR = Y * R
            back = wp.transpose(R) * YR
            spread(a_history, p, 6 * b, decay * back)
            a_D = a_D + reach * Y
            a_R = a_R + (two * decay) * (YR * e)
            wp.atomic_add(a_branches, s, b, 1, wp.ddot(back, e) * decay * x / T + wp.ddot(Y, D) * (reach - h * decay) / T)
        a_C[p] = a_C[p] + deviator(a_D)
        add_spin_adjoint(a_C, p, C[p], h, a_R)

    @kernel
    def remember(
        F: wp.array(dtype=mat33),
        at: int,
        history: wp.array2d(dtype=real),
        history_next: wp.array2d(dtype=real),
    ):
        """Write the largest norm of the deviatoric Hencky strain so far."""
        p = wp.tid()
        largest = history[p, at]
        if bound(F[p]) > largest:
            _U, d, _V = frame(F[p])
            e = hencky(d)
            largest = wp.max(largest, wp.length(e - mean_of(e)))
        history_next[p, at] = largest

    @kernel
    def remember_adjoint(
        F: wp.array(dtype=mat33),
        at: int,
        history: wp.array2d(dtype=real),
        a_history_next: wp.array2d(dtype=real),
        a_F: wp.array(dtype=mat33),
        a_history: wp.array2d(dtype=real),
    ):
        p = wp.tid()
        a = a_history_next[p, at]
        if bound(F[p]) > history[p, at]:
            U, d, V = frame(F[p])
            e = hencky(d)
            e = e - mean_of(e)
            size = wp.length(e)
            if size > history[p, at]:
                a_F[p] = a_F[p] + U * wp.diag((a / size) * wp.cw_mul(e, inverse_stretch(d))) * wp.transpose(V)
                a = zero
        a_history[p, at] = a_history[p, at] + a

    @func
    def log_volume(F: mat33):
        return log1p(bounded(volume_change(F)))

    @func
    def log_volume_gradient(F: mat33):
        out = mat33()
        J = one + volume_change(F)
        if J > floor:
            out = (one / J) * cofactor(F)
        return out

    @kernel
    def compact(
        trial: wp.array(dtype=mat33),
        F: wp.array(dtype=mat33),
        at: int,
        history: wp.array2d(dtype=real),
        history_next: wp.array2d(dtype=real),
    ):
        """Advance ln J_P by what the plastic law takes from ln det F."""
        p = wp.tid()
        history_next[p, at] = history[p, at] + log_volume(trial[p]) - log_volume(F[p])

    @kernel
    def compact_adjoint(
        trial: wp.array(dtype=mat33),
        F: wp.array(dtype=mat33),
        at: int,
        a_history_next: wp.array2d(dtype=real),
        a_trial: wp.array(dtype=mat33),
        a_F: wp.array(dtype=mat33),
        a_history: wp.array2d(dtype=real),
    ):
        p = wp.tid()
        a = a_history_next[p, at]
        a_trial[p] = a_trial[p] + a * log_volume_gradient(trial[p])
        a_F[p] = a_F[p] - a * log_volume_gradient(F[p])
        a_history[p, at] = a_history[p, at] + a

    return SimpleNamespace(
        relax=relax,
        relax_adjoint=relax_adjoint,
        remember=remember,
        remember_adjoint=remember_adjoint,
        compact=compact,
        compact_adjoint=compact_adjoint,
        **vars(flow_kernels.build(real)),
    )
