//! `neurodin demo`: the built-in scene from photographs to a scored mesh and a report about it, on this machine.
//!
//! Every stage is what a user's own photographs go through: a dataset on disk, a run directory, a mesh file. Only the surface is known
//! here, so that the mesh can be scored against the truth.

pub mod report;
mod summary;

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;
use std::time::Instant;

use clap::Args;
use serde_json::json;

use super::chosen::gpu_options;
use super::eval::pictures;
use super::mesh::{self, MeshArgs};
use super::progress::Progress;
use super::render::Which;
use super::scene_args::SceneArgs;
use super::timing::{Timed, Until, time};
use super::train::Task;
use super::{Context, interrupt};
use crate::config::Config;
use crate::eval::{self, GeometryOptions, GeometryScores, Reference};
use crate::gpu::{DeviceInfo, GpuOptions};
use crate::mesh::{Mesh, read_mesh};
use crate::render::Rendered;
use crate::scene::synthetic::{self, SyntheticDataset, SyntheticOptions};
use crate::scene::{Picture, Region, Scene, Split, View};
use crate::train::Trainer;
use crate::train::run_directory::{RunDirectory, scene_options};
use crate::{Error, Result};

/// Reconstruct the built-in scene and report on it
#[derive(Args)]
#[command(after_help = "\
Example:
  neurodin demo
  neurodin demo --out tour --steps 10000
  neurodin demo --minutes 2 --resolution 256

Writes to the output directory: dataset/ (photographs, cameras, ground truth), run/ (settings, log, previews, checkpoints),
mesh.ply, scores.json, pictures/, report.html, and demo.txt, by which --force knows that they are a demo's.")]
pub(super) struct DemoArgs {
    /// Directory to write
    #[arg(short, long, value_name = "DIR", default_value = "demo-out")]
    pub out: PathBuf,
    /// Training steps [default: what fits into the time, at most those of the preset]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    pub steps: Option<u64>,
    /// Time for training
    #[arg(long, value_name = "M", default_value_t = 4.0, value_parser = minutes, conflicts_with = "steps")]
    pub minutes: f64,
    /// Seed of every random number of the training
    #[arg(long, value_name = "N")]
    pub seed: Option<u32>,
    /// Photographs to train on
    #[arg(long, value_name = "N", default_value_t = 48, value_parser = clap::value_parser!(u32).range(2..=1000))]
    pub views: u32,
    /// Width of the photographs in pixels; they are three quarters as high
    #[arg(long, value_name = "PIXELS", default_value_t = 240, value_parser = clap::value_parser!(u32).range(16..=4096))]
    pub width: u32,
    /// Cells of the mesh along the longest side of the region
    #[arg(long, value_name = "N", default_value_t = 512, value_parser = clap::value_parser!(u32).range(32..=4096))]
    pub resolution: u32,
    /// Replace what a former demo wrote to the directory
    #[arg(long)]
    pub force: bool,
}

fn minutes(text: &str) -> Result<f64, String> {
    match text.parse() {
        Ok(minutes) if (0.1..=1440.0).contains(&minutes) => Ok(minutes),
        _ => Err("expected minutes from 0.1 to 1440".into()),
    }
}

const PRESET: &str = "outdoor-tiny";
/// Steps before and while kernels are timed.
const WARMUP: u64 = 3;
const TIMED: u64 = 16;
/// A run is a multiple of this many steps, and at least as many.
const STEP_GRAIN: u64 = 50;
/// Distances at which the mesh is scored, as shares of the scene's radius.
const THRESHOLDS: [f64; 3] = [0.005, 0.01, 0.02];

/// All that the report is made of.
pub(super) struct Outcome {
    dataset: SyntheticDataset,
    config: Config,
    device: DeviceInfo,
    /// Some steps before the training, kernel by kernel.
    timed: Timed,
    views: Vec<Seen>,
    mesh: Mesh,
    scores: GeometryScores,
    /// Stage and seconds.
    stages: Vec<(String, f64)>,
    /// The training's log, as written.
    log: String,
}

/// A held-out view: the photograph, what the field shows there, and how alike they are.
pub(super) struct Seen {
    name: String,
    picture: Picture,
    rendered: Rendered,
    psnr: f64,
    ssim: f64,
}

