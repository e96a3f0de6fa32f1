// Sums over a workgroup, always in the same order: the same numbers give the same sum in every run. For workgroups of a power of two.

shared float partial_sums[LOCAL_SIZE];

// The sum of every invocation's share, known to all of them. All take part.
float workgroup_sum(float share) {
    uint lane = gl_LocalInvocationID.x;
    partial_sums[lane] = share;
    barrier();
    for (uint stride = LOCAL_SIZE / 2u; stride > 0u; stride /= 2u) {
        if (lane < stride) partial_sums[lane] += partial_sums[lane + stride];
        barrier();
    }
    float sum = partial_sums[0];
    barrier(); // before the next sum takes the array
    return sum;
}
