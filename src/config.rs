//! Every hyper-parameter of a training run.
//!
//! Values, units and reasons stand in `config/presets/outdoor-large.toml`, which is NeuRodin's stage 1 for large outdoor scenes and the
//! default; the other presets are lists of differences from it. A `Config` is never written to after construction: what changes with
//! time is computed by [`crate::train::schedule`] from the step.

use crate::gpu::Matrices;
use serde::{Deserialize, Serialize};

mod difference;
mod resolve;
mod validate;

pub use difference::{Difference, Effect};
pub(crate) use resolve::nearest;
pub use resolve::{HUGE, METHODS, Method, PRESETS, Preset};

/// All settings of a training run.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Config {
    /// Name of the preset that this started from.
    pub preset: String,
    /// Name of the method that the preset was combined with.
    pub method: String,
    /// Seed of every random number: initial parameters, pixels, jitter, taps.
    pub seed: u32,
    /// The same run comes out in the same bits, on one device: gradients add up in fixed point, and no clock decides what is computed.
    pub deterministic: bool,
    /// How wide layers and networks are multiplied.
    pub matrices: Matrices,
    /// Length of the stage. The schedules below are written for `schedule_steps` and stretched to this.
    pub steps: u64,
    /// Steps of the stage before it: the number that its own first step has.
    pub first_step: u64,
    /// The number of steps that every schedule's own numbers refer to.
    pub schedule_steps: u64,
    /// Rays per training step.
    pub rays: u32,
    pub scene: SceneConfig,
    pub hash: HashConfig,
    pub surface: SurfaceConfig,
    pub color: ColorConfig,
    pub appearance: AppearanceConfig,
    pub sampling: SamplingConfig,
    pub background: BackgroundConfig,
    pub loss: LossConfig,
    pub optimizer: OptimizerConfig,
    pub stage2: Stage2Config,
    pub report: ReportConfig,
}

/// What the second stage does differently, as in NeuRodin's released code: beside what stands here, an analytic gradient, a density along
/// the line of sight and no bias correction.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Stage2Config {
    /// Length of the stage; 0: there is none.
    pub steps: u64,
    pub rays: u32,
    /// Over these the learning rates of networks and hash table rise from 0.
    pub warmup: u64,
    pub eikonal: f64,
    /// Weight of the tangent-normal loss.
    pub tangent: f64,
    pub scale_bound: ScaleBound,
}

impl Config {
    /// The configuration of the second stage, or `None` where there is none. It begins with the first's parameters; optimiser and
    /// schedules begin anew.
    pub fn second_stage(&self) -> Option<Config> {
        let stage2 = &self.stage2;
        if stage2.steps == 0 {
            return None;
        }
        let mut config = self.clone();
        config.first_step = self.first_step + self.steps;
        config.steps = stage2.steps;
        config.rays = stage2.rays;
        config.optimizer.fields.warmup = stage2.warmup;
        config.optimizer.table.warmup = stage2.warmup;
        config.surface.gradient = GradientKind::Analytic;
        config.surface.density = DensityKind::Sight;
        config.loss.eikonal = stage2.eikonal;
        config.loss.bias.weight = 0.0;
        config.loss.bias.weight_start = 0.0;
        config.loss.curvature.weight = 0.0;
        config.loss.tangent = stage2.tangent;
        config.loss.scale_bound = stage2.scale_bound.clone();
        config.stage2.steps = 0;
        Some(config)
    }

    /// The same with so many steps in all stages together, which keep their shares of them.
    pub fn with_total_steps(self, total: u64) -> Config {
        let mut config = self;
        let stages = config.steps + config.stage2.steps;
        let here = total.saturating_sub(config.first_step);
        let share = u128::from(here) * u128::from(config.stage2.steps) / u128::from(stages.max(1));
        config.stage2.steps = share as u64;
        config.steps = here - config.stage2.steps;
        config
    }

    /// Steps of this stage and all others.
    pub fn total_steps(&self) -> u64 {
        self.first_step + self.steps + self.stage2.steps
    }
}

/// How the dataset is read, and the region that the surface may occupy.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SceneConfig {
    /// Sphere (objects, outdoors) or axis-parallel box (rooms).
    pub shape: RegionKind,
    /// The region is enlarged by this factor, unless its size was typed.
    pub region_scale: f64,
    /// Every n-th view is held out where the dataset has no split of its own; 0 keeps all.
    pub holdout: u32,
    /// Width and height of the images are divided by this (2 halves them).
    pub downscale: f64,
    /// What a mask or alpha channel means.
    pub masks: MaskUse,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum RegionKind {
    Sphere,
    Box,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum MaskUse {
    /// Masks are not looked at (every NeuRodin recipe).
    Ignore,
    /// Masked-out pixels carry no loss.
    Exclude,
    /// They are silhouettes of the object: colour is compared within them, and `loss.mask` wants nothing outside.
    Foreground,
}

impl MaskUse {
    /// Whether masks are read at all; pixels that they leave out have no colour to compare then.
    pub fn reads(self) -> bool {
        self != MaskUse::Ignore
    }
}

/// The SDF's multi-resolution hash grid.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct HashConfig {
    pub levels: u32,
    /// Coarsest and finest resolution per axis of the region's cube [-1, 1]³.
    pub base: u32,
    pub max: u32,
    /// Entries of a hashed level: 2^log2_size.
    pub log2_size: u32,
    /// Features per level: 1, 2, 4 or 8.
    pub features: u32,
    /// Look-ups read a copy of the table in float16, into which updates are rounded.
    pub half: bool,
    pub release: ReleaseConfig,
}

