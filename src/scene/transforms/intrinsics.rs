//! Lenses in a transforms.json: pixels, angles or a matrix, for the file or for a frame, with what is missing filled in.

use serde_json::Value;

use super::super::json::{Document, Object, brief};
use super::super::{Camera, CameraModel};
use crate::{Error, Result};

impl Document<'_> {
    /// The intrinsics of one frame: its own keys before the file's.
    pub(super) fn intrinsics(&self, frame: &Object, place: &str) -> Result<Intrinsics> {
        // Keys that belong together come from the same level.
        let level = |keys: &[&str]| {
            let own = keys
                .iter()
                .any(|key| frame.get(*key).is_some_and(|value| !value.is_null()));
            if own { frame } else { &self.top }
        };
        let numbers = |object: &Object, keys: &[&str]| -> Result<Vec<Option<f64>>> {
            keys.iter()
                .map(|key| self.number(object, key, place))
                .collect()
        };
        let group = |keys: &[&str]| numbers(level(keys), keys);
        let either = |key: &str| frame.get(key).or_else(|| self.top.get(key));
        let is_true = |key: &str| either(key).is_some_and(|value| value.as_bool() == Some(true));
        for (key, lens) in [
            ("equirectangular", "equirectangular"),
            ("latlong", "latitude-longitude"),
            ("orthographic", "orthographic"),
        ] {
            if is_true(key) {
                return Err(self.unsupported_lens(place, lens));
            }
        }
        if self
            .number(frame, "ftheta_p0", place)?
            .or(self.number(&self.top, "ftheta_p0", place)?)
            .is_some()
        {
            return Err(self.unsupported_lens(place, "F-theta"));
        }
        let model = either("camera_model")
            .and_then(Value::as_str)
            .unwrap_or("OPENCV");
        let fisheye = match model.to_ascii_uppercase().as_str() {
            "OPENCV" | "PINHOLE" | "SIMPLE_PINHOLE" | "SIMPLE_RADIAL" | "RADIAL"
            | "FULL_OPENCV" | "PERSPECTIVE" => is_true("is_fisheye"),
            "OPENCV_FISHEYE" | "FISHEYE" | "SIMPLE_RADIAL_FISHEYE" | "RADIAL_FISHEYE" => true,
            _ => return Err(self.unsupported_lens(place, model)),
        };
        let mut focal = group(&["fl_x", "fl_y"])?;
        let mut center = group(&["cx", "cy"])?;
        if let Some(matrix) = either("intrinsic_matrix").filter(|_| focal == [None, None]) {
            let entry = |row: usize, column: usize| {
                matrix
                    .get(row)
                    .and_then(|row| row.get(column))
                    .and_then(Value::as_f64)
            };
            focal = vec![entry(0, 0), entry(1, 1)];
            center = vec![entry(0, 2), entry(1, 2)];
        }
        let mut angle = group(&["camera_angle_x", "camera_angle_y"])?;
        if angle == [None, None] {
            let degrees = group(&["x_fov", "y_fov"])?;
            angle = degrees
                .into_iter()
                .map(|angle| angle.map(f64::to_radians))
                .collect();
        }
        let size = match group(&["w", "h"])?[..] {
            [Some(w), Some(h)] if w >= 1.0 && h >= 1.0 => Some((w as u32, h as u32)),
            [None, None] => None,
            _ => return Err(self.error(format!("{place}w and h are no picture size"))),
        };
        let keys = ["k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2"];
        let list = "distortion_params";
        let object = level(&[&keys[..], &[list]].concat());
        let distortion = numbers(object, &keys)?;
        let distortion = match object.get(list).filter(|list| !list.is_null()) {
            Some(list) if distortion == [None; 8] => self.distortion_params(list, place)?,
            _ => std::array::from_fn(|i| distortion[i].unwrap_or(0.0)),
        };
        Ok(Intrinsics {
            focal: [focal[0], focal[1]],
            center: [center[0], center[1]],
            angle: [angle[0], angle[1]],
            size,
            distortion,
            fisheye,
        })
    }

    /// nerfstudio's list of k1 to k4, p1, p2, as k1 to k6, p1, p2.
    fn distortion_params(&self, list: &Value, place: &str) -> Result<[f64; 8]> {
        let numbers: Option<Vec<f64>> = list
            .as_array()
            .and_then(|list| list.iter().map(Value::as_f64).collect());
        match numbers.as_deref() {
            Some(&[k1, k2, k3, k4, p1, p2]) => Ok([k1, k2, k3, k4, 0.0, 0.0, p1, p2]),
            _ => Err(self.error(format!(
                "{place}distortion_params is {}, not the six numbers k1, k2, k3, k4, p1, p2",
                brief(list)
            ))),
        }
    }

    fn unsupported_lens(&self, place: &str, lens: &str) -> Error {
        Error::input(
            self.file,
            format!(
                "{place}the camera model {lens} is not supported; OPENCV, OPENCV_FISHEYE and simpler ones are"
            ),
            "undistort the pictures to a pinhole camera first",
        )
    }
}

