//! `neurodin compare`: several methods on one dataset under equal budgets, as one table.

mod report;
mod table;

use super::eval::{self, EvalArgs};
use super::mesh::{self, MeshArgs, NO_SURFACE};
use super::scene_args::{SceneArgs, numbers};
use super::settings::SettingsArgs;
use super::{Context, train};
use crate::config::{Config, METHODS};
use crate::mesh::{Mesh, read_mesh};
use crate::picture::Rgb;
use crate::picture::surface::{Eye, Lens, Visible, clay, sun_eye};
use crate::scene::{Camera, Region, Split};
use crate::train::run_directory::{RunDirectory, SceneRecord};
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
command goes on where it was stopped. The methods are those of `neurodin train --help`, at --method.")]
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
    /// Of the held-out views, in the mean.
    psnr: Option<f64>,
    ssim: Option<f64>,
    /// Why there is no mesh, if so.
    no_mesh: Option<String>,
    /// Of the mesh, as `neurodin eval --mesh` has it, where there is a reference.
    geometry: Option<Value>,
}

pub(super) fn run(args: &CompareArgs, context: &Context) -> anyhow::Result<()> {
    let methods = methods(&args.methods)?;
    // Hours may pass until it is needed.
    eval::read_reference(&args.reference)?;
    let mut table = Table::default();
    // All methods under one seed, then under the next: a study that is stopped has compared.
    for nth in 0..args.seeds {
        for method in &methods {
            table.add(one_run(args, method, nth, context)?);
        }
    }
    let mut files = Vec::new();
    if let Some(path) = &args.report {
        context.say("\npictures");
        let pictures = pictures(args, &methods)?;
        let html = report::html(&table, &pictures, &args.dataset.display().to_string());
        fs::write(path, html).map_err(|error| Error::unwritable(path, &error))?;
        files.push(path);
    }
    let result = json!({ "methods": table.to_json(), "report": files.first() });
    Ok(context.result(&result, &format!("\n{}", table.text()))?)
}

/// The methods that were named, each of which exists.
fn methods(named: &[String]) -> Result<Vec<String>> {
    if named == ["all"] {
        return Ok(METHODS.iter().map(|method| method.name.into()).collect());
    }
    for name in named {
        Config::default().with_method(name)?;
    }
    Ok(named.to_vec())
}

/// Trains, extracts and scores one method under the nth seed, or what of that is still to do.
fn one_run(
    args: &CompareArgs,
    method: &str,
    nth: u32,
    context: &Context,
) -> anyhow::Result<Scores> {
    let mut settings = args.settings.clone();
    settings.method = Some(method.into());
    let first = settings.seed.unwrap_or(Config::default().seed);
    let seed = first + nth;
    settings.seed = Some(seed);
    let run = directory(args, method, nth);
    let finished = run.join("scores.json");
    if let Ok(text) = fs::read_to_string(&finished) {
        return match serde_json::from_str::<Scores>(&text) {
            Ok(scores) if scores.method == method && scores.seed == seed => {
                context.say(&format!("\n{method}, seed {seed}: done before"));
                Ok(scores)
            }
            _ => Err(Error::input(
                &finished,
                format!("holds no scores of {method} with seed {seed}"),
                "remove its directory to have it trained again, or give another --out",
            )
            .into()),
        };
    }
    context.say(&format!("\n{method}, seed {seed}: {}", run.display()));
    let trained =
        train::train_or_resume(&args.dataset, &run, settings, args.scene.clone(), context)?;
    let has_mesh = take_mesh(args, &run, context)?;
    let pictures = eval::pictures::score(&run, None, None, context, &mut |_, _| {})?;
    let geometry = match has_mesh && !args.reference.is_empty() {
        true => Some(score_mesh(args, &run.join("mesh.ply"))?),
        false => None,
    };
    let scores = Scores {
        method: method.into(),
        seed,
        steps: trained.steps,
        seconds_per_step: seconds_per_step(&run)?,
        device_bytes: trained.device_bytes,
        psnr: pictures.psnr(),
        ssim: pictures.ssim(),
        no_mesh: (!has_mesh).then(|| NO_SURFACE.into()),
        geometry,
    };
    let text = serde_json::to_string_pretty(&scores).expect("plain numbers and text");
    RunDirectory::open(&run)?.write(&finished, &text)?;
    Ok(scores)
}

fn directory(args: &CompareArgs, method: &str, nth: u32) -> PathBuf {
    args.out.join(format!("{method}-{nth}"))
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

/// The reference, where it is a mesh, and every method's mesh under the first seed, from where the first held-out view was taken.
fn pictures(args: &CompareArgs, methods: &[String]) -> anyhow::Result<Vec<Shown>> {
    let first = RunDirectory::open(&directory(args, &methods[0], 0))?;
    let record = SceneRecord::load(&first)?;
    let latest = crate::train::checkpoint::latest(&first.checkpoints())?;
    let scene = record.open(Some(&args.dataset), &latest.checkpoint.state().config)?;
    let region = &record.region;
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
    for method in methods {
        let path = directory(args, method, 0).join("mesh.ply");
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
