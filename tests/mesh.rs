//! Mesh extraction against analytic surfaces: closed, manifold, where the field is zero, the same whatever the block size.

use std::collections::HashMap;

use glam::{DMat4, DVec3};
use neurodin::Result;
use neurodin::mesh::extract::{PointAttributes, extract_surface};
use neurodin::mesh::{Domain, ExtractOptions, Lattice, Mesh, SurfaceAttributes, extract_mesh};
use proptest::prelude::*;

/// A field given by a function of the position; evaluated in float64 and rounded.
struct Analytic<F: Fn(DVec3) -> f64>(F);

impl<F: Fn(DVec3) -> f64> Lattice for Analytic<F> {
    fn sdf(
        &mut self,
        origin: DVec3,
        step: f64,
        dims: [usize; 3],
        values: &mut Vec<f32>,
    ) -> Result<()> {
        values.clear();
        for z in 0..dims[2] {
            for y in 0..dims[1] {
                for x in 0..dims[0] {
                    // float32 positions, as a device has them.
                    let at = DVec3::new(x as f64, y as f64, z as f64).as_vec3() * step as f32
                        + origin.as_vec3();
                    values.push((self.0)(at.as_dvec3()) as f32);
                }
            }
        }
        Ok(())
    }
}

impl<F: Fn(DVec3) -> f64> SurfaceAttributes for Analytic<F> {
    fn attributes(&mut self, points: &[[f32; 3]]) -> Result<PointAttributes> {
        let position = |p: &[f32; 3]| DVec3::from(p.map(f64::from));
        let color = |p: &[f32; 3]| p.map(|x| 0.5 + 0.5 * x);
        let gradient = |p: &[f32; 3]| {
            let slope = |axis: DVec3| {
                ((self.0)(position(p) + 1e-4 * axis) - (self.0)(position(p) - 1e-4 * axis)) / 2e-4
            };
            [
                slope(DVec3::X) as f32,
                slope(DVec3::Y) as f32,
                slope(DVec3::Z) as f32,
            ]
        };
        Ok((
            points.iter().map(color).collect(),
            points.iter().map(gradient).collect(),
        ))
    }
}

fn extract(field: impl Fn(DVec3) -> f64, options: &ExtractOptions) -> Mesh {
    extract_mesh(&mut Analytic(field), options, &mut |_| true).unwrap()
}

fn sphere(p: DVec3) -> f64 {
    (p - DVec3::new(0.03, -0.02, 0.01)).length() - 0.6
}

fn torus(p: DVec3) -> f64 {
    DVec3::new(p.truncate().length() - 0.6, p.z, 0.0).length() - 0.23
}

/// Checks that every edge has two triangles that run along it in opposite directions and that the triangles around a vertex form one
/// fan; returns the Euler characteristic.
fn assert_closed_manifold(mesh: &Mesh) -> i64 {
    let mut next_around: HashMap<(u32, u32), u32> = HashMap::new(); // (vertex, neighbour) -> next neighbour
    for &[a, b, c] in &mesh.faces {
        assert!(
            a != b && b != c && c != a,
            "a face uses a vertex twice: {:?}",
            [a, b, c]
        );
        for (v, from, to) in [(a, b, c), (b, c, a), (c, a, b)] {
            assert!(
                next_around.insert((v, from), to).is_none(),
                "two faces run from {v} to {from}"
            );
        }
    }
    let mut degree = vec![0usize; mesh.positions.len()];
    for &(v, from) in next_around.keys() {
        assert!(
            next_around.contains_key(&(from, v)),
            "the edge {v}-{from} has one face"
        );
        degree[v as usize] += 1;
    }
    let mut start = vec![u32::MAX; mesh.positions.len()];
    next_around
        .keys()
        .for_each(|&(v, from)| start[v as usize] = from);
    for v in 0..mesh.positions.len() {
        assert!(degree[v] >= 3, "vertex {v} has {} neighbours", degree[v]);
        let (mut at, mut steps) = (start[v], 0);
        loop {
            (at, steps) = (next_around[&(v as u32, at)], steps + 1);
            if at == start[v] {
                break;
            }
        }
        assert_eq!(
            steps, degree[v],
            "the faces around vertex {v} form more than one fan"
        );
    }
    let n_edges = next_around.len() / 2;
    mesh.positions.len() as i64 - n_edges as i64 + mesh.faces.len() as i64
}

/// Vertices and faces by position, in an order that does not depend on how they were found.
fn sorted_faces(mesh: &Mesh) -> Vec<[[u64; 3]; 3]> {
    let corner = |vertex: u32| mesh.positions[vertex as usize].to_array().map(f64::to_bits);
    let mut faces: Vec<[[u64; 3]; 3]> = mesh
        .faces
        .iter()
        .map(|face| {
            let mut face = face.map(corner);
            let first = (0..3).min_by_key(|&i| face[i]).unwrap();
            face.rotate_left(first);
            face
        })
        .collect();
    faces.sort_unstable();
    faces
}

