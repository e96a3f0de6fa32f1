//! From signed distances to colours: scale, Laplace density or NeuS's opacity, quadrature along the ray, compositing.

use super::batch::Scale;
use super::networks::logistic;
use super::tape::{Tape, Var};

/// 1/β of the scale logit v: 1/(range·sigmoid(v) + floor), not below `lower`; where `lower` holds, v gets no gradient.
pub fn inverse_scale(tape: &mut Tape, logit: Var, range: f64, floor: f64, lower: f64) -> Var {
    tape.map(
        logit,
        move |v| (1.0 / (range * logistic(v) + floor)).max(lower),
        move |v, _| {
            let sigmoid = logistic(v);
            let inverse = 1.0 / (range * sigmoid + floor);
            if inverse < lower {
                0.0
            } else {
                -inverse * inverse * range * sigmoid * (1.0 - sigmoid)
            }
        },
    )
}

/// 1/β of one v for all, |v| + floor or e^(rate v); nothing bounds it from below.
pub fn shared_inverse_scale(tape: &mut Tape, v: Var, scale: Scale, floor: f64) -> Var {
    match scale {
        Scale::Local => panic!("every sample has its own"),
        Scale::Beta => tape.map(
            v,
            move |v| 1.0 / (v.abs() + floor),
            move |v, y| -y * y * v.signum(),
        ),
        Scale::Exponential { rate } => tape.map(v, move |v| (rate * v).exp(), move |_, y| rate * y),
    }
}

/// NeuS: τ = −ln(1 − α), α = (Φ(s(f − ½c̃δ)) − Φ(s(f + ½c̃δ)))/(Φ(s(f − ½c̃δ)) + 1e-5), c̃ = −(relu(½ − ½c)(1 − a) + relu(−c) a), c = g·d,
/// for bin lengths δ and scales s, all `[n]`, directions `[n, 3]`.
pub fn neus_depth(
    tape: &mut Tape,
    [sdf, gradient, inv_s]: [Var; 3],
    directions: &[[f64; 3]],
    lengths: Vec<f64>,
    anneal: f64,
) -> Var {
    const EPSILON: f64 = 1e-5;
    let n = sdf.len();
    assert_eq!([gradient.rows, inv_s.len(), lengths.len()], [n; 3]);
    let directions = directions.to_vec();
    // c, c̃, and Φ at both ends.
    let at = move |tape: &Tape, i: usize, direction: [f64; 3], length: f64| {
        let g = tape.point(gradient, i);
        let c: f64 = g.iter().zip(direction).map(|(g, d)| g * d).sum::<f64>() + 1e-8;
        let facing = (0.5 - 0.5 * c).max(0.0) * (1.0 - anneal) + (-c).max(0.0) * anneal;
        let (f, s) = (tape.value(sdf)[i], tape.value(inv_s)[i]);
        let ends = [0.5, -0.5].map(|side| f + side * facing * length);
        (c, ends, ends.map(|x| logistic(s * x)))
    };
    let value = (0..n)
        .map(|i| {
            let (_, _, [before, after]) = at(tape, i, directions[i], lengths[i]);
            -(1.0 - (before - after) / (before + EPSILON)).ln()
        })
        .collect();
    tape.record(
        sdf.rows,
        sdf.cols,
        value,
        &[sdf, gradient, inv_s],
        move |tape, d_tau, gradients| {
            for i in 0..n {
                let (c, ends, phi) = at(tape, i, directions[i], lengths[i]);
                let [before, after] = phi;
                let alpha = (before - after) / (before + EPSILON);
                let d_alpha = d_tau[i] / (1.0 - alpha);
                let d_phi = [
                    d_alpha * (after + EPSILON) / (before + EPSILON).powi(2),
                    -d_alpha / (before + EPSILON),
                ];
                let s = tape.value(inv_s)[i];
                let d_end = [0, 1].map(|end| d_phi[end] * phi[end] * (1.0 - phi[end]));
                if let Some(d_sdf) = gradients.of(sdf) {
                    d_sdf[i] += s * (d_end[0] + d_end[1]);
                }
                if let Some(d_s) = gradients.of(inv_s) {
                    d_s[i] += ends[0] * d_end[0] + ends[1] * d_end[1];
                }
                if let Some(d_gradient) = gradients.of(gradient) {
                    let d_facing = 0.5 * lengths[i] * s * (d_end[0] - d_end[1]);
                    let soft = if c < 1.0 { -0.5 } else { 0.0 };
                    let hard = if c < 0.0 { -1.0 } else { 0.0 };
                    let d_c = d_facing * (soft * (1.0 - anneal) + hard * anneal);
                    for axis in 0..3 {
                        d_gradient[i * 3 + axis] += d_c * directions[i][axis];
                    }
                }
            }
        },
    )
}

