//! The built-in scene: what it writes is a real dataset, and its ground truth is exact.

use std::fs;
use std::path::Path;

use glam::{DMat4, DVec2, DVec3, dvec2, dvec3};
use neurodin::Error;
use neurodin::scene::synthetic::{self, ReferencePoint, SyntheticOptions};

fn small() -> SyntheticOptions {
    SyntheticOptions {
        train_views: 12,
        test_views: 2,
        width: 96,
        height: 72,
        reference_spacing: 0.03,
    }
}

fn write(options: &SyntheticOptions, root: &Path) -> synthetic::SyntheticDataset {
    options.write(root, &mut |_, _, _| ()).unwrap()
}

/// Every file below `root` with its bytes, sorted by path.
fn contents(root: &Path) -> Vec<(String, Vec<u8>)> {
    let mut files = Vec::new();
    for entry in fs::read_dir(root).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            files.extend(contents(&path));
        } else {
            files.push((path.display().to_string(), fs::read(&path).unwrap()));
        }
    }
    files.sort();
    files
}

/// The posed pictures that a transforms file lists, read with nothing but what it says: pose, projection of a camera-frame point, pixels.
struct Photograph {
    world_from_camera: DMat4,
    focal: DVec2,
    center: DVec2,
    picture: image::RgbImage,
}

impl Photograph {
    fn read(root: &Path, name: &str) -> Vec<Photograph> {
        let text = fs::read_to_string(root.join(name)).unwrap();
        let json: serde_json::Value = serde_json::from_str(&text).unwrap();
        let number = |key: &str| json[key].as_f64().unwrap();
        json["frames"]
            .as_array()
            .unwrap()
            .iter()
            .map(|frame| {
                let file = root.join(frame["file_path"].as_str().unwrap());
                let picture = image::open(file).unwrap().to_rgb8();
                assert_eq!(
                    (f64::from(picture.width()), f64::from(picture.height())),
                    (number("w"), number("h"))
                );
                let row = |r: usize| {
                    let row: [f64; 4] =
                        serde_json::from_value(frame["transform_matrix"][r].clone()).unwrap();
                    row
                };
                Photograph {
                    world_from_camera: DMat4::from_cols_array_2d(&[row(0), row(1), row(2), row(3)])
                        .transpose(),
                    focal: dvec2(number("fl_x"), number("fl_y")),
                    center: dvec2(number("cx"), number("cy")),
                    picture,
                }
            })
            .collect()
    }

    fn eye(&self) -> DVec3 {
        self.world_from_camera.w_axis.truncate()
    }

    /// Pixel coordinates of a world point in front of the camera.
    fn project(&self, p: DVec3) -> DVec2 {
        let q = self.world_from_camera.inverse().transform_point3(p);
        assert!(q.z < 0.0, "{p} is behind the camera");
        self.center + self.focal * dvec2(q.x, -q.y) / -q.z
    }

    fn sees(&self, point: &ReferencePoint) -> bool {
        let ray = point.position - self.eye();
        let pixel = self.project(point.position);
        let inside = pixel.cmpgt(DVec2::ZERO).all() && pixel.cmplt(2.0 * self.center).all();
        let hit = synthetic::trace(self.eye(), ray.normalize(), 10.0);
        inside && hit.is_some_and(|hit| (hit.distance - ray.length()).abs() < 1e-3)
    }

    /// sRGB in [0, 1], interpolated between pixel centres.
    fn sample(&self, pixel: DVec2) -> DVec3 {
        let limit = 2.0 * self.center - 1.001;
        let at = (pixel - 0.5).clamp(DVec2::ZERO, limit);
        let (x, y) = (at.x as u32, at.y as u32);
        let t = at - at.floor();
        let value = |dx: u32, dy: u32| {
            let c = self.picture.get_pixel(x + dx, y + dy).0;
            dvec3(f64::from(c[0]), f64::from(c[1]), f64::from(c[2])) / 255.0
        };
        let top = value(0, 0).lerp(value(1, 0), t.x);
        top.lerp(value(0, 1).lerp(value(1, 1), t.x), t.y)
    }
}

fn srgb(linear: DVec3) -> DVec3 {
    linear.min(DVec3::ONE).powf(1.0 / 2.2)
}

