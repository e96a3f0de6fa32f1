//! Which part of the world to reconstruct: stated by the user, by the dataset, or estimated from cameras and points.
//!
//! Sparse points hold outliers, and outdoors more background than object, so extents are percentiles of the points that many cameras
//! see. Cameras that look inwards (at an object) bound what they share; cameras that look outwards (from within a room) bound all.

use glam::{DMat3, DMat4, DVec3};
use serde::{Deserialize, Serialize};

use super::{Scene, Split, View};
use crate::{Error, Result};

/// The region to reconstruct. A point of the world has region coordinates `(world - center) / radius`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Region {
    /// World frame.
    pub center: DVec3,
    /// World units per region unit.
    pub radius: f64,
    pub shape: RegionShape,
    /// How it was chosen, for people.
    pub how: String,
}

/// What of the region frame belongs to the region.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum RegionShape {
    /// ‖x‖ ≤ 1
    Sphere,
    /// |x_j| ≤ half_j, the largest of which is 1
    Box { half: DVec3 },
}

impl RegionShape {
    /// Half extents of the smallest box around it, which is about the origin.
    pub fn half_extents(self) -> DVec3 {
        match self {
            RegionShape::Sphere => DVec3::ONE,
            RegionShape::Box { half } => half,
        }
    }

    /// Whether a point of the region frame belongs to it.
    pub fn contains(self, x: DVec3) -> bool {
        match self {
            RegionShape::Sphere => x.length_squared() <= 1.0,
            RegionShape::Box { half } => x.abs().cmple(half).all(),
        }
    }

    /// Whether a box of the region frame has a point in common with it.
    pub fn meets_box(self, low: DVec3, high: DVec3) -> bool {
        match self {
            RegionShape::Sphere => DVec3::ZERO.clamp(low, high).length_squared() <= 1.0,
            RegionShape::Box { half } => low.cmple(half).all() && high.cmpge(-half).all(),
        }
    }

    /// Whether the ray from `x` along the unit vector `direction` (region frame) passes through it.
    pub fn meets_ray(self, x: DVec3, direction: DVec3) -> bool {
        match self {
            RegionShape::Sphere => {
                let nearest = x + direction * (-x.dot(direction)).max(0.0);
                nearest.length_squared() <= 1.0
            }
            RegionShape::Box { half } => {
                let (mut enter, mut leave) = (0.0, f64::INFINITY);
                for axis in 0..3 {
                    let inverse = direction[axis].recip();
                    let (a, b) = (
                        (-half[axis] - x[axis]) * inverse,
                        (half[axis] - x[axis]) * inverse,
                    );
                    // A ray along a side gives NaN on it, which max and min pass over.
                    enter = f64::max(enter, a.min(b));
                    leave = f64::min(leave, a.max(b));
                }
                enter <= leave
            }
        }
    }
}

/// What the user says of the region. World frame and units.
#[derive(Clone, Debug, PartialEq)]
pub struct RegionOverrides {
    pub center: Option<[f64; 3]>,
    pub radius: Option<f64>,
    /// Two opposite corners of a box.
    pub boxed: Option<[[f64; 3]; 2]>,
    /// Enlarges whatever region results about its centre.
    pub scale: f64,
    /// Makes a box of an estimated sphere: the extents of the points, or the sphere's cube.
    pub prefer_box: bool,
}

impl Default for RegionOverrides {
    fn default() -> Self {
        RegionOverrides {
            center: None,
            radius: None,
            boxed: None,
            scale: 1.0,
            prefer_box: false,
        }
    }
}

/// Where the cameras look.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Facing {
    /// At something between or before them: an object, a building, a landscape.
    Inward,
    /// Away from each other, from within: a room.
    Outward,
}

/// Where the cameras look, and what says so.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Looks {
    pub facing: Facing,
    pub why: String,
    /// The point nearest to all optical axes, world frame; `None` where they are nearly parallel.
    pub focus: Option<DVec3>,
}

