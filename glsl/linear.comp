#version 460
// One layer of a network on planar activations: Y = σ(WX + b), or with TRANSPOSED its adjoint d_X = Wᵀd_Y, gated by the derivative
// of the ReLU that made X. One sample and TILE output channels per invocation; the slice picks the channels.
#include "lib/prelude.glsl"

layout(constant_id = 0) const uint INPUTS = 64;
layout(constant_id = 1) const uint OUTPUTS = 64;
layout(constant_id = 2) const uint WEIGHT_COLUMNS = 64;  // row length of the stored matrix
layout(constant_id = 3) const uint TRANSPOSED = 0;
layout(constant_id = 4) const uint BIAS = 1;
layout(constant_id = 5) const uint ACTIVATION = 0;       // 0 none, 1 ReLU, 2 sigmoid
layout(constant_id = 6) const uint GATED = 0;            // multiply by 1[gate > 0]
layout(constant_id = 7) const uint TILE = 16;
const uint CHUNK = 8;                                    // inputs per turn of the rolled loop for wide layers
#include "lib/linear.glsl"

layout(push_constant, scalar) uniform Args {
    F32s x;         // [INPUTS, n]
    F32s weight;    // forward [OUTPUTS, WEIGHT_COLUMNS], transposed [INPUTS, WEIGHT_COLUMNS]
    F32s bias;      // [OUTPUTS]
    F32s gate;      // [OUTPUTS, n] post-ReLU values
    F32sMut y;      // [OUTPUTS, n]
    uint n;
};

void main() {
    uint sample_ = item();
    if (sample_ >= n) return;
    uint first = slice() * TILE;
    // The last tile may overhang: it recomputes the last channel there and stores nothing.
    float sum[TILE];
    [[unroll]] for (uint t = 0u; t < TILE; ++t) sum[t] = BIAS != 0u ? bias.at[min(first + t, OUTPUTS - 1u)] : 0.0;
    if (INPUTS <= 64u) {
        [[unroll]] for (uint i = 0u; i < min(INPUTS, 64u); ++i) {
            float value = x.at[i * n + sample_];
            [[unroll]] for (uint t = 0u; t < TILE; ++t)
                sum[t] = fma(weight.at[weight_index(min(first + t, OUTPUTS - 1u), i)], value, sum[t]);
        }
    } else {
        for (uint i0 = 0u; i0 < INPUTS; i0 += CHUNK) {
            [[unroll]] for (uint c = 0u; c < CHUNK; ++c) {
                uint i = min(i0 + c, INPUTS - 1u);
                float value = i0 + c < INPUTS ? x.at[i * n + sample_] : 0.0;
                [[unroll]] for (uint t = 0u; t < TILE; ++t)
                    sum[t] = fma(weight.at[weight_index(min(first + t, OUTPUTS - 1u), i)], value, sum[t]);
            }
        }
    }
    [[unroll]] for (uint t = 0u; t < TILE; ++t) {
        if (first + t < OUTPUTS) {
            float value = activated(sum[t]);
            uint at = (first + t) * n + sample_;
            if (GATED != 0u && !(gate.at[at] > 0.0)) value = 0.0;
            y.at[at] = value;
        }
    }
}
