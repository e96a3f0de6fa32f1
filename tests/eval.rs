//! Scores against brute force, closed forms and values worked out by hand.

use clap::Parser;
use glam::{DMat4, DVec2, DVec3};
use neurodin::Error;
use neurodin::cli::eval::{EvalArgs, score_mesh};
use neurodin::eval::{
    GeometryOptions, GeometryScores, Reference, Viewpoint, psnr, score_geometry, ssim,
};
use neurodin::mesh::bvh::{Bvh, Triangle};
use neurodin::mesh::{Mesh, write_mesh};

/// A repeatable stream of numbers in [0, 1).
struct Random(u64);

impl Random {
    fn next(&mut self) -> f64 {
        self.0 = self
            .0
            .wrapping_mul(6364136223846793005)
            .wrapping_add(1442695040888963407);
        (self.0 >> 33) as f64 / (1u64 << 31) as f64
    }

    fn point(&mut self) -> DVec3 {
        DVec3::new(self.next(), self.next(), self.next())
    }
}

/// No camera at all.
enum NoView {}

impl Viewpoint for NoView {
    fn world_from_camera(&self) -> DMat4 {
        match *self {}
    }
    fn size(&self) -> [u32; 2] {
        match *self {}
    }
    fn project(&self, _: DVec3) -> Option<DVec2> {
        match *self {}
    }
}

fn options() -> GeometryOptions {
    GeometryOptions {
        samples: 10_000,
        seed: 7,
        thresholds: vec![0.01, 0.03, 0.1],
        trim: 0.05,
        crop: None,
        min_views: 1,
        hidden_by: 1e-3,
    }
}

fn score(mesh: &Mesh, reference: &Reference, options: &GeometryOptions) -> GeometryScores {
    score_geometry::<NoView>(mesh, reference, None, options).unwrap()
}

fn near(a: f64, b: f64, tolerance: f64) -> bool {
    (a - b).abs() <= tolerance
}

/// Distance from a point to a triangle by Voronoi regions (Ericson 2005, 5.1.5): another way than the library's.
fn triangle_distance(p: DVec3, [a, b, c]: [DVec3; 3]) -> f64 {
    let (ab, ac, ap) = (b - a, c - a, p - a);
    let (d1, d2) = (ab.dot(ap), ac.dot(ap));
    if d1 <= 0.0 && d2 <= 0.0 {
        return p.distance(a);
    }
    let bp = p - b;
    let (d3, d4) = (ab.dot(bp), ac.dot(bp));
    if d3 >= 0.0 && d4 <= d3 {
        return p.distance(b);
    }
    let cp = p - c;
    let (d5, d6) = (ab.dot(cp), ac.dot(cp));
    if d6 >= 0.0 && d5 <= d6 {
        return p.distance(c);
    }
    let (va, vb, vc) = (d3 * d6 - d5 * d4, d5 * d2 - d1 * d6, d1 * d4 - d3 * d2);
    if vc <= 0.0 && d1 >= 0.0 && d3 <= 0.0 {
        return p.distance(a + ab * (d1 / (d1 - d3)));
    }
    if vb <= 0.0 && d2 >= 0.0 && d6 <= 0.0 {
        return p.distance(a + ac * (d2 / (d2 - d6)));
    }
    if va <= 0.0 && d4 - d3 >= 0.0 && d5 - d6 >= 0.0 {
        return p.distance(b + (c - b) * ((d4 - d3) / (d4 - d3 + d5 - d6)));
    }
    p.distance(a + (ab * vb + ac * vc) / (va + vb + vc))
}

