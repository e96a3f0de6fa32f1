#version 460
#include "lib/prelude.glsl"
// Multiply-adds in registers, 16 independent chains per invocation, each x ← gain·x + offset, 16·ROUNDS times: the fastest that any
// kernel can compute in float32. Measures the roof that a profile compares arithmetic with.
layout(constant_id = 0) const uint ROUNDS = 16;

layout(push_constant, scalar) uniform Args {
    F32sMut sums; // [n] overwritten: sum of the chains, which started at 0, 1, … 15
    uint n;
    float gain;
    float offset;
};

void main() {
    uint i = item();
    if (i >= n) return;
    float x[16];
    [[unroll]] for (uint chain = 0u; chain < 16u; ++chain) x[chain] = float(chain);
    uint round = 0u;
    do {
        [[unroll]] for (uint step = 0u; step < 16u; ++step) {
            [[unroll]] for (uint chain = 0u; chain < 16u; ++chain) x[chain] = fma(gain, x[chain], offset);
        }
    } while (++round < ROUNDS);
    float sum = 0.0;
    [[unroll]] for (uint chain = 0u; chain < 16u; ++chain) sum += x[chain];
    sums.at[i] = sum;
}
