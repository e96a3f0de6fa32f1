//! `neurodin train`: a dataset becomes a run directory; or an interrupted run goes on.

use super::chosen::{Chosen, described, gpu_options, open_scene};
use super::progress::{Progress, clock};
use super::scene_args::SceneArgs;
use super::settings::SettingsArgs;
use super::{Context, diagnostics, interrupt};
use crate::config::{Config, Difference, Effect};
use crate::gpu::Gpu;
use crate::scene::{Region, RegionShape, Scene, Split};
use crate::train::Trainer;
use crate::train::checkpoint::{self, Latest};
use crate::train::report::{Control, Event, Log};
use crate::train::run_directory::{RunDirectory, SceneRecord};
use crate::{Error, Result};
use clap::Args;
use serde_json::{Value, json};
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

/// Train on a dataset, or go on with a run
#[derive(Args)]
#[command(after_help = "\
Example:
  neurodin train photos/ --out run
  neurodin train photos/ --out run --preset outdoor-large --set hash.log2_size=22
  neurodin train --out run --resume
  neurodin train --preset indoor-tiny --print-config > mine.toml")]
pub(super) struct TrainArgs {
    /// Directory of the dataset, its transforms.json, meta_data.json or cameras_sphere.npz, or the directory of a COLMAP model; with
    /// --resume only if it has moved
    #[arg(required_unless_present_any = ["resume", "print_config"])]
    pub dataset: Option<PathBuf>,
    /// Run directory to write
    #[arg(
        short,
        long,
        value_name = "RUN",
        required_unless_present = "print_config"
    )]
    pub out: Option<PathBuf>,
    /// Go on where the run stopped
    #[arg(long, conflicts_with_all = ["force", "center", "radius", "boxed", "region_scale"])]
    pub resume: bool,
    /// Replace a run that is there already
    #[arg(long)]
    pub force: bool,
    /// Prepare everything, say what would be done, and write nothing
    #[arg(long)]
    pub dry_run: bool,
    /// Print every setting as TOML on stdout, with a dataset those that suit it, and do nothing else
    #[arg(long)]
    pub print_config: bool,
    #[command(flatten)]
    pub settings: SettingsArgs,
    #[command(flatten)]
    pub scene: SceneArgs,
}

pub(super) fn run(args: &TrainArgs, context: &Context) -> anyhow::Result<()> {
    let out = args.out.as_deref().unwrap_or(Path::new(""));
    let task = match (args.resume, args.print_config) {
        (true, true) => return print_config(&resumed(args, out)?.config, context),
        (true, false) => resume(args, out, context)?,
        (false, true) => {
            let config = match &args.dataset {
                Some(dataset) => {
                    let scene = open_scene(&args.settings, &args.scene, dataset)?;
                    Chosen::of(&args.settings, &args.scene, &scene)?.config
                }
                None => described(&args.settings, &args.scene)?,
            };
            return print_config(&config, context);
        }
        (false, false) => begin(args, out, context)?,
    };
    if args.dry_run {
        context.say("dry run: nothing was written");
        return Ok(context.result(&json!({ "dry_run": true, "config": task.config }), "")?);
    }
    let done = task.run(args.force, context)?;
    Ok(context.result(&done.to_json(), &done.text())?)
}

/// Every setting on stdout: as TOML, or under `--json` as the object that it is.
fn print_config(config: &Config, context: &Context) -> anyhow::Result<()> {
    match context.prints_json() {
        true => context.result(&json!(config), "")?,
        false => context.print(&config.to_toml())?,
    }
    Ok(())
}

/// Trains on a dataset into `out`, or where a run of it is there already goes on with that.
pub(super) fn train_or_resume(
    dataset: &Path,
    out: &Path,
    settings: SettingsArgs,
    scene: SceneArgs,
    context: &Context,
) -> anyhow::Result<Done> {
    // A checkpoint that cannot be read is no reason to begin anew: what is wrong with it is said by going on.
    let has_checkpoint = match RunDirectory::open(out) {
        Ok(run) => !checkpoint::files(&run.checkpoints())?.is_empty(),
        Err(_) => false,
    };
    let args = TrainArgs {
        dataset: Some(dataset.into()),
        out: Some(out.into()),
        resume: has_checkpoint,
        force: true, // a run without checkpoint holds nothing
        dry_run: false,
        print_config: false,
        settings,
        scene,
    };
    let task = match has_checkpoint {
        // With the settings that it was begun with.
        true => {
            let kept = TrainArgs {
                settings: SettingsArgs::default(),
                scene: SceneArgs::default(),
                ..args
            };
            resume(&kept, out, context)?
        }
        false => begin(&args, out, context)?,
    };
    task.run(true, context)
}

