#version 460
// AdamW of the hash table: of the marked entries of a level (the slice), or of all where most are marked; levels that are up to date as
// a whole are table_update_whole's. An invocation walks over the marks of a strip of entries. Gradients and marks are consumed in passing.
// A step whose loss is not finite changes nothing.
// Every strip is gone over as a whole once in so many steps, so that no entry is left alone for as long as stamps can count.
#include "lib/prelude.glsl"
#include "lib/hash_grid.glsl"
#include "lib/lazy_table.glsl"

layout(constant_id = 0) const uint FEATURES = 2;
layout(constant_id = 1) const uint STRIP = 16;  // words of 32 marks: long strips have equally much to do, short ones are many
#include "lib/entry.glsl"

layout(push_constant, scalar) uniform Args {
    Levels levels;
    LevelUses uses;         // [levels]
    ClockRows rows;         // [256]
    U32s clock;             // [1]
    U32s bad_step;          // [1] non-zero: losses not finite
    F32sMut table;          // [entries, FEATURES]
    SumsMut grads;          // [entries, FEATURES] zero where nobody marked
    F32sMut first_moment;   // [entries, FEATURES]
    F32sMut second_moment;  // [entries, FEATURES]
    U32sMut marks;          // [slots / 32] a bit each
    U32sMut stamps;         // [slots / 4] a byte each
    float rate;             // η / (1 − β₁ᵗ)
    float decay;            // η λ
    float correction;       // √(1 − β₂ᵗ)
    float one_minus_beta1;  // 1 − β₁
    float one_minus_beta2;  // 1 − β₂
    float epsilon;
    float most;             // share of a level's entries
    uint step;
};

const uint SWEEP = 240u;  // steps

uint now, next;
bool bad;
Rates rates;

// The update of an entry whose moments are as old as its stamp, and p is too, unless it is marked.
void update_stale(uint entry, uint slot, bool marked) {
    uint stamp = stamp_in(stamps.at[slot >> 2u], slot);
    Lag lag = NO_LAG;
    if (stamp != now) lag = rows.at[stamp].lag;
    [[unroll]] for (uint k = 0u; k < PAIRS; ++k) {
        AdamState x = AdamState(load_features(reading(table), entry, k), load_features(reading(first_moment), entry, k),
                                load_features(reading(second_moment), entry, k));
        vec2 g = load_sums(grads, entry, k);
        if (!marked) x.p = caught_up(x, lag, rows, stamp, now, rates);
        x.m *= lag.first;
        x.v *= lag.second;
        if (!bad) x = adam_step(x, g, rates);
        if (marked) clear_sums(grads, entry, k);
        store_features(table, entry, k, x.p);
        store_features(first_moment, entry, k, x.m);
        store_features(second_moment, entry, k, x.v);
    }
    stamps.at[slot >> 2u] ^= (stamp ^ next) << (8u * (slot & 3u));
}

void main() {
    uint l = slice();
    Level level = levels.at[l];
    LevelUse use = uses.at[l];
    if (use.whole != 0u) return;
    now = clock.at[0];
    bad = bad_step.at[0] != 0u;
    next = bad ? now : (now + 1u) % READINGS;
    rates = Rates(rate, decay, correction, one_minus_beta1, one_minus_beta2, epsilon);

    uint word = item() * STRIP, end = min(word + STRIP, (level.entries + 31u) / 32u);
    bool all = mostly_touched(level, use.touched, most) || item() / 8u % SWEEP == step % SWEEP;
    uint marked = 0u, bits = 0u;
    while (true) {
        // The next word with something to do.
        for (; bits == 0u && word < end; ++word) {
            uint at = first_slot(level, l) / 32u + word;
            marked = marks.at[at];
            if (marked != 0u) marks.at[at] = 0u;
            uint n_entries = min(level.entries - word * 32u, 32u);
            bits = all ? ~0u >> (32u - n_entries) : marked;
        }
        if (bits == 0u) break;
        uint entry = (word - 1u) * 32u + findLSB(bits);
        update_stale(level.offset + entry, first_slot(level, l) + entry, (marked & bits & (~bits + 1u)) != 0u);
        bits &= bits - 1u;
    }
}