/// Fewer points than this say nothing about a region.
pub(super) const ENOUGH_POINTS: usize = 50;
/// Points and cameras looked at for visibility: more would not change a percentile.
const SAMPLED_POINTS: usize = 20_000;
const SAMPLED_CAMERAS: usize = 128;

impl Region {
    /// Chooses the region: overrides first, then what the dataset says, then what cameras and points show.
    ///
    /// Errors are [`Error::Config`] for overrides that make no sense and [`Error::Input`] where nothing can be estimated.
    pub fn estimate(scene: &Scene, overrides: &RegionOverrides) -> Result<Region> {
        let wrong = |what: String| Err(Error::Config { what });
        if !(overrides.scale > 0.0 && overrides.scale.is_finite()) {
            return wrong(format!(
                "the region can be scaled by a positive factor, not {}",
                overrides.scale
            ));
        }
        if let Some(radius) = overrides
            .radius
            .filter(|radius| !(*radius > 0.0 && radius.is_finite()))
        {
            return wrong(format!(
                "the region's radius must be positive, not {radius}"
            ));
        }
        if let Some(center) = overrides
            .center
            .filter(|center| !DVec3::from(*center).is_finite())
        {
            return wrong(format!(
                "the region's centre must be finite, not {center:?}"
            ));
        }
        let mut region = match (overrides.boxed, overrides.center, overrides.radius) {
            (Some(_), Some(_), _) | (Some(_), _, Some(_)) => {
                return wrong(
                    "a box states centre and size already: give either it or a centre and radius"
                        .into(),
                );
            }
            (Some([a, b]), None, None) => {
                let (a, b) = (DVec3::from(a), DVec3::from(b));
                let half = (b - a).abs() * 0.5;
                if !(half.is_finite() && half.min_element() > 0.0) {
                    return wrong(format!(
                        "the box from {a} to {b} is empty: its corners must differ along every axis"
                    ));
                }
                Region::of_box((a + b) * 0.5, half, "the box given".into())
            }
            (None, Some(center), Some(radius)) => {
                Region::of_sphere(center.into(), radius, "the centre and radius given".into())
            }
            (None, center, radius) => {
                let mut region = stated_or_estimated(scene, overrides.prefer_box)?;
                if let Some(center) = center {
                    region.center = center.into();
                    region.how = format!("centre given; radius: {}", region.how);
                }
                if let Some(radius) = radius {
                    region.radius = radius;
                    region.how = format!("radius given; centre: {}", region.how);
                }
                region
            }
        };
        if overrides.prefer_box && region.shape == RegionShape::Sphere {
            region.shape = RegionShape::Box { half: DVec3::ONE };
        }
        if overrides.scale != 1.0 {
            region.radius *= overrides.scale;
            region.how = format!("{}, enlarged {} times", region.how, overrides.scale);
        }
        if !(region.center.is_finite() && region.radius.is_finite() && region.radius > 0.0) {
            return Err(Error::input(
                &scene.root,
                format!(
                    "no region can be estimated: centre {}, radius {} from {} cameras and {} points",
                    region.center,
                    region.radius,
                    scene.views.len(),
                    scene.points.len()
                ),
                "give one with --center x,y,z --radius r",
            ));
        }
        tracing::debug!(
            center = ?region.center.to_array(),
            radius = region.radius,
            shape = ?region.shape,
            how = region.how,
            "region estimated"
        );
        Ok(region)
    }

    fn of_sphere(center: DVec3, radius: f64, how: String) -> Region {
        Region {
            center,
            radius,
            shape: RegionShape::Sphere,
            how,
        }
    }

    fn of_box(center: DVec3, half: DVec3, how: String) -> Region {
        let radius = half.max_element();
        Region {
            center,
            radius,
            shape: RegionShape::Box {
                half: half / radius,
            },
            how,
        }
    }

    /// Region coordinates to the world's.
    pub fn world_from_region(&self) -> DMat4 {
        DMat4::from_translation(self.center) * DMat4::from_scale(DVec3::splat(self.radius))
    }

    /// World coordinates to the region's.
    pub fn region_from_world(&self) -> DMat4 {
        DMat4::from_scale(DVec3::splat(self.radius.recip())) * DMat4::from_translation(-self.center)
    }

