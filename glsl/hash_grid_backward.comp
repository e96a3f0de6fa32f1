#version 460
// Scatter of ∂loss/∂features into the hash table: d_table[corner] += weight · d_e, one (point, level) per invocation.
// The level is the launch's slice: only one level's gradients need to fit the cache.
#include "lib/prelude.glsl"
#include "lib/hash_grid.glsl"

layout(constant_id = 0) const uint LEVELS = 12;
layout(constant_id = 1) const uint FEATURES = 2;

layout(push_constant, scalar) uniform Args {
    Levels levels;
    F32s points;      // [3, n]
    F32s d_features;  // [LEVELS * FEATURES, n]
    F32sMut d_table;  // [entries, FEATURES] accumulated
    uint n;
};

void main() {
    uint point = item();
    if (point >= n) return;
    uint l = slice();
    Level level = levels.at[l];
    Cell cell = cell_of(level, vec3(points.at[point], points.at[n + point], points.at[2u * n + point]));
    float d_e[FEATURES];
    bool any_gradient = false;
    [[unroll]] for (uint f = 0u; f < FEATURES; ++f) {
        d_e[f] = d_features.at[(l * FEATURES + f) * n + point];
        any_gradient = any_gradient || d_e[f] != 0.0;
    }
    if (!any_gradient) return;
    [[unroll]] for (uint corner = 0u; corner < 8u; ++corner) {
        uint entry = corner_entry(level, cell, corner) * FEATURES;
        float weight = corner_weight(cell, corner);
        [[unroll]] for (uint f = 0u; f < FEATURES; ++f) add(d_table, entry + f, weight * d_e[f]);
    }
}