pub(super) fn run(args: &DemoArgs, context: &Context) -> anyhow::Result<()> {
    let mut demo = Demo::begin(args, context)?;
    let dataset = demo.stage("photographs", Demo::photographs)?;
    let config = demo.config()?;
    let scene = Scene::open(&dataset.root, &scene_options(&config))?;
    let region = Region::estimate(&scene, &SceneArgs::default().region(&config))?;
    // A few timed steps say where the time goes, and how many steps fit into it.
    let timed = demo.stage("timing", |demo| demo.timing(&scene, &region, &config))?;
    let config = demo.with_steps(config, 1e-3 * timed.wall_ms / timed.steps as f64)?;
    // What `neurodin train`, `mesh` and `eval` do.
    let device = demo.stage("training", |demo| {
        demo.training(scene.clone(), &region, &config, &dataset)
    })?;
    let mesh = demo.stage("mesh", Demo::mesh)?;
    let views = demo.stage("held-out views", Demo::views)?;
    let scores = demo.stage("scores", |_| scores(&mesh, &dataset, &scene))?;
    let outcome = Outcome {
        device,
        log: demo.log()?,
        timed,
        dataset,
        config,
        views,
        mesh,
        scores,
        stages: Vec::new(),
    };
    demo.report(outcome)
}

/// A demonstration on its way.
struct Demo<'c> {
    args: &'c DemoArgs,
    context: &'c Context,
    interrupted: std::sync::Arc<AtomicBool>,
    began: Instant,
    /// Stage and seconds, as they end.
    stages: Vec<(String, f64)>,
}

