#version 460
// Marks the hash table's entries around points that are about to be looked up, and brings p of those that were left alone up to date,
// one (point, level) per invocation: whoever marks an entry first sees to it. Their moments follow in table_update.
#include "lib/prelude.glsl"
#include "lib/hash_grid.glsl"
#include "lib/lazy_table.glsl"

layout(constant_id = 0) const uint LEVELS = 12;
layout(constant_id = 1) const uint FEATURES = 2;
#include "lib/entry.glsl"

layout(push_constant, scalar) uniform Args {
    Levels levels;
    F32s points;           // [3, n]
    ClockRows rows;        // [256]
    U32s clock;            // [1]
    U32s stamps;           // [slots / 4] a byte each
    F32s first_moment;     // [entries, FEATURES]
    F32s second_moment;    // [entries, FEATURES]
    LevelUsesMut uses;     // [LEVELS] counted
    U32sMut marks;         // [slots / 32] a bit each
    F32sMut table;         // [entries, FEATURES]
    uint n;
    float one_minus_beta1; // 1 − β₁
    float one_minus_beta2; // 1 − β₂
    float epsilon;
};

void main() {
    uint point = item();
    uint l = level_of_slice(LEVELS);
    if (point >= n || uses.at[l].whole != 0u) return;
    Level level = levels.at[l];
    Cell cell = cell_of(level, vector_at(points, point, n));
    uint now = clock.at[0];
    Rates rates = Rates(0.0, 0.0, 1.0, one_minus_beta1, one_minus_beta2, epsilon);
    uint touched = 0u;
    for (uint corner = 0u; corner < 8u; ++corner) {
        uint entry = corner_entry(level, cell, corner);
        uint slot = first_slot(level, l) + entry - level.offset;
        uint bit = 1u << (slot & 31u);
        // Looking first spares most of the atomics.
        if ((marks.at[slot >> 5u] & bit) != 0u) continue;
        if ((atomicOr(marks.at[slot >> 5u], bit) & bit) != 0u) continue;
        ++touched;
        uint stamp = stamp_in(stamps.at[slot >> 2u], slot);
        if (stamp == now) continue;
        Lag lag = rows.at[stamp].lag;
        [[unroll]] for (uint k = 0u; k < PAIRS; ++k) {
            AdamState x = AdamState(load_features(reading(table), entry, k), load_features(first_moment, entry, k),
                                    load_features(second_moment, entry, k));
            store_features(table, entry, k, caught_up(x, lag, rows, stamp, now, rates));
        }
    }
    touched = subgroupAdd(touched);
    if (subgroupElect()) atomicAdd(uses.at[l].touched, touched);
}
