#version 460
// Tangent-normal loss and its gradients, one sample per invocation (Rosu and Behnke 2023, PermutoSDF, as in NeuRodin's released code): the
// angle between the normals n at a sample and n' beside it, L = acos(clamp(n·n', ±(1 - 1e-6)))/π. Beyond the clamp there is no gradient.
#include "lib/prelude.glsl"
#include "lib/tangent.glsl"

layout(push_constant, scalar) uniform Args {
    F32s gradient;             // [3, n] g
    F32s gradient_beside;      // [3, n] g'
    F32sMut loss;              // [n] L
    F32sMut d_gradient;        // [3, n] accumulated
    F32sMut d_gradient_beside; // [3, n] overwritten
    uint n;
    float scale;               // of the gradients: weight / n
};

void main() {
    uint p = item();
    if (p >= n) return;
    vec3 g = vector_at(gradient, p, n), beside = vector_at(gradient_beside, p, n);
    vec3 normal = normal_of(g), normal_beside = normal_of(beside);
    // The angle from sine and cosine: from the cosine alone it would lose its digits where the normals agree, which is nearly everywhere.
    float sine = length(cross(normal, normal_beside));
    float angle = atan(sine, dot(normal, normal_beside));
    const float SMALLEST = 1.41421368e-3;  // acos(1 - 1e-6)
    bool clamped = angle < SMALLEST || angle > PI - SMALLEST;
    loss.at[p] = clamp(angle, SMALLEST, PI - SMALLEST) / PI;
    float d_c = clamped ? 0.0 : -scale / (PI * sine);
    vec3 d_g = normal_backward(g, d_c * normal_beside), d_beside = normal_backward(beside, d_c * normal);
    set_vector(d_gradient, p, n, vector_at(reading(d_gradient), p, n) + d_g);
    set_vector(d_gradient_beside, p, n, d_beside);
}
