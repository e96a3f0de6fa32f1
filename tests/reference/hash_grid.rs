//! Multi-resolution hash encoding (Müller et al. 2022) with tiny-cuda-nn's level table, corner order and indices.
//!
//! Level l of growth b has scale_l = base·bˡ − 1 and R_l = ceil(scale_l) + 1 vertices per axis. For u in [0, 1]³ (or anywhere):
//! p = scale_l·u + ½, cell = floor(p) as a signed 32-bit integer read as unsigned, w = p − floor(p), trilinear weights. A vertex
//! (x, y, z) is entry x + y·R + z·R² where R³ fits the level, else (x ⊕ 2654435761·y ⊕ 805459861·z), both modulo the entries.

use super::tape::{Tape, Var};

/// One level's numbers.
#[derive(Clone, Debug, PartialEq)]
pub struct Level {
    pub scale: f64,
    /// Vertices per axis.
    pub resolution: u32,
    pub entries: u32,
    /// Entries of all levels before this one.
    pub offset: usize,
    /// True where every vertex has an entry of its own.
    pub dense: bool,
    /// Cells are chosen in float32, as the kernels choose them: on a border both neighbours give the same value, but not the same slope.
    pub float32_cells: bool,
}

#[derive(Clone, Debug, PartialEq)]
pub struct Grid {
    pub levels: Vec<Level>,
    /// Features per entry.
    pub features: usize,
}

/// A level's eight corners around a point: corner c has bit 0 for x, bit 1 for y, bit 2 for z.
pub struct Cell {
    pub index: [u32; 8],
    pub weight: [f64; 8],
    /// ∂weight/∂u, per axis.
    pub slope: [[f64; 3]; 8],
    /// ∂²weight/∂u_a∂u_b for (a, b) = (x,y), (x,z), (y,z); the pure second derivatives of a trilinear weight are 0.
    pub bend: [[f64; 3]; 8],
}

impl Level {
    fn new(scale: f64, resolution: u32, log2_size: u32, offset: usize) -> Level {
        let vertices = u64::from(resolution).pow(3);
        let entries = vertices.div_ceil(8).saturating_mul(8).min(1 << log2_size) as u32;
        Level {
            scale,
            resolution,
            entries,
            offset,
            dense: vertices <= u64::from(entries),
            float32_cells: false,
        }
    }

    pub fn index(&self, vertex: [u32; 3]) -> u32 {
        let [x, y, z] = vertex;
        let index = if self.dense {
            let r = self.resolution;
            x.wrapping_add(y.wrapping_mul(r))
                .wrapping_add(z.wrapping_mul(r.wrapping_mul(r)))
        } else {
            x ^ y.wrapping_mul(2_654_435_761) ^ z.wrapping_mul(805_459_861)
        };
        index % self.entries
    }

    pub fn cell(&self, u: [f64; 3]) -> Cell {
        let p = u.map(|u| self.scale * u + 0.5);
        let low = match self.float32_cells {
            true => u.map(|u| {
                let (half, x) = (0.5 * self.scale as f32, (2.0 * u - 1.0) as f32);
                f64::from((half.mul_add(x, half) + 0.5).floor())
            }),
            false => p.map(f64::floor),
        };
        let first = low.map(|low| low as i64 as u32);
        let w = [0, 1, 2].map(|axis| p[axis] - low[axis]);
        let mut cell = Cell {
            index: [0; 8],
            weight: [0.0; 8],
            slope: [[0.0; 3]; 8],
            bend: [[0.0; 3]; 8],
        };
        for corner in 0..8 {
            let bit = [corner & 1, corner >> 1 & 1, corner >> 2 & 1];
            let vertex = [0, 1, 2].map(|axis| first[axis].wrapping_add(bit[axis] as u32));
            let side = [0, 1, 2].map(|axis| {
                if bit[axis] == 1 {
                    w[axis]
                } else {
                    1.0 - w[axis]
                }
            });
            let sign = bit.map(|bit| if bit == 1 { self.scale } else { -self.scale });
            cell.index[corner] = self.index(vertex);
            cell.weight[corner] = side[0] * side[1] * side[2];
            cell.slope[corner] = [
                sign[0] * side[1] * side[2],
                side[0] * sign[1] * side[2],
                side[0] * side[1] * sign[2],
            ];
            cell.bend[corner] = [
                sign[0] * sign[1] * side[2],
                sign[0] * side[1] * sign[2],
                side[0] * sign[1] * sign[2],
            ];
        }
        cell
    }
}

