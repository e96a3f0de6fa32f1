#version 460
// Adjoint of y = sigmoid(u) in place: d_u = d_y · y(1 − y).
#include "lib/prelude.glsl"

layout(push_constant, scalar) uniform Args {
    F32s y;       // [n]
    F32sMut d_y;  // [n] becomes d_u
    uint n;
};

void main() {
    uint i = item();
    if (i >= n) return;
    d_y.at[i] = d_y.at[i] * y.at[i] * (1.0 - y.at[i]);
}
