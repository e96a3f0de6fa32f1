#version 460
// Marks the hash table's entries around points that are about to be looked up, one (point, level) per invocation.
#include "lib/prelude.glsl"
#include "lib/hash_grid.glsl"
#include "lib/lazy_table.glsl"

layout(constant_id = 0) const uint LEVELS = 12;

layout(push_constant, scalar) uniform Args {
    Levels levels;
    F32s points;        // [3, n]
    LevelUsesMut uses;  // [LEVELS] counted
    U32sMut marks;      // [slots / 32] a bit each
    uint n;
};

void main() {
    uint point = item();
    uint l = level_of_slice(LEVELS);
    if (point >= n || uses.at[l].whole > 1u) return;  // in its last step as a whole one, a level is counted
    Level level = levels.at[l];
    Cell cell = cell_of(level, vector_at(points, point, n));
    uint marked = 0u;
    for (uint corner = 0u; corner < 8u; ++corner) {
        uint slot = first_slot(level, l) + corner_entry(level, cell, corner) - level.offset;
        uint bit = 1u << (slot & 31u);
        // Looking first spares most of the atomics.
        if ((marks.at[slot >> 5u] & bit) != 0u) continue;
        if ((atomicOr(marks.at[slot >> 5u], bit) & bit) == 0u) ++marked;
    }
    marked = subgroupAdd(marked);
    if (subgroupElect()) atomicAdd(uses.at[l].marked, marked);
}
