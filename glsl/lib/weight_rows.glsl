// One row of a weight-normalised matrix: where its direction v, its length g and its effective weights stand.

struct WeightRow {
    uint v;        // first element of the row's direction, in the parameter block
    uint g;        // its length, in the parameter block
    uint weight;   // first element of the row's effective weights
    uint columns;
    uint released; // 1: columns of hash levels that are not released yet are switched off
};
layout(buffer_reference, scalar) readonly buffer WeightRows { WeightRow at[]; };

// The columns that act: a level that is switched off has no effect, and no gradient.
uint acting_columns(WeightRow row, uint released_columns) {
    return row.released != 0u ? min(row.columns, released_columns) : row.columns;
}
