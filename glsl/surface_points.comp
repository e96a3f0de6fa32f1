#version 460
#include "lib/prelude.glsl"
#include "lib/sampling.glsl"
#include "lib/taps.glsl"
// Where the surface network is asked: a point of every bin, and around it the taps of the finite-difference gradient, one invocation per
// bin. The point is the bin's start, or with MIDPOINT its middle (NeuS, whose opacity is of the distances at both ends).
//     x_i = o + t_i d,  delta = max(tap_range u, tap_floor),  taps x_i + delta d_j
layout(constant_id = 3) const uint MIDPOINT = 0;

layout(push_constant, scalar) uniform Args {
    F32s origins;    // [3, n_rays]
    F32s directions; // [3, n_rays]
    F32s near_far;   // [2, n_rays]
    F32s edges;      // [n_rays, n_samples + 1]
    F32s tap_draws;  // [n] u in [0,1); read only where there are taps
    F32sMut points;  // [3, BLOCKS * n]: block 0 the samples, then their taps
    uint n_rays;
    uint n_samples; // n = n_rays n_samples
    float tap_range; // region units
    float tap_floor; // region units
};

void main() {
    uint index = item();
    uint n = n_rays * n_samples;
    if (index >= n) return;
    uint ray = index / n_samples;
    uint total = BLOCKS * n;
    Span span = ray_span(near_far, n_rays, ray);
    float s = edges.at[index + ray]; // edges have one more per ray than bins
    float t = MIDPOINT != 0u ? bin_midpoint(span, s, edges.at[index + ray + 1u]) : distance_at(span, s);
    float delta = TAPS > 0u ? tap_step(tap_draws.at[index], tap_range, tap_floor) : 0.0;
    vec3 x = vector_at(origins, ray, n_rays) + t * vector_at(directions, ray, n_rays);
    set_vector(points, index, total, x);
    for (uint tap = 0u; tap < TAPS; tap++) set_vector(points, (1u + tap) * n + index, total, x + delta * tap_direction(tap));
}
