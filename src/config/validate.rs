//! Ranges: which settings the kernels and the method accept. Each complaint gives key, value and range.

use super::{BackgroundKind, Config, GradientKind, MaskUse, MultiStep, ScaleBound, ScaleKind};
use crate::{Error, Result};
use std::fmt::Display;

impl Config {
    /// The same configuration, all of whose values can be trained with.
    ///
    /// # Errors
    /// [`Error::Config`] with every value that is out of range.
    pub fn validated(self) -> Result<Config> {
        let mut wrong = Complaints::default();
        wrong.whole("steps", self.steps, 1, 100_000_000);
        wrong.whole("schedule_steps", self.schedule_steps, 1, 100_000_000);
        wrong.whole("rays", self.rays, 1, 65_536);

        wrong.real("scene.region_scale", self.scene.region_scale, 1e-3, 1e3);
        wrong.real("scene.downscale", self.scene.downscale, 1.0, 64.0);
        if self.scene.holdout == 1 {
            wrong.add(
                "scene.holdout",
                1,
                "0 (none) or at least 2; 1 would hold every view out",
            );
        }

        let hash = &self.hash;
        wrong.grid(
            "hash",
            hash.levels,
            hash.base,
            hash.max,
            hash.log2_size,
            hash.features,
        );
        if hash.half && hash.features == 1 {
            wrong.add(
                "hash.half",
                hash.half,
                "false where hash.features is 1: float16s lie in pairs",
            );
        }
        wrong.whole("hash.release.first", hash.release.first, 0, 16);
        wrong.whole("hash.release.every", hash.release.every, 1, 100_000_000);
        wrong.network("surface.hidden", self.surface.hidden);
        wrong.whole("surface.features", self.surface.features, 1, 256);
        wrong.real("surface.init_hash", self.surface.init_hash, 0.0, 10.0);
        wrong.real(
            "surface.init_features",
            self.surface.init_features,
            0.0,
            10.0,
        );
        wrong.real("surface.init_bias", self.surface.init_bias, 0.0, 10.0);
        wrong.real("surface.scale_max", self.surface.scale_max, 1e-4, 10.0);
        wrong.real("surface.scale_floor", self.surface.scale_floor, 1e-6, 1.0);
        match self.surface.scale {
            ScaleKind::Local => {}
            ScaleKind::Beta => {
                wrong.real("surface.scale_init", self.surface.scale_init, 1e-4, 10.0);
            }
            ScaleKind::Exponential => {
                wrong.real("surface.scale_init", self.surface.scale_init, -10.0, 10.0);
                wrong.real("surface.scale_rate", self.surface.scale_rate, 1e-3, 100.0);
            }
        }
        if ![4, 6].contains(&self.surface.taps) {
            wrong.add("surface.taps", self.surface.taps, "4 or 6");
        }
        wrong.real("surface.tap_range", self.surface.tap_range, 1e-6, 1.0);
        let range_end = self.surface.tap_range_end;
        if range_end != 0.0 {
            wrong.real("surface.tap_range_end", range_end, 1e-6, 1.0);
        }
        wrong.real(
            "loss.curvature.weight",
            self.loss.curvature.weight,
            0.0,
            1e3,
        );
        if self.loss.curvature.weight > 0.0 && self.surface.gradient != GradientKind::Taps {
            wrong.add(
                "loss.curvature.weight",
                self.loss.curvature.weight,
                "0 where surface.gradient is not \"taps\"",
            );
        }
        wrong.real("loss.tangent", self.loss.tangent, 0.0, 1e3);
        if self.loss.tangent > 0.0 && self.surface.gradient != GradientKind::Analytic {
            wrong.add(
                "loss.tangent",
                self.loss.tangent,
                "0 where surface.gradient is not \"analytic\"",
            );
        }
        wrong.network("color.hidden", self.color.hidden);
        wrong.whole("color.layers", self.color.layers, 1, 8);
        wrong.real("color.init_gain", self.color.init_gain, 0.01, 10.0);
        wrong.whole("appearance.dims", self.appearance.dims, 0, 64);

        let sampling = &self.sampling;
        for (level, count) in sampling.proposal_samples.iter().enumerate() {
            wrong.whole(
                &format!("sampling.proposal_samples[{level}]"),
                *count,
                2,
                4096,
            );
        }
        wrong.whole("sampling.samples", sampling.samples, 2, 4096);
        for max in sampling.proposal_max {
            wrong.grid(
                "sampling.proposal",
                sampling.proposal_levels,
                sampling.proposal_base,
                max,
                sampling.proposal_log2_size,
                sampling.proposal_features,
            );
        }
        wrong.network("sampling.proposal_hidden", sampling.proposal_hidden);
        wrong.whole("sampling.anneal_steps", sampling.anneal_steps, 1, u64::MAX);

        let background = &self.background;
        if background.kind == BackgroundKind::Field {
            wrong.grid(
                "background",
                background.levels,
                background.base,
                background.max,
                background.log2_size,
                background.features,
            );
            wrong.whole("background.samples", background.samples, 2, 1024);
            wrong.real("background.far", background.far, 2.0, 1e6);
            wrong.network("background.hidden", background.hidden);
            wrong.whole("background.geometry", background.geometry, 1, 63);
        }

        let loss = &self.loss;
        wrong.real("loss.color_squared", loss.color_squared, 0.0, 1e3);
        wrong.real("loss.eikonal", loss.eikonal, 0.0, 1e3);
        wrong.real("loss.interlevel", loss.interlevel, 0.0, 1e3);
        wrong.real("loss.mask", loss.mask, 0.0, 1e3);
        wrong.real("loss.sensor_depth", loss.sensor_depth, 0.0, 1e3);
        wrong.real("loss.mono_depth", loss.mono_depth, 0.0, 1e6);
        wrong.real("loss.mono_normal", loss.mono_normal, 0.0, 1e3);
        if loss.mask > 0.0 && self.scene.masks != MaskUse::Foreground {
            wrong.add(
                "loss.mask",
                loss.mask,
                "0 where scene.masks is not \"foreground\"",
            );
        }
        wrong.real("stage2.eikonal", self.stage2.eikonal, 0.0, 1e3);
        wrong.real("loss.bias.weight", loss.bias.weight, 0.0, 1e3);
        wrong.real("loss.bias.weight_start", loss.bias.weight_start, 0.0, 1e3);
        wrong.real("loss.bias.epsilon", loss.bias.epsilon, 0.0, 1.0);
        wrong.real("loss.bias.offset", loss.bias.offset, 0.0, 1.0);
        wrong.scale_bound("loss.scale_bound", &loss.scale_bound);
        wrong.scale_bound("stage2.scale_bound", &self.stage2.scale_bound);
        wrong.whole("stage2.steps", self.stage2.steps, 0, 100_000_000);
        wrong.whole("stage2.rays", self.stage2.rays, 1, 65_536);
        wrong.whole("stage2.warmup", self.stage2.warmup, 0, 100_000_000);
        wrong.real("stage2.tangent", self.stage2.tangent, 0.0, 1e3);

        let optimizer = &self.optimizer;
        wrong.multi_step("optimizer.fields", &optimizer.fields);
        wrong.multi_step("optimizer.table", &optimizer.table);
        wrong.multi_step("optimizer.proposal", &optimizer.proposal);
        wrong.real(
            "optimizer.background.learning_rate",
            optimizer.background.learning_rate,
            1e-12,
            10.0,
        );
        wrong.real(
            "optimizer.background.learning_rate_end",
            optimizer.background.learning_rate_end,
            1e-12,
            10.0,
        );
        wrong.real(
            "optimizer.background.weight_decay",
            optimizer.background.weight_decay,
            0.0,
            10.0,
        );
        wrong.real("optimizer.beta1", optimizer.beta1, 0.0, 0.999_999);
        wrong.real("optimizer.beta2", optimizer.beta2, 0.0, 0.999_999_9);
        wrong.real("optimizer.epsilon", optimizer.epsilon, 1e-30, 1.0);

        wrong.whole("report.log_steps", self.report.log_steps, 1, u64::MAX);
        wrong.whole(
            "report.preview_pixels",
            self.report.preview_pixels,
            16,
            u64::MAX,
        );
        wrong.real(
            "report.checkpoint_minutes",
            self.report.checkpoint_minutes,
            0.0,
            1e6,
        );
        wrong.whole("report.keep", self.report.keep, 1, 1_000_000);

        match wrong.0.is_empty() {
            true => Ok(self),
            false => Err(Error::Config {
                what: wrong.0.join("\n"),
            }),
        }
    }
}

