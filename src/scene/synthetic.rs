//! The built-in scene: an analytic surface with texture, photographed into a real dataset with exact ground truth.
//!
//! On a mosaic floor stand a gyroid-cut sphere on a fluted column, a trefoil knot, a Menger cube, a white ball without any texture,
//! linked rings and a fan of ever thinner sticks. `shapes` holds the geometry, `paint` the reflectance, `tracing` the light and the
//! rays; here are the cameras, and what is written to disk. Everything is a function of the options: the same options, the same
//! bytes. World frame: z up, the floor's top at z = 0. Cameras look along -z with y up (OpenGL), pixel centres at +0.5.

use std::f64::consts::PI;
use std::fs;
use std::path::{Path, PathBuf};

use glam::{DMat4, DVec2, DVec3, dvec2, dvec3};
use rayon::prelude::*;
use serde_json::json;

use crate::ply::{self, Element, Scalar};
use crate::{Error, Result, srgb};

mod paint;
mod shapes;
mod tracing;

pub use tracing::{Hit, SKY, SUN, normal, radiance, sdf, trace};

/// Centre of the sphere that holds the scene, and its radius: what `sphere_center` and `sphere_radius` say in the dataset.
pub const CENTER: DVec3 = dvec3(0.0, 0.0, 0.40);
pub const RADIUS: f64 = 1.2;

/// How the built-in scene is photographed.
#[derive(Clone, Debug, PartialEq)]
pub struct SyntheticOptions {
    pub train_views: usize,
    pub test_views: usize,
    pub width: u32,
    pub height: u32,
    /// Edge of the lattice cells of which each holds at most one reference point; world units.
    pub reference_spacing: f64,
}

impl Default for SyntheticOptions {
    fn default() -> Self {
        SyntheticOptions {
            train_views: 48,
            test_views: 6,
            width: 240,
            height: 180,
            reference_spacing: 0.006,
        }
    }
}

/// One posed picture to be taken.
#[derive(Clone, Debug)]
pub struct SyntheticView {
    /// Path of the picture inside the dataset.
    pub file: String,
    pub world_from_camera: DMat4,
}

/// What was written, and where.
#[derive(Clone, Debug)]
pub struct SyntheticDataset {
    pub root: PathBuf,
    /// Point cloud on the exact surface: positions, normals and colours of points that two or more training cameras see.
    pub reference: PathBuf,
    pub reference_points: usize,
    pub train: Vec<SyntheticView>,
    pub test: Vec<SyntheticView>,
}

/// A point of the exact surface.
#[derive(Clone, Copy, Debug)]
pub struct ReferencePoint {
    pub position: DVec3,
    /// Outward unit normal.
    pub normal: DVec3,
    /// Linear colour under the scene's light.
    pub color: DVec3,
}

impl SyntheticOptions {
    /// Focal length in pixels: 48° across.
    pub fn focal(&self) -> f64 {
        1.125 * f64::from(self.width)
    }

    /// Training cameras: spread evenly over a band of the sphere around the scene, 6° to 62° above the horizon.
    pub fn train(&self) -> Vec<SyntheticView> {
        let n = self.train_views;
        let golden = PI * (3.0 - 5f64.sqrt());
        let (low, high) = (6f64.to_radians().sin(), 62f64.to_radians().sin());
        (0..n)
            .map(|index| {
                let part = (index as f64 + 0.5) / n as f64;
                // Distance and aim vary a little from view to view, as they do when people take pictures.
                let wobble = DVec2::from_angle(2.4 * index as f64);
                SyntheticView {
                    file: format!("images/train_{index:03}.png"),
                    world_from_camera: look(
                        golden * index as f64,
                        (low + (high - low) * part).asin(),
                        2.9 + 0.2 * wobble.x,
                        CENTER + dvec3(0.0, 0.05 * wobble.x, 0.05 * wobble.y - 0.16),
                    ),
                }
            })
            .collect()
    }