/// Coarse to fine: levels whose features are still hidden from the network (Li et al. 2023, Neuralangelo).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ReleaseConfig {
    /// Levels seen from the beginning; 0: all.
    pub first: u32,
    /// One level more every `every` schedule steps after `start`.
    pub start: u64,
    pub every: u64,
}

/// The SDF network: one hidden softplus layer, heads for SDF, scale logit and geometry features.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SurfaceConfig {
    pub hidden: u32,
    /// Geometry features handed to the colour network.
    pub features: u32,
    /// Mirrors the geometric initialisation: free space inside the initial sphere (indoor scenes).
    pub inside_out: bool,
    /// Deviation of the hidden layer's first weights on hash features, as a share of those on the position.
    pub init_hash: f64,
    /// Deviation of the features' first weights from those of the signed distance, as a share of these.
    pub init_features: f64,
    /// Radius-like bias of the geometric initialisation.
    pub init_bias: f64,
    /// What hides what lies behind.
    pub density: DensityKind,
    /// Schedule steps over which NeuS's cosine hardens; 0: it is hard.
    pub cosine_steps: u64,
    /// Whose the scale is.
    pub scale: ScaleKind,
    /// Range of the local scale β = scale_max·sigmoid(v) + scale_floor.
    pub scale_max: f64,
    /// Floor of β.
    pub scale_floor: f64,
    /// First value of a global scale.
    pub scale_init: f64,
    /// Rate of the exponential scale 1/β = e^(scale_rate v).
    pub scale_rate: f64,
    /// How the SDF's gradient is had.
    pub gradient: GradientKind,
    /// Points around a sample: 6 or 4.
    pub taps: u32,
    /// How far away they lie.
    pub tap_step: TapStepKind,
    /// Random taps lie U(0, tap_range) away, floored at a quarter of the finest cell of [0, 1]³.
    pub tap_range: f64,
    /// What the range has become by the end of the schedule, by equal factors in equal times; 0 where it stays what it is.
    pub tap_range_end: f64,
}

impl SurfaceConfig {
    /// Radius of the sphere that the geometric initialisation makes the surface, about, in region units: with it the network is
    /// 0.85 ‖x‖ + 0.12 − init_bias (measured on the networks of NeuRodin's released code, at init_bias 0.5).
    pub fn initial_radius(&self) -> f64 {
        ((self.init_bias - 0.12) / 0.85).max(0.0)
    }
}

