//! The published evaluation protocols in `neurodin eval`, and the way from a mesh's coordinates into its reference's.

use std::path::{Path, PathBuf};

use clap::{Args, ValueEnum};
use glam::{DMat3, DMat4, DVec3, DVec4};
use serde_json::{Value, json};

use super::EvalArgs;
use crate::eval::dtu::{self, Observed, read_plane, score_dtu};
use crate::eval::geometry::Reference;
use crate::eval::tanks::{Prism, score_tanks, threshold};
use crate::mesh::Mesh;
use crate::{Error, Result, scene};

/// How a mesh is scored, and what the protocols take beside it.
#[derive(Args, Clone, Debug, Default)]
#[command(next_help_heading = "Protocols")]
pub struct ProtocolArgs {
    /// How a mesh is scored
    #[arg(
        long,
        value_enum,
        default_value_t,
        value_name = "NAME",
        conflicts_with = "run"
    )]
    pub protocol: Protocol,
    /// From the mesh's coordinates to the reference's: 4 rows of 4 numbers as text (*_trans.txt) or .npy, or a meta_data.json with worldtogt
    #[arg(long, value_name = "FILE", conflicts_with = "run")]
    pub align: Option<PathBuf>,
    /// tnt: the scene, which has its own threshold; --thresholds states one for others
    #[arg(long, value_name = "SCENE", conflicts_with = "run")]
    pub scene: Option<String>,
    /// tnt: the scene's polygon, a SelectionPolygonVolume in JSON
    #[arg(long, value_name = "FILE", conflicts_with = "run")]
    pub crop_polygon: Option<PathBuf>,
    /// dtu: ObsMask, BB and Res of the scan, as .npz
    #[arg(long, value_name = "FILE", conflicts_with = "run")]
    pub observed: Option<PathBuf>,
    /// dtu: the table's plane P, as .npz or .npy
    #[arg(long, value_name = "FILE", conflicts_with = "run")]
    pub plane: Option<PathBuf>,
}

/// How a mesh is scored.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub enum Protocol {
    /// Distances both ways, Chamfer, and F-score at any thresholds
    #[default]
    Plain,
    /// Tanks and Temples: F-score of the vertices at the scene's threshold, cropped and reduced to equal density; no ICP refinement
    Tnt,
    /// DTU: mean distances in millimetres where the scanner saw, cut off at 20
    Dtu,
}

impl Protocol {
    fn name(self) -> String {
        let value = self.to_possible_value().expect("none is skipped");
        value.get_name().to_owned()
    }
}

/// Refuses flags that another protocol would look at.
pub(super) fn check_flags(args: &EvalArgs) -> Result<()> {
    use Protocol::{Dtu, Plain, Tnt};
    let protocols = &args.protocols;
    let flags: [(&str, bool, &[Protocol]); 10] = [
        ("--samples", args.samples.is_some(), &[Plain]),
        ("--crop", args.crop.is_some(), &[Plain]),
        ("--trim", args.trim.is_some(), &[Plain]),
        ("--visible-from", args.visible_from.is_some(), &[Plain]),
        ("--hidden-by", args.hidden_by.is_some(), &[Plain]),
        ("--thresholds", !args.thresholds.is_empty(), &[Plain, Tnt]),
        ("--scene", protocols.scene.is_some(), &[Tnt]),
        ("--crop-polygon", protocols.crop_polygon.is_some(), &[Tnt]),
        ("--observed", protocols.observed.is_some(), &[Dtu]),
        ("--plane", protocols.plane.is_some(), &[Dtu]),
    ];
    for (flag, given, of) in flags {
        if given && !of.contains(&protocols.protocol) {
            let of: Vec<String> = of.iter().map(|protocol| protocol.name()).collect();
            return Err(Error::Config {
                what: format!(
                    "{flag} is for --protocol {}, not {}",
                    of.join(" or "),
                    protocols.protocol.name()
                ),
            });
        }
    }
    Ok(())
}

/// The similarity that `--align` names, the identity without it.
///
/// # Errors
/// `Input` for a file that holds none.
pub(super) fn truth_from_mesh(args: &EvalArgs) -> Result<DMat4> {
    let file = args.protocols.align.as_deref();
    file.map_or(Ok(DMat4::IDENTITY), read_similarity)
}

