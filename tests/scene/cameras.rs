//! Every camera model against its formula as COLMAP writes it, and there and back.

use glam::{DVec2, DVec3};
use neurodin::scene::{Camera, CameraModel};
use proptest::prelude::*;

/// One camera per model, with distortion such as calibrations of real lenses give.
fn cameras() -> Vec<Camera> {
    let params = |model: CameraModel| match model {
        CameraModel::SimplePinhole => vec![500.0, 322.0, 239.0],
        CameraModel::Pinhole => vec![500.0, 510.0, 322.0, 239.0],
        CameraModel::SimpleRadial => vec![500.0, 322.0, 239.0, -0.12],
        CameraModel::Radial => vec![500.0, 322.0, 239.0, -0.2, 0.06],
        CameraModel::Opencv => vec![500.0, 510.0, 322.0, 239.0, -0.2, 0.06, 1e-3, -2e-3],
        CameraModel::OpencvFisheye => {
            vec![300.0, 302.0, 322.0, 239.0, 0.04, -0.01, 4e-3, -1e-3]
        }
        CameraModel::FullOpencv => {
            vec![
                500.0, 510.0, 322.0, 239.0, 0.3, 0.05, 1e-3, -2e-3, 0.01, 0.5, 0.1, 0.01,
            ]
        }
        CameraModel::Fov => vec![400.0, 405.0, 322.0, 239.0, 0.9],
        CameraModel::SimpleRadialFisheye => vec![300.0, 322.0, 239.0, -0.02],
        CameraModel::RadialFisheye => vec![300.0, 322.0, 239.0, -0.02, 3e-3],
        CameraModel::ThinPrismFisheye => {
            vec![
                300.0, 302.0, 322.0, 239.0, 0.04, -0.01, 1e-3, -1e-3, 4e-3, -1e-3, 2e-3, -1e-3,
            ]
        }
    };
    CameraModel::ALL
        .into_iter()
        .map(|model| Camera::new(model, 640, 480, params(model)).unwrap())
        .collect()
}

fn pixels() -> impl Iterator<Item = DVec2> {
    (0..=16).flat_map(|row| {
        (0..=16).map(move |column| DVec2::new(f64::from(column) * 40.0, f64::from(row) * 30.0))
    })
}

#[test]
fn every_model_returns_to_the_pixel() {
    for camera in cameras() {
        for pixel in pixels() {
            let direction = camera.direction(pixel);
            let back = camera
                .project(direction * 3.7)
                .unwrap_or_else(|| panic!("{} {pixel}", camera.model));
            assert!(
                (back - pixel).length() <= 1e-6,
                "{} {pixel} came back as {back}",
                camera.model
            );
        }
    }
}

#[test]
fn every_model_returns_to_the_direction() {
    for camera in cameras() {
        for pixel in pixels() {
            let direction = camera.direction(pixel).normalize();
            let again = camera
                .direction(camera.project(direction).unwrap())
                .normalize();
            assert!(
                (again - direction).length() <= 1e-9,
                "{} {pixel}",
                camera.model
            );
        }
    }
}

/// The formulas of COLMAP's models one by one, written out as they stand there, for one point.
#[test]
fn distortion_is_that_of_each_model_written_out() {
    let (x, y) = (0.31, -0.17);
    let (r2, point) = (x * x + y * y, DVec3::new(x, -y, -1.0));
    let (r, theta) = (f64::sqrt(r2), f64::atan(r2.sqrt()));
    for camera in cameras() {
        let p = camera.params.clone();
        let brown = |k1: f64, k2: f64, p1: f64, p2: f64| {
            let radial = k1 * r2 + k2 * r2 * r2;
            (
                x + x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
                y + y * radial + 2.0 * p2 * x * y + p1 * (r2 + 2.0 * y * y),
            )
        };
        let fisheye = |k: [f64; 4]| {
            let t2 = theta * theta;
            let d = theta
                * (1.0 + k[0] * t2 + k[1] * t2.powi(2) + k[2] * t2.powi(3) + k[3] * t2.powi(4));
            (x * d / r, y * d / r)
        };
        let (u, v) = match camera.model {
            CameraModel::SimplePinhole | CameraModel::Pinhole => (x, y),
            CameraModel::SimpleRadial => brown(p[3], 0.0, 0.0, 0.0),
            CameraModel::Radial => brown(p[3], p[4], 0.0, 0.0),
            CameraModel::Opencv => brown(p[4], p[5], p[6], p[7]),
            CameraModel::OpencvFisheye => fisheye([p[4], p[5], p[6], p[7]]),
            CameraModel::FullOpencv => {
                let radial = (1.0 + p[4] * r2 + p[5] * r2.powi(2) + p[8] * r2.powi(3))
                    / (1.0 + p[9] * r2 + p[10] * r2.powi(2) + p[11] * r2.powi(3));
                (
                    x * radial + 2.0 * p[6] * x * y + p[7] * (r2 + 2.0 * x * x),
                    y * radial + 2.0 * p[7] * x * y + p[6] * (r2 + 2.0 * y * y),
                )
            }
            CameraModel::Fov => {
                let factor = (2.0 * r * (p[4] / 2.0).tan()).atan() / (r * p[4]);
                (x * factor, y * factor)
            }
            CameraModel::SimpleRadialFisheye => fisheye([p[3], 0.0, 0.0, 0.0]),
            CameraModel::RadialFisheye => fisheye([p[3], p[4], 0.0, 0.0]),
            CameraModel::ThinPrismFisheye => {
                let (x, y) = (theta * x / r, theta * y / r);
                let r2 = x * x + y * y;
                let radial = p[4] * r2 + p[5] * r2.powi(2) + p[8] * r2.powi(3) + p[9] * r2.powi(4);
                (
                    x + x * radial + 2.0 * p[6] * x * y + p[7] * (r2 + 2.0 * x * x) + p[10] * r2,
                    y + y * radial + 2.0 * p[7] * x * y + p[6] * (r2 + 2.0 * y * y) + p[11] * r2,
                )
            }
        };
        let (fx, fy, cx, cy) = if camera.model.has_single_focal() {
            (p[0], p[0], p[1], p[2])
        } else {
            (p[0], p[1], p[2], p[3])
        };
        let wanted = DVec2::new(fx * u + cx, fy * v + cy);
        let got = camera.project(point * 2.0).unwrap();
        assert!(
            (got - wanted).length() < 1e-9,
            "{}: {got} instead of {wanted}",
            camera.model
        );
    }
}

