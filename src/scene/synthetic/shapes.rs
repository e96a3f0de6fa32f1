//! The built-in scene's geometry and paint: signed distances in closed form, and a reflectance for every point of the surface.
//!
//! World frame: right-handed, z up, the floor's top at z = 0, about one unit in radius. Every part's function is zero exactly on its
//! surface, positive outside matter, and never larger in magnitude outside than the Euclidean distance, so that sphere tracing
//! (Hart 1996) cannot step through anything. Spheres, tori, capsules, cylinders and boxes are exact distances; the fluted column, the
//! knot, the gyroid-cut sphere and the Menger cube are bounds.

use std::f64::consts::{PI, TAU};

use glam::{DVec2, DVec3, dvec2, dvec3};

use super::paint;

/// One object of the scene.
pub struct Part {
    /// A box that holds it.
    pub low: DVec3,
    pub high: DVec3,
    distance: fn(DVec3) -> f64,
    /// Linear reflectance of the surface point `p`.
    pub reflectance: fn(DVec3) -> DVec3,
}

impl Part {
    /// Signed distance bound, at least the distance to the part's box: skipping a part because its box is farther than something
    /// already found then never changes the minimum, and the union stays continuous.
    pub fn sdf(&self, p: DVec3) -> f64 {
        let outside = self.box_distance(p);
        if outside > 0.0 {
            (self.distance)(p).max(outside)
        } else {
            (self.distance)(p)
        }
    }

    /// The same for a point that is known to lie within the part's box.
    pub fn sdf_inside_box(&self, p: DVec3) -> f64 {
        (self.distance)(p)
    }

    /// Distance to the part's box; 0 within.
    pub fn box_distance(&self, p: DVec3) -> f64 {
        (self.low - p).max(p - self.high).max(DVec3::ZERO).length()
    }
}

/// The objects, nearest-to-everything first so that the union culls early.
pub static PARTS: [Part; 9] = [
    Part {
        low: dvec3(-FLOOR_RADIUS, -FLOOR_RADIUS, -FLOOR_THICKNESS),
        high: dvec3(FLOOR_RADIUS, FLOOR_RADIUS, 0.0),
        distance: floor,
        reflectance: paint::floor,
    },
    Part {
        low: dvec3(-0.225, -0.225, -0.01),
        high: dvec3(0.225, 0.225, COLUMN_TOP),
        distance: column,
        reflectance: paint::column,
    },
    Part {
        low: dvec3(-0.33, -0.33, 0.35),
        high: dvec3(0.33, 0.33, 1.01),
        distance: pierced_sphere,
        reflectance: paint::pierced_sphere,
    },
    Part {
        low: dvec3(-0.1, -0.1, 0.35),
        high: dvec3(0.1, 0.1, 0.78),
        distance: inner_ball,
        reflectance: paint::inner_ball,
    },
    Part {
        low: dvec3(-0.485, -0.468, 0.525),
        high: dvec3(0.485, 0.468, 0.835),
        distance: hoop,
        reflectance: paint::brass,
    },
    Part {
        low: dvec3(0.22, 0.06, 0.0),
        high: dvec3(0.88, 0.72, 0.50),
        distance: knot,
        reflectance: paint::knot,
    },
    Part {
        low: dvec3(-0.813, 0.116, -0.01),
        high: dvec3(-0.365, 0.564, 0.34),
        distance: menger,
        reflectance: paint::menger,
    },
    Part {
        low: dvec3(-0.727, -0.56, 0.0),
        high: dvec3(-0.387, -0.22, 0.34),
        distance: white_ball,
        reflectance: paint::white,
    },
    Part {
        low: dvec3(-0.30, -0.95, -0.04),
        high: dvec3(0.89, 0.88, 0.66),
        distance: sticks_and_rings,
        reflectance: paint::sticks_and_rings,
    },
];

