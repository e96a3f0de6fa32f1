#version 460
#include "lib/prelude.glsl"
#include "lib/normal.glsl"
#include "lib/supervision.glsl"
// Adjoint of normal_map with respect to the samples' gradients g, one sample per invocation; that with respect to the weights is
// composite_backward's.
layout(push_constant, scalar) uniform Args {
    F32s weights;       // [n_rays, n_samples]
    F32s gradient;      // [3, n]
    F32s d_image;       // [5, n_rays] the last three planes are the normal's
    F32sMut d_gradient; // [3, n] accumulated
    uint n_rays;
    uint n_samples; // n = n_rays n_samples
};

void main() {
    uint p = item();
    uint n = n_rays * n_samples;
    if (p >= n) return;
    uint ray = p / n_samples;
    vec3 d_normal = vector_at(d_image, D_NORMAL * n_rays + ray, n_rays);
    vec3 d_g = normal_backward(vector_at(gradient, p, n), weights.at[p] * d_normal);
    set_vector(d_gradient, p, n, vector_at(reading(d_gradient), p, n) + d_g);
}
