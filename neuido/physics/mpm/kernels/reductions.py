"""Native source of the sums between particles and grid, for float32.

On a GPU the sums run over the particles of a warp. On the CPU they run over the three nodes of a row, twelve numbers side by side in vector
registers, and the rows of the stencil are summed before the nodes of a row. `stencil.functions` makes Warp functions of these bodies.
"""

_ROWS = """
    typedef float four __attribute__((vector_size(16), aligned(4)));
    typedef float eight __attribute__((vector_size(32), aligned(4)));
    struct Row {
        eight a;
        four b;
        static Row of(four n0, four n1, four n2) { return {__builtin_shufflevector(n0, n1, 0, 1, 2, 3, 4, 5, 6, 7), n2}; }
        static Row load(const void* nodes) {
            return {*static_cast<const eight*>(nodes), *reinterpret_cast<const four*>(static_cast<const float*>(nodes) + 8)};
        }
        void store(void* nodes) const {
            *static_cast<eight*>(nodes) = a;
            *reinterpret_cast<four*>(static_cast<float*>(nodes) + 8) = b;
        }
        Row operator+(Row o) const { return {a + o.a, b + o.b}; }
        Row operator*(Row o) const { return {a * o.a, b * o.b}; }
        Row operator*(float w) const { return {a * w, b * w}; }
        four sum() const {
            return __builtin_shufflevector(a, a, 0, 1, 2, 3) + __builtin_shufflevector(a, a, 4, 5, 6, 7) + b;
        }
    };
    const auto each = [](float n0, float n1, float n2) {
        return Row::of(four{n0, n0, n0, n0}, four{n1, n1, n1, n1}, four{n2, n2, n2, n2});
    };
"""
"""Row: the four numbers of three neighbouring nodes."""

ARRANGE = """
#if defined(__CUDA_ARCH__)
    if (__activemask() != 0xffffffffu) return 0;
    const int lane = threadIdx.x & 31;
    int key = (node << 5) | lane;
    #pragma unroll
    for (int k = 2; k <= 32; k *= 2)
        #pragma unroll
        for (int j = k / 2; j > 0; j /= 2) {
            const int other = __shfl_xor_sync(0xffffffffu, key, j);
            key = ((lane & j) == 0) == ((lane & k) == 0) ? min(key, other) : max(key, other);
        }
    return (key & 31) - lane;
#else
    return 0;
#endif
"""
"""Sort the particles of a warp by node (bitonic sort); returns the offset to the particle that this lane takes."""

RUN = """
#if defined(__CUDA_ARCH__)
    const unsigned active = __activemask();
    const int lane = threadIdx.x & 31;
    const int before = __shfl_up_sync(active, node, 1);
    const bool head = lane == 0 || before != node || !((active >> (lane - 1)) & 1u);
    const unsigned above = __ballot_sync(active, head) & ~((2u << lane) - 1u);
    const int last = above ? __ffs(above) - 2 : 31 - __clz(active);
    const int left = last - lane;
    const int longest = __reduce_max_sync(active, left);
    return left | (longest << 8) | (head ? 1 << 16 : 0);
#else
    return 1 << 16;
#endif
"""
"""Describe the run of neighbouring lanes with the same node.

Returns the number of lanes left in this lane's run, the largest such number in the warp, and a flag for the first lane of a run.
"""

_ADD = """
    const unsigned active = __activemask();
    const int left = run & 255, longest = (run >> 8) & 255;
    const auto add = [&](int at, float a, float b, float c, float d) {
        float v[4] = {a, b, c, d};
        for (int e = 1; e <= longest; e *= 2) {
            #pragma unroll
            for (int k = 0; k < 4; ++k) {
                const float u = __shfl_down_sync(active, v[k], e);
                if (e <= left) v[k] += u;
            }
        }
        if (run >> 16) {
        #if __CUDA_ARCH__ >= 900
            atomicAdd(reinterpret_cast<float4*>(&grid.data[at]), make_float4(v[0], v[1], v[2], v[3]));
        #else
            for (int k = 0; k < 4; ++k) atomicAdd(&grid.data[at].c[k], v[k]);
        #endif
        }
    };
"""
"""Sum over a run of lanes with the same node, then add the sum to the node once, by the first lane of the run."""

