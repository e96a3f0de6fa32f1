//! What a lens does: from a pixel to the direction that it saw, and back, for COLMAP's camera models 0 to 10.
//!
//! Ten of the eleven models are one formula in different coordinates (COLMAP, `sensor/models.h`). With a point (X, Y, Z) in the
//! camera's frame, Y down and Z forward, let `w` be its undistorted image coordinates:
//!
//! ```text
//! perspective:  w = (X, Y) / Z
//! fisheye:      w = θ (X, Y) / ‖(X, Y)‖,   θ = atan2(‖(X, Y)‖, Z)
//! ```
//!
//! The lens then moves `w` to `w'`, with s = ‖w‖²:
//!
//! ```text
//! ρ(s) = (1 + k1 s + k2 s² + k3 s³ + k4 s⁴) / (1 + k5 s + k6 s² + k7 s³)
//! x' = x ρ + 2 p1 x y + p2 (s + 2 x²) + b1 s
//! y' = y ρ + 2 p2 x y + p1 (s + 2 y²) + b2 s
//! pixel = focal · w' + centre
//! ```
//!
//! and a model is a choice of which coefficients are there. The eleventh, FOV, has a closed form: ‖w'‖ = atan(2 ‖w‖ tan(ω/2)) / ω.
//! Going back, `w` is found by Newton's method. `glsl/lib/camera.glsl` is the same in float32.

use glam::{DVec2, DVec3};
use serde::{Deserialize, Serialize};

/// COLMAP's camera models, by their numbers there.
#[repr(u32)]
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "SCREAMING_SNAKE_CASE")]
pub enum CameraModel {
    /// f, cx, cy
    SimplePinhole = 0,
    /// fx, fy, cx, cy
    Pinhole = 1,
    /// f, cx, cy, k
    SimpleRadial = 2,
    /// f, cx, cy, k1, k2
    Radial = 3,
    /// fx, fy, cx, cy, k1, k2, p1, p2
    Opencv = 4,
    /// fx, fy, cx, cy, k1, k2, k3, k4
    OpencvFisheye = 5,
    /// fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, k5, k6 (the last three in the denominator)
    FullOpencv = 6,
    /// fx, fy, cx, cy, omega
    Fov = 7,
    /// f, cx, cy, k
    SimpleRadialFisheye = 8,
    /// f, cx, cy, k1, k2
    RadialFisheye = 9,
    /// fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, sx1, sy1
    ThinPrismFisheye = 10,
}

/// Models that COLMAP knows and that are refused by name: (number, name).
pub const UNSUPPORTED_MODELS: [(u32, &str); 7] = [
    (11, "RAD_TAN_THIN_PRISM_FISHEYE"),
    (12, "SIMPLE_DIVISION"),
    (13, "DIVISION"),
    (14, "SIMPLE_FISHEYE"),
    (15, "FISHEYE"),
    (16, "EUCM"),
    (17, "EQUIRECTANGULAR"),
];

impl CameraModel {
    /// All models, in the order of their numbers.
    pub const ALL: [CameraModel; 11] = [
        CameraModel::SimplePinhole,
        CameraModel::Pinhole,
        CameraModel::SimpleRadial,
        CameraModel::Radial,
        CameraModel::Opencv,
        CameraModel::OpencvFisheye,
        CameraModel::FullOpencv,
        CameraModel::Fov,
        CameraModel::SimpleRadialFisheye,
        CameraModel::RadialFisheye,
        CameraModel::ThinPrismFisheye,
    ];

    /// The model with COLMAP's number `id`, if it is one of these.
    pub fn from_id(id: u32) -> Option<Self> {
        Self::ALL.get(id as usize).copied()
    }