pub const FLOOR_RADIUS: f64 = 1.05;
const FLOOR_THICKNESS: f64 = 0.08;
const COLUMN_TOP: f64 = 0.36;
pub const SPHERE_CENTER: DVec3 = dvec3(0.0, 0.0, 0.68);
pub const SPHERE_RADIUS: f64 = 0.33;
const KNOT_CENTER: DVec3 = dvec3(0.55, 0.39, 0.25);
/// Radius of the knot's torus, of the winding around it, and of the tube.
const KNOT: [f64; 3] = [0.19, 0.075, 0.036];
/// The cube is sunk by a hair, so that no face of it coincides with the floor.
const MENGER_CENTER: DVec3 = dvec3(-0.589, 0.34, 0.167);
const MENGER_HALF: f64 = 0.17;
const BALL_CENTER: DVec3 = dvec3(-0.557, -0.39, 0.17);
const BALL_RADIUS: f64 = 0.17;
pub const STICKS: usize = 7;

/// A disk with a rounded rim.
fn floor(p: DVec3) -> f64 {
    rounded_cylinder(
        p - dvec3(0.0, 0.0, -0.5 * FLOOR_THICKNESS),
        FLOOR_RADIUS,
        0.5 * FLOOR_THICKNESS,
        0.02,
    )
}

/// A drum with sixteen round grooves, between two plates.
fn column(p: DVec3) -> f64 {
    let radial = p.truncate().length();
    let base = rounded_cylinder(p - dvec3(0.0, 0.0, 0.015), 0.225, 0.025, 0.008);
    let capital = rounded_cylinder(p - dvec3(0.0, 0.0, COLUMN_TOP - 0.02), 0.20, 0.02, 0.008);
    let shaft = rounded_cylinder(p - dvec3(0.0, 0.0, 0.18), 0.17, 0.16, 0.004);
    // The nearest groove, by folding the angle into one sector.
    let sector = TAU / 16.0;
    let angle = p.y.atan2(p.x);
    let folded = angle - sector * (angle / sector).round();
    let groove = (radial * DVec2::from_angle(folded) - dvec2(0.178, 0.0)).length() - 0.025;
    base.min(capital).min(shaft.max(-groove))
}

/// A spherical shell, cut through wherever a gyroid exceeds a level.
fn pierced_sphere(p: DVec3) -> f64 {
    let q = p - SPHERE_CENTER;
    let radius = q.length();
    let shell = (radius - SPHERE_RADIUS).max(SPHERE_RADIUS - 0.065 - radius);
    if shell > 0.05 {
        return shell;
    }
    let k = TAU / 0.33;
    let (s, c) = (sin(k * q), cos(k * q));
    let gyroid = s.x * c.y + s.y * c.z + s.z * c.x;
    // |∇ gyroid| ≤ √3 k.
    shell.max((gyroid - 0.30) / (3f64.sqrt() * k))
}

/// A small ball in the middle of the pierced sphere, on a thin rod.
fn inner_ball(p: DVec3) -> f64 {
    let ball = (p - SPHERE_CENTER).length() - 0.1;
    let rod = capsule(p, dvec3(0.0, 0.0, 0.368), SPHERE_CENTER, 0.018);
    ball.min(rod)
}

/// A thin hoop around the sphere, tilted, on two pins.
fn hoop(p: DVec3) -> f64 {
    let q = p - SPHERE_CENTER;
    // Tilted about x by the angle whose cosine is 0.96.
    let tilted = dvec3(q.x, 0.96 * q.y + 0.28 * q.z, 0.96 * q.z - 0.28 * q.y);
    let ring = torus(tilted, 0.47, 0.014);
    let pins = capsule(
        dvec3(q.x.abs(), q.y, q.z),
        dvec3(0.31, 0.0, 0.0),
        dvec3(0.465, 0.0, 0.0),
        0.011,
    );
    ring.min(pins)
}