#[test]
fn a_scaled_camera_sees_the_same_directions() {
    for camera in cameras() {
        for (width, height) in [(320, 240), (320, 239), (1280, 960), (213, 160)] {
            let small = camera.scaled(width, height);
            assert_eq!(small.params.len(), small.model.param_count());
            let scale = DVec2::new(f64::from(width) / 640.0, f64::from(height) / 480.0);
            for pixel in pixels() {
                let difference = small.direction(pixel * scale) - camera.direction(pixel);
                assert!(
                    difference.length() < 1e-9,
                    "{} to {width}x{height}",
                    camera.model
                );
            }
        }
    }
}

#[test]
fn beyond_the_fold_nothing_is_seen_and_nothing_breaks() {
    // x - 0.3 x³ turns at x = 1.054: directions further out would come back into the picture.
    let camera = Camera::new(
        CameraModel::SimpleRadial,
        640,
        480,
        vec![300.0, 320.0, 240.0, -0.3],
    )
    .unwrap();
    assert!(camera.project(DVec3::new(1.0, 0.0, -1.0)).is_some());
    assert!(camera.project(DVec3::new(1.2, 0.0, -1.0)).is_none());
    assert!(camera.project(DVec3::new(9.0, 0.0, -1.0)).is_none());
    for pixel in pixels() {
        assert!(camera.direction(pixel * 10.0).is_finite());
    }
}

#[test]
fn wide_fisheyes_look_behind_themselves() {
    let camera = Camera::new(
        CameraModel::RadialFisheye,
        640,
        640,
        vec![150.0, 320.0, 320.0, 0.0, 0.0],
    )
    .unwrap();
    let direction = camera.direction(DVec2::new(320.0 + 150.0 * 2.0, 320.0));
    assert!(direction.z > 0.0);
    assert!((camera.project(direction).unwrap().x - 620.0).abs() < 1e-9);
}

#[test]
fn senseless_cameras_are_refused() {
    for (model, width, params, what) in [
        (
            CameraModel::Pinhole,
            640,
            vec![1.0; 3],
            "takes 4 parameters, not 3",
        ),
        (
            CameraModel::Pinhole,
            640,
            vec![-1.0, 1.0, 1.0, 1.0],
            "focal length -1",
        ),
        (CameraModel::Pinhole, 0, vec![1.0; 4], "0x480"),
        (
            CameraModel::SimplePinhole,
            640,
            vec![f64::NAN, 1.0, 1.0],
            "not finite",
        ),
    ] {
        let error = Camera::new(model, width, 480, params).unwrap_err();
        assert!(error.contains(what), "{error}");
    }
}

/// Distortion coefficients behind the focal lengths and the centre.
fn with_coefficients(model: CameraModel, coefficients: &[f64]) -> Camera {
    let mut params = if model.has_single_focal() {
        vec![400.0]
    } else {
        vec![400.0, 410.0]
    };
    params.extend([322.0, 239.0]);
    let lens = model.param_count() - params.len();
    params.extend(&coefficients[..lens]);
    Camera::new(model, 640, 480, params).unwrap()
}

#[test]
fn a_camera_is_reduced_to_so_many_pixels_and_never_enlarged() {
    let camera = &cameras()[0];
    for (pixels, size) in [
        (1 << 20, (640, 480)),
        (640 * 480, (640, 480)),
        (15_000, (141, 106)),
        (1, (1, 1)),
    ] {
        let reduced = camera.within(pixels);
        assert_eq!((reduced.width, reduced.height), size, "{pixels}");
    }
    // What was seen in the middle still is.
    let at = DVec2::new(322.0, 239.0);
    let moved = at * DVec2::new(141.0 / 640.0, 106.0 / 480.0);
    let (before, after) = (camera.direction(at), camera.within(15_000).direction(moved));
    assert!(before.angle_between(after) < 1e-9);
}

proptest! {
    #![proptest_config(ProptestConfig { failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn mild_lenses_are_undone_everywhere(coefficients in prop::collection::vec(-0.008..0.008f64, 8)) {
        for model in CameraModel::ALL {
            let camera = with_coefficients(model, &coefficients);
            for pixel in pixels() {
                let back = camera.project(camera.direction(pixel));
                let back = back.unwrap_or_else(|| panic!("{model} {pixel} {coefficients:?}"));
                prop_assert!((back - pixel).length() <= 1e-6, "{model} {pixel} came back as {back}");
            }
        }
    }

    #[test]
    fn senseless_lenses_still_give_numbers(coefficients in prop::collection::vec(-50.0..50.0f64, 8)) {
        for model in CameraModel::ALL {
            let camera = with_coefficients(model, &coefficients);
            for pixel in pixels() {
                let direction = camera.direction(pixel);
                prop_assert!(direction.is_finite(), "{model} {pixel} {direction}");
                prop_assert!(camera.project(direction).is_none_or(|pixel| pixel.is_finite()));
            }
        }
    }
}