    /// Held-out cameras: evenly around, at three heights in turn.
    pub fn test(&self) -> Vec<SyntheticView> {
        let n = self.test_views;
        (0..n)
            .map(|index| SyntheticView {
                file: format!("images/test_{index:03}.png"),
                world_from_camera: look(
                    0.5 + 2.0 * PI * index as f64 / n as f64,
                    [14f64, 32.0, 50.0][index % 3].to_radians(),
                    2.85,
                    CENTER - dvec3(0.0, 0.0, 0.16),
                ),
            })
            .collect()
    }

    /// Direction of the ray through `pixel` in the camera's frame, unit length.
    fn direction(&self, pixel: DVec2) -> DVec3 {
        let center = 0.5 * dvec2(f64::from(self.width), f64::from(self.height));
        let offset = (pixel - center) / self.focal();
        dvec3(offset.x, -offset.y, -1.0).normalize()
    }

    /// The picture that a camera takes: 2×2 rays per pixel averaged in linear light, then sRGB. Row-major RGB.
    pub fn photograph(&self, view: &SyntheticView) -> Vec<u8> {
        let origin = view.world_from_camera.w_axis.truncate();
        let (width, height) = (self.width as usize, self.height as usize);
        let mut pixels = vec![0; 3 * width * height];
        pixels
            .par_chunks_mut(3 * width)
            .enumerate()
            .for_each(|(y, row)| {
                for (x, pixel) in row.chunks_mut(3).enumerate() {
                    let mut linear = DVec3::ZERO;
                    for corner in [(0.25, 0.25), (0.75, 0.25), (0.25, 0.75), (0.75, 0.75)] {
                        let at = dvec2(x as f64 + corner.0, y as f64 + corner.1);
                        let direction =
                            view.world_from_camera.transform_vector3(self.direction(at));
                        linear += 0.25
                            * trace(origin, direction, 10.0)
                                .map_or(SKY, |hit| tracing::radiance(&hit));
                    }
                    for (byte, value) in pixel.iter_mut().zip(linear.to_array()) {
                        *byte = srgb::encode(value);
                    }
                }
            });
        pixels
    }

    /// Points of the exact surface that at least two training cameras see: of every lattice cell that the surface crosses, the foot
    /// of its centre, where that foot lies within the cell.
    pub fn reference(&self) -> Vec<ReferencePoint> {
        let train = self.train();
        let spacing = self.reference_spacing;
        // Blocks of 16³ cells are skipped as a whole where the distance at the middle exceeds the half diagonal.
        const BLOCK: i64 = 16;
        let blocks = (RADIUS / spacing / BLOCK as f64).ceil() as i64;
        let side = 2 * blocks;
        (0..side * side * side)
            .into_par_iter()
            .flat_map_iter(|index| {
                let block =
                    [index % side, index / side % side, index / side / side].map(|b| b - blocks);
                let corner = block.map(|b| b * BLOCK);
                let size = BLOCK as f64 * spacing;
                let low =
                    CENTER + spacing * dvec3(corner[0] as f64, corner[1] as f64, corner[2] as f64);
                let mut points = Vec::new();
                if sdf(low + DVec3::splat(0.5 * size)) < 0.87 * size {
                    for cell in 0..BLOCK * BLOCK * BLOCK {
                        let offset = [cell % BLOCK, cell / BLOCK % BLOCK, cell / BLOCK / BLOCK];
                        let middle = low
                            + spacing
                                * dvec3(
                                    offset[0] as f64 + 0.5,
                                    offset[1] as f64 + 0.5,
                                    offset[2] as f64 + 0.5,
                                );
                        points.extend(self.foot(middle).filter(|p| self.seen_by_two(p, &train)));
                    }
                }
                points
            })
            .collect()
    }

