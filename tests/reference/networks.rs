//! The layers that the fields are made of: linear maps, weight normalisation, activations, and the two encodings of a direction.

use super::tape::{Tape, Var};
use std::f64::consts::FRAC_PI_2;

/// W_r = g_r · V_r / ‖V_r‖ for V `[outputs, inputs]` and g `[outputs, 1]` (Salimans & Kingma 2016).
pub fn weight_norm(tape: &mut Tape, v: Var, g: Var) -> Var {
    assert_eq!(v.rows, g.len());
    let cols = v.cols;
    let norm = |row: &[f64]| row.iter().map(|v| v * v).sum::<f64>().sqrt();
    let mut value = Vec::with_capacity(v.len());
    for (row, g) in tape.value(v).chunks_exact(cols).zip(tape.value(g)) {
        let length = norm(row);
        value.extend(row.iter().map(|v| g * v / length));
    }
    tape.record(v.rows, cols, value, &[v, g], move |tape, d_w, gradients| {
        for (row, d_w) in d_w.chunks_exact(cols).enumerate() {
            let direction = &tape.value(v)[row * cols..(row + 1) * cols];
            let length = norm(direction);
            // ∂L/∂g = d_w · V/‖V‖ and ∂L/∂V = g/‖V‖ (d_w − (∂L/∂g) V/‖V‖).
            let d_scale = d_w
                .iter()
                .zip(direction)
                .map(|(d_w, v)| d_w * v)
                .sum::<f64>()
                / length;
            let factor = tape.value(g)[row] / length;
            if let Some(d_g) = gradients.of(g) {
                d_g[row] += d_scale;
            }
            if let Some(d_v) = gradients.of(v) {
                for ((d_v, d_w), v) in d_v[row * cols..(row + 1) * cols]
                    .iter_mut()
                    .zip(d_w)
                    .zip(direction)
                {
                    *d_v += factor * (d_w - d_scale * v / length);
                }
            }
        }
    })
}

/// A weight-normalised layer's parameters.
#[derive(Clone, Copy)]
pub struct NormedLayer {
    /// `[outputs, inputs]`
    pub v: Var,
    /// `[outputs, 1]`
    pub g: Var,
    /// `[1, outputs]`
    pub bias: Var,
}

impl NormedLayer {
    pub fn apply(self, tape: &mut Tape, x: Var) -> Var {
        let w = weight_norm(tape, self.v, self.g);
        self.apply_weights(tape, w, x)
    }

    fn apply_weights(self, tape: &mut Tape, w: Var, x: Var) -> Var {
        let product = tape.matmul_transposed(x, w);
        tape.add_row(product, self.bias)
    }

    pub fn apply_with_relu(self, tape: &mut Tape, x: Var) -> Var {
        let w = weight_norm(tape, self.v, self.g);
        let z = self.apply_weights(tape, w, x);
        relu(tape, z, x, w, Some(self.bias))
    }
}

/// Softplus of sharpness 100: log(1 + e^(100x))/100, and x itself above 100x > 20.
pub fn softplus_100(tape: &mut Tape, x: Var) -> Var {
    tape.map(
        x,
        |x| {
            if 100.0 * x > 20.0 {
                x
            } else {
                (100.0 * x).exp().ln_1p() / 100.0
            }
        },
        |x, _| {
            if 100.0 * x > 20.0 {
                1.0
            } else {
                logistic(100.0 * x)
            }
        },
    )
}

/// The slope of [`softplus_100`], to be differentiated itself.
pub fn softplus_100_slope(tape: &mut Tape, x: Var) -> Var {
    let linear = |x: f64| 100.0 * x > 20.0;
    tape.map(
        x,
        move |x| if linear(x) { 1.0 } else { logistic(100.0 * x) },
        move |x, y| {
            if linear(x) {
                0.0
            } else {
                100.0 * y * (1.0 - y)
            }
        },
    )
}

/// max(z, 0) for z = x Wᵀ + b, with slope 0 at 0 unless the tape says otherwise.
pub fn relu(tape: &mut Tape, z: Var, x: Var, w: Var, bias: Option<Var>) -> Var {
    let edge = tape.relu_edge;
    let value: Vec<f64> = tape.value(z).iter().map(|z| z.max(0.0)).collect();
    let mut slope: Vec<f64> = tape
        .value(z)
        .iter()
        .map(|&z| f64::from(u8::from(z > 0.0)))
        .collect();
    if edge.margin > 0.0 {
        for (row, x) in tape.value(x).chunks_exact(x.cols).enumerate() {
            for (unit, w_row) in tape.value(w).chunks_exact(w.cols).enumerate() {
                let at = row * w.rows + unit;
                let products: f64 = x.iter().zip(w_row).map(|(x, w)| (x * w).abs()).sum();
                let bias = bias.map_or(0.0, |bias| tape.value(bias)[unit].abs());
                if tape.value(z)[at].abs() <= edge.margin * (products + bias) {
                    slope[at] = edge.slope;
                }
            }
        }
    }
    tape.record(z.rows, z.cols, value, &[z], move |_, d_y, gradients| {
        if let Some(d_z) = gradients.of(z) {
            for ((d_z, d_y), slope) in d_z.iter_mut().zip(d_y).zip(&slope) {
                *d_z += d_y * slope;
            }
        }
    })
}

