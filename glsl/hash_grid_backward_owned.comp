#version 460
// hash_grid_backward for devices with few cores and slow atomics: a subgroup owns a level (the slice), walks over all points, and its
// eight lanes are the eight corners. Nobody else adds to that level, so plain loads and stores do. Small levels are in its cache by then.
#define LOCAL_SIZE 8
#include "lib/prelude.glsl"
#include "lib/hash_grid.glsl"
#include "lib/scatter.glsl"
#include "lib/entry.glsl"
#include "lib/read_through.glsl"

const uint POINTS = 4u;  // per turn of the loop

void scatter(Level level, uint l, uint point) {
    if (!visit(level, l, point)) return;
    uint corner = gl_LocalInvocationID.x;
    uint entry = corner_entry(level, cell, corner);
    vec2 factors = corner_factors(level, corner);
    if (corners_may_meet(level, cell)) {
        [[unroll]] for (uint f = 0u; f < FEATURES; ++f) add(d_table, entry * FEATURES + f, added(factors, f));
    } else {
        [[unroll]] for (uint k = 0u; k < PAIRS; ++k) {
            vec2 more = vec2(added(factors, 2u * k), FEATURES == 1u ? 0.0 : added(factors, 2u * k + 1u));
            add_alone(d_table, entry, k, more);
        }
    }
    // The next point's corners may be this one's, in other lanes.
    subgroupMemoryBarrierBuffer();
}

void main() {
    uint l = level_of_slice(LEVELS);
    Level level = levels.at[l];
    uint n_words = level.entries * FEATURES * SUM_WORDS, first_word = level.offset * FEATURES * SUM_WORDS;
    if (read_through(U32s(uvec2(d_table)), first_word, n_words, end - begin) > n_words) return;  // never
    for (uint first = begin; first < end; first += POINTS) {
        [[unroll]] for (uint k = 0u; k < POINTS; ++k) {
            if (first + k < end) scatter(level, l, first + k);
        }
    }
}
