#version 460
// After a step whose loss was not finite: the gradients of the hash table's marked entries wait for no update, and are forgotten. An
// invocation takes several words of marks; the level is the slice.
#include "lib/prelude.glsl"
#include "lib/hash_grid.glsl"
#include "lib/lazy_table.glsl"

layout(constant_id = 0) const uint FEATURES = 2;
layout(constant_id = 1) const uint TURNS = 16;  // words of 32 marks of an invocation: few workgroups where there is nothing to do
#include "lib/entry.glsl"

layout(push_constant, scalar) uniform Args {
    Levels levels;
    U32s bad_step;   // [1] non-zero: losses not finite
    U32s marks;      // [slots / 32] a bit each
    SumsMut grads;   // [entries, FEATURES]
};

void main() {
    if (bad_step.at[0] == 0u) return;
    uint l = slice();
    Level level = levels.at[l];
    uint words = (level.entries + 31u) / 32u;
    for (uint turn = 0u; turn < TURNS; ++turn) {
        uint word = (group() * TURNS + turn) * LOCAL_SIZE + gl_LocalInvocationID.x;
        if (word >= words) return;
        for (uint bits = marks.at[first_slot(level, l) / 32u + word]; bits != 0u; bits &= bits - 1u) {
            uint entry = level.offset + word * 32u + findLSB(bits);
            [[unroll]] for (uint k = 0u; k < PAIRS; ++k) clear_sums(grads, entry, k);
        }
    }
}
