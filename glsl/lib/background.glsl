// The background's colour network input, as rows of a planar buffer: GEOMETRY features, appearance code, spherical harmonics (16).

layout(constant_id = 0) const uint GEOMETRY = 15;
layout(constant_id = 1) const uint APPEARANCE = 0;
const uint ROW_APPEARANCE = 0u + GEOMETRY;  // the sum keeps the constant from taking this name
const uint ROW_HARMONICS = GEOMETRY + APPEARANCE;
