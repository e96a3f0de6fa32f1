// One row of a weight-normalised matrix: where its direction v, its length g and its effective weights stand.

struct WeightRow {
    uint v;        // first element of the row's direction, in the parameter block
    uint g;        // its length, in the parameter block
    uint weight;   // first element of the row's effective weights
    uint columns;
};
layout(buffer_reference, scalar) readonly buffer WeightRows { WeightRow at[]; };
