#version 460
// Rendered normals: Σ w n over a ray's samples with n = g/‖g‖ (not normalised again, as in NeuRodin's released code).
// One ray per invocation.
#include "lib/prelude.glsl"
#include "lib/normal.glsl"

layout(push_constant, scalar) uniform Args {
    F32s weights;     // [n_rays, n_samples]
    F32s gradient;    // [3, n] g
    F32sMut normals;  // [3, n_rays]
    uint n_rays;
    uint n_samples; // n = n_rays n_samples
};

void main() {
    uint ray = item();
    if (ray >= n_rays) return;
    uint n = n_rays * n_samples;
    vec3 sum = vec3(0.0);
    for (uint s = 0u; s < n_samples; ++s) {
        uint p = ray * n_samples + s;
        sum += weights.at[p] * normal_of(vector_at(gradient, p, n));
    }
    set_vector(normals, ray, n_rays, sum);
}
