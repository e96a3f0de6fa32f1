// What both kernels of a layer know of it.
#include "lib/scalar.glsl"

uint weight_index(uint o, uint i) { return TRANSPOSED != 0u ? i * WEIGHT_COLUMNS + o : o * WEIGHT_COLUMNS + i; }

float activated(float u) {
    if (ACTIVATION == 1u) return max(u, 0.0);
    if (ACTIVATION == 2u) return sigmoid(u);
    return u;
}
