#version 460
// Hash grid, hidden layer and first output of a field in one pass, one point per invocation:
//   z = [x, e(x)],  u = W₁z + b₁,  h = σ(u),  out = w₂·h + b₂.
// The SDF and its taps, the proposal densities and the background density are all this kernel.
// In two launches, PART 1 with a slice per level and then PART 2, it suits devices whose caches hold one level but not all of them; there, few
// workgroups go over all points.
#include "lib/prelude.glsl"
#include "lib/hash_grid.glsl"
#include "lib/field.glsl"
#include "lib/look_up.glsl"
#include "lib/read_through.glsl"

// Further heads: 0 none of the points of this launch have any, 1 the first n_hidden have, 2 all have. (With 1 lavapipe branches per lane at
// every store of h: a launch for those that have and one for the others is faster.)
layout(constant_id = 7) const uint HEADS = 1;
layout(constant_id = 8) const uint PART = 0;      // 0 everything, 1 the encoding of one level per slice, 2 the network
layout(constant_id = 9) const uint STRAIGHT = 0;
layout(constant_id = 10) const uint KEPT = 0;     // order up to which PART 1 keeps the encoding's derivatives: 0, 1 or 2
#include "lib/tile.glsl"

layout(push_constant, scalar) uniform Args {
    Levels levels;
    U32s table;          // [entries, FEATURES], or its copy (lib/look_up.glsl)
    F32s hidden_weight;  // [HIDDEN, INPUTS]
    F32s hidden_bias;    // [HIDDEN]
    F32s head_weight;    // [HIDDEN]
    F32s head_bias;      // [1]
    F32s points;         // [3, n] region frame
    F32sMut inputs;      // [INPUTS, n] z, kept for the backward pass
    F32sMut hidden;      // [HIDDEN, stride_hidden] h of the first n_hidden points, for further heads
    F32sMut first;       // [n] out
    F32sMut derivatives; // [3 KEPT, LEVELS·FEATURES, n] of the encoding
    uint n;
    uint n_hidden;
    uint stride_hidden;
    uint begin;          // the points of this launch
    uint end;
    uint points_each;    // of an invocation of PART 1
};

// Three derivatives of a feature, from a row on.
void keep(vec3 d, uint row, uint feature, uint point) {
    [[unroll]] for (uint i = 0u; i < 3u; ++i) derivatives.at[derivative_row(row + i, feature) * n + point] = d[i];
}

// A level's part of a point's encoding.
void encode(Level level, uint l, Item item) {
    uint point = item.at;
    vec3 x = vector_of(points, n, item);
    Cell cell = cell_of(level, x);
    uint entries[8];
    [[unroll]] for (uint corner = 0u; corner < 8u; ++corner) entries[corner] = corner_entry(level, cell, corner);
    [[unroll]] for (uint k = 0u; k < PAIRS; ++k) {
        vec2 corners[8];
        [[unroll]] for (uint corner = 0u; corner < 8u; ++corner) corners[corner] = look_up(table, entries[corner], k);
        Interpolation e = interpolate(corners, cell.weight);
        [[unroll]] for (uint f = 2u * k; f < min(2u * k + 2u, FEATURES); ++f) {
            uint feature = l * FEATURES + f;
            inputs.at[(COORDINATES + feature) * n + point] = e.value[f % 2u];
            if (KEPT >= 1u) keep(slope_of(level, e, f % 2u), 0u, feature, point);
            if (KEPT >= 2u) keep(mixed_of(level, e, f % 2u), 3u, feature, point);
        }
    }
    if (COORDINATES != 0u && l == 0u) set_vector(inputs, point, n, x);
}

// The same of this workgroup's share of the points. (How many those are cannot be told from the number of workgroups: a long launch comes in
// parts, each with a number of its own.)
void encode_level() {
    uint l = level_of_slice(LEVELS), turns = points_each;
    Level level = levels.at[l];
    uint words_of_entry = HALF != 0u ? FEATURES / 2u : FEATURES;
    uint n_words = level.entries * words_of_entry;
    // Where there are many workgroups, they have one turn each, and share a cache.
    if (turns > 1u && read_through(table, level.offset * words_of_entry, n_words, turns * LOCAL_SIZE) > n_words) return;  // never
    uint first = begin + first_of_subgroup(turns);
    for (uint turn = 0u; turn < turns; ++turn) {
        encode(level, l, item_from(first, end));
        first += items_abreast();
    }
}

void main() {
    if (PART == 1u) {
        encode_level();
        return;
    }
    Item point = item_of(begin, end);
    if (PART == 0u) {
        for (uint l = 0u; l < LEVELS; ++l) encode(levels.at[l], l, point);
    }
    // Copied to locals before the loop: lavapipe bounds-checks every read of a push constant by a branch, behind which it then computes the
    // sums that are used there, while their products wait on the stack.
    F32s hidden_weight = hidden_weight, hidden_bias = hidden_bias, head_weight = head_weight;
    F32sMut hidden = hidden;
    uint n_hidden = n_hidden, stride_hidden = stride_hidden;
    load_input(reading(inputs), n, point);

    float sum = BIAS != 0u ? head_bias.at[0] : 0.0;
    uint neurons = turns(HIDDEN, n);
    uint first_neuron = 0u;
    [[unroll]] do {
        F32s weight = from(hidden_weight, first_neuron * INPUTS);
        preactivate(weight, from(hidden_bias, first_neuron));
        [[unroll]] for (uint t = 0u; t < TILE; ++t) {
            float h = activation(u[t]);
            sum = fma(head_weight.at[first_neuron + t], h, sum);
            if (HEADS != 0u && (HEADS == 2u || point.at < n_hidden)) hidden.at[(first_neuron + t) * stride_hidden + point.at] = h;
        }
        first_neuron += TILE;
    } while (first_neuron < neurons);
    first.at[point.at] = sum;
}
