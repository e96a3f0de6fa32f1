#version 460
// Brings entries of the hash table up to date, in the order in which they lie in memory: those that have been marked since the last time;
// after an update those of a level (the slice) that is updated whole from now on, and every entry once in so many steps, so that none is
// left alone for as long as stamps can count; or `everything`. A subgroup walks over the marks of a strip of entries.
#include "lib/prelude.glsl"
#include "lib/hash_grid.glsl"
#include "lib/lazy_table.glsl"

layout(constant_id = 0) const uint LEVELS = 12;
layout(constant_id = 1) const uint FEATURES = 2;
layout(constant_id = 2) const uint STRIP = 16;  // pairs of words of marks, for each lane: long strips keep all lanes at work, short ones are many
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

// The other stamps of the word belong to this subgroup's strip, too, and to this lane.
void restamp(uint slot, uint of_four, uint change) { stamps.at[slot >> 2u] = of_four ^ change; }

// The first n bits of a word.
uint ones(uint n) { return n == 0u ? 0u : ~0u >> (32u - min(n, 32u)); }

void main() {
    uint l = level_of_slice(LEVELS);
    uint whole = uses.at[l].whole;
    bool becomes_whole = after_update != 0u && whole == WHOLE;
    if (whole != 0u && !becomes_whole) return;
    uint next = first_of_subgroup(STRIP);  // pair of words that nobody has taken
    bool due = after_update != 0u && next / (STRIP * items_abreast()) % SWEEP == step % SWEEP;
    bool all = everything != 0u || becomes_whole || due;
    if (after_update != 0u && !all) return;  // nothing is marked then

    Level level = levels.at[l];
    uint now = clock.at[0];
    uint end = min(next + STRIP * items_abreast(), (level.entries + 63u) / 64u);
    uint first = 0u;         // entry of the level with which this lane's words begin
    uvec2 bits = uvec2(0u);  // what is to be done of them
    while (true) {
        // Lanes that are done take the next words.
        while (next < end) {
            bool done = (bits.x | bits.y) == 0u;
            uint turn = subgroupInclusiveAdd(uint(done));
            uint taken = subgroupMax(turn);
            if (taken == 0u) break;
            if (done && next + turn <= end) {
                first = (next + turn - 1u) * 64u;
                uint at = (first_slot(level, l) + first) / 32u;
                uvec2 marked = words_at(marks, at);
                bits = marked & ~words_at(U32s(uvec2(settled)), at);
                if ((bits.x | bits.y) != 0u) set_words(settled, at, marked);
                uint left = level.entries - first;
                if (all) bits = uvec2(ones(left), ones(max(left, 32u) - 32u));
            }
            next += taken;
        }
        bool low = bits.x != 0u;
        uint word = low ? bits.x : bits.y;
        if (subgroupMax(word) == 0u) break;
        if (word != 0u) {
            uint in_level = first + (low ? 0u : 32u) + findLSB(word);
            settle(level.offset + in_level, first_slot(level, l) + in_level, now);
            word &= word - 1u;
            bits = low ? uvec2(word, bits.y) : uvec2(0u, word);
        }
    }
}