fn read_similarity(file: &Path) -> Result<DMat4> {
    let wrong = |what: String| {
        let next = "give 4 rows of 4 numbers, the last 0 0 0 1, or a meta_data.json with worldtogt";
        Error::input(file, what, next)
    };
    let extension = file.extension().unwrap_or_default().to_ascii_lowercase();
    let matrix = match extension.to_str() {
        Some("json") => {
            scene::truth_from_world(file)?.ok_or_else(|| wrong("states no worldtogt".into()))?
        }
        Some("npy") => crate::arrays::Arrays::open(file)?.matrix("the array")?,
        _ => {
            let text =
                std::fs::read_to_string(file).map_err(|error| Error::unreadable(file, &error))?;
            let words: Vec<&str> = text
                .split(|c: char| c.is_whitespace() || c == ',')
                .filter(|word| !word.is_empty())
                .collect();
            let numbers: Vec<f64> = words.iter().map_while(|word| word.parse().ok()).collect();
            let numbers: [f64; 16] = numbers.try_into().map_err(|numbers: Vec<f64>| {
                let (count, words) = (numbers.len(), words.len());
                wrong(format!(
                    "is no 4x4 matrix: {count} of its {words} words are numbers"
                ))
            })?;
            DMat4::from_cols_array(&numbers).transpose()
        }
    };
    if !matrix.is_finite() || matrix.row(3) != DVec4::W {
        return Err(wrong(format!(
            "its last row is {}, not 0 0 0 1, or not all is finite",
            matrix.row(3)
        )));
    }
    let axes = DMat3::from_mat4(matrix);
    let scale = axes.determinant().abs().cbrt();
    if !(scale > 0.0 && scene::off_orthonormal(axes * scale.recip()) <= 1e-3) {
        return Err(wrong(format!("is no similarity: its axes are {axes}")));
    }
    Ok(matrix)
}

/// Scores by the protocol of Tanks and Temples.
pub(super) fn tanks(args: &EvalArgs, ours: &Mesh, reference: Reference) -> Result<(Value, String)> {
    let missing = |what: &str| Error::Config { what: what.into() };
    let threshold = match (&args.protocols.scene, &args.thresholds[..]) {
        (None, [threshold]) => *threshold,
        (Some(scene), []) => threshold(scene)?,
        (None, []) => {
            return Err(missing(
                "--protocol tnt needs the scene's threshold: --scene NAME for those of the training set, --thresholds D for others",
            ));
        }
        _ => {
            return Err(missing(
                "--protocol tnt has one threshold: give either --scene or one number to --thresholds",
            ));
        }
    };
    let crop =
        args.protocols.crop_polygon.as_ref().ok_or_else(|| {
            missing("--protocol tnt needs the scene's polygon: --crop-polygon FILE")
        })?;
    let crop = Prism::read(crop)?;
    let scores = score_tanks(&ours.positions, &points_of(reference), &crop, threshold)?;
    let [precision, recall] =
        [scores.score.precision, scores.score.recall].map(|share| 100.0 * share);
    let text = format!(
        "F {:.4} at {threshold}, precision {precision:.2} %, recall {recall:.2} % ({} points against {}, {} apart)\n",
        scores.score.f_score, scores.points, scores.reference_points, scores.voxel
    );
    Ok((json!(scores), text))
}

/// Scores by the protocol of DTU.
pub(super) fn dtu(args: &EvalArgs, ours: &Mesh, reference: Reference) -> Result<(Value, String)> {
    let needs = |flag: &str, what: &str| Error::Config {
        what: format!("--protocol dtu needs {what}: {flag} FILE"),
    };
    let protocols = &args.protocols;
    let observed = protocols
        .observed
        .as_ref()
        .ok_or_else(|| needs("--observed", "the scan's ObsMask"))?;
    let plane = protocols
        .plane
        .as_ref()
        .ok_or_else(|| needs("--plane", "the table's plane"))?;
    let (observed, plane) = (Observed::read(observed)?, read_plane(plane)?);
    let scores = score_dtu(ours, &points_of(reference), &observed, plane, args.seed)?;
    let number = |value: Option<f64>| value.map_or("-".into(), |value| format!("{value:.4}"));
    let text = format!(
        "Chamfer {}, mesh to scan {} ({} points), scan to mesh {} ({} points), of distances below {}\n",
        number(scores.chamfer),
        number(scores.accuracy),
        scores.points,
        number(scores.completeness),
        scores.reference_points,
        dtu::CUT_OFF
    );
    Ok((json!(scores), text))
}

/// The reference as points: those given, or the vertices of the mesh.
fn points_of(reference: Reference) -> Vec<DVec3> {
    let vertices = reference.mesh.map(|mesh| mesh.positions);
    reference.points.or(vertices).unwrap_or_default()
}
