// What a field reads of its hash table.
#include "lib/entry.glsl"
#include "lib/half_copy.glsl"

// A pair of an entry's features: of the table, [entries, FEATURES] floats, or of its copy with HALF.
vec2 look_up(U32s table, uint entry, uint pair) {
    if (HALF != 0u) return unpackHalf2x16(table.at[entry * PAIRS + pair]);
    return load_features(F32s(uvec2(table)), entry, pair);
}
