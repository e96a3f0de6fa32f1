//! What a training step takes and what it gives back: configuration, parameters, rays, draws; losses, images, gradients.

use super::background::Background;
use super::hash_grid::Grid;
use super::losses::BiasReduction;
use super::sampling::{Region, Stretch};
use super::supervision::Supervision;
use super::tape::ReluEdge;
use std::collections::BTreeMap;

/// What tells stages and methods apart: where g, the signed distance's gradient, comes from, what hides what lies behind, and the losses
/// of their own.
#[derive(Clone, Debug, PartialEq)]
pub struct Stage {
    /// Points around a sample from which g is had, 6 or 4; 0: analytic.
    pub taps: usize,
    pub density: Density,
    pub bias: bool,
    pub tangent: Option<Tangent>,
}

impl Stage {
    /// Stage 1: stochastic six taps; the density is that of f; the bias loss.
    pub fn first() -> Stage {
        Stage {
            taps: 6,
            density: Density::Laplace,
            bias: true,
            tangent: None,
        }
    }

    /// Stage 2: analytic; the density is that of f/|g·d|; the tangent loss in place of the bias loss.
    pub fn second(tangent: Tangent) -> Stage {
        Stage {
            taps: 0,
            density: Density::Sight,
            bias: false,
            tangent: Some(tangent),
        }
    }
}

#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Density {
    /// Laplace density of f (VolSDF).
    Laplace,
    /// Laplace density of f/|g·d| (TUVR).
    Sight,
    /// NeuS's opacity, f in the middle of the bin.
    Neus,
}

/// Whose the scale is.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Scale {
    /// β = scale_range · sigmoid(v) + scale_floor, v a head of the network.
    Local,
    /// β = |v| + scale_floor, one v.
    Beta,
    /// 1/β = e^(rate v), one v.
    Exponential { rate: f64 },
}

/// The tangent loss: how far a normal turns within a small shift in the tangent plane.
#[derive(Clone, Debug, PartialEq)]
pub struct Tangent {
    pub weight: f64,
    /// Length of the longest shift.
    pub step: f64,
    /// Gaussian draws, one per shading sample, `[N · S]`; normalised they are uniform on the sphere.
    pub draws: Vec<[f64; 3]>,
}

/// The shape of everything, and the numbers that do not change with time.
#[derive(Clone, Debug, PartialEq)]
pub struct StepConfig {
    pub region: Region,
    /// False: no jitter, and appearance codes of zeros.
    pub train: bool,
    /// The two proposal networks' grids, hidden width and bins.
    pub proposal_grids: [Grid; 2],
    pub proposal_hidden: usize,
    pub proposal_samples: [usize; 2],
    /// Shading samples per ray.
    pub samples: usize,
    pub grid: Grid,
    /// Width of the surface network's hidden layer.
    pub hidden: usize,
    /// Geometry features handed to the colour network.
    pub features: usize,
    pub scale: Scale,
    pub scale_range: f64,
    pub scale_floor: f64,
    /// δ = max(tap_range · u, tap_floor)
    pub tap_range: f64,
    pub tap_floor: f64,
    pub color_hidden: usize,
    /// Hidden layers of the colour network.
    pub color_layers: usize,
    pub views: usize,
    /// Length of a view's appearance code; 0: none.
    pub appearance: usize,
    pub background: Background,
    pub color_squared: f64,
    pub eikonal_weight: f64,
    pub interlevel_weight: f64,
    pub bias_epsilon: f64,
    pub bias_offset: f64,
    pub bias_reduction: BiasReduction,
    /// Only rays with Σ w > 0.999 pass the bias loss's gate (outdoors).
    pub bias_needs_opaque: bool,
}

/// A batch of N rays in the region frame.
#[derive(Clone, Debug, Default)]
pub struct Rays {
    pub origins: Vec<[f64; 3]>,
    /// Unit vectors.
    pub directions: Vec<[f64; 3]>,
    /// r, g, b and the weight of the ray's colour loss.
    pub target: Vec<[f64; 4]>,
    /// Index of the ray's view.
    pub view: Vec<usize>,
    /// Near, far and outside, where they are not to be computed from the region.
    pub stretches: Option<Vec<Stretch>>,
    /// What is wanted of them besides colour.
    pub supervision: Supervision,
}

