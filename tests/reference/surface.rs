//! The surface field: signed distance, scale logit and geometry features of a point; stochastic six taps; the colour seen there.

use super::hash_grid::{Grid, encode};
use super::networks::{NormedLayer, color_network, direction_encoding, geometry_network};
use super::proposal::unit_cube;
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
        let u = unit_cube(tape, points);
        let encoding = encode(tape, grid, self.table, u);
        let x = tape.constant(points.len(), 3, points.iter().flatten().copied().collect());
        let input = tape.concat(&[x, encoding]);
        geometry_network(tape, self.hidden, self.heads, input)
    }

    pub fn sdf(self, tape: &mut Tape, grid: &Grid, points: &[[f64; 3]]) -> Var {
        let heads = self.heads(tape, grid, points);
        tape.columns(heads, 0..1)
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
    let x = tape.constant(n, 3, points.iter().flatten().copied().collect());
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
