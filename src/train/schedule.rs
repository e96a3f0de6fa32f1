//! Every number that changes with time, as a function of the step alone.
//!
//! Closed forms, those of NeuRodin's released code (release: of Neuralangelo's), k the time in schedule steps:
//!   scale bound   A: 1/β ≥ a + (b - a) log₂(1 + min(k, K)/K);  B: a + (b - a) (e^{4x} - 1)/(e⁴ - 1), then on to c with (e^x - 1)/(e - 1)
//!   bias weight   the form of A, from `weight_start` to `weight`
//!   annealing     10x / (9x + 1), x = min(k/K, 1): exponent of the proposal weights (Barron et al. 2022)
//!   multi-step    min(k/warmup, 1) · γ^(milestones passed)
//!   exponential   a^(1-x) b^x, x = min(k/K, 1)
//!   release       one level more every K steps after k₀: l = max(⌊(k − k₀)/K⌋, 1), the network sees max(first, l) levels; taps that follow
//!                 it lie a quarter of level l's cell away, and the curvature weight is divided by the grid's growth l − 1 times
//! A run of another length than `schedule_steps` is the same schedule, stretched: k = step · schedule_steps / steps, not rounded.

use crate::config::{Config, Drop, HashConfig, MultiStep, Rise, ScaleBound, TapStepKind};

/// The schedules of a run.
#[derive(Clone, Debug)]
pub struct Schedule {
    config: Config,
}

/// All annealed numbers of one step.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Now {
    /// The step of the stage that these belong to.
    pub step: u64,
    /// Learning rate of the surface and colour networks and the appearance codes.
    pub lr_fields: f64,
    /// Learning rate of the signed distance's hash grid.
    pub lr_table: f64,
    /// Learning rate of the proposal networks.
    pub lr_proposal: f64,
    /// Learning rate of the background.
    pub lr_background: f64,
    /// Exponent of the proposal weights, 0 to 1.
    pub anneal: f64,
    /// Lower bound of 1/β, in inverse region units.
    pub inv_s_lower: f64,
    /// Weight of the explicit bias correction.
    pub bias_weight: f64,
    /// Weight of the curvature loss.
    pub curvature_weight: f64,
    /// Levels of the surface's hash grid that its network sees.
    pub released_levels: u32,
    /// Taps lie max(tap_range·u, tap_floor) away, in region units.
    pub tap_range: f64,
    pub tap_floor: f64,
    /// How hard NeuS's cosine is, 0 to 1.
    pub cosine_anneal: f64,
}

impl Now {
    /// The same with all learning rates multiplied.
    pub fn with_rates_times(self, factor: f64) -> Now {
        Now {
            lr_fields: factor * self.lr_fields,
            lr_table: factor * self.lr_table,
            lr_proposal: factor * self.lr_proposal,
            lr_background: factor * self.lr_background,
            ..self
        }
    }
}

impl Schedule {
    /// The schedules of a configuration.
    pub fn new(config: &Config) -> Schedule {
        Schedule {
            config: config.clone(),
        }
    }

    /// Where the schedule stands at a step of the stage (counted from 0): schedule steps, not whole in general.
    pub fn time(&self, step: u64) -> f64 {
        // One rounding only, so that milestones are hit exactly wherever they can be.
        (u128::from(step) * u128::from(self.config.schedule_steps)) as f64
            / self.config.steps as f64
    }

    /// The numbers for a step, counted from the beginning of the first stage. Beyond the end of the stage they stay as at its end.
    pub fn at(&self, step: u64) -> Now {
        let step = step.saturating_sub(self.config.first_step);
        let k = self.time(step.min(self.config.steps));
        let Config {
            hash,
            surface,
            sampling,
            loss,
            optimizer,
            schedule_steps,
            ..
        } = &self.config;
        let bias = &loss.bias;
        let level = match hash.release.first {
            0 => hash.levels,
            _ => {
                let since = (k - hash.release.start as f64).max(0.0);
                ((since / hash.release.every as f64) as u32).clamp(1, hash.levels)
            }
        };
        let growth = growth(hash);
        let (tap_range, tap_floor) = match surface.tap_step {
            TapStepKind::Random => {
                let range = match surface.tap_range_end {
                    0.0 => surface.tap_range,
                    end => exponential(surface.tap_range, end, k / *schedule_steps as f64),
                };
                (range, 0.25 / f64::from(hash.max))
            }
            TapStepKind::Level => {
                let cells = f64::from(hash.base) * growth.powi(level as i32 - 1);
                (0.0, 0.25 * 2.0 / cells)
            }
        };
        Now {
            step,
            lr_fields: multi_step(&optimizer.fields, k),
            lr_table: multi_step(&optimizer.table, k),
            lr_proposal: multi_step(&optimizer.proposal, k),
            lr_background: exponential(
                optimizer.background.learning_rate,
                optimizer.background.learning_rate_end,
                k / *schedule_steps as f64,
            ),
            anneal: anneal(k / sampling.anneal_steps as f64),
            inv_s_lower: scale_bound(&loss.scale_bound, k),
            bias_weight: match bias.weight > 0.0 {
                true => logarithmic(bias.weight_start, bias.weight, bias.ramp_steps, k),
                false => 0.0, // a ramp that ends with nothing is none
            },
            curvature_weight: loss.curvature.weight * ramp(k, loss.curvature.warmup)
                / growth.powi(level as i32 - 1),
            released_levels: level.max(hash.release.first).min(hash.levels),
            tap_range,
            tap_floor,
            cosine_anneal: ramp(k, surface.cosine_steps),
        }
    }
}