    /// The model that COLMAP calls `name`, such as `SIMPLE_RADIAL`.
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|model| model.name() == name)
    }

    /// COLMAP's name.
    pub fn name(self) -> &'static str {
        match self {
            CameraModel::SimplePinhole => "SIMPLE_PINHOLE",
            CameraModel::Pinhole => "PINHOLE",
            CameraModel::SimpleRadial => "SIMPLE_RADIAL",
            CameraModel::Radial => "RADIAL",
            CameraModel::Opencv => "OPENCV",
            CameraModel::OpencvFisheye => "OPENCV_FISHEYE",
            CameraModel::FullOpencv => "FULL_OPENCV",
            CameraModel::Fov => "FOV",
            CameraModel::SimpleRadialFisheye => "SIMPLE_RADIAL_FISHEYE",
            CameraModel::RadialFisheye => "RADIAL_FISHEYE",
            CameraModel::ThinPrismFisheye => "THIN_PRISM_FISHEYE",
        }
    }

    /// How many parameters it has.
    pub fn param_count(self) -> usize {
        match self {
            CameraModel::SimplePinhole => 3,
            CameraModel::Pinhole | CameraModel::SimpleRadial | CameraModel::SimpleRadialFisheye => {
                4
            }
            CameraModel::Radial | CameraModel::Fov | CameraModel::RadialFisheye => 5,
            CameraModel::Opencv | CameraModel::OpencvFisheye => 8,
            CameraModel::FullOpencv | CameraModel::ThinPrismFisheye => 12,
        }
    }

    /// Whether directions are parametrised by angle, so that they may lie beyond 90° from the axis.
    pub fn is_fisheye(self) -> bool {
        matches!(
            self,
            CameraModel::OpencvFisheye
                | CameraModel::SimpleRadialFisheye
                | CameraModel::RadialFisheye
                | CameraModel::ThinPrismFisheye
        )
    }

    /// Whether one focal length serves both axes.
    pub fn has_single_focal(self) -> bool {
        matches!(
            self,
            CameraModel::SimplePinhole
                | CameraModel::SimpleRadial
                | CameraModel::Radial
                | CameraModel::SimpleRadialFisheye
                | CameraModel::RadialFisheye
        )
    }
}

impl std::fmt::Display for CameraModel {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(self.name())
    }
}

/// A lens and the raster behind it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Camera {
    pub model: CameraModel,
    /// Pixels across and down.
    pub width: u32,
    pub height: u32,
    /// In COLMAP's order, `model.param_count()` of them; lengths in pixels.
    pub params: Vec<f64>,
}

impl Camera {
    /// A camera whose numbers make sense, or what is wrong with them.
    pub fn new(
        model: CameraModel,
        width: u32,
        height: u32,
        params: Vec<f64>,
    ) -> Result<Self, String> {
        if params.len() != model.param_count() {
            return Err(format!(
                "camera model {model} takes {} parameters, not {}",
                model.param_count(),
                params.len()
            ));
        }
        if let Some(bad) = params.iter().find(|value| !value.is_finite()) {
            return Err(format!(
                "camera parameter {bad} of a {model} camera is not finite"
            ));
        }
        let focals = if model.has_single_focal() { 1 } else { 2 };
        if let Some(bad) = params[..focals].iter().find(|focal| **focal <= 0.0) {
            return Err(format!(
                "focal length {bad} of a {model} camera is not positive"
            ));
        }
        if width == 0 || height == 0 || width > 1 << 17 || height > 1 << 17 {
            return Err(format!(
                "image size {width}x{height} is not between 1 and 131072 pixels a side"
            ));
        }
        Ok(Camera {
            model,
            width,
            height,
            params,
        })
    }

    /// Focal lengths in pixels, across and down.
    pub fn focal(&self) -> DVec2 {
        self.lens().focal
    }

    /// Principal point in pixels; (0, 0) is the outer corner of the first pixel, whose centre is (0.5, 0.5).
    pub fn center(&self) -> DVec2 {
        self.lens().center
    }

