#version 460
// Background colour of a ray: C = Σ w c with σ = exp(out), w_i = (1 − e^{−σδ}) T_i (Mildenhall et al. 2020, NeRF) on black.
// One ray per invocation.
#include "lib/prelude.glsl"
#include "lib/volume.glsl"

layout(push_constant, scalar) uniform Args {
    F32s edges;      // [n_rays, n_samples + 1]
    F32s raw;        // [n] log density
    F32s rgb;        // [3, n]
    F32sMut color;   // [3, n_rays]
    uint n_rays;
    uint n_samples; // n = n_rays n_samples
};

void main() {
    uint ray = item();
    if (ray >= n_rays) return;
    uint n = n_rays * n_samples;
    float depth = 0.0, transmittance = 1.0;
    vec3 sum = vec3(0.0);
    for (uint s = 0u; s < n_samples; ++s) {
        uint p = ray * n_samples + s;
        uint e = ray * (n_samples + 1u) + s;
        float tau = background_density(raw.at[p]) * (edges.at[e + 1u] - edges.at[e]);
        sum += opacity(tau) * transmittance * vector_at(rgb, p, n);
        depth += tau;
        transmittance = exp(-depth);
    }
    set_vector(color, ray, n_rays, sum);
}
