//! `neurodin profile`: where the time of a training step goes, kernel by kernel.

use super::progress::Progress;
use super::scene_args::SceneArgs;
use super::settings::SettingsArgs;
use super::train::{configure, open_scene, region_wanted};
use super::{Context, interrupt};
use crate::gpu::{GpuOptions, Profile, ProfileRow, Roofs};
use crate::scene::Region;
use crate::train::Trainer;
use crate::{Error, Result};
use clap::Args;
use cpu_time::ProcessTime;
use serde_json::{Value, json};
use std::fmt::Write as _;
use std::fs::File;
use std::io::{BufWriter, Write as _};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

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
    if let Some(trace) = args
        .trace
        .as_ref()
        .filter(|trace| trace.exists() && !args.force)
    {
        return Err(Error::output(
            trace,
            "exists already",
            "name another file, or replace it with --force",
        )
        .into());
    }
    // --steps is how many are timed; the run that they are the beginning of keeps its length.
    let steps = args.settings.steps.unwrap_or(STEPS).max(1);
    let settings = SettingsArgs {
        steps: None,
        ..args.settings.clone()
    };
    let scene = open_scene(&settings, &args.scene, &args.dataset)?;
    let chosen = configure(&settings, &args.scene, &scene)?;
    let config = chosen.config;
    let config = match args.settings.stage {
        Some(2) => config.second_stage().ok_or_else(|| Error::Config {
            what: "stage2.steps = 0: there is no second stage to time".into(),
        })?,
        _ => config,
    };
    let region = Region::estimate(&scene, &region_wanted(&args.scene, &config))?;
    let gpu = context.gpu_with(GpuOptions {
        profile: true,
        ..GpuOptions::default()
    })?;
    context.say(&format!("preset   {}{}", config.preset, chosen.why));
    context.say(&format!("device   {}", gpu.info().name));
    let roofs = gpu.measure_roofs()?;
    let mut trainer = Trainer::new(&gpu, &scene, &region, &config)?;
    let interrupted = interrupt::flag("stopping")?;
    let mut progress = Progress::new(context, "profile", config.first_step + args.warmup + steps);
    let mut take = |trainer: &mut Trainer, count: u64| -> Result<()> {
        for _ in 0..count {
            trainer.step()?;
            progress.at(trainer.steps_done(), "");
            stop_if(&interrupted)?;
        }
        trainer.finish()?;
        Ok(())
    };
    take(&mut trainer, args.warmup)?;
    gpu.reset_profile()?;
    let (begun, cpu_begun) = (Instant::now(), ProcessTime::now());
    take(&mut trainer, steps)?;
    let times = Times {
        steps: steps as f64,
        wall_ms: begun.elapsed().as_secs_f64() * 1e3,
        cpu_ms: cpu_begun.elapsed().as_secs_f64() * 1e3,
    };
    drop(progress);
    let profile = gpu.profile()?;
    if let Some(path) = &args.trace {
        write_trace(path, &profile, &gpu.info().name)?;
    }
    let result = json!({
        "device": gpu.info().name,
        "preset": config.preset,
        "steps": steps,
        "wall_ms_per_step": times.wall_ms / times.steps,
        "cpu_ms_per_step": times.cpu_ms / times.steps,
        "device_ms_per_step": device_ms(&profile) / times.steps,
        "coverage": device_ms(&profile) / times.wall_ms,
        "roofs": { "gb_per_s": roofs.copy_gb_s, "gflop_per_s": roofs.fma_gflop_s },
        "rows": profile.rows.iter().map(|row| as_json(row, &profile, &roofs)).collect::<Vec<_>>(),
        "trace": args.trace,
    });
    Ok(context.result(&result, &as_text(&profile, &roofs, &times))?)
}

/// What the timed steps took together.
struct Times {
    steps: f64,
    wall_ms: f64,
    /// Of all threads of this process: on a software device, the price of the steps; on a GPU, that of driving it.
    cpu_ms: f64,
}

