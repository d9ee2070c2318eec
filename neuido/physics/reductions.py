"""CUDA source of the sums that particles of a warp make before they add to the grid; on the CPU plain additions.

Bodies of Warp functions, for float32: `kernels.build` uses them in the scatter of P2G and of the adjoint of G2P.
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
"""Which particle of the warp a lane takes, as an offset, so that those with the same node are neighbours (bitonic sort)."""

RUN = """
#if defined(__CUDA_ARCH__)
    const unsigned active = __activemask();
    const int lane = threadIdx.x & 31;
    const int before = __shfl_up_sync(active, node, 1);
    const bool head = lane == 0 || before != node || !((active >> (lane - 1)) & 1u);
    const unsigned above = __ballot_sync(active, head) & ~((2u << lane) - 1u);
    const int last = above ? __ffs(above) - 2 : 31 - __clz(active);
    const int left = last - lane;
    const int most = __reduce_max_sync(active, left);
    return left | (most << 8) | (head ? 1 << 16 : 0);
#else
    return 1 << 16;
#endif
"""
"""Lanes left in this lane's run of particles with one and the same node, the longest such in the warp, and the first one's flag."""

ADD4 = """
#if defined(__CUDA_ARCH__)
    const unsigned active = __activemask();
    const int left = run & 255, most = (run >> 8) & 255;
    float v[4] = {value[0], value[1], value[2], value[3]};
    for (int d = 1; d <= most; d *= 2) {
        #pragma unroll
        for (int c = 0; c < 4; ++c) {
            const float u = __shfl_down_sync(active, v[c], d);
            if (d <= left) v[c] += u;
        }
    }
    if (run >> 16) {
    #if __CUDA_ARCH__ >= 900
        atomicAdd(reinterpret_cast<float4*>(&grid.data[node]), make_float4(v[0], v[1], v[2], v[3]));
    #else
        for (int c = 0; c < 4; ++c) atomicAdd(&grid.data[node].c[c], v[c]);
    #endif
    }
#else
    for (int c = 0; c < 4; ++c) grid.data[node].c[c] += value[c];
#endif
"""
"""The sum over a run of neighbouring lanes, then one vector reduction by its first: particles are sorted by cell at the start."""
