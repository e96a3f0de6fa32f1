#version 460
// Adjoint of sight_distance, one sample per invocation: d_f = d_a / |c|,  d_g = -d_a f sign(c)/c² d. d_a is replaced by d_f in its place.
#include "lib/prelude.glsl"
#include "lib/sight.glsl"

layout(push_constant, scalar) uniform Args {
    F32s sdf;           // [n] f
    F32s gradient;      // [3, n] g
    F32s directions;    // [3, n_rays] d
    F32sMut d_distance; // [n] d_a in, d_f out
    F32sMut d_gradient; // [3, n] overwritten
    uint n;
    uint n_rays;
};

void main() {
    uint p = item();
    if (p >= n) return;
    uint ray = p / (n / n_rays);
    float c = cosine(gradient, directions, p, n, n_rays);
    float d_f = d_distance.at[p] / abs(c);
    d_distance.at[p] = d_f;
    float d_c = -d_f * sdf.at[p] / c;
    [[unroll]] for (uint axis = 0u; axis < 3u; ++axis) d_gradient.at[axis * n + p] = d_c * directions.at[axis * n_rays + ray];
}
