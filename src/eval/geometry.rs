//! How far a mesh is from the true surface, and the true surface from the mesh.
//!
//! Accuracy: distances of points on the mesh, drawn uniformly by area, to the reference. Completeness: distances of points of the
//! reference to the mesh. Distances to a mesh are exact point-to-triangle distances, those to a point cloud exact point-to-point
//! distances, both by a bounding volume hierarchy ([`crate::mesh::bvh`]). Chamfer = (mean accuracy + mean completeness) / 2, trimmed
//! where each distance is first cut off at `trim`. At a threshold τ, precision and recall are the shares of points with distance ≤ τ
//! on either side, F = 2PR / (P + R) (Knapitsch et al. 2017).
//!
//! With cameras given, surface that no camera sees is left out of the mesh: samples hidden behind other parts of the mesh or outside of
//! every picture do not count, nor do the faces of which no sample is seen. Inventions in free space stay visible and are punished.

use glam::{DMat4, DVec2, DVec3};
use rayon::prelude::*;
use serde::Serialize;

use crate::mesh::bvh::{Bvh, Triangle};
use crate::mesh::{Mesh, bounds};
use crate::scene::View;
use crate::{Error, Result, random};

/// How to score.
#[derive(Clone, Debug)]
pub struct GeometryOptions {
    /// Points drawn on the mesh, and on the reference where it is a mesh.
    pub samples: usize,
    pub seed: u64,
    /// Distances, in world units, at which precision, recall and F are wanted.
    pub thresholds: Vec<f64>,
    /// Distances are cut off here for the trimmed Chamfer distance.
    pub trim: f64,
    /// World-axis box outside of which nothing counts, of neither surface.
    pub crop: Option<[DVec3; 2]>,
    /// Views that must see a point of the mesh, where views are given.
    pub min_views: u32,
    /// A point is hidden by what is nearer to the camera by more than this distance.
    pub hidden_by: f64,
}

/// What is known of the true surface.
#[derive(Clone, Debug, Default)]
pub struct Reference {
    /// Accuracy is measured to it, if it is there.
    pub mesh: Option<Mesh>,
    /// Completeness is measured from these, if they are there.
    pub points: Option<Vec<DVec3>>,
}

impl Reference {
    /// A mesh where there are faces, a point cloud otherwise.
    pub fn from_mesh(mesh: Mesh) -> Reference {
        if mesh.faces.is_empty() {
            Reference {
                mesh: None,
                points: Some(mesh.positions),
            }
        } else {
            Reference {
                mesh: Some(mesh),
                points: None,
            }
        }
    }

    /// Smallest box around all of it.
    pub fn bounds(&self) -> Option<[DVec3; 2]> {
        let positions = self
            .mesh
            .as_ref()
            .map(|mesh| &mesh.positions)
            .or(self.points.as_ref())?;
        bounds(positions)
    }
}

/// Summary of distances in world units; `None` where there are none, or infinite ones.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Distances {
    pub points: usize,
    pub mean: Option<f64>,
    pub median: Option<f64>,
    pub root_mean_square: Option<f64>,
    pub percentile_95: Option<f64>,
    pub trimmed_mean: f64,
}

/// Shares of points nearer than a threshold.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ThresholdScore {
    pub threshold: f64,
    pub precision: f64,
    pub recall: f64,
    pub f_score: f64,
}

impl ThresholdScore {
    /// With F, which is 0 where both others are.
    pub(super) fn new(threshold: f64, precision: f64, recall: f64) -> Self {
        let f_score = if precision + recall > 0.0 {
            2.0 * precision * recall / (precision + recall)
        } else {
            0.0
        };
        ThresholdScore {
            threshold,
            precision,
            recall,
            f_score,
        }
    }
}

/// All scores of a mesh.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct GeometryScores {
    pub vertices: usize,
    pub faces: usize,
    /// Faces that count: inside the crop box, and seen where views are given.
    pub faces_scored: usize,
    pub accuracy: Distances,
    pub completeness: Distances,
    pub chamfer: Option<f64>,
    pub trim: f64,
    pub chamfer_trimmed: f64,
    pub thresholds: Vec<ThresholdScore>,
}