pub fn sigmoid(tape: &mut Tape, x: Var) -> Var {
    tape.map(x, logistic, |_, y| y * (1.0 - y))
}

/// e^x whose slope is e^clamp(x, −15, 15), so that one wild density cannot explode a step.
pub fn exp_with_bounded_slope(tape: &mut Tape, x: Var) -> Var {
    tape.map(x, f64::exp, |x, _| x.clamp(-15.0, 15.0).exp())
}

pub fn logistic(x: f64) -> f64 {
    if x >= 0.0 {
        1.0 / (1.0 + (-x).exp())
    } else {
        x.exp() / (1.0 + x.exp())
    }
}

/// Weight-normalised ReLU layers, the last one with a sigmoid instead.
pub fn color_network(tape: &mut Tape, layers: &[NormedLayer], x: Var) -> Var {
    let (last, hidden) = layers
        .split_last()
        .expect("a network of at least one layer");
    let mut x = x;
    for layer in hidden {
        x = layer.apply_with_relu(tape, x);
    }
    let z = last.apply(tape, x);
    sigmoid(tape, z)
}

/// Weight-normalised softplus layer, then a linear one.
pub fn geometry_network(tape: &mut Tape, hidden: NormedLayer, heads: NormedLayer, x: Var) -> Var {
    let z = hidden.apply(tape, x);
    let h = softplus_100(tape, z);
    heads.apply(tape, h)
}

/// [`geometry_network`], and the derivative of its first output by its input, ∂y₀/∂x = W₁ᵀ (softplus'(z) ⊙ w₂) with w₂ the first row of
/// W₂: `[n, inputs]`. As an explicit expression of the parameters it can be differentiated again.
pub fn geometry_network_with_slope(
    tape: &mut Tape,
    hidden: NormedLayer,
    heads: NormedLayer,
    x: Var,
) -> (Var, Var) {
    let w1 = weight_norm(tape, hidden.v, hidden.g);
    let z = hidden.apply_weights(tape, w1, x);
    let h = softplus_100(tape, z);
    let w2 = weight_norm(tape, heads.v, heads.g);
    let y = heads.apply_weights(tape, w2, h);

    let slope = softplus_100_slope(tape, z);
    let first_row = tape.gather_rows(w2, vec![0; x.rows]);
    let d_z = tape.multiply(slope, first_row);
    let w1_transposed = tape.transpose(w1);
    (y, tape.matmul_transposed(d_z, w1_transposed))
}

/// Plain layers without bias, ReLU between them.
pub fn plain_network(tape: &mut Tape, layers: &[Var], x: Var) -> Var {
    let (last, hidden) = layers
        .split_last()
        .expect("a network of at least one layer");
    let mut x = x;
    for &layer in hidden {
        let z = tape.matmul_transposed(x, layer);
        x = relu(tape, z, x, layer, None);
    }
    tape.matmul_transposed(x, *last)
}

/// Frequencies 1, 2, 4, 8 without a factor 2π: 12 sines (axis-major), the same 12 a quarter turn later, then d itself.
pub fn direction_encoding(d: [f64; 3]) -> [f64; 27] {
    let mut encoding = [0.0; 27];
    for axis in 0..3 {
        for frequency in 0..4 {
            let angle = f64::from(1 << frequency) * d[axis];
            encoding[axis * 4 + frequency] = angle.sin();
            encoding[12 + axis * 4 + frequency] = (angle + FRAC_PI_2).sin();
        }
        encoding[24 + axis] = d[axis];
    }
    encoding
}

/// Real spherical harmonics of degrees 0 to 3 with the Condon-Shortley phase, order m = −l…l within a degree.
pub fn spherical_harmonics([x, y, z]: [f64; 3]) -> [f64; 16] {
    let pi = std::f64::consts::PI;
    let c = |numerator: f64, denominator: f64| (numerator / (denominator * pi)).sqrt();
    [
        c(1.0, 4.0),
        -c(3.0, 4.0) * y,
        c(3.0, 4.0) * z,
        -c(3.0, 4.0) * x,
        c(15.0, 4.0) * x * y,
        -c(15.0, 4.0) * y * z,
        c(5.0, 16.0) * (3.0 * z * z - 1.0),
        -c(15.0, 4.0) * x * z,
        c(15.0, 16.0) * (x * x - y * y),
        c(35.0, 32.0) * y * (y * y - 3.0 * x * x),
        c(105.0, 4.0) * x * y * z,
        c(21.0, 32.0) * y * (1.0 - 5.0 * z * z),
        c(7.0, 16.0) * z * (5.0 * z * z - 3.0),
        c(21.0, 32.0) * x * (1.0 - 5.0 * z * z),
        c(105.0, 16.0) * z * (x * x - y * y),
        c(35.0, 32.0) * x * (3.0 * y * y - x * x),
    ]
}