#[test]
fn chamfer_and_f_score_of_points_are_those_of_brute_force() {
    let mut random = Random(1);
    let ours: Vec<DVec3> = (0..10_000).map(|_| random.point()).collect();
    let theirs: Vec<DVec3> = (0..10_000)
        .map(|_| random.point() * DVec3::new(1.0, 1.0, 0.8))
        .collect();
    let nearest = |from: &[DVec3], to: &[DVec3]| -> Vec<f64> {
        from.iter()
            .map(|p| {
                to.iter()
                    .map(|q| p.distance_squared(*q))
                    .fold(f64::INFINITY, f64::min)
                    .sqrt()
            })
            .collect()
    };
    let (accuracy, completeness) = (nearest(&ours, &theirs), nearest(&theirs, &ours));
    let mean = |distances: &[f64]| distances.iter().sum::<f64>() / distances.len() as f64;
    let mesh = Mesh {
        positions: ours,
        ..Default::default()
    };
    let reference = Reference {
        points: Some(theirs),
        ..Default::default()
    };
    let scores = score(&mesh, &reference, &options());
    assert!(near(scores.accuracy.mean.unwrap(), mean(&accuracy), 1e-9));
    assert!(near(
        scores.completeness.mean.unwrap(),
        mean(&completeness),
        1e-9
    ));
    assert!(near(
        scores.chamfer.unwrap(),
        0.5 * (mean(&accuracy) + mean(&completeness)),
        1e-9
    ));
    let trimmed =
        |distances: &[f64]| mean(&distances.iter().map(|d| d.min(0.05)).collect::<Vec<_>>());
    assert!(near(
        scores.chamfer_trimmed,
        0.5 * (trimmed(&accuracy) + trimmed(&completeness)),
        1e-9
    ));
    assert_eq!(scores.thresholds.len(), 3);
    for at in &scores.thresholds {
        let share = |distances: &[f64]| {
            distances.iter().filter(|&&d| d <= at.threshold).count() as f64 / 1e4
        };
        let (precision, recall) = (share(&accuracy), share(&completeness));
        assert!(near(at.precision, precision, 1e-9) && near(at.recall, recall, 1e-9));
        assert!(near(
            at.f_score,
            2.0 * precision * recall / (precision + recall),
            1e-9
        ));
    }
    let mut sorted = accuracy.clone();
    sorted.sort_by(f64::total_cmp);
    assert!(near(
        scores.accuracy.median.unwrap(),
        0.5 * (sorted[4999] + sorted[5000]),
        1e-12
    ));
    assert!(near(
        scores.accuracy.percentile_95.unwrap(),
        0.95 * sorted[9499] + 0.05 * sorted[9500],
        1e-4
    ));
}

#[test]
fn distances_to_triangles_are_those_of_brute_force() {
    let mut random = Random(2);
    let mut triangles: Vec<[DVec3; 3]> = (0..400)
        .map(|_| {
            let a = random.point();
            [
                a,
                a + 0.2 * (random.point() - 0.5),
                a + 0.2 * (random.point() - 0.5),
            ]
        })
        .collect();
    // Needles, points, and copies of one place.
    for i in 0..60 {
        let [a, b, _] = triangles[i];
        triangles.push([a, b, a + (b - a) * 0.3]);
        triangles.push([a; 3]);
        triangles.push([DVec3::splat(0.5); 3]);
    }
    let bvh = Bvh::new(triangles.iter().map(|&corners| Triangle(corners)).collect());
    for _ in 0..10_000 {
        let p = random.point() * 1.4 - 0.2;
        // Ericson's way divides zero by zero for triangles without area: their sides speak for them.
        let brute = triangles.iter().fold(f64::INFINITY, |best, &[a, b, c]| {
            let segment = |from: DVec3, to: DVec3| {
                let t = if from == to {
                    0.0
                } else {
                    ((p - from).dot(to - from) / (to - from).length_squared()).clamp(0.0, 1.0)
                };
                p.distance(from + (to - from) * t)
            };
            let flat = (b - a).cross(c - a).length() < 1e-12;
            best.min(if flat {
                segment(a, b).min(segment(b, c)).min(segment(c, a))
            } else {
                triangle_distance(p, [a, b, c])
            })
        });
        assert!(
            near(bvh.distance(p), brute, 1e-9),
            "{} for {brute} at {p}",
            bvh.distance(p)
        );
    }
    assert_eq!(
        Bvh::<DVec3>::new(vec![]).distance(DVec3::ZERO),
        f64::INFINITY
    );
}

