#version 460
#extension GL_KHR_cooperative_matrix : require
#extension GL_KHR_memory_scope_semantics : require
#extension GL_EXT_shader_explicit_arithmetic_types_float16 : require
#define LOCAL_SIZE 128
#include "lib/prelude.glsl"
// weight_gradient by cooperative matrices: a tile of outputs times a tile of inputs (the slice) over a chunk of samples per workgroup.
#include "lib/sums.glsl"

layout(constant_id = 0) const uint INPUTS = 64;
layout(constant_id = 1) const uint OUTPUTS = 64;
layout(constant_id = 2) const uint BIAS = 1;
const bool A_IS_COLUMN_MAJOR = false, B_IS_COLUMN_MAJOR = true;
#include "lib/cooperative.glsl"

layout(push_constant, scalar) uniform Args {
    F32s x;            // [INPUTS, stride_x]
    F32s d_y;          // [OUTPUTS, stride_d_y]
    SumsMut d_weight;  // [OUTPUTS, INPUTS] accumulated
    SumsMut d_bias;    // [OUTPUTS] accumulated
    uint n;
    uint stride_x;     // at least n
    uint stride_d_y;
    uint chunk;        // samples per workgroup, a multiple of TILE_K
};

const uint TILES = (INPUTS + TILE_N - 1u) / TILE_N;

uint first_output() { return slice() / TILES * TILE_M; }

uint first_input() { return slice() % TILES * TILE_N; }

float a_at(uint m, uint s) {
    uint o = first_output() + m;
    return o < OUTPUTS && s < n ? d_y.at[o * stride_d_y + s] : 0.0;
}

float b_at(uint s, uint input_) {
    uint i = first_input() + input_;
    return i < INPUTS && s < n ? x.at[i * stride_x + s] : 0.0;
}

float take(uint m, uint input_, float value) {
    uint o = first_output() + m, i = first_input() + input_;
    if (o < OUTPUTS && i < INPUTS) add(d_weight, o * INPUTS + i, value);
    return 0.0;
}

void main() {
    uint first = group() * chunk, end = min(first + chunk, n);
    if (first >= n) return;
    multiply(first, end);
    if (BIAS == 0u || first_input() != 0u) return;
    uint end_output = min(first_output() + TILE_M, OUTPUTS);
    for (uint o = first_output() + gl_SubgroupID; o < end_output; o += SUBGROUPS) {
        float bias = 0.0;
        for (uint s = first + gl_SubgroupInvocationID; s < end; s += SUBGROUP) bias += d_y.at[o * stride_d_y + s];
        bias = subgroupAdd(bias);
        if (subgroupElect()) add(d_bias, o, bias);
    }
}
