#version 460
// Adjoint of tangent_points into the samples' gradients, one sample per invocation: d_n = 0.01 r × d_q.
#include "lib/prelude.glsl"
#include "lib/tangent.glsl"

layout(push_constant, scalar) uniform Args {
    F32s gradient;      // [3, n] g
    F32s draws;         // [2, n]
    F32s d_points;      // [3, n] d_q
    F32sMut d_gradient; // [3, n] accumulated
    uint n;
};

void main() {
    uint p = item();
    if (p >= n) return;
    vec3 d_n = TANGENT_STEP * cross(random_direction(draws, p, n), vector_at(d_points, p, n));
    vec3 d_g = normal_backward(vector_at(gradient, p, n), d_n);
    set_vector(d_gradient, p, n, vector_at(reading(d_gradient), p, n) + d_g);
}