#[test]
fn rays_are_blocked_by_what_stands_between() {
    let mut random = Random(3);
    let triangles: Vec<Triangle> = (0..300)
        .map(|_| {
            let a = random.point();
            Triangle([
                a,
                a + 0.6 * (random.point() - 0.5),
                a + 0.6 * (random.point() - 0.5),
            ])
        })
        .collect();
    let mut blocked = 0;
    let bvh = Bvh::new(triangles.clone());
    for ray in 0..3000 {
        let (origin, mut direction) = (random.point() * 2.0 - 0.5, random.point() - 0.5);
        if ray % 10 == 0 {
            direction[ray / 10 % 3] = 0.0; // along the sides of boxes
        }
        // By signed volumes: the segment's ends lie on different sides of the plane, and the line passes the three sides alike.
        let end = origin + 0.8 * direction;
        let volume = |a: DVec3, b: DVec3, c: DVec3, d: DVec3| (b - a).cross(c - a).dot(d - a);
        let brute = triangles.iter().any(|&Triangle([a, b, c])| {
            let sides = [
                volume(origin, end, a, b),
                volume(origin, end, b, c),
                volume(origin, end, c, a),
            ];
            let passes = sides.iter().all(|&v| v > 0.0) || sides.iter().all(|&v| v < 0.0);
            passes && volume(a, b, c, origin) * volume(a, b, c, end) < 0.0
        });
        assert_eq!(bvh.is_blocked(origin, direction, 0.8), brute, "ray {ray}");
        blocked += usize::from(brute);
    }
    assert!(
        (300..2700).contains(&blocked),
        "{blocked} of 3000 rays are blocked"
    );
}

/// Longitudes and latitudes.
fn globe(radius: f64, n: u32) -> Mesh {
    let mut mesh = Mesh::default();
    for row in 0..=n {
        for column in 0..=2 * n {
            let (polar, around) = (f64::from(row), f64::from(column));
            let (sin, cos) = (std::f64::consts::PI * polar / f64::from(n)).sin_cos();
            let (y, x) = (std::f64::consts::PI * around / f64::from(n)).sin_cos();
            mesh.positions
                .push(radius * DVec3::new(x * sin, y * sin, cos));
        }
    }
    let id = |row: u32, column: u32| row * (2 * n + 1) + column;
    for row in 0..n {
        for column in 0..2 * n {
            let [a, b, c, d] = [
                id(row, column),
                id(row + 1, column),
                id(row + 1, column + 1),
                id(row, column + 1),
            ];
            mesh.faces.extend([[a, b, c], [a, c, d]]);
        }
    }
    mesh
}

#[test]
fn spheres_in_spheres_are_as_far_apart_as_their_radii() {
    let (inner, outer) = (globe(1.0, 60), globe(1.08, 60));
    let scores = score(&inner, &Reference::from_mesh(outer.clone()), &options());
    assert!(
        near(scores.accuracy.mean.unwrap(), 0.08, 1e-3),
        "{scores:?}"
    );
    assert!(near(scores.completeness.mean.unwrap(), 0.08, 1e-3));
    assert!(near(scores.chamfer_trimmed, 0.05, 1e-12));
    assert_eq!(
        scores
            .thresholds
            .iter()
            .map(|at| at.f_score)
            .collect::<Vec<_>>(),
        [0.0, 0.0, 1.0]
    );
    let same = score(&outer, &Reference::from_mesh(outer.clone()), &options());
    assert!(
        same.chamfer.unwrap() < 1e-12 && same.thresholds.iter().all(|at| at.f_score == 1.0),
        "{same:?}"
    );
    // Half of the sphere is right as far as it goes, and half complete.
    let mut half = outer.clone();
    neurodin::mesh::clean::keep_faces(&mut half, |face| {
        outer.corners(face).iter().all(|p| p.z >= -1e-9)
    });
    let scores = score(&half, &Reference::from_mesh(outer), &options());
    assert_eq!(scores.thresholds[0].precision, 1.0);
    assert!(near(scores.thresholds[0].recall, 0.505, 0.01), "{scores:?}");
}

