#version 460
// Effective weights of every weight-normalised row: W = g·v/‖v‖ (Salimans & Kingma 2016), one row per invocation.
#include "lib/prelude.glsl"
#include "lib/weight_rows.glsl"

layout(push_constant, scalar) uniform Args {
    WeightRows rows;   // [n]
    F32s params;
    F32sMut weights;
    uint n;
    uint released_columns;
};

void main() {
    uint r = item();
    if (r >= n) return;
    WeightRow row = rows.at[r];
    float square = 0.0;
    for (uint i = 0u; i < row.columns; ++i) square = fma(params.at[row.v + i], params.at[row.v + i], square);
    float scale = params.at[row.g] / sqrt(square);
    uint acting = acting_columns(row, released_columns);
    for (uint i = 0u; i < row.columns; ++i) weights.at[row.weight + i] = i < acting ? scale * params.at[row.v + i] : 0.0;
}
