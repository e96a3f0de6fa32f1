//! A dataset and the settings for a new run on it: what flags ask for, on top of what the dataset suggests.

use super::scene_args::SceneArgs;
use super::settings::SettingsArgs;
use super::suggestion::Suggestion;
use crate::Result;
use crate::config::Config;
use crate::gpu::GpuOptions;
use crate::scene::{Region, Scene};
use crate::train::run_directory::scene_options;
use std::path::Path;

/// The settings for a new run on a dataset, and the region that results from them.
pub(super) struct Chosen {
    pub config: Config,
    pub region: Region,
    /// Why the preset was chosen, if it was not named.
    pub why: String,
    /// What speaks against them, and what about the dataset should be seen to.
    pub doubts: Vec<String>,
}

impl Chosen {
    /// Those that were asked for, on top of what the dataset suggests where no preset was named.
    ///
    /// # Errors
    /// [`crate::Error::Config`] for settings or a region that make no sense; [`crate::Error::Input`] for a file or picture that cannot be
    /// read.
    pub fn of(settings: &SettingsArgs, flags: &SceneArgs, scene: &Scene) -> Result<Chosen> {
        let (config, why, suggestion) = match settings.names_preset()? {
            true => (described(settings, flags)?, String::new(), None),
            false => {
                let suggestion = Suggestion::for_scene(scene, flags)?;
                let config = flags.put_into(settings.resolve(suggestion.config()?)?)?;
                (config, suggestion.in_words(), Some(suggestion))
            }
        };
        let region = Region::estimate(scene, &flags.region(&config))?;
        tracing::info!(
            center = ?region.center.to_array(),
            radius = region.radius,
            shape = ?region.shape,
            how = region.how,
            preset = config.preset,
            suggested = suggestion.is_some(),
            "region and preset chosen"
        );
        let suggestion = match suggestion {
            Some(suggestion) => suggestion,
            None => Suggestion::of(scene, &region)?,
        };
        Ok(Chosen {
            doubts: doubts(&suggestion, &config, scene, &region),
            why,
            config,
            region,
        })
    }
}

fn doubts(suggestion: &Suggestion, config: &Config, scene: &Scene, region: &Region) -> Vec<String> {
    let mut doubts = suggestion.warnings(scene, region);
    doubts.extend(suggestion.doubts(config, scene, region));
    doubts
}

/// The settings for a new run, as far as they are known without looking at its dataset.
///
/// # Errors
/// As [`Chosen::of`].
pub(super) fn described(settings: &SettingsArgs, flags: &SceneArgs) -> Result<Config> {
    flags.put_into(settings.resolve(Config::preset("outdoor-tiny")?)?)
}

/// The dataset as the flags say it should be read; no preset says otherwise.
///
/// # Errors
/// Those of [`described`] and [`Scene::open`].
pub(super) fn open_scene(
    settings: &SettingsArgs,
    flags: &SceneArgs,
    dataset: &Path,
) -> Result<Scene> {
    Scene::open(dataset, &scene_options(&described(settings, flags)?))
}

/// How a configuration wants its device to work.
pub(super) fn gpu_options(config: &Config) -> GpuOptions {
    GpuOptions {
        deterministic: config.deterministic,
        matrices: config.matrices,
        ..GpuOptions::default()
    }
}
