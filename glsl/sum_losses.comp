#version 460
#define LOCAL_SIZE 32
#include "lib/prelude.glsl"
#include "lib/scalar.glsl"
#include "lib/loss_terms.glsl"
#include "lib/workgroup_sum.glsl"
// What the shares of loss_shares come to: losses[k] = scale_k * sum of term k's values, losses[n_terms] = the total of those that count. ONE
// workgroup, an invocation for each term, fixed order. bad_step is set where the total is not finite, and never cleared here.
layout(push_constant, scalar) uniform Args {
    LossTerms terms;     // [n_terms] at most LOCAL_SIZE
    F32s shares;         // [n_terms, n_shares]
    F32sMut losses;      // [n_terms + 1]
    U32sMut bad_step;    // [1] 1 once a total was not finite
    uint n_terms;
    uint n_shares;
};

void main() {
    uint k = gl_LocalInvocationID.x;
    float counted = 0.0;
    if (k < n_terms) {
        float sum = 0.0;
        for (uint i = 0u; i < n_shares; ++i) sum += shares.at[k * n_shares + i];
        float loss = terms.at[k].scale * sum;
        losses.at[k] = loss;
        if (terms.at[k].counts != 0u) counted = loss;
    }
    float total = workgroup_sum(counted);
    if (k == 0u) {
        losses.at[n_terms] = total;
        if (!is_finite(total)) bad_step.at[0] = 1u;
    }
}
