#version 460
#define LOCAL_SIZE 256
// Gradient of the one scale that all samples share: the sum of what each sample adds to it. These summands lie in the row of the network's
// scale logit, which has no gradient then, so zeros are left there. ONE workgroup, fixed order.
#include "lib/prelude.glsl"
#include "lib/sums.glsl"
#include "lib/workgroup_sum.glsl"

layout(push_constant, scalar) uniform Args {
    F32sMut d_scale;     // [n] consumed
    SumsMut d_parameter; // [1] accumulated
    uint n;
};

void main() {
    uint lane = gl_LocalInvocationID.x;
    float sum = 0.0;
    for (uint p = lane; p < n; p += LOCAL_SIZE) {
        sum += d_scale.at[p];
        d_scale.at[p] = 0.0;
    }
    sum = workgroup_sum(sum);
    if (lane == 0u) add_alone(d_parameter, 0u, sum);
}