/// Scores `mesh` (without faces: its vertices as points) against `reference`, both in world coordinates. With `views`, only what
/// enough of them see counts.
///
/// # Errors
/// `Config` if the reference holds nothing inside the crop box, options make no sense, or views are given for points without faces.
pub fn score_geometry<V: Viewpoint>(
    mesh: &Mesh,
    reference: &Reference,
    views: Option<&[V]>,
    options: &GeometryOptions,
) -> Result<GeometryScores> {
    let config = |what: &str| Error::Config { what: what.into() };
    let is_distance = |d: &f64| d.is_finite() && *d > 0.0;
    if options.samples == 0 {
        return Err(config(
            "no samples are to be drawn; next: a positive number of them",
        ));
    }
    let mut distances = options.thresholds.iter().chain([&options.trim]);
    if let Some(wrong) = distances.find(|d| !is_distance(d)) {
        return Err(config(&format!(
            "{wrong} is no distance to compare with; next: positive thresholds and trim, and a reference that has an extent where they \
             follow from it"
        )));
    }
    if views.is_some() && mesh.faces.is_empty() && !mesh.positions.is_empty() {
        return Err(config(&format!(
            "the mesh has {} points and no faces, so that it hides nothing and what views see of it cannot be told; next: give a mesh with \
             faces, or score all points, without --visible-from",
            mesh.positions.len()
        )));
    }
    let (samples, scored) = surface_samples(mesh, views, options);
    let ours = Target::over(mesh, &scored, &samples);
    let theirs = match (&reference.mesh, &reference.points) {
        (Some(mesh), _) => Target::Faces(Bvh::over_faces(mesh, 0..mesh.faces.len())),
        (None, Some(points)) => Target::Points(Bvh::new(points.clone())),
        (None, None) => return Err(config("there is no reference")),
    };
    let mut reference_points: Vec<DVec3> = match (&reference.points, &reference.mesh) {
        (Some(points), _) => points
            .iter()
            .copied()
            .filter(|&p| in_box(p, options.crop))
            .collect(),
        (None, Some(mesh)) => {
            let faces: Vec<usize> = (0..mesh.faces.len()).collect();
            draw(
                mesh,
                &faces,
                options.crop,
                options.samples,
                options.seed ^ 1,
            )
            .into_iter()
            .map(|(p, _)| p)
            .collect()
        }
        (None, None) => unreachable!("refused above"),
    };
    reference_points.shrink_to_fit();
    if reference_points.is_empty() {
        return Err(config(
            "the reference holds nothing inside the crop box; check the box and the coordinates",
        ));
    }
    let accuracy: Vec<f64> = samples.par_iter().map(|&p| theirs.distance(p)).collect();
    let completeness: Vec<f64> = reference_points
        .par_iter()
        .map(|&p| ours.distance(p))
        .collect();
    Ok(summary(
        mesh,
        scored.len(),
        &accuracy,
        &completeness,
        options,
    ))
}

/// The share of distances that are `near`; 0 of none.
pub(super) fn share(distances: &[f64], near: impl Fn(f64) -> bool) -> f64 {
    distances.iter().filter(|&&d| near(d)).count() as f64 / distances.len().max(1) as f64
}

/// Scores from the two lists of distances.
fn summary(
    mesh: &Mesh,
    faces_scored: usize,
    accuracy: &[f64],
    completeness: &[f64],
    options: &GeometryOptions,
) -> GeometryScores {
    let thresholds = options.thresholds.iter().map(|&threshold| {
        let near = |d: f64| d <= threshold;
        ThresholdScore::new(threshold, share(accuracy, near), share(completeness, near))
    });
    let thresholds = thresholds.collect();
    let accuracy = Distances::of(accuracy, options.trim);
    let completeness = Distances::of(completeness, options.trim);
    GeometryScores {
        vertices: mesh.positions.len(),
        faces: mesh.faces.len(),
        faces_scored,
        chamfer: accuracy
            .mean
            .zip(completeness.mean)
            .map(|(a, c)| 0.5 * (a + c)),
        trim: options.trim,
        chamfer_trimmed: 0.5 * (accuracy.trimmed_mean + completeness.trimmed_mean),
        accuracy,
        completeness,
        thresholds,
    }
}

