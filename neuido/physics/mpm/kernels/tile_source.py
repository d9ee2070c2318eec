"""Native source of the scatter of a warp into its own tile of shared memory, and of 128-bit loads of nodes, for float32.

The 32 particles of a warp are neighbours, so their stencils overlap: the about 100 nodes that they touch get 864 contributions. A warp
adds them up in a tile of shared memory that no other warp uses, and then adds the tile to the grid, one reduction a node. Lanes are sorted
by cell first, and the lanes of a cell summed by shuffles; distinct cells reach distinct nodes at the same place of the stencil, so that the
tile needs no atomics. A warp whose particles are too far apart adds to the grid directly.

On the CPU a particle adds to the grid by itself.
"""

ROLLED, UNROLLED = 1, 9
"""Turns of the loops over nodes that are written out. For a body of 25,000 particles a kernel's time follows the bytes of its code,
since each warp runs it once (0.22 us a KB on an H200); for a million it follows the instructions."""

CAPACITY = 512
"""Nodes of a tile; 8 KB a warp. A warp that begins at the end of one row of cells and ends at the beginning of the next needs about 400."""

LOAD4 = """
#if defined(__CUDA_ARCH__)
    const float4 v = *reinterpret_cast<const float4*>(&a.data[i]);
    return wp::vec_t<4, float>(v.x, v.y, v.z, v.w);
#else
    return a.data[i];
#endif
"""
"""Return element i of an array of four-vectors, by one load."""

GATHER4 = """
#if defined(__CUDA_ARCH__)
    typedef wp::vec_t<3, float> lanes;
    auto at = [&](int n) {
        const float4 u = *reinterpret_cast<const float4*>(&velocity.data[n]);
        return lanes(u.x, u.y, u.z);
    };
    lanes v = {}, vx = {}, vy = {}, vz = {};
    #pragma unroll UNROLL
    for (int i = 0; i < 3; ++i) {
        const float wi = i == 0 ? wx[0] : i == 1 ? wx[1] : wx[2];
        lanes u = {}, uy = {}, uz = {};
        #pragma unroll
        for (int j = 0; j < 3; ++j) {
            const int row = node + (i * ny + j) * nz;
            const lanes u0 = at(row), u1 = at(row + 1), u2 = at(row + 2);
            const lanes uj = wz[0] * u0 + wz[1] * u1 + wz[2] * u2;
            u += wy[j] * uj;
            if (j) uy += (j * wy[j]) * uj;
            uz += wy[j] * (wz[1] * u1 + (2.0f * wz[2]) * u2);
        }
        v += wi * u;
        vx += (i * wi) * u;
        vy += wi * uy;
        vz += wi * uz;
    }
    wp::mat_t<4, 3, float> out;
    #pragma unroll
    for (int c = 0; c < 3; ++c) {
        out.data[0][c] = v[c];
        out.data[1][c] = vx[c];
        out.data[2][c] = vy[c];
        out.data[3][c] = vz[c];
    }
    return out;
#else
    wp::mat_t<4, 3, float> out = {};
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j)
            for (int k = 0; k < 3; ++k) {
                const auto& u = velocity.data[node + (i * ny + j) * nz + k];
                const float w = wx[i] * wy[j] * wz[k];
                for (int c = 0; c < 3; ++c) {
                    out.data[0][c] += w * u[c];
                    out.data[1][c] += (i * w) * u[c];
                    out.data[2][c] += (j * w) * u[c];
                    out.data[3][c] += (k * w) * u[c];
                }
            }
    return out;
#endif
"""
"""Return the weighted sums of `reductions.GATHER`, with one load a node."""

