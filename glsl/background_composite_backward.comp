#version 460
// Adjoint of background_composite_forward, one ray per invocation. With C_after the colour behind sample i,
//   ∂C/∂τ_i = T_{i+1} c_i − C_after,  ∂τ_i/∂out_i = τ_i.
#include "lib/prelude.glsl"

layout(push_constant, scalar) uniform Args {
    F32s edges;      // [n_rays, n_samples + 1]
    F32s raw;        // [n]
    F32s rgb;        // [3, n]
    F32s color;      // [3, n_rays]
    F32s d_color;    // [3, n_rays]
    F32sMut d_raw;   // [n]
    F32sMut d_rgb;   // [3, n]
    uint n_rays;
    uint n_samples;
};

void main() {
    uint ray = item();
    if (ray >= n_rays) return;
    uint n = n_rays * n_samples;
    vec3 behind = vec3(color.at[ray], color.at[n_rays + ray], color.at[2u * n_rays + ray]);
    vec3 d_c = vec3(d_color.at[ray], d_color.at[n_rays + ray], d_color.at[2u * n_rays + ray]);
    float depth = 0.0;
    for (uint s = 0u; s < n_samples; ++s) {
        uint p = ray * n_samples + s;
        uint e = ray * (n_samples + 1u) + s;
        float out_ = raw.at[p];
        float tau = exp(min(out_, 15.0)) * (edges.at[e + 1u] - edges.at[e]);
        float after = exp(-depth - tau);
        float w = exp(-depth) - after;
        vec3 c = vec3(rgb.at[p], rgb.at[n + p], rgb.at[2u * n + p]);
        behind -= w * c;
        d_raw.at[p] = out_ > 15.0 ? 0.0 : tau * dot(d_c, after * c - behind);
        [[unroll]] for (uint k = 0u; k < 3u; ++k) d_rgb.at[k * n + p] = w * d_c[k];
        depth += tau;
    }
}
