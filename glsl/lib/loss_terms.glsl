// The arrays that a batch's losses are sums of.
struct LossTerm {
    F32s values; // [count]
    uint count;
    float scale;
    uint counts; // 1: a loss, 0: a figure for the log
    uint padding;
};
layout(buffer_reference, scalar, buffer_reference_align = 8) readonly buffer LossTerms { LossTerm at[]; };
