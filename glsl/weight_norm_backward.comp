#version 460
// Adjoint of weight_norm_forward, one row per invocation: with s = d_W·v/‖v‖,
//   d_g += s,  d_v += g/‖v‖ (d_W − s v/‖v‖).  d_W is consumed: zeroed for the next step.
#include "lib/prelude.glsl"
#include "lib/sums.glsl"
#include "lib/weight_rows.glsl"

layout(push_constant, scalar) uniform Args {
    WeightRows rows;     // [n]
    F32s params;
    SumsMut d_weights;   // consumed
    SumsMut d_params;    // accumulated
    uint n;
    uint released_columns;
};

void main() {
    uint r = item();
    if (r >= n) return;
    WeightRow row = rows.at[r];
    float square = 0.0;
    float along = 0.0;
    uint acting = acting_columns(row, released_columns);
    for (uint i = 0u; i < row.columns; ++i) {
        float v = params.at[row.v + i];
        square = fma(v, v, square);
        if (i < acting) along = fma(v, sum_at(d_weights, row.weight + i), along);
    }
    float inverse = inversesqrt(square);
    along *= inverse;
    add_alone(d_params, row.g, along);
    float scale = params.at[row.g] * inverse;
    for (uint i = 0u; i < row.columns; ++i) {
        float d_weight = i < acting ? sum_at(d_weights, row.weight + i) : 0.0;
        add_alone(d_params, row.v + i, scale * (d_weight - along * inverse * params.at[row.v + i]));
        clear(d_weights, row.weight + i);
    }
}
