//! The background: black, one colour, a learned colour, or a radiance field between the region's border and far away.

use super::hash_grid::{Grid, encode};
use super::networks::{exp_with_bounded_slope, plain_network, sigmoid, spherical_harmonics};
use super::sampling::{dot, lengths, midpoints, place, point_on_ray};
use super::tape::{Tape, Var};
use super::volume::{composite, ray_weights};

/// What a ray sees where the surface leaves something over.
#[derive(Clone, Debug, PartialEq)]
pub enum Background {
    Black,
    Fixed([f64; 3]),
    /// sigmoid of `background.constant`
    Learned,
    Field(FieldConfig),
}

#[derive(Clone, Debug, PartialEq)]
pub struct FieldConfig {
    pub grid: Grid,
    pub samples: usize,
    /// Distance of the last edge.
    pub far: f64,
    pub hidden: usize,
    /// Geometry features handed to the colour layers.
    pub geometry: usize,
    /// Length of the field's own appearance code.
    pub appearance: usize,
    /// Query contracted coordinates; false asks the grid far outside its cube, where indices wrap.
    pub contraction: bool,
}

/// The field's layers, plain matrices `[outputs, inputs]` without bias.
pub struct Field {
    pub table: Var,
    pub hidden: Var,
    /// Rows: log density, geometry features.
    pub heads: Var,
    pub color: [Var; 3],
    /// `[n, appearance]`: the code of each ray.
    pub code: Option<Var>,
}

/// `samples + 1` edges, uniform in disparity: 1/t = s/far + (1 − s)/near, each s with its own draw; `far` at least twice as far as `near`.
pub fn edges(samples: usize, near: f64, far: f64, draws: Option<&[f64]>) -> Vec<f64> {
    let draw = |edge: usize| draws.map_or(0.5, |draws| draws[edge]);
    let s = place(
        samples,
        draws.is_some().then_some(&draw as &dyn Fn(usize) -> f64),
    );
    s.into_iter()
        .map(|s| 1.0 / (s / far.max(2.0 * near) + (1.0 - s) / near))
        .collect()
}

/// x inside the unit ball, (2 − 1/‖x‖) x/‖x‖ beyond: all of space in a ball of radius 2.
pub fn contract(x: [f64; 3]) -> [f64; 3] {
    let length = dot(x, x).sqrt();
    if length <= 1.0 {
        x
    } else {
        x.map(|x| (2.0 - 1.0 / length) * x / length)
    }
}

/// Where the field's grid is asked for x: contracted space fills the unit cube, (c(x) + 2)/4; uncontracted (x + 1)/2.
pub fn grid_point(x: [f64; 3], contraction: bool) -> [f64; 3] {
    if contraction {
        contract(x).map(|x| (x + 2.0) / 4.0)
    } else {
        x.map(|x| (x + 1.0) / 2.0)
    }
}

impl Field {
    /// Colour `[n, 3]` seen along rays that leave the region at `near`, on black.
    pub fn render(
        &self,
        tape: &mut Tape,
        config: &FieldConfig,
        origins: &[[f64; 3]],
        directions: &[[f64; 3]],
        near: &[f64],
        draws: Option<&[f64]>,
    ) -> Var {
        let (rays, samples) = (origins.len(), config.samples);
        let mut bin_lengths = Vec::with_capacity(rays * samples);
        let mut u = Vec::with_capacity(rays * samples * 3);
        for ray in 0..rays {
            let draws = draws.map(|draws| &draws[ray * (samples + 1)..][..samples + 1]);
            let t = edges(samples, near[ray], config.far, draws);
            bin_lengths.extend(lengths(&t));
            for middle in midpoints(&t) {
                let x = point_on_ray(origins[ray], directions[ray], middle);
                u.extend(grid_point(x, config.contraction));
            }
        }
        let u = tape.constant(rays * samples, 3, u);
        let encoding = encode(tape, &config.grid, self.table, u);
        let heads = plain_network(tape, &[self.hidden, self.heads], encoding);
        let raw = tape.columns(heads, 0..1);
        let density = exp_with_bounded_slope(tape, raw);
        let density = tape.reshape(density, rays, samples);
        let weights = ray_weights(tape, density, bin_lengths);

        let harmonics = directions
            .iter()
            .flat_map(|&d| spherical_harmonics(d))
            .collect();
        let harmonics = tape.constant(rays, 16, harmonics);
        let ray_of_sample: Vec<usize> =
            (0..rays * samples).map(|sample| sample / samples).collect();
        let mut input = vec![
            tape.gather_rows(harmonics, ray_of_sample.clone()),
            tape.columns(heads, 1..1 + config.geometry),
        ];
        if let Some(code) = self.code {
            input.push(tape.gather_rows(code, ray_of_sample));
        }
        let input = tape.concat(&input);
        let z = plain_network(tape, &self.color, input);
        let rgb = sigmoid(tape, z);
        let black = tape.constant(rays, 3, vec![0.0; rays * 3]);
        composite(tape, weights, rgb, black)
    }
}