/// What a frame says of its lens. What it does not say follows from the picture's size.
#[derive(Clone, Debug)]
pub(in crate::scene) struct Intrinsics {
    /// Pixels, across and down.
    focal: [Option<f64>; 2],
    center: [Option<f64>; 2],
    /// Whole angles of view in radians, across and down.
    angle: [Option<f64>; 2],
    /// Width and height that the lengths refer to.
    size: Option<(u32, u32)>,
    /// k1 to k6, p1, p2
    distortion: [f64; 8],
    fisheye: bool,
}

impl Intrinsics {
    /// The camera of a picture that is stored with `stored` (width, height) pixels; of the stated size where one is stated.
    pub fn camera(&self, stored: (u32, u32)) -> std::result::Result<Camera, String> {
        let (width, height) = self.size.unwrap_or(stored);
        let sides = [f64::from(width), f64::from(height)];
        let from_angle = |axis: usize| {
            let angle = self.angle[axis]?;
            let half = 0.5 * sides[axis];
            Some(if self.fisheye {
                2.0 * half / angle
            } else {
                half / (0.5 * angle).tan()
            })
        };
        let given = if self.focal != [None, None] {
            self.focal
        } else {
            [from_angle(0), from_angle(1)]
        };
        let (fx, fy) = match given {
            [Some(fx), Some(fy)] => (fx, fy),
            [Some(f), None] | [None, Some(f)] => (f, f),
            [None, None] => return Err("no focal length: neither fl_x, camera_angle_x, x_fov nor intrinsic_matrix is there".into()),
        };
        let (cx, cy) = (
            self.center[0].unwrap_or(0.5 * sides[0]),
            self.center[1].unwrap_or(0.5 * sides[1]),
        );
        let [k1, k2, k3, k4, k5, k6, p1, p2] = self.distortion;
        let mut params = vec![fx, fy, cx, cy];
        let model = if self.fisheye {
            params.extend([k1, k2, k3, k4]);
            CameraModel::OpencvFisheye
        } else if k5 != 0.0 || k6 != 0.0 {
            // OpenCV's rational model, where k4 is in the denominator.
            params.extend([k1, k2, p1, p2, k3, k4, k5, k6]);
            CameraModel::FullOpencv
        } else if k4 != 0.0 {
            return Err(format!(
                "k4 = {k4} of a perspective lens: a radial polynomial of the 8th degree is not supported"
            ));
        } else if k3 != 0.0 {
            params.extend([k1, k2, p1, p2, k3, 0.0, 0.0, 0.0]);
            CameraModel::FullOpencv
        } else if [k1, k2, p1, p2] != [0.0; 4] {
            params.extend([k1, k2, p1, p2]);
            CameraModel::Opencv
        } else {
            CameraModel::Pinhole
        };
        Camera::new(model, width, height, params)
    }
}
