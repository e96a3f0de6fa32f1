//! `neurodin profile`: where the time of a training step goes, kernel by kernel.

use super::Context;
use super::chosen::{Chosen, gpu_options, open_scene};
use super::interrupt::{self, stop_if};
use super::progress::Progress;
use super::scene_args::SceneArgs;
use super::settings::SettingsArgs;
use super::timing::{STOPPED, Until, time};
use crate::Error;
use crate::destination;
use crate::gpu::{GpuOptions, Profile};
use crate::train::Trainer;
use clap::Args;
use serde_json::{Value, json};
use std::io::{self, Write};
use std::path::PathBuf;

/// Time every kernel of some training steps
#[derive(Args)]
#[command(after_help = "\
Example:
  neurodin profile photos/ --preset outdoor-tiny --steps 50
  neurodin profile photos/ --preset outdoor-large --stage 2 --steps 20 --trace trace.json

The trace opens in chrome://tracing and ui.perfetto.dev. Shares of the roofs compare what a kernel was said to need
with the fastest copy and the fastest arithmetic that were measured on the device.")]
pub(super) struct ProfileArgs {
    /// Directory of the dataset, its transforms.json, meta_data.json or cameras_sphere.npz, or the directory of a COLMAP model
    pub dataset: PathBuf,
    /// Write a Chrome trace of the timed steps to this file
    #[arg(long, value_name = "FILE")]
    pub trace: Option<PathBuf>,
    /// Steps before timing begins
    #[arg(long, value_name = "N", default_value_t = 10)]
    pub warmup: u64,
    /// Replace the trace if it exists
    #[arg(long)]
    pub force: bool,
    #[command(flatten)]
    pub settings: SettingsArgs,
    #[command(flatten)]
    pub scene: SceneArgs,
}

/// Steps that are timed unless it is said otherwise.
const STEPS: u64 = 50;

pub(super) fn run(args: &ProfileArgs, context: &Context) -> anyhow::Result<()> {
    if let Some(trace) = &args.trace {
        destination::check(trace, args.force)?;
    }
    // --steps is how many are timed; the run that they are the beginning of keeps its length.
    let steps = args.settings.steps.unwrap_or(STEPS);
    if steps == 0 {
        return Err(Error::Config {
            what: "--steps 0: at least one step must be timed".into(),
        }
        .into());
    }
    let settings = SettingsArgs {
        steps: None,
        ..args.settings.clone()
    };
    let scene = open_scene(&settings, &args.scene, &args.dataset)?;
    let chosen = Chosen::of(&settings, &args.scene, &scene)?;
    let config = chosen.config;
    let config = match args.settings.stage {
        Some(2) => config.second_stage().ok_or_else(|| Error::Config {
            what: "stage2.steps = 0: there is no second stage to time".into(),
        })?,
        _ => config,
    };
    let gpu = context.gpu_with(GpuOptions {
        profile: true,
        ..gpu_options(&config)
    })?;
    context.say(&format!("preset   {}{}", config.preset, chosen.why));
    context.say(&format!("device   {}", gpu.info().name));
    let roofs = gpu.measure_roofs()?;
    let mut trainer = Trainer::new(&gpu, &scene, &chosen.region, &config)?;
    let interrupted = interrupt::flag(context, "stopping")?;
    let mut progress = Progress::new(context, "profile", config.first_step + args.warmup + steps);
    let timed = time(
        &gpu,
        &mut trainer,
        args.warmup,
        Until::Steps(steps),
        &mut |step| {
            progress.at(step, "");
            stop_if(&interrupted, STOPPED)
        },
    )?;
    drop(progress);
    let mut result = json!({
        "device": gpu.info().name,
        "preset": config.preset,
        "roofs": { "gb_per_s": roofs.copy_gb_s, "gflop_per_s": roofs.fma_gflop_s },
        "trace": args.trace,
    });
    if let (Some(result), Value::Object(times)) = (result.as_object_mut(), timed.to_json(&roofs)) {
        result.extend(times);
    }
    context.result(&result, &timed.text(&roofs))?;
    // What was measured has been said by now, whatever becomes of the file.
    if let Some(path) = &args.trace {
        destination::write(path, args.force, |file| {
            write_trace(file, &timed.profile, &gpu.info().name)
        })?;
    }
    Ok(())
}

/// Chrome's trace format: one complete event ("X") a launch, in microseconds.
fn write_trace(file: &mut dyn Write, profile: &Profile, device: &str) -> io::Result<()> {
    let named = json!({ "ph": "M", "pid": 0, "name": "process_name", "args": { "name": device } });
    write!(file, "{{\"traceEvents\":[\n{named}")?;
    for event in &profile.events {
        let line = json!({
            "ph": "X", "pid": 0, "tid": 0, "name": &*event.row, "cat": &*event.call,
            "ts": event.begin_ns as f64 * 1e-3, "dur": (event.end_ns - event.begin_ns) as f64 * 1e-3,
        });
        write!(file, ",\n{line}")?;
    }
    writeln!(file, "\n]}}")
}
