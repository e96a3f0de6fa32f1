// The colour network's input, as rows of a planar buffer with one column per sample:
//   row 0 scale logit v (not an input), then GEOMETRY features φ, gradient g (3), appearance code (APPEARANCE), position x (3),
//   direction encoding (27). Rows that receive gradients come first, so that the backward pass is one contiguous product.

layout(constant_id = 0) const uint GEOMETRY = 15;
layout(constant_id = 1) const uint APPEARANCE = 0;

const uint ROW_GRADIENT = 1u + GEOMETRY;
const uint ROW_APPEARANCE = ROW_GRADIENT + 3u;
const uint ROW_POSITION = ROW_APPEARANCE + APPEARANCE;
const uint ROW_DIRECTION = ROW_POSITION + 3u;
