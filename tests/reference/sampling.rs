//! Where a ray is sampled: its stretch inside the region, the edges of the first sampler, and resampling by proposal weights.
//!
//! Positions on a ray are kept normalised, s in [0, 1]; with the warp S(t) = t/2 (t < 1), 1 − 1/(2t) (t ≥ 1), the distance is
//! t = S⁻¹(s·S(far) + (1 − s)·S(near)). No gradient flows through any of this.

/// The region that a surface may occupy, in the region frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Region {
    /// The unit ball.
    Sphere,
    /// |x_j| ≤ half_j
    Box { half: [f64; 3] },
}

/// The stretch of a ray that is sampled.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Stretch {
    pub near: f64,
    pub far: f64,
    /// The ray does not meet the region: it sees only the background.
    pub outside: bool,
}

/// Stretch of a ray that misses: finite, so that everything stays a number.
const MISSED: Stretch = Stretch {
    near: 1.0,
    far: 1.2,
    outside: true,
};

pub fn collide(region: Region, origin: [f64; 3], direction: [f64; 3]) -> Stretch {
    match region {
        Region::Sphere => collide_sphere(origin, direction),
        Region::Box { half } => collide_box(half, origin, direction),
    }
}

/// b = o·d, q = b² − (‖o‖² − 1): near = max(0, −b − √q), far = max(0, −b + √q). A sphere that lies behind is missed too (the published
/// collider leaves a stretch of length 0 there).
pub fn collide_sphere(origin: [f64; 3], direction: [f64; 3]) -> Stretch {
    let b = dot(origin, direction);
    let q = b * b - (dot(origin, origin) - 1.0);
    if q < 0.0 {
        return MISSED;
    }
    stretch((-b - q.sqrt()).max(0.0), (-b + q.sqrt()).max(0.0))
}

/// Slab test (Kay & Kajiya 1986); near ≥ 0. The published collider divides by d + 1e-6 instead of guarding against d = 0.
pub fn collide_box(half: [f64; 3], origin: [f64; 3], direction: [f64; 3]) -> Stretch {
    let (mut near, mut far) = (0.0_f64, f64::INFINITY);
    for axis in 0..3 {
        let d = if direction[axis].abs() < 1e-9 {
            1e-9
        } else {
            direction[axis]
        };
        let (a, b) = (
            (-half[axis] - origin[axis]) / d,
            (half[axis] - origin[axis]) / d,
        );
        near = near.max(a.min(b));
        far = far.min(a.max(b));
    }
    stretch(near, far)
}

/// A stretch shorter than this is none.
const SHORTEST: f64 = 1e-6;

fn stretch(near: f64, far: f64) -> Stretch {
    if far - near > SHORTEST {
        Stretch {
            near,
            far,
            outside: false,
        }
    } else {
        MISSED
    }
}

pub fn warp(t: f64) -> f64 {
    if t < 1.0 {
        t / 2.0
    } else {
        1.0 - 1.0 / (2.0 * t)
    }
}

pub fn unwarp(s: f64) -> f64 {
    if s < 0.5 {
        2.0 * s
    } else {
        1.0 / (2.0 - 2.0 * s)
    }
}

/// Distance along the ray of the normalised position s.
pub fn distance(s: f64, stretch: Stretch) -> f64 {
    unwarp(s * warp(stretch.far) + (1.0 - s) * warp(stretch.near))
}

pub fn distances(edges: &[f64], stretch: Stretch) -> Vec<f64> {
    edges.iter().map(|&s| distance(s, stretch)).collect()
}

/// `bins + 1` edges of equal bins; each moves between the bin centres beside it by its draw, `draw(edge)` in [0, 1).
pub fn place(bins: usize, draw: Option<&dyn Fn(usize) -> f64>) -> Vec<f64> {
    let s: Vec<f64> = (0..=bins).map(|j| j as f64 / bins as f64).collect();
    let Some(draw) = draw else { return s };
    (0..=bins)
        .map(|j| {
            let lower = if j == 0 {
                s[0]
            } else {
                (s[j - 1] + s[j]) / 2.0
            };
            let upper = if j == bins {
                s[bins]
            } else {
                (s[j] + s[j + 1]) / 2.0
            };
            lower + (upper - lower) * draw(j)
        })
        .collect()
}

/// `bins + 1` new edges, distributed like the histogram of `weights` to the power `anneal` between `edges`; `draw` shifts all of them.
pub fn resample(
    edges: &[f64],
    weights: &[f64],
    anneal: f64,
    bins: usize,
    draw: Option<f64>,
) -> Vec<f64> {
    let mut histogram: Vec<f64> = weights.iter().map(|w| w.powf(anneal) + 0.01).collect();
    let padding = (1e-5 - histogram.iter().sum::<f64>()).max(0.0) / histogram.len() as f64;
    histogram.iter_mut().for_each(|w| *w += padding);
    let total: f64 = histogram.iter().sum();
    let mut cdf = vec![0.0];
    let mut sum = 0.0;
    for w in &histogram {
        sum += w / total;
        cdf.push(sum.min(1.0));
    }
    let count = (bins + 1) as f64;
    (0..=bins)
        .map(|j| {
            let u = (j as f64 + draw.unwrap_or(0.5)) / count;
            let above = cdf.partition_point(|&c| c <= u);
            let (below, above) = (
                above.saturating_sub(1).min(cdf.len() - 1),
                above.min(cdf.len() - 1),
            );
            let step = cdf[above] - cdf[below];
            let part = if step == 0.0 {
                0.0
            } else {
                ((u - cdf[below]) / step).clamp(0.0, 1.0)
            };
            edges[below] + part * (edges[above] - edges[below])
        })
        .collect()
}

pub fn midpoints(distances: &[f64]) -> Vec<f64> {
    distances
        .windows(2)
        .map(|edge| (edge[0] + edge[1]) / 2.0)
        .collect()
}

pub fn lengths(distances: &[f64]) -> Vec<f64> {
    distances.windows(2).map(|edge| edge[1] - edge[0]).collect()
}

pub fn point_on_ray(origin: [f64; 3], direction: [f64; 3], t: f64) -> [f64; 3] {
    std::array::from_fn(|axis| origin[axis] + t * direction[axis])
}

pub fn dot(a: [f64; 3], b: [f64; 3]) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}