impl<'c> Demo<'c> {
    /// Refuses an output that is in the way before anything takes time.
    fn begin(args: &'c DemoArgs, context: &'c Context) -> anyhow::Result<Demo<'c>> {
        let out = &args.out;
        let occupied =
            fs::read_dir(out).map_or(out.exists(), |mut entries| entries.next().is_some());
        if occupied {
            if !args.force || !out.join(MARKER).is_file() {
                return Err(Error::output(
                    out,
                    "exists already",
                    "give another --out, or replace a former demo's with --force",
                )
                .into());
            }
            // Nothing is removed before there is a device to make it again, nor while another demo is at work there.
            context.gpu()?;
            let run = out.join(RUN);
            if RunDirectory::open(&run).is_ok() {
                RunDirectory::resume(&run)?;
            }
            for entry in [DATASET, RUN, PICTURES] {
                let path = out.join(entry);
                if path.exists() {
                    fs::remove_dir_all(&path).map_err(|e| Error::unwritable(path, &e))?;
                }
            }
        }
        fs::create_dir_all(out).map_err(|e| Error::unwritable(out, &e))?;
        let says = "Made by neurodin demo, which replaces its own files and folders here when given --force.\n";
        write_file(&out.join(MARKER), says.as_bytes())?;
        Ok(Demo {
            args,
            context,
            interrupted: interrupt::flag(context, "stopping")?,
            began: Instant::now(),
            stages: Vec::new(),
        })
    }

    /// Runs one stage and notes how long it took.
    fn stage<T>(
        &mut self,
        name: &str,
        work: impl FnOnce(&mut Self) -> anyhow::Result<T>,
    ) -> anyhow::Result<T> {
        self.context.say(&format!("\n{name}"));
        let begun = Instant::now();
        let result = work(self)?;
        self.stages
            .push((name.into(), begun.elapsed().as_secs_f64()));
        Ok(result)
    }

    /// [`Error::Interrupted`] once Ctrl-C was pressed.
    fn check(&self) -> Result<()> {
        let what = format!(
            "stopped; what was done so far is in {}",
            self.args.out.display()
        );
        interrupt::stop_if(&self.interrupted, &what)
    }

    fn photographs(&mut self) -> anyhow::Result<SyntheticDataset> {
        let options = SyntheticOptions {
            train_views: self.args.views as usize,
            test_views: (self.args.views as usize / 8).clamp(2, 6),
            width: self.args.width,
            height: self.args.width * 3 / 4,
            ..SyntheticOptions::default()
        };
        let mut shown: Option<(String, Progress)> = None;
        let dataset = options.write(&self.args.out.join(DATASET), &mut |what, done, total| {
            if shown.as_ref().is_none_or(|(before, _)| before != what) {
                // The bar of the part before goes first.
                shown = None;
                shown = Some((what.into(), Progress::new(self.context, what, total as u64)));
            }
            if let Some((_, progress)) = &mut shown {
                progress.at(done as u64, "");
            }
        })?;
        drop(shown);
        self.context.say(&format!(
            "{} + {} photographs of {}×{} pixels, and {} points of the exact surface, in {}",
            dataset.train.len(),
            dataset.test.len(),
            options.width,
            options.height,
            dataset.reference_points,
            dataset.root.display()
        ));
        self.check()?;
        Ok(dataset)
    }

    fn config(&self) -> Result<Config> {
        let config = Config::preset(PRESET)?;
        match self.args.seed {
            Some(seed) => config.with_assignment(&format!("seed={seed}")),
            None => Ok(config),
        }
    }

    /// Trains for a few steps that are thrown away: the first ones compile the kernels, the others are timed, kernel by kernel.
    fn timing(&mut self, scene: &Scene, region: &Region, config: &Config) -> anyhow::Result<Timed> {
        let gpu = self.context.gpu_with(GpuOptions {
            profile: true,
            ..gpu_options(config)
        })?;
        self.context.say(&format!("device   {}", gpu.info().name));
        let mut trainer = Trainer::new(&gpu, scene, region, config)?;
        let mut progress = Progress::new(self.context, "timing", WARMUP + TIMED);
        let timed = time(
            &gpu,
            &mut trainer,
            WARMUP,
            Until::Steps(TIMED),
            &mut |step| {
                let note = match step <= WARMUP {
                    true => "the device compiles the kernels",
                    false => "",
                };
                progress.at(step, note);
                self.check()
            },
        )?;
        drop(progress);
        self.context.say(&format!(
            "{:.1} ms a step",
            timed.wall_ms / timed.steps as f64
        ));
        Ok(timed)
    }

    /// As many steps as were asked for, or as fit into the time.
    fn with_steps(&self, config: Config, seconds_per_step: f64) -> Result<Config> {
        let steps = self.args.steps.unwrap_or_else(|| {
            let fit = (60.0 * self.args.minutes / seconds_per_step) as u64;
            (fit / STEP_GRAIN * STEP_GRAIN).clamp(STEP_GRAIN, config.steps)
        });
        self.context.say(&format!(
            "{steps} steps will take about {}",
            report::duration(steps as f64 * seconds_per_step)
        ));
        // A curve of some ten looks at the held-out view, small ones, since each costs as much as many steps.
        config
            .with_assignment(&format!("steps={steps}"))?
            .with_assignment("stage2.steps=0")?
            .with_assignment(&format!("report.preview_steps={}", (steps / 10).max(50)))?
            .with_assignment("report.preview_pixels=12000")?
            .with_assignment(&format!("report.log_steps={}", (steps / 400).max(1)))
    }

    /// A run directory as `neurodin train` makes it; the device that it was trained on.
    fn training(
        &mut self,
        scene: Scene,
        region: &Region,
        config: &Config,
        dataset: &SyntheticDataset,
    ) -> anyhow::Result<DeviceInfo> {
        let gpu = self.context.gpu_with(gpu_options(config))?;
        let run = self.args.out.join(RUN);
        let task = Task::new(&gpu, &dataset.root, scene, region, config.clone(), &run)?;
        task.run(false, self.context)?;
        Ok(gpu.info().clone())
    }

    /// `mesh.ply` of the part of the region that the photographs are about.
    fn mesh(&mut self) -> anyhow::Result<Mesh> {
        let run = self.args.out.join(RUN);
        let [low, high] = [-synthetic::RADIUS, synthetic::RADIUS]
            .map(|offset| (synthetic::CENTER + offset).to_array());
        let wanted = MeshArgs {
            run: run.clone(),
            out: Some(self.args.out.join(MESH)),
            resolution: self.args.resolution,
            crop: Some([low[0], low[1], low[2], high[0], high[1], high[2]]),
            force: self.args.force,
            ..MeshArgs::default()
        };
        let written = mesh::take(&wanted, self.context)?.ok_or_else(|| mesh::no_surface(&run))?;
        self.context.say(&written.text());
        Ok(written.mesh)
    }

    /// Renders every held-out view at its photograph's size.
    fn views(&mut self) -> anyhow::Result<Vec<Seen>> {
        let run = self.args.out.join(RUN);
        let mut pairs = Vec::new();
        let scores = pictures::score(
            &run,
            None,
            Which::Test,
            None,
            self.context,
            &mut |rendered, picture| pairs.push((rendered, picture)),
        )?;
        let seen = scores.views.into_iter().zip(pairs);
        Ok(seen
            .map(|(score, (rendered, picture))| Seen {
                name: score.name,
                psnr: score.psnr,
                ssim: score.ssim.unwrap_or(f64::NAN),
                picture,
                rendered,
            })
            .collect())
    }

    fn log(&self) -> Result<String> {
        let path = RunDirectory::open(&self.args.out.join(RUN))?.log();
        fs::read_to_string(&path).map_err(|e| Error::unreadable(path, &e))
    }

    /// Writes the pictures, `scores.json` and `report.html`, and says what came out.
    fn report(mut self, mut outcome: Outcome) -> anyhow::Result<()> {
        let out = &self.args.out;
        self.context.say("\nreport");
        let begun = Instant::now();
        let pictures = summary::Pictures::of(&outcome.mesh);
        self.stages
            .push(("report".into(), begun.elapsed().as_secs_f64()));
        outcome.stages = std::mem::take(&mut self.stages);
        let seconds = self.began.elapsed().as_secs_f64();

        let page = out.join("report.html");
        let folder = out.join(PICTURES);
        fs::create_dir_all(&folder).map_err(|e| Error::unwritable(&folder, &e))?;
        for (name, picture) in pictures.named() {
            write_file(&folder.join(name), &picture.png())?;
        }
        let scores = summary::as_json(&outcome, seconds);
        write_file(&out.join("scores.json"), format!("{scores:#}\n").as_bytes())?;
        write_file(
            &page,
            summary::report(&outcome, pictures, seconds, out)
                .html()
                .as_bytes(),
        )?;

        let mut result = json!({ "report": page, "mesh": out.join(MESH), "run": out.join(RUN), "dataset": outcome.dataset.root });
        if let (Some(result), serde_json::Value::Object(scores)) = (result.as_object_mut(), scores)
        {
            result.extend(scores);
        }
        let text = format!(
            "{}\ndone in {}; look at {}",
            summary::as_text(&outcome),
            report::duration(seconds),
            page.display()
        );
        Ok(self.context.result(&result, &text)?)
    }
}

