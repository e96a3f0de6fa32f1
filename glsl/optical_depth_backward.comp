#version 460
// Adjoint of optical_depth, one bin per invocation; every gradient is overwritten.
#include "lib/prelude.glsl"
#include "lib/sampling.glsl"
#include "lib/volume.glsl"
#include "lib/optical_depth.glsl"

layout(constant_id = 2) const uint GRADIENT = 0;  // 1: d_gradient is wanted

layout(push_constant, scalar) uniform Args {
    F32s sdf;         // [n]
    F32s gradient;    // [3, n]
    F32s scale;       // [n] or [1]
    F32s directions;  // [3, n_rays]
    F32s edges;       // [n_rays, n_samples + 1]
    F32s near_far;    // [2, n_rays]
    U32s ray_outside; // [n_rays]
    F32sMut d_sdf;      // [n] d_tau in, d_f out
    F32sMut d_scale;    // [n], also where there is one scale for all: its summands
    F32sMut d_gradient; // [3, n], with GRADIENT; zero for the Laplace density of f
    uint n_rays;
    uint n_samples; // n = n_rays n_samples
    float scale_range;
    float scale_floor;
    float inv_s_lower;
    float anneal;
};

void main() {
    uint p = item();
    uint n = n_rays * n_samples;
    if (p >= n) return;
    uint ray = p / n_samples;
    BinDepth depth = BinDepth(0.0, 0.0, 0.0, 0.0);
    Scale at = scale_of(scale.at[SCALE == SCALE_LOCAL ? p : 0u], scale_range, scale_floor, inv_s_lower);
    if (ray_outside.at[ray] == 0u) {
        float c = DENSITY == DENSITY_LAPLACE ? 1.0 : cosine(gradient, directions, p, n, ray, n_rays);
        float bin = bin_length(ray_span(near_far, n_rays, ray), edges.at[p + ray], edges.at[p + ray + 1u]);
        depth = bin_depth(sdf.at[p], c, at.inv_s, bin, anneal);
    }
    float d_tau = d_sdf.at[p];
    d_sdf.at[p] = d_tau * depth.d_sdf;
    d_scale.at[p] = d_tau * depth.d_inv_s * at.d_parameter;
    if (GRADIENT != 0u) set_vector(d_gradient, p, n, d_tau * depth.d_cosine * vector_at(directions, ray, n_rays));
}
