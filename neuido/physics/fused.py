"""Objective networks as one kernel a law, one thread a particle: features, network and read-out without a round trip to memory.

A thread keeps the second layer's 64 sums in registers and walks over the first layer's units; weights are read through the
cache, four at a time, the same for all threads. That is plain float32 on the CUDA cores: at 10^4 to 10^5 particles the
tensor cores' rate is out of reach anyway (LOG.md). The adjoint recomputes the sums; for the last layer it stores the hidden
units, and a second kernel reduces several substeps of them at once. `networks.py` is the slow twin.
"""

import functools
from collections.abc import Sequence
from types import SimpleNamespace

import torch
import warp as wp
from torch import Tensor

from neuido.physics import network_kernels
from neuido.physics.device import launch, start_warp
from neuido.physics.law import Engine
from neuido.types import Particles

WIDTHS = (32, 64)
"""Hidden widths that are compiled."""

FLUSH = 4
"""Substeps whose hidden units wait for one reduction to the last layer's gradient."""

CHUNK = 256
"""Particles that one thread of that reduction sums."""

BLOCK = 64
"""Threads a block: small bodies then still fill the multiprocessors."""

UNROLL = 2
"""Units of the first layer that a thread works on at a time."""

ROW = 12
"""Floats of a unit's row in the packed first layer: nine weights, the bias, two of padding."""

SIGMOID = """
    #if defined(__CUDA_ARCH__)
    #define NEUIDO_SIGMOID(a) __fdividef(1.0f, 1.0f + __expf(-(a)))
    #define NEUIDO_LOAD4(p) __ldg(reinterpret_cast<const float4*>(p))
    #else
    struct quad {{ float x, y, z, w; }};
    #define NEUIDO_SIGMOID(a) (1.0f / (1.0f + expf(-(a))))
    #define NEUIDO_LOAD4(p) (*reinterpret_cast<const quad*>(p))
    #endif
    #define NEUIDO_UNIT \\
        const auto q0 = NEUIDO_LOAD4(r), q1 = NEUIDO_LOAD4(r + 4), q2 = NEUIDO_LOAD4(r + 8); \\
        const float a = ((q0.x * x[0] + q0.y * x[1]) + (q0.z * x[2] + q0.w * x[3])) + ((q1.x * x[4] + q1.y * x[5]) \\
                        + (q1.z * x[6] + q1.w * x[7])) + (q2.x * x[8] + q2.y);
"""
"""Approximate exponential and division (relative error 1e-6), vector loads, and the sum of a unit of the first layer."""

HIDDEN = (
    SIGMOID
    + """
    wp::vec_t<{H}, wp::float32> z;
    const float* w1 = &W1.data[shared * {H} * 12];
    const float* w2 = &W2.data[shared * {H} * {H}];
    const float* b2 = &B2.data[shared * {H}];
    #pragma unroll
    for (int j = 0; j < {H}; j += 4) {{
        const auto q = NEUIDO_LOAD4(b2 + j);
        z[j] = q.x; z[j + 1] = q.y; z[j + 2] = q.z; z[j + 3] = q.w;
    }}
    #pragma unroll {U}
    for (int k = 0; k < {H}; ++k) {{
        const float* r = w1 + 12 * k;
        NEUIDO_UNIT
        const float h = a * NEUIDO_SIGMOID(a);
        const float* c = w2 + {H} * k;
        #pragma unroll
        for (int j = 0; j < {H}; j += 4) {{
            const auto q = NEUIDO_LOAD4(c + j);
            z[j] += q.x * h; z[j + 1] += q.y * h; z[j + 2] += q.z * h; z[j + 3] += q.w * h;
        }}
    }}
    return z;
"""
)

READOUT = (
    SIGMOID
    + """
    const float* w3 = &W3.data[scene * {H} * 4];
    const auto b = NEUIDO_LOAD4(&B3.data[scene * 4]);
    wp::vec_t<4, wp::float32> y(b.x, b.y, b.z, b.w);
    #pragma unroll
    for (int j = 0; j < {H}; ++j) {{
        const auto q = NEUIDO_LOAD4(w3 + 4 * j);
        const float h = z[j] * NEUIDO_SIGMOID(z[j]);
        y[0] += q.x * h; y[1] += q.y * h; y[2] += q.z * h; y[3] += q.w * h;
    }}
    return y;
"""
)