    /// The surface point next to `middle`, where it lies in the cell around it: Newton steps along the gradient.
    fn foot(&self, middle: DVec3) -> Option<ReferencePoint> {
        let half = 0.5 * self.reference_spacing;
        let mut p = middle;
        // A bound above the cell's half diagonal: the surface does not cross this cell.
        let mut value = sdf(p);
        if value.abs() > 1.75 * half {
            return None;
        }
        for _ in 0..24 {
            let (slope, direction) = slope(p);
            p -= value / slope.max(0.2) * direction;
            value = sdf(p);
            if value.abs() < 1e-9 {
                break;
            }
        }
        let inside = (p - middle).abs().max_element() <= half;
        if value.abs() > 1e-7 || !inside {
            return None;
        }
        let normal = normal(p);
        let hit = Hit {
            distance: 0.0,
            point: p,
            normal,
            part: tracing::nearest_part(p),
        };
        Some(ReferencePoint {
            position: p,
            normal,
            color: tracing::radiance(&hit),
        })
    }

    fn seen_by_two(&self, point: &ReferencePoint, cameras: &[SyntheticView]) -> bool {
        let mut seen = 0;
        for camera in cameras {
            let eye = camera.world_from_camera.w_axis.truncate();
            if point.normal.dot(eye - point.position) > 0.0
                && self.in_frame(camera, point.position)
                && tracing::visible(point.position + 1e-4 * point.normal, eye, 1e-4)
            {
                seen += 1;
                if seen == 2 {
                    return true;
                }
            }
        }
        false
    }

    fn in_frame(&self, camera: &SyntheticView, p: DVec3) -> bool {
        let [right, up, backward, eye] =
            [0, 1, 2, 3].map(|column| camera.world_from_camera.col(column).truncate());
        let q = p - eye;
        let q = dvec3(q.dot(right), q.dot(up), q.dot(backward));
        let half = 0.5 * dvec2(f64::from(self.width), f64::from(self.height)) / self.focal();
        q.z < 0.0 && q.x.abs() <= -q.z * half.x && q.y.abs() <= -q.z * half.y
    }

    /// `transforms.json` in the keys that nerfstudio and Neuralangelo share.
    fn transforms(&self, views: &[SyntheticView]) -> serde_json::Value {
        let (w, h) = (f64::from(self.width), f64::from(self.height));
        let range: Vec<[f64; 2]> = CENTER
            .to_array()
            .iter()
            .map(|c| [c - RADIUS, c + RADIUS])
            .collect();
        let frames: Vec<_> = views
            .iter()
            .map(|view| {
                let rows: Vec<[f64; 4]> = (0..4)
                    .map(|row| view.world_from_camera.row(row).to_array())
                    .collect();
                json!({ "file_path": view.file, "transform_matrix": rows })
            })
            .collect();
        json!({
            "camera_model": "OPENCV",
            "camera_angle_x": 2.0 * (0.5 * w / self.focal()).atan(),
            "camera_angle_y": 2.0 * (0.5 * h / self.focal()).atan(),
            "fl_x": self.focal(), "fl_y": self.focal(), "cx": 0.5 * w, "cy": 0.5 * h,
            "w": self.width, "h": self.height,
            "sk_x": 0.0, "sk_y": 0.0, "k1": 0.0, "k2": 0.0, "k3": 0.0, "k4": 0.0, "p1": 0.0, "p2": 0.0,
            "is_fisheye": false,
            "aabb_scale": 1.0,
            "aabb_range": range,
            "sphere_center": CENTER.to_array(),
            "sphere_radius": RADIUS,
            "frames": frames,
        })
    }

