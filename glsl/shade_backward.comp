#version 460
// Adjoint of shade_forward, one sample per invocation: the gradient g hears from the colour network and from the eikonal loss
// λ/B Σ(‖g‖ − 1)², and passes ±d_g/2δ on to the six SDF values; with ANALYTIC it adds d_g to what g hears from elsewhere.
#include "lib/prelude.glsl"
#include "lib/sampling.glsl"
#include "lib/shading.glsl"

layout(constant_id = 2) const uint ANALYTIC = 0;

layout(push_constant, scalar) uniform Args {
    F32s shading;     // [rows, n]
    F32s d_shading;   // [rows, n]
    F32s tap_draws;   // [n]
    F32sMut d_sdf;    // [7, n]; blocks 1…6 written
    F32sMut d_gradient; // [3, n] accumulated, with ANALYTIC
    uint n;
    float tap_range;
    float tap_floor;
    float eikonal_scale;  // λ/B
};

void main() {
    uint p = item();
    if (p >= n) return;
    vec3 g, d_g;
    [[unroll]] for (uint c = 0u; c < 3u; ++c) {
        g[c] = shading.at[(ROW_GRADIENT + c) * n + p];
        d_g[c] = d_shading.at[(ROW_GRADIENT + c) * n + p];
    }
    float norm = length(g);
    if (norm > 0.0) d_g += 2.0 * eikonal_scale * (norm - 1.0) / norm * g;
    if (ANALYTIC != 0u) {
        [[unroll]] for (uint c = 0u; c < 3u; ++c) d_gradient.at[c * n + p] += d_g[c];
        return;
    }
    d_g *= 0.5 / tap_step(tap_draws.at[p], tap_range, tap_floor);
    [[unroll]] for (uint c = 0u; c < 3u; ++c) {
        d_sdf.at[(1u + 2u * c) * n + p] = d_g[c];
        d_sdf.at[(2u + 2u * c) * n + p] = -d_g[c];
    }
}