/// 1/x
pub fn reciprocal(tape: &mut Tape, x: Var) -> Var {
    tape.map(x, |x| 1.0 / x, |_, y| -y * y)
}

/// σ = (½ + ½ sign(a) expm1(−|a|/β))/β, the Laplace distribution's share inside the surface at distance a, over β.
pub fn laplace(a: f64, beta: f64) -> f64 {
    (0.5 + 0.5 * sign(a) * (-a.abs() / beta).exp_m1()) / beta
}

/// sign with sign(0) = 0
fn sign(a: f64) -> f64 {
    if a == 0.0 { 0.0 } else { a.signum() }
}

pub fn laplace_density(tape: &mut Tape, a: Var, beta: Var) -> Var {
    assert_eq!(a.len(), beta.len());
    let value = tape
        .value(a)
        .iter()
        .zip(tape.value(beta))
        .map(|(&a, &beta)| laplace(a, beta))
        .collect();
    tape.record(
        a.rows,
        a.cols,
        value,
        &[a, beta],
        move |tape, d_sigma, gradients| {
            for (i, d_sigma) in d_sigma.iter().enumerate() {
                let (at, scale) = (tape.value(a)[i], tape.value(beta)[i]);
                let tail = 0.5 * (-at.abs() / scale).exp();
                if let Some(d_a) = gradients.of(a) {
                    d_a[i] -= d_sigma * sign(at).abs() * tail / (scale * scale);
                }
                if let Some(d_beta) = gradients.of(beta) {
                    d_beta[i] +=
                        d_sigma * (tail * at / (scale * scale) - laplace(at, scale)) / scale;
                }
            }
        },
    )
}

/// a = f/|g·d + 1e-8|, the distance along the ray if the surface were a plane (stage 2); `directions` `[n, 3]`.
pub fn distance_along_ray(tape: &mut Tape, sdf: Var, gradient: Var, directions: Var) -> Var {
    assert_eq!((gradient.rows, directions.rows), (sdf.len(), sdf.len()));
    let slope = move |tape: &Tape, i: usize| -> f64 {
        let (g, d) = (
            &tape.value(gradient)[i * 3..i * 3 + 3],
            &tape.value(directions)[i * 3..i * 3 + 3],
        );
        g.iter().zip(d).map(|(g, d)| g * d).sum::<f64>() + 1e-8
    };
    let value = (0..sdf.len())
        .map(|i| tape.value(sdf)[i] / slope(tape, i).abs())
        .collect();
    tape.record(
        sdf.rows,
        sdf.cols,
        value,
        &[sdf, gradient],
        move |tape, d_a, gradients| {
            for (i, d_a) in d_a.iter().enumerate() {
                let c = slope(tape, i);
                if let Some(d_f) = gradients.of(sdf) {
                    d_f[i] += d_a / c.abs();
                }
                if let Some(d_g) = gradients.of(gradient) {
                    for axis in 0..3 {
                        let d = tape.value(directions)[i * 3 + axis];
                        d_g[i * 3 + axis] -= d_a * tape.value(sdf)[i] * sign(c) * d / (c * c);
                    }
                }
            }
        },
    )
}