    /// The direction that `pixel` sees, in the OpenGL camera frame (x right, y up, looking along -z).
    ///
    /// Perspective models give z = -1, fisheye models a unit vector. Where the distortion reaches no such pixel, it is the direction
    /// whose pixel comes closest.
    pub fn direction(&self, pixel: DVec2) -> DVec3 {
        let lens = self.lens();
        let w = lens.undistort((pixel - lens.center) / lens.focal);
        if !lens.fisheye {
            return DVec3::new(w.x, -w.y, -1.0);
        }
        let theta = w.length();
        if theta < 1e-12 {
            return DVec3::NEG_Z;
        }
        let (sin, cos) = theta.min(std::f64::consts::PI).sin_cos();
        DVec3::new(sin * w.x / theta, -sin * w.y / theta, -cos)
    }

    /// The pixel that sees `point` (OpenGL camera frame), whether or not it lies within the image.
    ///
    /// `None` behind a perspective camera, at the centre, and where the distortion folds back on itself.
    pub fn project(&self, point: DVec3) -> Option<DVec2> {
        let lens = self.lens();
        let (across, forward) = (DVec2::new(point.x, -point.y), -point.z);
        let w = if lens.fisheye {
            let radius = across.length();
            if radius > 0.0 {
                across * (radius.atan2(forward) / radius)
            } else if forward > 0.0 {
                DVec2::ZERO
            } else {
                return None;
            }
        } else {
            if forward <= 0.0 {
                return None;
            }
            across / forward
        };
        if !w.is_finite() || lens.folds_before(w.length()) {
            return None;
        }
        let pixel = lens.distort(w) * lens.focal + lens.center;
        pixel.is_finite().then_some(pixel)
    }

    /// Whether `pixel` lies within the image.
    pub fn contains(&self, pixel: DVec2) -> bool {
        pixel.x >= 0.0
            && pixel.y >= 0.0
            && pixel.x < f64::from(self.width)
            && pixel.y < f64::from(self.height)
    }

    /// The same lens over an image of `width` by `height` pixels.
    ///
    /// A model with one focal length becomes its sibling with two where the two scales differ.
    pub fn scaled(&self, width: u32, height: u32) -> Camera {
        let scale = DVec2::new(
            f64::from(width) / f64::from(self.width),
            f64::from(height) / f64::from(self.height),
        );
        let old = &self.params;
        let (model, params) = if self.model.has_single_focal() && scale.x == scale.y {
            let mut params = old.clone();
            params[..3].iter_mut().for_each(|length| *length *= scale.x);
            (self.model, params)
        } else if self.model.has_single_focal() {
            let mut params = vec![
                old[0] * scale.x,
                old[0] * scale.y,
                old[1] * scale.x,
                old[2] * scale.y,
            ];
            let radial = |index: usize| old.get(index).copied().unwrap_or(0.0);
            let model = match self.model {
                CameraModel::SimplePinhole => CameraModel::Pinhole,
                CameraModel::SimpleRadial | CameraModel::Radial => CameraModel::Opencv,
                _ => CameraModel::OpencvFisheye,
            };
            if model != CameraModel::Pinhole {
                params.extend([radial(3), radial(4), 0.0, 0.0]);
            }
            (model, params)
        } else {
            let mut params = old.clone();
            params[0] *= scale.x;
            params[1] *= scale.y;
            params[2] *= scale.x;
            params[3] *= scale.y;
            (self.model, params)
        };
        Camera {
            model,
            width,
            height,
            params,
        }
    }

    /// The same lens over an image of at most so many pixels, in proportion; over as many as now where those are no more.
    pub fn within(&self, pixels: u64) -> Camera {
        let now = f64::from(self.width) * f64::from(self.height);
        let factor = (pixels as f64 / now).sqrt().min(1.0);
        let reduced = |size: u32| ((f64::from(size) * factor) as u32).max(1);
        self.scaled(reduced(self.width), reduced(self.height))
    }

    /// The parameters as kernels take them: twelve floats, zeros behind the last.
    pub fn params_f32(&self) -> [f32; 12] {
        let mut padded = [0.0; 12];
        for (slot, value) in padded.iter_mut().zip(&self.params) {
            *slot = *value as f32;
        }
        padded
    }

