//! `neurodin compare`: several methods on one dataset under equal budgets, as one table.

mod report;
mod table;

use super::Context;
use super::eval::{self, EvalArgs, pictures::score};
use super::mesh::{self, MeshArgs, NO_SURFACE};
use super::render::Which;
use super::scene_args::{SceneArgs, numbers};
use super::settings::SettingsArgs;
use super::study::{Planned, Study};
use crate::config::{AppearanceAtEval, Config, METHODS};
use crate::destination;
use crate::mesh::{Mesh, read_mesh};
use crate::picture::Rgb;
use crate::picture::surface::{Eye, Lens, Visible, clay, sun_eye};
use crate::scene::{Camera, Region, Scene, Split};
use crate::train::run_directory::RunDirectory;
use crate::{Error, Result};
use clap::Args;
use glam::{DMat4, dvec2};
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};
use std::fs;
use std::path::{Path, PathBuf};
use table::Table;

/// Train and score several methods on one dataset
#[derive(Args)]
#[command(after_help = "\
Example:
  neurodin compare photos/ --out study --methods neurodin,neus-grid,ablation-c --steps 2000
  neurodin compare photos/ --out study --methods all --steps 4000 --seeds 3 --reference scan.ply --report compare.html

Each method and seed becomes a run in --out, with its mesh and scores.json. What is there already is taken as it is, so that the same
command goes on where it was stopped; with another reference or resolution it is scored again, with other settings it is refused.
A method that runs out of memory or of finite numbers leaves its place in the table empty, and is tried again the next time. The methods are those of `neurodin train --help`, at --method.")]
pub(super) struct CompareArgs {
    /// Dataset to train on
    pub dataset: PathBuf,
    /// Directory for the runs
    #[arg(short, long, value_name = "DIR")]
    pub out: PathBuf,
    /// Methods with commas between, or all
    #[arg(
        long,
        value_name = "A,B,..",
        value_delimiter = ',',
        default_value = "all"
    )]
    pub methods: Vec<String>,
    /// Runs of every method, with seeds counted from that of the settings
    #[arg(long, value_name = "K", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..=100))]
    pub seeds: u32,
    /// True surface as a mesh or a point cloud, or one of each, as for `neurodin eval`; without it only pictures are scored
    #[arg(long, value_name = "FILE")]
    pub reference: Vec<PathBuf>,
    /// Distances for the F-score [default: 0.5, 1 and 2 % of half the reference's diagonal]
    #[arg(
        long,
        value_name = "A,B,..",
        value_delimiter = ',',
        requires = "reference"
    )]
    pub thresholds: Vec<f64>,
    /// Score only what lies in this box
    #[arg(long, value_name = "X0,Y0,Z0,X1,Y1,Z1", value_parser = numbers::<6>, allow_hyphen_values = true, requires = "reference")]
    pub crop: Option<[f64; 6]>,
    /// Score also what no training view sees
    #[arg(long, requires = "reference")]
    pub unseen: bool,
    /// Cells of the meshes along the longest side of the region
    #[arg(long, value_name = "N", default_value_t = 512, value_parser = clap::value_parser!(u32).range(8..=16384))]
    pub resolution: u32,
    /// Write the table and pictures of every mesh as one HTML file
    #[arg(long, value_name = "FILE")]
    pub report: Option<PathBuf>,
    /// Replace that file if it exists
    #[arg(long, requires = "report")]
    pub force: bool,
    #[command(flatten)]
    pub settings: SettingsArgs,
    #[command(flatten)]
    pub scene: SceneArgs,
}

/// What one run came to; `scores.json` in its directory.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Scores {
    method: String,
    seed: u32,
    steps: u64,
    seconds_per_step: f64,
    /// Device memory while training.
    device_bytes: u64,
    /// Of the held-out views, in the mean; `None` where there are none.
    psnr: Option<f64>,
    ssim: Option<f64>,
    /// Why there is no mesh, if so.
    no_mesh: Option<String>,
    /// Of the mesh, as `neurodin eval --mesh` has it, where there is a reference.
    geometry: Option<Value>,
    scored: Scored,
}

/// How a run was scored.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Scored {
    /// Of the mesh, in cells.
    resolution: u32,
    /// Of the rendered views.
    appearance: AppearanceAtEval,
    /// Absolute paths.
    reference: Vec<PathBuf>,
    thresholds: Vec<f64>,
    crop: Option<[f64; 6]>,
    unseen: bool,
}

impl Scored {
    fn asked(args: &CompareArgs, config: &Config) -> Result<Scored> {
        let absolute = |path: &PathBuf| {
            fs::canonicalize(path).map_err(|error| Error::unreadable(path, &error))
        };
        Ok(Scored {
            resolution: args.resolution,
            appearance: config.appearance.at_eval,
            reference: args.reference.iter().map(absolute).collect::<Result<_>>()?,
            thresholds: args.thresholds.clone(),
            crop: args.crop,
            unseen: args.unseen,
        })
    }
}

