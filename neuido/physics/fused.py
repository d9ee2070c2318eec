"""Objective networks as one kernel a law: features, network and read-out without a round trip to memory (CUDA, float32).

A warp carries 32 particles of one scene, a lane one of them. Strain, features and read-out are a lane's own; the network's
layers are matrix products of the warp on the tensor cores, in tf32 with the residues (three products for one, relative error
1e-7: plain float32 would be bound by reading weights, tf32 alone is right to 1e-3). The columns that a lane holds of one
layer's result are those that it must hold of the next layer's operand once the weights' rows are permuted, so activations
never leave their registers. `networks.py` is the slow twin.

    m16n8k8: a lane (g, t) = (lane / 4, lane % 4) holds rows g, g + 8 and columns 2t, 2t + 1 of a 16 x 8 result.
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

BLOCK = 32
"""Threads a block: the warps of a small body then spread most evenly over the multiprocessors."""

INPUTS = 16
"""Columns of the first operand: nine features, a one for the bias, padding."""

TOOLS = """
    const int lane = threadIdx.x & 31, g = lane >> 2, t = lane & 3;
    const unsigned full = 0xffffffffu;
    auto sigmoid = [](float a) {{ return __fdividef(1.0f, 1.0f + __expf(-a)); }};
    auto weights = [lane](const wp::array_t<wp::float32>& W, int offset, int tile) {{
        return __ldg(reinterpret_cast<const float4*>(W.data + offset) + tile * 32 + lane);
    }};
    // hi and lo of four values of a result, in the order of an operand
    auto split = [](const float* c, float* hi, float* lo) {{
        const float v[4] = {{c[0], c[2], c[1], c[3]}};
        #pragma unroll
        for (int i = 0; i < 4; ++i) {{
            unsigned u;
            asm("cvt.rna.tf32.f32 %0, %1;" : "=r"(u) : "f"(v[i]));
            hi[i] = __uint_as_float(u);
            lo[i] = v[i] - hi[i];
        }}
    }};
    auto product = [](float* c, const float* a, float b0, float b1) {{
        asm volatile("mma.sync.aligned.m16n8k8.row.col.f32.tf32.tf32.f32 {{%0,%1,%2,%3}}, {{%4,%5,%6,%7}}, {{%8,%9}}, {{%0,%1,%2,%3}};"
            : "+f"(c[0]), "+f"(c[1]), "+f"(c[2]), "+f"(c[3])
            : "r"(__float_as_uint(a[0])), "r"(__float_as_uint(a[1])), "r"(__float_as_uint(a[2])), "r"(__float_as_uint(a[3])),
              "r"(__float_as_uint(b0)), "r"(__float_as_uint(b1)));
    }};
    auto exact = [&](float* c, const float* hi, const float* lo, float4 w) {{
        product(c, lo, w.x, w.y);
        product(c, hi, w.z, w.w);
        product(c, hi, w.x, w.y);
    }};
    // the features of the warp's particles as operands, two tiles of 16 rows, two of 8 columns
    float xh[2][2][4], xl[2][2][4];
    #pragma unroll
    for (int m = 0; m < 2; ++m) {{
        float c[2][4] = {{{{0, 0, 0, 0}}, {{0, 0, 0, 0}}}};
        #pragma unroll
        for (int i = 0; i < 10; ++i) {{
            const float v = i < 9 ? x[i < 9 ? i : 0] : 1.0f;
            const float u0 = __shfl_sync(full, v, 16 * m + g), u1 = __shfl_sync(full, v, 16 * m + g + 8);
            if (t == (i & 7) >> 1) {{ c[i >> 3][i & 1] = u0; c[i >> 3][2 + (i & 1)] = u1; }}
        }}
        #pragma unroll
        for (int s = 0; s < 2; ++s) split(c[s], xh[m][s], xl[m][s]);
    }}
"""
"""What both functions begin with: products, their operands' residues, and the features as operands."""