impl Distances {
    fn of(distances: &[f64], trim: f64) -> Distances {
        let mut sorted = distances.to_vec();
        sorted.sort_unstable_by(f64::total_cmp);
        let n = sorted.len();
        // Between the two nearest ranks, linearly.
        let quantile = |q: f64| {
            let rank = q * (n - 1) as f64;
            let (below, above) = (sorted[rank.floor() as usize], sorted[rank.ceil() as usize]);
            below + rank.fract() * (above - below)
        };
        let mean = |f: &dyn Fn(f64) -> f64| sorted.iter().map(|&d| f(d)).sum::<f64>() / n as f64;
        let finite =
            |value: &dyn Fn() -> f64| (n > 0).then(value).filter(|value| value.is_finite());
        Distances {
            points: n,
            mean: finite(&|| mean(&|d| d)),
            median: finite(&|| quantile(0.5)),
            root_mean_square: finite(&|| mean(&|d| d * d).sqrt()),
            percentile_95: finite(&|| quantile(0.95)),
            trimmed_mean: if n > 0 { mean(&|d| d.min(trim)) } else { trim },
        }
    }
}

/// Something to measure distances to.
enum Target {
    Faces(Bvh<Triangle>),
    Points(Bvh<DVec3>),
}

impl Target {
    fn over(mesh: &Mesh, faces: &[usize], points: &[DVec3]) -> Target {
        if mesh.faces.is_empty() {
            Target::Points(Bvh::new(points.to_vec()))
        } else {
            Target::Faces(Bvh::over_faces(mesh, faces.iter().copied()))
        }
    }

    fn distance(&self, p: DVec3) -> f64 {
        match self {
            Target::Faces(faces) => faces.distance(p),
            Target::Points(points) => points.distance(p),
        }
    }
}

fn in_box(p: DVec3, crop: Option<[DVec3; 2]>) -> bool {
    crop.is_none_or(|[low, high]| p.cmpge(low).all() && p.cmple(high).all())
}

/// Points on the part of the mesh that counts, and the faces of that part.
fn surface_samples<V: Viewpoint>(
    mesh: &Mesh,
    views: Option<&[V]>,
    options: &GeometryOptions,
) -> (Vec<DVec3>, Vec<usize>) {
    if mesh.faces.is_empty() {
        return (
            mesh.positions
                .iter()
                .copied()
                .filter(|&p| in_box(p, options.crop))
                .collect(),
            Vec::new(),
        );
    }
    let touches = |face: &usize| {
        options.crop.is_none_or(|[low, high]| {
            let [l, h] = bounds(&mesh.corners(*face)).expect("three corners");
            l.cmple(high).all() && h.cmpge(low).all()
        })
    };
    let candidates: Vec<usize> = (0..mesh.faces.len()).filter(touches).collect();
    let drawn = draw(
        mesh,
        &candidates,
        options.crop,
        options.samples,
        options.seed,
    );
    let Some(views) = views else {
        return (drawn.into_iter().map(|(p, _)| p).collect(), candidates);
    };
    let everything = Bvh::over_faces(mesh, 0..mesh.faces.len());
    let eyes: Vec<Eye<V>> = views.iter().map(Eye::of).collect();
    let seen = |p: DVec3| {
        let enough = options.min_views as usize;
        eyes.iter()
            .filter(|eye| eye.sees(&everything, p, options.hidden_by))
            .take(enough)
            .count()
            == enough
    };
    let kept: Vec<(DVec3, usize)> = drawn.into_par_iter().filter(|&(p, _)| seen(p)).collect();
    let mut is_scored = vec![false; mesh.faces.len()];
    kept.iter().for_each(|&(_, face)| is_scored[face] = true);
    // Faces too small to have a sample are asked at their centre.
    let scored = candidates.into_par_iter().filter(|&face| {
        let [a, b, c] = mesh.corners(face);
        let center = (a + b + c) / 3.0;
        is_scored[face] || (in_box(center, options.crop) && seen(center))
    });
    let scored = scored.collect();
    (kept.into_iter().map(|(p, _)| p).collect(), scored)
}