BACK = (
    SIGMOID
    + """
    const float* w1 = &W1.data[shared * {H} * 12];
    const float* w2 = &W2.data[shared * {H} * {H}];
    const float* w3 = &W3.data[scene * {H} * 4];
    wp::vec_t<9, wp::float32> gx;
    #pragma unroll
    for (int i = 0; i < 9; ++i) gx[i] = 0.0f;
    wp::vec_t<{H}, wp::float32> g;
    float* keep = H2.data ? &H2.data[(long long)row * {H}] : nullptr;
    float* out = G2.data ? &G2.data[(long long)p * {H}] : nullptr;
    #pragma unroll
    for (int j = 0; j < {H}; ++j) {{
        const auto q = NEUIDO_LOAD4(w3 + 4 * j);
        const float s = NEUIDO_SIGMOID(z[j]);
        const float h = z[j] * s;
        if (keep) keep[j] = h;
        g[j] = (q.x * gy[0] + q.y * gy[1] + q.z * gy[2] + q.w * gy[3]) * (s + h * (1.0f - s));
        if (out) out[j] = g[j];
    }}
    #pragma unroll {U}
    for (int k = 0; k < {H}; ++k) {{
        const float* r = w1 + 12 * k;
        NEUIDO_UNIT
        const float s = NEUIDO_SIGMOID(a);
        const float* c = w2 + {H} * k;
        float s0 = 0.0f, s1 = 0.0f, s2 = 0.0f, s3 = 0.0f;
        #pragma unroll
        for (int j = 0; j < {H}; j += 4) {{
            const auto q = NEUIDO_LOAD4(c + j);
            s0 += q.x * g[j]; s1 += q.y * g[j + 1]; s2 += q.z * g[j + 2]; s3 += q.w * g[j + 3];
        }}
        const float h = a * s;
        const float g1 = ((s0 + s1) + (s2 + s3)) * (s + h * (1.0f - s));
        if (out) {{ H1.data[(long long)p * {H} + k] = h; G1.data[(long long)p * {H} + k] = g1; }}
        gx[0] += q0.x * g1; gx[1] += q0.y * g1; gx[2] += q0.z * g1; gx[3] += q0.w * g1; gx[4] += q1.x * g1;
        gx[5] += q1.y * g1; gx[6] += q1.z * g1; gx[7] += q1.w * g1; gx[8] += q2.x * g1;
    }}
    return gx;
"""
)


