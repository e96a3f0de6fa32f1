//! The surface field: signed distance, scale logit and geometry features of a point; the distance's gradient, by taps or
//! analytically; points shifted in the tangent plane; the colour seen there.

use super::hash_grid::{Grid, encode, encoding_slope};
use super::networks::{
    NormedLayer, color_network, direction_encoding, geometry_network, geometry_network_with_slope,
};
use super::proposal::unit_cube;
use super::sampling::dot;
use super::tape::{Tape, Var};

#[derive(Clone, Copy)]
pub struct Surface {
    /// `[entries, features]`
    pub table: Var,
    pub hidden: NormedLayer,
    /// Rows: signed distance, scale logit, geometry features.
    pub heads: NormedLayer,
    /// Levels of the grid whose features the network sees; zeros stand for the others.
    pub released: usize,
}

impl Surface {
    /// All heads at points `[n, 3]` of the region frame: `[n, 2 + K]`. The network sees [x, e((x + 1)/2)].
    pub fn heads(self, tape: &mut Tape, grid: &Grid, points: &[[f64; 3]]) -> Var {
        let x = tape.points(points);
        let u = unit_cube(tape, x);
        let encoding = encode(tape, grid, self.table, u);
        let encoding = self.released(tape, grid, encoding);
        let input = tape.concat(&[x, encoding]);
        geometry_network(tape, self.hidden, self.heads, input)
    }

    /// The columns of an encoding, or of a gradient by it, that the network sees, and zeros.
    fn released(self, tape: &mut Tape, grid: &Grid, encoding: Var) -> Var {
        let seen = tape.columns(encoding, 0..self.released * grid.features);
        let unseen = grid.width() - seen.cols;
        let zeros = tape.constant(encoding.rows, unseen, vec![0.0; encoding.rows * unseen]);
        tape.concat(&[seen, zeros])
    }

    pub fn sdf(self, tape: &mut Tape, grid: &Grid, points: &[[f64; 3]]) -> Var {
        let heads = self.heads(tape, grid, points);
        tape.columns(heads, 0..1)
    }

    /// All heads at x `[n, 3]`, and the gradient of the signed distance there, `[n, 3]`:
    /// g = J_xᵀ ∂f/∂[x, e], J_x = [I; ∂e/∂x], ∂e/∂x = ½ ∂e/∂u. Both can be differentiated by the parameters and by x.
    pub fn heads_and_gradient(self, tape: &mut Tape, grid: &Grid, x: Var) -> (Var, Var) {
        let u = unit_cube(tape, x);
        let encoding = encode(tape, grid, self.table, u);
        let encoding = self.released(tape, grid, encoding);
        let input = tape.concat(&[x, encoding]);
        let (heads, slope) = geometry_network_with_slope(tape, self.hidden, self.heads, input);
        let by_x = tape.columns(slope, 0..3);
        let by_encoding = tape.columns(slope, 3..slope.cols);
        let by_encoding = self.released(tape, grid, by_encoding);
        let by_u = encoding_slope(tape, grid, self.table, u, by_encoding);
        let through_encoding = tape.scale(by_u, 0.5);
        (heads, tape.add(by_x, through_encoding))
    }
}

/// Step of a sample's taps: δ = max(range · u, floor).
pub fn tap_step(draw: f64, range: f64, floor: f64) -> f64 {
    (range * draw).max(floor)
}

/// The four taps' corners; the taps are ε/√3 times these away.
const CORNERS: [[f64; 3]; 4] = [
    [1.0, -1.0, -1.0],
    [-1.0, -1.0, 1.0],
    [-1.0, 1.0, -1.0],
    [1.0, 1.0, 1.0],
];

/// How far a tap is from its sample, and by what f there enters g: of six taps ±δ along an axis and ±1/(2δ), of four k ε/√3 and
/// k/(4 ε/√3).
fn tap(taps: usize, tap: usize, step: f64) -> ([f64; 3], [f64; 3]) {
    match taps {
        6 => {
            let mut axis = [0.0; 3];
            axis[tap / 2] = if tap.is_multiple_of(2) { 1.0 } else { -1.0 };
            (axis.map(|a| a * step), axis.map(|a| a / (2.0 * step)))
        }
        4 => {
            let e = step / 3.0_f64.sqrt();
            (
                CORNERS[tap].map(|k| k * e),
                CORNERS[tap].map(|k| k / (4.0 * e)),
            )
        }
        _ => panic!("{taps} taps"),
    }
}

/// Blocks of the samples' points, one per tap, moved by +x, −x, +y, −y, +z, −z times their own step, or to the four corners.
pub fn tap_points(taps: usize, points: &[[f64; 3]], steps: &[f64]) -> Vec<[f64; 3]> {
    (0..taps)
        .flat_map(|block| points.iter().zip(steps).map(move |sample| (block, sample)))
        .map(|(block, (x, &step))| {
            let (offset, _) = tap(taps, block, step);
            std::array::from_fn(|axis| x[axis] + offset[axis])
        })
        .collect()
}

