#version 460
#include "lib/prelude.glsl"
// Fills a span with one value: v_i = value.
layout(push_constant, scalar) uniform Args {
    F32sMut values; // [n] overwritten
    uint n;
    float value;
};

void main() {
    uint i = item();
    if (i >= n) return;
    values.at[i] = value;
}
