//! What is wanted of a ray besides its colour: masks, a sensor's depth, monocular depth and normals, and what these ask of the samples.

use super::sampling::dot;
use super::surface::normalized;
use super::tape::{Tape, Var};

/// Weights of the losses, and what is known of each ray; a weight of 0 leaves its loss out.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Supervision {
    pub mask: f64,
    pub sensor_depth: f64,
    pub mono_depth: f64,
    pub mono_normal: f64,
    pub known: Vec<Known>,
}

/// What is known of a ray beforehand.
#[derive(Clone, Debug, PartialEq)]
pub struct Known {
    /// z-depth of a unit of distance along the ray.
    pub cosine: f64,
    /// Up to scale and shift; not finite where unknown.
    pub mono_depth: f64,
    /// In the camera's axes; zero where unknown.
    pub mono_normal: [f64; 3],
    /// 0 where unknown.
    pub sensor_depth: f64,
    /// The camera's axes in the region frame.
    pub axes: [[f64; 3]; 3],
}

/// Σ w, `[n, 1]`, for [`super::volume::ray_weights`] `[n, S + 1]`.
pub fn accumulation(tape: &mut Tape, weights: Var) -> Var {
    let (n, samples) = (weights.rows, weights.cols - 1);
    let rows = tape.value(weights).chunks_exact(samples + 1);
    let value = rows.map(|row| row[..samples].iter().sum()).collect();
    tape.record(n, 1, value, &[weights], move |_, d, gradients| {
        if let Some(d_weights) = gradients.of(weights) {
            for (row, d) in d_weights.chunks_exact_mut(samples + 1).zip(d) {
                row[..samples].iter_mut().for_each(|d_w| *d_w += d);
            }
        }
    })
}

/// Σ w m/(Σ w + 1e-10), `[n, 1]`, with the bins' midpoints m `[n, S]`.
pub fn depth(tape: &mut Tape, weights: Var, midpoints: Vec<f64>) -> Var {
    let (n, samples) = (weights.rows, weights.cols - 1);
    assert_eq!(midpoints.len(), n * samples);
    // Numerator and denominator.
    let parts = move |tape: &Tape, ray: usize, midpoints: &[f64]| {
        let row = &tape.value(weights)[ray * (samples + 1)..][..samples];
        let weighted: f64 = row.iter().zip(midpoints).map(|(w, m)| w * m).sum();
        (weighted, row.iter().sum::<f64>() + 1e-10)
    };
    let of_ray = move |ray: usize| ray * samples..(ray + 1) * samples;
    let value = (0..n)
        .map(|ray| {
            let (weighted, total) = parts(tape, ray, &midpoints[of_ray(ray)]);
            weighted / total
        })
        .collect();
    tape.record(n, 1, value, &[weights], move |tape, d, gradients| {
        let Some(d_weights) = gradients.of(weights) else {
            return;
        };
        for ray in 0..n {
            let midpoints = &midpoints[of_ray(ray)];
            let (weighted, total) = parts(tape, ray, midpoints);
            for (sample, m) in midpoints.iter().enumerate() {
                d_weights[ray * (samples + 1) + sample] +=
                    d[ray] * (m / total - weighted / (total * total));
            }
        }
    })
}

/// Σ w n, `[n, 3]`, with the samples' normals `[n · S, 3]`.
pub fn normal(tape: &mut Tape, weights: Var, normals: Var) -> Var {
    let (rays, samples) = (weights.rows, weights.cols - 1);
    assert_eq!(normals.rows, rays * samples);
    let mut value = vec![0.0; rays * 3];
    for p in 0..rays * samples {
        let (ray, sample) = (p / samples, p % samples);
        let weight = tape.value(weights)[ray * (samples + 1) + sample];
        let n = tape.point(normals, p);
        (0..3).for_each(|axis| value[ray * 3 + axis] += weight * n[axis]);
    }
    tape.record(
        rays,
        3,
        value,
        &[weights, normals],
        move |tape, d, gradients| {
            for p in 0..rays * samples {
                let (ray, sample) = (p / samples, p % samples);
                let at = ray * (samples + 1) + sample;
                for axis in 0..3 {
                    let d = d[ray * 3 + axis];
                    if let Some(d_weights) = gradients.of(weights) {
                        d_weights[at] += d * tape.value(normals)[p * 3 + axis];
                    }
                    if let Some(d_normals) = gradients.of(normals) {
                        d_normals[p * 3 + axis] += d * tape.value(weights)[at];
                    }
                }
            }
        },
    )
}

