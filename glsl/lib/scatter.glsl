// What the scatters of gradients into the hash table share: their arguments, and what a point adds to a corner.

layout(constant_id = 0) const uint LEVELS = 12;
layout(constant_id = 1) const uint FEATURES = 2;
layout(constant_id = 2) const uint SECOND_ORDER = 0;  // the table hears from the field's gradient g = Jᵀ a too

layout(push_constant, scalar) uniform Args {
    Levels levels;
    F32s points;      // [3, n]
    F32s d_features;  // [LEVELS * FEATURES, n] d_e
    F32s slopes;      // [LEVELS * FEATURES, n] a, with SECOND_ORDER
    F32s d_gradient;  // [3, n] v = ∂loss/∂g, with SECOND_ORDER
    F32sMut d_table;  // [entries, FEATURES] accumulated
    uint n;
};

// One point in one level.
struct Visit {
    Cell cell;
    vec3 v;
    float d_e[FEATURES];
    float a[FEATURES];
    bool adds_nothing;
};

Visit visit(Level level, uint l, uint point) {
    Visit at;
    at.cell = cell_of(level, vec3(points.at[point], points.at[n + point], points.at[2u * n + point]));
    at.adds_nothing = true;
    [[unroll]] for (uint f = 0u; f < FEATURES; ++f) {
        at.d_e[f] = d_features.at[(l * FEATURES + f) * n + point];
        at.adds_nothing = at.adds_nothing && at.d_e[f] == 0.0;
    }
    if (SECOND_ORDER != 0u) {
        [[unroll]] for (uint f = 0u; f < FEATURES; ++f) at.a[f] = slopes.at[(l * FEATURES + f) * n + point];
        at.v = vec3(d_gradient.at[point], d_gradient.at[n + point], d_gradient.at[2u * n + point]);
        at.adds_nothing = at.adds_nothing && at.v == vec3(0.0);
    }
    return at;
}

// d_table[corner] += w d_e + (∂w/∂x · v) a, with the corner's weight w.
struct CornerFactors {
    float weight;
    float along;
};

CornerFactors corner_factors(Level level, Visit at, uint corner) {
    return CornerFactors(corner_weight(at.cell, corner), SECOND_ORDER != 0u ? dot(corner_slope(level, at.cell, corner), at.v) : 0.0);
}

float added(Visit at, CornerFactors factors, uint f) {
    return SECOND_ORDER != 0u ? fma(factors.along, at.a[f], factors.weight * at.d_e[f]) : factors.weight * at.d_e[f];
}
