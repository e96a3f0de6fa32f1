//! The surface field: signed distance, scale logit and geometry features of a point; the distance's gradient, by stochastic six taps or
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
}

impl Surface {
    /// All heads at points `[n, 3]` of the region frame: `[n, 2 + K]`. The network sees [x, e((x + 1)/2)].
    pub fn heads(self, tape: &mut Tape, grid: &Grid, points: &[[f64; 3]]) -> Var {
        let x = tape.points(points);
        let u = unit_cube(tape, x);
        let encoding = encode(tape, grid, self.table, u);
        let input = tape.concat(&[x, encoding]);
        geometry_network(tape, self.hidden, self.heads, input)
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
        let input = tape.concat(&[x, encoding]);
        let (heads, slope) = geometry_network_with_slope(tape, self.hidden, self.heads, input);
        let by_x = tape.columns(slope, 0..3);
        let by_encoding = tape.columns(slope, 3..slope.cols);
        let by_u = encoding_slope(tape, grid, self.table, u, by_encoding);
        let through_encoding = tape.scale(by_u, 0.5);
        (heads, tape.add(by_x, through_encoding))
    }
}

/// Step of a sample's taps: δ = max(range · u, floor).
pub fn tap_step(draw: f64, range: f64, floor: f64) -> f64 {
    (range * draw).max(floor)
}

/// Six blocks of the samples' points, moved by +x, −x, +y, −y, +z, −z times their own step.
pub fn tap_points(points: &[[f64; 3]], steps: &[f64]) -> Vec<[f64; 3]> {
    let mut taps = Vec::with_capacity(6 * points.len());
    for axis in 0..3 {
        for sign in [1.0, -1.0] {
            taps.extend(points.iter().zip(steps).map(|(&x, &step)| {
                let mut tap = x;
                tap[axis] += sign * step;
                tap
            }));
        }
    }
    taps
}

/// g_j = (f(x + δe_j) − f(x − δe_j))/(2δ) for f `[6n, 1]` at [`tap_points`]: `[n, 3]`.
pub fn six_tap_gradient(tape: &mut Tape, taps: Var, steps: Vec<f64>) -> Var {
    let n = steps.len();
    assert_eq!(taps.len(), 6 * n);
    let mut value = vec![0.0; 3 * n];
    for (sample, step) in steps.iter().enumerate() {
        for axis in 0..3 {
            let f = |side: usize| tape.value(taps)[(2 * axis + side) * n + sample];
            value[sample * 3 + axis] = (f(0) - f(1)) / (2.0 * step);
        }
    }
    tape.record(n, 3, value, &[taps], move |_, d_gradient, gradients| {
        let Some(d_taps) = gradients.of(taps) else {
            return;
        };
        for (sample, step) in steps.iter().enumerate() {
            for axis in 0..3 {
                let d = d_gradient[sample * 3 + axis] / (2.0 * step);
                d_taps[2 * axis * n + sample] += d;
                d_taps[(2 * axis + 1) * n + sample] -= d;
            }
        }
    })
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
