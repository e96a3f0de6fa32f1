#version 460
#define LOCAL_SIZE 256
// The gradient of the one scale that all samples share: the sum of its summands, which leave zeros behind, since they stand where the
// network's own logit would have its gradient. One workgroup, fixed order.
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
