//! `neurodin bench`: the device's roofs, every kernel against them, and the price of a step by the size of the dictionary.

mod between;

use super::Context;
use super::interrupt::{self, stop_if};
use super::progress::Progress;
use super::scene_args::SceneArgs;
use super::timing::{STOPPED, Timed, Until, time};
use crate::config::Config;
use crate::destination;
use crate::gpu::{DeviceKind, GpuOptions, Roofs, TableRoofs};
use crate::scene::synthetic::SyntheticOptions;
use crate::scene::{Region, Scene};
use crate::train::Trainer;
use crate::train::run_directory::scene_options;
use crate::{Error, Result};
use clap::Args;
use serde_json::{Value, json};
use std::cell::{Cell, RefCell};
use std::fmt::Write;
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;
use std::time::Instant;

/// Measure the device, every kernel, and steps by the size of the dictionary
#[derive(Args)]
#[command(after_help = "\
Example:
  neurodin bench --out bench.json
  neurodin bench --presets outdoor-tiny --sizes 19,22
  neurodin bench --between before.json after.json

It needs no dataset: pictures of the built-in scene are made for it. A software device gets the large presets with 64 rays.
`roof %` is how near a kernel comes to the fastest copy or the fastest arithmetic, whichever is nearer, by what it was said to need.")]
pub(super) struct BenchArgs {
    /// Presets whose steps are timed, both stages of each
    #[arg(
        long,
        value_name = "A,B,..",
        value_delimiter = ',',
        default_value = "outdoor-tiny,outdoor-large,indoor-small"
    )]
    pub presets: Vec<String>,
    /// Dictionaries of outdoor-large whose steps are timed, as powers of two; 0 for none
    #[arg(
        long,
        value_name = "N,M,..",
        value_delimiter = ',',
        default_value = "17,18,19,20,21,22"
    )]
    pub sizes: Vec<u32>,
    /// Rays of the large presets [default: 64 on a software device, else those of the preset]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    pub rays: Option<u32>,
    /// Time for the steps of each preset, stage and size
    #[arg(long, value_name = "S", default_value_t = 10.0, value_parser = seconds)]
    pub seconds: f64,
    /// Write the result as JSON to this file, too
    #[arg(short, long, value_name = "FILE")]
    pub out: Option<PathBuf>,
    /// Replace that file if it exists
    #[arg(long)]
    pub force: bool,
    /// Compare two results instead of measuring
    #[arg(long, num_args = 2, value_names = ["BEFORE", "AFTER"])]
    pub between: Option<Vec<PathBuf>>,
}

/// A time for which steps can be measured.
fn seconds(text: &str) -> Result<f64, String> {
    let seconds = text.parse().map_err(|_| "is not a number".to_string())?;
    match seconds > 0.0 && seconds <= 86_400.0 {
        true => Ok(seconds),
        false => Err("is not in (0, 86400]".into()),
    }
}

impl BenchArgs {
    /// The presets that are measured.
    ///
    /// # Errors
    /// [`Error::Config`] for unknown ones, and for a number of rays that none can have.
    fn presets(&self, rays: Option<u32>) -> Result<Vec<Config>> {
        let presets = self.presets.iter();
        presets
            .map(|name| with_rays(Config::preset(name)?, rays).validated())
            .collect()
    }

    /// outdoor-large with every size of its dictionary that is measured.
    ///
    /// # Errors
    /// [`Error::Config`] for a size that no dictionary can have.
    fn dictionaries(&self, rays: Option<u32>) -> Result<Vec<Config>> {
        let sizes = self.sizes.iter().filter(|size| **size > 0);
        sizes
            .map(|size| {
                let mut config = with_rays(Config::preset("outdoor-large")?, rays);
                config.hash.log2_size = *size;
                config.validated()
            })
            .collect()
    }
}

