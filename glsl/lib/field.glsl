// What the forward and the backward of a field (hash grid + one hidden layer) share: its shape, its activation, its input.

layout(constant_id = 0) const uint LEVELS = 12;
layout(constant_id = 1) const uint FEATURES = 2;
layout(constant_id = 2) const uint HIDDEN = 64;
layout(constant_id = 3) const uint COORDINATES = 3;  // leading inputs: x, y, z (SDF) or none (densities)
layout(constant_id = 4) const uint SOFTPLUS = 1;     // hidden activation: 1 softplus(100 u)/100, 0 ReLU
layout(constant_id = 5) const uint BIAS = 1;
layout(constant_id = 6) const uint TILE = 8;         // hidden neurons per pass over the inputs; divides HIDDEN

#include "lib/entry.glsl"
#include "lib/abreast.glsl"

const uint INPUTS = COORDINATES + LEVELS * FEATURES;

// Row of the encoding's derivatives, where they are kept as [3 or 6, LEVELS·FEATURES, n]: 0 to 2 is ∂e/∂x by axis, 3 to 5 the mixed ones of
// second order, along y and z, x and z, x and y.
uint derivative_row(uint which, uint feature) { return which * LEVELS * FEATURES + feature; }

// Three of a feature's, from a row on.
vec3 kept_derivatives(F32s derivatives, uint row, uint feature, uint n, Item point) {
    vec3 d;
    [[unroll]] for (uint i = 0u; i < 3u; ++i) d[i] = number_of(derivatives, derivative_row(row + i, feature) * n, point);
    return d;
}

// log(1 + e^{100u})/100 without overflow; equal to the published form, which turns linear above 100u = 20, to 2e-11.
float softplus(float u) { return max(u, 0.0) + 0.01 * log(1.0 + exp(-100.0 * abs(u))); }

float activation(float u) { return SOFTPLUS != 0u ? softplus(u) : max(u, 0.0); }

float activation_derivative(float u) {
    if (SOFTPLUS == 0u) return u > 0.0 ? 1.0 : 0.0;
    float e = exp(-100.0 * abs(u));
    return (u >= 0.0 ? 1.0 : e) / (1.0 + e);
}

// σ'' from σ': of softplus(100 u)/100 it is 100 σ'(1 - σ'), of ReLU 0.
float activation_curvature(float slope) { return SOFTPLUS != 0u ? 100.0 * slope * (1.0 - slope) : 0.0; }
