#version 460
#extension GL_KHR_cooperative_matrix : require
#extension GL_KHR_memory_scope_semantics : require
#extension GL_EXT_shader_explicit_arithmetic_types_float16 : require
#define LOCAL_SIZE 128
#include "lib/prelude.glsl"
// field_gradient by cooperative matrices, as far as s: TILE_N points per workgroup, one tile of neurons after the other. a = W₁ᵀ s is left to
// `linear`, and g to field_gradient itself.
#include "lib/hash_grid.glsl"
#include "lib/field.glsl"

const bool A_IS_COLUMN_MAJOR = false, B_IS_COLUMN_MAJOR = false;
#include "lib/cooperative.glsl"

layout(push_constant, scalar) uniform Args {
    Levels levels;
    U32s table;
    F32s hidden_weight;  // [HIDDEN, INPUTS]
    F32s hidden_bias;    // [HIDDEN]
    F32s head_weight;    // [HIDDEN]
    F32s points;
    F32s inputs;         // [INPUTS, n] z, as field_forward left them
    F32s derivatives;
    F32sMut steepness;   // [HIDDEN, end - begin] s
    F32sMut slopes;
    F32sMut gradient;
    uint n;
    uint begin;          // the points of this launch
    uint end;
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

float take(uint m, uint p, float value) {
    uint neuron = first_neuron + m, point = first_point() + p;
    if (neuron >= HIDDEN || point >= end) return 0.0;
    float u = value + (BIAS != 0u ? hidden_bias.at[neuron] : 0.0);
    steepness.at[neuron * (end - begin) + point - begin] = activation_derivative(u) * head_weight.at[neuron];
    return 0.0;
}

void main() {
    if (first_point() >= end) return;
    for (first_neuron = 0u; first_neuron < HIDDEN; first_neuron += TILE_M) multiply(0u, INPUTS);
}
