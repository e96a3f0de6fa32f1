#version 460
// Sums of loss arrays, in shares: a workgroup each, the term is the slice. Fixed order: the same values give the same sums in every run.
#include "lib/prelude.glsl"
#include "lib/loss_terms.glsl"
#include "lib/workgroup_sum.glsl"

layout(constant_id = 0) const uint VALUES = 2048;  // of a share

layout(push_constant, scalar) uniform Args {
    LossTerms terms;  // [n_terms]
    F32sMut shares;   // [n_terms, n_shares]
    uint n_shares;
};

void main() {
    if (group() >= n_shares) return;  // rows of a launch are equally long
    LossTerm term = terms.at[slice()];
    uint first = group() * VALUES, end = min(first + VALUES, term.count);
    float sum = 0.0;
    for (uint i = first + gl_LocalInvocationID.x; i < end; i += LOCAL_SIZE) sum += term.values.at[i];
    sum = workgroup_sum(sum);
    if (gl_LocalInvocationID.x == 0u) shares.at[slice() * n_shares + group()] = sum;
}
