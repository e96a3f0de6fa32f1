#version 460
// Gradient of a field's first output with respect to position, by the chain rule, one point per invocation:
//   s = σ'(u) ⊙ w₂,  a = W₁ᵀ s,  g = Jᵀ a  with J = ∂z/∂x = [I; ∂e/∂x].
// a is kept: the hash table's gradient through g needs it (hash_grid_backward).
// Where the network is one of matrices, the second form of this comes first, then `linear`, and this is left with g.
#include "lib/prelude.glsl"
#include "lib/hash_grid.glsl"
#include "lib/field.glsl"
#include "lib/look_up.glsl"

layout(constant_id = 7) const uint STRAIGHT = 0;
layout(constant_id = 8) const uint KEPT = 0;   // 1: field_forward has kept ∂e/∂x; 0: the table is looked up once more
layout(constant_id = 9) const uint GIVEN = 0;  // 1: a is there
#include "lib/tile.glsl"

layout(push_constant, scalar) uniform Args {
    Levels levels;
    U32s table;          // [entries, FEATURES], or its copy (lib/look_up.glsl)
    F32s hidden_weight;  // [HIDDEN, INPUTS]
    F32s hidden_bias;    // [HIDDEN]
    F32s head_weight;    // [HIDDEN]
    F32s points;         // [3, n] region frame
    F32s inputs;         // [INPUTS, n] z, as field_forward left them
    F32s derivatives;    // [3, LEVELS·FEATURES, n] ∂e/∂x, where KEPT
    F32sMut steepness;   // [HIDDEN, end - begin] s, of the form by matrices alone
    F32sMut slopes;      // [INPUTS, n] a
    F32sMut gradient;    // [3, n] g, per region unit
    uint n;
    uint begin;          // the points of this launch
    uint end;
};

float a[INPUTS];

void differentiate(Item point) {
    load_input(inputs, n, point);
    [[unroll]] for (uint i = 0u; i < INPUTS; ++i) a[i] = 0.0;
    uint neurons = turns(HIDDEN, n);
    uint first_neuron = 0u;
    [[unroll]] do {
        F32s weight = from(hidden_weight, first_neuron * INPUTS);
        preactivate(weight, from(hidden_bias, first_neuron));
        [[unroll]] for (uint t = 0u; t < TILE; ++t) u[t] = activation_derivative(u[t]) * head_weight.at[first_neuron + t];
        [[unroll]] for (uint i = 0u; i < INPUTS; ++i) {
            [[unroll]] for (uint t = 0u; t < TILE; ++t) a[i] = fma(weight.at[t * INPUTS + i], u[t], a[i]);
        }
        first_neuron += TILE;
    } while (first_neuron < neurons);
    [[unroll]] for (uint i = 0u; i < INPUTS; ++i) slopes.at[i * n + point.at] = a[i];
}

void main() {
    Item at_hand = item_of(begin, end);
    uint point = at_hand.at;
    if (GIVEN == 0u) {
        differentiate(at_hand);
    } else if (KEPT != 0u) {
        [[unroll]] for (uint i = 0u; i < INPUTS; ++i) a[i] = number_of(reading(slopes), i * n, at_hand);
    }
    vec3 g = COORDINATES != 0u ? vector_at(reading(slopes), point, n) : vec3(0.0);
    if (KEPT != 0u) {
        [[unroll]] for (uint feature = 0u; feature < LEVELS * FEATURES; ++feature) {
            [[unroll]] for (uint axis = 0u; axis < 3u; ++axis) {
                g[axis] = fma(a[COORDINATES + feature], number_of(derivatives, derivative_row(axis, feature) * n, at_hand), g[axis]);
            }
        }
        set_vector(gradient, point, n, g);
        return;
    }
    vec3 x = vector_at(points, point, n);
    for (uint l = 0u; l < LEVELS; ++l) {
        Level level = levels.at[l];
        Cell cell = cell_of(level, x);
        vec2 slope[PAIRS];
        slope[PAIRS - 1u] = vec2(0.0);
        [[unroll]] for (uint f = 0u; f < FEATURES; ++f) slope[f / 2u][f % 2u] = slopes.at[(COORDINATES + l * FEATURES + f) * n + point];
        vec2 corners[8];
        [[unroll]] for (uint corner = 0u; corner < 8u; ++corner) {
            uint entry = corner_entry(level, cell, corner);
            corners[corner] = vec2(0.0);
            [[unroll]] for (uint k = 0u; k < PAIRS; ++k) corners[corner].x += dot(slope[k], look_up(table, entry, k));
        }
        g += slope_of(level, interpolate(corners, cell.weight), 0u);
    }
    set_vector(gradient, point, n, g);
}