/// The step's random numbers, raw draws in [0, 1).
#[derive(Clone, Debug, Default)]
pub struct Draws {
    /// First sampler, first and second resampling: one draw per ray each.
    pub jitter: [Vec<f64>; 3],
    /// One per shading sample, `[N · S]`; stage 2 takes none.
    pub taps: Vec<f64>,
    /// One per edge of the background field, `[N · (samples + 1)]`; empty: edges stay where they are.
    pub background: Vec<f64>,
}

/// What changes with time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Now {
    /// Exponent of the proposal weights.
    pub anneal: f64,
    /// Lower bound of 1/β.
    pub inv_s_lower: f64,
    pub bias_weight: f64,
    pub curvature_weight: f64,
    /// Levels of the surface's grid that the network sees.
    pub released_levels: usize,
    /// NeuS's c̃ = −(relu(½ − ½c)(1 − a) + relu(−c) a).
    pub cosine_anneal: f64,
    /// Factor of the sum over rays in the colour loss: 1/N, or 1/Σ of the rays' weights.
    pub inv_count: f64,
}

#[derive(Clone, Debug)]
pub struct Step {
    pub config: StepConfig,
    /// By span name; [`StepConfig::spans`] lists names and shapes.
    pub params: BTreeMap<String, Vec<f64>>,
    pub rays: Rays,
    pub draws: Draws,
    pub now: Now,
    /// Normalised edges `[N, bins + 1]` of both proposal levels and the final one, to be taken as they are.
    pub edges: Option<[Vec<f64>; 3]>,
    /// The surface's points, those of the samples and their taps, `[7 · N · S]`, or with a tangent loss of the samples and its own, `[2 · N · S]`, likewise: rounded to float32, a point moves by a ten-thousandth of a fine cell.
    pub points: Option<Vec<[f64; 3]>>,
    pub stage: Stage,
    pub relu_edge: ReluEdge,
}

/// Everything that the forward pass makes, sample-major with the component innermost.
#[derive(Clone, Debug, Default)]
pub struct Images {
    /// `[N]`
    pub stretches: Vec<Stretch>,
    /// Normalised edges per level, `[N, bins + 1]`, and the same as distances.
    pub edges: [Vec<f64>; 3],
    pub distances: [Vec<f64>; 3],
    /// Log densities `[N, bins]` and weights `[N, bins]` of the proposal levels.
    pub proposal_raw: [Vec<f64>; 2],
    pub proposal_weights: [Vec<f64>; 2],
    /// Bin starts, then the six tap blocks, `[7 · N · S]`; in stage 2 bin starts, then the tangent loss's points, `[2 · N · S]`.
    pub points: Vec<[f64; 3]>,
    /// Network outputs at bin starts and taps, before anything is overwritten for rays outside.
    pub sdf: Vec<f64>,
    /// `[N · S]`
    pub logit: Vec<f64>,
    pub inv_s: Vec<f64>,
    /// σ, `[N, S]`; rays outside have f = +1000 here where there is a background.
    pub density: Vec<f64>,
    /// `[N, S, 3]`
    pub gradient: Vec<f64>,
    /// `[N, S, K]`
    pub features: Vec<f64>,
    /// `[N, S, 3]` before padding.
    pub rgb: Vec<f64>,
    /// `[N, S]`
    pub weights: Vec<f64>,
    /// Behind the last sample, `[N]`.
    pub transmittance: Vec<f64>,
    pub accumulation: Vec<f64>,
    pub depth: Vec<f64>,
    /// Σ w n, `[N, 3]`
    pub normal: Vec<f64>,
    /// `[N, 3]`
    pub background: Vec<f64>,
    pub color: Vec<f64>,
    /// Colour loss per ray before `inv_count`, `[N]`.
    pub color_error: Vec<f64>,
    /// The bias loss's gates `[N]`, points `[2N]` and the network's values there `[2N]`.
    pub bias_gate: Vec<f64>,
    pub bias_points: Vec<[f64; 3]>,
    pub bias_sdf: Vec<f64>,
    /// g at the tangent loss's points, `[N, S, 3]`.
    pub tangent_gradient: Vec<f64>,
}

