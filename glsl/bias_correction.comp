#version 460
#include "lib/prelude.glsl"
#include "lib/workgroup_sum.glsl"
// Explicit bias correction (Wang et al. 2024, NeuRodin): just behind the heaviest sample the signed distance should be negative.
//     hinge_r = max(sdf(P + eps d) + eps, 0) [sdf(P + offset d) > 0]
//     loss_r = gate_r hinge_r              as the paper means it
//     loss_r = mean(gate) hinge_r          as the published code computes it (PUBLISHED = 1): an outer product over the batch
// The loss is sum_r scale loss_r. Every workgroup finds the mean of all rays by itself.
layout(constant_id = 0) const uint PUBLISHED = 0;

layout(push_constant, scalar) uniform Args {
    F32s query_sdf;      // [2 n_rays]: at P + eps d, then at P + offset d
    F32s gate;           // [n_rays] 0 or 1
    F32sMut loss;        // [n_rays] after scale
    F32sMut d_query_sdf; // [n_rays] of the first after scale; the second is only compared
    uint n_rays;
    float eps;
    float scale; // the loss's weight / number of rays
};

void main() {
    float mean_gate = 0.0;
    if (PUBLISHED != 0u) {
        float sum = 0.0;
        for (uint ray = gl_LocalInvocationID.x; ray < n_rays; ray += LOCAL_SIZE) sum += gate.at[ray];
        mean_gate = workgroup_sum(sum) / float(n_rays);
    }
    uint ray = item();
    if (ray >= n_rays) return;
    float factor = PUBLISHED != 0u ? mean_gate : gate.at[ray];
    float raised = query_sdf.at[ray] + eps;
    bool violated = raised > 0.0 && query_sdf.at[n_rays + ray] > 0.0;
    loss.at[ray] = violated ? factor * scale * raised : 0.0;
    d_query_sdf.at[ray] = violated ? factor * scale : 0.0;
}