    /// Writes the dataset to `root`: `images/*.png`, `transforms.json`, `transforms_test.json` and `ground_truth/surface.ply`.
    ///
    /// It is put together beside `root` and moved there when complete. `progress` gets what is being done, how much of it is done,
    /// and how much there is.
    ///
    /// # Errors
    /// [`Error::Output`] where `root` exists and is not an empty folder, or something cannot be written.
    pub fn write(
        &self,
        root: &Path,
        progress: &mut dyn FnMut(&str, usize, usize),
    ) -> Result<SyntheticDataset> {
        let occupied =
            fs::read_dir(root).map_or(root.exists(), |mut entries| entries.next().is_some());
        if occupied {
            let next = "remove it, or name another folder";
            return Err(Error::output(root, "exists already", next));
        }
        let parent = root
            .parent()
            .filter(|p| !p.as_os_str().is_empty())
            .unwrap_or(Path::new("."));
        fs::create_dir_all(parent).map_err(|e| Error::unwritable(parent, &e))?;
        let staging = tempfile::Builder::new()
            .prefix(".dataset-")
            .tempdir_in(parent)
            .map_err(|e| Error::unwritable(parent, &e))?;
        for folder in ["images", "ground_truth"] {
            let path = staging.path().join(folder);
            fs::create_dir(&path).map_err(|e| Error::unwritable(path, &e))?;
        }

        let (train, test) = (self.train(), self.test());
        let total = train.len() + test.len();
        for (index, view) in train.iter().chain(&test).enumerate() {
            progress("rendering photographs", index, total);
            let path = staging.path().join(&view.file);
            let pixels = self.photograph(view);
            image::save_buffer(
                &path,
                &pixels,
                self.width,
                self.height,
                image::ExtendedColorType::Rgb8,
            )
            .map_err(|e| Error::unwritable(path, &e))?;
        }
        progress("rendering photographs", total, total);
        for (name, views) in [("transforms.json", &train), ("transforms_test.json", &test)] {
            let path = staging.path().join(name);
            let text = format!("{:#}\n", self.transforms(views));
            fs::write(&path, text).map_err(|e| Error::unwritable(path, &e))?;
        }

        progress("sampling the exact surface", 0, 1);
        let points = self.reference();
        let inside = Path::new("ground_truth").join("surface.ply");
        let path = staging.path().join(&inside);
        write_points(&path, &points).map_err(|e| Error::unwritable(path, &e))?;
        progress("sampling the exact surface", 1, 1);

        let staged = staging.keep();
        fs::rename(&staged, root).map_err(|e| {
            // What cannot be moved is of no use; the error that matters is the rename's.
            let _ = fs::remove_dir_all(&staged);
            Error::unwritable(root, &e)
        })?;
        Ok(SyntheticDataset {
            root: root.to_path_buf(),
            reference: root.join(inside),
            reference_points: points.len(),
            train,
            test,
        })
    }
}

/// Length and direction of the distance's gradient, by central differences.
fn slope(p: DVec3) -> (f64, DVec3) {
    const H: f64 = 1e-6;
    let along = |axis: DVec3| (sdf(p + H * axis) - sdf(p - H * axis)) / (2.0 * H);
    let gradient = dvec3(along(DVec3::X), along(DVec3::Y), along(DVec3::Z));
    (gradient.length(), gradient.normalize_or(DVec3::Z))
}

/// A camera at `azimuth` and `elevation` (radians) and `distance` from `target`, looking at it, upright.
pub fn look(azimuth: f64, elevation: f64, distance: f64, target: DVec3) -> DMat4 {
    let (level, height) = (elevation.cos(), elevation.sin());
    let backward = dvec3(level * azimuth.cos(), level * azimuth.sin(), height);
    let right = DVec3::Z.cross(backward).normalize();
    DMat4::from_cols(
        right.extend(0.0),
        backward.cross(right).extend(0.0),
        backward.extend(0.0),
        (target + distance * backward).extend(1.0),
    )
}

/// Binary PLY: position, normal, sRGB colour.
fn write_points(path: &Path, points: &[ReferencePoint]) -> std::io::Result<()> {
    let vertex = Element::new("vertex", points.len())
        .with(Scalar::F32, &["x", "y", "z", "nx", "ny", "nz"])
        .with(Scalar::U8, &["red", "green", "blue"]);
    let comment =
        "exact surface, seen by two or more training cameras; world frame of transforms.json";
    let mut file = std::io::BufWriter::new(fs::File::create(path)?);
    ply::write(&mut file, comment, &[vertex], |_, index, values| {
        let point = &points[index];
        values.extend(point.position.to_array());
        values.extend(point.normal.to_array());
        let color = point.color.to_array().map(srgb::encode);
        values.extend(color.map(f64::from));
    })?;
    file.into_inner().map_err(|e| e.into_error())?.sync_all()
}