SPREAD = f"""
#if defined(__CUDA_ARCH__)
    {_ADD}
    auto bi = b;
    #pragma unroll
    for (int i = 0; i < 3; ++i) {{
        auto bj = bi;
        #pragma unroll
        for (int j = 0; j < 3; ++j) {{
            auto bk = bj;
            const float wij = wx[i] * wy[j];
            const int row = node + (i * ny + j) * nz;
            #pragma unroll
            for (int k = 0; k < 3; ++k) {{
                const float w = wij * wz[k];
                add(row + k, w * bk[0], w * bk[1], w * bk[2], w * mass);
                bk = bk + az;
            }}
            bj = bj + ay;
        }}
        bi = bi + ax;
    }}
#else
    {_ROWS}
    const Row w = each(wz[0], wz[1], wz[2]);
    const four first = {{b[0], b[1], b[2], mass}}, dz = {{az[0], az[1], az[2]}};
    Row bi = w * Row::of(first, first + dz, first + 2.0f * dz);
    const four dx = {{ax[0], ax[1], ax[2]}}, dy = {{ay[0], ay[1], ay[2]}};
    const Row along_x = w * Row::of(dx, dx, dx), along_y = w * Row::of(dy, dy, dy);
    #pragma unroll
    for (int i = 0; i < 3; ++i) {{
        Row bj = bi;
        #pragma unroll
        for (int j = 0; j < 3; ++j) {{
            auto* const nodes = &grid.data[node + (i * ny + j) * nz];
            (Row::load(nodes) + bj * (wx[i] * wy[j])).store(nodes);
            bj = bj + along_y;
        }}
        bi = bi + along_x;
    }}
#endif
"""
"""Add momentum and mass of a particle to its 27 nodes; the momentum at the first node is b, and grows by ax, ay, az per node."""