/// How the gradient of the signed distance is had (Wang et al. 2024, NeuRodin: another way in each stage).
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum GradientKind {
    /// Finite differences (stage 1).
    Taps,
    /// The chain rule (stage 2).
    Analytic,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum TapStepKind {
    /// One draw per sample (NeuRodin).
    Random,
    /// A quarter of the cell of the finest level that is released (Neuralangelo).
    Level,
}

/// What the optical depth of a bin is a function of; stages are NeuRodin's, as released.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum DensityKind {
    /// Laplace density of the signed distance (VolSDF; stage 1).
    Laplace,
    /// Laplace density of the signed distance along the line of sight (TUVR; stage 2).
    Sight,
    /// NeuS's opacity.
    Neus,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum ScaleKind {
    /// Every point has its own (NeuRodin).
    Local,
    /// One β = |v| + scale_floor (VolSDF).
    Beta,
    /// One 1/β = e^(scale_rate v) (NeuS).
    Exponential,
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ColorConfig {
    pub hidden: u32,
    /// Hidden layers.
    pub layers: u32,
    /// Of the first weights, which are U(±1/√inputs) times this.
    pub init_gain: f64,
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct AppearanceConfig {
    /// Length of the per-image code; 0 switches it off.
    pub dims: u32,
    /// The code used when rendering: zero (published), mean of all, or that of the frame.
    pub at_eval: AppearanceAtEval,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum AppearanceAtEval {
    Zero,
    Mean,
    Frame,
}

/// Proposal networks and sample counts.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SamplingConfig {
    /// Samples of the two proposal levels.
    pub proposal_samples: [u32; 2],
    /// Shading samples.
    pub samples: u32,
    pub proposal_levels: u32,
    pub proposal_base: u32,
    pub proposal_max: [u32; 2],
    pub proposal_log2_size: u32,
    pub proposal_features: u32,
    pub proposal_hidden: u32,
    /// Schedule steps over which the proposal weights' exponent rises to 1.
    pub anneal_steps: u64,
}

/// What a ray sees behind the region.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BackgroundConfig {
    pub kind: BackgroundKind,
    /// Samples per ray between the region's border and `far`.
    pub samples: u32,
    pub far: f64,
    pub levels: u32,
    pub base: u32,
    pub max: u32,
    pub log2_size: u32,
    pub features: u32,
    pub hidden: u32,
    /// Geometry features handed to the background's colour network.
    pub geometry: u32,
    /// Query in contracted coordinates; false restores the published wrap-around.
    pub contraction: bool,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum BackgroundKind {
    /// Nothing: black (closed rooms).
    None,
    /// One learned colour (an even sky).
    Constant,
    /// A learned radiance field (anything else outdoors).
    Field,
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LossConfig {
    /// Weight of the squared colour error beside the absolute one, whose weight is 1.
    pub color_squared: f64,
    pub eikonal: f64,
    pub interlevel: f64,
    /// Tangent-normal consistency (Rosu and Behnke 2023, PermutoSDF); needs the analytic gradient.
    pub tangent: f64,
    /// Accumulated weight against the object's mask; with `scene.masks = "foreground"`.
    pub mask: f64,
    /// Rendered depth against that of a sensor.
    pub sensor_depth: f64,
    /// Against monocular estimates, whose scale and shift are unknown; every batch is of one view then.
    pub mono_depth: f64,
    /// Rendered normals against monocular ones.
    pub mono_normal: f64,
    pub curvature: CurvatureConfig,
    pub bias: BiasConfig,
    /// Lower bound of 1/β from `start` to `end` over `steps` schedule steps.
    pub scale_bound: ScaleBound,
}

impl LossConfig {
    /// Whether anything but colour is wanted of a ray.
    pub fn is_supervised(&self) -> bool {
        [
            self.mask,
            self.sensor_depth,
            self.mono_depth,
            self.mono_normal,
        ]
        .iter()
        .any(|&weight| weight > 0.0)
    }
}

/// Mean |trace of the SDF's Hessian|, from taps (Li et al. 2023, Neuralangelo).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CurvatureConfig {
    /// Rises from 0 to this over `warmup` schedule steps, then falls by the grid's growth with every level released.
    pub weight: f64,
    pub warmup: u64,
}

/// Explicit bias correction (Wang et al. 2024, NeuRodin).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BiasConfig {
    pub weight: f64,
    /// Ramp from `weight_start` to `weight` over `ramp_steps` (0: constant).
    pub weight_start: f64,
    pub ramp_steps: u64,
    pub epsilon: f64,
    /// Offset c of the point that must still be in free space.
    pub offset: f64,
    pub reduction: BiasReduction,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum BiasReduction {
    PerRay,
    Published,
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ScaleBound {
    pub rise: Rise,
    pub start: f64,
    pub end: f64,
    pub steps: u64,
    /// From `end` to here, exponentially, over `last_steps` more (0: none).
    pub last: f64,
    pub last_steps: u64,
}

/// How a bound rises over x from 0 to 1.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Rise {
    /// log₂(1 + x), fast first (schedule A, stage 1).
    Logarithmic,
    /// (e^{4x} − 1)/(e⁴ − 1), fast last (schedule B, stage 2).
    Exponential,
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct OptimizerConfig {
    pub fields: MultiStep,
    pub table: MultiStep,
    pub proposal: MultiStep,
    pub background: Exponential,
    pub beta1: f64,
    pub beta2: f64,
    pub epsilon: f64,
}

/// A constant rate with a linear warm-up from 0, then a factor `gamma` at each milestone (schedule steps).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MultiStep {
    pub learning_rate: f64,
    pub weight_decay: f64,
    pub warmup: u64,
    pub milestones: Vec<u64>,
    pub gamma: f64,
    /// On which side of a milestone its factor begins.
    pub drop: Drop,
}

/// The two conventions that the published schedules mix.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Drop {
    /// The step at the milestone has the new rate (proposal networks).
    At,
    /// The step at the milestone still has the old one (fields and table).
    After,
}

/// Exponential decay from `learning_rate` to `learning_rate_end` over the schedule.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Exponential {
    pub learning_rate: f64,
    pub learning_rate_end: f64,
    pub weight_decay: f64,
}

/// How often a run tells and saves; nothing here changes what is learned. In steps of the run, not of the schedule.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ReportConfig {
    /// Between two lines of the log.
    pub log_steps: u64,
    /// Between two previews of a held-out view; 0 for none.
    pub preview_steps: u64,
    /// A preview is reduced to at most this many pixels.
    pub preview_pixels: u64,
    /// Between two checkpoints; 0 for one at the end (and on interruption) only.
    pub checkpoint_steps: u64,
    /// One more when this many minutes have passed since the last; 0 for none.
    pub checkpoint_minutes: f64,
    /// Complete checkpoints that stay in the run directory.
    pub keep: u32,
}