#[test]
fn samples_are_uniform_by_area_and_repeatable() {
    // Two squares of area 1 and 4 against a plane: the distances say which one a sample is on.
    let square = |z: f64, side: f64| {
        [
            DVec3::new(0.0, 0.0, z),
            DVec3::new(side, 0.0, z),
            DVec3::new(side, side, z),
            DVec3::new(0.0, side, z),
        ]
    };
    let mesh = Mesh {
        positions: [square(1.0, 1.0), square(2.0, 2.0)].concat(),
        faces: vec![[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]],
        ..Default::default()
    };
    let plane = Mesh {
        positions: square(0.0, 2.0).to_vec(),
        faces: vec![[0, 1, 2], [0, 2, 3]],
        ..Default::default()
    };
    let reference = Reference::from_mesh(plane);
    let scores = score(&mesh, &reference, &options());
    assert!(
        near(scores.accuracy.mean.unwrap(), (1.0 + 4.0 * 2.0) / 5.0, 1e-3),
        "{scores:?}"
    );
    assert_eq!(scores, score(&mesh, &reference, &options()));
    // Cropped to the upper square's corner: about as many samples, all there.
    let crop = Some([DVec3::new(1.5, 1.5, -1.0), DVec3::splat(3.0)]);
    let scores = score(&mesh, &reference, &GeometryOptions { crop, ..options() });
    assert_eq!(scores.accuracy.mean, Some(2.0));
    assert_eq!(scores.faces_scored, 2);
    assert!(
        (8_000..13_000).contains(&scores.accuracy.points),
        "{scores:?}"
    );
}

/// A pinhole camera, 90 degrees wide, on the x axis, looking at the origin.
struct OnAxis(f64);

impl Viewpoint for OnAxis {
    fn world_from_camera(&self) -> DMat4 {
        DMat4::look_at_rh(DVec3::X * self.0, DVec3::ZERO, DVec3::Z).inverse()
    }

    fn size(&self) -> [u32; 2] {
        [100, 100]
    }

    fn project(&self, p: DVec3) -> Option<DVec2> {
        (p.z < 0.0).then(|| DVec2::new(50.0 - 50.0 * p.x / p.z, 50.0 + 50.0 * p.y / p.z))
    }
}

#[test]
fn only_what_cameras_see_counts() {
    let outer = globe(1.0, 40);
    let inner = globe(0.5, 40);
    let mut both = outer.clone();
    both.faces.extend(
        inner
            .faces
            .iter()
            .map(|face| face.map(|vertex| vertex + outer.positions.len() as u32)),
    );
    both.positions.extend(&inner.positions);
    let reference = Reference::from_mesh(outer.clone());
    let views = [OnAxis(4.0), OnAxis(-4.0)];
    let everything = score(&both, &reference, &options());
    assert!(
        everything.thresholds[0].precision < 0.9,
        "the inner sphere is wrong: {everything:?}"
    );
    let seen = score_geometry(&both, &reference, Some(&views), &options()).unwrap();
    assert_eq!(
        seen.thresholds[0].precision, 1.0,
        "the inner sphere is out of sight"
    );
    // Seen from both sides: all but the belt |x| < 1/4, where rays touch the sphere.
    assert!(
        near(seen.accuracy.points as f64, 10_000.0 * 0.8 * 0.75, 150.0),
        "{seen:?}"
    );
    let seen = score_geometry(&both, &reference, Some(&views[..1]), &options()).unwrap();
    assert!(near(seen.thresholds[0].recall, 0.375, 0.03), "{seen:?}");
    let twice = GeometryOptions {
        min_views: 2,
        ..options()
    };
    let seen = score_geometry(&both, &reference, Some(&views), &twice).unwrap();
    assert_eq!((seen.accuracy.points, seen.faces_scored), (0, 0));
    assert_eq!((seen.accuracy.mean, seen.chamfer), (None, None));
    assert!(near(seen.chamfer_trimmed, twice.trim, 1e-12));
    assert!(seen.thresholds.iter().all(|at| at.f_score == 0.0));
    // Behind the camera, which looks from 4 towards smaller x, there is as little.
    let mut behind = outer;
    for p in &mut behind.positions {
        p.x += 8.0;
    }
    let seen = score_geometry(&behind, &reference, Some(&views[..1]), &options()).unwrap();
    assert_eq!((seen.accuracy.points, seen.faces_scored), (0, 0));
    // Points hide nothing; no mesh at all is merely bad.
    behind.faces.clear();
    let refused = score_geometry(&behind, &reference, Some(&views), &options()).unwrap_err();
    let told = refused.to_string();
    assert!(
        told.contains("no faces") && told.contains("without --visible-from"),
        "{told}"
    );
    score_geometry(&Mesh::default(), &reference, Some(&views), &options()).unwrap();
}