FORWARD = (
    "#if defined(__CUDA_ARCH__)"
    + TOOLS
    + """
    const int one = shared * {SIZE1}, two = shared * {SIZE2}, three = scene * {SIZE3};
    float z[2][{NT}][4];
    #pragma unroll
    for (int n = 0; n < {NT}; ++n) {{
        const float2 b = *reinterpret_cast<const float2*>(B2.data + shared * {H} + 8 * n + 2 * t);
        #pragma unroll
        for (int m = 0; m < 2; ++m) {{ z[m][n][0] = b.x; z[m][n][1] = b.y; z[m][n][2] = b.x; z[m][n][3] = b.y; }}
    }}
    #pragma unroll 1
    for (int j = 0; j < {NT}; ++j) {{
        const float4 w0 = weights(W1, one, j), w1 = weights(W1, one, {NT} + j);
        float hi[2][4], lo[2][4];
        #pragma unroll
        for (int m = 0; m < 2; ++m) {{
            float c[4] = {{0, 0, 0, 0}};
            exact(c, xh[m][0], xl[m][0], w0);
            exact(c, xh[m][1], xl[m][1], w1);
            #pragma unroll
            for (int i = 0; i < 4; ++i) c[i] *= sigmoid(c[i]);
            split(c, hi[m], lo[m]);
        }}
        #pragma unroll
        for (int n = 0; n < {NT}; ++n) {{
            const float4 w = weights(W2, two, j * {NT} + n);
            exact(z[0][n], hi[0], lo[0], w);
            exact(z[1][n], hi[1], lo[1], w);
        }}
    }}
    float y[2][4] = {{{{0, 0, 0, 0}}, {{0, 0, 0, 0}}}};
    #pragma unroll
    for (int j = 0; j < {NT}; ++j) {{
        const float4 w = weights(W3, three, j);
        #pragma unroll
        for (int m = 0; m < 2; ++m) {{
            float c[4], hi[4], lo[4];
            #pragma unroll
            for (int i = 0; i < 4; ++i) c[i] = z[m][j][i] * sigmoid(z[m][j][i]);
            split(c, hi, lo);
            exact(y[m], hi, lo, w);
        }}
    }}
    wp::vec_t<{KEPT}, wp::float32> out;
    #pragma unroll
    for (int m = 0; m < 2; ++m)
        #pragma unroll
        for (int n = 0; n < {NT}; ++n)
            #pragma unroll
            for (int i = 0; i < 4; ++i) out[(m * {NT} + n) * 4 + i] = z[m][n][i];
    // the four outputs of a lane's own particle
    #pragma unroll
    for (int i = 0; i < 4; ++i) {{
        float v = 0.0f;
        #pragma unroll
        for (int m = 0; m < 2; ++m)
            #pragma unroll
            for (int u = 0; u < 2; ++u) {{
                const float q = __shfl_sync(full, y[m][2 * u + (i & 1)], 4 * (lane & 7) + (i >> 1));
                if (m == lane >> 4 && u == ((lane >> 3) & 1)) v = q;
            }}
        out[{KEPT} - 4 + i] = v + B3.data[scene * 4 + i];
    }}
    return out;
#else
    return wp::vec_t<{KEPT}, wp::float32>();
#endif
"""
)