    /// Whether `point` (world frame) lies inside.
    pub fn contains(&self, point: DVec3) -> bool {
        self.shape.contains((point - self.center) / self.radius)
    }

    /// Whether the ray from `origin` along the unit vector `direction` (world frame) passes through it.
    pub fn meets_ray(&self, origin: DVec3, direction: DVec3) -> bool {
        let origin = (origin - self.center) / self.radius;
        self.shape.meets_ray(origin, direction)
    }

    /// How many of the scene's views stand inside.
    pub fn cameras_inside(&self, scene: &Scene) -> usize {
        scene
            .views
            .iter()
            .filter(|view| self.contains(view.position()))
            .count()
    }

    /// How many of the scene's points lie inside.
    pub fn points_inside(&self, scene: &Scene) -> usize {
        scene
            .points
            .iter()
            .filter(|point| self.contains(point.position))
            .count()
    }
}

fn stated_or_estimated(scene: &Scene, prefer_box: bool) -> Result<Region> {
    if let Some(hint) = &scene.region_hint {
        return Ok(match hint.half {
            Some(half) => Region::of_box(hint.center, half, hint.how.clone()),
            None => Region::of_sphere(hint.center, hint.radius, hint.how.clone()),
        });
    }
    let looks = Looks::of(scene);
    let cameras: Vec<DVec3> = train_views(scene).map(View::position).collect();
    let points = sampled_points(scene);
    if points.len() < ENOUGH_POINTS {
        return Ok(from_cameras(scene, &looks, &cameras));
    }
    let (kept, how) = match looks.facing {
        Facing::Inward => shared_points(scene, &points),
        Facing::Outward => {
            let all = points.iter().chain(&cameras).copied().collect();
            (
                all,
                "the sparse points and the cameras, which look outwards".into(),
            )
        }
    };
    let kept = without_outliers(kept);
    let (low, high) = percentile_box(&kept, 0.005, 0.995);
    let (mut low, mut high) = (low, high);
    if looks.facing == Facing::Outward {
        // A room holds its cameras, wherever its points are.
        for camera in &cameras {
            low = low.min(*camera);
            high = high.max(*camera);
        }
    }
    let center = (low + high) * 0.5;
    const MARGIN: f64 = 1.1;
    if prefer_box {
        return Ok(Region::of_box(center, (high - low) * (0.5 * MARGIN), how));
    }
    let mut distances: Vec<f64> = kept.iter().map(|point| point.distance(center)).collect();
    let mut radius = percentile(&mut distances, 0.995);
    if looks.facing == Facing::Outward {
        radius = cameras
            .iter()
            .map(|camera| camera.distance(center))
            .fold(radius, f64::max);
    }
    Ok(Region::of_sphere(center, radius * MARGIN, how))
}

/// Without points: the ball about the focus that every camera's picture holds, or a guess around cameras that look outwards.
fn from_cameras(scene: &Scene, looks: &Looks, cameras: &[DVec3]) -> Region {
    if let (Facing::Inward, Some(focus)) = (looks.facing, looks.focus) {
        let mut fitting: Vec<f64> = train_views(scene)
            .map(|view| view.position().distance(focus) * view.camera.half_angle().min(1.2).sin())
            .collect();
        let radius = percentile(&mut fitting, 0.5);
        return Region::of_sphere(
            focus,
            radius,
            "no points: a ball about the point nearest to all optical axes that fills the median picture".into(),
        );
    }
    let (low, high) = percentile_box(cameras, 0.0, 1.0);
    let center = (low + high) * 0.5;
    let reach = cameras
        .iter()
        .map(|camera| camera.distance(center))
        .fold(0.0, f64::max);
    if looks.facing == Facing::Inward {
        // Parallel views: something as wide as the cameras' spread, that far before them.
        let forward = train_views(scene)
            .map(View::forward)
            .sum::<DVec3>()
            .normalize_or_zero();
        return Region::of_sphere(
            center + forward * 2.0 * reach,
            1.5 * reach,
            "no points and parallel views: a guess from how far the cameras are spread; give --center and --radius".into(),
        );
    }
    // sdfstudio's indoor convention puts the cameras within a fifth to a fourth of its box.
    Region::of_sphere(
        center,
        4.0 * reach,
        "no points and cameras that look outwards: four times the cameras' reach, a guess; give --center and --radius".into(),
    )
}

