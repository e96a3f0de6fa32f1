// Sums over a workgroup, always in the same order: the same numbers give the same sum in every run on a device.

shared float partial_sums[LOCAL_SIZE];  // of the subgroups

// The sum of every invocation's share, known to all of them. All take part.
float workgroup_sum(float share) {
    share = subgroupAdd(share);
    if (subgroupElect()) partial_sums[gl_SubgroupID] = share;
    barrier();
    float sum = 0.0;
    for (uint s = 0u; s < gl_NumSubgroups; ++s) sum += partial_sums[s];
    barrier(); // before the next sum takes the array
    return sum;
}
