//! The protocol of Tanks and Temples (Knapitsch et al. 2017): precision, recall and F-score of point clouds of equal density.
//!
//! Both clouds are cropped by the scene's polygon, reduced to the means of cubes of half the threshold, and compared by nearest
//! neighbours. The mesh counts by its vertices. The published tools refine the given alignment by ICP; here it is taken as it is.

use std::path::Path;

use glam::{DVec2, DVec3};
use serde::{Deserialize, Serialize};

use super::cloud::{distances, voxel_means};
use super::geometry::{ThresholdScore, share};
use crate::{Error, Result};

/// Scenes of the training set with their thresholds, in metres.
pub const SCENES: [(&str, f64); 7] = [
    ("Barn", 0.01),
    ("Caterpillar", 0.005),
    ("Church", 0.025),
    ("Courthouse", 0.025),
    ("Ignatius", 0.003),
    ("Meetingroom", 0.01),
    ("Truck", 0.005),
];

/// The threshold of a scene.
///
/// # Errors
/// `Config` with the names that there are.
pub fn threshold(scene: &str) -> Result<f64> {
    let found = SCENES
        .iter()
        .find(|(name, _)| name.eq_ignore_ascii_case(scene));
    found.map(|(_, threshold)| *threshold).ok_or_else(|| {
        let names: Vec<_> = SCENES.iter().map(|(name, _)| *name).collect();
        Error::Config {
            what: format!(
                "no threshold is known for the scene '{scene}'; there are: {}; for another one give it by --thresholds",
                names.join(", ")
            ),
        }
    })
}

/// A prism over a polygon: what Open3D saves as `SelectionPolygonVolume`.
#[derive(Clone, Debug, PartialEq)]
pub struct Prism {
    /// The axis that it stands along, and its ends there.
    axis: usize,
    ends: [f64; 2],
    /// Corners in the other two axes, in their order.
    corners: Vec<DVec2>,
}

/// The file's keys; further ones are of no interest.
#[derive(Deserialize)]
struct SelectionPolygonVolume {
    axis_min: f64,
    axis_max: f64,
    bounding_polygon: Vec<[f64; 3]>,
    orthogonal_axis: String,
}

impl Prism {
    /// Reads a crop file.
    ///
    /// # Errors
    /// `Input` for a file that is none, and for what bounds nothing.
    pub fn read(file: &Path) -> Result<Prism> {
        let wrong = |what: String| {
            let next = "give the scene's crop file, a SelectionPolygonVolume as Open3D saves it";
            Error::input(file, what, next)
        };
        let text =
            std::fs::read_to_string(file).map_err(|error| Error::unreadable(file, &error))?;
        let volume: SelectionPolygonVolume = serde_json::from_str(&text)
            .map_err(|error| wrong(format!("is no crop file: {error}")))?;
        let axis = match volume.orthogonal_axis.to_ascii_uppercase().as_str() {
            "X" => 0,
            "Y" => 1,
            "Z" => 2,
            other => {
                return Err(wrong(format!(
                    "orthogonal_axis is {other:?}, not X, Y or Z"
                )));
            }
        };
        let points = volume.bounding_polygon;
        if points.len() < 3 {
            return Err(wrong(format!(
                "bounding_polygon has {} points; a polygon takes at least 3",
                points.len()
            )));
        }
        let ends = [volume.axis_min, volume.axis_max];
        if ends[0] >= ends[1] {
            let [low, high] = ends;
            return Err(wrong(format!(
                "axis_min {low} is not below axis_max {high}"
            )));
        }
        Ok(Prism {
            axis,
            ends,
            corners: points
                .into_iter()
                .map(|point| without(axis, point.into()))
                .collect(),
        })
    }

    /// Whether `p` lies inside: between the ends, and within the polygon by the even-odd rule.
    pub fn contains(&self, p: DVec3) -> bool {
        if !(self.ends[0]..=self.ends[1]).contains(&p[self.axis]) {
            return false;
        }
        let p = without(self.axis, p);
        let before = self.corners.iter().cycle().skip(self.corners.len() - 1);
        let crossings = before.zip(&self.corners).filter(|(a, b)| {
            // Sides that the line through p along the first axis crosses, beyond p.
            let spans = (a.y > p.y) != (b.y > p.y);
            spans && p.x < a.x + (b.x - a.x) * (p.y - a.y) / (b.y - a.y)
        });
        crossings.count() % 2 == 1
    }
}

/// The coordinates other than that of `axis`.
fn without(axis: usize, p: DVec3) -> DVec2 {
    match axis {
        0 => DVec2::new(p.y, p.z),
        1 => DVec2::new(p.x, p.z),
        _ => DVec2::new(p.x, p.y),
    }
}

/// The scores of the protocol.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct TanksScores {
    #[serde(flatten)]
    pub score: ThresholdScore,
    /// Side of the cubes that both clouds are reduced by.
    pub voxel: f64,
    /// Points that were compared.
    pub points: usize,
    pub reference_points: usize,
}

/// Scores the points `ours` against `truth`, both in the frame of the truth and of `crop`.
///
/// # Errors
/// `Config` if nothing of the truth lies inside the crop.
pub fn score_tanks(
    ours: &[DVec3],
    truth: &[DVec3],
    crop: &Prism,
    threshold: f64,
) -> Result<TanksScores> {
    if !(threshold > 0.0 && threshold.is_finite()) {
        return Err(Error::Config {
            what: format!("the threshold must be positive, not {threshold}"),
        });
    }
    let voxel = 0.5 * threshold;
    let prepared = |points: &[DVec3]| {
        let inside: Vec<DVec3> = points
            .iter()
            .copied()
            .filter(|&p| crop.contains(p))
            .collect();
        voxel_means(&inside, voxel)
    };
    let (ours, theirs) = (prepared(ours), prepared(truth));
    if theirs.is_empty() {
        return Err(Error::Config {
            what: format!(
                "of the reference's {} points none lies inside the crop polygon: are they of the same scene?",
                truth.len()
            ),
        });
    }
    let near = |d: f64| d < threshold;
    let precision = share(&distances(&ours, &theirs), near);
    let recall = share(&distances(&theirs, &ours), near);
    Ok(TanksScores {
        score: ThresholdScore::new(threshold, precision, recall),
        voxel,
        points: ours.len(),
        reference_points: theirs.len(),
    })
}
