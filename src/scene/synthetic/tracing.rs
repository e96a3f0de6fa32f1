//! Sphere tracing of the built-in scene, and its light: a sun with a soft shadow, and an even sky.
//!
//! A ray meets the boxes of the parts first and is traced only inside those it passes (Hart 1996: step by the distance bound).
//! Every term of the light is a function of the surface point alone, Lambert's law included, so all views agree on every colour.

use glam::{DVec3, dvec3};

use super::shapes::{PARTS, Part};

/// Linear colour of the sky, in every direction.
pub const SKY: DVec3 = dvec3(0.60, 0.70, 0.82);
/// Towards the sun: unit.
pub const SUN: DVec3 = dvec3(0.48, -0.36, 0.80);
const SUN_COLOR: DVec3 = dvec3(1.02, 0.95, 0.83);
/// Light that comes back from below.
const BOUNCE: DVec3 = dvec3(0.20, 0.17, 0.14);
/// A hit is where the bound falls below this.
const TOUCH: f64 = 1e-6;
/// Cotangent of the half angle of the penumbra.
const SHADOW_SHARPNESS: f64 = 18.0;

/// Where a ray meets the surface.
#[derive(Clone, Copy, Debug)]
pub struct Hit {
    /// Distance along the ray.
    pub distance: f64,
    pub point: DVec3,
    /// Outward unit normal.
    pub normal: DVec3,
    /// Index into the parts.
    pub part: usize,
}

/// Signed distance bound of the whole scene at `p`: zero exactly on the surface, positive in free space, never larger there than the
/// Euclidean distance.
pub fn sdf(p: DVec3) -> f64 {
    let mut nearest = f64::INFINITY;
    for part in &PARTS {
        if part.box_distance(p) < nearest {
            nearest = nearest.min(part.sdf(p));
        }
    }
    nearest
}

/// The part that is nearest to `p`.
pub fn nearest_part(p: DVec3) -> usize {
    let mut best = (0, f64::INFINITY);
    for (index, part) in PARTS.iter().enumerate() {
        let distance = part.sdf(p);
        if distance < best.1 {
            best = (index, distance);
        }
    }
    best.0
}

/// First meeting of the ray with the surface within `far`; `direction` is of unit length.
pub fn trace(origin: DVec3, direction: DVec3, far: f64) -> Option<Hit> {
    let mut nearest = far;
    let mut hit = None;
    for (index, part) in PARTS.iter().enumerate() {
        let Some((enter, leave)) = cross(part, origin, direction, 0.0) else {
            continue;
        };
        let leave = leave.min(nearest);
        let mut t = enter.max(0.0);
        while t < leave {
            let distance = part.sdf_inside_box(origin + t * direction);
            if distance < TOUCH {
                nearest = t;
                hit = Some(index);
                break;
            }
            t += distance.max(TOUCH);
        }
    }
    hit.map(|part| {
        let point = origin + nearest * direction;
        Hit {
            distance: nearest,
            point,
            normal: part_normal(&PARTS[part], point),
            part,
        }
    })
}

/// Whether the straight line between two points is free, their last `margin` left out at either end.
pub fn visible(from: DVec3, to: DVec3, margin: f64) -> bool {
    let length = (to - from).length();
    let direction = (to - from) / length;
    trace(from + margin * direction, direction, length - 2.0 * margin).is_none()
}

/// Outward unit normal of the scene's surface near `p`.
pub fn normal(p: DVec3) -> DVec3 {
    part_normal(&PARTS[nearest_part(p)], p)
}

/// Gradient direction by four evaluations on a tetrahedron.
fn part_normal(part: &Part, p: DVec3) -> DVec3 {
    const H: f64 = 1e-5;
    const CORNERS: [DVec3; 4] = [
        dvec3(1.0, -1.0, -1.0),
        dvec3(-1.0, -1.0, 1.0),
        dvec3(-1.0, 1.0, -1.0),
        dvec3(1.0, 1.0, 1.0),
    ];
    let gradient: DVec3 = CORNERS
        .iter()
        .map(|&corner| corner * part.sdf(p + H * corner))
        .sum();
    gradient.normalize_or(DVec3::Z)
}

/// Linear colour that leaves the surface at a hit, the same in all directions.
pub fn radiance(hit: &Hit) -> DVec3 {
    let Hit { point, normal, .. } = *hit;
    let start = point + 2e-4 * normal;
    let facing = normal.dot(SUN).max(0.0);
    let sun = if facing > 0.0 {
        facing * sunlight(start)
    } else {
        0.0
    };
    let open = openness(point, normal);
    let up = 0.5 + 0.5 * normal.z;
    let light = SUN_COLOR * sun + (0.62 * SKY * up + BOUNCE * (1.0 - up)) * open;
    (PARTS[hit.part].reflectance)(point) * light
}

/// Share of the sun that is seen from `start`: the narrowest clearance along the way, as an angle, stands for the covered part of its
/// disk.
fn sunlight(start: DVec3) -> f64 {
    const REACH: f64 = 1.4;
    let mut clearance: f64 = 1.0;
    for part in &PARTS {
        let Some((enter, leave)) = cross(part, start, SUN, 0.06) else {
            continue;
        };
        let mut t = enter.max(0.004);
        let leave = leave.min(REACH);
        while t < leave {
            let distance = part.sdf(start + t * SUN);
            clearance = clearance.min(SHADOW_SHARPNESS * distance / t);
            if clearance <= 0.0 {
                return 0.0;
            }
            t += distance.max(0.003);
        }
    }
    clearance * clearance * (3.0 - 2.0 * clearance)
}

/// Share of the sky that is open above `point`: how far the distance grows along the normal, at four heights.
fn openness(point: DVec3, normal: DVec3) -> f64 {
    let mut covered = 0.0;
    let mut weight = 1.0;
    for height in [0.015, 0.045, 0.11, 0.22] {
        covered += weight * (height - sdf(point + height * normal)).max(0.0) / height;
        weight *= 0.6;
    }
    1.0 - 0.85 * covered / (1.0 + 0.6 + 0.36 + 0.216)
}

/// Where the ray enters and leaves the part's box, widened by `margin`.
fn cross(part: &Part, origin: DVec3, direction: DVec3, margin: f64) -> Option<(f64, f64)> {
    let inverse = direction.recip();
    let a = (part.low - DVec3::splat(margin) - origin) * inverse;
    let b = (part.high + DVec3::splat(margin) - origin) * inverse;
    let enter = a.min(b).max_element();
    let leave = a.max(b).min_element();
    (enter < leave && leave > 0.0).then_some((enter, leave))
}
