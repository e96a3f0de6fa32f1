#version 460
// Directional derivative of a field's input along v = ∂loss/∂g: ȧ = J v, which is ∂loss/∂a for g = Jᵀ a. One (point, level) per
// invocation; the level is the launch's slice.
#include "lib/prelude.glsl"
#include "lib/hash_grid.glsl"
#include "lib/field.glsl"

layout(push_constant, scalar) uniform Args {
    Levels levels;
    F32s table;       // [entries, FEATURES]
    F32s points;      // [3, n]
    F32s d_gradient;  // [3, n] v
    F32sMut tangents; // [INPUTS, end - begin] ȧ
    uint n;
    uint begin;       // the points at hand
    uint end;
};

void main() {
    uint point = begin + item(), count = end - begin;
    if (point >= end) return;
    vec3 x = vector_at(points, point, n);
    vec3 v = vector_at(d_gradient, point, n);
    uint l = level_of_slice(LEVELS);
    if (COORDINATES != 0u && l == 0u) set_vector(tangents, item(), count, v);
    Level level = levels.at[l];
    Cell cell = cell_of(level, x);
    vec2 tangent[PAIRS];
    [[unroll]] for (uint k = 0u; k < PAIRS; ++k) tangent[k] = vec2(0.0);
    [[unroll]] for (uint corner = 0u; corner < 8u; ++corner) {
        uint entry = corner_entry(level, cell, corner);
        float along = dot(corner_slope(level, cell, corner), v);
        [[unroll]] for (uint k = 0u; k < PAIRS; ++k) tangent[k] = fma(vec2(along), load_features(table, entry, k), tangent[k]);
    }
    [[unroll]] for (uint f = 0u; f < FEATURES; ++f) tangents.at[(COORDINATES + l * FEATURES + f) * count + item()] = tangent[f / 2u][f % 2u];
}
