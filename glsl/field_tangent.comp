#version 460
// Directional derivative of a field's input along v = ∂loss/∂g: ȧ = J v, which is ∂loss/∂a for g = Jᵀ a. One (point, level) per
// invocation; the level is the launch's slice.
#include "lib/prelude.glsl"
#include "lib/hash_grid.glsl"
#include "lib/field.glsl"
#include "lib/look_up.glsl"

layout(constant_id = 7) const uint KEPT = 0; // 1: field_forward has kept ∂e/∂x; 0: the table is looked up once more

layout(push_constant, scalar) uniform Args {
    Levels levels;
    U32s table;       // [entries, FEATURES], or its copy (lib/look_up.glsl)
    F32s points;      // [3, n]
    F32s derivatives; // [3, LEVELS·FEATURES, n] ∂e/∂x, where KEPT
    F32s d_gradient;  // [3, n] v
    F32sMut tangents; // [INPUTS, end - begin] ȧ
    uint n;
    uint begin;       // the points at hand
    uint end;
};

void main() {
    Item point = item_of(begin, end);
    uint q = point.at - begin, count = end - begin;
    vec3 v = vector_of(d_gradient, n, point);
    uint l = level_of_slice(LEVELS);
    if (COORDINATES != 0u && l == 0u) set_vector(tangents, q, count, v);
    if (KEPT != 0u) {
        [[unroll]] for (uint f = 0u; f < FEATURES; ++f) {
            uint feature = l * FEATURES + f;
            vec3 slope = kept_derivatives(derivatives, 0u, feature, n, point);
            tangents.at[(COORDINATES + feature) * count + q] = dot(slope, v);
        }
        return;
    }
    vec3 x = vector_of(points, n, point);
    Level level = levels.at[l];
    Cell cell = cell_of(level, x);
    uint entries[8];
    [[unroll]] for (uint corner = 0u; corner < 8u; ++corner) entries[corner] = corner_entry(level, cell, corner);
    [[unroll]] for (uint k = 0u; k < PAIRS; ++k) {
        vec2 corners[8];
        [[unroll]] for (uint corner = 0u; corner < 8u; ++corner) corners[corner] = look_up(table, entries[corner], k);
        Interpolation e = interpolate(corners, cell.weight);
        [[unroll]] for (uint f = 2u * k; f < min(2u * k + 2u, FEATURES); ++f) {
            tangents.at[(COORDINATES + l * FEATURES + f) * count + q] = dot(slope_of(level, e, f % 2u), v);
        }
    }
}
