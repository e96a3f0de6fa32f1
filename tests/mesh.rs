//! Mesh extraction against analytic surfaces: closed, manifold, where the field is zero, the same whatever the block size.

use std::cell::Cell;
use std::collections::HashMap;

use glam::{DMat4, DQuat, DVec3};
use neurodin::mesh::extract::{PointAttributes, add_attributes, extract_surface, to_world};
use neurodin::mesh::{ExtractOptions, Lattice, Mesh, SurfaceAttributes, clean, extract_mesh};
use neurodin::scene::{Region, RegionShape};
use neurodin::{Error, Result};
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

/// Values drawn per lattice point: every ambiguous case, many times over. Positive on the shape's border, so the surface is closed.
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
        let options = ExtractOptions { resolution: 12, block, shape: RegionShape::Box { half }, ..Default::default() };
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
fn attributes_reach_the_world() {
    let center = DVec3::new(0.03, -0.02, 0.01);
    let turn = DMat4::from_axis_angle(DVec3::new(1.0, 2.0, 3.0).normalize(), 0.7);
    for mirror in [1.0, -1.0] {
        let world_from_region = DMat4::from_translation(DVec3::new(5e5, -3.0, 2.0))
            * DMat4::from_scale(DVec3::new(2.5, 2.5, 2.5 * mirror))
            * turn;
        let options = ExtractOptions {
            resolution: 48,
            world_from_region,
            ..Default::default()
        };
        let mesh = extract(sphere, &options);
        assert_eq!(assert_closed_manifold(&mesh), 2);
        let world_center = world_from_region.transform_point3(center);
        for (vertex, &p) in mesh.positions.iter().enumerate() {
            assert!(
                ((p - world_center).length() - 1.5).abs() < 2e-3,
                "vertex {vertex} at {p}"
            );
            let normal = DVec3::from(mesh.normals[vertex].map(f64::from));
            let expected = (p - world_center).normalize();
            assert!(
                normal.dot(expected) > 0.999,
                "normal {normal} where {expected} is outward"
            );
            let region = world_from_region.inverse().transform_point3(p);
            for axis in 0..3 {
                let color = f64::from(mesh.colors[vertex][axis]) / 255.0;
                assert!(
                    (color - (0.5 + 0.5 * region[axis])).abs() < 3e-3,
                    "colour {color} at {region}"
                );
            }
        }
        let volume: f64 = (0..mesh.faces.len())
            .map(|face| {
                mesh.area_vector(face)
                    .dot(mesh.corners(face)[0] - world_center)
                    / 3.0
            })
            .sum();
        assert!(
            (volume / (4.0 / 3.0 * std::f64::consts::PI * 1.5f64.powi(3)) - 1.0).abs() < 0.01,
            "volume {volume}"
        );
    }
}

#[test]
fn nothing_is_left_outside_of_the_region() {
    let slab = |p: DVec3| p.z.abs() - 0.31;
    let mesh = extract(
        slab,
        &ExtractOptions {
            resolution: 50,
            ..Default::default()
        },
    );
    assert!(!mesh.faces.is_empty());
    assert!(mesh.positions.iter().all(|p| p.length() <= 1.0));
    // Nearly up to the sphere: the cut may miss what shares a cell with the outside.
    let area = mesh.area() / (2.0 * std::f64::consts::PI * (1.0 - 0.31f64.powi(2)));
    assert!((0.9..=1.0).contains(&area), "{area} of the disks");

    let half = DVec3::new(1.0, 0.5, 0.7);
    let options = ExtractOptions {
        resolution: 50,
        shape: RegionShape::Box { half },
        ..Default::default()
    };
    let mesh = extract(slab, &options);
    let expected = 2.0 * 2.0 * 1.0;
    assert!(mesh.positions.iter().all(|p| p.abs().cmple(half).all()));
    assert!(
        (0.9..=1.0).contains(&(mesh.area() / expected)),
        "{} of {expected}",
        mesh.area()
    );
}