@functools.cache
def build(width: int) -> SimpleNamespace:
    """The fused kernels for one hidden width (float32)."""
    start_warp()
    name = f"neuido.fused.{width}"
    own = network_kernels.functions(wp.float32, name)
    vec4, vec9, mat33 = own.vec4, own.vec9, own.mat33
    vecH = wp.types.vector(length=width, dtype=wp.float32)
    measure, features_of, stress_of, stress_coefficients = own.measure, own.features_of, own.stress_of, own.stress_coefficients
    stress_gradient, correction_of = own.stress_gradient, own.correction_of
    correction_coefficients, correction_gradient = own.correction_coefficients, own.correction_gradient
    kernel = functools.partial(wp.kernel, module=name, enable_backward=False)
    floats = wp.array(dtype=wp.float32)

    @wp.func_native(HIDDEN.format(H=width, U=UNROLL))
    def hidden(x: vec9, shared: int, W1: floats, W2: floats, B2: floats) -> vecH: ...

    @wp.func_native(READOUT.format(H=width))
    def readout(z: vecH, scene: int, W3: floats, B3: floats) -> vec4: ...

    @wp.func_native(BACK.format(H=width, U=UNROLL))
    def back(
        x: vec9, z: vecH, gy: vec4, shared: int, scene: int, W1: floats, W2: floats, W3: floats,
        H2: floats, row: int, H1: floats, G1: floats, G2: floats, p: int,
    ) -> vec9: ...  # fmt: skip

    @kernel
    def stress(
        F: wp.array(dtype=mat33), scene: wp.array(dtype=wp.int32), shared: int, own_rows: int,
        W1: floats, W2: floats, B2: floats, W3: floats, B3: floats, scale: float, tau: wp.array(dtype=mat33),
    ):  # fmt: skip
        p = wp.tid()
        N, h, l, A, q = measure(F[p])
        z = hidden(features_of(l, A, q), wp.min(scene[p], shared - 1), W1, W2, B2)
        tau[p] = stress_of(l, A, q, readout(z, wp.min(scene[p], own_rows - 1), W3, B3), scale)

    @kernel
    def correct(
        F: wp.array(dtype=mat33), scene: wp.array(dtype=wp.int32), shared: int, own_rows: int,
        W1: floats, W2: floats, B2: floats, W3: floats, B3: floats, scale: float, out: wp.array(dtype=mat33),
    ):  # fmt: skip
        p = wp.tid()
        N, h, l, A, q = measure(F[p])
        z = hidden(features_of(l, A, q), wp.min(scene[p], shared - 1), W1, W2, B2)
        out[p] = correction_of(F[p], l, A, q, readout(z, wp.min(scene[p], own_rows - 1), W3, B3), scale)

    @kernel
    def stress_adjoint(
        F: wp.array(dtype=mat33), scene: wp.array(dtype=wp.int32), shared: int, own_rows: int,
        W1: floats, W2: floats, B2: floats, W3: floats, B3: floats, scale: float,
        g_out: wp.array(dtype=mat33), g_F: wp.array(dtype=mat33),
        H2: floats, GY: wp.array(dtype=vec4), first: int, X: wp.array(dtype=vec9), H1: floats, G1: floats, G2: floats,
    ):  # fmt: skip
        """Adds to g_F; writes hidden units and output adjoints to rows first + p, and all of them where X is given."""
        p = wp.tid()
        N, h, l, A, q = measure(F[p])
        x = features_of(l, A, q)
        s = wp.min(scene[p], shared - 1)
        r = wp.min(scene[p], own_rows - 1)
        z = hidden(x, s, W1, W2, B2)
        c = readout(z, r, W3, B3)
        gy = stress_coefficients(l, A, q, scale, g_out[p])
        gx = back(x, z, gy, s, r, W1, W2, W3, H2, first + p, H1, G1, G2, p)
        if GY:
            GY[first + p] = gy
        if X:
            X[p] = x
        g_F[p] = g_F[p] + stress_gradient(F[p], N, h, l, A, q, c, scale, g_out[p], gx)

    @kernel
    def correct_adjoint(
        F: wp.array(dtype=mat33), scene: wp.array(dtype=wp.int32), shared: int, own_rows: int,
        W1: floats, W2: floats, B2: floats, W3: floats, B3: floats, scale: float,
        g_out: wp.array(dtype=mat33), g_F: wp.array(dtype=mat33),
        H2: floats, GY: wp.array(dtype=vec4), first: int, X: wp.array(dtype=vec9), H1: floats, G1: floats, G2: floats,
    ):  # fmt: skip
        """As `stress_adjoint`."""
        p = wp.tid()
        N, h, l, A, q = measure(F[p])
        x = features_of(l, A, q)
        s = wp.min(scene[p], shared - 1)
        r = wp.min(scene[p], own_rows - 1)
        z = hidden(x, s, W1, W2, B2)
        c = readout(z, r, W3, B3)
        gy = correction_coefficients(F[p], l, A, q, c, scale, 0, g_out[p])
        gx = back(x, z, gy, s, r, W1, W2, W3, H2, first + p, H1, G1, G2, p)
        if GY:
            GY[first + p] = gy
        if X:
            X[p] = x
        g_F[p] = g_F[p] + correction_gradient(F[p], N, h, l, A, q, c, scale, g_out[p], gx)

    @kernel
    def reduce_last(
        H2: floats, GY: wp.array(dtype=vec4), particles: int, chunk_scene: wp.array(dtype=wp.int32),
        chunk_first: wp.array(dtype=wp.int32), chunk_last: wp.array(dtype=wp.int32), own_rows: int,
        gW3: wp.array(dtype=vec4), gB3: wp.array(dtype=vec4),
    ):  # fmt: skip
        """Adds hidden unit times output adjoint, summed over a chunk of particles of one scene and substep."""
        tid = wp.tid()
        j = tid % wp.static(width)
        chunk = (tid / wp.static(width)) % chunk_scene.shape[0]
        substep = tid / (wp.static(width) * chunk_scene.shape[0])
        total = vec4(0.0, 0.0, 0.0, 0.0)
        bias = vec4(0.0, 0.0, 0.0, 0.0)
        for p in range(chunk_first[chunk], chunk_last[chunk]):
            row = substep * particles + p
            gy = GY[row]
            total += H2[row * wp.static(width) + j] * gy
            if j == 0:
                bias += gy
        s = wp.min(chunk_scene[chunk], own_rows - 1)
        wp.atomic_add(gW3, s * wp.static(width) + j, total)
        if j == 0:
            wp.atomic_add(gB3, s, bias)

    return SimpleNamespace(stress=stress, correct=correct, stress_adjoint=stress_adjoint, correct_adjoint=correct_adjoint,
                           reduce_last=reduce_last)  # fmt: skip


@functools.lru_cache(maxsize=16)
def _chunks(offsets: tuple[int, ...], device: torch.device) -> list[Tensor]:
    """Scene, first and last particle of every chunk; kept, since a graph may not copy from the host while it is captured."""
    table = [(s, p, min(p + CHUNK, j)) for s, (i, j) in enumerate(zip(offsets[:-1], offsets[1:])) for p in range(i, j, CHUNK)]
    return [torch.tensor(column, dtype=torch.int32, device=device) for column in zip(*table)]


