// The hidden neurons of a field at an invocation's point, TILE of them at a time.
#include "lib/straight.glsl"
#include "lib/abreast.glsl"

float z[INPUTS];  // the hidden layer's input
float u[TILE];    // what its activation is applied to

void load_input(F32s inputs, uint n, Item point) {
    [[unroll]] for (uint i = 0u; i < INPUTS; ++i) z[i] = number_of(inputs, i * n, point);
}

// u = W₁z + b₁ of the tile whose weights and biases begin here.
void preactivate(F32s weight, F32s bias) {
    [[unroll]] for (uint t = 0u; t < TILE; ++t) u[t] = BIAS != 0u ? bias.at[t] : 0.0;
    [[unroll]] for (uint i = 0u; i < INPUTS; ++i) {
        [[unroll]] for (uint t = 0u; t < TILE; ++t) u[t] = fma(weight.at[t * INPUTS + i], z[i], u[t]);
    }
}
