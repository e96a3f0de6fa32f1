#version 460
#include "lib/prelude.glsl"
#include "lib/supervision.glsl"
// Binary cross-entropy of the accumulated weight against the object's mask, and its gradient, one invocation per ray:
//     loss = -(m log a + (1 - m) log b),  a the accumulation, b = 1 - a what passes, both clipped to [1e-3, 1 - 1e-3]
// The picture has b beside a, where the difference would have lost its digits. A clipped one has no gradient. A ray that misses the region has no say.
layout(push_constant, scalar) uniform Args {
    F32s image;       // [6, n_rays] of composite_forward
    F32s target;      // [4, n_rays] the last plane is m, 0 or 1
    U32s ray_outside; // [n_rays]
    F32sMut loss;     // [n_rays] before scale
    F32sMut d_image;  // [5, n_rays] accumulated
    uint n_rays;
    float scale; // the loss's weight / number of rays
};

const float CLIP = 1e-3;

void main() {
    uint ray = item();
    if (ray >= n_rays) return;
    float m = target.at[3u * n_rays + ray];
    float accumulation = image.at[IMAGE_ACCUMULATION * n_rays + ray], passed = image.at[IMAGE_TRANSMITTANCE * n_rays + ray];
    float a = clamp(accumulation, CLIP, 1.0 - CLIP), b = clamp(passed, CLIP, 1.0 - CLIP);
    float counts = ray_outside.at[ray] == 0u ? 1.0 : 0.0;
    loss.at[ray] = -counts * (m * log(a) + (1.0 - m) * log(b));
    if (a == accumulation && b == passed) d_image.at[D_ACCUMULATION * n_rays + ray] += scale * counts * ((1.0 - m) / b - m / a);
}