/// Everything a run needs, on the device, with nothing written yet.
pub(super) struct Task {
    out: PathBuf,
    /// Settings of all its stages.
    config: Config,
    scene: Scene,
    record: SceneRecord,
    trainer: Trainer,
    /// The checkpoint that it goes on from.
    resumed: Option<PathBuf>,
}

/// What training came to.
pub(super) struct Done {
    run: PathBuf,
    /// Steps done in all stages, also before it was resumed.
    pub steps: u64,
    took: Duration,
    /// Device memory of the stage that took most.
    pub device_bytes: u64,
    /// Of the last preview, in dB.
    preview_psnr: Option<f64>,
    checkpoint: Option<PathBuf>,
}

impl Done {
    fn to_json(&self) -> Value {
        json!({
            "run": self.run,
            "step": self.steps,
            "seconds": self.took.as_secs_f64(),
            "device_bytes": self.device_bytes,
            "preview_psnr": self.preview_psnr,
            "checkpoint": self.checkpoint,
        })
    }

    fn text(&self) -> String {
        format!(
            "done     {} steps in {}; next: neurodin mesh {} -o mesh.ply",
            self.steps,
            clock(self.took),
            self.run.display()
        )
    }
}

/// A new run.
fn begin(args: &TrainArgs, out: &Path, context: &Context) -> anyhow::Result<Task> {
    if args.settings.stage == Some(2) {
        return Err(Error::Config {
            what: "stage 2 goes on from a run whose first stage is done: name it by --out, with --resume".into(),
        }
        .into());
    }
    RunDirectory::check_free(out, args.force)?;
    let dataset = args.dataset.as_deref().expect("clap requires it");
    let scene = open_scene(&args.settings, &args.scene, dataset)?;
    let Chosen {
        config,
        region,
        why,
        doubts,
    } = Chosen::of(&args.settings, &args.scene, &scene)?;
    context.say(&format!(
        "dataset  {}, {}: {} views to train on, {} held out{}",
        dataset.display(),
        scene.format,
        scene.split(Split::Train).count(),
        scene.split(Split::Test).count(),
        match scene.skipped.len() {
            0 => String::new(),
            skipped => format!(", {skipped} things skipped (`neurodin inspect` says which)"),
        }
    ));
    context.say(&format!("region   {}", in_words(&region)));
    context.say(&format!(
        "preset   {}{}, {}, seed {}",
        config.preset,
        why,
        in_stages(&config),
        config.seed
    ));
    for doubt in &doubts {
        context.warn(doubt);
    }
    let gpu = context.gpu_with(gpu_options(&config))?;
    let later = later_bytes(&gpu, &scene, &region, &config)?;
    let task = Task::new(&gpu, dataset, scene, &region, config, out)?;
    say_device(&gpu, later, args.dry_run, context);
    Ok(task)
}

/// Device memory of the stage that comes after this one, if any. It may need more: that it fits is tried before the first step, not found out
/// at the end of a long stage.
fn later_bytes(gpu: &Gpu, scene: &Scene, region: &Region, config: &Config) -> Result<Option<u64>> {
    let Some(second) = config.second_stage() else {
        return Ok(None);
    };
    match Trainer::new(gpu, scene, region, &second) {
        Ok(trainer) => Ok(Some(trainer.gpu().memory_plan().total)),
        Err(Error::OutOfMemory { what }) => Err(Error::OutOfMemory {
            what: format!(
                "stage 2 would not fit with stage2.rays = {} (--set stage2.rays=N)\n  {what}",
                second.rays
            ),
        }),
        Err(error) => Err(error),
    }
}