BACKWARD = (
    "#if defined(__CUDA_ARCH__)"
    + TOOLS
    + """
    const int one = shared * {SIZE1}, two = shared * {SIZE2}, three = scene * {SIZE3T};
    float z[2][{NT}][4], gy_rows[2][2][4], gh[2][4], gl[2][4];
    #pragma unroll
    for (int m = 0; m < 2; ++m) {{
        #pragma unroll
        for (int n = 0; n < {NT}; ++n)
            #pragma unroll
            for (int i = 0; i < 4; ++i) z[m][n][i] = kept[(m * {NT} + n) * 4 + i];
        float c[4] = {{0, 0, 0, 0}};
        #pragma unroll
        for (int i = 0; i < 4; ++i) {{
            gy_rows[m][0][i] = __shfl_sync(full, gy[i], 16 * m + g);
            gy_rows[m][1][i] = __shfl_sync(full, gy[i], 16 * m + g + 8);
            if (t == i >> 1) {{ c[i & 1] = gy_rows[m][0][i]; c[2 + (i & 1)] = gy_rows[m][1][i]; }}
        }}
        split(c, gh[m], gl[m]);
    }}
    if (P3.data) {{
        float b[4];
        #pragma unroll
        for (int i = 0; i < 4; ++i) {{
            b[i] = gy[i];
            #pragma unroll
            for (int d = 16; d > 0; d >>= 1) b[i] += __shfl_xor_sync(full, b[i], d);
        }}
        if (lane < 4) PB.data[warp * 4 + lane] += lane == 0 ? b[0] : lane == 1 ? b[1] : lane == 2 ? b[2] : b[3];
    }}
    // second layer: adjoint of its sums, in place; what the last layer's gradient gets from this warp
    #pragma unroll
    for (int j = 0; j < {NT}; ++j) {{
        const float4 w = weights(W3T, three, j);
        float part[8] = {{0, 0, 0, 0, 0, 0, 0, 0}};
        #pragma unroll
        for (int m = 0; m < 2; ++m) {{
            float c[4] = {{0, 0, 0, 0}};
            exact(c, gh[m], gl[m], w);
            #pragma unroll
            for (int i = 0; i < 4; ++i) {{
                const float s = sigmoid(z[m][j][i]), h = z[m][j][i] * s;
                #pragma unroll
                for (int o = 0; o < 4; ++o) part[(i & 1) * 4 + o] += h * gy_rows[m][i >> 1][o];
                z[m][j][i] = c[i] * (s + h * (1.0f - s));
            }}
            if (G2.data) {{
                #pragma unroll
                for (int i = 0; i < 4; ++i) {{
                    const int p = first + 16 * m + g + 8 * (i >> 1);
                    if (p < last) G2.data[(long long)p * {H} + 8 * j + 2 * t + (i & 1)] = z[m][j][i];
                }}
            }}
        }}
        if (P3.data) {{
            // sum over the eight lanes of a column: each keeps the half that its bit of g says
            #pragma unroll
            for (int b = 0; b < 3; ++b) {{
                const int half = 4 >> b, bit = 16 >> b;
                const bool upper = lane & bit;
                #pragma unroll
                for (int i = 0; i < 4; ++i)
                    if (i < half) {{
                        const float give = upper ? part[i] : part[i + half], keep = upper ? part[i + half] : part[i];
                        part[i] = keep + __shfl_xor_sync(full, give, bit);
                    }}
            }}
            P3.data[(warp * {NT} + j) * 32 + lane] += part[0];
        }}
    }}
    float a[2][{NT}][4];
    #pragma unroll
    for (int n = 0; n < {NT}; ++n)
        #pragma unroll
        for (int m = 0; m < 2; ++m)
            #pragma unroll
            for (int i = 0; i < 4; ++i) a[m][n][i] = 0.0f;
    #pragma unroll
    for (int j = 0; j < {NT}; ++j) {{
        float hi[2][4], lo[2][4];
        split(z[0][j], hi[0], lo[0]);
        split(z[1][j], hi[1], lo[1]);
        #pragma unroll
        for (int n = 0; n < {NT}; ++n) {{
            const float4 w = weights(W2T, two, j * {NT} + n);
            exact(a[0][n], hi[0], lo[0], w);
            exact(a[1][n], hi[1], lo[1], w);
        }}
    }}
    float gx[2][2][4] = {{{{{{0, 0, 0, 0}}, {{0, 0, 0, 0}}}}, {{{{0, 0, 0, 0}}, {{0, 0, 0, 0}}}}}};
    #pragma unroll
    for (int n = 0; n < {NT}; ++n) {{
        const float4 w0 = weights(W1, one, n), w1 = weights(W1, one, {NT} + n);
        const float4 v0 = weights(W1T, one, 2 * n), v1 = weights(W1T, one, 2 * n + 1);
        #pragma unroll
        for (int m = 0; m < 2; ++m) {{
            float c[4] = {{0, 0, 0, 0}}, hi[4], lo[4];
            exact(c, xh[m][0], xl[m][0], w0);
            exact(c, xh[m][1], xl[m][1], w1);
            #pragma unroll
            for (int i = 0; i < 4; ++i) {{
                const float s = sigmoid(c[i]), h = c[i] * s;
                c[i] = a[m][n][i] * (s + h * (1.0f - s));
                const int p = first + 16 * m + g + 8 * (i >> 1);
                if (G2.data && p < last) {{
                    H1.data[(long long)p * {H} + 8 * n + 2 * t + (i & 1)] = h;
                    G1.data[(long long)p * {H} + 8 * n + 2 * t + (i & 1)] = c[i];
                }}
            }}
            split(c, hi, lo);
            exact(gx[m][0], hi, lo, v0);
            exact(gx[m][1], hi, lo, v1);
        }}
    }}
    wp::vec_t<9, wp::float32> out;
    #pragma unroll
    for (int i = 0; i < 9; ++i) {{
        float v = 0.0f;
        #pragma unroll
        for (int m = 0; m < 2; ++m)
            #pragma unroll
            for (int u = 0; u < 2; ++u) {{
                const float q = __shfl_sync(full, gx[m][i >> 3][2 * u + (i & 1)], 4 * (lane & 7) + ((i & 7) >> 1));
                if (m == lane >> 4 && u == ((lane >> 3) & 1)) v = q;
            }}
        out[i] = v;
    }}
    return out;
#else
    return wp::vec_t<9, wp::float32>();
#endif
"""
)


