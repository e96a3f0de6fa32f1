#version 460
// AdamW with decoupled decay, one parameter per invocation (Loshchilov & Hutter 2019, algorithm 2; Adam where weight_decay is 0).
// Entries without gradient decay and move on by their momentum like all others. A step whose loss is not finite changes nothing.
#include "lib/prelude.glsl"

layout(push_constant, scalar) uniform Args {
    F32sMut params;       // [n] updated in place
    F32sMut grads;        // [n] consumed: zeroed for the next step
    F32sMut first_moment; // [n]
    F32sMut second_moment; // [n]
    U32s bad_step;        // [1] non-zero: losses not finite
    uint n;
    float learning_rate;
    float weight_decay;
    float beta1;
    float beta2;
    float correction1;    // 1 − β₁ᵗ
    float correction2;    // √(1 − β₂ᵗ)
    float epsilon;
};

void main() {
    uint i = item();
    if (i >= n) return;
    float g = grads.at[i];
    grads.at[i] = 0.0;
    if (bad_step.at[0] != 0u) return;
    float m = fma(beta1, first_moment.at[i], (1.0 - beta1) * g);
    float v = fma(beta2, second_moment.at[i], (1.0 - beta2) * g * g);
    first_moment.at[i] = m;
    second_moment.at[i] = v;
    float p = params.at[i] * (1.0 - learning_rate * weight_decay);
    params.at[i] = p - learning_rate / correction1 * m / (sqrt(v) / correction2 + epsilon);
}
