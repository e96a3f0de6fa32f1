#version 460
// AdamW, two parameters in each turn of an invocation. Parameters without gradient decay and move on by their momentum like all others. A step whose
// loss is not finite changes nothing.
#include "lib/prelude.glsl"
#include "lib/update_pair.glsl"

layout(constant_id = 0) const uint TURNS = 1;

layout(push_constant, scalar) uniform Args {
    F32sMut params;        // [n] updated in place
    U32sMut halves;        // [n / 2] their copy, with HALF
    SumsMut grads;         // [n] consumed: zeroed for the next step
    F32sMut first_moment;  // [n]
    F32sMut second_moment; // [n]
    U32s bad_step;         // [1] non-zero: losses not finite
    uint n;                // where odd, padding goes along: it is zero and stays so
    float rate;            // η / (1 − β₁ᵗ)
    float decay;           // η λ
    float correction;      // √(1 − β₂ᵗ)
    float one_minus_beta1; // 1 − β₁
    float one_minus_beta2; // 1 − β₂
    float epsilon;
};

void main() {
    // Copied to locals before the loop, as in field_forward.
    F32sMut params = params, first_moment = first_moment, second_moment = second_moment;
    U32sMut halves = halves;
    SumsMut grads = grads;
    uint n_pairs = (n + 1u) / 2u;
    bool bad = bad_step.at[0] != 0u;
    Rates rates = Rates(rate, decay, correction, one_minus_beta1, one_minus_beta2, epsilon);
    uint first = first_of_subgroup(TURNS);
    for (uint turn = 0u; turn < TURNS; ++turn) {
        update_pair(params, halves, grads, first_moment, second_moment, 0u, item_from(first, n_pairs), bad, rates);
        first += items_abreast();
    }
}