/// A trefoil: two turns around the axis, three around the tube's circle.
///
/// At azimuth φ the strands cross the half-plane (ρ, z) at the angles 1.5 φ and 1.5 φ + π. Distance to them within the half-plane
/// has a slope of at most 1.85 in space inside the torus that holds the knot; outside that torus, the distance to it bounds instead.
fn knot(p: DVec3) -> f64 {
    let q = knot_frame(p);
    let [ring, winding, tube] = KNOT;
    let hull = torus(q, ring, winding + tube);
    let across = dvec2(q.truncate().length() - ring, q.z);
    let strand = winding * DVec2::from_angle(1.5 * q.y.atan2(q.x));
    let nearest = (across - strand).length().min((across + strand).length());
    hull.max(((nearest - tube) / 1.85).min(0.01 - hull))
}

/// Coordinates in which the knot's axis is z: it leans away from the middle of the scene by the angle whose cosine is 0.8.
pub fn knot_frame(p: DVec3) -> DVec3 {
    let q = p - KNOT_CENTER;
    let (outward, sideways) = (dvec2(0.8, 0.6), dvec2(-0.6, 0.8));
    let (u, v) = (q.truncate().dot(outward), q.truncate().dot(sideways));
    dvec3(0.8 * u - 0.6 * q.z, v, 0.6 * u + 0.8 * q.z)
}

/// A cube with two generations of square tunnels (Menger 1926).
fn menger(p: DVec3) -> f64 {
    let q = menger_frame(p);
    let mut distance = cuboid(q, DVec3::splat(MENGER_HALF));
    if distance > 0.1 {
        return distance;
    }
    let mut cell = 2.0 * MENGER_HALF;
    for _ in 0..2 {
        // Position within the cell of this generation, and the cross of its three tunnels, a third of the cell wide.
        let within = q + DVec3::splat(MENGER_HALF);
        let r = (within - cell * (within / cell).floor() - DVec3::splat(0.5 * cell)).abs();
        let tunnel = r.x.max(r.y).min(r.y.max(r.z)).min(r.z.max(r.x)) - cell / 6.0;
        distance = distance.max(-tunnel);
        cell /= 3.0;
    }
    distance
}

/// Coordinates along the cube's edges: turned about z by the angle whose cosine is 12/13.
pub fn menger_frame(p: DVec3) -> DVec3 {
    let q = p - MENGER_CENTER;
    let (c, s) = (12.0 / 13.0, 5.0 / 13.0);
    dvec3(c * q.x + s * q.y, c * q.y - s * q.x, q.z)
}

fn white_ball(p: DVec3) -> f64 {
    (p - BALL_CENTER).length() - BALL_RADIUS
}

fn sticks_and_rings(p: DVec3) -> f64 {
    let mut distance = rings(p).into_iter().fold(f64::INFINITY, f64::min);
    for index in 0..STICKS {
        distance = distance.min(stick(p, index));
    }
    distance
}

/// Foot, head and radius of stick `index`: from 2.8 % to 0.9 % of the scene, leaning in turns to either side.
pub const fn stick_axis(index: usize) -> (DVec3, DVec3, f64) {
    // Directions 262° to 338° from the x axis.
    const AROUND: [[f64; 2]; STICKS] = [
        [-0.1392, -0.9903],
        [0.0814, -0.9967],
        [0.2979, -0.9546],
        [0.5, -0.8660],
        [0.6777, -0.7353],
        [0.8225, -0.5687],
        [0.9272, -0.3746],
    ];
    let [x, y] = AROUND[index];
    let lean = if index.is_multiple_of(2) { 0.88 } else { 1.06 };
    let part = index as f64 / (STICKS - 1) as f64;
    let height = 0.60 - 0.24 * part;
    (
        dvec3(0.78 * x, 0.78 * y, -0.01),
        dvec3(0.78 * lean * x, 0.78 * lean * y, height),
        0.028 - 0.019 * part,
    )
}

/// A stick with a knob.
pub fn stick(p: DVec3, index: usize) -> f64 {
    let (foot, head, radius) = stick_axis(index);
    capsule(p, foot, head, radius).min((p - head).length() - 1.9 * radius)
}

