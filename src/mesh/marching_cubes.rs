//! Marching cubes over one block of a lattice (Lorensen & Cline 1987), with a closed, manifold result.
//!
//! Each cell's surface is found face by face: where a face of the cell has two sign changes they are joined by one segment; where it
//! has four, the sign of the bilinear interpolant at its saddle decides which pairs are joined (Nielson & Hamann 1991): with a, c < 0
//! and b, d ≥ 0 around the face, the negative corners are connected iff a·c > b·d. The two cells beside the face see the same four
//! numbers, multiplied exactly, and so draw the same segments. Segments close to loops, loops are cut into triangles. A cut never runs
//! inside a face of the cell, where the neighbour might make the same one (an edge with four triangles); the few loops that cannot be
//! cut so (116 of 1196) get a vertex inside the cell. All other vertices lie on lattice edges, by linear interpolation.
//!
//! Every triangle edge is thus shared by exactly two triangles and the triangles around a vertex form one fan, whatever the values are.
//! What happens strictly inside a cell (two sheets, or a tunnel between them) is not asked: it is always sheets.
//! The table is made by this file from the rules above when it is first needed.

use std::sync::OnceLock;

/// A vertex keeps this distance (in cells) from the ends of its lattice edge, so that no triangle is degenerate where the field is zero
/// at a lattice point. It moves the surface by at most a thousandth of a cell.
pub const EDGE_MARGIN: f64 = 1e-3;

/// Id that [`Sink`] gives to a vertex that is not wanted; triangles that touch it are not emitted.
pub const OUTSIDE: u32 = u32::MAX;
const UNSET: u32 = u32::MAX - 1;
/// Ids from here on are reserved.
pub const MAX_VERTICES: usize = UNSET as usize;

const NO_PATCH: u16 = u16::MAX;

/// Corner `c` of a cell is at (c & 1, c >> 1 & 1, c >> 2 & 1). Edge `4 axis + s` starts at corner `EDGE_STARTS[..]` and runs along axis.
const EDGE_STARTS: [u8; 12] = edge_starts();

const fn edge_starts() -> [u8; 12] {
    let mut starts = [0; 12];
    let (mut axis, mut edge) = (0, 0);
    while axis < 3 {
        let mut corner = 0;
        while corner < 8 {
            if corner >> axis & 1 == 0 {
                starts[edge] = corner;
                edge += 1;
            }
            corner += 1;
        }
        axis += 1;
    }
    starts
}

/// The four corners of face `2 axis + side`, counter-clockwise seen from outside the cell.
fn face_corners(face: usize) -> [u8; 4] {
    let (axis, side) = (face / 2, face % 2);
    let (u, v) = (1u8 << ((axis + 1) % 3), 1u8 << ((axis + 2) % 3));
    let base = (side as u8) << axis;
    if side == 1 {
        [base, base | u, base | u | v, base | v]
    } else {
        [base, base | v, base | u | v, base | u]
    }
}

fn edge_between(a: u8, b: u8) -> u8 {
    let axis = (a ^ b).trailing_zeros() as usize;
    let start = a & b;
    (4 * axis..4 * axis + 4)
        .find(|&edge| EDGE_STARTS[edge] == start)
        .expect("neighbouring corners") as u8
}

/// The surface inside one kind of cell. Vertices 0..12 are on the cell's edges, 12 is inside the cell.
#[derive(Default)]
struct Patch {
    triangles: Vec<[u8; 3]>,
    /// The loop around the inner vertex, if there is one.
    centered: Vec<u8>,
}

struct CellTable {
    /// `[256 signs, 64 face decisions]` index of the patch; decisions of unambiguous faces do not matter.
    patch: Vec<u16>,
    patches: Vec<Patch>,
    /// `[256]` bit mask of ambiguous faces.
    ambiguous: [u8; 256],
    faces: [[u8; 4]; 6],
}

impl CellTable {
    fn get() -> &'static CellTable {
        static TABLE: OnceLock<CellTable> = OnceLock::new();
        TABLE.get_or_init(CellTable::build)
    }

    fn build() -> CellTable {
        let faces: [[u8; 4]; 6] = std::array::from_fn(face_corners);
        let mut table = CellTable {
            patch: vec![NO_PATCH; 256 * 64],
            patches: Vec::new(),
            ambiguous: [0; 256],
            faces,
        };
        for signs in 0..256usize {
            let negative = |corner: u8| signs >> corner & 1 == 1;
            for (face, q) in faces.iter().enumerate() {
                if (0..4).all(|i| negative(q[i]) != negative(q[(i + 1) % 4])) {
                    table.ambiguous[signs] |= 1 << face;
                }
            }
            for decisions in 0..64usize {
                let relevant = decisions & table.ambiguous[signs] as usize;
                table.patch[signs * 64 + decisions] = if relevant != decisions {
                    table.patch[signs * 64 + relevant] // smaller, so already there
                } else {
                    table.patches.push(patch(&faces, signs, decisions));
                    (table.patches.len() - 1) as u16
                };
            }
        }
        table
    }
}

