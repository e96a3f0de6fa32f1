#version 460
// Rendered normals: Σ w n over a ray's samples with n = g/‖g‖ (METHOD 2.6; not normalised again), one ray per invocation.
#include "lib/prelude.glsl"
#include "lib/shading.glsl"

layout(push_constant, scalar) uniform Args {
    F32s weights;     // [n_rays, n_samples]
    F32s shading;     // [rows, n_rays * n_samples]
    F32sMut normals;  // [3, n_rays]
    uint n_rays;
    uint n_samples;
};

void main() {
    uint ray = item();
    if (ray >= n_rays) return;
    uint n = n_rays * n_samples;
    vec3 sum = vec3(0.0);
    for (uint s = 0u; s < n_samples; ++s) {
        uint p = ray * n_samples + s;
        vec3 g = vec3(shading.at[ROW_GRADIENT * n + p], shading.at[(ROW_GRADIENT + 1u) * n + p], shading.at[(ROW_GRADIENT + 2u) * n + p]);
        sum += weights.at[p] / max(length(g), 1e-12) * g;
    }
    set_vector(normals, ray, n_rays, sum);
}
