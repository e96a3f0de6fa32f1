#version 460
// One learned colour behind everything: C = sigmoid(logits), one ray per invocation.
#include "lib/prelude.glsl"
#include "lib/scalar.glsl"

layout(push_constant, scalar) uniform Args {
    F32s logits;     // [3]
    F32sMut color;   // [3, n_rays]
    uint n_rays;
};

void main() {
    uint ray = item();
    if (ray >= n_rays) return;
    [[unroll]] for (uint c = 0u; c < 3u; ++c) color.at[c * n_rays + ray] = sigmoid(logits.at[c]);
}
