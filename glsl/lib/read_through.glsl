// A core's cache, filled in order.
//
// A core of a software device that looks up a level of a hash table in no order waits for memory whenever a line comes for the first time; read in
// order, lines come many at once. So whoever will look up most of a level reads it through first.

const uint LINE = 16u;             // words
const uint MOST_WORDS = 1u << 18;  // more than a core's cache holds would be gone before it is asked for
const uint LINES_A_POINT = 16u;    // are read through in the time that one point waits

// For so many points, n words from a first one on; by the first subgroup, since a software device begins with the next when that one has ended.
// Returns how many lines do not begin with 0, at most n, for one reason: what nobody asks for the compiler does not read.
uint read_through(U32s words, uint first, uint n, uint points) {
    uint filled = 0u;
    if (gl_SubgroupID > 0u || n > MOST_WORDS || points * LINES_A_POINT < n / LINE) return filled;
    for (uint i = LINE * gl_SubgroupInvocationID; i < n; i += LINE * gl_SubgroupSize) filled += min(words.at[first + i], 1u);
    return filled;
}
