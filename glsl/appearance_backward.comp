#version 460
// Gradient of a ray's appearance code: the sum over the ray's samples, one (ray, channel) per invocation.
#include "lib/prelude.glsl"
#include "lib/sums.glsl"

layout(push_constant, scalar) uniform Args {
    F32s d_code;         // [channels, n]
    U32s ray_view;       // [n_rays]
    SumsMut d_appearance; // [views, channels] accumulated
    uint n_rays;
    uint n_samples; // n = n_rays n_samples
    uint channels;
};

void main() {
    if (item() >= n_rays * channels) return;
    uint ray = item() / channels;
    uint channel = item() % channels;
    float sum = 0.0;
    for (uint s = 0u; s < n_samples; ++s) sum += d_code.at[(channel * n_rays + ray) * n_samples + s];
    add(d_appearance, ray_view.at[ray] * channels + channel, sum);
}