@functools.cache
def build(width: int) -> SimpleNamespace:
    """The fused kernels for one hidden width."""
    start_warp()
    tiles = width // 8
    kept = 8 * tiles + 4
    sizes = {
        "H": width, "NT": tiles, "KEPT": kept, "SIZE1": 2 * tiles * 128, "SIZE2": tiles * tiles * 128, "SIZE3": tiles * 128,
        "SIZE3T": tiles * 128,
    }  # fmt: skip
    name = f"neuido.fused.{width}"
    # approximate logarithms, roots and divisions in the strain and its features, right to 1e-6: a third of the instructions
    wp.set_module_options({"fast_math": True}, module=wp.get_module(name))
    own = network_kernels.functions(wp.float32, name)
    vec4, vec9, mat33 = own.vec4, own.vec9, own.mat33
    vecK = wp.types.vector(length=kept, dtype=wp.float32)
    measure, features_of, stress_of, stress_coefficients = own.measure, own.features_of, own.stress_of, own.stress_coefficients
    stress_gradient, correction_of = own.stress_gradient, own.correction_of
    correction_coefficients, correction_gradient = own.correction_coefficients, own.correction_gradient
    kernel = functools.partial(wp.kernel, module=name, enable_backward=False)
    func = functools.partial(wp.func, module=name)
    floats = wp.array(dtype=wp.float32)
    ints = wp.array(dtype=wp.int32)

    @wp.func_native(FORWARD.format(**sizes))
    def network(x: vec9, shared: int, scene: int, W1: floats, W2: floats, B2: floats, W3: floats, B3: floats) -> vecK: ...

    @wp.func_native(BACKWARD.format(**sizes))
    def network_adjoint(
        x: vec9, kept: vecK, gy: vec4, shared: int, scene: int, W1: floats, W2T: floats, W3T: floats, W1T: floats,
        warp: int, first: int, last: int, P3: floats, PB: floats, H1: floats, G1: floats, G2: floats,
    ) -> vec9: ...  # fmt: skip

    @func
    def outputs(k: vecK):
        return vec4(k[wp.static(kept - 4)], k[wp.static(kept - 3)], k[wp.static(kept - 2)], k[wp.static(kept - 1)])

    @kernel
    def stress(
        F: wp.array(dtype=mat33), scenes: ints, firsts: ints, lasts: ints, shared: int, rows: int,
        W1: floats, W2: floats, B2: floats, W3: floats, B3: floats, scale: float, tau: wp.array(dtype=mat33),
    ):  # fmt: skip
        tid = wp.tid()
        warp = tid / 32
        p = firsts[warp] + tid % 32
        s = scenes[warp]
        Fp = F[wp.min(p, lasts[warp] - 1)]
        N, h, l, A, q = measure(Fp)
        k = network(features_of(l, A, q), wp.min(s, shared - 1), wp.min(s, rows - 1), W1, W2, B2, W3, B3)
        if p < lasts[warp]:
            tau[p] = stress_of(l, A, q, outputs(k), scale)

    @kernel
    def correct(
        F: wp.array(dtype=mat33), scenes: ints, firsts: ints, lasts: ints, shared: int, rows: int,
        W1: floats, W2: floats, B2: floats, W3: floats, B3: floats, scale: float, out: wp.array(dtype=mat33),
    ):  # fmt: skip
        tid = wp.tid()
        warp = tid / 32
        p = firsts[warp] + tid % 32
        s = scenes[warp]
        Fp = F[wp.min(p, lasts[warp] - 1)]
        N, h, l, A, q = measure(Fp)
        k = network(features_of(l, A, q), wp.min(s, shared - 1), wp.min(s, rows - 1), W1, W2, B2, W3, B3)
        if p < lasts[warp]:
            out[p] = correction_of(Fp, l, A, q, outputs(k), scale)

    @kernel
    def stress_adjoint(
        F: wp.array(dtype=mat33), scenes: ints, firsts: ints, lasts: ints, shared: int, rows: int,
        W1: floats, W2: floats, B2: floats, W3: floats, B3: floats, scale: float, W2T: floats, W3T: floats, W1T: floats,
        g_out: wp.array(dtype=mat33), g_F: wp.array(dtype=mat33),
        P3: floats, PB: floats, X: wp.array(dtype=vec9), H1: floats, G1: floats, G2: floats,
    ):  # fmt: skip
        """Adds to g_F, and to the warp's share of the last layer's gradient where P3 is given; writes units where X is."""
        tid = wp.tid()
        warp = tid / 32
        last = lasts[warp]
        p = firsts[warp] + tid % 32
        s = wp.min(scenes[warp], shared - 1)
        r = wp.min(scenes[warp], rows - 1)
        pp = wp.min(p, last - 1)
        g = g_out[pp]
        N, h, l, A, q = measure(F[pp])
        x = features_of(l, A, q)
        k = network(x, s, r, W1, W2, B2, W3, B3)
        gy = stress_coefficients(l, A, q, scale, g)
        if p >= last:
            gy = vec4(0.0, 0.0, 0.0, 0.0)
        gx = network_adjoint(x, k, gy, s, r, W1, W2T, W3T, W1T, warp, firsts[warp], last, P3, PB, H1, G1, G2)
        if p < last:
            if X:
                X[p] = x
            # measured again: cheaper than the registers to remember it
            N2, h2, l2, A2, q2 = measure(F[p])
            g_F[p] = g_F[p] + stress_gradient(F[p], N2, h2, l2, A2, q2, outputs(k), scale, g_out[p], gx)

    @kernel
    def correct_adjoint(
        F: wp.array(dtype=mat33), scenes: ints, firsts: ints, lasts: ints, shared: int, rows: int,
        W1: floats, W2: floats, B2: floats, W3: floats, B3: floats, scale: float, W2T: floats, W3T: floats, W1T: floats,
        g_out: wp.array(dtype=mat33), g_F: wp.array(dtype=mat33),
        P3: floats, PB: floats, X: wp.array(dtype=vec9), H1: floats, G1: floats, G2: floats,
    ):  # fmt: skip
        """As `stress_adjoint`."""
        tid = wp.tid()
        warp = tid / 32
        last = lasts[warp]
        p = firsts[warp] + tid % 32
        s = wp.min(scenes[warp], shared - 1)
        r = wp.min(scenes[warp], rows - 1)
        pp = wp.min(p, last - 1)
        g = g_out[pp]
        N, h, l, A, q = measure(F[pp])
        x = features_of(l, A, q)
        k = network(x, s, r, W1, W2, B2, W3, B3)
        gy = correction_coefficients(F[pp], l, A, q, outputs(k), scale, 0, g)
        if p >= last:
            gy = vec4(0.0, 0.0, 0.0, 0.0)
        gx = network_adjoint(x, k, gy, s, r, W1, W2T, W3T, W1T, warp, firsts[warp], last, P3, PB, H1, G1, G2)
        if p < last:
            if X:
                X[p] = x
            N2, h2, l2, A2, q2 = measure(F[p])  # as above
            g_F[p] = g_F[p] + correction_gradient(F[p], N2, h2, l2, A2, q2, outputs(k), scale, g_out[p], gx)

    return SimpleNamespace(stress=stress, correct=correct, stress_adjoint=stress_adjoint, correct_adjoint=correct_adjoint)