/// g for f `[taps · n, 1]` at [`tap_points`]: `[n, 3]`; of six taps (f(x + δe_j) − f(x − δe_j))/(2δ).
pub fn tap_gradient(tape: &mut Tape, taps: usize, at_taps: Var, steps: Vec<f64>) -> Var {
    let n = steps.len();
    assert_eq!(at_taps.len(), taps * n);
    let mut value = vec![0.0; 3 * n];
    for (sample, &step) in steps.iter().enumerate() {
        for block in 0..taps {
            let f = tape.value(at_taps)[block * n + sample];
            let (_, by_f) = tap(taps, block, step);
            (0..3).for_each(|axis| value[sample * 3 + axis] += by_f[axis] * f);
        }
    }
    tape.record(n, 3, value, &[at_taps], move |_, d_gradient, gradients| {
        let Some(d_taps) = gradients.of(at_taps) else {
            return;
        };
        for (sample, &step) in steps.iter().enumerate() {
            for block in 0..taps {
                let (_, by_f) = tap(taps, block, step);
                for axis in 0..3 {
                    d_taps[block * n + sample] += by_f[axis] * d_gradient[sample * 3 + axis];
                }
            }
        }
    })
}

/// Mean |Σ_j ∂²f/∂x_j²| for f `[(1 + taps) · n, 1]` at samples and taps: of six taps Σ (f(x + δe_j) − 2f(x) + f(x − δe_j))/δ², of four
/// (½ Σ f − 2f(x))/(ε²/3).
pub fn curvature(tape: &mut Tape, taps: usize, sdf: Var, steps: Vec<f64>) -> Var {
    let n = steps.len();
    assert_eq!(sdf.len(), (1 + taps) * n);
    let by_square = if taps == 6 { 1.0 } else { 1.5 };
    let trace = move |tape: &Tape, sample: usize, step: f64| -> f64 {
        let f = |block: usize| tape.value(sdf)[block * n + sample];
        let around: f64 = (1..=taps).map(f).sum();
        by_square * (around - taps as f64 * f(0)) / (step * step)
    };
    let sum: f64 = (0..n).map(|i| trace(tape, i, steps[i]).abs()).sum();
    tape.record(
        1,
        1,
        vec![sum / n as f64],
        &[sdf],
        move |tape, d, gradients| {
            let Some(d_sdf) = gradients.of(sdf) else {
                return;
            };
            for (sample, &step) in steps.iter().enumerate() {
                let side = trace(tape, sample, step).signum();
                let d_f = d[0] * side * by_square / (step * step * n as f64);
                d_sdf[sample] -= taps as f64 * d_f;
                (1..=taps).for_each(|block| d_sdf[block * n + sample] += d_f);
            }
        },
    )
}

/// g/max(‖g‖, 1e-12)
pub fn normalized(g: [f64; 3]) -> [f64; 3] {
    let length = dot(g, g).sqrt().max(SHORTEST);
    g.map(|g| g / length)
}

const SHORTEST: f64 = 1e-12;

/// [`normalized`], row by row.
pub fn normals(tape: &mut Tape, gradient: Var) -> Var {
    let value = (0..gradient.rows)
        .flat_map(|row| normalized(tape.point(gradient, row)))
        .collect();
    tape.record(
        gradient.rows,
        3,
        value,
        &[gradient],
        move |tape, d_normal, gradients| {
            let Some(d_gradient) = gradients.of(gradient) else {
                return;
            };
            for row in 0..gradient.rows {
                let g = tape.point(gradient, row);
                let length = dot(g, g).sqrt();
                let d_n: [f64; 3] = std::array::from_fn(|axis| d_normal[row * 3 + axis]);
                // (I − n nᵀ) d_n/‖g‖; a g shorter than the least length is only scaled.
                let n = normalized(g);
                let along = if length > SHORTEST { dot(n, d_n) } else { 0.0 };
                for axis in 0..3 {
                    d_gradient[row * 3 + axis] +=
                        (d_n[axis] - along * n[axis]) / length.max(SHORTEST);
                }
            }
        },
    )
}

fn cross(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    std::array::from_fn(|axis| {
        let (next, last) = ((axis + 1) % 3, (axis + 2) % 3);
        a[next] * b[last] - a[last] * b[next]
    })
}

/// q = m + step (n × u) for bases m, normals n `[n, 3]` and unit vectors u: a shift in the tangent plane, longest where u lies in it.
pub fn tangent_points(
    tape: &mut Tape,
    bases: &[[f64; 3]],
    normals: Var,
    directions: Vec<[f64; 3]>,
    step: f64,
) -> Var {
    let n = bases.len();
    assert_eq!((normals.rows, directions.len()), (n, n));
    let value = (0..n)
        .flat_map(|row| {
            let shift = cross(tape.point(normals, row), directions[row]);
            std::array::from_fn::<f64, 3, _>(|axis| bases[row][axis] + step * shift[axis])
        })
        .collect();
    tape.record(n, 3, value, &[normals], move |_, d_q, gradients| {
        let Some(d_normals) = gradients.of(normals) else {
            return;
        };
        // d_q · (n × u) = n · (u × d_q)
        for (row, d_q) in d_q.chunks_exact(3).enumerate() {
            let d_n = cross(directions[row], [d_q[0], d_q[1], d_q[2]]);
            (0..3).for_each(|axis| d_normals[row * 3 + axis] += step * d_n[axis]);
        }
    })
}

/// Colour `[n, 3]` in (0, 1), before padding: the network sees [x, encoded direction, g as it is, geometry features, appearance code].
pub fn color(
    tape: &mut Tape,
    layers: &[NormedLayer],
    points: &[[f64; 3]],
    directions: &[[f64; 3]],
    gradient: Var,
    features: Var,
    appearance: Option<Var>,
) -> Var {
    let n = points.len();
    let x = tape.points(points);
    let d = tape.constant(
        n,
        27,
        directions
            .iter()
            .flat_map(|&d| direction_encoding(d))
            .collect(),
    );
    let mut input = vec![x, d, gradient, features];
    input.extend(appearance);
    let input = tape.concat(&input);
    color_network(tape, layers, input)
}
