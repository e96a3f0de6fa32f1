// Multi-resolution hash grid: cells, corners and trilinear weights of one level (Müller et al. 2022, in tiny-cuda-nn's index rules).
//
// A position x in [-1, 1]³ lies at p = scale·(x + 1)/2 + ½ in the level's lattice. Coarse levels store their lattice densely and wrap at
// the far border; fine ones hash the corner. Positions outside the cube wrap as unsigned integers do.

struct Level {
    float scale;      // lattice steps across the cube
    uint resolution;  // lattice points per axis
    uint entries;     // stored feature vectors; a power of two where hashed
    uint offset;      // first entry in the table
    uint hashed;      // 1: hashed, 0: dense
    uint reciprocal;  // ⌊2³² / entries⌋
};
layout(buffer_reference, scalar) readonly buffer Levels { Level at[]; };

// The level that a slice of a launch works on: from both ends in turn. Devices whose few cores take contiguous parts of a launch then find
// as many coarse levels, which are quick, as fine ones in each part.
uint level_of_slice(uint n_levels) {
    uint half_ = slice() >> 1u;
    return (slice() & 1u) == 0u ? half_ : n_levels - 1u - half_;
}

struct Cell {
    uvec3 low;    // the corner nearest to -infinity
    vec3 weight;  // position inside the cell, in [0, 1)
};

// What a float without fraction says, up to ±2²²; beyond, some integer. With 3·2²² added its units are the last bit of the mantissa. (A
// software device's own conversion takes lane by lane and asks whether each fits.)
uvec3 integers(vec3 whole) { return floatBitsToUint(whole + 12582912.0) - floatBitsToUint(12582912.0); }

Cell cell_of(Level level, vec3 x) {
    float half_scale = 0.5 * level.scale;
    vec3 low = floor(fma(vec3(half_scale), x, vec3(half_scale)) + 0.5);
    // The fraction is taken from the integer part, not from the rounded position: at 2000 cells that would cost 13 of its 24 bits.
    return Cell(integers(low), fma(vec3(half_scale), x, half_scale - low) + 0.5);
}

const uvec3 HASH_PRIMES = uvec3(1u, 2654435761u, 805459861u);

// Corners of a cell are 0..7; bit 0, 1, 2 steps along x, y, z.
uvec3 corner_step(uint corner) { return uvec3(corner & 1u, (corner >> 1u) & 1u, corner >> 2u); }

// The same as −1 and 1.
vec3 corner_side(uint corner) { return 2.0 * vec3(corner_step(corner)) - 1.0; }

// Entry (within the whole table) of a corner of a cell.
uint corner_entry(Level level, Cell cell, uint corner) {
    uvec3 at = cell.low + corner_step(corner);
    uint index;
    if (level.hashed != 0u) {
        uvec3 h = at * HASH_PRIMES;
        index = (h.x ^ h.y ^ h.z) & (level.entries - 1u);
    } else {
        index = at.x + level.resolution * (at.y + level.resolution * at.z);
        // index mod entries: a software device divides lane by lane. The reciprocal is at most one too small.
        uint quotient, rest;
        umulExtended(index, level.reciprocal, quotient, rest);
        index -= quotient * level.entries;
        if (index >= level.entries) index -= level.entries;
    }
    return level.offset + index;
}

// The trilinear weight of a corner is the product of these.
vec3 axis_weights(Cell cell, uint corner) { return mix(1.0 - cell.weight, cell.weight, vec3(corner_step(corner))); }

float corner_weight(Cell cell, uint corner) {
    vec3 w = axis_weights(cell, corner);
    return w.x * w.y * w.z;
}

// d corner_weight / d x for x in [-1, 1]³. Along its own axis the trilinear weight is linear, so it depends on the other two only.
vec3 corner_slope(Level level, Cell cell, uint corner) {
    vec3 w = axis_weights(cell, corner), side = corner_side(corner);
    return 0.5 * level.scale * side * w.yzx * w.zxy;
}

// What lies between a cell's corners, of two quantities at once, and its derivatives along the cell's edges: the sum of corner_weight times
// what the corners hold, axis by axis.
struct Interpolation {
    vec2 value;
    vec2 slope[3];  // along x, y, z
    vec2 mixed[3];  // along y and z, x and z, x and y; twice along one axis there is none
};

Interpolation interpolate(vec2 corners[8], vec3 w) {
    vec2 x[4], dx[4];
    [[unroll]] for (uint i = 0u; i < 4u; ++i) {
        dx[i] = corners[2u * i + 1u] - corners[2u * i];
        x[i] = fma(vec2(w.x), dx[i], corners[2u * i]);
    }
    vec2 xy[2], dx_y[2], x_dy[2], dx_dy[2];
    [[unroll]] for (uint i = 0u; i < 2u; ++i) {
        x_dy[i] = x[2u * i + 1u] - x[2u * i];
        dx_dy[i] = dx[2u * i + 1u] - dx[2u * i];
        xy[i] = fma(vec2(w.y), x_dy[i], x[2u * i]);
        dx_y[i] = fma(vec2(w.y), dx_dy[i], dx[2u * i]);
    }
    Interpolation e;
    e.slope[2] = xy[1] - xy[0];
    e.mixed[0] = x_dy[1] - x_dy[0];
    e.mixed[1] = dx_y[1] - dx_y[0];
    e.mixed[2] = fma(vec2(w.z), dx_dy[1] - dx_dy[0], dx_dy[0]);
    e.slope[0] = fma(vec2(w.z), e.mixed[1], dx_y[0]);
    e.slope[1] = fma(vec2(w.z), e.mixed[0], x_dy[0]);
    e.value = fma(vec2(w.z), e.slope[2], xy[0]);
    return e;
}

// One quantity's derivative by x in [-1, 1]³.
vec3 slope_of(Level level, Interpolation e, uint f) { return 0.5 * level.scale * vec3(e.slope[0][f], e.slope[1][f], e.slope[2][f]); }

// Its mixed second derivatives by x, in the order of Interpolation.
vec3 mixed_of(Level level, Interpolation e, uint f) {
    return 0.25 * level.scale * level.scale * vec3(e.mixed[0][f], e.mixed[1][f], e.mixed[2][f]);
}

// The second derivative with these mixed parts, times v.
vec3 curvature_along(vec3 mixed, vec3 v) { return mixed.zxy * v.yzx + mixed.yzx * v.zxy; }

// Whether two corners of a cell may share an entry. A corner's hash differs from corner 0's by the exclusive or of what its steps along
// x, y and z change; those three numbers are odd, since the primes are, so corners meet only where two of the three are equal. In a
// dense level they meet nowhere, except that positions outside the cube may wrap onto anything.
bool corners_may_meet(Level level, Cell cell) {
    uvec3 change = ((cell.low * HASH_PRIMES) ^ ((cell.low + 1u) * HASH_PRIMES)) & (level.entries - 1u);
    if (level.hashed != 0u) return change.x == change.y || change.x == change.z || change.y == change.z;
    return any(greaterThanEqual(cell.low, uvec3(level.resolution)));
}
