// Items abreast: neighbours in a subgroup take neighbouring items, whose numbers lie side by side in memory.
//
// A software device fetches what its lanes read one after the other, wherever it lies; but a number that all lanes read is one access, and
// its compiler joins LANES of them that lie side by side to a vector. So where LANES is not 0, each lane reads those of all, and picks its own.
// (Writes have no such form. Where some lanes have left, nothing is joined: no invocation leaves before it has read.)
//
// Such a device goes through a loop's body once more when the loop has ended, with no lane at work; what all lanes read, it reads all the
// same. So in a loop, its place has to exist even then.

// Lanes of a subgroup, on devices that gain by it, otherwise 0; the device says it.
layout(constant_id = 110) const uint LANES = 0;

struct Item {
    uint at;     // this invocation's
    uint first;  // its subgroup's first, with LANES
    bool again;  // another invocation's, too
};

// Of the items of a subgroup that begin at `first`, before `end`, this invocation's. Past the end, the last ones are done again: they may
// write what the other invocation writes, but add nothing. There are at least LANES items: with fewer, Recorder::run takes the kernel
// without LANES.
Item item_from(uint first, uint end) {
    uint whole = LANES == 0u ? first : min(first, end - LANES);
    uint at = whole + gl_SubgroupInvocationID;
    return LANES == 0u ? Item(min(at, end - 1u), 0u, at >= end) : Item(at, whole, at < first);
}

// The item of an invocation that has one, of those from begin to end, as if its workgroup had this index.
Item item_of(uint workgroup, uint begin, uint end) {
    uint at = begin + workgroup * gl_WorkGroupSize.x + gl_LocalInvocationID.x;
    uint first = begin + (workgroup * gl_NumSubgroups + gl_SubgroupID) * items_abreast();
    return LANES == 0u ? Item(min(at, end - 1u), 0u, at >= end) : item_from(first, end);
}

Item item_of(uint begin, uint end) { return item_of(group(), begin, end); }

// The same item where `begin` is counted as 0.
Item counted_from(uint begin, Item item) { return Item(item.at - begin, item.first - begin, item.again); }

// The number of an item, of those that begin at an element of an array. (`mix`: a choice by `?:` would be a branch around its read.)
float number_of(F32s p, uint row, Item item) {
    if (LANES == 0u) return p.at[row + item.at];
    F32s of_lane = from(p, row + item.first);
    float number = of_lane.at[0];
    [[unroll]] for (uint lane = 1u; lane < LANES; ++lane) number = mix(number, of_lane.at[lane], gl_SubgroupInvocationID == lane);
    return number;
}

// The vector of an item, of [3, n].
vec3 vector_of(F32s planes, uint n, Item item) {
    return vec3(number_of(planes, 0u, item), number_of(planes, n, item), number_of(planes, 2u * n, item));
}

// The two numbers of an item, of those in pairs that begin at an even element of an array.
#ifdef CORE_ONLY
vec2 pair_of(F32s p, uint row, Item item) { return pair_at(p, row + 2u * item.at); }
#else
vec2 pair_of(F32s p, uint row, Item item) {
    if (LANES == 0u) return pair_at(p, row + 2u * item.at);
    U64s of_lane = U64s(uvec2(from(p, row + 2u * item.first)));
    uint64_t pair = of_lane.at[0];
    [[unroll]] for (uint lane = 1u; lane < LANES; ++lane) pair = mix(pair, of_lane.at[lane], gl_SubgroupInvocationID == lane);
    return uintBitsToFloat(unpackUint2x32(pair));
}
#endif
