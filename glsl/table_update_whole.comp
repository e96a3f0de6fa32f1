#version 460
// AdamW of all parameters of those levels of the hash table (the slice) that are updated whole; of the others
// entries wait until they are asked for (table_settle).
#include "lib/prelude.glsl"
#include "lib/hash_grid.glsl"
#include "lib/lazy_table.glsl"
#include "lib/update_pair.glsl"

layout(constant_id = 0) const uint LEVELS = 12;
layout(constant_id = 1) const uint FEATURES = 2;
layout(constant_id = 2) const uint TURNS = 64;  // pairs of parameters of an invocation: few workgroups where there is nothing to do

layout(push_constant, scalar) uniform Args {
    Levels levels;
    LevelUses uses;         // [levels]
    U32s clock;             // [1]
    U32s bad_step;          // [1] non-zero: losses not finite
    F32sMut table;          // [entries, FEATURES]
    U32sMut halves;         // [entries, FEATURES / 2] its copy, with HALF
    SumsMut grads;          // [entries, FEATURES] consumed
    F32sMut first_moment;   // [entries, FEATURES]
    F32sMut second_moment;  // [entries, FEATURES]
    U32sMut stamps;         // [slots / 4] a byte each
    float rate;             // η / (1 − β₁ᵗ)
    float decay;            // η λ
    float correction;       // √(1 − β₂ᵗ)
    float one_minus_beta1;  // 1 − β₁
    float one_minus_beta2;  // 1 − β₂
    float epsilon;
};

void main() {
    uint l = level_of_slice(LEVELS);
    uint whole = uses.at[l].whole;
    if (whole == 0u) return;
    Level level = levels.at[l];
    // Copied to locals before the loop, as in field_forward.
    F32sMut table = table, first_moment = first_moment, second_moment = second_moment;
    U32sMut halves = halves;
    SumsMut grads = grads;
    uint n_pairs = level.entries * FEATURES / 2u;  // levels have an even number of entries, and more than a subgroup has lanes
    if (group() * LOCAL_SIZE * TURNS >= n_pairs) return;  // the launch is as long as the largest level
    bool bad = bad_step.at[0] != 0u;
    Rates rates = Rates(rate, decay, correction, one_minus_beta1, one_minus_beta2, epsilon);
    uint first = first_of_subgroup(TURNS), row = level.offset * FEATURES;
    for (uint turn = 0u; turn < TURNS; ++turn) {
        update_pair(table, halves, grads, first_moment, second_moment, row, item_from(first, n_pairs), bad, rates);
        first += items_abreast();
    }
    // Unless the level stays whole, the next step settles its entries one by one, and needs their stamps.
    if (whole == 1u) {
        uint next = bad ? clock.at[0] : (clock.at[0] + 1u) % READINGS;
        uint n_words = (level.entries + 3u) / 4u, per_group = 2u * LOCAL_SIZE * TURNS / FEATURES / 4u;
        for (uint j = gl_LocalInvocationID.x; j < per_group; j += LOCAL_SIZE) {
            uint word = group() * per_group + j;
            if (word < n_words) stamps.at[first_slot(level, l) / 4u + word] = next * 0x01010101u;
        }
    }
}
