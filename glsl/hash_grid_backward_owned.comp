#version 460
// hash_grid_backward for devices with few cores and slow atomics: a subgroup owns a level (the slice), walks over all points, and its
// eight lanes are the eight corners. Nobody else adds to that level, so plain loads and stores do.
#define LOCAL_SIZE 8
#include "lib/prelude.glsl"
#include "lib/hash_grid.glsl"

layout(constant_id = 0) const uint LEVELS = 12;
layout(constant_id = 1) const uint FEATURES = 2;
const uint POINTS = 4u;  // per turn of the loop

layout(push_constant, scalar) uniform Args {
    Levels levels;
    F32s points;      // [3, n]
    F32s d_features;  // [LEVELS * FEATURES, n]
    F32sMut d_table;  // [entries, FEATURES] accumulated
    uint n;
};

void scatter(Level level, uint l, uint point) {
    float d_e[FEATURES];
    bool any_gradient = false;
    [[unroll]] for (uint f = 0u; f < FEATURES; ++f) {
        d_e[f] = d_features.at[(l * FEATURES + f) * n + point];
        any_gradient = any_gradient || d_e[f] != 0.0;
    }
    if (!any_gradient) return;
    Cell cell = cell_of(level, vec3(points.at[point], points.at[n + point], points.at[2u * n + point]));
    uint corner = gl_LocalInvocationID.x;
    uint entry = corner_entry(level, cell, corner) * FEATURES;
    float weight = corner_weight(cell, corner);
    if (corners_may_meet(level, cell)) {
        [[unroll]] for (uint f = 0u; f < FEATURES; ++f) add(d_table, entry + f, weight * d_e[f]);
    } else {
        [[unroll]] for (uint f = 0u; f < FEATURES; ++f) d_table.at[entry + f] += weight * d_e[f];
    }
    // The next point's corners may be this one's, in other lanes.
    subgroupMemoryBarrierBuffer();
}

void main() {
    uint l = level_of_slice(LEVELS);
    Level level = levels.at[l];
    for (uint first = 0u; first < n; first += POINTS) {
        [[unroll]] for (uint k = 0u; k < POINTS; ++k) {
            if (first + k < n) scatter(level, l, first + k);
        }
    }
}
