#version 460
#include "lib/prelude.glsl"
// Colour error and its gradient, one invocation per ray.
//     loss_r = weight_r mean_c (|e_rc| + squared e_rc^2),  e = color - target;  the loss is scale * sum_r loss_r
layout(push_constant, scalar) uniform Args {
    F32s image;      // [6, n_rays] of composite_forward; the first three planes are read
    F32s target;     // [4, n_rays] red, green, blue, weight
    F32sMut loss;    // [n_rays] before scale
    F32sMut square;  // [n_rays] weight_r mean_c e_rc^2, for the PSNR of the log
    F32sMut d_color; // [3, n_rays] after scale
    uint n_rays;
    float scale;   // 1 / number of rays
    float squared; // weight of the squared error beside the absolute one
};

void main() {
    uint ray = item();
    if (ray >= n_rays) return;
    float weight = target.at[3u * n_rays + ray];
    float sum = 0.0, squares = 0.0;
    [[unroll]] for (uint channel = 0u; channel < 3u; channel++) {
        float error = image.at[channel * n_rays + ray] - target.at[channel * n_rays + ray];
        sum += abs(error);
        squares += error * error;
        d_color.at[channel * n_rays + ray] = scale * weight * (1.0 / 3.0) * (sign(error) + 2.0 * squared * error);
    }
    loss.at[ray] = weight * (sum + squared * squares) * (1.0 / 3.0);
    square.at[ray] = weight * squares * (1.0 / 3.0);
}