SPREAD_ADJOINT = f"""
    wp::mat_t<5, 4, float> out = {{}};
#if defined(__CUDA_ARCH__)
    #pragma unroll
    for (int i = 0; i < 3; ++i)
        #pragma unroll
        for (int j = 0; j < 3; ++j) {{
            const int row = node + (i * ny + j) * nz;
            float t[4] = {{}}, tz[4] = {{}}, p = 0.0f, pz = 0.0f;
            #pragma unroll
            for (int k = 0; k < 3; ++k) {{
                const auto& g = grid.data[row + k];
                float phi = g[3] * mass;
                #pragma unroll
                for (int c = 0; c < 3; ++c) phi += g[c] * (b[c] + i * ax[c] + j * ay[c] + k * az[c]);
                #pragma unroll
                for (int c = 0; c < 4; ++c) {{
                    t[c] += wz[k] * g[c];
                    if (k) tz[c] += (k * wz[k]) * g[c];
                }}
                p += wz[k] * phi;
                pz += gz[k] * phi;
            }}
            const float w = wx[i] * wy[j];
            #pragma unroll
            for (int c = 0; c < 4; ++c) {{
                out.data[0][c] += w * t[c];
                if (i) out.data[1][c] += (i * w) * t[c];
                if (j) out.data[2][c] += (j * w) * t[c];
                out.data[3][c] += w * tz[c];
            }}
            out.data[4][0] += (gx[i] * wy[j]) * p;
            out.data[4][1] += (wx[i] * gy[j]) * p;
            out.data[4][2] += w * pz;
        }}
#else
    {_ROWS}
    const Row wk = each(wz[0], wz[1], wz[2]), ik = each(0.0f, wz[1], 2.0f * wz[2]), gk = each(gz[0], gz[1], gz[2]);
    const four start = {{b[0], b[1], b[2], mass}}, dz = {{az[0], az[1], az[2]}};
    const four dx = {{ax[0], ax[1], ax[2]}}, dy = {{ay[0], ay[1], ay[2]}};
    const Row along_x = Row::of(dx, dx, dx), along_y = Row::of(dy, dy, dy);
    Row bi = Row::of(start, start + dz, start + 2.0f * dz);
    Row s0 = {{}}, sx = {{}}, sy = {{}}, px = {{}}, py = {{}}, pz = {{}};
    #pragma unroll
    for (int i = 0; i < 3; ++i) {{
        Row bj = bi, u = {{}}, uy = {{}}, p = {{}}, q = {{}};
        #pragma unroll
        for (int j = 0; j < 3; ++j) {{
            const Row g = Row::load(&grid.data[node + (i * ny + j) * nz]), phi = g * bj;
            u = u + g * wy[j];
            if (j) uy = uy + g * (j * wy[j]);
            p = p + phi * wy[j];
            q = q + phi * gy[j];
            bj = bj + along_y;
        }}
        s0 = s0 + u * wx[i];
        if (i) sx = sx + u * (i * wx[i]);
        sy = sy + uy * wx[i];
        px = px + p * gx[i];
        py = py + q * wx[i];
        pz = pz + p * wx[i];
        bi = bi + along_x;
    }}
    const four sums[4] = {{(s0 * wk).sum(), (sx * wk).sum(), (sy * wk).sum(), (s0 * ik).sum()}};
    const four slopes[3] = {{(px * wk).sum(), (py * wk).sum(), (pz * gk).sum()}};
    for (int r = 0; r < 4; ++r)
        for (int c = 0; c < 4; ++c) out.data[r][c] = sums[r][c];
    for (int c = 0; c < 3; ++c) out.data[4][c] = slopes[c][0] + slopes[c][1] + slopes[c][2] + slopes[c][3];
#endif
    return out;
"""
"""Return weighted sums over a particle's 27 nodes, (5, 4): those of `GATHER`, of four numbers, then the one of `GATHER_ADJOINT`."""

GATHER = f"""
    wp::mat_t<4, 3, float> out;
#if defined(__CUDA_ARCH__)
    typedef wp::vec_t<3, float> lanes;
    const auto at = [&](int n) {{ return lanes(velocity.data[n][0], velocity.data[n][1], velocity.data[n][2]); }};
    lanes v = {{}}, vx = {{}}, vy = {{}}, vz = {{}};
    #pragma unroll
    for (int i = 0; i < 3; ++i) {{
        lanes u = {{}}, uy = {{}}, uz = {{}};
        #pragma unroll
        for (int j = 0; j < 3; ++j) {{
            const int row = node + (i * ny + j) * nz;
            const lanes u0 = at(row), u1 = at(row + 1), u2 = at(row + 2);
            const lanes uj = wz[0] * u0 + wz[1] * u1 + wz[2] * u2;
            u += wy[j] * uj;
            if (j) uy += (j * wy[j]) * uj;
            uz += wy[j] * (wz[1] * u1 + (2.0f * wz[2]) * u2);
        }}
        v += wx[i] * u;
        if (i) vx += (i * wx[i]) * u;
        vy += wx[i] * uy;
        vz += wx[i] * uz;
    }}
#else
    {_ROWS}
    Row s0 = {{}}, sx = {{}}, sy = {{}};
    #pragma unroll
    for (int i = 0; i < 3; ++i) {{
        Row u = {{}}, uy = {{}};
        #pragma unroll
        for (int j = 0; j < 3; ++j) {{
            const Row g = Row::load(&velocity.data[node + (i * ny + j) * nz]);
            u = u + g * wy[j];
            if (j) uy = uy + g * (j * wy[j]);
        }}
        s0 = s0 + u * wx[i];
        if (i) sx = sx + u * (i * wx[i]);
        sy = sy + uy * wx[i];
    }}
    const Row w = each(wz[0], wz[1], wz[2]), iw = each(0.0f, wz[1], 2.0f * wz[2]);
    const four v = (s0 * w).sum(), vx = (sx * w).sum(), vy = (sy * w).sum(), vz = (s0 * iw).sum();
#endif
    #pragma unroll
    for (int c = 0; c < 3; ++c) {{
        out.data[0][c] = v[c];
        out.data[1][c] = vx[c];
        out.data[2][c] = vy[c];
        out.data[3][c] = vz[c];
    }}
    return out;
"""
"""Return weighted sums over a particle's 27 nodes, (4, 3): of the velocities, and of these times the node's number along x, y and z."""

