#version 460
// Gradient with respect to position, through a field's output and its gradient g, one point per invocation:
//   d_x = Jᵀ d_z + Σ a (∂²e/∂x²) v,   d_z from field_backward, a from field_gradient, v = ∂loss/∂g.
// The curvature of the network itself is in d_z.
#include "lib/prelude.glsl"
#include "lib/hash_grid.glsl"
#include "lib/field.glsl"
#include "lib/look_up.glsl"

layout(constant_id = 7) const uint KEPT = 0; // 2: field_forward has kept the encoding's derivatives; 0: the table is looked up once more

layout(push_constant, scalar) uniform Args {
    Levels levels;
    U32s table;       // [entries, FEATURES], or its copy (lib/look_up.glsl)
    F32s points;      // [3, n]
    F32s d_inputs;    // [INPUTS, end - begin] d_z
    F32s derivatives; // [6, LEVELS·FEATURES, n] ∂e/∂x and ∂²e/∂x², where KEPT
    F32s slopes;      // [INPUTS, n] a
    F32s d_gradient;  // [3, n] v
    F32sMut d_points; // [3, n]
    uint n;
    uint begin;       // the points at hand
    uint end;
};

void main() {
    Item point = item_of(begin, end);
    Item kept = counted_from(begin, point);  // in scratch memory
    uint count = end - begin;
    vec3 x = vector_of(points, n, point);
    vec3 v = vector_of(d_gradient, n, point);
    vec3 d_x = COORDINATES != 0u ? vector_of(d_inputs, count, kept) : vec3(0.0);
    for (uint turn = 0u; turn < LEVELS; ++turn) {
        uint l = min(turn, LEVELS - 1u);  // (lib/abreast.glsl)
        if (KEPT != 0u) {
            [[unroll]] for (uint f = 0u; f < FEATURES; ++f) {
                uint feature = l * FEATURES + f, row = COORDINATES + feature;
                vec3 slope = kept_derivatives(derivatives, 0u, feature, n, point), mixed = kept_derivatives(derivatives, 3u, feature, n, point);
                d_x += number_of(d_inputs, row * count, kept) * slope + number_of(slopes, row * n, point) * curvature_along(mixed, v);
            }
            continue;
        }
        Level level = levels.at[l];
        Cell cell = cell_of(level, x);
        vec2 d_e[PAIRS], slope[PAIRS];
        d_e[PAIRS - 1u] = slope[PAIRS - 1u] = vec2(0.0);
        [[unroll]] for (uint f = 0u; f < FEATURES; ++f) {
            uint row = COORDINATES + l * FEATURES + f;
            d_e[f / 2u][f % 2u] = number_of(d_inputs, row * count, kept);
            slope[f / 2u][f % 2u] = number_of(slopes, row * n, point);
        }
        vec2 corners[8];
        [[unroll]] for (uint corner = 0u; corner < 8u; ++corner) {
            uint entry = corner_entry(level, cell, corner);
            corners[corner] = vec2(0.0);
            [[unroll]] for (uint k = 0u; k < PAIRS; ++k) {
                vec2 stored = look_up(table, entry, k);
                corners[corner] += vec2(dot(d_e[k], stored), dot(slope[k], stored));
            }
        }
        Interpolation e = interpolate(corners, cell.weight);
        d_x += slope_of(level, e, 0u) + curvature_along(mixed_of(level, e, 1u), v);
    }
    set_vector(d_points, point.at, n, d_x);
}