/// The device, and what of its memory is used from here to the end: everything is allocated before a stage's first step.
fn say_device(gpu: &Gpu, later: Option<u64>, in_full: bool, context: &Context) {
    let plan = gpu.memory_plan();
    let mib = |bytes: u64| bytes as f64 / f64::from(1 << 20);
    let later = later.map_or(String::new(), |bytes| {
        format!(", then {:.0} MiB for stage 2", mib(bytes))
    });
    context.say(&format!(
        "device   {}: {:.0} MiB in {} buffers{later}, of {:.0} MiB",
        gpu.info().name,
        mib(plan.total),
        plan.buffers.len(),
        mib(plan.budget)
    ));
    if in_full {
        context.say(&plan.to_string());
    }
}

/// About how many times as long as a step of the first stage one of the second takes: at equal rays three quarters (tools/runs/throughput.md).
fn times_as_long(config: &Config) -> f64 {
    0.75 * f64::from(config.stage2.rays) / f64::from(config.rays)
}

/// How long the stages are.
fn in_stages(config: &Config) -> String {
    match config.stage2.steps {
        0 => format!("{} steps", config.steps),
        second => format!("{} steps, then {second} of stage 2", config.steps),
    }
}

fn in_words(region: &Region) -> String {
    let (center, radius) = (region.center, region.radius);
    let shape = match region.shape {
        RegionShape::Sphere => format!("sphere of radius {radius:.4}"),
        RegionShape::Box { half } => {
            let size = 2.0 * radius * half;
            format!("box of {:.4} x {:.4} x {:.4}", size.x, size.y, size.z)
        }
    };
    format!(
        "{shape} about ({:.4}, {:.4}, {:.4}), {}",
        center.x, center.y, center.z, region.how
    )
}

/// A run that is gone on with.
struct Resumed {
    run: RunDirectory,
    latest: Latest,
    /// Settings of all its stages.
    config: Config,
    /// Those of the stage in which it is.
    stage: Config,
    /// Changes to a stage that is over.
    too_late: Vec<Difference>,
}

/// What there is to go on from, under the settings that were asked for now.
fn resumed(args: &TrainArgs, out: &Path) -> Result<Resumed> {
    let run = RunDirectory::open(out)?;
    let latest = checkpoint::latest(&run.checkpoints())?;
    let state = latest.checkpoint.state();
    let mut was = settings_of_all_stages(&run, &state.config)?;
    let first = was.steps;
    let first_is_done = was.first_step == 0 && state.step >= first;
    let refused = |what: String| Err(Error::Config { what });
    match args.settings.stage {
        Some(1) if state.config.first_step > 0 => {
            return refused(format!(
                "--stage 1: the run is in its second, after {} steps of the first\n  next: leave it out",
                state.config.first_step
            ));
        }
        Some(2) if was.first_step == 0 && !first_is_done => {
            return refused(format!(
                "--stage 2: {} of {first} steps of the first stage are done\n  next: go on with that, without --stage",
                state.step
            ));
        }
        // A run that was begun without a second stage now gets its preset's.
        Some(2) if was.first_step == 0 && was.stage2.steps == 0 => {
            was.stage2.steps = Config::preset(&was.preset)?.stage2.steps
        }
        _ => {}
    }
    let mut config = args
        .settings
        .resolve(was.clone())
        .and_then(|config| args.scene.put_into(config))?;
    if first_is_done && config.stage2.steps > 0 {
        // What is done stays as long as it was: all other steps are the second stage's.
        let total = config.total_steps();
        if total <= first {
            return refused(format!(
                "--steps {total}: the first stage is done with its {first} steps, which leaves none for the second\n  next: more --steps, or none to \
                 keep what the run had"
            ));
        }
        (config.steps, config.stage2.steps) = (first, total - first);
    }
    let in_second = state.config.first_step > 0 && config.first_step == 0;
    let stage = match in_second {
        true => config.second_stage().unwrap_or_else(|| config.clone()),
        false => config.clone(),
    };
    let now = state.config.differences(&stage);
    let mut too_late = was.differences(&config);
    too_late.retain(|of_all| {
        in_second && of_all.key != "stage2.steps" && !now.iter().any(|one| one.key == of_all.key)
    });
    Ok(Resumed {
        run,
        latest,
        config,
        stage,
        too_late,
    })
}

