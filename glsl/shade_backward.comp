#version 460
// Adjoint of shade_forward, one sample per invocation. ∂loss/∂g is that through the colour network, that of the eikonal loss
// λ/B Σ(‖g‖ − 1)² and, where the density or another loss uses g too, theirs. It goes on to the taps' SDF values; without taps it is left
// in d_gradient. The curvature loss reaches the SDF values on its own.
#include "lib/prelude.glsl"
#include "lib/taps.glsl"
#include "lib/shading.glsl"

layout(constant_id = 3) const uint CURVATURE = 0;
layout(constant_id = 4) const uint OTHER_USES = 0;  // 1: d_gradient holds ∂loss/∂g through what else uses g

layout(push_constant, scalar) uniform Args {
    F32s sdf;           // [BLOCKS, n], read with CURVATURE
    F32s shading;       // [rows, n]
    F32s d_shading;     // [rows, n]
    F32s tap_draws;     // [n]
    F32sMut d_sdf;      // [BLOCKS, n] the taps' blocks overwritten, block 0 accumulated with CURVATURE
    F32sMut d_gradient; // [3, n] read with OTHER_USES; without taps that of all uses is left here
    uint n;
    float tap_range;
    float tap_floor;
    float eikonal_scale;    // λ/B
    float curvature_scale;  // λ/B
};

void main() {
    uint p = item();
    if (p >= n) return;
    vec3 g = vector_at(shading, ROW_GRADIENT * n + p, n);
    vec3 d_g = vector_at(d_shading, ROW_GRADIENT * n + p, n);
    if (OTHER_USES != 0u) d_g += vector_at(reading(d_gradient), p, n);
    float norm = length(g);
    if (norm > 0.0) d_g += 2.0 * eikonal_scale * (norm - 1.0) / norm * g;
    if (TAPS == 0u) {
        set_vector(d_gradient, p, n, d_g);
        return;
    }
    float delta = tap_step(tap_draws.at[p], tap_range, tap_floor);
    float d_trace = 0.0;
    if (CURVATURE != 0u) {
        float trace = 0.0;
        for (uint tap = 0u; tap < TAPS; ++tap) trace += sdf.at[(1u + tap) * n + p] - sdf.at[p];
        d_trace = curvature_scale * trace_factor(delta) * sign(trace);
        d_sdf.at[p] -= float(TAPS) * d_trace;
    }
    d_g *= gradient_factor(delta);
    for (uint tap = 0u; tap < TAPS; ++tap) d_sdf.at[(1u + tap) * n + p] = dot(tap_direction(tap), d_g) + d_trace;
}
