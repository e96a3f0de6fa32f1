#version 460
// Weight and bias gradients of a layer: d_W[o, i] += Σ_n d_Y[o, n] X[i, n],  d_b[o] += Σ_n d_Y[o, n].
// An invocation has one output and TILE inputs, sums `chunk` samples in registers and touches memory once per entry. All lanes ask for
// the same x, so that it costs one load for all of them. Slices are blocks of outputs × tiles of inputs; workgroups along x are chunks.
#include "lib/prelude.glsl"
#include "lib/sums.glsl"

layout(constant_id = 0) const uint INPUTS = 64;
layout(constant_id = 1) const uint OUTPUTS = 64;
layout(constant_id = 2) const uint BIAS = 1;
layout(constant_id = 3) const uint TILE = 32;
const uint SAMPLES = 16u;  // per turn of the loop: a cache line of every row, since rows a power of two apart keep each other out of caches
const uint TILES = (INPUTS + TILE - 1u) / TILE;

layout(push_constant, scalar) uniform Args {
    F32s x;            // [INPUTS, n]
    F32s d_y;          // [OUTPUTS, n]
    SumsMut d_weight;  // [OUTPUTS, INPUTS] accumulated
    SumsMut d_bias;    // [OUTPUTS] accumulated
    uint n;
    uint stride_x;     // samples between channels of x (x may be the front part of a longer buffer)
    uint chunk;        // samples per workgroup
};

// What `count` samples from s0 on add to the weights of output o from input i0 on.
void add_products(inout float sum[TILE], inout float bias, uint o, uint i0, uint s0, const uint count) {
    float d[SAMPLES];
    [[unroll]] for (uint k = 0u; k < count; ++k) {
        d[k] = d_y.at[o * n + s0 + k];
        bias += d[k];
    }
    [[unroll]] for (uint t = 0u; t < TILE; ++t) {
        F32s samples = from(x, min(i0 + t, INPUTS - 1u) * stride_x + s0);
        [[unroll]] for (uint k = 0u; k < count; ++k) sum[t] = fma(d[k], samples.at[k], sum[t]);
    }
}

void main() {
    uint o = slice() / TILES * gl_WorkGroupSize.x + gl_LocalInvocationID.x;
    uint i0 = slice() % TILES * TILE;
    if (o >= OUTPUTS) return;
    uint s0 = group() * chunk;
    uint end = min(s0 + chunk, n);

    float sum[TILE];
    [[unroll]] for (uint t = 0u; t < TILE; ++t) sum[t] = 0.0;
    float bias = 0.0;
    for (; s0 + SAMPLES <= end; s0 += SAMPLES) add_products(sum, bias, o, i0, s0, SAMPLES);
    for (; s0 < end; ++s0) add_products(sum, bias, o, i0, s0, 1u);
    [[unroll]] for (uint t = 0u; t < TILE; ++t) {
        if (i0 + t < INPUTS) add(d_weight, o * INPUTS + i0 + t, sum[t]);
    }
    if (BIAS != 0u && i0 == 0u) add(d_bias, o, bias);
}