pub(super) fn run(args: &BenchArgs, context: &Context) -> anyhow::Result<()> {
    if let Some(files) = &args.between {
        let (result, text) = between::compare(&files[0], &files[1])?;
        return Ok(context.result(&result, &text)?);
    }
    // Whatever cannot be is said before anything is measured. Both stages of each preset, and a dictionary's first.
    let measurements = 2 * args.presets(args.rays)?.len() + args.dictionaries(args.rays)?.len();
    if let Some(path) = &args.out {
        destination::check(path, args.force)?;
    }
    let bench = Bench::new(args.seconds, measurements, context)?;
    let gpu = context.gpu()?;
    context.say(&format!("device   {}", gpu.info().name));
    let roofs = gpu.measure_roofs()?;
    context.say(&format!(
        "roofs    copy {:.1} GB/s, multiply-adds {:.1} GFLOP/s",
        roofs.copy_gb_s, roofs.fma_gflop_s
    ));
    let tables = gpu.measure_tables(&[15, 19, 22])?;
    for table in &tables {
        context.say(&format!(
            "table    2^{} entries of 32 bytes: {:.0} M gathered a second, {:.0} M added to",
            table.log2_entries, table.gather_m_s, table.scatter_m_s
        ));
    }
    let rays = args.rays.or(match gpu.info().kind {
        DeviceKind::Cpu => Some(64),
        _ => None,
    });
    let mut presets = Vec::new();
    let mut dictionary = Vec::new();
    // Minutes that were measured are worth having, though not all were.
    let stopped = match bench
        .presets(&args.presets(rays)?, &roofs, &mut presets)
        .and_then(|()| bench.dictionary(&args.dictionaries(rays)?, &roofs, &mut dictionary))
    {
        Err(stopped @ Error::Interrupted { .. }) => Some(stopped),
        outcome => {
            outcome?;
            None
        }
    };
    drop(bench);
    let mut result = json!({
        "version": super::VERSION.as_str(),
        "device": gpu.info().name,
        "driver": gpu.info().driver,
        "incomplete": stopped.is_some(),
        "roofs": { "gb_per_s": roofs.copy_gb_s, "gflop_per_s": roofs.fma_gflop_s },
        "tables": tables.iter().map(table_json).collect::<Vec<_>>(),
        "presets": presets,
    });
    if !dictionary.is_empty() {
        context.say(&with_ratios(&mut dictionary));
    }
    result["dictionary"] = dictionary.into();
    context.result(&result, "")?;
    // What was measured has been said by now, whatever becomes of the file.
    if let Some(path) = &args.out {
        destination::write(path, args.force, |file| writeln!(file, "{result:#}"))?;
    }
    stopped.map_or(Ok(()), |stopped| Err(stopped.into()))
}

/// The rows of the dictionary as a table, and in each its ratio to the one at 2^19.
fn with_ratios(rows: &mut [Value]) -> String {
    let of = |row: &Value, key: &str| row[key].as_f64().unwrap_or(f64::NAN);
    let base = rows.iter().find(|row| row["log2_size"] == 19);
    let base = base.map(|row| [of(row, "cpu_ms_per_step"), of(row, "device_ms_per_step")]);
    let mut text =
        String::from("\nstage 1 by dictionary   CPU ms    ratio   device ms    ratio        MiB\n");
    for row in rows {
        let times = [of(row, "cpu_ms_per_step"), of(row, "device_ms_per_step")];
        let ratios = base.map(|base| [times[0] / base[0], times[1] / base[1]]);
        let shown = |ratio: Option<f64>| ratio.map_or("-".into(), |r| format!("{r:.3}"));
        let _ = writeln!(
            text,
            "2^{:<20} {:>8.1} {:>8} {:>11.1} {:>8} {:>10.0}",
            row["log2_size"],
            times[0],
            shown(ratios.map(|r| r[0])),
            times[1],
            shown(ratios.map(|r| r[1])),
            of(row, "device_bytes") / f64::from(1 << 20)
        );
        row["ratio_of_cpu_ms"] = ratios.map(|r| r[0]).into();
        row["ratio_of_device_ms"] = ratios.map(|r| r[1]).into();
    }
    text
}

fn table_json(table: &TableRoofs) -> Value {
    json!({
        "log2_entries": table.log2_entries,
        "gather_m_per_s": table.gather_m_s,
        "scatter_m_per_s": table.scatter_m_s,
    })
}

/// What steps are taken on: pictures of the built-in scene, in a folder that goes with it.
struct Bench<'c> {
    context: &'c Context,
    folder: PathBuf,
    interrupted: std::sync::Arc<AtomicBool>,
    seconds: f64,
    /// In seconds of steps.
    progress: RefCell<Progress>,
    measured: Cell<f64>,
}

impl Drop for Bench<'_> {
    fn drop(&mut self) {
        // What is left of it would be a nuisance, not a fault.
        let _ = std::fs::remove_dir_all(&self.folder);
    }
}

/// Steps that are not timed: the first ones compile the kernels.
const WARMUP: u64 = 3;

