#version 460
// The float16 copy of a hash table whose values were written from outside, a pair of features per invocation. (Updates keep it themselves.)
#include "lib/prelude.glsl"

layout(push_constant, scalar) uniform Args {
    F32s table;      // [2 n]
    U32sMut halves;  // [n]
    uint n;          // pairs
};

void main() {
    uint pair = item();
    if (pair < n) halves.at[pair] = packHalf2x16(pair_at(table, 2u * pair));
}