/// Two linked rings, one lying, one standing.
pub fn rings(p: DVec3) -> [f64; 2] {
    let q = p - dvec3(-0.06, 0.72, 0.0);
    let lying = torus(q - dvec3(-0.065, 0.0, 0.029), 0.12, 0.03);
    let standing = q - dvec3(0.065, 0.0, 0.148);
    [
        lying,
        torus(dvec3(standing.x, standing.z, standing.y), 0.12, 0.03),
    ]
}

fn rounded_cylinder(p: DVec3, radius: f64, half_height: f64, rounding: f64) -> f64 {
    let d = dvec2(p.truncate().length() - radius, p.z.abs() - half_height) + rounding;
    d.max_element().min(0.0) + d.max(DVec2::ZERO).length() - rounding
}

fn cuboid(p: DVec3, half: DVec3) -> f64 {
    let d = p.abs() - half;
    d.max_element().min(0.0) + d.max(DVec3::ZERO).length()
}

/// Torus around z.
fn torus(p: DVec3, ring: f64, tube: f64) -> f64 {
    dvec2(p.truncate().length() - ring, p.z).length() - tube
}

fn capsule(p: DVec3, a: DVec3, b: DVec3, radius: f64) -> f64 {
    let (along, from_a) = (b - a, p - a);
    let t = (from_a.dot(along) / along.length_squared()).clamp(0.0, 1.0);
    (from_a - t * along).length() - radius
}

fn sin(v: DVec3) -> DVec3 {
    dvec3(v.x.sin(), v.y.sin(), v.z.sin())
}

fn cos(v: DVec3) -> DVec3 {
    dvec3(v.x.cos(), v.y.cos(), v.z.cos())
}

/// Angle of the knot's strand at `p`, in turns, for its stripes.
pub fn knot_turn(p: DVec3) -> f64 {
    let q = knot_frame(p);
    let azimuth = q.y.atan2(q.x);
    let across = dvec2(q.truncate().length() - KNOT[0], q.z);
    // Of the two strands at this azimuth the nearer one is meant; the second is one turn further along the curve.
    let strand = DVec2::from_angle(1.5 * azimuth);
    let turn = if across.dot(strand) >= 0.0 { 0.0 } else { 1.0 };
    0.5 * (azimuth / (2.0 * PI) + turn)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Points of a low-discrepancy sequence in the cube [-1.3, 1.3]³.
    fn points(n: u32) -> impl Iterator<Item = DVec3> {
        (0..n).map(|i| {
            let i = f64::from(i) + 0.5;
            let u = dvec3(0.819_172_513, 0.671_043_607, 0.549_700_478) * i;
            2.6 * (u - u.floor()) - DVec3::splat(1.3)
        })
    }

    #[test]
    fn every_part_lies_inside_its_box() {
        for (index, part) in PARTS.iter().enumerate() {
            for p in points(200_000).filter(|p| part.box_distance(*p) > 0.0) {
                let distance = (part.distance)(p);
                assert!(
                    distance > 0.0,
                    "part {index} reaches out of its box at {p}: {distance}"
                );
            }
        }
    }

    #[test]
    fn every_part_is_a_distance_bound() {
        // A function with slope at most 1 that is zero on the surface cannot exceed the distance to it.
        for (index, part) in PARTS.iter().enumerate() {
            let pairs = points(200_000).zip(points(200_001).skip(1));
            for (near, (p, towards)) in pairs.enumerate() {
                // Half of the points are pulled close to the part, where its details decide.
                let p = if near % 2 == 0 {
                    p
                } else {
                    p.clamp(part.low, part.high)
                };
                let q = p + 1e-3 * (towards - p).normalize();
                let (a, b) = (part.sdf(p), part.sdf(q));
                assert!(
                    (a - b).abs() <= 1.0001e-3,
                    "part {index} at {p}: {a} and {b} a thousandth apart"
                );
            }
        }
    }
}
