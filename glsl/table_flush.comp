#version 460
// Brings every entry of the hash table up to date, for whoever reads all of it, one pair of an entry's parameters per invocation;
// the level is the slice. Stamps and marks are the caller's to clear.
#include "lib/prelude.glsl"
#include "lib/hash_grid.glsl"
#include "lib/lazy_table.glsl"

layout(constant_id = 0) const uint FEATURES = 2;
#include "lib/entry.glsl"

layout(push_constant, scalar) uniform Args {
    Levels levels;
    LevelUses uses;         // [levels]
    ClockRows rows;         // [256]
    U32s clock;             // [1]
    U32s marks;             // [slots / 32] a bit each
    U32s stamps;            // [slots / 4] a byte each
    F32sMut table;          // [entries, FEATURES]
    F32sMut first_moment;   // [entries, FEATURES]
    F32sMut second_moment;  // [entries, FEATURES]
    float one_minus_beta1;  // 1 − β₁
    float one_minus_beta2;  // 1 − β₂
    float epsilon;
};

void main() {
    uint l = slice(), k = item() % PAIRS, in_level = item() / PAIRS;
    Level level = levels.at[l];
    if (in_level >= level.entries || uses.at[l].whole != 0u) return;
    uint entry = level.offset + in_level, slot = first_slot(level, l) + in_level;
    uint now = clock.at[0];
    uint stamp = stamp_in(stamps.at[slot >> 2u], slot);
    if (stamp == now) return;
    AdamState x = AdamState(load_features(reading(table), entry, k), load_features(reading(first_moment), entry, k),
                            load_features(reading(second_moment), entry, k));
    bool marked = (marks.at[slot >> 5u] >> (slot & 31u) & 1u) != 0u;
    Lag lag = rows.at[stamp].lag;
    if (!marked) {
        store_features(table, entry, k, caught_up(x, lag, rows, stamp, now, Rates(0.0, 0.0, 1.0, one_minus_beta1, one_minus_beta2, epsilon)));
    }
    store_features(first_moment, entry, k, lag.first * x.m);
    store_features(second_moment, entry, k, lag.second * x.v);
}
