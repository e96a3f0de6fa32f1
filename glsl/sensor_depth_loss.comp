#version 460
#include "lib/prelude.glsl"
#include "lib/supervision.glsl"
// Absolute error of the rendered z-depth where a sensor measured one, and its gradient, one invocation per ray (METHOD 12):
//     loss = |c t - z|,  t the rendered distance along the ray, c the z-depth of a unit of it, z > 0 the sensor's; region units
layout(push_constant, scalar) uniform Args {
    F32s image;       // [6, n] of composite_forward
    F32s priors;      // [6, n] of draw_priors
    F32s target;      // [4, n]
    U32s ray_outside; // [n]
    F32sMut loss;     // [n] before scale
    F32sMut d_image;  // [5, n] added to
    uint n;
    float scale; // the loss's weight / number of rays
};

void main() {
    uint ray = item();
    if (ray >= n) return;
    float z = priors.at[PRIOR_SENSOR_DEPTH * n + ray];
    float weight = z > 0.0 ? ray_weight(target, ray_outside, ray, n) : 0.0;
    float cosine = priors.at[PRIOR_COSINE * n + ray];
    float error = cosine * image.at[IMAGE_DEPTH * n + ray] - z;
    loss.at[ray] = weight * abs(error);
    d_image.at[D_DEPTH * n + ray] += scale * weight * cosine * sign(error);
}