impl<'c> Bench<'c> {
    fn new(seconds: f64, measurements: usize, context: &'c Context) -> anyhow::Result<Bench<'c>> {
        let folder = std::env::temp_dir().join(format!("neurodin-bench-{}", std::process::id()));
        let total = (seconds * measurements as f64).ceil() as u64;
        let bench = Bench {
            context,
            interrupted: interrupt::flag(context, "stopping")?,
            seconds,
            folder,
            progress: RefCell::new(Progress::new(context, "bench", total)),
            measured: Cell::new(0.0),
        };
        let pictures = SyntheticOptions {
            train_views: 12,
            test_views: 1,
            width: 160,
            height: 120,
            reference_spacing: 0.5,
        };
        pictures.write(&bench.folder, &mut |_, _, _| {})?;
        Ok(bench)
    }

    /// Both stages of each preset, added to `measured` as they come.
    fn presets(&self, presets: &[Config], roofs: &Roofs, measured: &mut Vec<Value>) -> Result<()> {
        for first in presets {
            let second = first.second_stage();
            for (stage, config) in std::iter::once(first).chain(&second).enumerate() {
                let (name, stage) = (&first.preset, stage + 1);
                let what = format!("{name}, stage {stage}, {} rays", config.rays);
                let (timed, device_bytes) = self.time(config, &what)?;
                self.context
                    .say(&format!("\n{what}\n{}", timed.text(roofs)));
                let mut result = timed.to_json(roofs);
                result["preset"] = name.as_str().into();
                result["stage"] = stage.into();
                result["rays"] = config.rays.into();
                result["device_bytes"] = device_bytes.into();
                measured.push(result);
            }
        }
        Ok(())
    }

    /// Steps of outdoor-large by the size of its dictionary, both stages with as many rays, added to `rows` as they come.
    fn dictionary(&self, sizes: &[Config], roofs: &Roofs, rows: &mut Vec<Value>) -> Result<()> {
        for config in sizes {
            let log2_size = config.hash.log2_size;
            let what = format!("outdoor-large at 2^{log2_size}, {} rays", config.rays);
            match self.time(config, &what) {
                Ok((timed, device_bytes)) => {
                    let mut row = timed.to_json(roofs);
                    row["log2_size"] = log2_size.into();
                    row["device_bytes"] = device_bytes.into();
                    rows.push(row);
                }
                // A size that does not fit is an answer.
                Err(Error::OutOfMemory { what }) => {
                    self.context.warn(&format!("2^{log2_size}: {what}"));
                }
                Err(error) => return Err(error),
            }
        }
        Ok(())
    }

    /// Times steps of one configuration; also says how much device memory it takes.
    fn time(&self, config: &Config, what: &str) -> Result<(Timed, u64)> {
        let gpu = self.context.gpu_with(GpuOptions {
            profile: true,
            ..GpuOptions::default()
        })?;
        let scene = Scene::open(&self.folder, &scene_options(config))?;
        let region = Region::estimate(&scene, &SceneArgs::default().region(config))?;
        let mut trainer = Trainer::new(&gpu, &scene, &region, config)?;
        let start = Instant::now();
        let timed = time(
            &gpu,
            &mut trainer,
            WARMUP,
            Until::Seconds(self.seconds),
            &mut |_| {
                let seconds = start.elapsed().as_secs_f64().min(self.seconds);
                let done = self.measured.get() + seconds;
                self.progress.borrow_mut().at(done as u64, what);
                stop_if(&self.interrupted, STOPPED)
            },
        )?;
        self.measured.set(self.measured.get() + self.seconds);
        Ok((timed, gpu.memory_plan().total))
    }
}

/// The large presets' batches are for GPUs.
fn with_rays(config: Config, rays: Option<u32>) -> Config {
    let mut config = config;
    if let Some(rays) = rays.filter(|_| !config.preset.contains("tiny")) {
        config.rays = rays;
        config.stage2.rays = rays;
    }
    config
}

/// Reads a result that `--out` wrote.
fn read(path: &Path) -> Result<Value> {
    let data = std::fs::read(path).map_err(|error| Error::unreadable(path, &error))?;
    serde_json::from_slice(&data)
        .ok()
        .filter(|value: &Value| value["presets"].is_array())
        .ok_or_else(|| {
            Error::input(
                path,
                "is no result of a bench",
                "name a file that `neurodin bench --out` wrote",
            )
        })
}
