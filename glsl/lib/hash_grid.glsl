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
};
layout(buffer_reference, scalar) readonly buffer Levels { Level at[]; };

struct Cell {
    uvec3 low;    // the corner nearest to -infinity
    vec3 weight;  // position inside the cell, in [0, 1)
};

Cell cell_of(Level level, vec3 x) {
    float half_scale = 0.5 * level.scale;
    vec3 low = floor(fma(vec3(half_scale), x, vec3(half_scale)) + 0.5);
    // The fraction is taken from the integer part, not from the rounded position: at 2000 cells that would cost 13 of its 24 bits.
    return Cell(uvec3(ivec3(low)), fma(vec3(half_scale), x, half_scale - low) + 0.5);
}

// Entry (within the whole table) of corner 0..7 of a cell; bit 0, 1, 2 of `corner` steps along x, y, z.
uint corner_entry(Level level, Cell cell, uint corner) {
    uvec3 at = cell.low + uvec3(corner & 1u, (corner >> 1u) & 1u, corner >> 2u);
    uint index;
    if (level.hashed != 0u) {
        index = (at.x ^ (at.y * 2654435761u) ^ (at.z * 805459861u)) & (level.entries - 1u);
    } else {
        index = at.x + level.resolution * (at.y + level.resolution * at.z);
        if (index >= level.entries) index %= level.entries;
    }
    return level.offset + index;
}

float corner_weight(Cell cell, uint corner) {
    vec3 far = vec3(float(corner & 1u), float((corner >> 1u) & 1u), float(corner >> 2u));
    vec3 w = mix(1.0 - cell.weight, cell.weight, far);
    return w.x * w.y * w.z;
}
