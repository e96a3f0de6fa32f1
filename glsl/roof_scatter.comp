#version 460
#include "lib/prelude.glsl"
#include "lib/sums.glsl"
// Adds to entries of eight floats at random in a table, ENTRIES per invocation, by atomics: the fastest that a hash grid's gradient can be
// scattered without aggregating it first. Measures the roof for tables of one size.
layout(constant_id = 0) const uint ENTRIES = 16;

layout(push_constant, scalar) uniform Args {
    SumsMut table;  // [entries, 8] accumulated
    uint n;
    uint mask;      // entries - 1, entries a power of two
};

void main() {
    uint i = item();
    if (i >= n) return;
    uint key = i * 2654435761u + 1u;
    for (uint k = 0u; k < ENTRIES; ++k) {
        key = key * 1664525u + 1013904223u;
        uint entry = (key >> 8u) & mask;
        [[unroll]] for (uint channel = 0u; channel < 8u; ++channel) add(table, 8u * entry + channel, 1.0);
    }
}
