//! Small steps to test with: a configuration, parameters near the geometric initialisation, and rays, all drawn from a seed.

use super::background::{Background, FieldConfig};
use super::batch::{Draws, Now, Rays, Scale, Stage, Step, StepConfig, Tangent};
use super::hash_grid::Grid;
use super::losses::BiasReduction;
use super::sampling::{Region, dot};
use super::supervision::{Known, Supervision};
use super::tape::ReluEdge;
use std::collections::BTreeMap;
use std::f64::consts::{PI, TAU};

/// SplitMix64 (Steele et al. 2014).
pub struct Random(pub u64);

impl Random {
    /// In [0, 1).
    pub fn uniform(&mut self) -> f64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((z ^ (z >> 31)) >> 11) as f64 / (1_u64 << 53) as f64
    }

    /// In [−half, half).
    pub fn symmetric(&mut self, half: f64) -> f64 {
        (2.0 * self.uniform() - 1.0) * half
    }

    pub fn normal(&mut self) -> f64 {
        let radius = (-2.0 * (1.0 - self.uniform()).ln()).sqrt();
        radius * (TAU * self.uniform()).cos()
    }

    pub fn direction(&mut self) -> [f64; 3] {
        normalized(std::array::from_fn(|_| self.normal()))
    }
}

fn normalized(v: [f64; 3]) -> [f64; 3] {
    let length = v.iter().map(|x| x * x).sum::<f64>().sqrt();
    v.map(|x| x / length)
}

/// An outdoor configuration of a few thousand parameters.
pub fn config() -> StepConfig {
    StepConfig {
        region: Region::Sphere,
        train: true,
        proposal_grids: [
            Grid::published(3, 4, 16, 9, 2),
            Grid::published(3, 4, 32, 9, 2),
        ],
        proposal_hidden: 16,
        proposal_samples: [24, 16],
        samples: 12,
        grid: Grid::published(4, 4, 32, 10, 2),
        hidden: 16,
        features: 7,
        scale: Scale::Local,
        scale_range: 0.1,
        scale_floor: 2e-4,
        tap_range: 0.1,
        tap_floor: 1.0 / (4.0 * 32.0),
        color_hidden: 16,
        color_layers: 2,
        views: 3,
        appearance: 4,
        background: Background::Learned,
        color_squared: 3.0,
        eikonal_weight: 0.01,
        interlevel_weight: 1.0,
        bias_epsilon: 5e-4,
        bias_offset: 0.001,
        bias_reduction: BiasReduction::PerRay,
        bias_needs_opaque: true,
    }
}

pub fn background_field() -> FieldConfig {
    FieldConfig {
        grid: Grid::published(4, 4, 32, 9, 2),
        samples: 8,
        far: 1000.0,
        hidden: 16,
        geometry: 15,
        appearance: 3,
        contraction: true,
    }
}

/// Values for every span of a configuration. The surface is about a sphere of radius ½, roughened, with free space outside it, or
/// inside where `inside_out`.
pub fn parameters(
    config: &StepConfig,
    inside_out: bool,
    random: &mut Random,
) -> BTreeMap<String, Vec<f64>> {
    // Free space is where f > 0: outside the sphere, or inside it.
    let side = if inside_out { -1.0 } else { 1.0 };
    let mut params = BTreeMap::new();
    for (name, rows, cols) in config.spans() {
        let values = match name.as_str() {
            "surface.hidden.v" => {
                let deviation = 2.0_f64.sqrt() / (config.hidden as f64).sqrt();
                let value = |column: usize, random: &mut Random| {
                    if column < 3 {
                        random.normal() * deviation
                    } else {
                        random.symmetric(0.1)
                    }
                };
                (0..rows * cols).map(|i| value(i % cols, random)).collect()
            }
            "surface.heads.v" => {
                let mean = side * PI.sqrt() / (config.hidden as f64).sqrt();
                (0..rows * cols)
                    .map(|_| mean * (1.0 + random.symmetric(0.1)))
                    .collect()
            }
            "surface.hidden.bias" => (0..cols).map(|_| random.symmetric(0.02)).collect(),
            "surface.heads.bias" => (0..cols)
                .map(|_| -0.5 * side + random.symmetric(0.02))
                .collect(),
            // 1/β of about 30.
            "surface.scale" => match config.scale {
                Scale::Exponential { rate } => vec![3.4 / rate],
                _ => vec![0.03],
            },
            _ if name.ends_with("table") => {
                (0..rows * cols).map(|_| random.symmetric(0.3)).collect()
            }
            _ if name.ends_with(".g") => vec![0.0; rows],
            _ if name.ends_with(".bias") => (0..cols).map(|_| random.symmetric(0.1)).collect(),
            "appearance" | "background.appearance" => {
                (0..rows * cols).map(|_| random.normal()).collect()
            }
            _ => (0..rows * cols)
                .map(|_| random.symmetric((3.0 / cols as f64).sqrt()))
                .collect(),
        };
        params.insert(name, values);
    }
    // g starts near ‖V‖, so that it is a parameter of its own.
    let lengths: Vec<String> = params
        .keys()
        .filter(|name| name.ends_with(".g"))
        .cloned()
        .collect();
    for name in lengths {
        let v: &Vec<f64> = &params[&name.replace(".g", ".v")];
        let rows = params[&name].len();
        let length = |row: &[f64]| row.iter().map(|v| v * v).sum::<f64>().sqrt();
        let g = v
            .chunks_exact(v.len() / rows)
            .map(|row| length(row) * (1.0 + random.symmetric(0.05)))
            .collect();
        params.insert(name, g);
    }
    params
}

