#version 460
#define LOCAL_SIZE 256
#include "lib/prelude.glsl"
#include "lib/scalar.glsl"
#include "lib/workgroup_sum.glsl"
// Sums of loss arrays: losses[k] = scale_k * sum of term k's values, losses[n_terms] = the total of those that count. ONE workgroup, fixed
// order: the same values give the same sums in every run. bad_step is set where the total is not finite, and never cleared here.
struct LossTerm {
    F32s values; // [count]
    uint count;
    float scale;
    uint counts; // 1: a loss, 0: a figure for the log
    uint padding;
};
layout(buffer_reference, scalar, buffer_reference_align = 8) readonly buffer LossTerms { LossTerm at[]; };

layout(push_constant, scalar) uniform Args {
    LossTerms terms;     // [n_terms]
    F32sMut losses;      // [n_terms + 1]
    U32sMut bad_step;    // [1] 1 once a total was not finite
    uint n_terms;
};

void main() {
    uint lane = gl_LocalInvocationID.x;
    float total = 0.0;
    for (uint k = 0u; k < n_terms; k++) {
        LossTerm term = terms.at[k];
        float sum = 0.0;
        for (uint i = lane; i < term.count; i += LOCAL_SIZE) sum += term.values.at[i];
        float loss = term.scale * workgroup_sum(sum);
        if (term.counts != 0u) total += loss;
        if (lane == 0u) losses.at[k] = loss;
    }
    if (lane == 0u) {
        losses.at[n_terms] = total;
        if (!is_finite(total)) bad_step.at[0] = 1u;
    }
}
