//! Evaluation protocols against computations by brute force that share nothing with them, and what they refuse.

use std::collections::BTreeMap;
use std::f64::consts::TAU;
use std::path::{Path, PathBuf};

use clap::Parser;
use glam::{DMat4, DQuat, DVec2, DVec3};
use neurodin::Error;
use neurodin::cli::eval::{EvalArgs, score_mesh};
use neurodin::eval::cloud::{lattice, thinned};
use neurodin::eval::tanks;
use neurodin::mesh::{Mesh, write_mesh};
use npyz::{Order, WriterBuilder};
use proptest::prelude::*;
use serde_json::{Value, json};

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

fn near(a: f64, b: f64, tolerance: f64) -> bool {
    (a - b).abs() <= tolerance
}

#[derive(Parser)]
struct Typed {
    #[command(flatten)]
    eval: EvalArgs,
}

/// A folder of files for one evaluation.
struct Files(tempfile::TempDir);

impl Files {
    fn new() -> Files {
        Files(tempfile::tempdir().unwrap())
    }

    fn path(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    fn write(&self, name: &str, text: &str) {
        std::fs::write(self.path(name), text).unwrap();
    }

    fn points(&self, name: &str, points: &[DVec3]) {
        let mesh = Mesh {
            positions: points.to_vec(),
            ..Default::default()
        };
        write_mesh(&self.path(name), &mesh, true).unwrap();
    }

    /// Runs `eval` with words, of which those with a dot in the middle are names of files here.
    fn eval(&self, words: &str) -> Result<(Value, String), Error> {
        let is_file = |word: &str| word.contains('.') && word.parse::<f64>().is_err();
        let words = words.split_whitespace().map(|word| match is_file(word) {
            true => self.path(word).to_str().unwrap().to_owned(),
            false => word.to_owned(),
        });
        let words: Vec<String> = std::iter::once("eval".to_owned()).chain(words).collect();
        let args = Typed::try_parse_from(words).unwrap().eval;
        score_mesh(&args, args.mesh.as_ref().unwrap())
    }

    /// `eval` fails with exit code 3 and a message that holds each of `parts`.
    fn refuses(&self, words: &str, parts: &[&str]) {
        let error = self.eval(words).unwrap_err();
        assert_eq!(error.exit_code(), 3, "{error}");
        let message = error.to_string();
        for part in parts {
            assert!(message.contains(part), "{part:?} is missing in: {message}");
        }
    }
}

fn rows(matrix: DMat4) -> Vec<[f64; 4]> {
    (0..4).map(|row| matrix.row(row).to_array()).collect()
}

/// Four lines of four numbers.
fn as_text(matrix: DMat4) -> String {
    let line = |row: [f64; 4]| row.map(|number| number.to_string()).join(" ") + "\n";
    rows(matrix).into_iter().map(line).collect()
}

/// A shape that is not convex, as corners in the plane.
const STAR: [[f64; 2]; 6] = [
    [0.05, 0.1],
    [0.9, 0.05],
    [0.6, 0.5],
    [0.95, 0.9],
    [0.5, 0.7],
    [0.1, 0.95],
];

/// A crop file over [`STAR`] along one axis.
fn crop_file(axis: usize, ends: [f64; 2]) -> Value {
    let corners: Vec<[f64; 3]> = STAR
        .iter()
        .map(|[u, v]| match axis {
            0 => [7.0, *u, *v],
            1 => [*u, 7.0, *v],
            _ => [*u, *v, 7.0],
        })
        .collect();
    let name = ["X", "Y", "Z"][axis];
    json!({
        "class_name": "SelectionPolygonVolume", "version_major": 1, "version_minor": 0,
        "axis_min": ends[0], "axis_max": ends[1], "orthogonal_axis": name,
        "bounding_polygon": corners,
    })
}

/// Whether the star goes once around `p`: by the sum of the angles under which its sides are seen.
fn in_star(p: DVec2) -> bool {
    let corner = |index: usize| DVec2::from(STAR[index % STAR.len()]) - p;
    let turned: f64 = (0..STAR.len())
        .map(|side| corner(side).angle_to(corner(side + 1)))
        .sum();
    near(turned.abs(), TAU, 1e-6)
}

fn nearest(from: DVec3, to: &[DVec3]) -> f64 {
    let squared = to.iter().map(|p| p.distance_squared(from));
    squared.fold(f64::INFINITY, f64::min).sqrt()
}

#[test]
fn tanks_and_temples_is_that_of_brute_force() {
    let mut random = Random(3);
    let theirs: Vec<DVec3> = (0..6000)
        .map(|_| random.point() * DVec3::new(1.0, 1.0, 0.3))
        .collect();
    let ours: Vec<DVec3> = (0..5000)
        .map(|_| random.point() * DVec3::new(0.8, 1.0, 0.33))
        .collect();
    let files = Files::new();
    files.points("truth.ply", &theirs);
    files.points("ours.ply", &ours);
    for axis in 0..3 {
        let ends = [0.05, 0.27];
        files.write("crop.json", &crop_file(axis, ends).to_string());
        let threshold = 0.04;
        let (report, _) = files
            .eval(&format!(
                "--mesh ours.ply --reference truth.ply --protocol tnt --crop-polygon crop.json --thresholds {threshold}"
            ))
            .unwrap();

        let cropped = |points: &[DVec3]| -> Vec<DVec3> {
            let inside = |p: &&DVec3| {
                let across: Vec<f64> = (0..3).filter(|a| *a != axis).map(|a| p[a]).collect();
                p[axis] >= ends[0]
                    && p[axis] <= ends[1]
                    && in_star(DVec2::new(across[0], across[1]))
            };
            points.iter().filter(inside).copied().collect()
        };
        let reduced = |points: Vec<DVec3>| -> Vec<DVec3> {
            let low = points.iter().copied().reduce(DVec3::min).unwrap() - threshold / 4.0;
            let mut cubes: BTreeMap<[i32; 3], Vec<DVec3>> = BTreeMap::new();
            for p in points {
                let cube = [0, 1, 2].map(|a| ((p[a] - low[a]) / (threshold / 2.0)) as i32);
                cubes.entry(cube).or_default().push(p);
            }
            let mean = |points: Vec<DVec3>| points.iter().sum::<DVec3>() / points.len() as f64;
            cubes.into_values().map(mean).collect()
        };
        let (a, b) = (reduced(cropped(&ours)), reduced(cropped(&theirs)));
        assert!(a.len() > 100 && b.len() > 100 && a.len() < ours.len() && b.len() < theirs.len());
        let share = |from: &[DVec3], to: &[DVec3]| {
            let close = from.iter().filter(|p| nearest(**p, to) < threshold);
            close.count() as f64 / from.len() as f64
        };
        let (precision, recall) = (share(&a, &b), share(&b, &a));
        let f_score = 2.0 * precision * recall / (precision + recall);
        assert!((0.3..0.999).contains(&precision) && (0.3..0.999).contains(&recall));
        for (name, wanted) in [
            ("precision", precision),
            ("recall", recall),
            ("f_score", f_score),
            ("points", a.len() as f64),
            ("reference_points", b.len() as f64),
            ("voxel", 0.02),
        ] {
            let got = report[name].as_f64().unwrap();
            assert!(
                near(got, wanted, 1e-9),
                "axis {axis}, {name}: {got} for {wanted}"
            );
        }
    }
}

#[test]
fn scenes_have_their_published_thresholds() {
    for (scene, threshold) in [("Barn", 0.01), ("courthouse", 0.025), ("IGNATIUS", 0.003)] {
        assert_eq!(tanks::threshold(scene).unwrap(), threshold);
    }
    let files = Files::new();
    let points: Vec<DVec3> = (0..500)
        .map(|index| DVec3::new(0.3 + 1e-3 * f64::from(index), 0.4, 0.1))
        .collect();
    files.points("truth.ply", &points);
    files.write("crop.json", &crop_file(2, [-1.0, 1.0]).to_string());
    let words = "--mesh truth.ply --reference truth.ply --protocol tnt --crop-polygon crop.json --scene Truck";
    let (report, text) = files.eval(words).unwrap();
    assert_eq!(report["threshold"], 0.005);
    assert_eq!(report["f_score"], 1.0);
    assert!(text.contains("F 1.0000"), "{text}");
    // A mesh that lies elsewhere is a bad mesh, not an error.
    let away: Vec<DVec3> = points.iter().map(|p| *p + 9.0).collect();
    files.points("away.ply", &away);
    let (report, _) = files
        .eval(&words.replacen("truth.ply", "away.ply", 1))
        .unwrap();
    assert_eq!(report["f_score"], 0.0);
}

/// Writes arrays as scipy's loadmat and numpy's savez leave them: by columns.
fn save(path: &Path, arrays: &[(&str, &[u64], Vec<f64>)]) {
    let mut npz = npyz::npz::NpzWriter::create(path).unwrap();
    for (name, shape, values) in arrays {
        let builder = npz.array(name, Default::default()).unwrap();
        let builder = builder.default_dtype().order(Order::Fortran);
        let mut writer = builder.shape(shape).begin_nd().unwrap();
        writer.extend(values).unwrap();
        writer.finish().unwrap();
    }
}

/// An observation mask of 12 x 9 x 7 voxels of 5 mm with holes, by columns, and whether the voxel nearest to a point is set.
fn observation() -> (Vec<f64>, DVec3, impl Fn(DVec3) -> bool) {
    let mut random = Random(11);
    let mask: Vec<f64> = (0..12 * 9 * 7)
        .map(|_| f64::from(u8::from(random.next() < 0.7)))
        .collect();
    let low = DVec3::new(10.0, -20.0, 600.0);
    let copy = mask.clone();
    let seen = move |p: DVec3| {
        let [x, y, z] = [0, 1, 2].map(|axis| ((p[axis] - low[axis]) / 5.0 + 0.5).floor() as i64);
        let inside = (0..12).contains(&x) && (0..9).contains(&y) && (0..7).contains(&z);
        inside && copy[(x + 12 * (y + 9 * z)) as usize] == 1.0
    };
    (mask, low, seen)
}

fn save_observation(path: &Path, mask: &[f64], low: DVec3) {
    let high = low + DVec3::new(55.0, 40.0, 30.0);
    let corners = vec![low.x, high.x, low.y, high.y, low.z, high.z];
    save(
        path,
        &[
            ("ObsMask", &[12, 9, 7], mask.to_vec()),
            ("BB", &[2, 3], corners),
            ("Res", &[1, 1], vec![5.0]),
        ],
    );
}

#[test]
fn dtu_is_that_of_brute_force() {
    let (mask, low, seen) = observation();
    let mut random = Random(5);
    // At least 1.4 mm apart, so that nothing is thinned away; the scan is shifted, and both have parts far from the other.
    let mut cloud = |shift: DVec3, ahead: f64| -> Vec<DVec3> {
        let mut points = Vec::new();
        for x in -10..45 {
            for y in -6..25 {
                let jitter = random.point() * 0.3;
                let height = 10.0 + 6.0 * (0.2 * f64::from(x)).sin();
                let at = DVec3::new(2.0 * f64::from(x), 2.0 * f64::from(y), height);
                points.push(low + shift + at + jitter);
            }
        }
        points.extend((0..60).map(|i| low + DVec3::new(ahead, 2.0 * f64::from(i), 5.0)));
        points
    };
    let (ours, scan) = (
        cloud(DVec3::ZERO, -75.0),
        cloud(DVec3::new(1.0, 0.7, 0.9), 190.0),
    );
    let plane = [0.1, 0.05, 1.0, -(low.z + 8.0) - 0.1 * low.x];
    let files = Files::new();
    files.points("ours.ply", &ours);
    files.points("scan.ply", &scan);
    save_observation(&files.path("mask.npz"), &mask, low);
    save(&files.path("plane.npz"), &[("P", &[4, 1], plane.to_vec())]);
    let (report, text) = files
        .eval("--mesh ours.ply --reference scan.ply --protocol dtu --observed mask.npz --plane plane.npz")
        .unwrap();

    let high = low + DVec3::new(55.0, 40.0, 30.0);
    let boxed: Vec<DVec3> = ours
        .iter()
        .copied()
        .filter(|p| (0..3).all(|a| p[a] >= low[a] - 60.0 && p[a] < high[a] + 120.0))
        .collect();
    let observed: Vec<DVec3> = boxed.iter().copied().filter(|p| seen(*p)).collect();
    let above: Vec<DVec3> = scan
        .iter()
        .copied()
        .filter(|p| p.x * plane[0] + p.y * plane[1] + p.z * plane[2] + plane[3] > 0.0)
        .collect();
    assert!(boxed.len() < ours.len() && observed.len() < boxed.len() && above.len() < scan.len());
    let mean = |from: &[DVec3], to: &[DVec3]| {
        let all: Vec<f64> = from.iter().map(|p| nearest(*p, to)).collect();
        let close: Vec<f64> = all.iter().copied().filter(|d| *d < 20.0).collect();
        (
            close.iter().sum::<f64>() / close.len() as f64,
            all.len() - close.len(),
        )
    };
    let (accuracy, _) = mean(&observed, &scan);
    let (completeness, cut) = mean(&above, &boxed);
    assert!(cut > 0, "the cut-off has something to cut");
    for (name, wanted) in [
        ("accuracy", accuracy),
        ("completeness", completeness),
        ("chamfer", 0.5 * (accuracy + completeness)),
        ("points", observed.len() as f64),
        ("reference_points", above.len() as f64),
    ] {
        let got = report[name].as_f64().unwrap();
        assert!(near(got, wanted, 1e-6), "{name}: {got} for {wanted}");
    }
    assert!(text.contains("Chamfer"), "{text}");
}

#[test]
fn a_mesh_is_measured_by_points_all_over_its_faces() {
    // A square of 40 mm in two large faces, 1.5 mm above a dense scan: by its four vertices alone it would have no distances at all.
    let (mask, low, _) = observation();
    let at = |x: f64, y: f64, z: f64| low + DVec3::new(x, y, 15.0 + z);
    let mesh = Mesh {
        positions: vec![
            at(0.0, 0.0, 1.5),
            at(40.0, 0.0, 1.5),
            at(40.0, 30.0, 1.5),
            at(0.0, 30.0, 1.5),
        ],
        faces: vec![[0, 1, 2], [0, 2, 3]],
        ..Default::default()
    };
    let scan: Vec<DVec3> = (0..160 * 120)
        .map(|index| {
            at(
                f64::from(index % 160) * 0.25,
                f64::from(index / 160) * 0.25,
                0.0,
            )
        })
        .collect();
    let files = Files::new();
    write_mesh(&files.path("mesh.ply"), &mesh, false).unwrap();
    files.points("scan.ply", &scan);
    save_observation(&files.path("mask.npz"), &mask, low);
    save(
        &files.path("plane.npz"),
        &[("P", &[1, 4], vec![0.0, 0.0, 1.0, 0.0])],
    );
    let (report, _) = files
        .eval("--mesh mesh.ply --reference scan.ply --protocol dtu --observed mask.npz --plane plane.npz")
        .unwrap();
    // Next to 1.5, as points lie beside each other by up to 0.2.
    for name in ["accuracy", "completeness"] {
        assert!(
            near(report[name].as_f64().unwrap(), 1.503, 4e-3),
            "{report}"
        );
    }
    let expected = 0.7 * 1200.0 / 0.04;
    let points = report["points"].as_f64().unwrap();
    assert!(
        points > 0.5 * expected && points < 1.1 * expected,
        "{report}"
    );
}

#[test]
fn lattices_are_dense_and_thinned_clouds_are_even() {
    let mut random = Random(9);
    let mesh = Mesh {
        positions: (0..12).map(|_| random.point() * 4.0).collect(),
        faces: vec![[0, 1, 2], [3, 4, 5], [6, 7, 8], [9, 10, 11], [1, 1, 2]],
        ..Default::default()
    };
    let spacing = 0.2;
    let dense = lattice(&mesh, spacing).unwrap();
    for _ in 0..300 {
        let [u, v] = [random.next(), random.next()];
        let [a, b, c] = mesh.corners((random.next() * 4.0) as usize);
        let (u, v) = if u + v > 1.0 {
            (1.0 - u, 1.0 - v)
        } else {
            (u, v)
        };
        let p = a + (b - a) * u + (c - a) * v;
        assert!(nearest(p, &dense) <= spacing, "{p} lies in a gap");
    }
    assert!(mesh.positions.iter().all(|p| nearest(*p, &dense) < 1e-12));

    let thin = thinned(&dense, spacing, 4);
    assert!(thin.len() < dense.len());
    for (index, p) in thin.iter().enumerate() {
        assert!(nearest(*p, &thin[..index]) >= spacing);
    }
    assert!(dense.iter().all(|p| nearest(*p, &thin) < spacing));
    assert_eq!(thin, thinned(&dense, spacing, 4));
    assert_ne!(thin, thinned(&dense, spacing, 5));
}

#[test]
fn a_mesh_is_taken_into_the_frame_of_its_reference() {
    let mut random = Random(2);
    let truth: Vec<DVec3> = (0..400).map(|_| random.point()).collect();
    let similarity = DMat4::from_scale_rotation_translation(
        DVec3::splat(2.5),
        DQuat::from_rotation_x(0.8) * DQuat::from_rotation_z(-2.0),
        DVec3::new(3.0, -1.0, 0.5),
    );
    let back = similarity.inverse();
    let ours: Vec<DVec3> = truth.iter().map(|p| back.transform_point3(*p)).collect();
    let files = Files::new();
    files.points("truth.ply", &truth);
    files.points("ours.ply", &ours);
    let rows = rows(similarity);
    files.write("our_trans.txt", &as_text(similarity));
    files.write(
        "meta_data.json",
        &json!({"worldtogt": rows, "frames": []}).to_string(),
    );
    let mut bytes = Vec::new();
    let builder = npyz::WriteOptions::new().default_dtype().shape(&[4, 4]);
    let mut writer = builder.writer(&mut bytes).begin_nd().unwrap();
    writer.extend(rows.concat()).unwrap();
    writer.finish().unwrap();
    std::fs::write(files.path("align.npy"), bytes).unwrap();

    let plain = "--mesh ours.ply --reference truth.ply";
    let (report, _) = files.eval(plain).unwrap();
    assert!(report["chamfer"].as_f64().unwrap() > 0.1, "{report}");
    for file in ["our_trans.txt", "meta_data.json", "align.npy"] {
        let (report, _) = files.eval(&format!("{plain} --align {file}")).unwrap();
        assert!(
            report["chamfer"].as_f64().unwrap() < 1e-5,
            "{file}: {report}"
        );
    }
}

#[test]
fn cameras_come_along_into_the_frame_of_the_reference() {
    // Two parallel squares; the cameras see the upper one only, in the mesh's coordinates.
    let corners = [[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]];
    let square = |z: f64| corners.map(|[x, y]| DVec3::new(x, y, z));
    let both = Mesh {
        positions: [square(0.0), square(-0.5)].concat(),
        faces: vec![[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]],
        ..Default::default()
    };
    let files = Files::new();
    let similarity = DMat4::from_scale_rotation_translation(
        DVec3::splat(3.0),
        DQuat::from_rotation_y(1.0),
        DVec3::new(30.0, 0.0, -7.0),
    );
    let mut truth = both.clone();
    truth.faces.truncate(2);
    for p in &mut truth.positions {
        *p = similarity.transform_point3(*p);
    }
    write_mesh(&files.path("ours.ply"), &both, false).unwrap();
    write_mesh(&files.path("truth.ply"), &truth, false).unwrap();
    files.write("trans.txt", &as_text(similarity));
    std::fs::create_dir(files.path("photos.set")).unwrap();
    let frame = |index: u32| {
        let name = format!("{index}.png");
        let picture = image::RgbImage::new(32, 32);
        picture.save(files.path("photos.set").join(&name)).unwrap();
        let pose = DMat4::from_translation(DVec3::new(0.1 * f64::from(index), 0.0, 3.0));
        json!({"file_path": name, "transform_matrix": rows(pose)})
    };
    let frames: Vec<Value> = (0..3).map(frame).collect();
    let transforms = json!({"fl_x": 24.0, "frames": frames});
    files.write("photos.set/transforms.json", &transforms.to_string());

    let words =
        "--mesh ours.ply --reference truth.ply --align trans.txt --thresholds 0.01 --samples 4000";
    let number = |report: &Value, name: &str| report.pointer(name).unwrap().as_f64().unwrap();
    let (all, _) = files.eval(words).unwrap();
    let precision = number(&all, "/thresholds/0/precision");
    assert!(near(precision, 0.5, 0.01), "{all}");
    let (seen, _) = files
        .eval(&format!("{words} --visible-from photos.set"))
        .unwrap();
    assert_eq!(number(&seen, "/thresholds/0/precision"), 1.0, "{seen}");
    let points = number(&seen, "/accuracy/points");
    assert!(near(points, 2000.0, 40.0), "{seen}");
}

#[test]
fn what_a_protocol_lacks_is_said() {
    let (mask, low, _) = observation();
    let files = Files::new();
    let points: Vec<DVec3> = (0..50).map(|i| low + f64::from(i)).collect();
    files.points("a.ply", &points);
    files.write("crop.json", &crop_file(1, [0.0, 1.0]).to_string());
    save_observation(&files.path("mask.npz"), &mask, low);
    save(
        &files.path("plane.npz"),
        &[("P", &[4], vec![0.0, 0.0, 1.0, 0.0])],
    );
    let tnt = "--mesh a.ply --reference a.ply --protocol tnt";
    files.refuses(
        &format!("{tnt} --crop-polygon crop.json"),
        &["--scene", "--thresholds"],
    );
    files.refuses(
        &format!("{tnt} --crop-polygon crop.json --scene Barn --thresholds 1"),
        &["either --scene"],
    );
    files.refuses(
        &format!("{tnt} --crop-polygon crop.json --thresholds 1,2"),
        &["one threshold"],
    );
    files.refuses(
        &format!("{tnt} --crop-polygon crop.json --thresholds 0"),
        &["positive"],
    );
    files.refuses(
        &format!("{tnt} --crop-polygon crop.json --scene Horse"),
        &["'Horse'", "Barn, Caterpillar", "--thresholds"],
    );
    files.refuses(&format!("{tnt} --scene Barn"), &["--crop-polygon"]);
    files.refuses(
        &format!("{tnt} --scene Barn --crop-polygon crop.json"),
        &["of the reference's 50 points none", "same scene"],
    );
    files.refuses(
        &format!("{tnt} --scene Barn --trim 1"),
        &["--trim is for --protocol plain"],
    );
    files.refuses(
        &format!("{tnt} --scene Barn --samples 9"),
        &["--samples is for --protocol plain"],
    );
    files.refuses(
        "--mesh a.ply --reference a.ply --plane plane.npz",
        &["--plane is for --protocol dtu, not plain"],
    );
    let dtu = "--mesh a.ply --reference a.ply --protocol dtu";
    files.refuses(
        &format!("{dtu} --plane plane.npz"),
        &["--observed", "ObsMask"],
    );
    files.refuses(&format!("{dtu} --observed mask.npz"), &["--plane"]);
    save(
        &files.path("down.npz"),
        &[("P", &[4], vec![0.0, 0.0, -1.0, 0.0])],
    );
    files.refuses(
        &format!("{dtu} --observed mask.npz --plane down.npz"),
        &["of the scan's 50 points none lies above the plane"],
    );
}

#[test]
fn crop_files_that_bound_nothing_are_refused() {
    let files = Files::new();
    files.points("a.ply", &[DVec3::ZERO]);
    let with = |key: &str, value: Value| {
        let mut crop = crop_file(1, [0.0, 1.0]);
        crop[key] = value;
        files.write("crop.json", &crop.to_string());
    };
    let refuses = |parts: &[&str]| {
        let words =
            "--mesh a.ply --reference a.ply --protocol tnt --scene Barn --crop-polygon crop.json";
        files.refuses(words, &[&["crop.json"], parts].concat());
    };
    with("bounding_polygon", json!([[0, 0, 0], [1, 1, 1]]));
    refuses(&["bounding_polygon has 2 points", "at least 3"]);
    with("bounding_polygon", json!([[0, 0], [1, 1], [2, 0]]));
    refuses(&["is no crop file"]);
    with("orthogonal_axis", json!("W"));
    refuses(&["\"W\"", "X, Y or Z"]);
    with("axis_min", json!(1.0));
    refuses(&["axis_min 1 is not below axis_max 1"]);
    with("axis_max", json!(null));
    refuses(&["is no crop file"]);
    files.write("crop.json", "{");
    refuses(&["is no crop file"]);
}

#[test]
fn masks_planes_and_alignments_of_another_shape_are_refused() {
    let (mask, low, _) = observation();
    let files = Files::new();
    files.points("a.ply", &[low]);
    let corners = || vec![0.0, 1.0, 0.0, 1.0, 0.0, 1.0];
    let plane = vec![0.0, 0.0, 1.0, 0.0];
    save(&files.path("plane.npz"), &[("P", &[4], plane)]);
    let refuses = |arrays: &[(&str, &[u64], Vec<f64>)], part: &str| {
        save(&files.path("bad.npz"), arrays);
        let words =
            "--mesh a.ply --reference a.ply --protocol dtu --observed bad.npz --plane plane.npz";
        files.refuses(words, &["bad.npz", part]);
    };
    let whole = |shape: &'static [u64]| ("ObsMask", shape, mask.clone());
    refuses(
        &[("Mask", &[1], vec![0.0])],
        "holds no ObsMask; there are: Mask",
    );
    refuses(&[whole(&[12, 63])], "three axes");
    let small = ("BB", &[2u64, 2][..], vec![0.0; 4]);
    refuses(&[whole(&[12, 9, 7]), small], "BB has the shape [2, 2]");
    let flat = ("BB", &[2u64, 3][..], vec![0.0; 6]);
    refuses(&[whole(&[12, 9, 7]), flat], "is no box");
    let boxed = || ("BB", &[2u64, 3][..], corners());
    let two = ("Res", &[2u64][..], vec![1.0; 2]);
    refuses(&[whole(&[12, 9, 7]), boxed(), two], "Res holds 2 numbers");
    let none = ("Res", &[1u64][..], vec![0.0]);
    refuses(&[whole(&[12, 9, 7]), boxed(), none], "Res is 0");

    save_observation(&files.path("mask.npz"), &mask, low);
    save(&files.path("line.npz"), &[("P", &[3], vec![1.0; 3])]);
    let dtu = "--mesh a.ply --reference a.ply --protocol dtu --observed mask.npz --plane";
    files.refuses(&format!("{dtu} line.npz"), &["line.npz", "four numbers"]);
    files.write("Plane1.mat", "MATLAB 5.0");
    files.refuses(
        &format!("{dtu} Plane1.mat"),
        &["Plane1.mat", "scipy.io", "savez"],
    );
    let header = [&b"\x93NUMPY\x02\x00"[..], &[0xff; 40]].concat();
    std::fs::write(files.path("long.npy"), header).unwrap();
    files.refuses(
        &format!("{dtu} long.npy"),
        &["long.npy", "ends within its header"],
    );
    files.write("plane.csv", "1,2,3,4");
    files.refuses(
        &format!("{dtu} plane.csv"),
        &["plane.csv", "neither an .npz nor an .npy"],
    );

    for (text, part) in [
        ("1 0 0 0 0 1 0 0 0 0 1 0 0 0 0", "15 of its 15 words"),
        ("1 0 0 x 0 1 0 0 0 0 1 0 0 0 0 1", "3 of its 16 words"),
        ("1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 2", "last row"),
        ("nan 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1", "finite"),
        ("1 0 0 0 0 2 0 0 0 0 1 0 0 0 0 1", "no similarity"),
        ("0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 1", "no similarity"),
    ] {
        files.write("trans.txt", text);
        files.refuses(
            "--mesh a.ply --reference a.ply --align trans.txt",
            &["trans.txt", part, "4 rows of 4 numbers"],
        );
    }
    files.write("meta_data.json", "{\"frames\": []}");
    files.refuses(
        "--mesh a.ply --reference a.ply --align meta_data.json",
        &["states no worldtogt"],
    );
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 128, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn damaged_files_end_in_scores_or_errors(which in 0usize..4, place: u32, value: u8, cut: bool) {
        let (mask, low, _) = observation();
        let files = Files::new();
        files.points("a.ply", &[low, low + 3.0, low + DVec3::new(0.5, 0.5, 0.2)]);
        files.write("crop.json", &crop_file(2, [-1.0, 1e4]).to_string());
        files.write("trans.txt", &as_text(DMat4::IDENTITY));
        save_observation(&files.path("mask.npz"), &mask, low);
        save(&files.path("plane.npz"), &[("P", &[4], vec![0.0, 0.0, 1.0, 0.0])]);
        let damaged = files.path(["crop.json", "trans.txt", "mask.npz", "plane.npz"][which]);
        let mut bytes = std::fs::read(&damaged).unwrap();
        let at = place as usize % bytes.len();
        if cut {
            bytes.truncate(at);
        } else {
            bytes[at] = value;
        }
        std::fs::write(&damaged, bytes).unwrap();
        let mesh = "--mesh a.ply --reference a.ply --align trans.txt --protocol";
        for words in ["tnt --scene Barn --crop-polygon crop.json", "dtu --observed mask.npz --plane plane.npz"] {
            if let Err(error) = files.eval(&format!("{mesh} {words}")) {
                prop_assert!([1, 3].contains(&error.exit_code()), "{error}");
            }
        }
    }
}