/// A method under one seed.
struct Entry<'a> {
    method: String,
    run: Planned<'a>,
}

pub(super) fn run(args: &CompareArgs, context: &Context) -> anyhow::Result<()> {
    let methods = methods(&args.methods)?;
    // Hours may pass until they are needed.
    if let Some(path) = &args.report {
        destination::check(path, args.force)?;
    }
    eval::read_reference(&args.reference)?;
    let study = Study::open(&args.dataset, &args.settings, &args.scene)?;
    if let Err(error) = study.check_held_out("pictures are scored by held-out views") {
        if args.reference.is_empty() {
            return Err(error.into());
        }
        context.warn(&format!("only meshes will be scored: {error}"));
    }
    // All methods under one seed, then under the next: a study that is stopped has compared.
    let mut entries = Vec::new();
    for nth in 0..args.seeds {
        for method in &methods {
            let run = study.plan(args.out.join(format!("{method}-{nth}")), method, nth)?;
            run.check()?;
            let method = method.clone();
            entries.push(Entry { method, run });
        }
    }
    let mut table = Table::default();
    let mut failures = Vec::new();
    for entry in &entries {
        let (method, seed) = (&entry.method, entry.run.config.seed);
        match one_run(args, &study.scene, entry, context) {
            Ok(scores) => table.add(scores),
            Err(error) if is_a_result(&error) => {
                context.warn(&format!("{method}, seed {seed}: {error:#}"));
                table.add_failure(method, seed, &format!("{error:#}"));
                failures.push(error);
            }
            Err(error) => return Err(error),
        }
    }
    let html = match &args.report {
        None => None,
        Some(_) => {
            context.say("\npictures");
            let pictures = pictures(args, &study.scene, &entries[..methods.len()])?;
            let dataset = args.dataset.display().to_string();
            Some(report::html(&table, &pictures, &dataset))
        }
    };
    let result = json!({ "methods": table.to_json(), "report": args.report });
    context.result(&result, &format!("\n{}", table.text()))?;
    if let (Some(path), Some(html)) = (&args.report, html) {
        destination::write(path, args.force, |file| file.write_all(html.as_bytes()))?;
    }
    let runs = format!("{} of {} runs", failures.len(), entries.len());
    match failures.into_iter().next() {
        None => Ok(()),
        Some(first) => Err(first.context(format!(
            "{runs} failed; the same command tries them again:\n{}",
            table.failures()
        ))),
    }
}

/// Whether a run failed for what it is, so that the others may come through.
fn is_a_result(error: &anyhow::Error) -> bool {
    matches!(
        error.downcast_ref(),
        Some(Error::Numerical { .. } | Error::OutOfMemory { .. })
    )
}

/// The methods that were named, each of which exists, and each once.
fn methods(named: &[String]) -> Result<Vec<String>> {
    if named == ["all"] {
        return Ok(METHODS.iter().map(|method| method.name.into()).collect());
    }
    let mut methods = Vec::new();
    for name in named {
        Config::default().with_method(name)?;
        if !methods.contains(name) {
            methods.push(name.clone());
        }
    }
    Ok(methods)
}

/// Trains, extracts and scores one run, or what of that is still to do.
fn one_run(
    args: &CompareArgs,
    scene: &Scene,
    entry: &Entry,
    context: &Context,
) -> anyhow::Result<Scores> {
    let Entry { method, run } = entry;
    let seed = run.config.seed;
    let asked = Scored::asked(args, &run.config)?;
    let before = match fs::read_to_string(run.scores()) {
        Err(_) => None,
        Ok(text) => match serde_json::from_str::<Scores>(&text) {
            Ok(scores) if scores.method == *method && scores.seed == seed => Some(scores),
            _ => {
                return Err(Error::input(
                    run.scores(),
                    format!("holds no scores of {method} with seed {seed}"),
                    "remove it to have the run scored again, or give another --out",
                )
                .into());
            }
        },
    };
    let mut scores = match before {
        Some(scores) if scores.scored == asked => {
            context.say(&format!("\n{method}, seed {seed}: done before"));
            return Ok(scores);
        }
        Some(scores) => {
            context.say(&format!("\n{method}, seed {seed}: scored again"));
            scores
        }
        None => {
            let place = run.run.display();
            context.say(&format!("\n{method}, seed {seed}: {place}"));
            let trained = run.train(context)?;
            Scores {
                method: method.clone(),
                seed,
                steps: trained.steps,
                seconds_per_step: seconds_per_step(&run.run)?,
                device_bytes: trained.device_bytes,
                psnr: None,
                ssim: None,
                no_mesh: None,
                geometry: None,
                scored: asked.clone(),
            }
        }
    };
    let has_mesh = take_mesh(args, &run.run, context)?;
    scores.no_mesh = (!has_mesh).then(|| NO_SURFACE.into());
    if scene.split(Split::Test).next().is_some() {
        // Held-out views have no code of their own.
        let frame = asked.appearance == AppearanceAtEval::Frame;
        let appearance = (!frame).then_some(asked.appearance);
        let place = &run.run;
        let pictures = score(
            place,
            Some(&args.dataset),
            Which::Test,
            appearance,
            context,
            &mut |_, _| {},
        )?;
        (scores.psnr, scores.ssim) = (pictures.psnr(), pictures.ssim());
    }
    scores.geometry = match has_mesh && !args.reference.is_empty() {
        true => Some(score_mesh(args, &run.run.join("mesh.ply"))?),
        false => None,
    };
    scores.scored = asked;
    let text = serde_json::to_string_pretty(&scores).expect("plain numbers and text");
    RunDirectory::open(&run.run)?.write(&run.scores(), &text)?;
    Ok(scores)
}