/// The triangles of a cell with these corner signs (bit set: negative) and face decisions (bit set: negative corners are connected).
fn patch(faces: &[[u8; 4]; 6], signs: usize, decisions: usize) -> Patch {
    let negative = |corner: u8| signs >> corner & 1 == 1;
    // Going around a face counter-clockwise, a segment starts where the sign turns positive and ends where it turns negative. The
    // neighbouring face runs along the common edge the other way, so segments follow each other head to tail.
    let mut next = [u8::MAX; 12];
    for (face, q) in faces.iter().enumerate() {
        for i in (0..4).filter(|&i| negative(q[i]) && !negative(q[(i + 1) % 4])) {
            // Connected negative corners: cut off the positive corner ahead. Else: cut off the negative corner behind.
            let turns_negative = |k: &usize| !negative(q[*k]) && negative(q[(*k + 1) % 4]);
            let end = if decisions >> face & 1 == 1 {
                (1..4).map(|k| (i + k) % 4).find(turns_negative)
            } else {
                (1..4).map(|k| (i + 4 - k) % 4).find(turns_negative)
            };
            let end = end.expect("a face has as many sign changes of either kind");
            next[edge_between(q[i], q[(i + 1) % 4]) as usize] =
                edge_between(q[end], q[(end + 1) % 4]);
        }
    }
    let mut patch = Patch::default();
    let mut seen = [false; 12];
    for first in 0..12u8 {
        if next[first as usize] == u8::MAX || seen[first as usize] {
            continue;
        }
        let mut ring = Vec::new();
        let mut edge = first;
        while !seen[edge as usize] {
            seen[edge as usize] = true;
            ring.push(edge);
            edge = next[edge as usize];
        }
        ring.reverse(); // followed head to tail it turns clockwise for an eye on the positive side
        match triangulate(faces, &ring) {
            Some(triangles) => patch.triangles.extend(triangles),
            None => {
                assert!(
                    patch.centered.is_empty(),
                    "signs {signs:#010b}: two loops that need an inner vertex"
                );
                patch
                    .triangles
                    .extend((0..ring.len()).map(|i| [12, ring[i], ring[(i + 1) % ring.len()]]));
                patch.centered = ring;
            }
        }
    }
    patch
}

/// Cuts a loop into triangles with the shortest cuts that do not lie in a face of the cell; `None` if there is no such way.
fn triangulate(faces: &[[u8; 4]; 6], ring: &[u8]) -> Option<Vec<[u8; 3]>> {
    let n = ring.len();
    let ends = |edge: u8| {
        let start = EDGE_STARTS[edge as usize];
        [start, start | 1 << (edge / 4)]
    };
    let in_face = |edge: u8, face: &[u8; 4]| ends(edge).iter().all(|corner| face.contains(corner));
    let cut = |i: usize, j: usize| -> f64 {
        if j - i == 1 || j - i == n - 1 {
            return 0.0; // a side of the loop
        }
        if faces
            .iter()
            .any(|face| in_face(ring[i], face) && in_face(ring[j], face))
        {
            return f64::INFINITY;
        }
        let middle = |edge: u8| {
            std::array::from_fn::<f64, 3, _>(|axis| {
                ends(edge)
                    .iter()
                    .map(|corner| f64::from(corner >> axis & 1))
                    .sum::<f64>()
                    / 2.0
            })
        };
        let (a, b) = (middle(ring[i]), middle(ring[j]));
        (0..3).map(|axis| (a[axis] - b[axis]).powi(2)).sum()
    };
    // best[i][j]: cost and apex of the cheapest triangulation of the part of the loop between i and j.
    let mut best = vec![vec![(0.0, 0usize); n]; n];
    for span in 2..n {
        for i in 0..n - span {
            let j = i + span;
            best[i][j] = (i + 1..j)
                .map(|k| (best[i][k].0 + best[k][j].0 + cut(i, k) + cut(k, j), k))
                .min_by(|a, b| a.0.total_cmp(&b.0))
                .expect("span > 1");
        }
    }
    if best[0][n - 1].0.is_infinite() {
        return None;
    }
    let mut triangles = Vec::with_capacity(n - 2);
    let mut open = vec![(0, n - 1)];
    while let Some((i, j)) = open.pop() {
        if j - i > 1 {
            let k = best[i][j].1;
            triangles.push([ring[i], ring[k], ring[j]]);
            open.extend([(i, k), (k, j)]);
        }
    }
    Some(triangles)
}

