"""The Warp kernel of a specimen along a path: one thread follows one parameter set, row by row.

The law is isotropic, and the third axis stays. Matrices are stored as xx, xy, yx, yy, zz; symmetric tensors as xx, yy, zz, sqrt(2) xy, so
that the sum of the squares is that of the tensor. The equation of a plastic step is that of `plastic_step`.
"""

import warp as wp

from neuido.physics.laws.classical_kernels import LOCKED
from neuido.physics.points.plastic_step import BACKSTRESSES, EXACT, LEAST, ROUNDS
from neuido.physics.points.point_law import DENSE
from neuido.physics.points.rig import ITERATIONS, LARGEST_MOVE, PROBE, TOLERANCE
from neuido.physics.runtime.device import start_warp
from neuido.physics.runtime.once import cached

COLUMNS = (
    "mu", "lam", "k", "c", "r", "damage", "lock", "compaction", "compaction_lock", "mullins", "mullins_width", "set", "shear", "bulk",
    "growth", "swelling", "two_mu", "inverse", "H", "s", "H_k", "eta", "q", "b", "rate_k", "rate_n", "creep", "creep_n", "creep_stress",
    "h1", "h2", "h3", "g1", "g2", "g3", "modulus",
)  # fmt: skip
"""Columns of the table of the kernel; all but the moduli are zero where the effect is absent."""
KINDS = ("neo_hookean", "sigma", "fixed_corotated")
"""Elastic laws, by the number that the kernel takes."""
MODES = ("uniaxial", "equibiaxial", "pure_shear", "biaxial", "simple_shear")
"""Kinds of test, by the number that the kernel takes."""
NEAR = 1e-9
"""Half the difference of two principal values below which an isotropic function is taken as linear between them."""


