// A copy of a hash table in float16, pairs of features in the table's order, where the configuration wants one: look-ups read it, updates go
// to the table and are rounded into it at once. So a look-up asks for half the bytes, and small updates are not lost.

layout(constant_id = 20) const uint HALF = 0;  // 1: there is one

// Of the pair that begins at an even index.
void copy_pair(U32sMut halves, uint i, vec2 x) {
    if (HALF != 0u) halves.at[i >> 1u] = packHalf2x16(x);
}
