#version 460
#extension GL_KHR_cooperative_matrix : require
#extension GL_KHR_memory_scope_semantics : require
#extension GL_EXT_shader_explicit_arithmetic_types_float16 : require
#define LOCAL_SIZE 128
#include "lib/prelude.glsl"
// The network of field_forward, its PART 2, by cooperative matrices: TILE_N points per workgroup, one tile of neurons after the other.
#include "lib/hash_grid.glsl"
#include "lib/field.glsl"

layout(constant_id = 7) const uint HEADS = 1;
const bool A_IS_COLUMN_MAJOR = false, B_IS_COLUMN_MAJOR = false;
#define SUM_COLUMNS
#include "lib/cooperative.glsl"

layout(push_constant, scalar) uniform Args {
    Levels levels;
    U32s table;          // PART 0 and 1 alone
    F32s hidden_weight;  // [HIDDEN, INPUTS]
    F32s hidden_bias;    // [HIDDEN]
    F32s head_weight;    // [HIDDEN]
    F32s head_bias;      // [1]
    F32s points;         // [3, n] region frame
    F32sMut inputs;      // [INPUTS, n] z, kept for the backward pass
    F32sMut hidden;      // [HIDDEN, stride_hidden] h of the first n_hidden points, for further heads
    F32sMut first;       // [n] out
    F32sMut derivatives; // PART 1 alone
    uint n;
    uint n_hidden;
    uint stride_hidden;
    uint begin;          // the points of this launch
    uint end;
    uint points_each;    // PART 1 alone
};

uint first_neuron;

uint first_point() { return begin + group() * TILE_N; }

float a_at(uint m, uint k) {
    uint neuron = first_neuron + m;
    return neuron < HIDDEN && k < INPUTS ? hidden_weight.at[neuron * INPUTS + k] : 0.0;
}

float b_at(uint k, uint p) {
    uint point = first_point() + p;
    return k < INPUTS && point < end ? inputs.at[k * n + point] : 0.0;
}

// A neuron's part of the output.
float take(uint m, uint p, float value) {
    uint neuron = first_neuron + m, point = first_point() + p;
    if (neuron >= HIDDEN || point >= end) return 0.0;
    float h = activation(value + (BIAS != 0u ? hidden_bias.at[neuron] : 0.0));
    if (HEADS != 0u && point < n_hidden) hidden.at[neuron * stride_hidden + point] = h;
    return head_weight.at[neuron] * h;
}

void main() {
    if (first_point() >= end) return;
    uint lane = gl_LocalInvocationID.x;
    for (uint i = lane; i < SUBGROUPS * TILE_N; i += LOCAL_SIZE) column_sums[i] = 0.0;
    for (first_neuron = 0u; first_neuron < HIDDEN; first_neuron += TILE_M) multiply(0u, INPUTS);
    barrier();
    uint point = first_point() + lane;
    if (lane >= TILE_N || point >= end) return;
    float sum = BIAS != 0u ? head_bias.at[0] : 0.0;
    for (uint s = 0u; s < SUBGROUPS; ++s) sum += column_sums[s * TILE_N + lane];
    first.at[point] = sum;
}
