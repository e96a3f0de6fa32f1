#version 460
#define LOCAL_SIZE 256
#include "lib/prelude.glsl"
#include "lib/workgroup_sum.glsl"
// Explicit bias correction (Wang et al. 2024, NeuRodin): just behind the heaviest sample the signed distance should be negative.
//     hinge_r = max(sdf(P + eps d) + eps, 0) [sdf(P + offset d) > 0]
//     loss_r = gate_r hinge_r              as the paper means it
//     loss_r = mean(gate) hinge_r          as the published code computes it (published = 1): an outer product over the batch
// The loss is sum_r scale loss_r. ONE workgroup loops over all rays, so that the mean is the same in every run.
layout(push_constant, scalar) uniform Args {
    F32s query_sdf;      // [2 n_rays]: at P + eps d, then at P + offset d
    F32s gate;           // [n_rays] 0 or 1
    F32sMut loss;        // [n_rays] after scale
    F32sMut d_query_sdf; // [n_rays] of the first after scale; the second is only compared
    uint n_rays;
    float eps;
    float scale; // the loss's weight / number of rays
    uint published;
};

void main() {
    uint lane = gl_LocalInvocationID.x;
    float sum = 0.0;
    for (uint ray = lane; ray < n_rays; ray += LOCAL_SIZE) sum += gate.at[ray];
    float mean_gate = workgroup_sum(sum) / float(n_rays);

    for (uint ray = lane; ray < n_rays; ray += LOCAL_SIZE) {
        float factor = published != 0u ? mean_gate : gate.at[ray];
        float raised = query_sdf.at[ray] + eps;
        bool violated = raised > 0.0 && query_sdf.at[n_rays + ray] > 0.0;
        loss.at[ray] = violated ? factor * scale * raised : 0.0;
        d_query_sdf.at[ray] = violated ? factor * scale : 0.0;
    }
}
