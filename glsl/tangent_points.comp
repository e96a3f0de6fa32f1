#version 460
// Points beside the samples for the tangent-normal loss, one sample per invocation (Rosu and Behnke 2023, PermutoSDF):
// q = m + 0.01 n × r, with a random unit vector r and, as in NeuRodin's released code, the bin's midpoint m but the unit normal n = g/‖g‖
// at its start.
#include "lib/prelude.glsl"
#include "lib/sampling.glsl"
#include "lib/tangent.glsl"

layout(push_constant, scalar) uniform Args {
    F32s origins;     // [3, n_rays]
    F32s directions;  // [3, n_rays]
    F32s near_far;    // [2, n_rays]
    F32s edges;       // [n_rays, n_samples + 1]
    F32s gradient;    // [3, n] g
    F32s draws;       // [2, n] in [0, 1)
    F32sMut points;   // [3, n] q
    uint n;
    uint n_rays;
};

void main() {
    uint p = item();
    if (p >= n) return;
    uint ray = p / (n / n_rays);
    float t = bin_midpoint(ray_span(near_far, n_rays, ray), edges.at[p + ray], edges.at[p + ray + 1u]);
    vec3 beside = TANGENT_STEP * cross(normal_of(vector_at(gradient, p, n)), random_direction(draws, p, n));
    set_vector(points, p, n, vector_at(origins, ray, n_rays) + t * vector_at(directions, ray, n_rays) + beside);
}
