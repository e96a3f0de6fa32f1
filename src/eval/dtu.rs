//! The protocol of DTU (Jensen et al. 2014), as the reports of neural surfaces since have it: mean distances in millimetres.
//!
//! Points on the mesh, 0.2 mm apart, are measured to the scan where the observation mask says that it could be seen. Points of the scan
//! above the table are measured to those of the mesh in the mask's bounding box, 60 mm below it to 120 mm above. Distances of 20 mm and
//! more do not count. Nothing is culled by masks of the pictures, which some reports do first.

use std::path::Path;

use glam::{DVec3, DVec4};
use serde::Serialize;

use super::cloud::{distances, lattice, thinned};
use crate::arrays::Arrays;
use crate::mesh::Mesh;
use crate::{Error, Result};

/// Distance of points drawn on the mesh.
pub const SPACING: f64 = 0.2;
/// From here on a distance is not of the same surface.
pub const CUT_OFF: f64 = 20.0;
/// How far the box of the mesh's points goes beyond that of the mask, below and above.
const MARGINS: [f64; 2] = [60.0, 120.0];

/// Which part of space the scanner saw: DTU's ObsMask.
#[derive(Clone, Debug)]
pub struct Observed {
    low: DVec3,
    high: DVec3,
    /// Side of a voxel; voxel (0, 0, 0) has its centre at `low`.
    step: f64,
    shape: [usize; 3],
    /// `[x, y, z]`
    seen: Vec<bool>,
}

impl Observed {
    /// Reads `ObsMask`, `BB` (two corners) and `Res` from an .npz file.
    ///
    /// # Errors
    /// `Input` for what is missing or of another shape.
    pub fn read(file: &Path) -> Result<Observed> {
        let wrong = |what: String| {
            let next =
                "give DTU's ObsMask of the scan, converted to .npz with its ObsMask, BB and Res";
            Error::input(file, what, next)
        };
        let mut arrays = Arrays::open(file)?;
        let mask = arrays.flags("ObsMask")?;
        let [nx, ny, nz] = mask.shape[..] else {
            return Err(wrong(format!(
                "ObsMask has the shape {:?}, not three axes",
                mask.shape
            )));
        };
        let corners = arrays.numbers("BB")?;
        if corners.shape != [2, 3] {
            return Err(wrong(format!(
                "BB has the shape {:?}, not [2, 3]",
                corners.shape
            )));
        }
        let low = DVec3::from_slice(&corners.values);
        let high = DVec3::from_slice(&corners.values[3..]);
        if !(low.is_finite() && high.is_finite() && low.cmplt(high).all()) {
            return Err(wrong(format!("BB from {low} to {high} is no box")));
        }
        let step = arrays.numbers("Res")?.values;
        let &[step] = &step[..] else {
            return Err(wrong(format!("Res holds {} numbers, not one", step.len())));
        };
        if !(step > 0.0 && step.is_finite()) {
            return Err(wrong(format!("Res is {step}, not a positive length")));
        }
        Ok(Observed {
            low,
            high,
            step,
            shape: [nx, ny, nz],
            seen: mask.values,
        })
    }

    /// Whether the voxel whose centre is nearest to `p` was seen.
    pub fn contains(&self, p: DVec3) -> bool {
        let index = ((p - self.low) / self.step).round();
        let inside = |axis: usize| index[axis] >= 0.0 && index[axis] < self.shape[axis] as f64;
        if !(0..3).all(inside) {
            return false;
        }
        let [x, y, z] = index.to_array().map(|i| i as usize);
        self.seen[(x * self.shape[1] + y) * self.shape[2] + z]
    }

    /// Whether `p` lies in the box of the mask with its margins.
    pub fn is_near(&self, p: DVec3) -> bool {
        let [below, above] = MARGINS;
        p.cmpge(self.low - below).all() && p.cmplt(self.high + above).all()
    }
}

/// Reads the plane of the table, four numbers `P`: points x with P · (x, 1) > 0 lie above it.
///
/// # Errors
/// `Input` for a file that holds no plane.
pub fn read_plane(file: &Path) -> Result<DVec4> {
    let plane = Arrays::open(file)?.numbers("P")?.values;
    let numbers: Option<[f64; 4]> = plane.try_into().ok();
    numbers
        .map(DVec4::from)
        .filter(|plane| plane.is_finite() && plane.truncate() != DVec3::ZERO)
        .ok_or_else(|| {
            let next = "give DTU's Plane of the scan, converted to .npz with its P, or those four numbers as .npy";
            Error::input(file, "holds no plane: P has to be four numbers", next)
        })
}

/// The scores of the protocol, in the reference's units: millimetres.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct DtuScores {
    /// Mean distance from the mesh to the scan (data to scan); none where nothing is near.
    pub accuracy: Option<f64>,
    /// Mean distance from the scan to the mesh.
    pub completeness: Option<f64>,
    /// Mean of both.
    pub chamfer: Option<f64>,
    /// Points of the mesh that were measured, and points of the scan.
    pub points: usize,
    pub reference_points: usize,
}

/// Scores `mesh` (without faces: its vertices) against the points `truth` of the scan, both in millimetres in the scan's frame.
///
/// # Errors
/// `Config` if nothing of the scan lies above the plane, or the mesh is far too large.
pub fn score_dtu(
    mesh: &Mesh,
    truth: &[DVec3],
    observed: &Observed,
    plane: DVec4,
    seed: u64,
) -> Result<DtuScores> {
    let above: Vec<DVec3> = truth
        .iter()
        .copied()
        .filter(|p| plane.dot(p.extend(1.0)) > 0.0)
        .collect();
    if above.is_empty() {
        return Err(Error::Config {
            what: format!(
                "of the scan's {} points none lies above the plane: are they of the same scan?",
                truth.len()
            ),
        });
    }
    let near: Vec<DVec3> = thinned(&lattice(mesh, SPACING)?, SPACING, seed)
        .into_iter()
        .filter(|&p| observed.is_near(p))
        .collect();
    let seen: Vec<DVec3> = near
        .iter()
        .copied()
        .filter(|&p| observed.contains(p))
        .collect();
    let accuracy = mean_below_cut_off(&distances(&seen, truth));
    let completeness = mean_below_cut_off(&distances(&above, &near));
    Ok(DtuScores {
        accuracy,
        completeness,
        chamfer: accuracy.zip(completeness).map(|(a, c)| 0.5 * (a + c)),
        points: seen.len(),
        reference_points: above.len(),
    })
}

fn mean_below_cut_off(distances: &[f64]) -> Option<f64> {
    let near = || distances.iter().filter(|d| **d < CUT_OFF);
    let count = near().count();
    (count > 0).then(|| near().sum::<f64>() / count as f64)
}