    /// Half the smaller angle of view, in radians: from the axis to the middle of the nearest edge.
    pub fn half_angle(&self) -> f64 {
        let (w, h, c) = (f64::from(self.width), f64::from(self.height), self.center());
        [
            DVec2::new(0.0, c.y),
            DVec2::new(w, c.y),
            DVec2::new(c.x, 0.0),
            DVec2::new(c.x, h),
        ]
        .into_iter()
        .map(|edge| self.direction(edge).angle_between(DVec3::NEG_Z))
        .fold(f64::INFINITY, f64::min)
    }

    fn lens(&self) -> Lens {
        let p = &self.params;
        let mut lens = if self.model.has_single_focal() {
            Lens::new(DVec2::splat(p[0]), DVec2::new(p[1], p[2]))
        } else {
            Lens::new(DVec2::new(p[0], p[1]), DVec2::new(p[2], p[3]))
        };
        lens.fisheye = self.model.is_fisheye();
        match self.model {
            CameraModel::SimplePinhole | CameraModel::Pinhole => {}
            CameraModel::SimpleRadial | CameraModel::SimpleRadialFisheye => {
                lens.numerator[0] = p[3]
            }
            CameraModel::Radial | CameraModel::RadialFisheye => {
                lens.numerator[..2].copy_from_slice(&p[3..5])
            }
            CameraModel::Opencv => {
                lens.numerator[..2].copy_from_slice(&p[4..6]);
                lens.tangential = DVec2::new(p[6], p[7]);
            }
            CameraModel::OpencvFisheye => lens.numerator.copy_from_slice(&p[4..8]),
            CameraModel::FullOpencv => {
                lens.numerator[..3].copy_from_slice(&[p[4], p[5], p[8]]);
                lens.denominator.copy_from_slice(&p[9..12]);
                lens.tangential = DVec2::new(p[6], p[7]);
            }
            CameraModel::Fov => lens.omega = p[4],
            CameraModel::ThinPrismFisheye => {
                lens.numerator.copy_from_slice(&[p[4], p[5], p[8], p[9]]);
                lens.tangential = DVec2::new(p[6], p[7]);
                lens.prism = DVec2::new(p[10], p[11]);
            }
        }
        lens
    }
}

/// The coefficients of the one formula; zero where a model has none.
struct Lens {
    focal: DVec2,
    center: DVec2,
    fisheye: bool,
    /// k1 to k4
    numerator: [f64; 4],
    /// k5 to k7
    denominator: [f64; 3],
    tangential: DVec2,
    prism: DVec2,
    /// FOV's angle; 0 for every other model.
    omega: f64,
}

/// Below this FOV's angle is no distortion at all in float64.
const SMALLEST_OMEGA: f64 = 1e-7;

impl Lens {
    fn new(focal: DVec2, center: DVec2) -> Self {
        Lens {
            focal,
            center,
            fisheye: false,
            numerator: [0.0; 4],
            denominator: [0.0; 3],
            tangential: DVec2::ZERO,
            prism: DVec2::ZERO,
            omega: 0.0,
        }
    }

    fn is_straight(&self) -> bool {
        self.numerator == [0.0; 4]
            && self.denominator == [0.0; 3]
            && self.tangential == DVec2::ZERO
            && self.prism == DVec2::ZERO
    }

    /// ρ(s) and its derivative.
    fn radial(&self, s: f64) -> (f64, f64) {
        let [k1, k2, k3, k4] = self.numerator;
        let [k5, k6, k7] = self.denominator;
        let top = 1.0 + s * (k1 + s * (k2 + s * (k3 + s * k4)));
        let d_top = k1 + s * (2.0 * k2 + s * (3.0 * k3 + s * 4.0 * k4));
        let bottom = 1.0 + s * (k5 + s * (k6 + s * k7));
        let d_bottom = k5 + s * (2.0 * k6 + s * 3.0 * k7);
        (
            top / bottom,
            (d_top * bottom - top * d_bottom) / (bottom * bottom),
        )
    }