GATHER_ADJOINT = f"""
    float slope[3] = {{}};
#if defined(__CUDA_ARCH__)
    {_ADD}
    #pragma unroll
    for (int i = 0; i < 3; ++i)
        #pragma unroll
        for (int j = 0; j < 3; ++j) {{
            const float w = wx[i] * wy[j];
            const int row = node + (i * ny + j) * nz;
            float p = 0.0f, pz = 0.0f;
            #pragma unroll
            for (int k = 0; k < 3; ++k) {{
                float q[3], phi = 0.0f;
                #pragma unroll
                for (int c = 0; c < 3; ++c) {{
                    q[c] = b[c] + i * ax[c] + j * ay[c] + k * az[c];
                    phi += q[c] * velocity.data[row + k][c];
                }}
                p += wz[k] * phi;
                pz += gz[k] * phi;
                add(row + k, w * wz[k] * q[0], w * wz[k] * q[1], w * wz[k] * q[2], 0.0f);
            }}
            slope[0] += (gx[i] * wy[j]) * p;
            slope[1] += (wx[i] * gy[j]) * p;
            slope[2] += w * pz;
        }}
#else
    {_ROWS}
    const Row wk = each(wz[0], wz[1], wz[2]), gk = each(gz[0], gz[1], gz[2]);
    const four start = {{b[0], b[1], b[2]}}, dz = {{az[0], az[1], az[2]}};
    const four dx = {{ax[0], ax[1], ax[2]}}, dy = {{ay[0], ay[1], ay[2]}};
    const Row along_x = Row::of(dx, dx, dx), along_y = Row::of(dy, dy, dy);
    Row bi = Row::of(start, start + dz, start + 2.0f * dz), px = {{}}, py = {{}}, pz = {{}};
    #pragma unroll
    for (int i = 0; i < 3; ++i) {{
        Row bj = bi, p = {{}}, q = {{}};
        #pragma unroll
        for (int j = 0; j < 3; ++j) {{
            const int row = node + (i * ny + j) * nz;
            const Row phi = Row::load(&velocity.data[row]) * bj;
            p = p + phi * wy[j];
            q = q + phi * gy[j];
            (Row::load(&grid.data[row]) + bj * wk * (wx[i] * wy[j])).store(&grid.data[row]);
            bj = bj + along_y;
        }}
        px = px + p * gx[i];
        py = py + q * wx[i];
        pz = pz + p * wx[i];
        bi = bi + along_x;
    }}
    const four sums[3] = {{(px * wk).sum(), (py * wk).sum(), (pz * gk).sum()}};
    for (int c = 0; c < 3; ++c) slope[c] = sums[c][0] + sums[c][1] + sums[c][2];
#endif
    return wp::vec_t<3, float>(slope[0], slope[1], slope[2]);
"""
"""Add the vector b, which grows by ax, ay, az per node, to the 27 nodes of `grid`; return its products with the velocities, by slopes.

The component along an axis is the sum of the products with the weights of that axis replaced by their slopes.
"""
