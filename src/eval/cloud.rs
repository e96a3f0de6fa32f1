//! Point clouds as evaluation protocols want them: evenly dense, and distances between them.

use std::collections::HashMap;

use glam::{DVec3, I64Vec3};
use rayon::prelude::*;

use super::geometry::mixed;
use crate::mesh::Mesh;
use crate::mesh::bvh::Bvh;
use crate::{Error, Result};

/// More points than this come of a mesh in other units than its reference.
const MOST_POINTS: f64 = 4e8;

/// The distance from each of `from` to the nearest of `to`; infinite where there is none.
pub fn distances(from: &[DVec3], to: &[DVec3]) -> Vec<f64> {
    let to = Bvh::new(to.to_vec());
    from.par_iter().map(|&p| to.distance(p)).collect()
}

/// One point for each cube of side `size` that holds points: their mean. The cubes begin half a side below the smallest coordinates.
pub fn voxel_means(points: &[DVec3], size: f64) -> Vec<DVec3> {
    let Some([low, _]) = crate::mesh::bounds(points) else {
        return Vec::new();
    };
    let origin = low - 0.5 * size;
    let mut cells: Vec<([i64; 3], u32)> = points
        .par_iter()
        .enumerate()
        .map(|(index, &p)| (cell(p - origin, size).to_array(), index as u32))
        .collect();
    cells.par_sort_unstable();
    cells
        .chunk_by(|(a, _), (b, _)| a == b)
        .map(|members| {
            let sum: DVec3 = members.iter().map(|&(_, at)| points[at as usize]).sum();
            sum / members.len() as f64
        })
        .collect()
}

/// Points of which no two are nearer than `spacing`, such that none of those left out could be added: one by one in an order that
/// depends on `seed` alone.
pub fn thinned(points: &[DVec3], spacing: f64, seed: u64) -> Vec<DVec3> {
    let mut order: Vec<u32> = (0..points.len() as u32).collect();
    order.par_sort_unstable_by_key(|&index| (mixed(seed, u64::from(index)), index));
    let mut kept: HashMap<I64Vec3, Vec<DVec3>> = HashMap::new();
    let mut thin = Vec::new();
    for index in order {
        let p = points[index as usize];
        let home = cell(p, spacing);
        let crowded = (0..27).any(|neighbour| {
            let offset = I64Vec3::new(neighbour % 3, neighbour / 3 % 3, neighbour / 9) - 1;
            let there = kept.get(&(home + offset));
            there.is_some_and(|there| {
                there
                    .iter()
                    .any(|q| q.distance_squared(p) < spacing * spacing)
            })
        });
        if !crowded {
            kept.entry(home).or_default().push(p);
            thin.push(p);
        }
    }
    thin
}

/// Points on every face, their neighbours at most `spacing` away, corners included; without faces, the vertices.
///
/// # Errors
/// `Config` if that would be more points than a mesh in sensible units has.
pub fn lattice(mesh: &Mesh, spacing: f64) -> Result<Vec<DVec3>> {
    if mesh.faces.is_empty() {
        return Ok(mesh.positions.clone());
    }
    let parts = |face: usize| {
        let [a, b, c] = mesh.corners(face);
        let longest = a.distance(b).max(b.distance(c)).max(c.distance(a));
        (longest / spacing).ceil().max(1.0)
    };
    let faces = 0..mesh.faces.len();
    let wanted: f64 = faces
        .clone()
        .map(|face| 0.5 * (parts(face) + 1.0) * (parts(face) + 2.0))
        .sum();
    if wanted > MOST_POINTS {
        return Err(Error::Config {
            what: format!(
                "points every {spacing} on the mesh would be {wanted:.1e}: is it in the reference's units? --align takes it there"
            ),
        });
    }
    let on_face = |face: usize| {
        let [a, b, c] = mesh.corners(face);
        let n = parts(face) as u32;
        (0..=n).flat_map(move |i| {
            (0..=n - i).map(move |j| {
                let (u, v) = (f64::from(i) / f64::from(n), f64::from(j) / f64::from(n));
                a + (b - a) * u + (c - a) * v
            })
        })
    };
    Ok(faces.into_par_iter().flat_map_iter(on_face).collect())
}

fn cell(p: DVec3, size: f64) -> I64Vec3 {
    (p / size).floor().as_i64vec3()
}
