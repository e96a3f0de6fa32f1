#version 460
// The signed distance along the line of sight, one sample per invocation: a = f / |c|,  c = g·d + 1e-8 (METHOD 2.5; TUVR).
// A density of a has its heaviest point at the same depth behind a plane whatever the angle.
#include "lib/prelude.glsl"
#include "lib/sight.glsl"

layout(push_constant, scalar) uniform Args {
    F32s sdf;          // [n] f
    F32s gradient;     // [3, n] g
    F32s directions;   // [3, n_rays] d
    F32sMut distance_; // [n] a
    uint n;
    uint n_rays;
};

void main() {
    uint p = item();
    if (p >= n) return;
    distance_.at[p] = sdf.at[p] / abs(cosine(gradient, directions, p, n, n_rays));
}