#[test]
fn cropping_while_extracting_is_cropping_afterwards() {
    let world_from_region = DMat4::from_scale_rotation_translation(
        DVec3::splat(3.0),
        DQuat::from_rotation_y(0.4),
        DVec3::new(1.0, 2.0, 3.0),
    );
    let whole = ExtractOptions {
        resolution: 70,
        block: 16,
        world_from_region,
        ..Default::default()
    };
    let inner = [DVec3::new(0.2, 1.0, 1.0), DVec3::new(3.0, 4.0, 3.3)];
    let run = |options: &ExtractOptions| {
        let calls = Cell::new(0);
        let field = |p: DVec3| {
            calls.set(calls.get() + 1);
            sphere(p)
        };
        let (mut mesh, _) = extract_surface(&mut Analytic(field), options, &mut |_| true).unwrap();
        to_world(&mut mesh, options.world_from_region);
        (mesh, calls.get())
    };
    let (mut expected, all_calls) = run(&whole);
    // Kept are the faces that have all three corners inside.
    let inside: Vec<bool> = (0..expected.faces.len())
        .map(|face| {
            let [low, high] = inner;
            let corners = expected.corners(face);
            corners
                .iter()
                .all(|p| p.cmpge(low).all() && p.cmple(high).all())
        })
        .collect();
    clean::keep_faces(&mut expected, |face| inside[face]);
    let (cropped, calls) = run(&ExtractOptions {
        crop: Some(inner),
        ..whole
    });
    assert!(expected.faces.len() > 500, "{} faces", expected.faces.len());
    assert!(sorted_faces(&cropped) == sorted_faces(&expected));
    assert!(
        2 * calls < all_calls,
        "{calls} of {all_calls} values for half of the region"
    );
}

#[test]
fn scratch_memory_does_not_grow_with_resolution() {
    // Blocks without surface are skipped to save time; what is held does not depend on them.
    let stats = |resolution| {
        let options = ExtractOptions {
            resolution,
            steepest: Some(1.01),
            ..Default::default()
        };
        extract_surface(&mut Analytic(sphere), &options, &mut |_| true)
            .unwrap()
            .1
    };
    let (coarse, fine) = (stats(128), stats(768));
    assert!(
        fine.scratch_bytes as f64 <= 1.2 * coarse.scratch_bytes as f64,
        "{} B at 128, {} B at 768",
        coarse.scratch_bytes,
        fine.scratch_bytes
    );
    assert!(fine.steepest < 1.01, "slope {}", fine.steepest);
    assert!(fine.blocks_skipped > fine.blocks / 4, "{fine:?}");
}

#[test]
fn skipping_blocks_changes_nothing_where_the_bound_holds() {
    let bumpy = |p: DVec3| p.length() - 0.7 + 0.03 * (14.0 * p.x).sin() * (11.0 * p.y).sin();
    let options = ExtractOptions {
        resolution: 150,
        block: 16,
        ..Default::default()
    };
    let run = |steepest| {
        let (mesh, stats) = extract_surface(
            &mut Analytic(bumpy),
            &ExtractOptions {
                steepest,
                ..options.clone()
            },
            &mut |_| true,
        )
        .unwrap();
        (sorted_faces(&mesh), stats)
    };
    let (whole, _) = run(None);
    let (skipped, stats) = run(Some(1.8));
    assert!(
        stats.blocks_skipped > 0 && stats.steepest < 1.8,
        "{stats:?}"
    );
    assert!(skipped == whole);
    let (_, stats) = run(Some(0.5));
    assert!(
        stats.steepest > 1.0,
        "a bound that does not hold shows in the slope seen: {stats:?}"
    );
}

/// Checks that lattice points are exact in float32.
struct ExactPoints;

impl Lattice for ExactPoints {
    fn sdf(
        &mut self,
        origin: DVec3,
        step: f64,
        dims: [usize; 3],
        values: &mut Vec<f32>,
    ) -> Result<()> {
        for axis in 0..3 {
            for i in [0, 1, dims[axis] / 3, dims[axis] - 1] {
                let (exact, single) = (
                    origin[axis] + step * i as f64,
                    origin[axis] as f32 + step as f32 * i as f32,
                );
                assert_eq!(
                    exact,
                    f64::from(single),
                    "origin {origin}, step {step}, point {i}"
                );
            }
        }
        values.clear();
        values.resize(dims[0] * dims[1] * dims[2], 1.0);
        Ok(())
    }
}

#[test]
fn lattice_points_are_exact_in_float32() {
    for resolution in [2, 3, 50, 97, 333, 500, 512, 513] {
        for shape in [
            RegionShape::Sphere,
            RegionShape::Box {
                half: DVec3::new(0.3, 1.0, 0.77),
            },
        ] {
            let options = ExtractOptions {
                resolution,
                shape,
                ..Default::default()
            };
            let (mesh, stats) = extract_surface(&mut ExactPoints, &options, &mut |_| true).unwrap();
            assert!(mesh.faces.is_empty());
            let longest = *stats.cells.iter().max().unwrap() as u32;
            assert!(
                (resolution..=resolution + 1).contains(&longest),
                "{longest} cells for {resolution}"
            );
            let covered = stats.step * f64::from(longest);
            assert!(
                (2.0..2.0 * (1.0 + 2.0 / f64::from(resolution))).contains(&covered),
                "{covered}"
            );
        }
    }
}