#[test]
fn a_large_triangle_hides_although_its_corners_are_out_of_sight() {
    let ball = globe(1.0, 8);
    let mut mesh = Mesh {
        positions: vec![
            DVec3::new(2.0, -50.0, -50.0),
            DVec3::new(2.0, 50.0, -50.0),
            DVec3::new(2.0, 0.0, 50.0),
        ],
        faces: vec![[0, 1, 2]],
        ..Default::default()
    };
    mesh.positions.extend(&ball.positions);
    mesh.faces
        .extend(ball.faces.iter().map(|face| face.map(|v| v + 3)));
    let reference = Reference::from_mesh(ball);
    let scored = |eye| {
        score_geometry(&mesh, &reference, Some(&[OnAxis(eye)]), &options())
            .unwrap()
            .faces_scored
    };
    assert_eq!(scored(4.0), 1, "the wall alone");
    assert!(scored(-4.0) > 10, "from the other side the ball is seen");
}

#[test]
fn senseless_scores_are_refused() {
    let mesh = globe(1.0, 8);
    let reference = Reference::from_mesh(mesh.clone());
    let away = Some([DVec3::splat(5.0), DVec3::splat(6.0)]);
    for (reference, options) in [
        (Reference::default(), options()),
        (
            reference.clone(),
            GeometryOptions {
                crop: away,
                ..options()
            },
        ),
        (
            reference.clone(),
            GeometryOptions {
                samples: 0,
                ..options()
            },
        ),
        (
            reference.clone(),
            GeometryOptions {
                trim: f64::NAN,
                ..options()
            },
        ),
        (
            reference.clone(),
            GeometryOptions {
                thresholds: vec![0.1, -0.1],
                ..options()
            },
        ),
    ] {
        let result = score_geometry::<NoView>(&mesh, &reference, None, &options);
        assert!(
            matches!(result, Err(Error::Config { .. })),
            "{options:?}: {result:?}"
        );
    }
    // Nothing where something should be is a bad mesh, not an error.
    let scores = score(&Mesh::default(), &reference, &options());
    assert_eq!(scores.thresholds[2].recall, 0.0);
}

#[test]
fn psnr_of_known_differences() {
    assert!(near(psnr(&[0.5; 30], &[0.6; 30]), 20.0, 1e-5));
    assert!(near(
        psnr(&[0.0, 1.0, 0.0, 1.0], &[1.0, 1.0, 0.0, 1.0]),
        10.0 * 4f64.log10(),
        1e-12
    ));
    assert_eq!(psnr(&[0.25; 3], &[0.25; 3]), f64::INFINITY);
}

#[test]
fn ssim_of_known_pictures() {
    // Without structure only the luminance term is left: (2ab + C1) / (a² + b² + C1).
    let (a, b) = (vec![0.25f32; 20 * 15 * 3], vec![0.75f32; 20 * 15 * 3]);
    let expected = (2.0 * 0.25 * 0.75 + 1e-4) / (0.0625 + 0.5625 + 1e-4);
    assert!(near(ssim(&a, &b, 20, 15, 3).unwrap(), expected, 1e-9));
    assert!(near(ssim(&a, &a, 20, 15, 3).unwrap(), 1.0, 1e-12));
    assert_eq!(ssim(&a[..300], &b[..300], 10, 10, 3), None);
}