/// What is wrong, a line each.
#[derive(Default)]
struct Complaints(Vec<String>);

impl Complaints {
    fn add(&mut self, key: &str, value: impl Display, expected: impl Display) {
        let line = format!("{key} = {value}: expected {expected}");
        if !self.0.contains(&line) {
            self.0.push(line);
        }
    }

    fn whole(&mut self, key: &str, value: impl Into<u64>, least: u64, most: u64) {
        let value = value.into();
        if value < least || value > most {
            match most {
                u64::MAX => self.add(key, value, format!("at least {least}")),
                _ => self.add(key, value, format!("{least} to {most}")),
            }
        }
    }

    fn real(&mut self, key: &str, value: f64, least: f64, most: f64) {
        if !(least..=most).contains(&value) {
            self.add(key, value, format!("{least} to {most}"));
        }
    }

    /// Widths are tiled by eight.
    fn network(&mut self, key: &str, width: u32) {
        if width == 0 || !width.is_multiple_of(8) || width > 512 {
            self.add(key, width, "a multiple of 8, at most 512");
        }
    }

    fn grid(
        &mut self,
        group: &str,
        levels: u32,
        base: u32,
        max: u32,
        log2_size: u32,
        features: u32,
    ) {
        // The proposal grids' keys carry the group in their names.
        let dot = if group.ends_with("proposal") {
            "_"
        } else {
            "."
        };
        self.whole(&format!("{group}{dot}levels"), levels, 1, 16);
        self.whole(&format!("{group}{dot}base"), base, 2, 65_536);
        self.whole(&format!("{group}{dot}max"), max, 2, 65_536);
        if max < base {
            self.add(
                &format!("{group}{dot}max"),
                max,
                format!("at least {group}{dot}base = {base}"),
            );
        }
        self.whole(&format!("{group}{dot}log2_size"), log2_size, 4, 24);
        if ![1, 2, 4, 8].contains(&features) {
            self.add(&format!("{group}{dot}features"), features, "1, 2, 4 or 8");
        }
    }

    fn scale_bound(&mut self, group: &str, bound: &ScaleBound) {
        self.real(&format!("{group}.start"), bound.start, 0.0, 1e6);
        self.real(&format!("{group}.end"), bound.end, 0.0, 1e6);
        self.real(&format!("{group}.last"), bound.last, 0.0, 1e6);
        self.whole(&format!("{group}.steps"), bound.steps, 0, 100_000_000);
        self.whole(
            &format!("{group}.last_steps"),
            bound.last_steps,
            0,
            100_000_000,
        );
    }

    fn multi_step(&mut self, group: &str, group_of: &MultiStep) {
        self.real(
            &format!("{group}.learning_rate"),
            group_of.learning_rate,
            0.0,
            10.0,
        );
        self.real(
            &format!("{group}.weight_decay"),
            group_of.weight_decay,
            0.0,
            10.0,
        );
        self.real(&format!("{group}.gamma"), group_of.gamma, 0.0, 1.0);
        if !group_of.milestones.is_sorted() {
            self.add(
                &format!("{group}.milestones"),
                format!("{:?}", group_of.milestones),
                "ascending steps",
            );
        }
    }
}
