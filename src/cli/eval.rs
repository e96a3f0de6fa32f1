//! `neurodin eval`: how well a run renders held-out views, or how far a mesh is from the true surface.

pub(super) mod pictures;
pub mod protocol;

use std::fmt::Write;
use std::path::{Path, PathBuf};

use clap::Args;
use glam::{DMat4, DVec3};
use serde_json::{Value, json};

use super::Context;
use super::render::{Appearance, Which};
use super::scene_args::numbers;
use crate::eval::geometry::{
    Distances, GeometryOptions, GeometryScores, Reference, score_geometry,
};
use crate::mesh::{Mesh, bounds, read_mesh};
use crate::scene::{Scene, SceneOptions, Split, View};
use crate::{Error, Result};
use protocol::{Protocol, ProtocolArgs};

/// Score a training run's pictures, or a mesh against the true surface
#[derive(Args, Clone, Debug, Default)]
#[command(after_help = "Examples:
  neurodin eval run/
  neurodin eval run/ --split train --appearance frame
  neurodin eval --mesh mesh.ply --reference scan.ply --thresholds 0.005,0.01
  neurodin eval --mesh mesh.ply --reference true.ply --reference points.ply --crop -1,-1,0,1,1,2 --visible-from photos/ --json
  neurodin eval --mesh mesh.ply --reference scan.ply --align photos/meta_data.json
  neurodin eval --mesh mesh.ply --reference Barn.ply --protocol tnt --scene Barn --align Barn_trans.txt --crop-polygon Barn.json
  neurodin eval --mesh mesh.ply --reference stl024_total.ply --protocol dtu --observed ObsMask24_10.npz --plane Plane24.npz

Thresholds, distances and boxes are in the coordinates of the reference, which are those of the mesh or what --align makes of them.

DTU's MATLAB files are read as .npz; a .mat file is refused with the line that converts it.")]
#[command(group = clap::ArgGroup::new("scored").required(true).args(["run", "mesh"]))]
pub struct EvalArgs {
    /// Run directory: PSNR and SSIM of its views
    pub run: Option<PathBuf>,
    /// Which views
    #[arg(
        long,
        value_enum,
        default_value_t,
        value_name = "SPLIT",
        conflicts_with = "mesh"
    )]
    pub split: Which,
    /// Appearance code of the rendered views [default: as the run's settings say]
    #[arg(long, value_enum, value_name = "CODE", conflicts_with = "mesh")]
    pub appearance: Option<Appearance>,
    /// Where the run's dataset is now, if it has moved
    #[arg(long, value_name = "DATASET", conflicts_with = "mesh")]
    pub dataset: Option<PathBuf>,
    /// Mesh to score (PLY or OBJ); without faces, its points
    #[arg(long, value_name = "FILE", requires = "reference")]
    pub mesh: Option<PathBuf>,
    /// True surface as a mesh or a point cloud; given twice, accuracy is to the mesh and completeness from the points
    #[arg(long, value_name = "FILE", conflicts_with = "run")]
    pub reference: Vec<PathBuf>,
    /// Distances for precision, recall and F-score [default: 0.5, 1 and 2 % of half the reference's diagonal]
    #[arg(
        long,
        value_name = "A,B,..",
        value_delimiter = ',',
        conflicts_with = "run"
    )]
    pub thresholds: Vec<f64>,
    /// Distances are cut off here for the trimmed Chamfer distance [default: 5 % of half the reference's diagonal]
    #[arg(long, value_name = "D", conflicts_with = "run")]
    pub trim: Option<f64>,
    /// Score only what lies in this box
    #[arg(long, value_name = "X0,Y0,Z0,X1,Y1,Z1", value_parser = numbers::<6>, allow_hyphen_values = true, conflicts_with = "run")]
    pub crop: Option<[f64; 6]>,
    /// Leave out of the mesh what no training view of this dataset sees
    #[arg(long, value_name = "DATASET", conflicts_with = "run")]
    pub visible_from: Option<PathBuf>,
    /// Views that must see a place [default: 1]
    #[arg(long, value_name = "N", requires = "visible_from", value_parser = clap::value_parser!(u32).range(1..))]
    pub min_views: Option<u32>,
    /// A place is hidden by what is nearer to the camera by more than this [default: 0.1 % of half the reference's diagonal]
    #[arg(long, value_name = "D", requires = "visible_from")]
    pub hidden_by: Option<f64>,
    /// Points drawn on a mesh (--protocol plain) [default: 500000]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=50_000_000), conflicts_with = "run")]
    pub samples: Option<u32>,
    /// Seed of the points
    #[arg(long, value_name = "N", default_value_t = 0)]
    pub seed: u64,
    #[command(flatten)]
    pub protocols: ProtocolArgs,
}

pub(super) fn run(args: &EvalArgs, context: &Context) -> anyhow::Result<()> {
    let (report, text) = match (&args.run, &args.mesh) {
        (Some(run), _) => {
            let at_eval = args.appearance.map(Into::into);
            let dataset = args.dataset.as_deref();
            let split = args.split;
            let scores = pictures::score(run, dataset, split, at_eval, context, &mut |_, _| {})?;
            (scores.to_json(), scores.text())
        }
        (None, Some(mesh)) => score_mesh(args, mesh)?,
        (None, None) => unreachable!("clap requires one of them"),
    };
    Ok(context.result(&report, &text)?)
}

