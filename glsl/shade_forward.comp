#version 460
// From the field's gradient at a sample to the colour network's input, one sample per invocation:
//   g from taps (lib/taps.glsl), or where there are none from field_gradient,  eikonal term (‖g‖ − 1)²,
//   with CURVATURE its loss λ/B |trace of the Hessian| from the taps (Li et al. 2023, Neuralangelo),
//   direction encoding sin(2ᵏd), sin(2ᵏd + π/2) for k = 0…3, then d (as in NeuRodin's released code).
#include "lib/prelude.glsl"
#include "lib/taps.glsl"
#include "lib/shading.glsl"

layout(constant_id = 3) const uint CURVATURE = 0;

layout(push_constant, scalar) uniform Args {
    F32s sdf;          // [BLOCKS, n] at the samples and their taps
    F32s tap_draws;    // [n]
    F32s gradient;     // [3, n] without taps, in place of the two above
    F32s points;       // [3, BLOCKS * n]
    F32s directions;   // [3, n_rays]
    U32s ray_view;     // [n_rays]
    F32s appearance;   // [views, APPEARANCE]
    F32sMut shading;   // [rows, n]
    F32sMut eikonal;   // [n]
    F32sMut curvature; // [n] with CURVATURE
    uint n;
    uint n_rays;
    float tap_range;
    float tap_floor;
    float curvature_scale;  // λ/B
};

void main() {
    uint p = item();
    if (p >= n) return;
    uint ray = p / (n / n_rays);
    vec3 g = vec3(0.0);
    if (TAPS == 0u) {
        g = vector_at(gradient, p, n);
    } else {
        float delta = tap_step(tap_draws.at[p], tap_range, tap_floor);
        float trace = 0.0;
        for (uint tap = 0u; tap < TAPS; ++tap) {
            float f = sdf.at[(1u + tap) * n + p];
            g += f * tap_direction(tap);
            trace += f - sdf.at[p];
        }
        g *= gradient_factor(delta);
        if (CURVATURE != 0u) curvature.at[p] = curvature_scale * trace_factor(delta) * abs(trace);
    }
    float excess = length(g) - 1.0;
    eikonal.at[p] = excess * excess;
    set_vector(shading, ROW_GRADIENT * n + p, n, g);
    set_vector(shading, ROW_POSITION * n + p, n, vector_at(points, p, BLOCKS * n));
    [[unroll]] for (uint c = 0u; c < 3u; ++c) {
        float d = directions.at[c * n_rays + ray];
        [[unroll]] for (uint k = 0u; k < 4u; ++k) {
            float angle = d * float(1u << k);
            shading.at[(ROW_DIRECTION + c * 4u + k) * n + p] = sin(angle);
            shading.at[(ROW_DIRECTION + 12u + c * 4u + k) * n + p] = sin(angle + 1.57079632679);
        }
        shading.at[(ROW_DIRECTION + 24u + c) * n + p] = d;
    }
    for (uint a = 0u; a < APPEARANCE; ++a)
        shading.at[(ROW_APPEARANCE + a) * n + p] = appearance.at[ray_view.at[ray] * APPEARANCE + a];
}