/// By this file a folder is known as a demo's: what lies beside it may be replaced.
const MARKER: &str = "demo.txt";
const DATASET: &str = "dataset";
const RUN: &str = "run";
const MESH: &str = "mesh.ply";
const PICTURES: &str = "pictures";

/// The mesh against the exact surface; what no training camera sees does not count.
fn scores(
    mesh: &Mesh,
    dataset: &SyntheticDataset,
    scene: &Scene,
) -> anyhow::Result<GeometryScores> {
    let reference = Reference::from_mesh(read_mesh(&dataset.reference)?);
    let cameras: Vec<View> = scene
        .split(Split::Train)
        .map(|view| scene.views[view].clone())
        .collect();
    let options = GeometryOptions {
        samples: 200_000,
        seed: 0,
        thresholds: THRESHOLDS.map(|share| share * synthetic::RADIUS).to_vec(),
        trim: 0.05 * synthetic::RADIUS,
        crop: None,
        min_views: 1,
        hidden_by: 0.001 * synthetic::RADIUS,
    };
    Ok(eval::score_geometry(
        mesh,
        &reference,
        Some(&cameras),
        &options,
    )?)
}

fn write_file(path: &Path, bytes: &[u8]) -> Result<()> {
    fs::write(path, bytes).map_err(|error| Error::unwritable(path, &error))
}
