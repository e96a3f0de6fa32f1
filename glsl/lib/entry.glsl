// An entry of a hash table: FEATURES numbers side by side (the including kernel's constant), read and written in pairs; a single feature
// has 0 beside it.
#include "lib/sums.glsl"

const uint PAIRS = (FEATURES + 1u) / 2u;

vec2 load_features(F32s table, uint entry, uint pair) {
    return FEATURES == 1u ? vec2(table.at[entry], 0.0) : pair_at(table, entry * FEATURES + 2u * pair);
}

void store_features(F32sMut table, uint entry, uint pair, vec2 x) {
    if (FEATURES == 1u) {
        table.at[entry] = x[0];
    } else {
        set_pair(table, entry * FEATURES + 2u * pair, x);
    }
}

// The same of an entry's gradient.
vec2 load_sums(SumsMut grads, uint entry, uint pair) {
    return FEATURES == 1u ? vec2(sum_at(grads, entry), 0.0) : sums_at(grads, entry * FEATURES + 2u * pair);
}

void clear_sums(SumsMut grads, uint entry, uint pair) {
    if (FEATURES == 1u) {
        clear(grads, entry);
    } else {
        clear_pair(grads, entry * FEATURES + 2u * pair);
    }
}

void add_alone(SumsMut grads, uint entry, uint pair, vec2 v) {
    if (FEATURES == 1u) {
        add_alone(grads, entry, v.x);
    } else {
        add_pair_alone(grads, entry * FEATURES + 2u * pair, v);
    }
}
