#version 460
#include "lib/prelude.glsl"
// Copies 16 bytes per invocation: the fastest that any kernel can move memory. Measures the roof that a profile compares traffic with.
layout(buffer_reference, scalar, buffer_reference_align = 16) readonly buffer Uvec4s { uvec4 at[]; };
layout(buffer_reference, scalar, buffer_reference_align = 16) buffer Uvec4sMut { uvec4 at[]; };

layout(push_constant, scalar) uniform Args {
    Uvec4s from; // [slices, n]
    Uvec4sMut to; // [slices, n] overwritten
    uint n;
};

void main() {
    uint i = item();
    if (i >= n) return;
    to.at[slice() * n + i] = from.at[slice() * n + i];
}