/// What the run's first stage was begun with, also when `now`, the settings of its newest checkpoint, are those of its second: flags that it
/// was begun with are given again when it is gone on with, and mean the same.
fn settings_of_all_stages(run: &RunDirectory, now: &Config) -> Result<Config> {
    if now.first_step == 0 {
        return Ok(now.clone());
    }
    let path = run.config();
    let text = fs::read_to_string(&path).map_err(|error| Error::unreadable(&path, &error))?;
    let all = Config::recorded(&text, &path.display().to_string())?;
    let is_before = all.first_step == 0 && all.steps == now.first_step;
    Ok(if is_before { all } else { now.clone() })
}

fn resume(args: &TrainArgs, out: &Path, context: &Context) -> anyhow::Result<Task> {
    let Resumed {
        run,
        latest,
        config,
        stage,
        too_late,
    } = resumed(args, out)?;
    for refused in &latest.refused {
        context.warn(&refused.to_string());
    }
    let state = latest.checkpoint.state();
    let differences = state.config.differences(&stage);
    let refused: Vec<_> = differences
        .iter()
        .filter(|difference| difference.effect == Effect::Incompatible)
        .map(ToString::to_string)
        .collect();
    if !refused.is_empty() {
        return Err(Error::Config {
            what: format!(
                "{}: what was learned does not fit these changed settings:\n  {}\n  next: resume without them, or begin a new run in another --out",
                latest.checkpoint.path().display(),
                refused.join("\n  ")
            ),
        }
        .into());
    }
    let end = stage.first_step + stage.steps;
    if state.step > end {
        return Err(Error::Config {
            what: format!(
                "{} steps are done, and this stage would end with step {end}\n  next: more --steps, or none to keep what the run had",
                state.step
            ),
        }
        .into());
    }
    for difference in &differences {
        match difference.effect {
            Effect::None => context.say(&format!("changed  {difference}")),
            _ => context.warn(&format!(
                "changed setting {difference}: the run goes on differently from how it began"
            )),
        }
    }
    for difference in &too_late {
        context.warn(&format!(
            "changed setting {difference}: without effect, the first stage is over"
        ));
    }
    context.say(&format!(
        "resume   {} of {} steps done, from {}",
        state.step,
        config.total_steps(),
        latest.checkpoint.path().display()
    ));
    let mut record = SceneRecord::load(&run)?;
    let scene = record.open(args.dataset.as_deref(), &config)?;
    if let Some(moved) = &args.dataset {
        record.move_to(moved)?;
    }
    let gpu = context.gpu_with(gpu_options(&config))?;
    let later = later_bytes(&gpu, &scene, &state.region, &stage)?;
    let mut trainer = Trainer::new(&gpu, &scene, &state.region, &stage)?;
    trainer.restore(&latest.checkpoint)?;
    say_device(&gpu, later, args.dry_run, context);
    diagnostics::note_checkpoint(latest.checkpoint.path());
    Ok(Task {
        out: out.into(),
        record,
        config,
        scene,
        trainer,
        resumed: Some(latest.checkpoint.path().into()),
    })
}

impl Task {
    /// A new run into `out`, on a scene that was opened from `dataset`.
    ///
    /// # Errors
    /// Those of [`Trainer::new`] and [`SceneRecord::new`].
    pub fn new(
        gpu: &Gpu,
        dataset: &Path,
        scene: Scene,
        region: &Region,
        config: Config,
        out: &Path,
    ) -> Result<Task> {
        Ok(Task {
            out: out.into(),
            record: SceneRecord::new(dataset, &scene, region)?,
            trainer: Trainer::new(gpu, &scene, region, &config)?,
            config,
            scene,
            resumed: None,
        })
    }

