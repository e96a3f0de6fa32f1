//! The losses: colour, eikonal and interlevel in both stages, explicit bias correction in stage 1, tangent normals in stage 2.

use super::sampling::dot;
use super::tape::{Tape, Var};
use std::f64::consts::PI;

/// Per ray: weight · mean over the channels of |e| + squared · e², e = C − target, for C `[n, 3]` and targets (r, g, b, weight). `[n, 1]`.
pub fn color(tape: &mut Tape, rendered: Var, target: &[[f64; 4]], squared: f64) -> Var {
    assert_eq!(rendered.rows, target.len());
    let target = target.to_vec();
    let value = target
        .iter()
        .zip(tape.value(rendered).chunks_exact(3))
        .map(|(&[r, g, b, weight], c)| {
            let errors = [c[0] - r, c[1] - g, c[2] - b];
            weight
                * errors
                    .map(|e| e.abs() + squared * e * e)
                    .iter()
                    .sum::<f64>()
                / 3.0
        })
        .collect();
    tape.record(
        rendered.rows,
        1,
        value,
        &[rendered],
        move |tape, d_loss, gradients| {
            let Some(d_rendered) = gradients.of(rendered) else {
                return;
            };
            for (ray, target) in target.iter().enumerate() {
                for channel in 0..3 {
                    let error = tape.value(rendered)[ray * 3 + channel] - target[channel];
                    if error != 0.0 {
                        d_rendered[ray * 3 + channel] +=
                            d_loss[ray] * target[3] * (error.signum() + 2.0 * squared * error)
                                / 3.0;
                    }
                }
            }
        },
    )
}

/// Mean over the samples of (‖g‖ − 1)², for g `[n, 3]`.
pub fn eikonal(tape: &mut Tape, gradient: Var) -> Var {
    let n = gradient.rows as f64;
    let length = |g: &[f64]| g.iter().map(|g| g * g).sum::<f64>().sqrt();
    let value = tape
        .value(gradient)
        .chunks_exact(3)
        .map(|g| (length(g) - 1.0).powi(2))
        .sum::<f64>()
        / n;
    tape.record(
        1,
        1,
        vec![value],
        &[gradient],
        move |tape, d_loss, gradients| {
            let Some(d_gradient) = gradients.of(gradient) else {
                return;
            };
            for (d_g, g) in d_gradient
                .chunks_exact_mut(3)
                .zip(tape.value(gradient).chunks_exact(3))
            {
                let length = length(g);
                if length > 0.0 {
                    let factor = d_loss[0] * 2.0 * (length - 1.0) / (length * n);
                    d_g.iter_mut()
                        .zip(g)
                        .for_each(|(d_g, g)| *d_g += factor * g);
                }
            }
        },
    )
}

/// How the rays' hinges become one number.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum BiasReduction {
    /// mean over the rays of gate · hinge: the loss that was meant.
    PerRay,
    /// (mean of the gates) · (mean of the hinges): what the authors' code computes, by broadcasting `[n, 1]` against `[n]`.
    Published,
}

/// A ray's heaviest sample, first of equals.
pub fn heaviest(weights: &[f64]) -> usize {
    (0..weights.len()).fold(
        0,
        |best, i| if weights[i] > weights[best] { i } else { best },
    )
}

/// 1 where the ray crosses the surface (some f < 0) and, if asked for, is opaque (Σ w > 0.999).
pub fn bias_gate(sdf: &[f64], weights: &[f64], need_opaque: bool) -> f64 {
    let crosses = sdf.iter().any(|&f| f < 0.0);
    let opaque = weights.iter().sum::<f64>() > 0.999;
    if crosses && (opaque || !need_opaque) {
        1.0
    } else {
        0.0
    }
}

/// Points P + εd of all rays, then P + cd of all rays, for P the middle of each ray's heaviest bin.
pub fn bias_points(
    middles: &[[f64; 3]],
    directions: &[[f64; 3]],
    epsilon: f64,
    offset: f64,
) -> Vec<[f64; 3]> {
    [epsilon, offset]
        .iter()
        .flat_map(|&step| {
            middles
                .iter()
                .zip(directions)
                .map(move |(p, d)| std::array::from_fn(|axis| p[axis] + step * d[axis]))
        })
        .collect()
}

