#version 460
// Weight and bias gradients of a layer: d_W[o, i] += Σ_n d_Y[o, n] X[i, n],  d_b[o] += Σ_n d_Y[o, n].
// A workgroup sums up `chunk` samples in registers and touches memory once per entry; workgroups along x are chunks. Its lanes are outputs,
// all of which ask for the same x, so that it costs one load; or, with ROWS, samples, whose sums each subgroup adds up.
#include "lib/prelude.glsl"
#include "lib/sums.glsl"

layout(constant_id = 0) const uint INPUTS = 64;
layout(constant_id = 1) const uint OUTPUTS = 64;
layout(constant_id = 2) const uint BIAS = 1;
layout(constant_id = 3) const uint TILE = 32;  // inputs per invocation
layout(constant_id = 4) const uint ROWS = 0;   // outputs per invocation, where lanes are samples; they are read in pairs
const uint SAMPLES = 16u;  // per turn of the loop: a cache line of every row, since rows a power of two apart keep each other out of caches
const uint TILES = (INPUTS + TILE - 1u) / TILE;
const uint SUMMED_ROWS = ROWS != 0u ? ROWS : 1u;  // no array is empty
const uint SUMS = SUMMED_ROWS * TILE;

layout(push_constant, scalar) uniform Args {
    F32s x;            // [INPUTS, stride_x]
    F32s d_y;          // [OUTPUTS, stride_d_y]
    SumsMut d_weight;  // [OUTPUTS, INPUTS] accumulated
    SumsMut d_bias;    // [OUTPUTS] accumulated
    uint n;
    uint stride_x;     // at least n
    uint stride_d_y;
    uint chunk;        // samples per workgroup
};

// What `count` samples from s0 on add to the weights of output o from input i0 on.
void add_products(inout float sum[TILE], inout float bias, uint o, uint i0, uint s0, const uint count) {
    float d[SAMPLES];
    [[unroll]] for (uint k = 0u; k < count; ++k) {
        d[k] = d_y.at[o * stride_d_y + s0 + k];
        bias += d[k];
    }
    [[unroll]] for (uint t = 0u; t < TILE; ++t) {
        F32s samples = from(x, min(i0 + t, INPUTS - 1u) * stride_x + s0);
        [[unroll]] for (uint k = 0u; k < count; ++k) sum[t] = fma(d[k], samples.at[k], sum[t]);
    }
}

// Slices are blocks of outputs × tiles of inputs.
void outputs_as_lanes(uint i0, uint s0, uint end) {
    uint o = slice() / TILES * gl_WorkGroupSize.x + gl_LocalInvocationID.x;
    if (o >= OUTPUTS) return;
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

// Adds the subgroup's sums to the weights of ROWS outputs from o0 on; a lane for each, so that one access adds as many as there are lanes.
void add_up(const float sum[SUMS], uint o0, uint i0) {
    float of_lane = 0.0;
    [[unroll]] for (uint k = 0u; k < SUMS; ++k) {
        float total = subgroupAdd(sum[k]);
        uint lane = k % gl_SubgroupSize;
        if (gl_SubgroupInvocationID == lane) of_lane = total;
        if (lane == gl_SubgroupSize - 1u || k == SUMS - 1u) {
            uint mine = k - lane + gl_SubgroupInvocationID;
            uint o = o0 + mine / TILE, i = i0 + mine % TILE;
            if (mine <= k && o < OUTPUTS && i < INPUTS) add(d_weight, o * INPUTS + i, of_lane);
        }
    }
}

// Slices are blocks of ROWS outputs × tiles of inputs.
void samples_as_lanes(uint i0, uint s0, uint end) {
    uint o0 = slice() / TILES * ROWS;
    float sum[SUMS];
    [[unroll]] for (uint k = 0u; k < SUMS; ++k) sum[k] = 0.0;
    float bias[SUMMED_ROWS];
    [[unroll]] for (uint r = 0u; r < ROWS; ++r) bias[r] = 0.0;
    for (uint s = s0 + 2u * gl_LocalInvocationID.x; s < end; s += 2u * gl_WorkGroupSize.x) {
        vec2 d[SUMMED_ROWS];
        [[unroll]] for (uint r = 0u; r < ROWS; ++r) {
            d[r] = pair_at(d_y, min(o0 + r, OUTPUTS - 1u) * stride_d_y + s);
            bias[r] += d[r].x + d[r].y;
        }
        [[unroll]] for (uint t = 0u; t < TILE; ++t) {
            vec2 value = pair_at(x, min(i0 + t, INPUTS - 1u) * stride_x + s);
            [[unroll]] for (uint r = 0u; r < ROWS; ++r)
                sum[r * TILE + t] = fma(d[r].x, value.x, fma(d[r].y, value.y, sum[r * TILE + t]));
        }
    }
    add_up(sum, o0, i0);
    if (BIAS != 0u && i0 == 0u) {
        [[unroll]] for (uint r = 0u; r < ROWS; ++r) {
            float total = subgroupAdd(bias[r]);
            if (subgroupElect() && o0 + r < OUTPUTS) add(d_bias, o0 + r, total);
        }
    }
}

void main() {
    uint i0 = slice() % TILES * TILE;
    uint s0 = group() * chunk;
    uint end = min(s0 + chunk, n);
    if (ROWS == 0u) outputs_as_lanes(i0, s0, end);
    else samples_as_lanes(i0, s0, end);
}