@cached
def build():
    """Return the struct of a specimen's state, and the kernel that follows a path, in float64."""
    start_warp()
    module = "neuido.specimens"
    real, vec4, table = wp.float64, wp.vec4d, wp.array2d(dtype=wp.float64)
    vec5 = wp.types.vector(length=5, dtype=wp.float64)
    at = {name: wp.constant(i) for i, name in enumerate(COLUMNS)}
    c_mu, c_lam, c_k, c_c, c_r, c_damage, c_lock, c_comp, c_clock, c_mull, c_width, c_set, c_shear, c_bulk = (at[n] for n in COLUMNS[:14])
    c_grow, c_swell, c_two, c_inverse, c_H, c_s, c_Hk, c_eta, c_q, c_b, c_rk, c_rn = (at[n] for n in COLUMNS[14:26])
    c_creep, c_cn, c_cs, c_h, c_g, c_modulus = (at[n] for n in ("creep", "creep_n", "creep_stress", "h1", "g1", "modulus"))
    near, locked, dense, exact, least = (wp.constant(wp.float64(v)) for v in (NEAR, LOCKED, DENSE, EXACT, LEAST))
    probe, tolerance, largest = (wp.constant(wp.float64(v)) for v in (PROBE, TOLERANCE, LARGEST_MOVE))
    rounds, iterations, backstresses = wp.constant(ROUNDS), wp.constant(ITERATIONS), wp.constant(BACKSTRESSES)
    half_log, exp_minus, root, negative, squeezed = (wp.constant(i) for i in range(5))

    @wp.struct
    class State:
        """Total strains, elastic F, Maxwell branches, alpha, backstress, e_max, backstresses that saturate, x_max, ln U at its largest."""

        total: wp.array(dtype=vec4)
        F: wp.array(dtype=vec5)
        q: wp.array2d(dtype=vec4)
        alpha: wp.array(dtype=wp.float64)
        beta: wp.array(dtype=vec4)
        e_max: wp.array(dtype=wp.float64)
        backs: wp.array2d(dtype=vec4)
        x_max: wp.array(dtype=wp.float64)
        kept: wp.array(dtype=vec4)

    @wp.func(module=module)
    def dev(a: vec4):
        mean = (a[0] + a[1] + a[2]) / real(3.0)
        return vec4(a[0] - mean, a[1] - mean, a[2] - mean, a[3])

    @wp.func(module=module)
    def matmul(A: vec5, B: vec5):
        return vec5(A[0] * B[0] + A[1] * B[2], A[0] * B[1] + A[1] * B[3], A[2] * B[0] + A[3] * B[2], A[2] * B[1] + A[3] * B[3], A[4] * B[4])

    @wp.func(module=module)
    def as_matrix(a: vec4):
        xy = a[3] / wp.sqrt(real(2.0))
        return vec5(a[0], xy, xy, a[1], a[2])

    @wp.func(module=module)
    def left_cauchy(F: vec5):
        xy = wp.sqrt(real(2.0)) * (F[0] * F[2] + F[1] * F[3])
        return vec4(F[0] * F[0] + F[1] * F[1], F[2] * F[2] + F[3] * F[3], F[4] * F[4], xy)

    @wp.func(module=module)
    def image(x: real, what: int, lock: real):
        out = real(1.0) * x
        if what == half_log:
            out = real(0.5) * wp.log(x)
        elif what == exp_minus:
            out = wp.exp(-x)
        elif what == root:
            out = wp.sqrt(x)
        elif what == negative:
            out = wp.min(x, real(0.0))
        else:
            y = wp.max(-x, real(0.0))
            out = y * y / wp.max(lock - y, dense * lock)
        return out

    @wp.func(module=module)
    def isotropic(a: vec4, what: int, lock: real):
        mean, half = real(0.5) * (a[0] + a[1]), real(0.5) * (a[0] - a[1])
        gap = wp.max(wp.sqrt(half * half + real(0.5) * a[3] * a[3]), near)
        high, low = image(mean + gap, what, lock), image(mean - gap, what, lock)
        middle, slope = real(0.5) * (high + low), real(0.5) * (high - low) / gap
        return vec4(middle + slope * half, middle - slope * half, image(a[2], what, lock), slope * a[3])

    @wp.func(module=module)
    def turned(a: vec4, sine: real, cosine: real):
        cc, ss, cs, two = cosine * cosine, sine * sine, sine * cosine, wp.sqrt(real(2.0))
        xy = (cc - ss) * a[3] + two * cs * (a[1] - a[0])
        return vec4(cc * a[0] + ss * a[1] + two * cs * a[3], ss * a[0] + cc * a[1] - two * cs * a[3], a[2], xy)

    @wp.func(module=module)
    def spun(a: vec4, slide: real):
        tangent = real(0.25) * slide  # half of the half angle of the step, as in `constitutive.spin`
        size = real(1.0) + tangent * tangent
        return turned(a, real(2.0) * tangent / size, (real(1.0) - tangent * tangent) / size)

    @wp.func(module=module)
    def driving(i: int, s: vec4, size: real, slide: real, p: table, backs: wp.array2d(dtype=vec4)):
        xi = real(1.0) * s
        for m in range(backstresses):
            xi = xi - spun(backs[i, m], slide) / (real(1.0) + p[i, c_g + m] * size)
        return xi

    @wp.func(module=module)
    def excess(
        i: int, s: vec4, size: real, slide: real, alpha: real, dt: real, scale: real, p: table, backs: wp.array2d(dtype=vec4)
    ):  # fmt: skip
        one, zero = real(1.0), real(0.0)
        resist, slope, fall = p[i, c_two] * scale + p[i, c_Hk], real(0.0), vec4()
        xi = one * s
        for m in range(backstresses):
            h, g = one * p[i, c_h + m], one * p[i, c_g + m]
            theta = one / (one + g * size)
            back = one * spun(backs[i, m], slide)
            xi = xi - theta * back
            fall = fall + g * theta * theta * back
            resist = resist + theta * h
            slope = slope + g * theta * theta * h * size
        norm = wp.length(xi)
        if norm > zero:
            slope = slope + wp.dot(xi, fall) / norm
        soft, gone = wp.exp(-p[i, c_s] * alpha), wp.exp(-p[i, c_b] * (alpha + size))
        limit = real(0.0)
        if p[i, c_inverse] > zero:
            limit = one / p[i, c_inverse]
        bears = (limit + p[i, c_H] * (alpha + size) + p[i, c_q] * (one - gone)) * soft
        stiffer = real(0.0)
        if bears > zero:
            stiffer = (p[i, c_H] + p[i, c_q] * p[i, c_b] * gone) * soft
        else:
            bears = real(0.0)
        speed = size / dt + real(1.0e-300)
        power, creep, exponent = p[i, c_rk] * wp.pow(speed, p[i, c_rn]), real(0.0), real(1.0)
        if p[i, c_cn] > zero:
            exponent = one / p[i, c_cn]
        if p[i, c_inverse] <= zero and p[i, c_creep] > zero:
            creep = p[i, c_cs] * wp.pow(speed / p[i, c_creep], exponent)
        drag = p[i, c_eta] * speed + power + creep
        steeper = (p[i, c_eta] + (p[i, c_rn] * power + exponent * creep) / speed) / dt
        return norm - resist * size - bears - drag, slope - resist - stiffer - steeper

    @wp.func(module=module)
    def plastic(
        i: int, s: vec4, slide: real, alpha: real, dt: real, scale: real, p: table, backs: wp.array2d(dtype=vec4)
    ):  # fmt: skip
        """Return the size of the step; see `plastic_step.PlasticStep.solved`."""
        zero = real(0.0)
        size = real(0.0)
        if p[i, c_inverse] > zero or p[i, c_creep] > zero:
            begun, slope = excess(i, s, zero, slide, alpha, dt, scale, p, backs)
            if begun > zero:
                norm = wp.length(s)
                for m in range(backstresses):
                    norm = norm + wp.length(backs[i, m])
                low, high = real(0.0), norm / (p[i, c_two] * scale)
                size = begun / -slope
                if not (size > least * high and size < high):
                    size = begun / (begun + norm) * high
                for _ in range(rounds):
                    over, steep = excess(i, s, size, slide, alpha, dt, scale, p, backs)
                    if not (wp.abs(over) > exact * norm):
                        break
                    if over > zero:
                        low = real(1.0) * size
                    else:
                        high = real(1.0) * size
                    further = size - over / steep
                    if steep < zero and further > low and further < high:
                        size = real(1.0) * further
                    else:
                        size = real(0.5) * (low + high)
        return size

    @wp.func(module=module)
    def advance(
        i: int, new: vec4, dt: real, now: real, kind: int, sheared: int, p: table, branches: wp.array2d(dtype=wp.vec2d), old: State,
        commit: int,
    ):  # fmt: skip
        """Return the Kirchhoff stress after a step to the strains `new`; `commit` stores the state."""
        one, zero = real(1.0), real(0.0)
        step = new - old.total[i]
        D, slide, F = one * step, real(0.0), one * old.F[i]  # products, since a plain name stays an alias
        if sheared == 1:
            slide = step[3]
            F = matmul(vec5(one, slide, zero, one, one), F)
            D = vec4(step[0], step[1], step[2], slide / wp.sqrt(real(2.0)))
        else:
            sx, sy, sz = wp.exp(step[0]), wp.exp(step[1]), wp.exp(step[2])
            F = vec5(F[0] * sx, F[1] * sx, F[2] * sy, F[3] * sy, F[4] * sz)
        scale = wp.exp(p[i, c_grow] * now)
        if p[i, c_swell] != zero:
            grown = one + p[i, c_swell] * now
            F = F * (grown / (grown + p[i, c_swell] * dt))
        beta, alpha = spun(old.beta[i], slide), one * old.alpha[i]
        trial = p[i, c_two] * scale * dev(isotropic(left_cauchy(F), half_log, zero)) - beta
        size = plastic(i, trial, slide, alpha, dt, scale, p, old.backs)
        moved = vec4()
        if size > zero:
            xi = driving(i, trial, size, slide, p, old.backs)
            norm = wp.length(xi)
            if norm > zero:
                moved = size / norm * xi
            F = matmul(as_matrix(isotropic(moved, exp_minus, zero)), F)
        e_max = one * old.e_max[i]
        if p[i, c_damage] != zero:
            e_max = wp.max(e_max, wp.length(dev(isotropic(left_cauchy(F), half_log, zero))))
        kept, elastic = one * old.kept[i], one * F
        if p[i, c_set] != zero:
            e = isotropic(left_cauchy(vec5(F[0], F[2], F[1], F[3], F[4])), half_log, zero)
            if wp.length_sq(dev(e)) > wp.length_sq(dev(kept)):
                kept = one * e
            elastic = matmul(F, as_matrix(isotropic(p[i, c_set] * kept, exp_minus, zero)))
        b = left_cauchy(elastic)
        J = wp.sqrt((b[0] * b[1] - real(0.5) * b[3] * b[3]) * b[2])
        bbar = wp.pow(J, real(-2.0 / 3.0)) * b
        first = bbar[0] + bbar[1] + bbar[2]
        stretched = wp.max(first - real(3.0), zero)
        x_max = one * old.x_max[i]
        if p[i, c_mull] != zero:
            x_max = wp.max(x_max, stretched)
        # the elastic stress
        mu, lam, unit = p[i, c_mu], p[i, c_lam], vec4(one, one, one, zero)
        t = vec4()
        if kind == 0:
            t = mu * (b - unit) + lam * wp.log(J) * unit
        elif kind == 1:
            t = real(2.0) * mu * isotropic(b, half_log, zero) + lam * wp.log(J) * unit
        else:
            t = real(2.0) * mu * (b - isotropic(b, root, zero)) + lam * J * (J - one) * unit
        later = wp.exp(p[i, c_grow] * (now + dt)) * wp.exp(-p[i, c_damage] * e_max)
        t = t + p[i, c_k] * stretched / wp.max(one - p[i, c_lock] * stretched, locked) * dev(bbar)
        if p[i, c_c] != zero:
            second = first * bbar - left_cauchy(as_matrix(bbar))
            t = t + real(6.0) * p[i, c_c] / (second[0] + second[1] + second[2]) * dev(second)
        if p[i, c_r] != zero:
            t = t + p[i, c_r] * isotropic(isotropic(b, half_log, zero), negative, zero)
        if p[i, c_comp] != zero:
            lock = one * p[i, c_clock]
            if lock <= zero:
                lock = real(1.0)
            t = t - real(2.0) * mu * p[i, c_comp] * isotropic(isotropic(b, half_log, zero), squeezed, lock)
        if p[i, c_mull] != zero:
            reach = p[i, c_width] * x_max
            if reach <= zero:
                reach = real(1.0)
            later = later * (one - p[i, c_mull] * wp.erf((x_max - stretched) / reach))
        for m in range(branches.shape[1]):
            x = dt / branches[i, m][1]
            fresh = (one - wp.exp(-x)) / x
            if x < real(1.0e-4):  # the difference from one would be lost
                fresh = one - x / real(2.0) + x * x / real(6.0)
            q = wp.exp(-x) * spun(old.q[i, m], slide) + fresh * dev(D)
            t = t + branches[i, m][0] * q
            if commit == 1:
                old.q[i, m] = q
        t = later * t + J * (real(2.0) * p[i, c_shear] * dev(D) + real(3.0) * p[i, c_bulk] * (D - dev(D))) / dt
        if commit == 1:
            old.total[i] = new
            old.F[i] = F
            old.alpha[i] = alpha + size
            old.beta[i] = beta + p[i, c_Hk] * moved
            old.e_max[i] = e_max
            old.x_max[i] = x_max
            old.kept[i] = kept
            for m in range(backstresses):
                old.backs[i, m] = (spun(old.backs[i, m], slide) + p[i, c_h + m] * moved) / (one + p[i, c_g + m] * size)
        return vec4(t[0], t[1], t[2], t[3] / wp.sqrt(real(2.0)))

    @wp.func(module=module)
    def strains(given: wp.vec2d, u: wp.vec2d, mode: int, lead: int, incompressible: int):
        """Return the logarithms of the stretches and the shear; `u` has the free axis, after the loading one where that is free too."""
        zero = real(0.0)
        first, free = real(1.0) * given[0], real(1.0) * u[0]
        if lead == 1:
            first = real(1.0) * u[0]
            free = real(1.0) * u[1]
        out = vec4(zero, zero, zero, first)
        if mode == 0:
            if incompressible == 1:
                free = -first / real(2.0)
            out = vec4(first, free, free, zero)
        elif mode < 4:
            second = real(1.0) * first
            if mode == 2:
                second = zero
            elif mode == 3:
                second = given[1]
            if incompressible == 1:
                free = -first - second
            out = vec4(first, second, free, zero)
        return out

    @wp.func(module=module)
    def unbalanced(t: vec4, e: vec4, given: wp.vec2d, mode: int, lead: int, incompressible: int, true_stress: int):
        """Return the stress that must vanish, in the order of the unknowns."""
        out = wp.vec2d(t[2], real(0.0))
        if lead == 1:
            seen = real(1.0) * t[3]
            if mode < 4:
                pressure = real(0.0)
                if incompressible == 1:
                    pressure = real(1.0) * t[2]
                volume = e[0] + e[1] + e[2]
                fx, fy = real(1.0) * volume, real(1.0) * volume
                if true_stress == 0:
                    fx = real(1.0) * e[0]
                    fy = real(1.0) * e[1]
                seen = (t[0] - pressure) * wp.exp(-fx)
                if mode == 1:
                    seen = real(0.5) * (seen + (t[1] - pressure) * wp.exp(-fy))
            out = wp.vec2d(seen - given[0], t[2])
        return out

    @wp.kernel(module=module, enable_backward=False)
    def follow(
        path: wp.array(dtype=wp.vec2d), gaps: wp.array(dtype=wp.float64), pieces: wp.array(dtype=int), begun: real, timed: int,
        last: wp.vec2d, kind: int, mode: int, lead: int, incompressible: int, true_stress: int, unknowns: int, p: table,
        branches: wp.array2d(dtype=wp.vec2d), state: State, us: wp.array(dtype=wp.vec2d), ratios: wp.array(dtype=wp.vec2d),
        es: wp.array2d(dtype=vec4), ts: wp.array2d(dtype=vec4),
    ):  # fmt: skip
        i = wp.tid()
        zero, one = real(0.0), real(1.0)
        sheared = int(mode == 4)
        u, ratio, before, now = one * us[i], one * ratios[i], one * last, one * begun
        modulus = p[i, c_modulus]
        failed = int(0)
        for n in range(path.shape[0]):
            jump = (path[n] - before) / real(pieces[n])
            dt = real(1.0)
            if timed == 1:
                dt = gaps[n] / real(pieces[n])
            e, t = vec4(), vec4()
            for piece in range(pieces[n]):
                if failed == 1:
                    break
                given = before + jump * real(piece + 1)
                when = real(0.0)
                if timed == 1:
                    when = now + dt * real(piece)
                first = one * u
                u = u + ratio * jump[0]
                off = int(unknowns > 0)
                for _ in range(iterations):
                    e = strains(given, u, mode, lead, incompressible)
                    t = advance(i, e, dt, when, kind, sheared, p, branches, state, 0)
                    if unknowns == 0:
                        break
                    r = unbalanced(t, e, given, mode, lead, incompressible, true_stress)
                    size = wp.abs(r[0])
                    if unknowns == 2:
                        size = wp.max(size, wp.abs(r[1]))
                    most = wp.max(wp.max(wp.abs(t[0]), wp.abs(t[1])), wp.max(wp.abs(t[2]), wp.abs(t[3])))
                    if size <= tolerance * wp.max(modulus, most):
                        off = int(0)
                        break
                    e = strains(given, u + wp.vec2d(probe, zero), mode, lead, incompressible)
                    t = advance(i, e, dt, when, kind, sheared, p, branches, state, 0)
                    a = (unbalanced(t, e, given, mode, lead, incompressible, true_stress) - r) / probe
                    c = wp.vec2d(zero, modulus)
                    if unknowns == 2:
                        e = strains(given, u + wp.vec2d(zero, probe), mode, lead, incompressible)
                        t = advance(i, e, dt, when, kind, sheared, p, branches, state, 0)
                        c = (unbalanced(t, e, given, mode, lead, incompressible, true_stress) - r) / probe
                    else:
                        a = wp.vec2d(a[0], zero)
                        r = wp.vec2d(r[0], zero)
                    det = a[0] * c[1] - a[1] * c[0]
                    if not (wp.abs(det) / (modulus * modulus) >= real(1.0e-12)) or not wp.isfinite(det):
                        a = wp.vec2d(modulus, zero)
                        c = wp.vec2d(zero, modulus)
                        det = modulus * modulus
                    x, y = (r[0] * c[1] - r[1] * c[0]) / det, (a[0] * r[1] - a[1] * r[0]) / det
                    if wp.isfinite(x) and wp.isfinite(y):
                        u = u - wp.vec2d(wp.clamp(x, -largest, largest), wp.clamp(y, -largest, largest))
                failed = 1 * off
                if failed == 0:
                    t = advance(i, e, dt, when, kind, sheared, p, branches, state, 1)
                if wp.abs(jump[0]) > zero and lead == 0:
                    slope = (u - first) / jump[0]
                    if wp.isfinite(slope[0]):
                        ratio = wp.vec2d(wp.clamp(slope[0], real(-2.0), real(2.0)), zero)
            if failed == 1:
                e = vec4(wp.nan, wp.nan, wp.nan, wp.nan)
                t = one * e
            es[i, n] = e
            ts[i, n] = t
            before = one * path[n]
            now = now + gaps[n]
        us[i] = u
        ratios[i] = ratio

    return State, vec5, follow