/// Where the marcher's vertices and triangles go. Points and cells are counted from the block's first point.
pub trait Sink {
    /// The vertex on the lattice edge from `point` along `axis`, at the fraction `t` of it. Asked once per edge and block.
    fn edge_vertex(&mut self, point: [usize; 3], axis: usize, t: f64) -> u32;
    /// A vertex inside `cell`, `offset` (in cells) from its first corner.
    fn inner_vertex(&mut self, cell: [usize; 3], offset: [f64; 3]) -> u32;
    /// Three different vertices, none of them [`OUTSIDE`], counter-clockwise seen from where the field is positive.
    fn triangle(&mut self, vertices: [u32; 3]);
}

/// Scratch memory for one block at a time.
#[derive(Default)]
pub struct Marcher {
    /// `[nz, ny, n_words]` bit set: negative.
    signs: Vec<u64>,
    /// `[ny, nx]` vertex ids on the x and y edges of the layer's lower and upper lattice plane, and on the z edges between.
    lower: [Vec<u32>; 2],
    upper: [Vec<u32>; 2],
    pillars: Vec<u32>,
}

impl Marcher {
    /// Bytes held.
    pub fn bytes(&self) -> usize {
        8 * self.signs.capacity()
            + 4 * (self.pillars.capacity()
                + self
                    .lower
                    .iter()
                    .chain(&self.upper)
                    .map(Vec::capacity)
                    .sum::<usize>())
    }

    /// Emits the zero surface of one block. `values[(z ny + y) nx + x]`, `dims = [nx, ny, nz]` points.
    ///
    /// # Errors
    /// The index of the first value that is not finite.
    pub fn march(
        &mut self,
        values: &[f32],
        dims: [usize; 3],
        sink: &mut impl Sink,
    ) -> Result<(), usize> {
        let [nx, ny, nz] = dims;
        assert_eq!(values.len(), nx * ny * nz, "values against dims {dims:?}");
        let n_words = self.find_signs(values, nx)?;
        for ids in self
            .lower
            .iter_mut()
            .chain(&mut self.upper)
            .chain([&mut self.pillars])
        {
            ids.clear();
            ids.resize(nx * ny, UNSET);
        }
        let table = CellTable::get();
        for z in 0..nz.saturating_sub(1) {
            for y in 0..ny.saturating_sub(1) {
                let row = |dy: usize, dz: usize| ((z + dz) * ny + y + dy) * n_words;
                let rows = [row(0, 0), row(1, 0), row(0, 1), row(1, 1)];
                for word in 0..n_words {
                    // A cell is crossed if its eight corners are neither all negative nor all positive.
                    let (mut any, mut all) = (0, u64::MAX);
                    for first in rows {
                        let (here, ahead) = self.signs_and_next(first, word, n_words);
                        any |= here | ahead;
                        all &= here & ahead;
                    }
                    let n_cells = (nx - 1).saturating_sub(64 * word).min(64);
                    let mut crossed = any
                        & !all
                        & if n_cells == 64 {
                            u64::MAX
                        } else {
                            (1 << n_cells) - 1
                        };
                    while crossed != 0 {
                        let bit = crossed.trailing_zeros();
                        crossed &= crossed - 1;
                        let mut signs = 0usize;
                        for (i, first) in rows.into_iter().enumerate() {
                            let (here, ahead) = self.signs_and_next(first, word, n_words);
                            signs |=
                                ((here >> bit & 1 | (ahead >> bit & 1) << 1) as usize) << (2 * i);
                        }
                        self.cell(
                            table,
                            values,
                            dims,
                            [64 * word + bit as usize, y, z],
                            signs,
                            sink,
                        );
                    }
                }
            }
            std::mem::swap(&mut self.lower, &mut self.upper);
            for ids in self.upper.iter_mut().chain([&mut self.pillars]) {
                ids.fill(UNSET);
            }
        }
        Ok(())
    }

    /// Fills `signs`; returns the number of words per row.
    fn find_signs(&mut self, values: &[f32], nx: usize) -> Result<usize, usize> {
        let n_words = nx.div_ceil(64);
        self.signs.clear();
        self.signs.reserve(values.len() / nx.max(1) * n_words);
        for (row, points) in values.chunks_exact(nx).enumerate() {
            for (word, points) in points.chunks(64).enumerate() {
                let (mut bits, mut finite) = (0u64, true);
                for (bit, &value) in points.iter().enumerate() {
                    bits |= u64::from(value < 0.0) << bit;
                    finite &= value.is_finite();
                }
                if !finite {
                    let bad = points
                        .iter()
                        .position(|value| !value.is_finite())
                        .expect("just seen");
                    return Err(row * nx + 64 * word + bad);
                }
                self.signs.push(bits);
            }
        }
        Ok(n_words)
    }