/// τ_i = σ_i δ_i, T_i = exp(−Σ_{j<i} τ_j), w_i = (1 − e^(−τ_i)) T_i for σ `[n, S]` and bin lengths δ.
/// The result is `[n, S + 1]`: the weights, and in the last column what is left behind the last sample, T_S.
pub fn ray_weights(tape: &mut Tape, sigma: Var, lengths: Vec<f64>) -> Var {
    let (rays, samples) = (sigma.rows, sigma.cols);
    assert_eq!(lengths.len(), rays * samples);
    let mut value = Vec::with_capacity(rays * (samples + 1));
    for (sigma, lengths) in tape
        .value(sigma)
        .chunks_exact(samples)
        .zip(lengths.chunks_exact(samples))
    {
        let mut depth: f64 = 0.0;
        for (sigma, length) in sigma.iter().zip(lengths) {
            let tau = sigma * length;
            value.push(-(-tau).exp_m1() * (-depth).exp());
            depth += tau;
        }
        value.push((-depth).exp());
    }
    tape.record(
        rays,
        samples + 1,
        value,
        &[sigma],
        move |tape, d_weights, gradients| {
            let Some(d_sigma) = gradients.of(sigma) else {
                return;
            };
            for ray in 0..rays {
                let at = ray * samples;
                let mut transmittance = vec![1.0];
                for sample in 0..samples {
                    let tau = tape.value(sigma)[at + sample] * lengths[at + sample];
                    transmittance.push(transmittance[sample] * (-tau).exp());
                }
                // ∂w_i/∂τ_i = T_{i+1}; ∂w_j/∂τ_i = −w_j for j > i; ∂T_S/∂τ_i = −T_S.
                let d_w = &d_weights[ray * (samples + 1)..][..samples + 1];
                let mut behind = d_w[samples] * transmittance[samples];
                for sample in (0..samples).rev() {
                    let d_tau = d_w[sample] * transmittance[sample + 1] - behind;
                    d_sigma[at + sample] += d_tau * lengths[at + sample];
                    behind += d_w[sample] * (transmittance[sample] - transmittance[sample + 1]);
                }
            }
        },
    )
}

/// C = Σ w_i c_i + T_S C_bg for [`ray_weights`] `[n, S + 1]`, colours `[n·S, 3]`, backgrounds `[n, 3]`.
pub fn composite(tape: &mut Tape, weights: Var, colors: Var, background: Var) -> Var {
    let (rays, samples) = (weights.rows, weights.cols - 1);
    assert_eq!(
        (colors.len(), background.len()),
        (rays * samples * 3, rays * 3)
    );
    let behind = move |ray: usize, sample: usize| {
        if sample < samples {
            Ok(ray * samples + sample)
        } else {
            Err(ray)
        }
    };
    let mut value = vec![0.0; rays * 3];
    for ray in 0..rays {
        for sample in 0..=samples {
            let seen = match behind(ray, sample) {
                Ok(point) => &tape.value(colors)[point * 3..point * 3 + 3],
                Err(ray) => &tape.value(background)[ray * 3..ray * 3 + 3],
            };
            let weight = tape.value(weights)[ray * (samples + 1) + sample];
            (0..3).for_each(|channel| value[ray * 3 + channel] += weight * seen[channel]);
        }
    }
    tape.record(
        rays,
        3,
        value,
        &[weights, colors, background],
        move |tape, d_color, gradients| {
            for ray in 0..rays {
                let d_color = &d_color[ray * 3..ray * 3 + 3];
                for sample in 0..=samples {
                    let (source, row) = match behind(ray, sample) {
                        Ok(point) => (colors, point),
                        Err(ray) => (background, ray),
                    };
                    let at = ray * (samples + 1) + sample;
                    for channel in 0..3 {
                        if let Some(d_weights) = gradients.of(weights) {
                            d_weights[at] +=
                                d_color[channel] * tape.value(source)[row * 3 + channel];
                        }
                        if let Some(d_source) = gradients.of(source) {
                            d_source[row * 3 + channel] +=
                                d_color[channel] * tape.value(weights)[at];
                        }
                    }
                }
            }
        },
    )
}

/// What a colour network's sigmoid leaves is widened a little, so that 0 and 1 can be reached: 1.002 c − 0.001.
pub fn pad_color(tape: &mut Tape, rgb: Var) -> Var {
    tape.map(rgb, |rgb| 1.002 * rgb - 0.001, |_, _| 1.002)
}

/// Σ w_i m_i/(Σ w_i + 1e-10) with the bins' midpoints m.
pub fn expected_depth(weights: &[f64], midpoints: &[f64]) -> f64 {
    let total: f64 = weights.iter().sum();
    weights
        .iter()
        .zip(midpoints)
        .map(|(w, m)| w * m)
        .sum::<f64>()
        / (total + 1e-10)
}