#[test]
fn ssim_is_that_of_its_definition() {
    let (width, height, channels) = (23, 17, 3);
    let mut random = Random(5);
    let a: Vec<f32> = (0..width * height * channels)
        .map(|_| random.next() as f32)
        .collect();
    let b: Vec<f32> = a
        .iter()
        .map(|&x| (0.8 * x + 0.3 * random.next() as f32).min(1.0))
        .collect();
    // Window by window, with weights of the two-dimensional Gaussian and central moments.
    let weight = |dx: usize, dy: usize| {
        let r2 = (dx as f64 - 5.0).powi(2) + (dy as f64 - 5.0).powi(2);
        (-r2 / (2.0 * 1.5 * 1.5)).exp()
    };
    let mut total = 0.0;
    for channel in 0..channels {
        for y in 0..height - 10 {
            for x in 0..width - 10 {
                let window: Vec<(f64, f64, f64)> = (0..121)
                    .map(|i| {
                        let at = ((y + i / 11) * width + x + i % 11) * channels + channel;
                        (weight(i % 11, i / 11), f64::from(a[at]), f64::from(b[at]))
                    })
                    .collect();
                let sum: f64 = window.iter().map(|(w, _, _)| w).sum();
                let mean = |f: &dyn Fn(f64, f64) -> f64| {
                    window.iter().map(|&(w, a, b)| w * f(a, b)).sum::<f64>() / sum
                };
                let (ma, mb) = (mean(&|a, _| a), mean(&|_, b| b));
                let (va, vb, cov) = (
                    mean(&|a, _| (a - ma).powi(2)),
                    mean(&|_, b| (b - mb).powi(2)),
                    mean(&|a, b| (a - ma) * (b - mb)),
                );
                total += (2.0 * ma * mb + 1e-4) * (2.0 * cov + 9e-4)
                    / ((ma * ma + mb * mb + 1e-4) * (va + vb + 9e-4));
            }
        }
    }
    let expected = total / ((width - 10) * (height - 10) * channels) as f64;
    let got = ssim(&a, &b, width, height, channels).unwrap();
    assert!(near(got, expected, 1e-9), "{got} for {expected}");
    assert!((0.3..0.99).contains(&got), "{got} would be met by anything");
}

#[derive(Parser)]
struct Typed {
    #[command(flatten)]
    eval: EvalArgs,
}

#[test]
fn meshes_are_scored_from_files() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).to_str().unwrap().to_string();
    let (inner, outer) = (globe(1.0, 40), globe(1.08, 40));
    let points = Mesh {
        faces: vec![],
        ..outer.clone()
    };
    for (name, mesh) in [
        ("inner.ply", &inner),
        ("outer.obj", &outer),
        ("points.ply", &points),
    ] {
        write_mesh(folder.path().join(name).as_path(), mesh, false).unwrap();
    }
    let run = |typed: &[&str]| {
        let args = Typed::try_parse_from([&["eval"], typed].concat())
            .unwrap()
            .eval;
        score_mesh(&args, args.mesh.as_ref().unwrap())
    };
    let (mesh, truth, cloud) = (path("inner.ply"), path("outer.obj"), path("points.ply"));
    let typed = [
        "--mesh",
        &mesh,
        "--reference",
        &truth,
        "--reference",
        &cloud,
        "--samples",
        "5000",
    ];
    let (report, text) = run(&typed).unwrap();
    let number = |name: &str| report.pointer(name).unwrap().as_f64().unwrap();
    assert!(
        near(number("/accuracy/mean"), 0.08, 2e-3) && near(number("/chamfer"), 0.08, 2e-3),
        "{report:#}"
    );
    assert_eq!(
        number("/completeness/points"),
        points.positions.len() as f64
    );
    let size = 1.08 * 3f64.sqrt();
    assert!(
        near(number("/thresholds/1/threshold"), 0.01 * size, 1e-6)
            && near(number("/trim"), 0.05 * size, 1e-6)
    );
    assert!(
        text.contains("completeness") && text.lines().count() == 7,
        "{text}"
    );
    let upper = ["--crop=2,2,2,-2,-2,0", "--thresholds", "0.05,0.1"];
    let (report, _) = run(&[&typed[..], &upper].concat()).unwrap();
    assert_eq!(report["thresholds"].as_array().unwrap().len(), 2);
    assert_eq!(report["thresholds"][1]["f_score"], 1.0);
    assert!(report["completeness"]["points"].as_u64().unwrap() < 2000);

    assert!(
        run(&[
            "--mesh",
            &mesh,
            "--reference",
            &truth,
            "--reference",
            &truth
        ])
        .is_err(),
        "two true meshes"
    );
    assert!(
        run(&["--mesh", &mesh, "--reference", &cloud, "--crop=5,5,5,6,6,6"]).is_err(),
        "nothing in the box"
    );
    let wrong: [&[&str]; 4] = [
        &[],
        &["--mesh", "a"],
        &["run", "--reference", "b"],
        &["run", "--mesh", "a", "--reference", "b"],
    ];
    for typed in wrong {
        assert!(
            Typed::try_parse_from([&["eval"], typed].concat()).is_err(),
            "{typed:?}"
        );
    }
}
