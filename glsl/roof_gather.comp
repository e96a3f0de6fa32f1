#version 460
#include "lib/prelude.glsl"
// Reads entries of 32 bytes at random from a table, ENTRIES per invocation: the fastest that a hash grid's look-ups can be. Measures the roof
// for tables of one size.
layout(constant_id = 0) const uint ENTRIES = 16;

layout(buffer_reference, scalar, buffer_reference_align = 16) readonly buffer Vec4s { vec4 at[]; };

layout(push_constant, scalar) uniform Args {
    Vec4s table;   // [entries, 2]
    F32sMut sums;  // [n] overwritten
    uint n;
    uint mask;     // entries - 1, entries a power of two
};

void main() {
    uint i = item();
    if (i >= n) return;
    vec4 sum = vec4(0.0);
    uint key = i * 2654435761u + 1u;
    for (uint k = 0u; k < ENTRIES; ++k) {
        key = key * 1664525u + 1013904223u;
        uint entry = (key >> 8u) & mask;
        sum += table.at[2u * entry] + table.at[2u * entry + 1u];
    }
    sums.at[i] = sum.x + sum.y + sum.z + sum.w;
}