#[test]
fn damaged_fields_and_senseless_options_are_refused() {
    let options = ExtractOptions {
        resolution: 20,
        block: 8,
        ..Default::default()
    };
    let hole = |p: DVec3| {
        if (p - DVec3::splat(0.3)).length() < 0.08 {
            f64::NAN
        } else {
            sphere(p)
        }
    };
    match extract_mesh(&mut Analytic(hole), &options, &mut |_| true) {
        Err(Error::Numerical { what }) => assert!(what.contains("NaN"), "{what}"),
        other => panic!("{other:?}"),
    }
    for wrong in [
        ExtractOptions {
            resolution: 1,
            ..options.clone()
        },
        ExtractOptions {
            resolution: 1 << 20,
            ..options.clone()
        },
        ExtractOptions {
            block: 0,
            ..options.clone()
        },
        ExtractOptions {
            shape: RegionShape::Box {
                half: DVec3::new(1.0, 0.0, 1.0),
            },
            ..options.clone()
        },
        ExtractOptions {
            shape: RegionShape::Box {
                half: DVec3::new(1.0, f64::NAN, 1.0),
            },
            ..options.clone()
        },
    ] {
        assert!(
            matches!(
                extract_mesh(&mut Analytic(sphere), &wrong, &mut |_| true),
                Err(Error::Config { .. })
            ),
            "{wrong:?}"
        );
    }
}

#[test]
fn progress_reaches_the_end_and_can_stop() {
    let options = ExtractOptions {
        resolution: 40,
        block: 10,
        ..Default::default()
    };
    let mut last = HashMap::new();
    extract_mesh(&mut Analytic(sphere), &options, &mut |p| {
        let before = last
            .insert(format!("{:?}", p.stage), (p.done, p.total))
            .unwrap_or((0, p.total));
        assert!(p.done > before.0 && p.total == before.1);
        true
    })
    .unwrap();
    assert_eq!(last.len(), 2);
    assert!(last.values().all(|(done, total)| done == total), "{last:?}");

    let mut blocks = 0;
    let stopped = extract_mesh(&mut Analytic(sphere), &options, &mut |_| {
        blocks += 1;
        blocks < 5
    });
    assert!(
        matches!(stopped, Err(Error::Interrupted { .. })) && blocks == 5,
        "{blocks} blocks"
    );
}

#[test]
fn a_region_says_where_its_mesh_belongs() {
    let region = Region {
        center: DVec3::new(1.0, 2.0, 3.0),
        radius: 4.0,
        shape: RegionShape::Box {
            half: DVec3::new(1.0, 0.5, 0.9),
        },
        how: String::new(),
    };
    let mesh = extract(
        sphere,
        &ExtractOptions {
            resolution: 40,
            ..ExtractOptions::of(&region)
        },
    );
    let [low, high] = mesh.bounds().unwrap();
    // The ball of radius 0.6 around (0.03, -0.02, 0.01) sticks out of the box along y.
    assert!(
        (high.x - (1.0 + 4.0 * 0.63)).abs() < 0.02 && (low.x - (1.0 - 4.0 * 0.57)).abs() < 0.02
    );
    assert!(low.y >= 2.0 - 4.0 * 0.5 && high.y <= 2.0 + 4.0 * 0.5);
}

#[test]
fn where_the_gradient_vanishes_the_faces_give_the_normal() {
    struct Flat;
    impl SurfaceAttributes for Flat {
        fn attributes(&mut self, points: &[[f32; 3]]) -> Result<PointAttributes> {
            let gradient = |p: &[f32; 3]| if p[2] > 0.0 { [f32::NAN; 3] } else { [0.0; 3] };
            Ok((
                vec![[f32::NAN; 3]; points.len()],
                points.iter().map(gradient).collect(),
            ))
        }
    }
    let options = ExtractOptions {
        resolution: 40,
        ..Default::default()
    };
    let (mut mesh, _) = extract_surface(&mut Analytic(sphere), &options, &mut |_| true).unwrap();
    add_attributes(&mut mesh, &mut Flat, &mut |_| true).unwrap();
    for (p, normal) in mesh.positions.iter().zip(&mesh.normals) {
        let outward = (*p - DVec3::new(0.03, -0.02, 0.01)).normalize();
        assert!(
            outward.dot(DVec3::from(normal.map(f64::from))) > 0.98,
            "{normal:?} at {p}"
        );
    }
}
