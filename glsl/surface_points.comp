#version 460
#include "lib/prelude.glsl"
#include "lib/sampling.glsl"
// Where the surface network is asked: the start of every bin, and around it the six taps of the finite-difference gradient, one
// invocation per bin (Wang et al. 2024, NeuRodin: the step is random, one per sample).
//     x_i = o + t_i d,  delta = max(tap_range u, tap_floor),  taps x_i +- delta e_axis
layout(push_constant, scalar) uniform Args {
    F32s origins;    // [3, n]
    F32s directions; // [3, n]
    F32s near_far;   // [2, n]
    F32s edges;      // [n, n_samples + 1]
    F32s tap_draws;  // [n * n_samples] u in [0,1); read only for 7 blocks
    F32sMut points;  // [3, n_blocks * n * n_samples]: block 0 the starts, then +x, -x, +y, -y, +z, -z
    uint n;
    uint n_samples;
    uint n_blocks;   // 1: starts only, 7: with taps
    float tap_range; // region units
    float tap_floor; // region units
};

void main() {
    uint index = item();
    uint count = n * n_samples;
    if (index >= count) return;
    uint ray = index / n_samples;
    uint total = n_blocks * count;
    float t = distance_at(ray_span(near_far, n, ray), edges.at[index + ray]); // edges have one more per ray than bins
    vec3 start;
    [[unroll]] for (uint axis = 0u; axis < 3u; axis++) {
        start[axis] = origins.at[axis * n + ray] + t * directions.at[axis * n + ray];
        points.at[axis * total + index] = start[axis];
    }
    if (n_blocks == 1u) return;
    float delta = tap_step(tap_draws.at[index], tap_range, tap_floor);
    [[unroll]] for (uint axis = 0u; axis < 3u; axis++) {
        [[unroll]] for (uint tap = 0u; tap < 3u; tap++) {
            uint plus = axis * total + (1u + 2u * tap) * count + index;
            float step = tap == axis ? delta : 0.0;
            points.at[plus] = start[axis] + step;
            points.at[plus + count] = start[axis] - step;
        }
    }
}
