//! The flags that make a configuration; shared by every command that trains.

use crate::config::{Config, HUGE, METHODS, PRESETS};
use crate::{Error, Result};
use clap::Args;
use std::path::PathBuf;

/// Where settings come from, weakest first: preset, file, method, environment, flags. A file that names a method is laid over that one.
#[derive(Args, Clone, Debug, Default)]
#[command(next_help_heading = "Settings")]
pub(super) struct SettingsArgs {
    /// Named settings to start from; without it a tiny preset for the kind of scene
    #[arg(long, value_name = "NAME", env = "NEURODIN_PRESET", long_help = preset_help())]
    pub preset: Option<String>,
    /// Method that the preset is set to
    #[arg(long, value_name = "NAME", env = "NEURODIN_METHOD", long_help = method_help())]
    pub method: Option<String>,
    /// TOML file of settings that differ from the preset
    #[arg(long, value_name = "FILE", env = "NEURODIN_CONFIG")]
    pub config: Option<PathBuf>,
    /// Length of the run, all stages together; every schedule is stretched to it
    #[arg(long, value_name = "N", env = "NEURODIN_STEPS")]
    pub steps: Option<u64>,
    /// Only this stage; 2 goes on from a run whose first is done
    #[arg(long, value_name = "1|2", value_parser = clap::value_parser!(u8).range(1..=2))]
    pub stage: Option<u8>,
    /// Seed of every random number
    #[arg(long, value_name = "N", env = "NEURODIN_SEED")]
    pub seed: Option<u32>,
    /// The same run comes out in the same bits, on one device; steps take a tenth longer or so, gradients twice the memory
    #[arg(long)]
    pub deterministic: bool,
    /// One setting, for example hash.log2_size=22; may be given several times
    #[arg(long, value_name = "KEY=VALUE")]
    pub set: Vec<String>,
}

/// The presets with what they are for.
fn preset_help() -> String {
    let mut text = String::from(
        "Named settings to start from; without it a tiny preset for the kind of scene\n",
    );
    for preset in PRESETS {
        text += &format!("\n  {:<14} {}", preset.name, preset.summary);
    }
    text += &format!("\n\nWith {HUGE} behind its name, the same with a dictionary of 2^22.");
    text
}

/// The methods with what they are.
fn method_help() -> String {
    let mut text = String::from("Method that the preset is set to\n");
    for method in METHODS {
        text += &format!("\n  {:<14} {}", method.name, method.summary);
    }
    text
}

impl SettingsArgs {
    /// The configuration that was asked for, on top of `base` where no preset was named.
    ///
    /// # Errors
    /// [`Error::Config`], [`Error::Input`] for a file that cannot be read.
    pub fn resolve(&self, base: Config) -> Result<Config> {
        let mut config = match &self.preset {
            Some(name) => Config::preset(name)?,
            None => base,
        };
        if let Some(path) = &self.config {
            let source = path.display().to_string();
            let text =
                std::fs::read_to_string(path).map_err(|error| Error::unreadable(path, &error))?;
            config = match &self.preset {
                // Its own preset counts unless another was asked for.
                None => Config::from_toml_or(&text, &source, config)?,
                Some(name) => Config {
                    preset: name.clone(),
                    ..config.with_toml(&text, &source)?
                },
            };
        }
        if let Some(name) = &self.method {
            config = config.with_method(name)?;
        }
        for assignment in &self.set {
            config = config.with_assignment(assignment)?;
        }
        if self.stage == Some(1) {
            config.stage2.steps = 0;
        }
        if let Some(steps) = self.steps {
            config = config.with_total_steps(steps);
        }
        if let Some(seed) = self.seed {
            config.seed = seed;
        }
        config.deterministic |= self.deterministic;
        config.validated()
    }

    /// Whether these flags or their file name a preset.
    ///
    /// # Errors
    /// As [`SettingsArgs::resolve`].
    pub fn names_preset(&self) -> Result<bool> {
        // Whatever the base is, a named preset replaces its name.
        let unnamed = Config {
            preset: String::new(),
            ..Config::default()
        };
        Ok(!self.resolve(unnamed)?.preset.is_empty())
    }
}