@functools.lru_cache(maxsize=16)
def _warps(offsets: tuple[int, ...], device: torch.device) -> list[Tensor]:
    """Scene, first and last particle of every warp; kept, since a graph may not copy from the host while it is captured."""
    table = [(s, p, min(p + 32, j)) for s, (i, j) in enumerate(zip(offsets[:-1], offsets[1:])) for p in range(i, j, 32)]
    return [torch.tensor(column, dtype=torch.int32, device=device) for column in zip(*table)]


@functools.lru_cache(maxsize=16)
def _order(rows: int, columns: int, device: torch.device) -> Tensor:
    """Where the two entries of each lane's fragment stand in a (rows, columns) matrix, (tiles, 32 lanes, 2)."""
    lane = torch.arange(32)
    g, t = lane // 4, lane % 4
    tiles = [
        torch.stack([(8 * k + 2 * t + half) * columns + 8 * n + g for half in (0, 1)], dim=1)
        for k in range(rows // 8)
        for n in range(columns // 8)
    ]
    return torch.stack(tiles).to(device)


def _fragments(W: Tensor) -> Tensor:
    """(S, rows, columns) -> (S, tiles * 32 * 4): of each lane two entries rounded to tf32, then their residues."""
    entries = W.flatten(1)[:, _order(W.shape[1], W.shape[2], W.device)]
    high = ((entries.contiguous().view(torch.int32) + 0x1000) & ~0x1FFF).view(torch.float32)
    return torch.cat([high, entries - high], dim=-1).flatten(1).contiguous()


class FusedEngine(Engine):
    """An objective network for one rollout; the same interface and results as its law's own engine."""

    def __init__(self, law, tensors: Sequence[Tensor], particles: Particles):
        super().__init__(law, tensors, particles)
        W1, b1, W2, b2, W3, b3 = self.tensors
        self.width, self.outputs = W1.shape[1], W3.shape[1]
        self.kernels = build(self.width)
        elastic = self.outputs == network_kernels.STRESS_COEFFICIENTS
        self._forward = self.kernels.stress if elastic else self.kernels.correct
        self._adjoint = self.kernels.stress_adjoint if elastic else self.kernels.correct_adjoint
        shared, own = max(t.shape[0] for t in (W1, b1, W2, b2)), max(W3.shape[0], b3.shape[0])
        first = W1.new_zeros(shared, INPUTS, self.width)
        first[:, :9], first[:, 9] = W1.mT, b1
        last, offset = W1.new_zeros(own, self.width, 8), W1.new_zeros(own, 4)
        last[..., : self.outputs], offset[:, : self.outputs] = W3.mT, b3
        second, bias = W2.mT.expand(shared, -1, -1), b2.expand(shared, -1).contiguous()
        self.first, self.second, self.last = first, second, last
        self.rows = (shared, own)
        self.packed = [t.view(-1) for t in (_fragments(first), _fragments(second), bias, _fragments(last), offset)]
        self.warps = _warps(particles.offsets, W1.device)

    @property
    def threads(self) -> int:
        return 32 * len(self.warps[0])

    def forward(self, F: Tensor, out: Tensor) -> None:
        arguments = [F, *self.warps, *self.rows, *self.packed, self.law.scale, out]
        launch(self._forward, self.threads, arguments, F.device, block=BLOCK)

    def start_adjoint(self, wanted: Sequence[bool]) -> None:
        super().start_adjoint(wanted)
        like, count = self.first, self.particles.offsets[-1]
        self.transposed = [_fragments(t.mT.contiguous()).view(-1) for t in (self.second, self.last, self.first)]
        self.full, self.ends = any(wanted[:4]), any(wanted[4:])
        self.P3 = self.PB = self.X = self.H1 = self.G1 = self.G2 = None
        if self.ends:
            self.P3, self.PB = like.new_zeros(self.threads * self.width // 8), like.new_zeros(len(self.warps[0]) * 4)
        if self.full:
            self.X = like.new_empty(count, 9)
            self.H1, self.G1, self.G2 = (like.new_empty(count * self.width) for _ in range(3))

    def adjoint(self, F: Tensor, grad_out: Tensor, grad_F: Tensor) -> None:
        arguments = [F, *self.warps, *self.rows, *self.packed, self.law.scale, *self.transposed, grad_out, grad_F,
                     self.P3, self.PB, self.X, self.H1, self.G1, self.G2]  # fmt: skip
        launch(self._adjoint, self.threads, arguments, F.device, block=BLOCK)
        if self.full:
            self._reduce_first(len(F))

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

    def gradients(self) -> list[Tensor | None]:
        if self.ends:
            # a warp's share: tile j, lane (g, t) holds output g % 4 of column 8 j + 2 t + g / 4
            tiles = self.width // 8
            share = self.P3.view(-1, tiles, 2, 4, 4).permute(0, 3, 1, 4, 2).reshape(-1, 4, self.width)
            for target, value in ((self.grads[4], share), (self.grads[5], self.PB.view(-1, 4))):
                if target is not None:
                    rows = self.warps[0].long().clamp(max=len(target) - 1)
                    target.index_add_(0, rows, value[:, : self.outputs].contiguous())
        return self.grads