/// From 0 to 1 within `steps`, linearly.
fn ramp(k: f64, steps: u64) -> f64 {
    if k < steps as f64 {
        k / steps as f64
    } else {
        1.0
    }
}

/// Cells along an axis of a level of the hash grid over those of the level before.
fn growth(hash: &HashConfig) -> f64 {
    let steps = f64::from(hash.levels.max(2) - 1);
    (f64::from(hash.max) / f64::from(hash.base)).powf(1.0 / steps)
}

/// From `start` to `end` within `steps`, as log₂(1 + x): fast first. Zero steps: `end` from the beginning.
fn logarithmic(start: f64, end: f64, steps: u64, k: f64) -> f64 {
    if k >= steps as f64 {
        return end;
    }
    start + (end - start) * (1.0 + k / steps as f64).log2()
}

fn scale_bound(bound: &ScaleBound, k: f64) -> f64 {
    let beyond = k - bound.steps as f64;
    if beyond >= 0.0 && bound.last_steps > 0 {
        return exponential_rise(bound.end, bound.last, beyond / bound.last_steps as f64, 1.0);
    }
    match bound.rise {
        Rise::Logarithmic => logarithmic(bound.start, bound.end, bound.steps, k),
        Rise::Exponential => exponential_rise(bound.start, bound.end, k / bound.steps as f64, 4.0),
    }
}

/// From `start` to `end` while x goes from 0 to 1, as (e^{rate x} − 1)/(e^rate − 1): fast last.
fn exponential_rise(start: f64, end: f64, x: f64, rate: f64) -> f64 {
    start + (end - start) * (rate * x.min(1.0)).exp_m1() / rate.exp_m1()
}

fn anneal(x: f64) -> f64 {
    let x = x.min(1.0);
    10.0 * x / (9.0 * x + 1.0)
}

fn multi_step(group: &MultiStep, k: f64) -> f64 {
    let rise = ramp(k, group.warmup);
    let passed = group
        .milestones
        .iter()
        .map(|milestone| *milestone as f64)
        .filter(|milestone| match group.drop {
            Drop::At => *milestone <= k,
            Drop::After => *milestone < k,
        })
        .count();
    group.learning_rate * rise * group.gamma.powi(passed as i32)
}

