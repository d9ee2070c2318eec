"""Native source of the sums between particles and grid, for float32.

On a GPU the sums run over the particles of a warp, on the CPU over the four lanes of a vector register. `transfers.build` uses these bodies
of Warp functions in P2G, in G2P and in the adjoint of G2P.
"""

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

ADD4 = f"""
#if defined(__CUDA_ARCH__)
    {_ADD}
    add(node, value[0], value[1], value[2], value[3]);
#else
    for (int c = 0; c < 4; ++c) grid.data[node].c[c] += value[c];
#endif
"""
"""Add four numbers to a node."""

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
    typedef float lanes __attribute__((vector_size(16), aligned(4)));
    const lanes dx = {{ax[0], ax[1], ax[2]}}, dy = {{ay[0], ay[1], ay[2]}}, dz = {{az[0], az[1], az[2]}};
    lanes bi = {{b[0], b[1], b[2], mass}};
    for (int i = 0; i < 3; ++i, bi += dx) {{
        lanes bj = bi;
        for (int j = 0; j < 3; ++j, bj += dy) {{
            lanes* row = reinterpret_cast<lanes*>(&grid.data[node + (i * ny + j) * nz]);
            const float wij = wx[i] * wy[j];
            row[0] += (wij * wz[0]) * bj;
            row[1] += (wij * wz[1]) * (bj + dz);
            row[2] += (wij * wz[2]) * (bj + 2.0f * dz);
        }}
    }}
#endif
"""
"""Add momentum and mass of a particle to its 27 nodes; the momentum at the first node is b, and grows by ax, ay, az per node."""

GATHER = """
#if defined(__CUDA_ARCH__)
    typedef wp::vec_t<3, float> lanes;
    #define LANES(n) lanes(velocity.data[n][0], velocity.data[n][1], velocity.data[n][2])
#else
    typedef float lanes __attribute__((vector_size(16), aligned(4)));
    #define LANES(n) (*reinterpret_cast<const lanes*>(&velocity.data[n]))
#endif
    lanes v = {}, vx = {}, vy = {}, vz = {};
    #pragma unroll
    for (int i = 0; i < 3; ++i) {
        lanes u = {}, uy = {}, uz = {};
        #pragma unroll
        for (int j = 0; j < 3; ++j) {
            const int row = node + (i * ny + j) * nz;
            const lanes u0 = LANES(row), u1 = LANES(row + 1), u2 = LANES(row + 2);
            const lanes uj = wz[0] * u0 + wz[1] * u1 + wz[2] * u2;
            u += wy[j] * uj;
            if (j) uy += (j * wy[j]) * uj;
            uz += wy[j] * (wz[1] * u1 + (2.0f * wz[2]) * u2);
        }
        v += wx[i] * u;
        if (i) vx += (i * wx[i]) * u;
        vy += wx[i] * uy;
        vz += wx[i] * uz;
    }
    #undef LANES
    wp::mat_t<4, 3, float> out;
    #pragma unroll
    for (int c = 0; c < 3; ++c) {
        out.data[0][c] = v[c];
        out.data[1][c] = vx[c];
        out.data[2][c] = vy[c];
        out.data[3][c] = vz[c];
    }
    return out;
"""
"""Return weighted sums over a particle's 27 nodes, (4, 3): of the velocities, and of these times the node's number along x, y and z."""
