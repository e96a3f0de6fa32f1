#version 460
// One layer of a network on planar activations: Y = σ(WX + b), or with TRANSPOSED its adjoint d_X = Wᵀd_Y, gated by the derivative
// of the ReLU that made X. One sample and TILE output channels per invocation; with HELD all tiles of a sample.
#include "lib/prelude.glsl"

layout(constant_id = 0) const uint INPUTS = 64;
layout(constant_id = 1) const uint OUTPUTS = 64;
layout(constant_id = 2) const uint WEIGHT_COLUMNS = 64;  // row length of the stored matrix
layout(constant_id = 3) const uint TRANSPOSED = 0;
layout(constant_id = 4) const uint BIAS = 1;
layout(constant_id = 5) const uint ACTIVATION = 0;       // 0 none, 1 ReLU, 2 sigmoid
layout(constant_id = 6) const uint GATED = 0;            // multiply by 1[gate > 0]
layout(constant_id = 7) const uint TILE = 16;            // at most OUTPUTS
layout(constant_id = 8) const uint HELD = 0;             // an invocation holds its inputs, for all of its tiles
layout(constant_id = 9) const uint STRAIGHT = 0;         // with HELD: no loops
const uint TILES = (OUTPUTS + TILE - 1u) / TILE;
const uint PARTS = HELD != 0u ? 1u : TILES;              // workgroups for the same samples, neighbours, so that one cache serves them all
const uint CHUNK = HELD != 0u ? INPUTS : 8u;             // inputs that are written out one after the other
const uint LAST_CHUNK = INPUTS < CHUNK ? 0u : INPUTS / CHUNK - 1u;
#include "lib/linear.glsl"
#include "lib/straight.glsl"
#include "lib/abreast.glsl"

layout(push_constant, scalar) uniform Args {
    F32s x;         // [INPUTS, stride_x]
    F32s weight;    // forward [OUTPUTS, WEIGHT_COLUMNS], transposed [INPUTS, WEIGHT_COLUMNS]
    F32s bias;      // [OUTPUTS]
    F32s gate;      // [OUTPUTS, stride_y] post-ReLU values; y may take their place
    F32sMut y;      // [OUTPUTS, stride_y]
    uint n;
    uint stride_x;  // at least n
    uint stride_y;
};

float held[HELD != 0u ? INPUTS : 1u];

// What `count` inputs from i0 on add to the outputs from `first` on.
void add_products(inout float sum[TILE], uint first, uint i0, const uint count, Item sample_) {
    F32s block = from(weight, weight_index(first, i0));
    [[unroll]] for (uint i = 0u; i < count; ++i) {
        float value = HELD != 0u ? held[i] : number_of(x, (i0 + i) * stride_x, sample_);
        [[unroll]] for (uint t = 0u; t < TILE; ++t) sum[t] = fma(block.at[weight_index(t, i)], value, sum[t]);
    }
}

void main() {
    Item sample_ = item_of(group() / PARTS, 0u, n);
    // Where there is a gate, y may be in its place already when a sample is done again.
    bool writes = GATED == 0u || !sample_.again;
    if (HELD != 0u) {
        [[unroll]] for (uint i = 0u; i < INPUTS; ++i) held[i] = number_of(x, i * stride_x, sample_);
    }
    // Of what is held there is one chunk, but the compiler cannot know it: what a loop returns is summed up in it. Otherwise a software
    // device moves sums to where they are stored, away from their products, which then take the way over the stack.
    uint chunks = turns(INPUTS / CHUNK, n);
    uint begin = group() % PARTS;
    uint end = HELD != 0u ? turns(TILES, n) : begin + 1u;
    [[unroll]] for (uint tile = begin; tile < end; ++tile) {
        // The last tile begins where it still is a whole one, and does not store what the tile before it stores.
        uint first = min(tile * TILE, OUTPUTS - TILE);
        float sum[TILE];
        [[unroll]] for (uint t = 0u; t < TILE; ++t) sum[t] = BIAS != 0u ? bias.at[first + t] : 0.0;
        [[unroll]] for (uint c = 0u; c < chunks; ++c) add_products(sum, first, min(c, LAST_CHUNK) * CHUNK, CHUNK, sample_);
        add_products(sum, first, INPUTS / CHUNK * CHUNK, INPUTS % CHUNK, sample_);
        [[unroll]] for (uint t = 0u; t < TILE; ++t) {
            if (OUTPUTS % TILE == 0u || first + t >= tile * TILE) {
                float value = activated(sum[t]);
                uint at = (first + t) * stride_y + sample_.at;
                if (GATED != 0u && !(number_of(gate, (first + t) * stride_y, sample_) > 0.0)) value = 0.0;
                if (writes) y.at[at] = value;
            }
        }
    }
}