/// From `start` to `end` while x goes from 0 to 1, by equal factors in equal times.
fn exponential(start: f64, end: f64, x: f64) -> f64 {
    start * (end / start).powf(x.min(1.0))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::PRESETS;

    /// What the schedules of NeuRodin's released code come to, rounded.
    #[test]
    fn published_table() {
        let outdoor = Schedule::new(&Config::default());
        let indoor = Schedule::new(&Config::preset("indoor-large").unwrap());
        for (step, bound, bias, anneal) in [
            (0, 0.01, 0.001, 0.0),
            (1_000, 0.586, 0.00774, 0.526),
            (5_000, 2.87, 0.0297, 0.909),
            (10_000, 5.67, 0.05, 1.0),
            (20_000, 11.11, 0.05, 1.0),
            (50_000, 26.31, 0.05, 1.0),
            (100_000, 48.55, 0.05, 1.0),
            (200_000, 84.80, 0.05, 1.0),
            (250_000, 100.0, 0.05, 1.0),
            (300_000, 100.0, 0.05, 1.0),
        ] {
            let (now, room) = (outdoor.at(step), indoor.at(step));
            assert!((now.inv_s_lower / bound - 1.0).abs() < 2e-3, "{now:?}");
            assert!((room.bias_weight / bias - 1.0).abs() < 2e-3, "{room:?}");
            assert!((now.anneal - anneal).abs() < 5e-4, "{now:?}");
            assert_eq!(now.bias_weight, 0.1, "constant outdoors");
        }
    }

    /// By equal factors in equal times; every preset's range stays what it is.
    #[test]
    fn the_range_of_taps_shrinks() {
        let shrinking = Config::default().with_assignment("surface.tap_range_end=0.001");
        let shrinking = Schedule::new(&shrinking.unwrap());
        for (step, range) in [(0, 0.1), (150_000, 0.01), (300_000, 0.001)] {
            for preset in PRESETS {
                let config = Config::preset(preset.name).unwrap();
                let now = Schedule::new(&config).at(step * config.steps / 300_000);
                assert_eq!(now.tap_range, config.surface.tap_range, "{}", preset.name);
            }
            assert!((shrinking.at(step).tap_range / range - 1.0).abs() < 1e-12);
        }
    }

    #[test]
    fn a_weight_of_nothing_has_no_ramp() {
        let ramped = Config::preset("indoor-large").unwrap();
        assert!(ramped.loss.bias.weight_start > 0.0 && ramped.loss.bias.ramp_steps > 0);
        let off = ramped.with_assignment("loss.bias.weight=0").unwrap();
        for step in [0, 1, 100, 20_000] {
            assert_eq!(Schedule::new(&off).at(step).bias_weight, 0.0);
        }
    }

    /// The second stage's bound B, and everything else from anew, as in NeuRodin's released code.
    #[test]
    fn published_table_of_stage_2() {
        let first = Config::default();
        let second = first.second_stage().expect("two stages");
        assert_eq!(second.second_stage(), None, "there is no third");
        let (first, second) = (Schedule::new(&first), Schedule::new(&second));
        for (step, bound) in [
            (0, 0.01),
            (1_000, 0.198),
            (5_000, 0.991),
            (10_000, 2.08),
            (20_000, 4.60),
            (50_000, 16.04),
            (100_000, 59.61),
            (200_000, 500.0),
            (250_000, 1443.9),
            (300_000, 3000.0),
        ] {
            let (now, then) = (second.at(300_000 + step), first.at(step));
            assert!((now.inv_s_lower / bound - 1.0).abs() < 3e-3, "{now:?}");
            assert_eq!(now.bias_weight, 0.0);
            assert_eq!(
                (now.step, now.lr_fields, now.anneal),
                (then.step, then.lr_fields, then.anneal)
            );
        }
    }

    /// Warm-up and both sides of every milestone, as in NeuRodin's released code.
    #[test]
    fn learning_rates() {
        let schedule = Schedule::new(&Config::default());
        for (step, fields, proposal) in [
            (0, 0.0, 1.0),
            (1, 1.0 / 5000.0, 1.0),
            (4_999, 4999.0 / 5000.0, 1.0),
            (5_000, 1.0, 1.0),
            (149_999, 1.0, 1.0),
            (150_000, 1.0, 0.33),
            (160_000, 1.0, 0.33),
            (160_001, 0.1, 0.33),
            (225_000, 0.1, 0.33 * 0.33),
            (240_000, 0.1, 0.33 * 0.33),
            (240_001, 0.01, 0.33 * 0.33),
            (270_000, 0.01, 0.33 * 0.33 * 0.33),
        ] {
            let now = schedule.at(step);
            assert!((now.lr_fields - 1e-3 * fields).abs() < 1e-15, "{now:?}");
            assert_eq!(now.lr_table, now.lr_fields);
            assert!((now.lr_proposal - 1e-2 * proposal).abs() < 1e-14, "{now:?}");
        }
        assert!((schedule.at(0).lr_background - 1e-2).abs() < 1e-15);
        assert!((schedule.at(150_000).lr_background - 1e-3).abs() < 1e-15);
        assert!((schedule.at(300_000).lr_background - 1e-4).abs() < 1e-15);
    }

    /// A short run passes through the same numbers at the same fractions, milestones included.
    #[test]
    fn stretched() {
        let long = Schedule::new(&Config::default());
        let short = Schedule::new(&Config {
            steps: 2_000,
            ..Config::default()
        });
        for step in (0..=2_000).step_by(50) {
            let (short, long) = (short.at(step), long.at(step * 150));
            assert_eq!(
                Now {
                    step: long.step,
                    ..short
                },
                long
            );
        }
        assert_eq!(short.at(5_000).inv_s_lower, short.at(2_000).inv_s_lower);
    }
}
