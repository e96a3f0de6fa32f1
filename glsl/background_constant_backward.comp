#version 460
// Gradient of the learned background colour: the sum over all rays through the sigmoid, added up by one workgroup in a fixed order.
#include "lib/prelude.glsl"
#include "lib/sums.glsl"

layout(push_constant, scalar) uniform Args {
    F32s logits;       // [3]
    F32s d_color;      // [3, n_rays]
    SumsMut d_logits;  // [3] accumulated
    uint n_rays;
};

shared float partial[gl_WorkGroupSize.x * 3u];

void main() {
    uint lane = gl_LocalInvocationID.x;
    [[unroll]] for (uint c = 0u; c < 3u; ++c) {
        float sum = 0.0;
        for (uint ray = lane; ray < n_rays; ray += gl_WorkGroupSize.x) sum += d_color.at[c * n_rays + ray];
        partial[c * gl_WorkGroupSize.x + lane] = sum;
    }
    barrier();
    if (lane < 3u) {
        float sum = 0.0;
        for (uint i = 0u; i < gl_WorkGroupSize.x; ++i) sum += partial[lane * gl_WorkGroupSize.x + i];
        float y = 1.0 / (1.0 + exp(-logits.at[lane]));
        add_alone(d_logits, lane, sum * y * (1.0 - y));
    }
}