/// Hinge relu(f(P + εd) + ε) · 1[f(P + cd) > 0] per ray, reduced; f `[2n, 1]` at [`bias_points`]. The second half gets no gradient.
pub fn bias(
    tape: &mut Tape,
    f: Var,
    gates: Vec<f64>,
    epsilon: f64,
    reduction: BiasReduction,
) -> Var {
    let n = gates.len();
    assert_eq!(f.len(), 2 * n);
    let mean_gate = gates.iter().sum::<f64>() / n as f64;
    let share = move |ray: usize| match reduction {
        BiasReduction::PerRay => gates[ray] / n as f64,
        BiasReduction::Published => mean_gate / n as f64,
    };
    let hinge = move |f: &[f64], ray: usize| {
        if f[n + ray] > 0.0 {
            (f[ray] + epsilon).max(0.0)
        } else {
            0.0
        }
    };
    let value = (0..n)
        .map(|ray| share(ray) * hinge(tape.value(f), ray))
        .sum();
    tape.record(1, 1, vec![value], &[f], move |tape, d_loss, gradients| {
        let Some(d_f) = gradients.of(f) else { return };
        for (ray, d_f) in d_f[..n].iter_mut().enumerate() {
            if hinge(tape.value(f), ray) > 0.0 {
                *d_f += d_loss[0] * share(ray);
            }
        }
    })
}

/// How far one proposal level's histogram fails to bound the final one: mean over rays and final bins of
/// max(0, w − outer)²/(w + 1e-7), outer the proposal weight of all bins that overlap the final bin.
/// `proposal` `[n, P]` with edges `[n, P + 1]`; the final weights `[n, S]` and edges `[n, S + 1]` are constants.
pub fn interlevel(
    tape: &mut Tape,
    proposal: Var,
    edges: &[f64],
    final_weights: &[f64],
    final_edges: &[f64],
) -> Var {
    let (rays, bins) = (proposal.rows, proposal.cols);
    let samples = final_weights.len() / rays;
    assert_eq!(
        (edges.len(), final_edges.len()),
        (rays * (bins + 1), rays * (samples + 1))
    );
    // First and last proposal bin that a final bin overlaps.
    let mut overlaps = Vec::with_capacity(rays * samples);
    for ray in 0..rays {
        let coarse = &edges[ray * (bins + 1)..][..bins + 1];
        for fine in final_edges[ray * (samples + 1)..][..samples + 1].windows(2) {
            let first = coarse[..bins]
                .partition_point(|&s| s <= fine[0])
                .saturating_sub(1);
            let last = coarse[1..].partition_point(|&s| s <= fine[1]).min(bins - 1);
            overlaps.push((first, last));
        }
    }
    let weights = final_weights.to_vec();
    let mean = 1.0 / weights.len() as f64;
    let excess = |row: &[f64], weight: f64, (first, last): (usize, usize)| {
        (weight - row[first..=last].iter().sum::<f64>()).max(0.0)
    };
    let row_of =
        move |tape: &Tape, ray: usize| tape.value(proposal)[ray * bins..(ray + 1) * bins].to_vec();
    let mut value = 0.0;
    for (i, (&weight, &overlap)) in weights.iter().zip(&overlaps).enumerate() {
        value +=
            mean * excess(&row_of(tape, i / samples), weight, overlap).powi(2) / (weight + 1e-7);
    }
    tape.record(
        1,
        1,
        vec![value],
        &[proposal],
        move |tape, d_loss, gradients| {
            let Some(d_proposal) = gradients.of(proposal) else {
                return;
            };
            for (i, (&weight, &overlap)) in weights.iter().zip(&overlaps).enumerate() {
                let ray = i / samples;
                let d_outer = -2.0 * d_loss[0] * mean * excess(&row_of(tape, ray), weight, overlap)
                    / (weight + 1e-7);
                d_proposal[ray * bins + overlap.0..=ray * bins + overlap.1]
                    .iter_mut()
                    .for_each(|d| *d += d_outer);
            }
        },
    )
}

/// The largest |cosine| that still has a gradient: the angle's slope has a pole at 1.
const STEEPEST: f64 = 1.0 - 1e-6;

/// Mean over the samples of the angle between the unit vectors a and b `[n, 3]`, in half turns: acos(clamp(a · b))/π.
pub fn tangent(tape: &mut Tape, a: Var, b: Var) -> Var {
    let n = a.rows;
    assert_eq!((a.cols, b.rows, b.cols), (3, n, 3));
    let cosine = move |tape: &Tape, row: usize| dot(tape.point(a, row), tape.point(b, row));
    let angle = |row: usize| cosine(tape, row).clamp(-STEEPEST, STEEPEST).acos();
    let mean = 1.0 / (n as f64 * PI);
    let value = (0..n).map(angle).sum::<f64>() * mean;
    tape.record(
        1,
        1,
        vec![value],
        &[a, b],
        move |tape, d_loss, gradients| {
            for row in 0..n {
                let cosine = cosine(tape, row);
                if cosine.abs() > STEEPEST {
                    continue;
                }
                let d_cosine = -d_loss[0] * mean / (1.0 - cosine * cosine).sqrt();
                for (input, other) in [(a, b), (b, a)] {
                    if let Some(d) = gradients.of(input) {
                        let other = tape.point(other, row);
                        (0..3).for_each(|axis| d[row * 3 + axis] += d_cosine * other[axis]);
                    }
                }
            }
        },
    )
}
