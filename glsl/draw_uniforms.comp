#version 460
#include "lib/prelude.glsl"
// Uniform random numbers in [0,1), one per invocation, as a function of (seed, step, purpose, index): a run can be replayed and resumed.
// Philox4x32-10 (Salmon et al. 2011, Parallel random numbers: as easy as 1, 2, 3); the top 24 bits of its first word.
layout(push_constant, scalar) uniform Args {
    F32sMut draws; // [n]
    uint n;
    uint seed;
    uint step;
    uint purpose; // which use of randomness within the step
};

uint philox(uvec4 counter, uvec2 key) {
    for (uint round = 0u; round < 10u; round++) {
        uint high0, low0, high1, low1;
        umulExtended(0xD2511F53u, counter.x, high0, low0);
        umulExtended(0xCD9E8D57u, counter.z, high1, low1);
        counter = uvec4(high1 ^ counter.y ^ key.x, low1, high0 ^ counter.w ^ key.y, low0);
        key += uvec2(0x9E3779B9u, 0xBB67AE85u);
    }
    return counter.x;
}

void main() {
    uint index = item();
    if (index >= n) return;
    uint bits = philox(uvec4(index, step, 0u, 0u), uvec2(seed, purpose));
    draws.at[index] = float(bits >> 8) * (1.0 / 16777216.0);
}
