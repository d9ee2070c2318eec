"""CUDA source of the fused networks: three layers for the 32 or 16 particles of a warp on the tensor cores, and their adjoint.

    m16n8k8: a lane (g, t) = (lane / 4, lane % 4) holds rows g, g + 8 and columns 2t, 2t + 1 of a 16 x 8 result,
    and of the next operand the same columns, once the rows of its weights are permuted (`fused._order`).

`FORWARD` and `BACKWARD` are bodies of Warp functions, in which `fused.build` fills in the sizes. The CPU, for
tests, evaluates one particle at a time, without the gradients of the first two layers.
"""

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
    // the same with the residues in a sum of their own, since a product waits for the one before that adds to the same sum
    auto apart = [&](float* c, float* r, const float* hi, const float* lo, float4 w) {{
        product(r, lo, w.x, w.y);
        product(c, hi, w.x, w.y);
        product(r, hi, w.z, w.w);
    }};
    // the features of the warp's particles as operands, tiles of 16 rows, two of 8 columns
    float xh[{MT}][2][4], xl[{MT}][2][4];
    #pragma unroll
    for (int m = 0; m < {MT}; ++m) {{
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
"""The common beginning of both functions: matrix products, residues of operands, and the features as operands."""

PLAIN = """
    // the CPU evaluates one particle in plain loops, for tests; entry (r, c) of a packed matrix is the sum of its two parts
    auto entry = [](const wp::array_t<wp::float32>& W, int offset, int columns, int r, int c) {{
        const float* at = W.data + offset + (((r / 8) * (columns / 8) + c / 8) * 32 + 4 * (c % 8) + (r % 8) / 2) * 4 + r % 2;
        return at[0] + at[2];
    }};
    auto sigmoid = [](float a) {{ return 1.0f / (1.0f + expf(-a)); }};
"""
"""The beginning of both functions on the CPU: entries of packed matrices."""

FORWARD = (
    "#if defined(__CUDA_ARCH__)"
    + TOOLS
    + """
    const int one = shared * {SIZE1}, two = shared * {SIZE2}, three = scene * {SIZE3};
    float z[{MT}][{NT}][4];
    #pragma unroll
    for (int n = 0; n < {NT}; ++n) {{
        const float2 b = *reinterpret_cast<const float2*>(B2.data + shared * {H} + 8 * n + 2 * t);
        #pragma unroll
        for (int m = 0; m < {MT}; ++m) {{ z[m][n][0] = b.x; z[m][n][1] = b.y; z[m][n][2] = b.x; z[m][n][3] = b.y; }}
    }}
    #pragma unroll {TURNS}
    for (int j = 0; j < {NT}; ++j) {{
        const float4 w0 = weights(W1, one, j), w1 = weights(W1, one, {NT} + j);
        float hi[{MT}][4], lo[{MT}][4];
        #pragma unroll
        for (int m = 0; m < {MT}; ++m) {{
            float c[4] = {{0, 0, 0, 0}}, r[4] = {{0, 0, 0, 0}};
            apart(c, r, xh[m][0], xl[m][0], w0);
            apart(c, r, xh[m][1], xl[m][1], w1);
            #pragma unroll
            for (int i = 0; i < 4; ++i) {{
                c[i] += r[i];
                c[i] *= sigmoid(c[i]);
            }}
            split(c, hi[m], lo[m]);
        }}
        #pragma unroll
        for (int n = 0; n < {NT}; ++n) {{
            const float4 w = weights(W2, two, j * {NT} + n);
            exact(z[0][n], hi[0], lo[0], w);
            exact(z[1][n], hi[1], lo[1], w);
        }}
    }}
    float y[{MT}][4] = {{}}, rest[{MT}][4] = {{}};
    #pragma unroll
    for (int j = 0; j < {NT}; ++j) {{
        const float4 w = weights(W3, three, j);
        #pragma unroll
        for (int m = 0; m < {MT}; ++m) {{
            float c[4], hi[4], lo[4];
            #pragma unroll
            for (int i = 0; i < 4; ++i) c[i] = z[m][j][i] * sigmoid(z[m][j][i]);
            split(c, hi, lo);
            apart(y[m], rest[m], hi, lo, w);
        }}
    }}
    #pragma unroll
    for (int m = 0; m < {MT}; ++m)
        #pragma unroll
        for (int i = 0; i < 4; ++i) y[m][i] += rest[m][i];
    wp::vec_t<{KEPT}, wp::float32> out;
    #pragma unroll
    for (int m = 0; m < {MT}; ++m)
        #pragma unroll
        for (int n = 0; n < {NT}; ++n)
            #pragma unroll
            for (int i = 0; i < 4; ++i) out[(m * {NT} + n) * 4 + i] = z[m][n][i];
    // the four outputs of a lane's own particle
    #pragma unroll
    for (int i = 0; i < 4; ++i) {{
        float v = 0.0f;
        #pragma unroll
        for (int m = 0; m < {MT}; ++m)
            #pragma unroll
            for (int u = 0; u < 2; ++u) {{
                const float q = __shfl_sync(full, y[m][2 * u + (i & 1)], 4 * (lane & 7) + (i >> 1));
                if (m == (lane >> 4) % {MT} && u == ((lane >> 3) & 1)) v = q;
            }}
        out[{KEPT} - 4 + i] = v + B3.data[scene * 4 + i];
    }}
    return out;
#else"""
    + PLAIN
    + """
    wp::vec_t<{KEPT}, wp::float32> out;
    for (int n = 0; n < {H}; ++n) out[n] = B2.data[shared * {H} + n];
    for (int k = 0; k < {H}; ++k) {{
        float z = entry(W1, shared * {SIZE1}, {H}, 9, k);
        for (int i = 0; i < 9; ++i) z += x[i] * entry(W1, shared * {SIZE1}, {H}, i, k);
        z *= sigmoid(z);
        for (int n = 0; n < {H}; ++n) out[n] += z * entry(W2, shared * {SIZE2}, {H}, k, n);
    }}
    for (int o = 0; o < 4; ++o) {{
        float y = B3.data[scene * 4 + o];
        for (int n = 0; n < {H}; ++n) y += out[n] * sigmoid(out[n]) * entry(W3, scene * {SIZE3}, 8, n, o);
        out[{H} + o] = y;
    }}
    return out;
#endif
"""
)

BACKWARD = (
    "#if defined(__CUDA_ARCH__)"
    + TOOLS
    + """
    const int one = shared * {SIZE1}, two = shared * {SIZE2}, three = scene * {SIZE3T};
    float z[{MT}][{NT}][4], gy_rows[{MT}][2][4], gh[{MT}][4], gl[{MT}][4];
    #pragma unroll
    for (int m = 0; m < {MT}; ++m) {{
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
        for (int m = 0; m < {MT}; ++m) {{
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
    float a[{MT}][{NT}][4];
    #pragma unroll
    for (int n = 0; n < {NT}; ++n)
        #pragma unroll
        for (int m = 0; m < {MT}; ++m)
            #pragma unroll
            for (int i = 0; i < 4; ++i) a[m][n][i] = 0.0f;
    #pragma unroll
    for (int j = 0; j < {NT}; ++j) {{
        float hi[{MT}][4], lo[{MT}][4];
        #pragma unroll
        for (int m = 0; m < {MT}; ++m) split(z[m][j], hi[m], lo[m]);
        #pragma unroll
        for (int n = 0; n < {NT}; ++n) {{
            const float4 w = weights(W2T, two, j * {NT} + n);
            #pragma unroll
            for (int m = 0; m < {MT}; ++m) exact(a[m][n], hi[m], lo[m], w);
        }}
    }}
    float gx[{MT}][2][4] = {{}};
    #pragma unroll
    for (int n = 0; n < {NT}; ++n) {{
        const float4 w0 = weights(W1, one, n), w1 = weights(W1, one, {NT} + n);
        const float4 v0 = weights(W1T, one, 2 * n), v1 = weights(W1T, one, 2 * n + 1);
        #pragma unroll
        for (int m = 0; m < {MT}; ++m) {{
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
        for (int m = 0; m < {MT}; ++m)
            #pragma unroll
            for (int u = 0; u < 2; ++u) {{
                const float q = __shfl_sync(full, gx[m][i >> 3][2 * u + (i & 1)], 4 * (lane & 7) + ((i & 7) >> 1));
                if (m == (lane >> 4) % {MT} && u == ((lane >> 3) & 1)) v = q;
            }}
        out[i] = v;
    }}
    return out;
#else"""
    + PLAIN
    + """
    float a[{H}], gz[{H}];
    for (int k = 0; k < {H}; ++k) a[k] = 0.0f;
    for (int o = 0; o < 4; ++o)
        if (P3.data) PB.data[warp * 4 + o] += gy[o];
    for (int n = 0; n < {H}; ++n) {{
        const float s = sigmoid(kept[n]), h = kept[n] * s;
        gz[n] = 0.0f;
        for (int o = 0; o < 4; ++o) {{
            gz[n] += gy[o] * entry(W3T, scene * {SIZE3T}, {H}, o, n);
            if (P3.data) P3.data[(warp * {NT} + n / 8) * 32 + 16 * (n % 2) + 4 * o + (n % 8) / 2] += h * gy[o];
        }}
        gz[n] *= s + h * (1.0f - s);
    }}
    for (int n = 0; n < {H}; ++n)
        for (int k = 0; k < {H}; ++k) a[k] += gz[n] * entry(W2T, shared * {SIZE2}, {H}, n, k);
    wp::vec_t<9, wp::float32> out;
    for (int k = 0; k < {H}; ++k) {{
        float z = entry(W1, shared * {SIZE1}, {H}, 9, k);
        for (int i = 0; i < 9; ++i) z += x[i] * entry(W1, shared * {SIZE1}, {H}, i, k);
        const float s = sigmoid(z), h = z * s;
        for (int i = 0; i < 9; ++i) out[i] += a[k] * (s + h * (1.0f - s)) * entry(W1T, shared * {SIZE1}, 16, k, i);
    }}
    return out;
#endif
"""
)
