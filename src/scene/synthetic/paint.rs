//! The built-in scene's paint: linear reflectance as a function of the surface point.
//!
//! Contrast at a few per cent of the scene's radius almost everywhere, since it is what multi-view consistency is measured by; one
//! part, the white ball, has none on purpose. Noise is value noise on an integer lattice with quintic interpolation (Perlin 2002),
//! summed over octaves.

use glam::{DVec3, dvec3};

use super::shapes::{
    FLOOR_RADIUS, SPHERE_CENTER, STICKS, knot_turn, menger_frame, rings, stick, stick_axis,
};

const CREAM: DVec3 = dvec3(0.78, 0.70, 0.56);
const OCHRE: DVec3 = dvec3(0.72, 0.46, 0.14);
const BRICK: DVec3 = dvec3(0.52, 0.17, 0.09);
const SLATE: DVec3 = dvec3(0.12, 0.20, 0.32);
const SAGE: DVec3 = dvec3(0.25, 0.36, 0.22);
const GOLD: DVec3 = dvec3(0.85, 0.58, 0.18);
const TEAL: DVec3 = dvec3(0.03, 0.33, 0.36);

/// Rings of tiles with dark joints, each tile of its own colour and grain.
pub fn floor(p: DVec3) -> DVec3 {
    const RING: f64 = 0.105;
    let radius = p.truncate().length();
    if radius > FLOOR_RADIUS - 0.02 || p.z < -0.012 {
        return SLATE.lerp(CREAM, 0.25 + 0.5 * noise(12.0 * p, 3));
    }
    let ring = (radius / RING).floor();
    let tiles = (6.0 * ring).max(1.0);
    let turn = (p.y.atan2(p.x) / std::f64::consts::TAU + 1.0 + 0.37 * ring) * tiles;
    let tile = turn.floor();
    let joint = {
        let across = radius / RING - ring;
        let along = turn - tile;
        let length = std::f64::consts::TAU * (ring + 0.5) * RING / tiles;
        let to_ring = across.min(1.0 - across) * RING;
        let to_side = along.min(1.0 - along) * length;
        smoothstep(0.004, 0.009, to_ring.min(to_side))
    };
    let pick = lattice(ring as i32, tile as i32, 7);
    let base = [CREAM, OCHRE, BRICK, SLATE, SAGE][(pick * 5.0) as usize % 5];
    let shade = 0.75 + 0.5 * lattice(ring as i32, tile as i32, 11);
    let grain = 0.55 + 0.9 * noise(38.0 * p + dvec3(pick * 19.0, 0.0, 0.0), 3);
    dvec3(0.05, 0.045, 0.04).lerp((base * shade * grain).min(DVec3::splat(0.9)), joint)
}

/// Pale stone with dark veins.
pub fn column(p: DVec3) -> DVec3 {
    let warp = 1.6 * noise(9.0 * p, 3);
    let vein = (1.0 - (2.0 * noise(7.0 * p + DVec3::splat(warp), 3) - 1.0).abs()).powi(6);
    let grain = 0.8 + 0.4 * noise(60.0 * p, 2);
    CREAM.lerp(SLATE, 0.85 * vein) * grain
}

/// Glaze: bands of latitude in teal and cream, mottled.
pub fn pierced_sphere(p: DVec3) -> DVec3 {
    let q = p - SPHERE_CENTER;
    let mottle = noise(24.0 * q, 3);
    let band = (26.0 * q.z + 3.0 * (mottle - 0.5)).sin();
    let inside = smoothstep(0.300, 0.285, q.length());
    TEAL.lerp(CREAM, smoothstep(-0.25, 0.25, band))
        .lerp(BRICK, inside)
        * (0.6 + 0.7 * mottle)
}

pub fn inner_ball(p: DVec3) -> DVec3 {
    let spots = smoothstep(0.5, 0.58, noise(30.0 * p, 2));
    GOLD.lerp(BRICK, spots)
}

pub fn brass(p: DVec3) -> DVec3 {
    GOLD * (0.45 + 0.8 * noise(22.0 * p, 2))
}

/// Stripes that follow the strand.
pub fn knot(p: DVec3) -> DVec3 {
    let turn = knot_turn(p) * 18.0;
    let stripe = turn - turn.floor();
    let base = if stripe < 0.5 { BRICK * 1.2 } else { CREAM };
    base * (0.6 + 0.8 * noise(32.0 * p, 2))
}