/// The points that at least half as many cameras see as see a well-seen point: what the pictures share.
fn shared_points(scene: &Scene, points: &[DVec3]) -> (Vec<DVec3>, String) {
    let views: Vec<&View> = train_views(scene).collect();
    let stride = views.len().div_ceil(SAMPLED_CAMERAS).max(1);
    let views: Vec<&View> = views.into_iter().step_by(stride).collect();
    let counts: Vec<f64> = points
        .iter()
        .map(|point| {
            views
                .iter()
                .filter(|view| view.sees(*point).is_some())
                .count() as f64
        })
        .collect();
    let well_seen = percentile(&mut counts.clone(), 0.9);
    let threshold = (0.5 * well_seen).max(1.0);
    let shared: Vec<DVec3> = points
        .iter()
        .zip(&counts)
        .filter(|(_, count)| **count >= threshold)
        .map(|(point, _)| *point)
        .collect();
    if shared.len() < ENOUGH_POINTS {
        return (points.to_vec(), "the sparse points".into());
    }
    let how = format!(
        "the {:.0} % of the sparse points that at least {threshold:.0} of {} cameras see",
        100.0 * shared.len() as f64 / points.len() as f64,
        views.len()
    );
    (shared, how)
}

/// What lies within the box of the middle nine tenths, enlarged by half its size to each side.
fn without_outliers(points: Vec<DVec3>) -> Vec<DVec3> {
    let (low, high) = percentile_box(&points, 0.05, 0.95);
    let margin = (high - low) * 0.5 + DVec3::splat((high - low).max_element() * 0.05);
    let (low, high) = (low - margin, high + margin);
    points
        .into_iter()
        .filter(|point| point.cmpge(low).all() && point.cmple(high).all())
        .collect()
}

impl Looks {
    /// Judges by the optical axes, and by the points where they decide more.
    pub fn of(scene: &Scene) -> Looks {
        let views: Vec<&View> = train_views(scene).collect();
        let count = views.len().max(1) as f64;
        let focus = nearest_to_axes(&views);
        let seeing = focus.map_or(0.0, |focus| {
            views
                .iter()
                .filter(|view| view.sees(focus).is_some())
                .count() as f64
                / count
        });
        let agreement = views
            .iter()
            .map(|view| view.forward())
            .sum::<DVec3>()
            .length()
            / count;
        let looks = |facing: Facing, why: String| Looks { facing, why, focus };
        if agreement > 0.8 {
            return looks(
                Facing::Inward,
                format!("the cameras all look the same way (mean axis has length {agreement:.2})"),
            );
        }
        let axes = format!(
            "the point nearest to all optical axes is in {:.0} % of the pictures",
            100.0 * seeing
        );
        let points = sampled_points(scene);
        if points.len() < ENOUGH_POINTS {
            let facing = if seeing >= 0.7 {
                Facing::Inward
            } else {
                Facing::Outward
            };
            return looks(facing, axes);
        }
        let middle = median_point(&points);
        let median_distance = |from: &mut dyn Iterator<Item = DVec3>| {
            percentile(
                &mut from.map(|point| point.distance(middle)).collect::<Vec<_>>(),
                0.5,
            )
        };
        let of_points = median_distance(&mut points.iter().copied());
        let of_cameras = median_distance(&mut views.iter().map(|view| view.position()));
        let distances = format!(
            "from the middle of the points, the median camera is {of_cameras:.3} away and the median point {of_points:.3}"
        );
        // Background can outnumber an object's points, but not turn the cameras away from it; a room's far walls lie beyond cameras.
        let inward = seeing >= 0.9 && of_cameras > 0.3 * of_points
            || seeing >= 0.5 && of_cameras > of_points
            || of_cameras > 1.5 * of_points;
        let facing = if inward {
            Facing::Inward
        } else {
            Facing::Outward
        };
        looks(facing, format!("{axes}; {distances}"))
    }
}

