#version 460
// Marks the hash table's entries around points that are about to be looked up, one (point, level) per invocation. Where points are few,
// entries are brought up to date by whoever marks them (SETTLES), in place of going over all marks for them (table_settle).
#include "lib/prelude.glsl"
#include "lib/hash_grid.glsl"
#include "lib/lazy_table.glsl"

layout(constant_id = 0) const uint LEVELS = 12;
layout(constant_id = 1) const uint FEATURES = 2;
layout(constant_id = 2) const uint SETTLES = 0;
#include "lib/entry.glsl"
#include "lib/half_copy.glsl"

layout(push_constant, scalar) uniform Args {
    Levels levels;
    F32s points;            // [3, n]
    LevelUsesMut uses;      // [LEVELS] counted
    U32sMut marks;          // [slots / 32] a bit each
    ClockRows rows;         // [256] from here on for SETTLES alone
    U32s clock;             // [1]
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
    uint n;
};

#include "lib/settle.glsl"

void restamp(uint slot, uint of_four, uint change) { atomicXor(stamps.at[slot >> 2u], change); }

void main() {
    uint point = item();
    uint l = level_of_slice(LEVELS);
    if (point >= n) return;
    uint whole = uses.at[l].whole;
    if (whole > 1u) return;  // in its last step as a whole one, a level is counted
    Level level = levels.at[l];
    Cell cell = cell_of(level, vector_at(points, point, n));
    uint marked = 0u;
    for (uint corner = 0u; corner < 8u; ++corner) {
        uint entry = corner_entry(level, cell, corner);
        uint slot = first_slot(level, l) + entry - level.offset;
        uint bit = 1u << (slot & 31u);
        // Looking first spares most of the atomics.
        if ((marks.at[slot >> 5u] & bit) != 0u) continue;
        if ((atomicOr(marks.at[slot >> 5u], bit) & bit) != 0u) continue;
        ++marked;
        if (SETTLES != 0u && whole == 0u) {
            atomicOr(settled.at[slot >> 5u], bit);
            settle(entry, slot, clock.at[0]);
        }
    }
    marked = subgroupAdd(marked);
    if (subgroupElect()) atomicAdd(uses.at[l].marked, marked);
}