/// Wood, sawn from one log.
pub fn menger(p: DVec3) -> DVec3 {
    let q = menger_frame(p);
    let from_axis = dvec3(q.x + 0.11, 0.35 * q.y, q.z + 0.26).length();
    let ring = 0.5 + 0.5 * (95.0 * (from_axis + 0.03 * noise(6.0 * q, 2))).sin();
    let fibre = noise(dvec3(70.0 * q.x, 9.0 * q.y, 70.0 * q.z), 2);
    OCHRE.lerp(dvec3(0.20, 0.09, 0.04), 0.6 * ring) * (0.7 + 0.6 * fibre)
}

/// No texture at all.
pub fn white(_: DVec3) -> DVec3 {
    DVec3::splat(0.80)
}

/// Each stick ringed in its own colour; one blue and one green ring.
pub fn sticks_and_rings(p: DVec3) -> DVec3 {
    let [lying, standing] = rings(p);
    let mottle = 0.6 + 0.8 * noise(28.0 * p, 2);
    if lying < 0.02 {
        return SAGE * 1.3 * mottle;
    }
    if standing < 0.02 {
        return dvec3(0.10, 0.24, 0.55) * mottle;
    }
    let (index, _) =
        (0..STICKS)
            .map(|index| (index, stick(p, index)))
            .fold((0, f64::INFINITY), |best, next| {
                if next.1 < best.1 { next } else { best }
            });
    let (foot, head, radius) = stick_axis(index);
    if (p - head).length() < 1.95 * radius {
        return GOLD * mottle;
    }
    let along = (p - foot).dot((head - foot).normalize());
    let dark = [
        BRICK,
        SLATE,
        TEAL,
        OCHRE * 0.6,
        SAGE * 0.7,
        BRICK * 0.5,
        SLATE,
    ][index];
    if (along / 0.07).rem_euclid(1.0) < 0.5 {
        dark
    } else {
        CREAM
    }
}

/// Value noise in [0, 1] over `octaves`, each of twice the frequency and half the weight.
fn noise(p: DVec3, octaves: u32) -> f64 {
    let (mut sum, mut total, mut weight, mut q) = (0.0, 0.0, 1.0, p);
    for _ in 0..octaves {
        sum += weight * value_noise(q);
        total += weight;
        weight *= 0.5;
        q = 2.0 * q + DVec3::splat(17.3);
    }
    sum / total
}

fn value_noise(p: DVec3) -> f64 {
    let cell = p.floor();
    let t = p - cell;
    let t = t * t * t * (t * (6.0 * t - 15.0) + 10.0);
    let (x, y, z) = (cell.x as i32, cell.y as i32, cell.z as i32);
    let edge = |dy: i32, dz: i32| {
        let a = lattice(x, y.wrapping_add(dy), z.wrapping_add(dz));
        let b = lattice(x.wrapping_add(1), y.wrapping_add(dy), z.wrapping_add(dz));
        a + (b - a) * t.x
    };
    let face = |dz: i32| {
        let (a, b) = (edge(0, dz), edge(1, dz));
        a + (b - a) * t.y
    };
    let (a, b) = (face(0), face(1));
    a + (b - a) * t.z
}

/// A number in [0, 1) for a lattice point, by integer mixing.
fn lattice(x: i32, y: i32, z: i32) -> f64 {
    let mut h = (x as u32).wrapping_mul(0x9e37_79b1)
        ^ (y as u32).wrapping_mul(0x85eb_ca77).rotate_left(11)
        ^ (z as u32).wrapping_mul(0xc2b2_ae3d).rotate_left(22);
    h = (h ^ (h >> 15)).wrapping_mul(0x2c1b_3c6d);
    h = (h ^ (h >> 12)).wrapping_mul(0x297a_2d39);
    h ^= h >> 15;
    f64::from(h >> 8) / f64::from(1u32 << 24)
}

fn smoothstep(from: f64, to: f64, x: f64) -> f64 {
    let t = ((x - from) / (to - from)).clamp(0.0, 1.0);
    t * t * (3.0 - 2.0 * t)
}