/// The point x that minimises Σ ‖(I - d dᵀ)(x - o)‖² over the optical axes; `None` where they are within a few degrees of parallel.
fn nearest_to_axes(views: &[&View]) -> Option<DVec3> {
    let (mut normal, mut right) = (DMat3::ZERO, DVec3::ZERO);
    for view in views {
        let d = view.forward();
        let across = DMat3::IDENTITY - DMat3::from_cols(d * d.x, d * d.y, d * d.z);
        normal += across;
        right += across * view.position();
    }
    let inverse = normal.inverse();
    // The norm of the inverse is one over the smallest eigenvalue: the mean squared sine between axes and the direction that they fix worst.
    let norm = inverse
        .to_cols_array()
        .into_iter()
        .map(|entry| entry * entry)
        .sum::<f64>()
        .sqrt();
    let fixed = 1.0 / (norm * views.len() as f64);
    (fixed.is_finite() && fixed > 2e-3).then(|| inverse * right)
}

pub(super) fn train_views(scene: &Scene) -> impl Iterator<Item = &View> {
    scene.views.iter().filter(|view| view.split == Split::Train)
}

/// Evenly strided, so that the same dataset gives the same region.
pub(super) fn sampled_points(scene: &Scene) -> Vec<DVec3> {
    let stride = scene.points.len().div_ceil(SAMPLED_POINTS).max(1);
    scene
        .points
        .iter()
        .step_by(stride)
        .map(|point| point.position)
        .collect()
}

/// The value below which `share` of the values lie, interpolated. NaN of none.
fn percentile(values: &mut [f64], share: f64) -> f64 {
    if values.is_empty() {
        return f64::NAN;
    }
    values.sort_by(f64::total_cmp);
    let at = share * (values.len() - 1) as f64;
    let (below, fraction) = (at.floor() as usize, at.fract());
    let above = (below + 1).min(values.len() - 1);
    values[below] + (values[above] - values[below]) * fraction
}

fn percentile_box(points: &[DVec3], low: f64, high: f64) -> (DVec3, DVec3) {
    let along = |axis: usize, share: f64| {
        percentile(
            &mut points.iter().map(|point| point[axis]).collect::<Vec<_>>(),
            share,
        )
    };
    let corner = |share: f64| DVec3::new(along(0, share), along(1, share), along(2, share));
    (corner(low), corner(high))
}

fn median_point(points: &[DVec3]) -> DVec3 {
    percentile_box(points, 0.5, 0.5).0
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rays_meet_spheres_and_boxes() {
        let region = |shape| Region {
            center: DVec3::new(1.0, 0.0, 0.0),
            radius: 2.0,
            shape,
            how: String::new(),
        };
        let ball = region(RegionShape::Sphere);
        let slab = region(RegionShape::Box {
            half: DVec3::new(1.0, 0.5, 0.25),
        });
        for (origin, direction, ball_met, slab_met) in [
            ([5.0, 0.0, 0.0], [-1.0, 0.0, 0.0], true, true),
            ([5.0, 0.0, 0.0], [1.0, 0.0, 0.0], false, false),
            ([5.0, 0.0, 1.0], [-1.0, 0.0, 0.0], true, false),
            ([5.0, 1.5, 0.0], [-1.0, 0.0, 0.0], true, false),
            ([5.0, 2.5, 0.0], [-1.0, 0.0, 0.0], false, false),
            ([1.5, 0.5, 0.2], [0.0, 0.0, 1.0], true, true),
            ([1.5, 0.5, 5.0], [0.6, 0.0, -0.8], false, false),
        ] {
            let (origin, direction) = (DVec3::from(origin), DVec3::from(direction));
            assert_eq!(
                ball.meets_ray(origin, direction),
                ball_met,
                "{origin} {direction}"
            );
            assert_eq!(
                slab.meets_ray(origin, direction),
                slab_met,
                "{origin} {direction}"
            );
        }
    }
}
