#version 460
// AdamW, one parameter per invocation. Parameters without gradient decay and move on by their momentum like all others. A step whose
// loss is not finite changes nothing.
#include "lib/prelude.glsl"
#include "lib/adam.glsl"

layout(push_constant, scalar) uniform Args {
    F32sMut params;       // [n] updated in place
    F32sMut grads;        // [n] consumed: zeroed for the next step
    F32sMut first_moment; // [n]
    F32sMut second_moment; // [n]
    U32s bad_step;        // [1] non-zero: losses not finite
    uint n;
    float rate;           // η / (1 − β₁ᵗ)
    float decay;          // η λ
    float correction;     // √(1 − β₂ᵗ)
    float share1;         // 1 − β₁
    float share2;         // 1 − β₂
    float epsilon;
};

void main() {
    uint i = item();
    if (i >= n) return;
    float g = grads.at[i];
    grads.at[i] = 0.0;
    if (bad_step.at[0] != 0u) return;
    Moving x = Moving(params.at[i], first_moment.at[i], second_moment.at[i]);
    x = adam_step(x, g, Rates(rate, decay, correction, share1, share2, epsilon));
    params.at[i] = x.p;
    first_moment.at[i] = x.m;
    second_moment.at[i] = x.v;
}
