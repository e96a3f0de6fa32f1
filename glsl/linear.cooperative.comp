#version 460
#extension GL_KHR_cooperative_matrix : require
#extension GL_KHR_memory_scope_semantics : require
#extension GL_EXT_shader_explicit_arithmetic_types_float16 : require
#define LOCAL_SIZE 128
#include "lib/prelude.glsl"
// linear by cooperative matrices: a tile of output channels times a tile of samples per workgroup; those of the same samples are neighbours.

layout(constant_id = 0) const uint INPUTS = 64;
layout(constant_id = 1) const uint OUTPUTS = 64;
layout(constant_id = 2) const uint WEIGHT_COLUMNS = 64;
layout(constant_id = 3) const uint TRANSPOSED = 0;
layout(constant_id = 4) const uint BIAS = 1;
layout(constant_id = 5) const uint ACTIVATION = 0;
layout(constant_id = 6) const uint GATED = 0;
const bool A_IS_COLUMN_MAJOR = TRANSPOSED != 0u, B_IS_COLUMN_MAJOR = false;
#include "lib/cooperative.glsl"
#include "lib/linear.glsl"

layout(push_constant, scalar) uniform Args {
    F32s x;         // [INPUTS, stride_x]
    F32s weight;    // forward [OUTPUTS, WEIGHT_COLUMNS], transposed [INPUTS, WEIGHT_COLUMNS]
    F32s bias;      // [OUTPUTS]
    F32s gate;      // [OUTPUTS, stride_y] post-ReLU values
    F32sMut y;      // [OUTPUTS, stride_y]
    uint n;
    uint stride_x;
    uint stride_y;
};

const uint PARTS = (OUTPUTS + TILE_M - 1u) / TILE_M;

uint first_output() { return group() % PARTS * TILE_M; }

uint first_sample() { return group() / PARTS * TILE_N; }

float a_at(uint m, uint k) {
    uint o = first_output() + m;
    return o < OUTPUTS && k < INPUTS ? weight.at[weight_index(o, k)] : 0.0;
}

float b_at(uint k, uint s) {
    uint sample_ = first_sample() + s;
    return k < INPUTS && sample_ < n ? x.at[k * stride_x + sample_] : 0.0;
}

float take(uint m, uint s, float value) {
    uint o = first_output() + m, sample_ = first_sample() + s;
    if (o >= OUTPUTS || sample_ >= n) return 0.0;
    uint at = o * stride_y + sample_;
    if (BIAS != 0u) value += bias.at[o];
    if (GATED != 0u && !(gate.at[at] > 0.0)) value = 0.0;
    y.at[at] = activated(value);
    return 0.0;
}

void main() {
    if (first_sample() < n) multiply(0u, INPUTS);
}