    /// A word of signs of the row at `first`, and the same of the points one further along x.
    #[inline]
    fn signs_and_next(&self, first: usize, word: usize, n_words: usize) -> (u64, u64) {
        let here = self.signs[first + word];
        let carry = if word + 1 < n_words {
            self.signs[first + word + 1] << 63
        } else {
            0
        };
        (here, here >> 1 | carry)
    }

    fn cell(
        &mut self,
        table: &CellTable,
        values: &[f32],
        dims: [usize; 3],
        cell: [usize; 3],
        signs: usize,
        sink: &mut impl Sink,
    ) {
        let [x, y, z] = cell;
        let [nx, ny, _] = dims;
        let corner: [f64; 8] = std::array::from_fn(|c| {
            f64::from(values[((z + (c >> 2)) * ny + y + (c >> 1 & 1)) * nx + x + (c & 1)])
        });
        let mut decisions = 0;
        let mut ambiguous = table.ambiguous[signs];
        while ambiguous != 0 {
            let face = ambiguous.trailing_zeros() as usize;
            ambiguous &= ambiguous - 1;
            let [a, b, c, d] = table.faces[face].map(|corner_index| corner[corner_index as usize]);
            // Products of two float32 are exact in float64, so both cells beside the face decide alike.
            let connected = if a < 0.0 {
                a * c > b * d
            } else {
                b * d > a * c
            };
            decisions |= usize::from(connected) << face;
        }
        let patch = &table.patches[table.patch[signs * 64 + decisions] as usize];

        let mut ids = [UNSET; 13];
        if !patch.centered.is_empty() {
            ids[12] = sink.inner_vertex(cell, inner_point(&corner, &patch.centered));
        }
        for triangle in &patch.triangles {
            let vertices = triangle.map(|slot| {
                let slot = slot as usize;
                if ids[slot] == UNSET {
                    ids[slot] = self.edge_vertex(dims, cell, slot, &corner, sink);
                }
                ids[slot]
            });
            if !vertices.contains(&OUTSIDE) {
                sink.triangle(vertices);
            }
        }
    }

    fn edge_vertex(
        &mut self,
        dims: [usize; 3],
        cell: [usize; 3],
        edge: usize,
        corner: &[f64; 8],
        sink: &mut impl Sink,
    ) -> u32 {
        let (start, axis) = (EDGE_STARTS[edge] as usize, edge / 4);
        let point = [
            cell[0] + (start & 1),
            cell[1] + (start >> 1 & 1),
            cell[2] + (start >> 2),
        ];
        let plane = match (axis, start >> 2) {
            (2, _) => &mut self.pillars,
            (_, 0) => &mut self.lower[axis],
            _ => &mut self.upper[axis],
        };
        let id = &mut plane[point[1] * dims[0] + point[0]];
        if *id == UNSET {
            *id = sink.edge_vertex(
                point,
                axis,
                crossing(corner[start], corner[start | 1 << axis]),
            );
        }
        *id
    }
}

/// Where between 0 and 1 the line from `a` to `b` is zero; the two have different signs.
fn crossing(a: f64, b: f64) -> f64 {
    (a / (a - b)).clamp(EDGE_MARGIN, 1.0 - EDGE_MARGIN)
}

/// A point inside the cell for a loop: its mean, moved onto the zero set of the trilinear interpolant by a few Newton steps.
fn inner_point(corner: &[f64; 8], ring: &[u8]) -> [f64; 3] {
    let mut p = [0.0; 3];
    for &edge in ring {
        let (start, axis) = (EDGE_STARTS[edge as usize] as usize, edge as usize / 4);
        for (j, p) in p.iter_mut().enumerate() {
            let at = if j == axis {
                crossing(corner[start], corner[start | 1 << axis])
            } else {
                (start >> j & 1) as f64
            };
            *p += at / ring.len() as f64;
        }
    }
    for _ in 0..4 {
        let (mut value, mut gradient) = (0.0, [0.0; 3]);
        for (c, f) in corner.iter().enumerate() {
            let w: [f64; 3] =
                std::array::from_fn(|j| if c >> j & 1 == 1 { p[j] } else { 1.0 - p[j] });
            value += f * w[0] * w[1] * w[2];
            for (j, g) in gradient.iter_mut().enumerate() {
                let sign = if c >> j & 1 == 1 { 1.0 } else { -1.0 };
                *g += f * sign * w[(j + 1) % 3] * w[(j + 2) % 3];
            }
        }
        let squared: f64 = gradient.iter().map(|g| g * g).sum();
        if squared > 0.0 {
            p = std::array::from_fn(|j| (p[j] - value * gradient[j] / squared).clamp(0.05, 0.95));
        }
    }
    p
}
