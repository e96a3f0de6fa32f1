#version 460
// Adjoint of field_forward up to the hash features, one point per invocation:
//   d_h = w₂ d_out (+ what further heads send back),  d_u = d_h σ'(u),  d_e = W₁ᵀ d_u,  d_w₂ += h d_out,  d_b₂ += d_out.
// u is computed again from z: reading it back would cost more than the sum. d_u goes to weight_gradient, d_e to hash_grid_backward.
#include "lib/prelude.glsl"
#include "lib/field.glsl"

layout(push_constant, scalar) uniform Args {
    F32s hidden_weight;     // [HIDDEN, INPUTS]
    F32s hidden_bias;       // [HIDDEN]
    F32s head_weight;       // [HIDDEN]
    F32s inputs;            // [INPUTS, n]
    F32s d_first;           // [n]
    F32s d_hidden;          // [HIDDEN, n_hidden] from the other heads
    F32sMut d_preactivation; // [HIDDEN, n] d_u
    F32sMut d_features;     // [LEVELS * FEATURES, n] d_e
    F32sMut d_head_weight;  // [HIDDEN] accumulated
    F32sMut d_head_bias;    // [1] accumulated
    uint n;
    uint n_hidden;
};

const uint FEATURE_INPUTS = LEVELS * FEATURES;
void main() {
    uint point = item();
    // Invocations past the end stay for the subgroup's sums and add nothing. (Summing up in shared memory first would halve the speed on
    // software devices, where a barrier costs more than an atomic add.)
    bool inside = point < n;
    uint p = inside ? point : 0u;
    float z[INPUTS];
    [[unroll]] for (uint i = 0u; i < INPUTS; ++i) z[i] = inputs.at[i * n + p];
    float d_out = inside ? d_first.at[p] : 0.0;
    bool has_heads = inside && point < n_hidden;
    float d_e[FEATURE_INPUTS];
    [[unroll]] for (uint i = 0u; i < FEATURE_INPUTS; ++i) d_e[i] = 0.0;

    for (uint first_neuron = 0u; first_neuron < HIDDEN; first_neuron += TILE) {
        float u[TILE];
        [[unroll]] for (uint t = 0u; t < TILE; ++t) u[t] = BIAS != 0u ? hidden_bias.at[first_neuron + t] : 0.0;
        [[unroll]] for (uint i = 0u; i < INPUTS; ++i) {
            [[unroll]] for (uint t = 0u; t < TILE; ++t) u[t] = fma(hidden_weight.at[(first_neuron + t) * INPUTS + i], z[i], u[t]);
        }
        [[unroll]] for (uint t = 0u; t < TILE; ++t) {
            float d_w2 = subgroupAdd(d_out * activation(u[t]));
            if (subgroupElect()) add(d_head_weight, first_neuron + t, d_w2);
            float d_h = d_out * head_weight.at[first_neuron + t];
            if (has_heads) d_h += d_hidden.at[(first_neuron + t) * n_hidden + p];
            u[t] = inside ? d_h * activation_derivative(u[t]) : 0.0;
            if (inside) d_preactivation.at[(first_neuron + t) * n + p] = u[t];
        }
        [[unroll]] for (uint i = 0u; i < FEATURE_INPUTS; ++i) {
            [[unroll]] for (uint t = 0u; t < TILE; ++t)
                d_e[i] = fma(hidden_weight.at[(first_neuron + t) * INPUTS + COORDINATES + i], u[t], d_e[i]);
        }
    }
    if (inside) {
        [[unroll]] for (uint i = 0u; i < FEATURE_INPUTS; ++i) d_features.at[i * n + p] = d_e[i];
    }
    if (BIAS != 0u) {
        float d_b2 = subgroupAdd(d_out);
        if (subgroupElect()) add(d_head_bias, 0u, d_b2);
    }
}