/// ∂total/∂(some of [`Images`]), shaped like them.
#[derive(Clone, Debug, Default)]
pub struct ActivationGradients {
    pub proposal_raw: [Vec<f64>; 2],
    /// All seven blocks; in stage 2 bin starts alone.
    pub sdf: Vec<f64>,
    pub logit: Vec<f64>,
    /// In stage 2 with what comes through the tangent loss's points.
    pub gradient: Vec<f64>,
    pub features: Vec<f64>,
    pub rgb: Vec<f64>,
    pub background: Vec<f64>,
    pub bias_sdf: Vec<f64>,
    /// By the coordinates of the tangent loss's points, and by g there, `[N, S, 3]`.
    pub tangent_points: Vec<f64>,
    pub tangent_gradient: Vec<f64>,
}

#[derive(Clone, Debug)]
pub struct Outcome {
    /// "color", "eikonal", "interlevel", and of "bias", "tangent", "curvature", "mask", "sensor_depth", "mono_depth", "mono_normal" those
    /// that there are, each with its weight, and their sum "total".
    pub losses: BTreeMap<String, f64>,
    pub images: Images,
    pub d_images: ActivationGradients,
    /// ∂total/∂parameter, by span name.
    pub gradients: BTreeMap<String, Vec<f64>>,
}

impl StepConfig {
    /// Name, rows and columns of every parameter span.
    pub fn spans(&self) -> Vec<(String, usize, usize)> {
        let mut spans = Vec::new();
        let mut plain = |name: String, rows: usize, cols: usize| spans.push((name, rows, cols));
        let mut normed = |name: String, rows: usize, cols: usize| {
            plain(format!("{name}.v"), rows, cols);
            plain(format!("{name}.g"), rows, 1);
            plain(format!("{name}.bias"), 1, rows);
        };
        normed("surface.hidden".into(), self.hidden, 3 + self.grid.width());
        normed("surface.heads".into(), 2 + self.features, self.hidden);
        let mut inputs = 3 + 27 + 3 + self.features + self.appearance;
        for layer in 0..=self.color_layers {
            let outputs = if layer < self.color_layers {
                self.color_hidden
            } else {
                3
            };
            normed(format!("color.{layer}"), outputs, inputs);
            inputs = outputs;
        }
        if self.scale != Scale::Local {
            plain("surface.scale".into(), 1, 1);
        }
        plain(
            "surface.table".into(),
            self.grid.entries(),
            self.grid.features,
        );
        if self.appearance > 0 {
            plain("appearance".into(), self.views, self.appearance);
        }
        for (level, grid) in self.proposal_grids.iter().enumerate() {
            plain(
                format!("proposal.{level}.table"),
                grid.entries(),
                grid.features,
            );
            plain(
                format!("proposal.{level}.hidden"),
                self.proposal_hidden,
                grid.width(),
            );
            plain(format!("proposal.{level}.out"), 1, self.proposal_hidden);
        }
        match &self.background {
            Background::Black | Background::Fixed(_) => {}
            Background::Learned => plain("background.constant".into(), 1, 3),
            Background::Field(field) => {
                plain(
                    "background.table".into(),
                    field.grid.entries(),
                    field.grid.features,
                );
                plain("background.hidden".into(), field.hidden, field.grid.width());
                plain("background.heads".into(), 1 + field.geometry, field.hidden);
                plain(
                    "background.color.0".into(),
                    field.hidden,
                    16 + field.geometry + field.appearance,
                );
                plain("background.color.1".into(), field.hidden, field.hidden);
                plain("background.color.2".into(), 3, field.hidden);
                if field.appearance > 0 {
                    plain("background.appearance".into(), self.views, field.appearance);
                }
            }
        }
        spans
    }
}