    /// To the end. `force` replaces a run that is there already.
    ///
    /// # Errors
    /// [`Error::Interrupted`] after Ctrl-C, with a checkpoint saved; those of writing the run directory and of [`Trainer::run`].
    pub fn run(mut self, force: bool, context: &Context) -> anyhow::Result<Done> {
        // From here on an interruption is an orderly one.
        let interrupted = interrupt::flag(context, "saving a checkpoint")?;
        let run = match &self.resumed {
            Some(_) => RunDirectory::resume(&self.out)?,
            None => RunDirectory::create(&self.out, force)?,
        };
        run.write(&run.scene(), &self.record.to_json())?;
        run.write(&run.config(), &self.config.to_toml())?;
        let total = self.config.total_steps();
        let mut teller = Teller {
            context,
            log: Log::append(&run.log())?,
            progress: Progress::new(context, "train", total).slower_from(
                total - self.config.stage2.steps,
                times_as_long(&self.config),
            ),
            interrupted: &interrupted,
            note: String::new(),
            failed: None,
            psnr: None,
            checkpoint: self.resumed.clone(),
        };
        if let Some(path) = self.resumed.take() {
            let step = self.trainer.steps_done();
            teller.hear(Event::Resumed { step, path });
        }
        let begun = Instant::now();
        let mut steps_done = self.trainer.steps_done();
        let mut device_bytes = 0;
        let mut trainer = Some(self.trainer);
        let mut outcome = Ok(());
        while let Some(mut stage) = trainer.take() {
            outcome = stage.run(&self.scene, &run, &mut |event| teller.hear(event));
            steps_done = stage.steps_done();
            device_bytes = device_bytes.max(stage.gpu().memory_plan().total);
            if outcome.is_ok() {
                match stage.next_stage(&self.scene, &run) {
                    Ok(next) => trainer = next,
                    Err(error) => outcome = Err(error),
                }
            }
        }
        let Teller {
            failed,
            psnr,
            checkpoint,
            progress,
            ..
        } = teller;
        drop(progress);
        if let Some(error) = failed {
            return Err(error.into());
        }
        if outcome.is_err() {
            context.say(&match &checkpoint {
                Some(path) => format!("kept     {} is the last checkpoint", path.display()),
                None => "kept     nothing: there was no checkpoint of this run yet".into(),
            });
        }
        outcome?;
        Ok(Done {
            run: run.root().into(),
            steps: steps_done,
            took: begun.elapsed(),
            device_bytes,
            preview_psnr: psnr,
            checkpoint,
        })
    }
}

/// Passes a run's events on: to its log, to stderr, and to the progress line.
struct Teller<'t> {
    context: &'t Context,
    log: Log,
    progress: Progress,
    interrupted: &'t AtomicBool,
    /// The last losses, for the progress line.
    note: String,
    /// What the log failed with.
    failed: Option<Error>,
    psnr: Option<f64>,
    checkpoint: Option<PathBuf>,
}

impl Teller<'_> {
    fn hear(&mut self, event: Event) -> Control {
        if let Err(error) = self.log.write(&event) {
            self.failed.get_or_insert(error);
        }
        let text = match &event {
            Event::Advanced { step, .. } => {
                diagnostics::note_step(*step);
                self.progress.at(*step, &self.note);
                return self.answer();
            }
            Event::Step { losses, psnr, .. } => {
                let parts: Vec<String> = losses
                    .parts
                    .iter()
                    .map(|(name, value)| format!("{} {value:.5}", name.replace('_', " ")))
                    .collect();
                self.note = format!(
                    "loss {:.4} ({})  {psnr:.2} dB",
                    losses.total,
                    parts.join(", ")
                );
                String::new()
            }
            Event::Preview {
                step, path, psnr, ..
            } => {
                self.psnr = Some(*psnr);
                format!("preview  step {step}: {psnr:.2} dB, {}", path.display())
            }
            Event::Saved {
                step,
                path,
                seconds,
            } => {
                diagnostics::note_checkpoint(path);
                self.checkpoint = Some(path.clone());
                let took = Duration::from_secs_f64(*seconds);
                format!("saved    step {step}: {} ({took:.1?})", path.display())
            }
            Event::Warning { what, .. } => format!("warning  {what}"),
            _ => String::new(),
        };
        self.context.tell(event.record(), &text);
        self.answer()
    }

    fn answer(&self) -> Control {
        match self.interrupted.load(Ordering::SeqCst) || self.failed.is_some() {
            true => Control::Stop,
            false => Control::Continue,
        }
    }
}
