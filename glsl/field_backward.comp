#version 460
// Adjoint of field_forward up to the field's input, one point per invocation:
//   d_h = w₂ d_out (+ what further heads send back),  d_u = d_h σ'(u),  d_z = W₁ᵀ d_u,  d_w₂ += h d_out,  d_b₂ += d_out,
// and with SECOND_ORDER of field_gradient as well: from ȧ = J v (field_tangent), with s = σ'(u) ⊙ w₂ and ṡ = W₁ ȧ,
//   d_u += ṡ w₂ σ''(u),  d_w₂ += ṡ σ'(u);  d_W₁ += s ȧᵀ is left to weight_gradient, as d_u zᵀ is.
// u is computed again from z: reading it back would cost more than the sum. d_e, the hash features' part of d_z, goes to
// hash_grid_backward; the coordinates' part is wanted with SECOND_ORDER only.
#include "lib/prelude.glsl"
#include "lib/sums.glsl"
#include "lib/field.glsl"

layout(constant_id = 7) const uint HEADS = 1;  // as in field_forward
layout(constant_id = 8) const uint SECOND_ORDER = 0;
layout(constant_id = 9) const uint STRAIGHT = 0;
#include "lib/tile.glsl"

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

const uint FIRST_INPUT = SECOND_ORDER != 0u ? 0u : COORDINATES;
const uint OUT_INPUTS = INPUTS - FIRST_INPUT;
const uint TANGENTS = SECOND_ORDER != 0u ? INPUTS : 1u;

void main() {
    // Copied to locals before the loop: lavapipe bounds-checks every read of a push constant by a branch, behind which it then computes the
    // sums that are used there, while their products wait on the stack.
    F32s hidden_weight = hidden_weight, hidden_bias = hidden_bias, head_weight = head_weight, d_hidden = d_hidden;
    F32sMut d_preactivation = d_preactivation, steepness = steepness;
    SumsMut d_head_weight = d_head_weight;
    uint n_hidden = n_hidden, stride_hidden = stride_hidden, m = m;
    // Invocations past the end stay for the subgroup's sums, to which they add nothing, and write as all others do: a software device pays
    // as much for a branch around a store as for the store. (Summing up in shared memory first would halve its speed, too: a barrier costs
    // more there than an atomic add.)
    Item point = item_of(begin, end);
    Item kept = counted_from(first, point);  // in scratch memory
    uint q = kept.at;
    load_input(inputs, n, point);
    float z_dot[TANGENTS];
    if (SECOND_ORDER != 0u) {
        [[unroll]] for (uint i = 0u; i < TANGENTS; ++i) z_dot[i] = number_of(tangents, i * m, kept);
    }
    float d_out = number_of(d_first, 0u, point);
    bool has_heads = HEADS == 2u || HEADS == 1u && point.at < n_hidden;
    float d_z[OUT_INPUTS];
    [[unroll]] for (uint i = 0u; i < OUT_INPUTS; ++i) d_z[i] = 0.0;

    uint neurons = turns(HIDDEN, n);
    uint first_neuron = 0u;
    [[unroll]] do {
        F32s weight = from(hidden_weight, first_neuron * INPUTS);
        preactivate(weight, from(hidden_bias, first_neuron));
        float s_dot[TILE];
        if (SECOND_ORDER != 0u) {
            [[unroll]] for (uint t = 0u; t < TILE; ++t) s_dot[t] = 0.0;
            [[unroll]] for (uint i = 0u; i < TANGENTS; ++i) {
                [[unroll]] for (uint t = 0u; t < TILE; ++t)
                    s_dot[t] = fma(weight.at[t * INPUTS + i], z_dot[i], s_dot[t]);
            }
        }
        float d_w2_of_lane = 0.0;
        [[unroll]] for (uint t = 0u; t < TILE; ++t) {
            uint neuron = first_neuron + t;
            float w2 = head_weight.at[neuron];
            float slope = activation_derivative(u[t]);
            float d_w2 = d_out * activation(u[t]);
            float d_h = d_out * w2;
            if (has_heads) d_h += HEADS == 2u ? number_of(d_hidden, neuron * stride_hidden, point) : d_hidden.at[neuron * stride_hidden + point.at];
            float d_u = d_h * slope;
            if (SECOND_ORDER != 0u) {
                d_w2 += s_dot[t] * slope;
                d_u += s_dot[t] * w2 * activation_curvature(slope);
                steepness.at[neuron * m + q] = slope * w2;
            }
            u[t] = d_u;
            d_preactivation.at[neuron * m + q] = d_u;
            // A lane for each neuron's sum, so that one access adds as many as there are lanes.
            d_w2 = subgroupAdd(point.again ? 0.0 : d_w2);
            uint lane = t % gl_SubgroupSize;
            if (gl_SubgroupInvocationID == lane) d_w2_of_lane = d_w2;
            if (lane == gl_SubgroupSize - 1u || t == TILE - 1u) {
                if (gl_SubgroupInvocationID <= lane) add(d_head_weight, neuron - lane + gl_SubgroupInvocationID, d_w2_of_lane);
            }
        }
        [[unroll]] for (uint i = 0u; i < OUT_INPUTS; ++i) {
            [[unroll]] for (uint t = 0u; t < TILE; ++t)
                d_z[i] = fma(weight.at[t * INPUTS + FIRST_INPUT + i], u[t], d_z[i]);
        }
        first_neuron += TILE;
    } while (first_neuron < neurons);
    [[unroll]] for (uint i = 0u; i < OUT_INPUTS; ++i) d_inputs.at[i * m + q] = d_z[i];
    if (BIAS != 0u) {
        float d_b2 = subgroupAdd(point.again ? 0.0 : d_out);
        if (subgroupElect()) add(d_head_bias, 0u, d_b2);
    }
}
