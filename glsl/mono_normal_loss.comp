#version 460
#include "lib/prelude.glsl"
#include "lib/rays.glsl"
#include "lib/normal.glsl"
#include "lib/supervision.glsl"
// How far the rendered normal is from a monocular one in the camera's axes, and its gradient, one invocation per ray (Yu et al. 2022,
// MonoSDF):  loss = sum_j |n_j - p_j| + 1 - n.p,  n the rendered sum of w n at unit length, p the prior
layout(push_constant, scalar) uniform Args {
    Views views;
    U32s ray_view;    // [n_rays]
    F32s normals;     // [3, n_rays] of normal_map, region frame
    F32s priors;      // [6, n_rays] of draw_priors
    F32s target;      // [4, n_rays]
    U32s ray_outside; // [n_rays]
    F32sMut loss;     // [n_rays] before scale
    F32sMut d_image;  // [5, n_rays] accumulated
    uint n_rays;
    float scale; // the loss's weight / number of rays
};

void main() {
    uint ray = item();
    if (ray >= n_rays) return;
    vec3 p = vector_at(priors, PRIOR_MONO_NORMAL * n_rays + ray, n_rays);
    float weight = p != vec3(0.0) ? ray_weight(target, ray_outside, ray, n_rays) : 0.0;
    float m[12] = views.at[ray_view.at[ray]].region_from_camera;
    mat3 camera_from_region = mat3(m[0], m[1], m[2], m[4], m[5], m[6], m[8], m[9], m[10]); // by columns
    vec3 rendered = camera_from_region * vector_at(normals, ray, n_rays);
    vec3 error = normal_of(rendered) - p;
    loss.at[ray] = weight * (abs(error.x) + abs(error.y) + abs(error.z) + 1.0 - dot(normal_of(rendered), p));
    vec3 d_rendered = scale * weight * normal_backward(rendered, sign(error) - p);
    vec3 d_normal = transpose(camera_from_region) * d_rendered;
    set_vector(d_image, D_NORMAL * n_rays + ray, n_rays, vector_at(reading(d_image), D_NORMAL * n_rays + ray, n_rays) + d_normal);
}
