#version 460
#include "lib/prelude.glsl"
#include "lib/supervision.glsl"
// Absolute error of the rendered z-depth where a sensor measured one, and its gradient, one invocation per ray:
//     loss = |c t - z|,  t the rendered distance along the ray, c the z-depth of a unit of it, z > 0 the sensor's; region units
layout(push_constant, scalar) uniform Args {
    F32s image;       // [6, n_rays] of composite_forward
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
    float z = priors.at[PRIOR_SENSOR_DEPTH * n_rays + ray];
    float weight = z > 0.0 ? ray_weight(target, ray_outside, ray, n_rays) : 0.0;
    float cosine = priors.at[PRIOR_COSINE * n_rays + ray];
    float error = cosine * image.at[IMAGE_DEPTH * n_rays + ray] - z;
    loss.at[ray] = weight * abs(error);
    d_image.at[D_DEPTH * n_rays + ray] += scale * weight * cosine * sign(error);
}
