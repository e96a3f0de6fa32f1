#version 460
#include "lib/prelude.glsl"
#include "lib/sampling.glsl"
// Where proposals are asked: the middle of every bin (in distance), one invocation per bin.
//     m_i = o + (t_i + t_{i+1})/2 d
layout(push_constant, scalar) uniform Args {
    F32s origins;    // [3, n_rays]
    F32s directions; // [3, n_rays]
    F32s near_far;   // [2, n_rays]
    F32s edges;      // [n_rays, n_samples + 1]
    F32sMut points;  // [3, n]
    uint n_rays;
    uint n_samples; // n = n_rays n_samples
};

void main() {
    uint index = item();
    uint n = n_rays * n_samples;
    if (index >= n) return;
    uint ray = index / n_samples;
    uint edge = index + ray; // edges have one more per ray than bins
    float t = bin_midpoint(ray_span(near_far, n_rays, ray), edges.at[edge], edges.at[edge + 1u]);
    set_vector(points, index, n, vector_at(origins, ray, n_rays) + t * vector_at(directions, ray, n_rays));
}
