#version 460
// Gradient of the learned background colour: the sum over all rays through the sigmoid, added up by one workgroup in a fixed order.
#include "lib/prelude.glsl"
#include "lib/scalar.glsl"
#include "lib/sums.glsl"
#include "lib/workgroup_sum.glsl"

layout(push_constant, scalar) uniform Args {
    F32s logits;       // [3]
    F32s d_color;      // [3, n_rays]
    SumsMut d_logits;  // [3] accumulated
    uint n_rays;
};

void main() {
    uint lane = gl_LocalInvocationID.x;
    [[unroll]] for (uint c = 0u; c < 3u; ++c) {
        float sum = 0.0;
        for (uint ray = lane; ray < n_rays; ray += LOCAL_SIZE) sum += d_color.at[c * n_rays + ray];
        sum = workgroup_sum(sum);
        float y = sigmoid(logits.at[c]);
        if (lane == 0u) add_alone(d_logits, c, sum * y * (1.0 - y));
    }
}
