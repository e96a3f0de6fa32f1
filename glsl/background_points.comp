#version 460
// Samples of the background field between a ray's exit point and `far`, as in NeuRodin's released code: edges uniform in s with
// independent jitter, disparity 1/t = s/far + (1 − s)/exit; positions at the midpoints. Here `far` is at least twice as far as the exit.
// One ray per invocation.
// With CONTRACTION, x ↦ (2 − 1/‖x‖) x/‖x‖ beyond the unit sphere and halved, so that all space falls into the hash grid's cube;
// without, the published uncontracted positions, whose indices wrap.
#include "lib/prelude.glsl"

layout(constant_id = 0) const uint CONTRACTION = 1;

layout(push_constant, scalar) uniform Args {
    F32s origins;      // [3, n_rays]
    F32s directions;   // [3, n_rays]
    F32s near_far;     // [2, n_rays]
    F32s draws;        // [n_rays, n_samples + 1]
    F32sMut edges;     // [n_rays, n_samples + 1] distances t
    F32sMut points;    // [3, n]
    uint n_rays;
    uint n_samples; // n = n_rays n_samples
    float far;
    uint jittered;
};

float edge_at(uint ray, uint j, float exit) {
    // Stratified: each edge moves within half a bin to both sides, the outermost ones inwards only.
    float low = (max(float(j), 0.5) - 0.5) / float(n_samples);
    float high = (min(float(j) + 0.5, float(n_samples))) / float(n_samples);
    float u = jittered != 0u ? draws.at[ray * (n_samples + 1u) + j] : 0.5;
    float s = jittered != 0u ? mix(low, high, u) : float(j) / float(n_samples);
    return 1.0 / (s / max(far, 2.0 * exit) + (1.0 - s) / exit);
}

void main() {
    uint ray = item();
    if (ray >= n_rays) return;
    vec3 o = vector_at(origins, ray, n_rays);
    vec3 d = vector_at(directions, ray, n_rays);
    float exit = max(near_far.at[n_rays + ray], 1e-3);
    uint n = n_rays * n_samples;
    float start = edge_at(ray, 0u, exit);
    edges.at[ray * (n_samples + 1u)] = start;
    for (uint s = 0u; s < n_samples; ++s) {
        float end = edge_at(ray, s + 1u, exit);
        edges.at[ray * (n_samples + 1u) + s + 1u] = end;
        vec3 x = o + 0.5 * (start + end) * d;
        start = end;
        if (CONTRACTION != 0u) {
            float norm = length(x);
            if (norm > 1.0) x *= (2.0 - 1.0 / norm) / norm;
            x *= 0.5;
        }
        set_vector(points, ray * n_samples + s, n, x);
    }
}
