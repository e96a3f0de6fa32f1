//! Studies: several runs on one dataset, which go on when the command that trains them is given again.

use super::Context;
use super::chosen::{Chosen, open_scene};
use super::scene_args::SceneArgs;
use super::settings::SettingsArgs;
use super::train::{self, Done};
use crate::config::{Config, Effect};
use crate::scene::{Region, Scene, Split};
use crate::train::checkpoint;
use crate::train::run_directory::{RunDirectory, SceneRecord};
use crate::{Error, Result};
use std::fs;
use std::path::{Path, PathBuf};

/// A dataset, opened, with the flags of all runs on it.
pub(super) struct Study<'a> {
    dataset: &'a Path,
    pub settings: SettingsArgs,
    flags: &'a SceneArgs,
    pub scene: Scene,
}

/// A run of a study: where it is, and what it is to be.
pub(super) struct Planned<'a> {
    pub run: PathBuf,
    pub config: Config,
    record: SceneRecord,
    dataset: &'a Path,
    settings: SettingsArgs,
    flags: &'a SceneArgs,
}

impl<'a> Study<'a> {
    /// Opens the dataset as all runs will.
    ///
    /// # Errors
    /// [`Error::Config`] for settings that make no sense, a second stage alone among them; those of [`Scene::open`].
    pub fn open(
        dataset: &'a Path,
        settings: &SettingsArgs,
        flags: &'a SceneArgs,
    ) -> Result<Study<'a>> {
        if settings.stage == Some(2) {
            return Err(Error::Config {
                what: "--stage 2: every run is trained from its beginning here
  next: --stage 1, or no --stage for all of them"
                    .into(),
            });
        }
        if let Some(method) = &settings.method {
            return Err(Error::Config {
                what: format!(
                    "--method {method} (or NEURODIN_METHOD): several methods are trained here\n  next: leave it out; compare takes --methods"
                ),
            });
        }
        Ok(Study {
            scene: open_scene(settings, flags, dataset)?,
            dataset,
            settings: settings.clone(),
            flags,
        })
    }

    /// Whether a view is held out, without which `what`.
    ///
    /// # Errors
    /// [`Error::Input`] in that case, with what would hold some out.
    pub fn check_held_out(&self, what: &str) -> Result<()> {
        if self.scene.split(Split::Test).next().is_some() {
            return Ok(());
        }
        // Of fewer than two in N none are.
        let views = self.scene.views.len();
        let next = match views / 2 {
            0 | 1 => "take more photographs".into(),
            most => format!("give --holdout {}", most.min(8)),
        };
        Err(Error::input(
            self.dataset,
            format!("no view of {views} is held out, and {what}"),
            next,
        ))
    }

    /// The run at `run`, of a method under the nth seed from that of the settings.
    ///
    /// # Errors
    /// [`Error::Config`] for settings that make no sense, and where there is no such seed; those of [`Chosen::of`].
    pub fn plan(&self, run: PathBuf, method: &str, nth: u32) -> Result<Planned<'a>> {
        let mut settings = SettingsArgs {
            method: Some(method.into()),
            ..self.settings.clone()
        };
        let Chosen {
            mut config, region, ..
        } = Chosen::of(&settings, self.flags, &self.scene)?;
        config.seed = config.seed.checked_add(nth).ok_or_else(|| Error::Config {
            what: format!(
                "--seeds: counted from seed {}, the {}th is beyond {}\n  next: a smaller --seed",
                config.seed,
                nth + 1,
                u32::MAX
            ),
        })?;
        settings.seed = Some(config.seed);
        Ok(Planned {
            run,
            record: SceneRecord::new(self.dataset, &self.scene, &region)?,
            config,
            dataset: self.dataset,
            settings,
            flags: self.flags,
        })
    }
}

impl Planned<'_> {
    pub fn region(&self) -> &Region {
        &self.record.region
    }

    /// Where a study that scores its runs keeps what this one came to.
    pub fn scores(&self) -> PathBuf {
        self.run.join("scores.json")
    }

    /// Whether what is there already, if anything, was trained as is asked now: it would be taken, or gone on with, as it is.
    ///
    /// # Errors
    /// [`Error::Config`] with the differences; those of reading the run.
    pub fn check(&self) -> Result<()> {
        let Ok(run) = RunDirectory::open(&self.run) else {
            return Ok(());
        };
        if checkpoint::files(&run.checkpoints())?.is_empty() && !self.scores().exists() {
            return Ok(());
        }
        let path = run.config();
        let text = fs::read_to_string(&path).map_err(|e| Error::unreadable(&path, &e))?;
        let was = Config::recorded(&text, &path.display().to_string())?;
        // A run that went on with its second stage holds the settings of that.
        let second = (was.first_step > 0).then(|| self.config.second_stage());
        let now = second.flatten().unwrap_or_else(|| self.config.clone());
        let differences = was.differences(&now);
        let mut told: Vec<String> = differences
            .iter()
            .filter(|difference| difference.effect != Effect::None)
            .map(ToString::to_string)
            .collect();
        told.extend(changes(&SceneRecord::load(&run)?, &self.record));
        if told.is_empty() {
            return Ok(());
        }
        Err(Error::Config {
            what: format!(
                "{}: was trained otherwise than is asked now:\n  {}\n  next: ask as before, remove that directory to have it trained again, or \
                 give another --out",
                self.run.display(),
                told.join("\n  ")
            ),
        })
    }

    /// Trains it, or goes on with it.
    ///
    /// # Errors
    /// Those of [`train::train_or_resume`].
    pub fn train(&self, context: &Context) -> anyhow::Result<Done> {
        let (settings, flags) = (self.settings.clone(), self.flags.clone());
        train::train_or_resume(self.dataset, &self.run, settings, flags, context)
    }
}

/// What of a dataset differs between two runs, in words.
fn changes(was: &SceneRecord, now: &SceneRecord) -> Vec<String> {
    let mut told = Vec::new();
    // One that is no longer where it was has moved here, if it holds the same.
    if was.dataset != now.dataset && was.dataset.exists() {
        let (was, now) = (was.dataset.display(), now.dataset.display());
        told.push(format!("dataset: {was} -> {now}"));
    }
    let place = |region: &Region| (region.center.to_array(), region.radius, region.shape);
    if place(&was.region) != place(&now.region) {
        let [was, now] = [place(&was.region), place(&now.region)];
        told.push(format!("region: {was:?} -> {now:?}"));
    }
    if was.views != now.views {
        let held_out = |record: &SceneRecord| {
            let test = record.views.iter().filter(|view| view.split == Split::Test);
            format!("{}, {} held out", record.views.len(), test.count())
        };
        let [was, now] = [held_out(was), held_out(now)];
        told.push(match was == now {
            true => "views: other names or sizes, or others held out".into(),
            false => format!("views: {was} -> {now}"),
        });
    }
    told
}
