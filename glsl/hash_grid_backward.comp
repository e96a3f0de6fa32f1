#version 460
// Scatter of ∂loss/∂features into the hash table: d_table[corner] += weight · d_e, with SECOND_ORDER also (∂weight/∂x · v) a, that of
// ∂loss/∂g (lib/scatter.glsl). One (point, level) per invocation; the level is the launch's slice: only one level's gradients need to fit
// the cache.
#include "lib/prelude.glsl"
#include "lib/hash_grid.glsl"
#include "lib/scatter.glsl"

void main() {
    uint point = begin + item();
    if (point >= end) return;
    uint l = slice();
    Level level = levels.at[l];
    if (!visit(level, l, point)) return;
    [[unroll]] for (uint corner = 0u; corner < 8u; ++corner) {
        uint entry = corner_entry(level, cell, corner) * FEATURES;
        vec2 factors = corner_factors(level, corner);
        [[unroll]] for (uint f = 0u; f < FEATURES; ++f) add(d_table, entry + f, added(factors, f));
    }
}