SPREAD_TILE = """
#if defined(__CUDA_ARCH__)
    __shared__ float4 tiles[WP_TILE_BLOCK_DIM / 32][%(capacity)d];
    const unsigned full = 0xffffffffu;
    const int lane = threadIdx.x & 31, none = 0x7fffffff;
    float4* const tile = tiles[threadIdx.x >> 5];
    // the box of all stencils
    const int x0 = __reduce_min_sync(full, live ? nx : none), x1 = __reduce_max_sync(full, live ? nx : -1);
    const int y0 = __reduce_min_sync(full, live ? ny : none), y1 = __reduce_max_sync(full, live ? ny : -1);
    const int z0 = __reduce_min_sync(full, live ? nz : none), z1 = __reduce_max_sync(full, live ? nz : -1);
    if (x1 < 0) return;  // no particle
    const int bx = x1 - x0 + 3, by = y1 - y0 + 3, bz = z1 - z0 + 3;
    const bool fits = bx <= %(capacity)d && by <= %(capacity)d && bz <= %(capacity)d && by * bz <= %(capacity)d
        && bx * by * bz <= %(capacity)d;
    const int count = fits ? bx * by * bz : 0;
    const int step_x = fits ? by * bz : size_y * size_z, step_y = fits ? bz : size_z;
    int own = fits ? ((nx - x0) * by + (ny - y0)) * bz + (nz - z0) : (nx * size_y + ny) * size_z + nz;
    #pragma unroll 1
    for (int t = lane; t < count; t += 32) tile[t] = make_float4(0.0f, 0.0f, 0.0f, 0.0f);
    // sort the lanes by cell (bitonic); lanes without a particle come last
    if (!live) own = -1;
    int key = ((live ? own & 0x3ffffff : 0x3ffffff) << 5) | lane;
    #pragma unroll
    for (int k = 2; k <= 32; k *= 2)
        #pragma unroll
        for (int j = k / 2; j > 0; j /= 2) {
            const int other = __shfl_xor_sync(full, key, j);
            key = ((lane & j) == 0) == ((lane & k) == 0) ? min(key, other) : max(key, other);
        }
    const int from = key & 31;
    own = __shfl_sync(full, own, from);
    const bool here = own >= 0;
    // the particle of the lane that this one takes over
    float wgt[9], first[4], grow[9];
    #pragma unroll
    for (int c = 0; c < 3; ++c) {
        wgt[c] = __shfl_sync(full, wx[c], from);
        wgt[3 + c] = __shfl_sync(full, wy[c], from);
        wgt[6 + c] = __shfl_sync(full, wz[c], from);
        first[c] = __shfl_sync(full, b[c], from);
        grow[c] = __shfl_sync(full, ax[c], from);
        grow[3 + c] = __shfl_sync(full, ay[c], from);
        grow[6 + c] = __shfl_sync(full, az[c], from);
    }
    first[3] = __shfl_sync(full, mass, from);
    if (!here) {
        #pragma unroll
        for (int c = 0; c < 3; ++c) wgt[c] = 0.0f;
        #pragma unroll
        for (int c = 0; c < 4; ++c) first[c] = 0.0f;  // a NaN of a lane without particle must not spread
        #pragma unroll
        for (int c = 0; c < 9; ++c) grow[c] = 0.0f;
    }
    // runs of lanes with the same cell
    const int before = __shfl_up_sync(full, own, 1);
    const bool head = lane == 0 || before != own;
    const unsigned above = __ballot_sync(full, head) & ~((2u << lane) - 1u);
    const int left = (above ? __ffs(above) - 2 : 31) - lane;
    const int longest = __reduce_max_sync(full, here ? left : 0);
    const bool adds = head && here;
    __syncwarp();
    #pragma unroll UNROLL
    for (int ij = 0; ij < 9; ++ij) {
        const int i = ij / 3, j = ij - 3 * i;
        const float wij = (i == 0 ? wgt[0] : i == 1 ? wgt[1] : wgt[2]) * (j == 0 ? wgt[3] : j == 1 ? wgt[4] : wgt[5]);
        const int row = own + i * step_x + j * step_y;
        float q[3];
        #pragma unroll
        for (int c = 0; c < 3; ++c) q[c] = first[c] + i * grow[c] + j * grow[3 + c];
        #pragma unroll UNROLL
        for (int k = 0; k < 3; ++k) {
            const float w = wij * (k == 0 ? wgt[6] : k == 1 ? wgt[7] : wgt[8]);
            float v[4] = {w * q[0], w * q[1], w * q[2], w * first[3]};
            #pragma unroll 1
            for (int e = 1; e <= longest; e *= 2) {
                #pragma unroll
                for (int c = 0; c < 4; ++c) {
                    const float u = __shfl_down_sync(full, v[c], e);
                    if (e <= left) v[c] += u;
                }
            }
            if (fits) {
                if (adds) {
                    float4 sum = tile[row + k];
                    sum.x += v[0]; sum.y += v[1]; sum.z += v[2]; sum.w += v[3];
                    tile[row + k] = sum;
                }
                __syncwarp();
            } else if (adds) {
                const int at = row + k;
                %(add)s
            }
            #pragma unroll
            for (int c = 0; c < 3; ++c) q[c] += grow[6 + c];
        }
    }
    #pragma unroll 1
    for (int t = lane; t < count; t += 32) {
        const float4 sum = tile[t];
        if (sum.x != 0.0f || sum.y != 0.0f || sum.z != 0.0f || sum.w != 0.0f) {
            const int line = t / bz, i = line / by;
            const int at = ((x0 + i) * size_y + y0 + line - i * by) * size_z + z0 + t - line * bz;
            const float v[4] = {sum.x, sum.y, sum.z, sum.w};
            %(flush)s
        }
    }
    __syncwarp();
#else
    if (!live) return;
    typedef float lanes __attribute__((vector_size(16), aligned(4)));
    const lanes dx = {ax[0], ax[1], ax[2]}, dy = {ay[0], ay[1], ay[2]}, dz = {az[0], az[1], az[2]};
    lanes bi = {b[0], b[1], b[2], mass};
    for (int i = 0; i < 3; ++i, bi += dx) {
        lanes bj = bi;
        for (int j = 0; j < 3; ++j, bj += dy) {
            lanes* row = reinterpret_cast<lanes*>(&grid.data[((nx + i) * size_y + ny + j) * size_z + nz]);
            const float wij = wx[i] * wy[j];
            row[0] += (wij * wz[0]) * bj;
            row[1] += (wij * wz[1]) * (bj + dz);
            row[2] += (wij * wz[2]) * (bj + 2.0f * dz);
        }
    }
#endif
"""
_ADD = """
#if __CUDA_ARCH__ >= 900
    atomicAdd(reinterpret_cast<float4*>(&grid.data[AT]), make_float4(v[0], v[1], v[2], v[3]));
#else
    for (int c = 0; c < 4; ++c) atomicAdd(&grid.data[AT].c[c], v[c]);
#endif
"""
SPREAD_TILE = SPREAD_TILE % {"capacity": CAPACITY, "add": _ADD.replace("AT", "at"), "flush": _ADD.replace("AT", "at")}
"""Add the momentum and mass of a warp's particles to their nodes; `live` is 0 for a lane without a particle.

The momentum at the first node (nx, ny, nz) of a particle is b, and grows by ax, ay, az per node. All lanes of the warp must take part.
"""


def unrolled(source: str, turns: int) -> str:
    """Return `GATHER4` or `SPREAD_TILE` with that many turns of its outer loop written out, `ROLLED` or `UNROLLED`."""
    return source.replace("UNROLL", str(turns))
