//! Rays, samples, compositing and their losses once more, in float64 and as plainly as they can be written.
//!
//! Gradients are the explicit sums of the chain rule, not the recursions of the kernels; the tests check them against central
//! differences before they are compared with anything.

/// Philox4x32-10, first output word (Salmon et al. 2011).
pub fn philox(mut counter: [u32; 4], mut key: [u32; 2]) -> u32 {
    for _ in 0..10 {
        let a = 0xD251_1F53_u64 * u64::from(counter[0]);
        let b = 0xCD9E_8D57_u64 * u64::from(counter[2]);
        counter = [
            (b >> 32) as u32 ^ counter[1] ^ key[0],
            b as u32,
            (a >> 32) as u32 ^ counter[3] ^ key[1],
            a as u32,
        ];
        key = [
            key[0].wrapping_add(0x9E37_79B9),
            key[1].wrapping_add(0xBB67_AE85),
        ];
    }
    counter[0]
}

/// Where o + t d lies in the unit sphere: (near, far, misses).
pub fn meet_sphere(o: [f64; 3], d: [f64; 3]) -> (f64, f64, bool) {
    let b: f64 = (0..3).map(|j| o[j] * d[j]).sum();
    let q = b * b - (o.iter().map(|x| x * x).sum::<f64>() - 1.0);
    if q < 0.0 {
        return (1.0, 1.2, true);
    }
    in_front(-b - q.sqrt(), -b + q.sqrt())
}

/// Where o + t d lies in the box |x_j| <= half_j: (near, far, misses).
pub fn meet_box(o: [f64; 3], d: [f64; 3], half: [f64; 3]) -> (f64, f64, bool) {
    let (mut entry, mut exit) = (f64::NEG_INFINITY, f64::INFINITY);
    for j in 0..3 {
        let (a, b) = ((-half[j] - o[j]) / d[j], (half[j] - o[j]) / d[j]);
        entry = entry.max(a.min(b));
        exit = exit.min(a.max(b));
    }
    in_front(entry, exit)
}

fn in_front(entry: f64, exit: f64) -> (f64, f64, bool) {
    let near = entry.max(0.0);
    if exit - near > 1e-6 {
        (near, exit, false)
    } else {
        (1.0, 1.2, true)
    }
}

pub fn warped(t: f64) -> f64 {
    if t < 1.0 {
        t / 2.0
    } else {
        1.0 - 1.0 / (2.0 * t)
    }
}

/// Distance of a normalised position on a ray with this near and far.
pub fn distance(s: f64, near_far: [f64; 2]) -> f64 {
    let u = s * warped(near_far[1]) + (1.0 - s) * warped(near_far[0]);
    if u < 0.5 {
        2.0 * u
    } else {
        1.0 / (2.0 - 2.0 * u)
    }
}

/// Normalised position of a distance.
pub fn position(t: f64, near_far: [f64; 2]) -> f64 {
    let [near, far] = near_far.map(warped);
    (warped(t) - near) / (far - near)
}

/// Edges of equal bins, each moved within half a bin by the ray's draw.
pub fn place_samples(n_samples: usize, draw: Option<f64>) -> Vec<f64> {
    let s: Vec<f64> = (0..=n_samples)
        .map(|j| j as f64 / n_samples as f64)
        .collect();
    let Some(u) = draw else { return s };
    let middle: Vec<f64> = s.windows(2).map(|pair| (pair[0] + pair[1]) / 2.0).collect();
    let lower = |j: usize| if j == 0 { s[0] } else { middle[j - 1] };
    let upper = |j: usize| {
        if j == n_samples {
            s[n_samples]
        } else {
            middle[j]
        }
    };
    (0..=n_samples)
        .map(|j| lower(j) + (upper(j) - lower(j)) * u)
        .collect()
}

/// Lengths of a ray's bins in distance.
pub fn lengths(edges: &[f64], near_far: [f64; 2]) -> Vec<f64> {
    edges
        .windows(2)
        .map(|pair| distance(pair[1], near_far) - distance(pair[0], near_far))
        .collect()
}

/// Weights, and the transmittance before every sample and after the last.
pub fn quadrature(tau: &[f64]) -> (Vec<f64>, Vec<f64>) {
    let mut transmittance = vec![1.0];
    let mut sum = 0.0;
    for t in tau {
        sum += t;
        transmittance.push((-sum).exp());
    }
    let weights = tau
        .iter()
        .zip(&transmittance)
        .map(|(t, before)| -(-t).exp_m1() * before)
        .collect();
    (weights, transmittance)
}

/// dL/dtau from dL/dw and dL/dT_end: w_i grows with tau_i by T_{i+1}, everything behind shrinks in proportion.
pub fn quadrature_backward(tau: &[f64], d_weights: &[f64], d_end: f64) -> Vec<f64> {
    let (weights, transmittance) = quadrature(tau);
    let n = tau.len();
    (0..n)
        .map(|i| {
            let behind: f64 = (i + 1..n).map(|j| weights[j] * d_weights[j]).sum();
            transmittance[i + 1] * d_weights[i] - behind - transmittance[n] * d_end
        })
        .collect()
}