fn stop_if(interrupted: &AtomicBool) -> Result<()> {
    match interrupted.load(Ordering::SeqCst) {
        true => Err(Error::Interrupted {
            what: "profiling stopped".into(),
        }),
        false => Ok(()),
    }
}

/// All rows together.
fn device_ms(profile: &Profile) -> f64 {
    profile.rows.iter().map(|row| row.total_ms).sum()
}

/// 10⁹ units a second.
fn giga_per_s(units: f64, ms: f64) -> f64 {
    if ms > 0.0 { units / ms * 1e-6 } else { 0.0 }
}

fn as_json(row: &ProfileRow, profile: &Profile, roofs: &Roofs) -> Value {
    let (bytes, flops) = (
        giga_per_s(row.bytes, row.total_ms),
        giga_per_s(row.flops, row.total_ms),
    );
    json!({
        "name": row.name,
        "launches": row.launches,
        "total_ms": row.total_ms,
        "share": row.total_ms / device_ms(profile),
        "min_ms": row.min_ms,
        "median_ms": row.median_ms,
        "max_ms": row.max_ms,
        "gb_per_s": bytes,
        "gflop_per_s": flops,
        "share_of_copy_roof": bytes / roofs.copy_gb_s,
        "share_of_arithmetic_roof": flops / roofs.fma_gflop_s,
    })
}

fn as_text(profile: &Profile, roofs: &Roofs, times: &Times) -> String {
    let total = device_ms(profile);
    let width = profile
        .rows
        .iter()
        .map(|row| row.name.len())
        .max()
        .unwrap_or(0);
    let mut text = format!(
        "{:<width$} {:>8} {:>10} {:>6} {:>9} {:>9} {:>9} {:>8} {:>9}\n",
        "kernel", "launches", "ms", "%", "min ms", "median ms", "max ms", "GB/s", "GFLOP/s"
    );
    for row in &profile.rows {
        let _ = writeln!(
            text,
            "{:<width$} {:>8} {:>10.2} {:>6.2} {:>9.4} {:>9.4} {:>9.4} {:>8.2} {:>9.2}",
            row.name,
            row.launches,
            row.total_ms,
            100.0 * row.total_ms / total,
            row.min_ms,
            row.median_ms,
            row.max_ms,
            giga_per_s(row.bytes, row.total_ms),
            giga_per_s(row.flops, row.total_ms),
        );
    }
    let Times {
        steps,
        wall_ms,
        cpu_ms,
    } = times;
    let _ = write!(
        text,
        "{steps} steps: {:.2} ms each on the device, {:.2} ms on the clock ({:.1} % covered), {:.2} ms of CPU time; roofs {:.1} GB/s, {:.1} GFLOP/s",
        total / steps,
        wall_ms / steps,
        100.0 * total / wall_ms,
        cpu_ms / steps,
        roofs.copy_gb_s,
        roofs.fma_gflop_s
    );
    text
}

/// Chrome's trace format: one complete event ("X") a launch, in microseconds.
fn write_trace(path: &Path, profile: &Profile, device: &str) -> Result<()> {
    let write = || -> std::io::Result<()> {
        let mut file = BufWriter::new(File::create(path)?);
        let named =
            json!({ "ph": "M", "pid": 0, "name": "process_name", "args": { "name": device } });
        write!(file, "{{\"traceEvents\":[\n{named}")?;
        for event in &profile.events {
            let line = json!({
                "ph": "X", "pid": 0, "tid": 0, "name": &*event.row, "cat": &*event.call,
                "ts": event.begin_ns as f64 * 1e-3, "dur": (event.end_ns - event.begin_ns) as f64 * 1e-3,
            });
            write!(file, ",\n{line}")?;
        }
        writeln!(file, "\n]}}")?;
        file.flush()
    };
    write().map_err(|error| {
        Error::output(
            path,
            format!("cannot be written: {error}"),
            "make room or mend the permissions there",
        )
    })
}