impl Grid {
    /// Scales in real arithmetic: a level whose scale is a whole number has exactly that many cells.
    pub fn exact(levels: usize, base: u32, max: u32, log2_size: u32, features: usize) -> Grid {
        let growth_log2 = growth(levels, base, max).log2();
        Grid::with_scales(levels, log2_size, features, |level| {
            let scale = f64::from(base) * (level as f64 * growth_log2).exp2() - 1.0;
            // Rounding in the last place must not add a vertex.
            (scale, (scale - 1e-9).ceil() as u32 + 1)
        })
    }

    /// Scales in single precision, as tiny-cuda-nn computes them: where growthˡ is a power of two, rounding decides the resolution.
    pub fn published(levels: usize, base: u32, max: u32, log2_size: u32, features: usize) -> Grid {
        let growth_log2 = (growth(levels, base, max) as f32).log2();
        Grid::with_scales(levels, log2_size, features, |level| {
            let scale = (level as f32 * growth_log2).exp2() * base as f32 - 1.0;
            (f64::from(scale), scale.ceil() as u32 + 1)
        })
    }

    fn with_scales(
        levels: usize,
        log2_size: u32,
        features: usize,
        scale_at: impl Fn(usize) -> (f64, u32),
    ) -> Grid {
        let mut offset = 0;
        let levels = (0..levels)
            .map(|level| {
                let (scale, resolution) = scale_at(level);
                let level = Level::new(scale, resolution, log2_size, offset);
                offset += level.entries as usize;
                level
            })
            .collect();
        Grid { levels, features }
    }

    /// Entries of all levels.
    pub fn entries(&self) -> usize {
        self.levels
            .last()
            .map_or(0, |level| level.offset + level.entries as usize)
    }

    /// Parameters: `entries() * features`.
    pub fn parameters(&self) -> usize {
        self.entries() * self.features
    }

    /// Length of an encoding, level-major, then feature.
    pub fn width(&self) -> usize {
        self.levels.len() * self.features
    }

    /// Calls `visit(level, corner, first flat parameter of the corner's entry, cell)` for all corners around u.
    fn visit(&self, u: [f64; 3], mut visit: impl FnMut(usize, usize, usize, &Cell)) {
        for (l, level) in self.levels.iter().enumerate() {
            let cell = level.cell(u);
            for corner in 0..8 {
                visit(
                    l,
                    corner,
                    (level.offset + cell.index[corner] as usize) * self.features,
                    &cell,
                );
            }
        }
    }

    /// e(u), [`width`](Self::width) values.
    pub fn encode(&self, table: &[f64], u: [f64; 3]) -> Vec<f64> {
        let mut encoding = vec![0.0; self.width()];
        self.visit(u, |level, corner, first, cell| {
            for feature in 0..self.features {
                encoding[level * self.features + feature] +=
                    cell.weight[corner] * table[first + feature];
            }
        });
        encoding
    }

    /// ∂e/∂u, `[width, 3]`.
    pub fn jacobian(&self, table: &[f64], u: [f64; 3]) -> Vec<[f64; 3]> {
        let mut jacobian = vec![[0.0; 3]; self.width()];
        self.visit(u, |level, corner, first, cell| {
            for feature in 0..self.features {
                let row = &mut jacobian[level * self.features + feature];
                *row = std::array::from_fn(|axis| {
                    row[axis] + cell.slope[corner][axis] * table[first + feature]
                });
            }
        });
        jacobian
    }

    /// Adds ∂(d_e · e)/∂table.
    pub fn add_table_gradient(&self, u: [f64; 3], d_encoding: &[f64], d_table: &mut [f64]) {
        self.visit(u, |level, corner, first, cell| {
            for feature in 0..self.features {
                d_table[first + feature] +=
                    cell.weight[corner] * d_encoding[level * self.features + feature];
            }
        });
    }

    /// ∂(d_e · e)/∂u
    pub fn point_gradient(&self, table: &[f64], u: [f64; 3], d_encoding: &[f64]) -> [f64; 3] {
        let mut d_u = [0.0; 3];
        for (row, d_e) in self.jacobian(table, u).iter().zip(d_encoding) {
            (0..3).for_each(|axis| d_u[axis] += d_e * row[axis]);
        }
        d_u
    }