/// New edges from a proposal's weights; offset is the draw, or 1/2.
pub fn resample(
    edges: &[f64],
    weights: &[f64],
    n_new: usize,
    offset: f64,
    anneal: f64,
) -> Vec<f64> {
    let histogram: Vec<f64> = weights.iter().map(|w| w.powf(anneal) + 0.01).collect();
    let total: f64 = histogram.iter().sum();
    let mut cdf = vec![0.0];
    for h in &histogram {
        cdf.push((cdf[cdf.len() - 1] + h / total).min(1.0));
    }
    let last = cdf.len() - 1;
    let n_edges = n_new + 1;
    (0..n_edges)
        .map(|j| {
            let u = (j as f64 + offset) / n_edges as f64;
            let right = cdf.iter().filter(|&&c| c <= u).count();
            let (below, above) = (right.saturating_sub(1).min(last), right.min(last));
            let fraction = (u - cdf[below]) / (cdf[above] - cdf[below]);
            let fraction = if fraction.is_nan() {
                0.0
            } else {
                fraction.clamp(0.0, 1.0)
            };
            edges[below] + fraction * (edges[above] - edges[below])
        })
        .collect()
}

/// Settings of the local scale.
#[derive(Clone, Copy)]
pub struct Scale {
    pub range: f64,
    pub floor: f64,
    pub inv_s_lower: f64,
}

/// 1/beta and its derivative by the logit.
pub fn local_scale(logit: f64, scale: Scale) -> (f64, f64) {
    let sigmoid = 1.0 / (1.0 + (-logit).exp());
    let inv_s = 1.0 / (scale.range * sigmoid + scale.floor);
    if inv_s < scale.inv_s_lower {
        return (scale.inv_s_lower, 0.0);
    }
    (
        inv_s,
        -inv_s * inv_s * scale.range * sigmoid * (1.0 - sigmoid),
    )
}

/// Laplace density, and its derivatives by the signed distance and by 1/beta.
pub fn laplace(sdf: f64, inv_s: f64) -> (f64, f64, f64) {
    let e = (-sdf.abs() * inv_s).exp();
    let d_sdf = -0.5 * inv_s * inv_s * e;
    match sdf >= 0.0 {
        true => (0.5 * inv_s * e, d_sdf, 0.5 * e * (1.0 - sdf * inv_s)),
        false => (
            inv_s * (1.0 - 0.5 * e),
            d_sdf,
            1.0 - 0.5 * e * (1.0 + sdf * inv_s),
        ),
    }
}

/// One ray before compositing.
#[derive(Clone)]
pub struct RaySamples {
    pub sdf: Vec<f64>,
    pub logit: Vec<f64>,
    pub edges: Vec<f64>,
    pub near_far: [f64; 2],
    pub empty: bool,
    pub rgb: Vec<[f64; 3]>,
    pub background: [f64; 3],
}

/// One ray after compositing.
pub struct Composite {
    pub weights: Vec<f64>,
    pub color: [f64; 3],
    pub accumulation: f64,
    pub end: f64,
    pub depth: f64,
}

/// Gradients of one ray.
pub struct CompositeGradient {
    pub sdf: Vec<f64>,
    pub logit: Vec<f64>,
    pub rgb: Vec<[f64; 3]>,
    pub background: [f64; 3],
}

impl RaySamples {
    fn sdf_of(&self, i: usize) -> f64 {
        if self.empty { 1000.0 } else { self.sdf[i] }
    }

    fn tau(&self, scale: Scale) -> Vec<f64> {
        let lengths = lengths(&self.edges, self.near_far);
        let sigma = |i: usize| laplace(self.sdf_of(i), local_scale(self.logit[i], scale).0).0;
        lengths
            .iter()
            .enumerate()
            .map(|(i, length)| sigma(i) * length)
            .collect()
    }

    pub fn composite(&self, scale: Scale) -> Composite {
        let (weights, transmittance) = quadrature(&self.tau(scale));
        let end = transmittance[weights.len()];
        let mut color = self.background.map(|c| c * end);
        for (w, rgb) in weights.iter().zip(&self.rgb) {
            (0..3).for_each(|c| color[c] += w * (1.002 * rgb[c] - 0.001));
        }
        let accumulation: f64 = weights.iter().sum();
        let t: Vec<f64> = self
            .edges
            .iter()
            .map(|&s| distance(s, self.near_far))
            .collect();
        let depth: f64 = weights
            .iter()
            .zip(t.windows(2))
            .map(|(w, t)| w * (t[0] + t[1]) / 2.0)
            .sum();
        Composite {
            weights,
            color,
            accumulation,
            end,
            depth: depth / (accumulation + 1e-10),
        }
    }