class FusedEngine(Engine):
    """An objective network for one rollout in float32; the same interface and results as its law's own engine."""

    def __init__(self, law, tensors: Sequence[Tensor], particles: Particles):
        super().__init__(law, tensors, particles)
        W1, b1, W2, b2, W3, b3 = self.tensors
        self.width, self.outputs = W1.shape[1], W3.shape[1]
        self.kernels = build(self.width)
        elastic = self.outputs == network_kernels.STRESS_COEFFICIENTS
        self._forward = self.kernels.stress if elastic else self.kernels.correct
        self._adjoint = self.kernels.stress_adjoint if elastic else self.kernels.correct_adjoint
        shared, own = max(W1.shape[0], W2.shape[0]), max(W3.shape[0], b3.shape[0])
        first = W1.new_zeros(shared, self.width, ROW)
        first[..., :9], first[..., 9] = W1, b1
        last, offset = W1.new_zeros(own, self.width, 4), W1.new_zeros(own, 4)
        last[..., : self.outputs], offset[..., : self.outputs] = W3.mT, b3
        second = W2.mT.expand(shared, -1, -1).contiguous()
        bias = b2.expand(shared, -1).contiguous()
        self.rows = (shared, own)
        self.packed = [first.view(-1), second.view(-1), bias.view(-1), last.view(-1), offset.view(-1)]

    def forward(self, F: Tensor, out: Tensor) -> None:
        arguments = [F, self.particles.scene, *self.rows, *self.packed, self.law.scale, out]
        launch(self._forward, len(F), arguments, F.device, block=BLOCK)

    def start_adjoint(self, wanted: Sequence[bool]) -> None:
        super().start_adjoint(wanted)
        like, count = self.tensors[0], len(self.particles.scene)
        self.full, self.last = any(wanted[:4]), any(wanted)
        self.H2 = self.GY = self.X = self.H1 = self.G1 = self.G2 = None
        if self.last:
            self.H2, self.GY = like.new_empty(FLUSH * count * self.width), like.new_empty(FLUSH * count, 4)
            self.g_last, self.g_offset = like.new_zeros(self.rows[1] * self.width, 4), like.new_zeros(self.rows[1], 4)
            self.chunks = _chunks(self.particles.offsets, like.device)
        if self.full:
            self.X = like.new_empty(count, 9)
            self.H1, self.G1, self.G2 = (like.new_empty(count * self.width) for _ in range(3))
        self.waiting = 0

    def adjoint(self, F: Tensor, grad_out: Tensor, grad_F: Tensor) -> None:
        count = len(F)
        launch(self._adjoint, count, [F, self.particles.scene, *self.rows, *self.packed, self.law.scale, grad_out, grad_F, self.H2, self.GY,
                                      self.waiting * count, self.X, self.H1, self.G1, self.G2], F.device, block=BLOCK)  # fmt: skip
        if self.full:
            self._reduce_first(count)
        if self.last:
            self.waiting += 1
            if self.waiting == FLUSH:
                self._flush()

    def _reduce_first(self, count: int) -> None:
        """The gradients of the first two layers, shared by all scenes or one for each."""
        g1, b1, g2, b2 = self.grads[:4]
        h1, d1, d2 = (t.view(count, self.width) for t in (self.H1, self.G1, self.G2))
        ranges = [(0, 0, count)] if self.rows[0] == 1 else [
            (s, i, j) for s, (i, j) in enumerate(zip(self.particles.offsets[:-1], self.particles.offsets[1:]))
        ]  # fmt: skip
        for s, i, j in ranges:
            for target, d, value in ((g1, d1, self.X), (g2, d2, h1)):
                if target is not None:
                    target[min(s, len(target) - 1)].addmm_(d[i:j].T, value[i:j])
            for target, d in ((b1, d1), (b2, d2)):
                if target is not None:
                    target[min(s, len(target) - 1)].add_(d[i:j].sum(0))

    def _flush(self) -> None:
        if self.waiting:
            count = len(self.particles.scene)
            launch(self.kernels.reduce_last, self.waiting * len(self.chunks[0]) * self.width,
                   [self.H2, self.GY, count, *self.chunks, self.rows[1], self.g_last, self.g_offset], self.H2.device, block=BLOCK)  # fmt: skip
        self.waiting = 0

    def gradients(self) -> list[Tensor | None]:
        if self.last:
            self._flush()
            last = self.g_last.view(self.rows[1], self.width, 4)[..., : self.outputs].mT
            for target, value in ((self.grads[4], last), (self.grads[5], self.g_offset[:, : self.outputs])):
                if target is not None:
                    target.add_(value if len(target) == len(value) else value.sum(0, keepdim=True))
        return self.grads
