#version 460
// Weight and bias gradients of a layer: d_W[o, i] += Σ_n d_Y[o, n] X[i, n],  d_b[o] += Σ_n d_Y[o, n].
// A workgroup sums one 8×8 tile of the matrix over `chunk` samples in registers, adds up its lanes and subgroups, and touches memory
// once per entry. The bias is the column of an input that is always 1. The slice is the tile; workgroups along x are the chunks.
#include "lib/prelude.glsl"

layout(constant_id = 0) const uint INPUTS = 64;
layout(constant_id = 1) const uint OUTPUTS = 64;
layout(constant_id = 2) const uint BIAS = 1;
const uint TILE = 8;
const uint LANES_MIN = 4u;

layout(push_constant, scalar) uniform Args {
    F32s x;            // [INPUTS, n]
    F32s d_y;          // [OUTPUTS, n]
    F32sMut d_weight;  // [OUTPUTS, INPUTS] accumulated
    F32sMut d_bias;    // [OUTPUTS] accumulated
    uint n;
    uint stride_x;     // samples between channels of x (x may be the front part of a longer buffer)
    uint chunk;        // samples per workgroup
};

shared float partial[gl_WorkGroupSize.x / LANES_MIN * TILE * TILE];

void main() {
    const uint COLUMN_TILES = (INPUTS + BIAS + TILE - 1u) / TILE;
    uint o0 = slice() / COLUMN_TILES * TILE;
    uint i0 = slice() % COLUMN_TILES * TILE;
    uint first = group() * chunk;
    uint end = min(first + chunk, n);

    float sum[TILE * TILE];
    [[unroll]] for (uint e = 0u; e < TILE * TILE; ++e) sum[e] = 0.0;
    for (uint s = first + gl_LocalInvocationID.x; s < end; s += gl_WorkGroupSize.x) {
        float value[TILE];
        [[unroll]] for (uint i = 0u; i < TILE; ++i) {
            value[i] = x.at[min(i0 + i, INPUTS - 1u) * stride_x + s];
            if (i0 + i >= INPUTS) value[i] = 1.0;
        }
        [[unroll]] for (uint o = 0u; o < TILE; ++o) {
            float d = d_y.at[min(o0 + o, OUTPUTS - 1u) * n + s];
            [[unroll]] for (uint i = 0u; i < TILE; ++i) sum[o * TILE + i] = fma(d, value[i], sum[o * TILE + i]);
        }
    }
    [[unroll]] for (uint e = 0u; e < TILE * TILE; ++e) {
        float lanes = subgroupAdd(sum[e]);
        if (subgroupElect()) partial[gl_SubgroupID * TILE * TILE + e] = lanes;
    }
    barrier();
    for (uint e = gl_LocalInvocationID.x; e < TILE * TILE; e += gl_WorkGroupSize.x) {
        float total = 0.0;
        for (uint s = 0u; s < gl_NumSubgroups; ++s) total += partial[s * TILE * TILE + e];
        uint o = o0 + e / TILE;
        uint i = i0 + e % TILE;
        if (o < OUTPUTS && i < INPUTS) add(d_weight, o * INPUTS + i, total);
        if (BIAS != 0u && o < OUTPUTS && i == INPUTS) add(d_bias, o, total);
    }
}