    /// Gradients of sum_c d_color_c color_c.
    pub fn composite_backward(&self, scale: Scale, d_color: [f64; 3]) -> CompositeGradient {
        let forward = self.composite(scale);
        let dot = |a: [f64; 3]| (0..3).map(|c| a[c] * d_color[c]).sum::<f64>();
        let d_weights: Vec<f64> = self
            .rgb
            .iter()
            .map(|rgb| dot(rgb.map(|c| 1.002 * c - 0.001)))
            .collect();
        let d_tau = quadrature_backward(&self.tau(scale), &d_weights, dot(self.background));
        let lengths = lengths(&self.edges, self.near_far);
        let (mut sdf, mut logit) = (Vec::new(), Vec::new());
        for i in 0..lengths.len() {
            let (inv_s, d_inv_s) = local_scale(self.logit[i], scale);
            let (_, by_sdf, by_inv_s) = laplace(self.sdf_of(i), inv_s);
            sdf.push(d_tau[i] * lengths[i] * by_sdf);
            logit.push(d_tau[i] * lengths[i] * by_inv_s * d_inv_s);
        }
        let rgb = forward
            .weights
            .iter()
            .map(|w| d_color.map(|d| 1.002 * w * d))
            .collect();
        CompositeGradient {
            sdf,
            logit,
            rgb,
            background: d_color.map(|d| d * forward.end),
        }
    }
}

/// One ray of a proposal level beside the final samples.
#[derive(Clone)]
pub struct ProposalRay {
    pub final_edges: Vec<f64>,
    pub final_weights: Vec<f64>,
    pub edges: Vec<f64>,
    pub raw: Vec<f64>,
    pub near_far: [f64; 2],
}

impl ProposalRay {
    pub fn tau(&self) -> Vec<f64> {
        self.raw
            .iter()
            .zip(lengths(&self.edges, self.near_far))
            .map(|(raw, length)| raw.exp() * length)
            .collect()
    }

    /// The proposal bins that final bin i touches, first and last.
    fn touched(&self, i: usize) -> (usize, usize) {
        let bins = self.raw.len();
        let below = (0..bins)
            .filter(|&j| self.edges[j] <= self.final_edges[i])
            .count();
        let above = (0..bins)
            .filter(|&j| self.edges[j + 1] <= self.final_edges[i + 1])
            .count();
        (below.saturating_sub(1).min(bins - 1), above.min(bins - 1))
    }

    /// Mean over the ray's final bins.
    pub fn interlevel(&self, weights: &[f64]) -> f64 {
        let excess = |i: usize, w: f64| {
            let (lo, hi) = self.touched(i);
            (w - weights[lo..=hi].iter().sum::<f64>()).max(0.0)
        };
        let terms = self
            .final_weights
            .iter()
            .enumerate()
            .map(|(i, &w)| excess(i, w).powi(2) / (w + 1e-7));
        terms.sum::<f64>() / self.final_weights.len() as f64
    }

    /// Its gradient by the proposal's weights.
    pub fn interlevel_by_weights(&self, weights: &[f64]) -> Vec<f64> {
        let mut d_weights = vec![0.0; weights.len()];
        for (i, &w) in self.final_weights.iter().enumerate() {
            let (lo, hi) = self.touched(i);
            let excess = w - weights[lo..=hi].iter().sum::<f64>();
            if excess > 0.0 {
                let d_outer = -2.0 * excess / (w + 1e-7) / self.final_weights.len() as f64;
                d_weights[lo..=hi].iter_mut().for_each(|d| *d += d_outer);
            }
        }
        d_weights
    }

    /// Its gradient by the network's output, with the truncated exponential's bounded slope.
    pub fn interlevel_by_raw(&self) -> Vec<f64> {
        let tau = self.tau();
        let (weights, _) = quadrature(&tau);
        let d_tau = quadrature_backward(&tau, &self.interlevel_by_weights(&weights), 0.0);
        let lengths = lengths(&self.edges, self.near_far);
        (0..tau.len())
            .map(|i| d_tau[i] * lengths[i] * self.raw[i].clamp(-15.0, 15.0).exp())
            .collect()
    }
}

/// First index of the largest weight.
pub fn heaviest(weights: &[f64]) -> usize {
    (0..weights.len()).rev().fold(weights.len() - 1, |best, i| {
        if weights[i] >= weights[best] { i } else { best }
    })
}

/// Bias correction: the loss of every ray (its mean over rays is the loss) and its gradient by the first query's signed distance.
pub fn bias_correction(
    near: &[f64],
    behind: &[f64],
    gate: &[f64],
    eps: f64,
    published: bool,
) -> (Vec<f64>, Vec<f64>) {
    let mean = gate.iter().sum::<f64>() / gate.len() as f64;
    let factor = |r: usize| if published { mean } else { gate[r] };
    let hinge = |r: usize| {
        if behind[r] > 0.0 {
            (near[r] + eps).max(0.0)
        } else {
            0.0
        }
    };
    let slope = |r: usize| if hinge(r) > 0.0 { 1.0 } else { 0.0 };
    let rays = 0..gate.len();
    (
        rays.clone().map(|r| factor(r) * hinge(r)).collect(),
        rays.map(|r| factor(r) * slope(r)).collect(),
    )
}
