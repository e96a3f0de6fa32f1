//! A proposal network: a small density field on a hash grid that says where on a ray the surface is likely.

use super::hash_grid::{Grid, encode};
use super::networks::{exp_with_bounded_slope, plain_network};
use super::tape::{Tape, Var};
use super::volume::ray_weights;

#[derive(Clone, Copy)]
pub struct Proposal {
    /// `[entries, features]`
    pub table: Var,
    /// `[16, levels · features]`
    pub hidden: Var,
    /// `[1, 16]`
    pub out: Var,
}

impl Proposal {
    /// Log density at points `[n, 3]` of the region frame: `[n, 1]`.
    pub fn log_density(self, tape: &mut Tape, grid: &Grid, points: &[[f64; 3]]) -> Var {
        let x = tape.points(points);
        let u = unit_cube(tape, x);
        let encoding = encode(tape, grid, self.table, u);
        plain_network(tape, &[self.hidden, self.out], encoding)
    }
}

/// Weights `[rays, bins]` of raw outputs `[rays · bins, 1]` for bins of the given lengths.
pub fn weights(tape: &mut Tape, raw: Var, lengths: Vec<f64>, bins: usize) -> Var {
    let density = exp_with_bounded_slope(tape, raw);
    let density = tape.reshape(density, raw.len() / bins, bins);
    let weights = ray_weights(tape, density, lengths);
    tape.columns(weights, 0..bins)
}

/// (x + 1)/2: the cube [−1, 1]³ as the hash grids see it.
pub fn unit_cube(tape: &mut Tape, x: Var) -> Var {
    tape.map(x, |x| (x + 1.0) / 2.0, |_, _| 0.5)
}
