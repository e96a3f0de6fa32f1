#version 460
// Adjoint of background_composite_forward, one ray per invocation, by the recursion of composite_backward from the back:
//   g_i = d_color · c_i (0 behind the last sample),  D_i = g_i − g_{i+1} + e^{−τ_{i+1}} D_{i+1},  d_τ_i = T_{i+1} D_i,  d_out_i = τ_i d_τ_i.
// Nothing is subtracted from a running sum: far bins are hundreds of units long, and τ_i would multiply what rounding leaves of it.
#include "lib/prelude.glsl"
#include "lib/volume.glsl"

layout(push_constant, scalar) uniform Args {
    F32s edges;      // [n_rays, n_samples + 1]
    F32s raw;        // [n]
    F32s rgb;        // [3, n]
    F32s d_color;    // [3, n_rays]
    F32sMut d_raw;   // [n]
    F32sMut d_rgb;   // [3, n]
    uint n_rays;
    uint n_samples; // n = n_rays n_samples
};

void main() {
    uint ray = item();
    if (ray >= n_rays) return;
    uint n = n_rays * n_samples;
    vec3 d_c = vector_at(d_color, ray, n_rays);

    // Forward: the transmittance after each sample, left in d_raw until the way back overwrites it.
    float depth = 0.0;
    for (uint s = 0u; s < n_samples; ++s) {
        uint p = ray * n_samples + s;
        uint e = ray * (n_samples + 1u) + s;
        depth += background_density(raw.at[p]) * (edges.at[e + 1u] - edges.at[e]);
        d_raw.at[p] = exp(-depth);
    }

    float next_worth = 0.0, passed = 0.0, advantage = 0.0; // g_{i+1}, e^{−τ_{i+1}}, D_{i+1}
    for (uint k = 0u; k < n_samples; ++k) {
        uint s = n_samples - 1u - k;
        uint p = ray * n_samples + s;
        uint e = ray * (n_samples + 1u) + s;
        float bin = edges.at[e + 1u] - edges.at[e];
        float tau = background_density(raw.at[p]) * bin;
        float w = opacity(tau);
        if (s > 0u) w *= d_raw.at[p - 1u];
        float worth = dot(d_c, vector_at(rgb, p, n));
        set_vector(d_rgb, p, n, w * d_c);
        advantage = worth - next_worth + passed * advantage;
        d_raw.at[p] *= advantage * bin * background_density_slope(raw.at[p]);
        next_worth = worth;
        passed = exp(-tau);
    }
}
