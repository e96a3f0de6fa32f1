#version 460
#extension GL_KHR_cooperative_matrix : require
#extension GL_KHR_memory_scope_semantics : require
#extension GL_EXT_shader_explicit_arithmetic_types_float16 : require
#define LOCAL_SIZE 128
#include "lib/prelude.glsl"
// field_backward by cooperative matrices, as far as d_u: TILE_N points per workgroup, one tile of neurons after the other. d_z = W₁ᵀ d_u is
// left to `linear`, for all inputs.
#include "lib/sums.glsl"
#include "lib/field.glsl"

layout(constant_id = 7) const uint HEADS = 1;
layout(constant_id = 8) const uint SECOND_ORDER = 0;
const bool A_IS_COLUMN_MAJOR = false, B_IS_COLUMN_MAJOR = false;
#define SUM_ROWS
#include "lib/cooperative.glsl"

layout(push_constant, scalar) uniform Args {
    F32s hidden_weight;      // [HIDDEN, INPUTS]
    F32s hidden_bias;        // [HIDDEN]
    F32s head_weight;        // [HIDDEN]
    F32s inputs;             // [INPUTS, n]
    F32s tangents;           // [INPUTS, m] ȧ, with SECOND_ORDER
    F32s d_first;            // [n]
    F32s d_hidden;           // [HIDDEN, stride_hidden] from the other heads
    F32sMut d_preactivation; // [HIDDEN, m] d_u
    F32sMut steepness;       // [HIDDEN, m] s, with SECOND_ORDER
    F32sMut d_inputs;        // [INPUTS, m] d_z; without SECOND_ORDER [LEVELS * FEATURES, m] d_e
    SumsMut d_head_weight;   // [HIDDEN] accumulated
    SumsMut d_head_bias;     // [1] accumulated
    uint n;
    uint n_hidden;
    uint stride_hidden;
    uint begin;              // the points of this launch
    uint end;
    uint first;              // of the m points for which there is scratch memory
    uint m;
};

uint first_neuron;
bool is_tangent;  // W₁ times ȧ rather than z

uint first_point() { return begin + group() * TILE_N; }

float a_at(uint i, uint k) {
    uint neuron = first_neuron + i;
    return neuron < HIDDEN && k < INPUTS ? hidden_weight.at[neuron * INPUTS + k] : 0.0;
}

float b_at(uint k, uint p) {
    uint point = first_point() + p;
    if (k >= INPUTS || point >= end) return 0.0;
    return is_tangent ? tangents.at[k * m + point - first] : inputs.at[k * n + point];
}

// A point's part of d_w₂.
float take(uint i, uint p, float value) {
    uint neuron = first_neuron + i, point = first_point() + p;
    if (neuron >= HIDDEN || point >= end) return 0.0;
    uint at = neuron * m + point - first;
    float u = is_tangent ? d_preactivation.at[at] : value + (BIAS != 0u ? hidden_bias.at[neuron] : 0.0);
    if (SECOND_ORDER != 0u && !is_tangent) {
        // The same invocation comes for it with ṡ.
        d_preactivation.at[at] = u;
        return 0.0;
    }
    float d_out = d_first.at[point], w2 = head_weight.at[neuron], slope = activation_derivative(u);
    float d_w2 = d_out * activation(u), d_h = d_out * w2;
    if (HEADS != 0u && point < n_hidden) d_h += d_hidden.at[neuron * stride_hidden + point];
    float d_u = d_h * slope;
    if (SECOND_ORDER != 0u) {
        d_w2 += value * slope;
        d_u += value * w2 * activation_curvature(slope);
        steepness.at[at] = slope * w2;
    }
    d_preactivation.at[at] = d_u;
    return d_w2;
}

void take_row(uint i, float sum) {
    bool complete = is_tangent || SECOND_ORDER == 0u;
    if (complete && first_neuron + i < HIDDEN) add(d_head_weight, first_neuron + i, sum);
}

void main() {
    if (first_point() >= end) return;
    for (first_neuron = 0u; first_neuron < HIDDEN; first_neuron += TILE_M) {
        is_tangent = false;
        multiply(0u, INPUTS);
        if (SECOND_ORDER != 0u) {
            is_tangent = true;
            multiply(0u, INPUTS);
        }
    }
    if (BIAS != 0u) {
        uint lane = gl_LocalInvocationID.x, point = first_point() + lane;
        float d_b2 = subgroupAdd(lane < TILE_N && point < end ? d_first.at[point] : 0.0);
        if (subgroupElect()) add(d_head_bias, 0u, d_b2);
    }
}