    fn distort(&self, w: DVec2) -> DVec2 {
        if self.omega.abs() > SMALLEST_OMEGA {
            let radius = w.length();
            let slope = 2.0 * (0.5 * self.omega).tan();
            return if radius * slope.abs() < 1e-9 {
                w * (slope / self.omega)
            } else {
                w * ((radius * slope).atan() / (self.omega * radius))
            };
        }
        let (x, y, s) = (w.x, w.y, w.length_squared());
        let (rho, _) = self.radial(s);
        let (p1, p2) = (self.tangential.x, self.tangential.y);
        DVec2::new(
            x * rho + 2.0 * p1 * x * y + p2 * (s + 2.0 * x * x) + self.prism.x * s,
            y * rho + 2.0 * p2 * x * y + p1 * (s + 2.0 * y * y) + self.prism.y * s,
        )
    }

    /// The `w` that `distort` sends to `target`: Newton's method from `target` itself, with steps halved until they help.
    fn undistort(&self, target: DVec2) -> DVec2 {
        if self.omega.abs() > SMALLEST_OMEGA {
            let radius = target.length();
            let slope = 2.0 * (0.5 * self.omega).tan();
            let angle = (radius * self.omega.abs()).min(std::f64::consts::FRAC_PI_2 - 1e-6);
            return if angle < 1e-9 {
                target * (self.omega / slope)
            } else {
                target * (angle.tan() / (slope.abs() * radius))
            };
        }
        if self.is_straight() {
            return target;
        }
        let mut w = target;
        let mut error = self.distort(w) - target;
        for _ in 0..50 {
            let step = self.newton_step(w, error);
            let mut fraction = 1.0;
            let (next, next_error) = loop {
                let next = w - step * fraction;
                let next_error = self.distort(next) - target;
                if next_error.length_squared() < error.length_squared() || fraction < 1e-4 {
                    break (next, next_error);
                }
                fraction *= 0.5;
            };
            if next_error.length_squared() >= error.length_squared() || !next_error.is_finite() {
                break; // as close as float64, or the fold of this lens, lets it come
            }
            (w, error) = (next, next_error);
        }
        w
    }

    /// J⁻¹ `error` at `w`, no longer than what keeps Newton's method from leaping over a fold.
    fn newton_step(&self, w: DVec2, error: DVec2) -> DVec2 {
        let (x, y, s) = (w.x, w.y, w.length_squared());
        let (rho, d_rho) = self.radial(s);
        let (p1, p2) = (self.tangential.x, self.tangential.y);
        let (b1, b2) = (self.prism.x, self.prism.y);
        let xx = rho + 2.0 * x * x * d_rho + 2.0 * p1 * y + 6.0 * p2 * x + 2.0 * b1 * x;
        let xy = 2.0 * x * y * d_rho + 2.0 * p1 * x + 2.0 * p2 * y + 2.0 * b1 * y;
        let yx = 2.0 * x * y * d_rho + 2.0 * p2 * y + 2.0 * p1 * x + 2.0 * b2 * x;
        let yy = rho + 2.0 * y * y * d_rho + 2.0 * p2 * x + 6.0 * p1 * y + 2.0 * b2 * y;
        let det = xx * yy - xy * yx;
        if det.abs() < 1e-12 {
            return DVec2::ZERO;
        }
        let step = DVec2::new(yy * error.x - xy * error.y, xx * error.y - yx * error.x) / det;
        step.clamp_length_max(0.5 * (1.0 + w.length()))
    }

    /// Whether the distance from the image's centre stops growing somewhere on the way out to `radius`.
    fn folds_before(&self, radius: f64) -> bool {
        const PROBES: u32 = 24;
        if self.is_straight() || self.omega != 0.0 {
            return false;
        }
        (1..=PROBES).any(|probe| {
            let s = (radius * f64::from(probe) / f64::from(PROBES)).powi(2);
            let (rho, d_rho) = self.radial(s);
            // A pole of the denominator is a fold too: ρ turns negative behind it.
            !(rho + 2.0 * s * d_rho > 0.0 && rho > 0.0)
        })
    }
}
