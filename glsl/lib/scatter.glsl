// What the scatters of gradients into the hash table share: their arguments, and what a point adds to a corner.
#include "lib/sums.glsl"

layout(constant_id = 0) const uint LEVELS = 12;
layout(constant_id = 1) const uint FEATURES = 2;
layout(constant_id = 2) const uint SECOND_ORDER = 0;  // there is a gradient through the field's gradient g = Jᵀ a, too

layout(push_constant, scalar) uniform Args {
    Levels levels;
    F32s points;      // [3, n]
    F32s d_features;  // [LEVELS * FEATURES, end - begin] d_e
    F32s slopes;      // [LEVELS * FEATURES, n] a, with SECOND_ORDER
    F32s d_gradient;  // [3, n] v = ∂loss/∂g, with SECOND_ORDER
    SumsMut d_table;  // [entries, FEATURES] accumulated
    uint n;
    uint begin;       // the points at hand
    uint end;
};

// The point at hand, in the level at hand.
Cell cell;
float d_e[FEATURES];
float a[FEATURES];
vec3 v;

// Turns to a point; false if it adds nothing to this level.
bool visit(Level level, uint l, uint point) {
    bool adds = false;
    [[unroll]] for (uint f = 0u; f < FEATURES; ++f) {
        d_e[f] = d_features.at[(l * FEATURES + f) * (end - begin) + point - begin];
        adds = adds || d_e[f] != 0.0;
    }
    if (SECOND_ORDER != 0u) {
        [[unroll]] for (uint f = 0u; f < FEATURES; ++f) a[f] = slopes.at[(l * FEATURES + f) * n + point];
        v = vector_at(d_gradient, point, n);
        adds = adds || v != vec3(0.0);
    }
    cell = cell_of(level, vector_at(points, point, n));
    return adds;
}

// d_table[corner] += w d_e + (∂w/∂x · v) a with the corner's weight w: the factors of d_e and of a.
vec2 corner_factors(Level level, uint corner) {
    return vec2(corner_weight(cell, corner), SECOND_ORDER != 0u ? dot(corner_slope(level, cell, corner), v) : 0.0);
}

float added(vec2 factors, uint f) {
    return SECOND_ORDER != 0u ? fma(factors.y, a[f], factors.x * d_e[f]) : factors.x * d_e[f];
}
