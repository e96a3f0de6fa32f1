#version 460
// From the field's gradient at a sample to the colour network's input, one sample per invocation:
//   g_j = [f(x + δe_j) − f(x − δe_j)] / 2δ from six taps, or with ANALYTIC from field_gradient (METHOD 3),  eikonal term (‖g‖ − 1)²  (METHOD 4.2),
//   direction encoding sin(2ᵏd), sin(2ᵏd + π/2) for k = 0…3, then d (METHOD 2.7).
#include "lib/prelude.glsl"
#include "lib/sampling.glsl"
#include "lib/shading.glsl"

layout(constant_id = 2) const uint ANALYTIC = 0;
const uint BLOCKS = ANALYTIC != 0u ? 1u : 7u;  // of points: samples, then their taps

layout(push_constant, scalar) uniform Args {
    F32s sdf;          // [7, n] at the samples and their taps +x −x +y −y +z −z
    F32s tap_draws;    // [n]
    F32s gradient;     // [3, n] with ANALYTIC, in place of the two above
    F32s points;       // [3, BLOCKS * n]
    F32s directions;   // [3, n_rays]
    U32s ray_view;     // [n_rays]
    F32s appearance;   // [views, APPEARANCE]
    F32sMut shading;   // [rows, n]
    F32sMut eikonal;   // [n]
    uint n;
    uint n_rays;
    float tap_range;
    float tap_floor;
};

void main() {
    uint p = item();
    if (p >= n) return;
    uint ray = p / (n / n_rays);
    vec3 g;
    if (ANALYTIC != 0u) {
        g = vec3(gradient.at[p], gradient.at[n + p], gradient.at[2u * n + p]);
    } else {
        float scale = 0.5 / tap_step(tap_draws.at[p], tap_range, tap_floor);
        g = scale * vec3(sdf.at[n + p] - sdf.at[2u * n + p], sdf.at[3u * n + p] - sdf.at[4u * n + p],
                         sdf.at[5u * n + p] - sdf.at[6u * n + p]);
    }
    float excess = length(g) - 1.0;
    eikonal.at[p] = excess * excess;
    [[unroll]] for (uint c = 0u; c < 3u; ++c) {
        shading.at[(ROW_GRADIENT + c) * n + p] = g[c];
        shading.at[(ROW_POSITION + c) * n + p] = points.at[c * BLOCKS * n + p];
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
