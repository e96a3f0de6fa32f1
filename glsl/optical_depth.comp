#version 460
// The optical depth of every bin, tau, from what the network says at its sample (lib/optical_depth.glsl), one bin per invocation.
#include "lib/prelude.glsl"
#include "lib/sampling.glsl"
#include "lib/volume.glsl"
#include "lib/optical_depth.glsl"

layout(push_constant, scalar) uniform Args {
    F32s sdf;         // [n] f (the first block of the taps' array)
    F32s gradient;    // [3, n] g; not read for the Laplace density of f
    F32s scale;       // [n] logits of the local scale, or [1]
    F32s directions;  // [3, n_rays] d
    F32s edges;       // [n_rays, n_samples + 1]
    F32s near_far;    // [2, n_rays]
    U32s ray_outside; // [n_rays] such rays are empty, whatever the network says
    F32sMut optical_depth; // [n] tau
    uint n_rays;
    uint n_samples; // n = n_rays n_samples
    float scale_range;  // of the local scale; rate of the exponential one
    float scale_floor;
    float inv_s_lower;  // the scheduled lower bound of the local 1/beta
    float anneal;       // of NeuS's cosine
};

void main() {
    uint p = item();
    uint n = n_rays * n_samples;
    if (p >= n) return;
    uint ray = p / n_samples;
    if (ray_outside.at[ray] != 0u) {
        optical_depth.at[p] = 0.0;
        return;
    }
    float c = DENSITY == DENSITY_LAPLACE ? 1.0 : cosine(gradient, directions, p, n, ray, n_rays);
    float bin = bin_length(ray_span(near_far, n_rays, ray), edges.at[p + ray], edges.at[p + ray + 1u]);
    float inv_s = scale_of(scale.at[SCALE == SCALE_LOCAL ? p : 0u], scale_range, scale_floor, inv_s_lower).inv_s;
    optical_depth.at[p] = bin_depth(sdf.at[p], c, inv_s, bin, anneal).tau;
}