#[test]
fn sphere_is_closed_and_in_place() {
    for resolution in [64, 128] {
        let mesh = extract(
            sphere,
            &ExtractOptions {
                resolution,
                ..Default::default()
            },
        );
        assert_eq!(assert_closed_manifold(&mesh), 2);
        let cell = 2.0 / f64::from(resolution);
        let worst = mesh
            .positions
            .iter()
            .map(|&p| sphere(p).abs())
            .fold(0.0, f64::max);
        assert!(
            worst <= 0.01 * cell,
            "|sdf| up to {} of a cell at {resolution}",
            worst / cell
        );
        let area = mesh.area() / (4.0 * std::f64::consts::PI * 0.36);
        assert!((0.99..=1.0).contains(&area), "area ratio {area}");
        for face in 0..mesh.faces.len() {
            let [a, b, c] = mesh.corners(face);
            let outward = (a + b + c) / 3.0 - DVec3::new(0.03, -0.02, 0.01);
            assert!(
                mesh.area_vector(face).dot(outward) > 0.0,
                "face {face} winds inward"
            );
        }
    }
}

#[test]
fn torus_has_one_hole() {
    let mesh = extract(
        torus,
        &ExtractOptions {
            resolution: 96,
            ..Default::default()
        },
    );
    assert_eq!(assert_closed_manifold(&mesh), 0);
}

/// Values drawn per lattice point: every ambiguous case, many times over. Positive on the domain's border, so the surface is closed.
fn noise(seed: u64, p: DVec3, cell: f64, levels: f64) -> f64 {
    let index = (p / cell).round();
    if index.abs().max_element() >= 5.0 {
        return 1.0;
    }
    let mut state = seed;
    for x in index.to_array() {
        state = (state ^ (x as i64 as u64)).wrapping_mul(0x9e37_79b9_7f4a_7c15);
        state ^= state >> 29;
    }
    let uniform = (state.wrapping_mul(0xbf58_476d_1ce4_e5b9) >> 11) as f64 / (1u64 << 53) as f64;
    // Few levels make exact zeros and exact ties at saddles.
    if levels > 0.0 {
        (uniform * levels).floor() - (levels / 2.0).floor()
    } else {
        uniform - 0.5
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(300))]

    #[test]
    fn noise_is_closed_and_manifold(seed: u64, levels in prop_oneof![Just(0.0), Just(2.0), Just(3.0), Just(5.0)], block in 2usize..14) {
        let half = DVec3::splat(1.0);
        let options = ExtractOptions { resolution: 12, block, domain: Domain::Box { half }, ..Default::default() };
        let cell = extract_surface(&mut Analytic(|_| 1.0), &options, &mut |_| true).unwrap().1.step;
        let mesh = extract(|p| noise(seed, p, cell, levels), &options);
        prop_assert!(mesh.faces.len() > 1000, "{} faces", mesh.faces.len());
        assert_closed_manifold(&mesh);
        let whole = extract(|p| noise(seed, p, cell, levels), &ExtractOptions { block: 64, ..options });
        prop_assert_eq!(sorted_faces(&mesh), sorted_faces(&whole));
    }
}

#[test]
fn block_size_changes_nothing() {
    let bumpy = |p: DVec3| {
        p.length() - 0.75 + 0.1 * (14.0 * p.x).sin() * (11.0 * p.y).sin() * (17.0 * p.z).cos()
    };
    for resolution in [60, 100] {
        let mesh = |block| {
            extract(
                bumpy,
                &ExtractOptions {
                    resolution,
                    block,
                    ..Default::default()
                },
            )
        };
        let whole = mesh(128);
        assert_closed_manifold(&whole);
        for block in [7, 16, 25, 64] {
            let parts = mesh(block);
            assert_eq!(
                parts.positions.len(),
                whole.positions.len(),
                "vertices with blocks of {block}"
            );
            assert!(
                sorted_faces(&parts) == sorted_faces(&whole),
                "faces with blocks of {block}"
            );
        }
    }
}

#[test]
fn world_frame() {
    let world_from_region =
        DMat4::from_translation(DVec3::new(5.0, -3.0, 2.0)) * DMat4::from_scale(DVec3::splat(2.5));
    let mesh = extract(
        sphere,
        &ExtractOptions {
            resolution: 32,
            world_from_region,
            ..Default::default()
        },
    );
    assert_eq!(assert_closed_manifold(&mesh), 2);
}