/// Writes the run's mesh as `mesh.ply` into its directory; whether there is one, since to have none is a result.
fn take_mesh(args: &CompareArgs, run: &Path, context: &Context) -> anyhow::Result<bool> {
    let wanted = MeshArgs {
        run: run.into(),
        resolution: args.resolution,
        force: true,
        ..MeshArgs::default()
    };
    let written = mesh::take(&wanted, context)?;
    if written.is_none() {
        context.warn(&format!("{}: {NO_SURFACE}", run.display()));
    }
    Ok(written.is_some())
}

/// Scores a run's mesh as `neurodin eval --mesh` does.
fn score_mesh(args: &CompareArgs, mesh: &Path) -> Result<Value> {
    let wanted = EvalArgs {
        reference: args.reference.clone(),
        thresholds: args.thresholds.clone(),
        crop: args.crop,
        visible_from: (!args.unseen).then(|| args.dataset.clone()),
        ..EvalArgs::default()
    };
    Ok(eval::score_mesh(&wanted, mesh)?.0)
}

/// Mean over the log's lines, which stand at equal distances in steps, also where the run was interrupted.
fn seconds_per_step(run: &Path) -> Result<f64> {
    let path = RunDirectory::open(run)?.log();
    let log = fs::read_to_string(&path).map_err(|e| Error::unreadable(&path, &e))?;
    let lines = log.lines().map(serde_json::from_str::<Value>);
    let rates: Vec<f64> = lines
        .filter_map(|line| line.ok()?["it_per_s"].as_f64())
        .filter(|rate| *rate > 0.0)
        .collect();
    Ok(rates.iter().map(|rate| 1.0 / rate).sum::<f64>() / rates.len() as f64)
}

/// A mesh as clay, with what it is of.
struct Shown {
    name: String,
    picture: Rgb,
}

/// The reference, where it is a mesh, and the meshes of these runs, from where the first held-out view was taken.
fn pictures(args: &CompareArgs, scene: &Scene, entries: &[Entry]) -> anyhow::Result<Vec<Shown>> {
    let region = entries[0].run.region();
    let view = scene.split(Split::Test).chain(0..1).next().unwrap_or(0);
    let view = &scene.views[view];
    let eye = eye(&view.camera, view.world_from_camera);
    let mut shown = Vec::new();
    for reference in &args.reference {
        let mesh = read_mesh(reference)?;
        if !mesh.faces.is_empty() {
            shown.push(Shown {
                name: "reference".into(),
                picture: picture(&mesh, &eye, region),
            });
        }
    }
    for Entry { method, run } in entries {
        let path = run.run.join("mesh.ply");
        if path.is_file() {
            shown.push(Shown {
                name: method.clone(),
                picture: picture(&read_mesh(&path)?, &eye, region),
            });
        }
    }
    Ok(shown)
}

fn picture(mesh: &Mesh, eye: &Eye, region: &Region) -> Rgb {
    let from_sun = Visible::of_mesh(mesh, &sun_eye(region.center, region.radius));
    clay(&Visible::of_mesh(mesh, eye), &from_sun, region.radius)
}

/// The camera without its distortion, at this width.
fn eye(camera: &Camera, world_from_camera: DMat4) -> Eye {
    const WIDTH: f64 = 480.0;
    let (width, height) = (f64::from(camera.width), f64::from(camera.height));
    let direction = |x: f64| {
        let d = camera.direction(dvec2(x, 0.5 * height));
        d.x / -d.z
    };
    Eye {
        world_from_eye: world_from_camera,
        lens: Lens::Perspective(WIDTH / (direction(width) - direction(0.0))),
        width: WIDTH as usize,
        height: (WIDTH * height / width) as usize,
    }
}