/// Scores `mesh` against its reference: the report for programs, and the one for people.
///
/// # Errors
/// Those of reading the files and the dataset; `Config` where nothing can be compared.
pub fn score_mesh(args: &EvalArgs, mesh: &Path) -> Result<(Value, String)> {
    protocol::check_flags(args)?;
    let mut ours = read_mesh(mesh)?;
    let truth_from_mesh = protocol::truth_from_mesh(args)?;
    for p in &mut ours.positions {
        *p = truth_from_mesh.transform_point3(*p);
    }
    let reference = read_reference(&args.reference)?;
    let (scores, text) = match args.protocols.protocol {
        Protocol::Plain => plain(args, &ours, &reference, truth_from_mesh)?,
        Protocol::Tnt => protocol::tanks(args, &ours, reference)?,
        Protocol::Dtu => protocol::dtu(args, &ours, reference)?,
    };
    let mut report = json!({ "mesh": mesh, "reference": args.reference });
    if let (Some(report), Value::Object(scores)) = (report.as_object_mut(), scores) {
        report.extend(scores);
    }
    Ok((report, text))
}

/// Distances both ways, as the options ask.
fn plain(
    args: &EvalArgs,
    ours: &Mesh,
    reference: &Reference,
    truth_from_mesh: DMat4,
) -> Result<(Value, String)> {
    let crop = args.crop.map(corners);
    let [low, high] = crop.or(reference.bounds()).ok_or_else(|| {
        let next = "give a mesh or points of the true surface";
        Error::input(&args.reference[0], "has no points", next)
    })?;
    let size = 0.5 * (high - low).length();
    let options = GeometryOptions {
        samples: args.samples.unwrap_or(500_000) as usize,
        seed: args.seed,
        thresholds: match args.thresholds[..] {
            [] => [0.005, 0.01, 0.02].map(|share| share * size).to_vec(),
            _ => args.thresholds.clone(),
        },
        trim: args.trim.unwrap_or(0.05 * size),
        crop,
        min_views: args.min_views.unwrap_or(1),
        hidden_by: args.hidden_by.unwrap_or(1e-3 * size),
    };
    let views = args
        .visible_from
        .as_ref()
        .map(|dataset| training_views(dataset, truth_from_mesh))
        .transpose()?;
    let scores = score_geometry(ours, reference, views.as_deref(), &options)?;
    Ok((json!(scores), as_text(&scores)))
}

/// The lower and the upper corner, from any two opposite ones.
fn corners([x0, y0, z0, x1, y1, z1]: [f64; 6]) -> [DVec3; 2] {
    bounds(&[DVec3::new(x0, y0, z0), DVec3::new(x1, y1, z1)]).expect("two corners")
}

/// The true surface: one mesh, one point cloud, or one of each.
pub(super) fn read_reference(paths: &[PathBuf]) -> Result<Reference> {
    let mut reference = Reference::default();
    for path in paths {
        let part = Reference::from_mesh(read_mesh(path)?);
        let next = "give one mesh, one point cloud, or one of each";
        if part.mesh.is_some() && reference.mesh.is_some() {
            return Err(Error::input(path, "is a second reference with faces", next));
        }
        if part.points.is_some() && reference.points.is_some() {
            return Err(Error::input(
                path,
                "is a second reference without faces",
                next,
            ));
        }
        reference = Reference {
            mesh: reference.mesh.or(part.mesh),
            points: reference.points.or(part.points),
        };
    }
    Ok(reference)
}

/// All views that are not set apart by the dataset itself, with the mesh's coordinates taken to those of the truth.
fn training_views(dataset: &Path, truth_from_mesh: DMat4) -> Result<Vec<View>> {
    let options = SceneOptions {
        holdout: 0,
        masks: false,
        ..Default::default()
    };
    let scene = Scene::open(dataset, &options)?;
    Ok(scene
        .views
        .into_iter()
        .filter(|view| view.split == Split::Train)
        .map(|view| View {
            // Not rigid any more, which no projection of a point minds.
            world_from_camera: truth_from_mesh * view.world_from_camera,
            ..view
        })
        .collect())
}

fn as_text(scores: &GeometryScores) -> String {
    let mut text = String::new();
    let number = |value: Option<f64>| value.map_or("-".into(), |value| format!("{value:.6}"));
    let mut row = |name: &str, value: String| {
        let _ = writeln!(text, "{name:<13} {value}");
    };
    row(
        "mesh",
        format!(
            "{} vertices, {} faces, {} of them scored",
            scores.vertices, scores.faces, scores.faces_scored
        ),
    );
    let distances = |d: &Distances| {
        let [mean, median, high] = [d.mean, d.median, d.percentile_95].map(number);
        format!(
            "mean {mean}, median {median}, 95 % within {high} ({} points)",
            d.points
        )
    };
    row("accuracy", distances(&scores.accuracy));
    row("completeness", distances(&scores.completeness));
    let trimmed = format!(
        "{:.6} with distances cut off at {:.6}",
        scores.chamfer_trimmed, scores.trim
    );
    row("Chamfer", format!("{}; {trimmed}", number(scores.chamfer)));
    for at in &scores.thresholds {
        let [precision, recall] = [at.precision, at.recall].map(|share| 100.0 * share);
        row(
            &format!("at {:.6}", at.threshold),
            format!(
                "F {:.4}, precision {precision:.2} %, recall {recall:.2} %",
                at.f_score
            ),
        );
    }
    text
}