/// `n` rays from a shell around the region towards it, the last one past it; or from inside a box, with free space there.
pub fn step(config: StepConfig, n: usize, seed: u64) -> Step {
    let random = &mut Random(seed);
    let inside = matches!(config.region, Region::Box { .. });
    let params = parameters(&config, inside, random);
    let mut rays = Rays::default();
    for ray in 0..n {
        let origin = random
            .direction()
            .map(|x| x * if inside { 0.2 } else { 1.6 });
        let towards: [f64; 3] = std::array::from_fn(|_| random.symmetric(0.5));
        let direction = if inside {
            random.direction()
        } else if ray + 1 == n {
            normalized(std::array::from_fn(|axis| {
                origin[axis] - 0.3 * towards[axis]
            }))
        } else {
            normalized(std::array::from_fn(|axis| towards[axis] - origin[axis]))
        };
        rays.origins.push(origin);
        rays.directions.push(direction);
        rays.target
            .push([random.uniform(), random.uniform(), random.uniform(), 1.0]);
        rays.view.push(ray % config.views);
    }
    let mut draw = |count: usize| -> Vec<f64> { (0..count).map(|_| random.uniform()).collect() };
    let draws = Draws {
        jitter: [draw(n), draw(n), draw(n)],
        taps: draw(n * config.samples),
        background: match &config.background {
            Background::Field(field) => draw(n * (field.samples + 1)),
            _ => Vec::new(),
        },
    };
    let now = Now {
        anneal: 0.8,
        inv_s_lower: 0.01,
        bias_weight: 0.1,
        curvature_weight: 0.0,
        released_levels: config.grid.levels.len(),
        cosine_anneal: 1.0,
        inv_count: 1.0 / n as f64,
    };
    Step {
        config,
        params,
        rays,
        draws,
        now,
        edges: None,
        points: None,
        stage: Stage::first(),
        relu_edge: ReluEdge::default(),
    }
}

/// `step` with every loss on masks, depths and normals, and something to know of its rays; of some of them it is not known.
pub fn supervised(step: Step, seed: u64) -> Step {
    let random = &mut Random(seed);
    let mut step = step;
    for (ray, target) in step.rays.target.iter_mut().enumerate() {
        target[3] = f64::from(u8::from(ray % 4 != 1));
    }
    let known = |(ray, &direction): (usize, &[f64; 3])| {
        let backward = normalized(direction.map(|x| -x + random.symmetric(0.3)));
        let side = random.direction();
        let along = dot(side, backward);
        let right = normalized(std::array::from_fn(|i| side[i] - along * backward[i]));
        let up = std::array::from_fn(|i| {
            let (j, k) = ((i + 1) % 3, (i + 2) % 3);
            backward[j] * right[k] - backward[k] * right[j]
        });
        Known {
            cosine: -dot(direction, backward),
            mono_depth: match ray % 5 {
                3 => f64::NAN,
                _ => random.uniform(),
            },
            mono_normal: match ray % 6 {
                4 => [0.0; 3],
                _ => random.direction(),
            },
            sensor_depth: match ray % 7 {
                5 => 0.0,
                _ => 0.5 + random.uniform(),
            },
            axes: [right, up, backward],
        }
    };
    let rays = step.rays.directions.iter().enumerate();
    step.rays.supervision = Supervision {
        mask: 0.1,
        sensor_depth: 0.2,
        mono_depth: 0.7,
        mono_normal: 0.05,
        known: rays.map(known).collect(),
    };
    step
}

/// Stage 2 with draws for `step`.
pub fn second_stage(step: &Step, seed: u64) -> Stage {
    let random = &mut Random(seed);
    let samples = step.rays.origins.len() * step.config.samples;
    Stage::second(Tangent {
        weight: 0.005,
        step: 0.01,
        draws: (0..samples)
            .map(|_| std::array::from_fn(|_| random.normal()))
            .collect(),
    })
}