    /// Adds ∂(h · ∂(d_e · e)/∂u)/∂table, the table's share of a loss on the spatial derivative.
    pub fn add_table_gradient_of_slope(
        &self,
        u: [f64; 3],
        d_encoding: &[f64],
        h: [f64; 3],
        d_table: &mut [f64],
    ) {
        self.visit(u, |level, corner, first, cell| {
            let slope: f64 = (0..3).map(|axis| h[axis] * cell.slope[corner][axis]).sum();
            for feature in 0..self.features {
                d_table[first + feature] += slope * d_encoding[level * self.features + feature];
            }
        });
    }

    /// ∂(h · ∂(d_e · e)/∂u)/∂u
    pub fn point_gradient_of_slope(
        &self,
        table: &[f64],
        u: [f64; 3],
        d_encoding: &[f64],
        h: [f64; 3],
    ) -> [f64; 3] {
        let mut d_u = [0.0; 3];
        self.visit(u, |level, corner, first, cell| {
            let [xy, xz, yz] = cell.bend[corner];
            for feature in 0..self.features {
                let c = d_encoding[level * self.features + feature] * table[first + feature];
                d_u[0] += c * (xy * h[1] + xz * h[2]);
                d_u[1] += c * (xy * h[0] + yz * h[2]);
                d_u[2] += c * (xz * h[0] + yz * h[1]);
            }
        });
        d_u
    }
}

/// The factor from one level's scale to the next.
pub fn growth(levels: usize, base: u32, max: u32) -> f64 {
    if levels < 2 {
        return 1.0;
    }
    ((f64::from(max) / f64::from(base)).ln() / (levels - 1) as f64).exp()
}

/// e(u) for u `[n, 3]` and a table `[entries, features]`: `[n, width]`.
pub fn encode(tape: &mut Tape, grid: &Grid, table: Var, u: Var) -> Var {
    assert_eq!((table.len(), u.cols), (grid.parameters(), 3));
    let width = grid.width();
    let value = (0..u.rows)
        .flat_map(|row| grid.encode(tape.value(table), tape.point(u, row)))
        .collect();
    let grid = grid.clone();
    tape.record(
        u.rows,
        width,
        value,
        &[table, u],
        move |tape, d_encoding, gradients| {
            for (row, d_encoding) in d_encoding.chunks_exact(width).enumerate() {
                let at = tape.point(u, row);
                if let Some(d_table) = gradients.of(table) {
                    grid.add_table_gradient(at, d_encoding, d_table);
                }
                if let Some(d_u) = gradients.of(u) {
                    let d_at = grid.point_gradient(tape.value(table), at, d_encoding);
                    (0..3).for_each(|axis| d_u[row * 3 + axis] += d_at[axis]);
                }
            }
        },
    )
}

/// (∂e/∂u)ᵀ a for u `[n, 3]` and a `[n, width]`, the spatial derivative of a · e: `[n, 3]`.
pub fn encoding_slope(tape: &mut Tape, grid: &Grid, table: Var, u: Var, a: Var) -> Var {
    let width = grid.width();
    assert_eq!((table.len(), u.cols), (grid.parameters(), 3));
    assert_eq!((a.rows, a.cols), (u.rows, width));
    let value = (0..u.rows)
        .flat_map(|row| {
            let a = &tape.value(a)[row * width..][..width];
            grid.point_gradient(tape.value(table), tape.point(u, row), a)
        })
        .collect();
    let grid = grid.clone();
    tape.record(
        u.rows,
        3,
        value,
        &[table, u, a],
        move |tape, d_slope, gradients| {
            for (row, h) in d_slope.chunks_exact(3).enumerate() {
                let (at, h) = (tape.point(u, row), [h[0], h[1], h[2]]);
                let (table_values, along) =
                    (tape.value(table), &tape.value(a)[row * width..][..width]);
                if let Some(d_table) = gradients.of(table) {
                    grid.add_table_gradient_of_slope(at, along, h, d_table);
                }
                if let Some(d_u) = gradients.of(u) {
                    let d_at = grid.point_gradient_of_slope(table_values, at, along, h);
                    (0..3).for_each(|axis| d_u[row * 3 + axis] += d_at[axis]);
                }
                if let Some(d_a) = gradients.of(a) {
                    let jacobian = grid.jacobian(table_values, at);
                    for (d_a, slope) in d_a[row * width..].iter_mut().zip(jacobian) {
                        *d_a += slope.iter().zip(h).map(|(slope, h)| slope * h).sum::<f64>();
                    }
                }
            }
        },
    )
}