/// Mean over the rays of `counts` times a function of a ray's row of `x`, given its value and derivatives.
fn mean_of<const C: usize>(
    tape: &mut Tape,
    x: Var,
    counts: &[f64],
    f: impl Fn(usize, [f64; C]) -> (f64, [f64; C]) + 'static,
) -> Var {
    assert_eq!((x.rows, x.cols), (counts.len(), C));
    let counts = counts.to_vec();
    let n = x.rows;
    let row = move |tape: &Tape, ray: usize| -> [f64; C] {
        std::array::from_fn(|column| tape.value(x)[ray * C + column])
    };
    // What does not count may be unknown, and no number.
    let counting: Vec<usize> = (0..n).filter(|&ray| counts[ray] > 0.0).collect();
    let value = (counting.iter())
        .map(|&ray| counts[ray] * f(ray, row(tape, ray)).0 / n as f64)
        .sum();
    tape.record(1, 1, vec![value], &[x], move |tape, d, gradients| {
        let Some(d_x) = gradients.of(x) else { return };
        for &ray in &counting {
            let slopes = f(ray, row(tape, ray)).1;
            for (column, slope) in slopes.into_iter().enumerate() {
                d_x[ray * C + column] += d[0] * counts[ray] * slope / n as f64;
            }
        }
    })
}

/// Binary cross-entropy of accumulated weights, clipped to [1e-3, 1 − 1e-3], against masks of 0 and 1.
pub fn mask(tape: &mut Tape, accumulation: Var, masks: Vec<f64>, counts: &[f64]) -> Var {
    mean_of(tape, accumulation, counts, move |ray, [a]| {
        let (m, clipped) = (masks[ray], a.clamp(1e-3, 1.0 - 1e-3));
        let loss = -(m * clipped.ln() + (1.0 - m) * (1.0 - clipped).ln());
        let slope = match a == clipped {
            true => (1.0 - m) / (1.0 - a) - m / a,
            false => 0.0,
        };
        (loss, [slope])
    })
}

/// |c t − z| where a sensor measured z > 0.
pub fn sensor_depth(tape: &mut Tape, depth: Var, known: &[Known], counts: &[f64]) -> Var {
    let known = known.to_vec();
    let counts: Vec<f64> = (known.iter().zip(counts))
        .map(|(known, &counts)| {
            if known.sensor_depth > 0.0 {
                counts
            } else {
                0.0
            }
        })
        .collect();
    mean_of(tape, depth, &counts, move |ray, [t]| {
        let Known {
            cosine,
            sensor_depth,
            ..
        } = known[ray];
        let error = cosine * t - sensor_depth;
        (error.abs(), [cosine * error.signum()])
    })
}

/// (a c t + b − p)² with the scale a and shift b for which its mean is least, by the normal equations. No derivative is taken of a and b.
pub fn mono_depth(tape: &mut Tape, depth: Var, known: &[Known], counts: &[f64]) -> Var {
    let known = known.to_vec();
    let counts: Vec<f64> = (known.iter().zip(counts))
        .map(|(known, &counts)| {
            if known.mono_depth.is_finite() {
                counts
            } else {
                0.0
            }
        })
        .collect();
    let mut sums = [0.0; 5]; // of 1, x, p, x², x p
    for (ray, &weight) in counts.iter().enumerate() {
        if weight > 0.0 {
            let (x, p) = (
                known[ray].cosine * tape.value(depth)[ray],
                known[ray].mono_depth,
            );
            for (sum, term) in sums.iter_mut().zip([1.0, x, p, x * x, x * p]) {
                *sum += weight * term;
            }
        }
    }
    let [one, x, p, xx, xp] = sums;
    let determinant = xx * one - x * x;
    let (a, b) = (
        (one * xp - x * p) / determinant,
        (xx * p - x * xp) / determinant,
    );
    mean_of(tape, depth, &counts, move |ray, [t]| {
        let cosine = known[ray].cosine;
        let error = a * cosine * t + b - known[ray].mono_depth;
        (error * error, [2.0 * error * a * cosine])
    })
}

/// Σ |n − p| + 1 − n · p in the camera's axes, n the rendered normal at unit length.
pub fn mono_normal(tape: &mut Tape, normal: Var, known: &[Known], counts: &[f64]) -> Var {
    let known = known.to_vec();
    let counts: Vec<f64> = (known.iter().zip(counts))
        .map(|(known, &counts)| {
            if known.mono_normal == [0.0; 3] {
                0.0
            } else {
                counts
            }
        })
        .collect();
    mean_of(tape, normal, &counts, move |ray, rendered| {
        let Known {
            mono_normal: prior,
            axes,
            ..
        } = known[ray];
        let n = axes.map(|axis| dot(axis, normalized(rendered)));
        let error: [f64; 3] = std::array::from_fn(|j| n[j] - prior[j]);
        let loss = error.iter().map(|e| e.abs()).sum::<f64>() + 1.0 - dot(n, prior);
        let d_n: [f64; 3] = std::array::from_fn(|j| error[j].signum() - prior[j]);
        // Back to the region frame, and through the division by the length.
        let d_unit: [f64; 3] = std::array::from_fn(|i| (0..3).map(|j| axes[j][i] * d_n[j]).sum());
        let unit = normalized(rendered);
        let along = dot(unit, d_unit);
        let length = dot(rendered, rendered).sqrt().max(1e-12);
        let d = std::array::from_fn(|i| (d_unit[i] - along * unit[i]) / length);
        (loss, d)
    })
}
