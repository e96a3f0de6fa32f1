#version 460
// Points of a regular lattice, x fastest: origin + step·(i, j, k). One point per invocation.
#include "lib/prelude.glsl"

layout(push_constant, scalar) uniform Args {
    F32sMut points;  // [3, n]
    uint n;
    uint first;      // lattice index of the first point
    uint n_x;
    uint n_y;
    vec3 origin;
    float step;
};

void main() {
    uint i = item();
    if (i >= n) return;
    uint index = first + i;
    vec3 cell = vec3(float(index % n_x), float(index / n_x % n_y), float(index / n_x / n_y));
    set_vector(points, i, n, fma(cell, vec3(step), origin));
}