/// A camera as far as seeing is concerned.
pub trait Viewpoint: Sync {
    /// Rigid; the camera looks along its −z.
    fn world_from_camera(&self) -> DMat4;
    /// Width and height in pixels.
    fn size(&self) -> [u32; 2];
    /// Pixel (centres at +0.5) of a point in the camera's frame; `None` if no pixel can show it. May lie outside the image.
    fn project(&self, p_camera: DVec3) -> Option<DVec2>;
}

impl Viewpoint for View {
    fn world_from_camera(&self) -> DMat4 {
        self.world_from_camera
    }

    fn size(&self) -> [u32; 2] {
        [self.camera.width, self.camera.height]
    }

    fn project(&self, p_camera: DVec3) -> Option<DVec2> {
        self.camera.project(p_camera)
    }
}

/// A view with what is asked of it most.
struct Eye<'a, V: Viewpoint> {
    view: &'a V,
    camera_from_world: DMat4,
    center: DVec3,
    size: DVec2,
}

impl<'a, V: Viewpoint> Eye<'a, V> {
    fn of(view: &'a V) -> Self {
        let world_from_camera = view.world_from_camera();
        Eye {
            view,
            camera_from_world: world_from_camera.inverse(),
            center: world_from_camera.w_axis.truncate(),
            size: DVec2::from(view.size().map(f64::from)),
        }
    }

    /// Whether `p` lies in the picture and nothing stands between.
    fn sees(&self, faces: &Bvh<Triangle>, p: DVec3, hidden_by: f64) -> bool {
        let pixel = self
            .view
            .project(self.camera_from_world.transform_point3(p));
        if !pixel
            .is_some_and(|pixel| pixel.cmpge(DVec2::ZERO).all() && pixel.cmplt(self.size).all())
        {
            return false;
        }
        let to_point = p - self.center;
        !faces.is_blocked(self.center, to_point, 1.0 - hidden_by / to_point.length())
    }
}

/// About `n` points on some faces of a mesh, uniform by area inside the crop box, each with its face. Stratified: the k-th point lies in
/// the k-th part of the area. Where the box cuts much away, more are drawn so that about n remain.
fn draw(
    mesh: &Mesh,
    faces: &[usize],
    crop: Option<[DVec3; 2]>,
    n: usize,
    seed: u64,
) -> Vec<(DVec3, usize)> {
    let mut drawn = draw_uncropped(mesh, faces, n, seed);
    drawn.retain(|&(p, _)| in_box(p, crop));
    let share = drawn.len() as f64 / n as f64;
    if share < 0.9 {
        let more = (n as f64 / share.max(1.0 / 64.0)) as usize;
        drawn = draw_uncropped(mesh, faces, more, seed);
        drawn.retain(|&(p, _)| in_box(p, crop));
    }
    drawn
}

fn draw_uncropped(mesh: &Mesh, faces: &[usize], n: usize, seed: u64) -> Vec<(DVec3, usize)> {
    let mut area = 0.0;
    let area_up_to: Vec<f64> = faces
        .iter()
        .map(|&face| {
            area += mesh.area_vector(face).length();
            area
        })
        .collect();
    if area <= 0.0 {
        return Vec::new();
    }
    let point = |k: usize| {
        let [along, u, v] = uniforms(seed, k as u64);
        let target = area * (k as f64 + along) / n as f64;
        let face = faces[area_up_to
            .partition_point(|&up_to| up_to < target)
            .min(faces.len() - 1)];
        let [a, b, c] = mesh.corners(face);
        // Uniform in a triangle (Osada et al. 2002).
        let root = u.sqrt();
        (
            a * (1.0 - root) + b * (root * (1.0 - v)) + c * (root * v),
            face,
        )
    };
    (0..n).into_par_iter().map(point).collect()
}

/// Three numbers in [0, 1) that depend on nothing but (seed, index).
fn uniforms(seed: u64, index: u64) -> [f64; 3] {
    std::array::from_fn(|i| {
        let nth = index.wrapping_mul(3).wrapping_add(i as u64);
        random::unit(mixed(seed, nth))
    })
}

/// Bits that depend on nothing but (seed, index).
pub(super) fn mixed(seed: u64, index: u64) -> u64 {
    let start = random::mix(seed.wrapping_mul(random::STEP));
    random::mix(start.wrapping_add(index).wrapping_mul(random::STEP))
}
