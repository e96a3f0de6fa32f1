#version 460
// Brings entries of the hash table up to date, in the order in which they lie in memory: those that have been marked since the last time;
// after an update those of a level (the slice) that is updated whole from now on, and every entry once in so many steps, so that none is
// left alone for as long as stamps can count; or `everything`. An invocation walks over the marks of a strip of entries.
#include "lib/prelude.glsl"
#include "lib/hash_grid.glsl"
#include "lib/lazy_table.glsl"

layout(constant_id = 0) const uint LEVELS = 12;
layout(constant_id = 1) const uint FEATURES = 2;
layout(constant_id = 2) const uint STRIP = 16;  // words of 32 marks: long strips have equally much to do, short ones are many
#include "lib/entry.glsl"
#include "lib/half_copy.glsl"

layout(push_constant, scalar) uniform Args {
    Levels levels;
    LevelUses uses;         // [levels]
    ClockRows rows;         // [256]
    U32s clock;             // [1]
    U32s marks;             // [slots / 32] a bit each
    U32sMut settled;        // [slots / 32] a bit each: marks that have been seen to
    U32sMut stamps;         // [slots / 4] a byte each
    F32sMut table;          // [entries, FEATURES]
    U32sMut halves;         // [entries, FEATURES / 2] its copy, with HALF
    SumsMut grads;          // [entries, FEATURES] consumed
    F32sMut first_moment;   // [entries, FEATURES]
    F32sMut second_moment;  // [entries, FEATURES]
    float one_minus_beta1;  // 1 − β₁
    float one_minus_beta2;  // 1 − β₂
    float epsilon;
    uint after_update;      // non-zero: `step` was updated
    uint everything;
    uint step;
};

const uint SWEEP = 240u;  // steps

#include "lib/settle.glsl"

// The other stamps of the word belong to this invocation's strip, too.
void restamp(uint slot, uint of_four, uint change) { stamps.at[slot >> 2u] = of_four ^ change; }

void main() {
    uint l = level_of_slice(LEVELS);
    uint whole = uses.at[l].whole;
    bool becomes_whole = after_update != 0u && whole == WHOLE;
    if (whole != 0u && !becomes_whole) return;
    bool due = after_update != 0u && item() / 8u % SWEEP == step % SWEEP;
    bool all = everything != 0u || becomes_whole || due;
    if (after_update != 0u && !all) return;  // nothing is marked then

    Level level = levels.at[l];
    uint now = clock.at[0];
    uint word = item() * STRIP, end = min(word + STRIP, (level.entries + 31u) / 32u);
    uint bits = 0u;
    while (true) {
        // The next word with something to do.
        for (; bits == 0u && word < end; ++word) {
            uint at = first_slot(level, l) / 32u + word;
            uint marked = marks.at[at];
            bits = marked & ~settled.at[at];
            if (bits != 0u) settled.at[at] = marked;
            if (all) bits = ~0u >> (32u - min(level.entries - word * 32u, 32u));
        }
        if (bits == 0u) break;
        uint in_level = (word - 1u) * 32u + findLSB(bits);
        settle(level.offset + in_level, first_slot(level, l) + in_level, now);
        bits &= bits - 1u;
    }
}