#[test]
fn the_dataset_is_complete_and_the_same_every_time() {
    let options = small();
    let folder = tempfile::tempdir().unwrap();
    let (first, second) = (folder.path().join("a/one"), folder.path().join("a/two"));
    let dataset = write(&options, &first);
    write(&options, &second);

    assert_eq!(Photograph::read(&first, "transforms.json").len(), 12);
    assert_eq!(Photograph::read(&first, "transforms_test.json").len(), 2);
    assert!(dataset.reference.is_file());
    let strip = |root: &Path| -> Vec<(String, Vec<u8>)> {
        let prefix = root.display().to_string();
        contents(root)
            .into_iter()
            .map(|(path, bytes)| (path[prefix.len()..].to_string(), bytes))
            .collect()
    };
    assert_eq!(strip(&first).len(), 12 + 2 + 2 + 1);
    assert!(
        strip(&first) == strip(&second),
        "two runs wrote different bytes"
    );
    // Nothing is left of the folder in which it was put together.
    assert_eq!(fs::read_dir(folder.path().join("a")).unwrap().count(), 2);

    let transforms: serde_json::Value =
        serde_json::from_str(&fs::read_to_string(first.join("transforms.json")).unwrap()).unwrap();
    assert_eq!(
        transforms["sphere_radius"].as_f64(),
        Some(synthetic::RADIUS)
    );
    let center: [f64; 3] = serde_json::from_value(transforms["sphere_center"].clone()).unwrap();
    assert_eq!(DVec3::from(center), synthetic::CENTER);
}

#[test]
fn an_output_that_exists_is_left_alone() {
    let folder = tempfile::tempdir().unwrap();
    fs::write(folder.path().join("mine.txt"), "precious").unwrap();
    let error = small().write(folder.path(), &mut |_, _, _| ()).unwrap_err();
    assert!(matches!(error, Error::Output { .. }), "{error}");
    assert_eq!(contents(folder.path()).len(), 1);
    // Nor is there a place below a file.
    let below = folder.path().join("mine.txt/dataset");
    let error = small().write(&below, &mut |_, _, _| ()).unwrap_err();
    assert!(matches!(error, Error::Output { .. }), "{error}");
}

#[test]
fn reference_points_lie_on_the_surface_and_two_cameras_see_them() {
    let options = small();
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path().join("scene");
    let dataset = write(&options, &root);
    let photographs = Photograph::read(&root, "transforms.json");
    let points = options.reference();
    assert_eq!(points.len(), dataset.reference_points);
    // About one point per cell that the visible surface crosses: its area is some eight units.
    let expected = 8.0 / (options.reference_spacing * options.reference_spacing);
    let ratio = points.len() as f64 / expected;
    assert!(
        (0.6..1.7).contains(&ratio),
        "{} points, about {expected:.0} expected",
        points.len()
    );
    for point in &points {
        let p = point.position;
        assert!(
            synthetic::sdf(p).abs() < 1e-7,
            "{p} is {} off the surface",
            synthetic::sdf(p)
        );
        assert!(p.distance(synthetic::CENTER) < synthetic::RADIUS);
    }
    // Only in creases, where two parts meet, may a short way along the normal end in matter.
    let inward = points
        .iter()
        .filter(|point| synthetic::sdf(point.position + 1e-4 * point.normal) <= 0.0);
    let inward = inward.count();
    assert!(
        inward * 1000 < points.len(),
        "{inward} of {} normals point inwards",
        points.len()
    );
    for point in points.iter().step_by(7) {
        let seen = photographs
            .iter()
            .filter(|camera| camera.sees(point))
            .count();
        assert!(seen >= 2, "{} is seen by {seen} cameras", point.position);
    }
}

/// Median over points and cameras of the colour difference between the exact surface and the photographs at the points' projections,
/// displaced by `shift` pixels.
fn disagreement(points: &[ReferencePoint], cameras: &[Photograph], shift: DVec2) -> f64 {
    let mut differences: Vec<f64> = Vec::new();
    for point in points {
        for camera in cameras.iter().filter(|camera| camera.sees(point)) {
            let seen = camera.sample(camera.project(point.position) + shift);
            differences.push((seen - srgb(point.color)).abs().element_sum() / 3.0);
        }
    }
    assert!(
        differences.len() > 2000,
        "only {} observations",
        differences.len()
    );
    differences.sort_by(f64::total_cmp);
    differences[differences.len() / 2]
}

#[test]
fn photographs_agree_with_the_surface_at_the_stated_poses() {
    let options = SyntheticOptions {
        train_views: 8,
        test_views: 2,
        width: 240,
        height: 180,
        reference_spacing: 0.04,
    };
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path().join("scene");
    write(&options, &root);
    let points = options.reference();
    for name in ["transforms.json", "transforms_test.json"] {
        let cameras = Photograph::read(&root, name);
        let exact = disagreement(&points, &cameras, DVec2::ZERO);
        assert!(exact < 0.04, "{name}: median difference {exact}");
        // Half a pixel aside must be worse whichever way it is: the poses and the pixel centres are where they are said to be.
        for shift in [
            dvec2(0.5, 0.0),
            dvec2(-0.5, 0.0),
            dvec2(0.0, 0.5),
            dvec2(0.0, -0.5),
        ] {
            let shifted = disagreement(&points, &cameras, shift);
            assert!(
                shifted > 1.1 * exact,
                "{name}: {exact} exact, {shifted} when moved by {shift}"
            );
        }
    }
}
