//! A synthetic rig of cameras, written to disk in every layout that is read.

use std::fs;
use std::path::{Path, PathBuf};

use glam::{DMat3, DMat4, DQuat, DVec2, DVec3, DVec4};
use neurodin::Error;
use neurodin::scene::{Scene, SceneOptions};
use npyz::WriterBuilder;
use serde_json::{Map, Value, json};
use tempfile::TempDir;

/// Pinhole cameras and what they stand around.
#[derive(Clone)]
pub struct Rig {
    pub width: u32,
    pub height: u32,
    pub focal: DVec2,
    pub center: DVec2,
    /// Name without ending, and pose with OpenGL's camera axes.
    pub views: Vec<(String, DMat4)>,
    pub points: Vec<DVec3>,
}

/// The pose of a camera at `eye` that looks at `target`.
pub fn look_at(eye: DVec3, target: DVec3) -> DMat4 {
    let back = (eye - target).normalize();
    let right = DVec3::Z.cross(back).normalize();
    DMat4::from_cols(
        right.extend(0.0),
        back.cross(right).extend(0.0),
        back.extend(0.0),
        eye.extend(1.0),
    )
}

/// A matrix by rows.
pub fn rows(matrix: DMat4) -> Vec<[f64; 4]> {
    (0..4).map(|row| matrix.row(row).to_array()).collect()
}

/// Writes named arrays of these shapes.
pub fn write_npz(path: &Path, arrays: &[(String, Vec<u64>, Vec<f64>)]) {
    let mut npz = npyz::npz::NpzWriter::create(path).unwrap();
    for (name, shape, values) in arrays {
        let builder = npz.array(name, Default::default()).unwrap();
        let mut writer = builder.default_dtype().shape(shape).begin_nd().unwrap();
        writer.extend(values).unwrap();
        writer.finish().unwrap();
    }
}

/// Points evenly on the sphere of `radius` about `center`.
pub fn sphere(count: usize, center: DVec3, radius: f64) -> Vec<DVec3> {
    (0..count)
        .map(|index| {
            let z = 1.0 - (2.0 * index as f64 + 1.0) / count as f64;
            let angle = index as f64 * 2.399_963_229_728_653;
            let across = (1.0 - z * z).sqrt();
            center + DVec3::new(across * angle.cos(), across * angle.sin(), z) * radius
        })
        .collect()
}

impl Rig {
    /// `count` cameras around a unit ball at (1, 2, 0.5), centred principal point, square pixels.
    pub fn around_a_ball(count: usize) -> Rig {
        let middle = DVec3::new(1.0, 2.0, 0.5);
        let eye = |index: usize| {
            let angle = index as f64 / count as f64 * std::f64::consts::TAU;
            let height = 1.0 + 0.7 * (3.0 * angle).sin();
            middle + DVec3::new(4.0 * angle.cos(), 4.0 * angle.sin(), height)
        };
        Rig {
            width: 64,
            height: 48,
            focal: DVec2::splat(70.0),
            center: DVec2::new(32.0, 24.0),
            views: (0..count)
                .map(|index| (format!("view_{index:03}"), look_at(eye(index), middle)))
                .collect(),
            points: sphere(400, middle, 1.0),
        }
    }

    /// The same, with nothing that could be left out or swapped unnoticed.
    pub fn skewed(count: usize) -> Rig {
        let mut rig = Rig::around_a_ball(count);
        rig.focal = DVec2::new(70.0, 74.5);
        rig.center = DVec2::new(29.25, 26.75);
        rig
    }

    /// The ray of `pixel` in view `index`, from the definition: origin and unit direction, world frame.
    pub fn ray(&self, index: usize, pixel: DVec2) -> (DVec3, DVec3) {
        let pose = self.views[index].1;
        let across = (pixel - self.center) / self.focal;
        let direction = pose.transform_vector3(DVec3::new(across.x, -across.y, -1.0));
        (pose.w_axis.truncate(), direction.normalize())
    }

    /// The picture of view `index`: a gradient that tells pixels and views apart.
    pub fn picture(&self, index: usize) -> image::RgbImage {
        image::RgbImage::from_fn(self.width, self.height, |x, y| {
            image::Rgb([
                (x * 4 % 256) as u8,
                (y * 5 % 256) as u8,
                (index * 20 % 256) as u8,
            ])
        })
    }

    /// Writes all pictures as `folder/name.png`.
    pub fn write_pictures(&self, folder: &Path) {
        fs::create_dir_all(folder).unwrap();
        for (index, (name, _)) in self.views.iter().enumerate() {
            self.picture(index)
                .save(folder.join(format!("{name}.png")))
                .unwrap();
        }
    }

    /// COLMAP's quaternion (w, x, y, z) and translation of view `index`.
    fn colmap_pose(&self, index: usize) -> ([f64; 4], [f64; 3]) {
        let opencv = self.views[index].1 * DMat4::from_diagonal(DVec4::new(1.0, -1.0, -1.0, 1.0));
        let camera_from_world = opencv.inverse();
        let q = DQuat::from_mat3(&DMat3::from_mat4(camera_from_world));
        (
            [q.w, q.x, q.y, q.z],
            camera_from_world.w_axis.truncate().to_array(),
        )
    }

    /// A COLMAP text model. Names get `.png`; images are listed backwards, as their order means nothing.
    pub fn write_colmap_text(&self, model: &Path) {
        fs::create_dir_all(model).unwrap();
        let camera = format!(
            "# Camera list\n7 PINHOLE {} {} {} {} {} {}\n",
            self.width, self.height, self.focal.x, self.focal.y, self.center.x, self.center.y
        );
        fs::write(model.join("cameras.txt"), camera).unwrap();
        let mut images = String::from("# Image list with two lines of data per image:\n");
        for index in (0..self.views.len()).rev() {
            let ([qw, qx, qy, qz], [tx, ty, tz]) = self.colmap_pose(index);
            let observed = if index % 2 == 0 {
                "1.5 2.5 3 4.5 5.5 -1"
            } else {
                ""
            };
            let name = &self.views[index].0;
            images += &format!(
                "{} {qw} {qx} {qy} {qz} {tx} {ty} {tz} 7 {name}.png\n{observed}\n",
                index + 1
            );
        }
        fs::write(model.join("images.txt"), images).unwrap();
        let mut points = String::from("# 3D point list\n");
        for (index, point) in self.points.iter().enumerate() {
            points += &format!(
                "{} {} {} {} 10 20 30 0.5 1 0 2 0\n",
                index + 1,
                point.x,
                point.y,
                point.z
            );
        }
        fs::write(model.join("points3D.txt"), points).unwrap();
    }

    /// A COLMAP binary model.
    pub fn write_colmap_binary(&self, model: &Path) {
        fs::create_dir_all(model).unwrap();
        fs::write(model.join("cameras.bin"), self.colmap_cameras(1)).unwrap();
        fs::write(model.join("images.bin"), self.colmap_images()).unwrap();
        fs::write(model.join("points3D.bin"), self.colmap_points()).unwrap();
    }

    /// cameras.bin with one camera of four parameters that claims to be of model `model_id`.
    pub fn colmap_cameras(&self, model_id: u32) -> Vec<u8> {
        let mut data = 1u64.to_le_bytes().to_vec();
        data.extend([7u32.to_le_bytes(), model_id.to_le_bytes()].concat());
        data.extend(
            [
                u64::from(self.width).to_le_bytes(),
                u64::from(self.height).to_le_bytes(),
            ]
            .concat(),
        );
        for value in [self.focal.x, self.focal.y, self.center.x, self.center.y] {
            data.extend(value.to_le_bytes());
        }
        data
    }

    /// images.bin with two observed points per image.
    pub fn colmap_images(&self) -> Vec<u8> {
        let mut data = (self.views.len() as u64).to_le_bytes().to_vec();
        for index in (0..self.views.len()).rev() {
            let (q, t) = self.colmap_pose(index);
            data.extend((index as u32 + 1).to_le_bytes());
            q.iter()
                .chain(&t)
                .for_each(|value| data.extend(value.to_le_bytes()));
            data.extend(7u32.to_le_bytes());
            data.extend(format!("{}.png\0", self.views[index].0).bytes());
            data.extend(2u64.to_le_bytes());
            data.extend([0u8; 48]);
        }
        data
    }

    /// points3D.bin with two observations per point.
    pub fn colmap_points(&self) -> Vec<u8> {
        let mut data = (self.points.len() as u64).to_le_bytes().to_vec();
        for (index, point) in self.points.iter().enumerate() {
            data.extend((index as u64 + 1).to_le_bytes());
            point
                .to_array()
                .iter()
                .for_each(|value| data.extend(value.to_le_bytes()));
            data.extend([10, 20, 30]);
            data.extend(0.5f64.to_le_bytes());
            data.extend(2u64.to_le_bytes());
            data.extend([0u8; 16]);
        }
        data
    }

    /// The frames of a transforms.json, with what `path` makes of a view's name.
    pub fn frames(&self, path: impl Fn(&str) -> String) -> Vec<Value> {
        let frame = |(name, pose): &(String, DMat4)| json!({"file_path": path(name), "transform_matrix": rows(*pose)});
        self.views.iter().map(frame).collect()
    }

    /// Intrinsics in pixels, as nerfstudio writes them.
    pub fn intrinsics(&self) -> Map<String, Value> {
        let keys = json!({
            "fl_x": self.focal.x, "fl_y": self.focal.y, "cx": self.center.x, "cy": self.center.y,
            "w": self.width, "h": self.height,
        });
        keys.as_object().unwrap().clone()
    }

    /// A transforms.json with these top-level keys and frames at `images/name.png`.
    pub fn transforms(&self, extra: Value) -> Value {
        let mut top = self.intrinsics();
        top.extend(extra.as_object().unwrap().clone());
        top.insert(
            "frames".into(),
            self.frames(|name| format!("images/{name}.png")).into(),
        );
        Value::Object(top)
    }

    /// Pose of view `index` with OpenCV's camera axes.
    pub fn opencv_pose(&self, index: usize) -> DMat4 {
        self.views[index].1 * DMat4::from_diagonal(DVec4::new(1.0, -1.0, -1.0, 1.0))
    }

    /// An sdfstudio meta_data.json with these further top-level keys and frames at `name_rgb.png`.
    pub fn meta_data(&self, extra: Value) -> Value {
        let frame = |index: usize| {
            let intrinsics = [
                [self.focal.x, 0.0, self.center.x, 0.0],
                [0.0, self.focal.y, self.center.y, 0.0],
                [0.0, 0.0, 1.0, 0.0],
                [0.0, 0.0, 0.0, 1.0],
            ];
            json!({
                "rgb_path": format!("{}_rgb.png", self.views[index].0),
                "camtoworld": rows(self.opencv_pose(index)),
                "intrinsics": intrinsics,
            })
        };
        let frames: Vec<Value> = (0..self.views.len()).map(frame).collect();
        let mut top = json!({
            "camera_model": "OPENCV", "height": self.height, "width": self.width, "frames": frames,
        });
        top.as_object_mut()
            .unwrap()
            .extend(extra.as_object().unwrap().clone());
        top
    }

    /// A dataset with pictures and this meta_data.json.
    pub fn sdfstudio(&self, meta_data: &Value) -> Dataset {
        let dataset = Dataset::new();
        for (index, (name, _)) in self.views.iter().enumerate() {
            let file = dataset.at(&format!("{name}_rgb.png"));
            self.picture(index).save(file).unwrap();
        }
        dataset.write("meta_data.json", meta_data.to_string());
        dataset
    }

    /// `world_mat` of view `index`: K [R | t], where the centre of the first pixel is (0, 0).
    pub fn world_mat(&self, index: usize) -> DMat4 {
        let (f, c) = (self.focal, self.center - 0.5);
        let k = DMat4::from_cols(
            DVec4::new(f.x, 0.0, 0.0, 0.0),
            DVec4::new(0.0, f.y, 0.0, 0.0),
            DVec4::new(c.x, c.y, 1.0, 0.0),
            DVec4::W,
        );
        k * self.opencv_pose(index).inverse()
    }

    /// A NeuS dataset: pictures, and `world_mat`s with the sphere of this centre and radius. A projection is known up to a factor, of
    /// either sign: some have one.
    pub fn neus(&self, center: DVec3, radius: f64) -> Dataset {
        let dataset = Dataset::new();
        self.write_pictures(&dataset.at("image"));
        let scale = DMat4::from_translation(center) * DMat4::from_scale(DVec3::splat(radius));
        let mut arrays = Vec::new();
        for index in 0..self.views.len() {
            let factor = [1.0, -2.5, 0.25][index % 3];
            let world = rows(self.world_mat(index) * factor).concat();
            arrays.push((format!("world_mat_{index}"), vec![4, 4], world));
            arrays.push((
                format!("scale_mat_{index}"),
                vec![4, 4],
                rows(scale).concat(),
            ));
        }
        write_npz(&dataset.at("cameras_sphere.npz"), &arrays);
        dataset
    }

    /// A Vis-MVSNet dataset. Views need names that are numbers.
    pub fn mvsnet(&self) -> Dataset {
        let dataset = Dataset::new();
        self.write_pictures(&dataset.at("images"));
        for (index, (name, _)) in self.views.iter().enumerate() {
            dataset.write(&format!("cams/{name}_cam.txt"), self.cam(index));
        }
        dataset
    }

    /// The text of a cam file.
    pub fn cam(&self, index: usize) -> String {
        let line = |row: &[f64]| {
            let numbers: Vec<String> = row.iter().map(f64::to_string).collect();
            numbers.join(" ") + "\n"
        };
        let mut text = String::from("extrinsic\n");
        let camera_from_world = self.opencv_pose(index).inverse();
        (0..4).for_each(|row| text += &line(&camera_from_world.row(row).to_array()));
        text += "\nintrinsic\n";
        text += &line(&[self.focal.x, 0.0, self.center.x]);
        text += &line(&[0.0, self.focal.y, self.center.y]);
        text += &line(&[0.0, 0.0, 1.0]);
        text + "\n0.5 0.01 192 8.5\n"
    }

    /// A dataset with pictures and `transforms`.
    pub fn dataset(&self, transforms: &Value) -> Dataset {
        let dataset = Dataset::new();
        self.write_pictures(&dataset.at("images"));
        dataset.write("transforms.json", transforms.to_string());
        dataset
    }
}

/// A directory that goes away with this.
pub struct Dataset(TempDir);

impl Dataset {
    pub fn new() -> Dataset {
        Dataset(tempfile::tempdir().unwrap())
    }

    pub fn path(&self) -> &Path {
        self.0.path()
    }

    pub fn at(&self, below: &str) -> PathBuf {
        self.path().join(below)
    }

    pub fn write(&self, below: &str, data: impl AsRef<[u8]>) {
        let path = self.at(below);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(path, data).unwrap();
    }

    pub fn open(&self) -> Result<Scene, Error> {
        Scene::open(self.path(), &all_views())
    }

    /// What opening it fails with: exit code 3, and a message that holds each of `parts`.
    pub fn refuses(&self, parts: &[&str]) {
        refused(self.open(), parts);
    }
}

/// Options that hold out no view.
pub fn all_views() -> SceneOptions {
    SceneOptions {
        holdout: 0,
        ..SceneOptions::default()
    }
}

/// Checks that `result` is bad input, said with each of `parts`.
pub fn refused<T>(result: Result<T, Error>, parts: &[&str]) {
    let Err(error) = result else {
        panic!("was accepted; the error should have said {parts:?}");
    };
    assert_eq!(error.exit_code(), 3, "{error}");
    let message = error.to_string();
    for part in parts {
        assert!(message.contains(part), "{part:?} is missing in: {message}");
    }
}

/// Checks that `scene`'s views give the rig's rays to 1e-5, whatever their order.
pub fn assert_rays(rig: &Rig, scene: &Scene) {
    assert_eq!(scene.views.len(), rig.views.len());
    for view in &scene.views {
        let index = rig
            .views
            .iter()
            .position(|(name, _)| view.name.contains(name.as_str()))
            .unwrap();
        assert_eq!(
            (view.camera.width, view.camera.height),
            (rig.width, rig.height)
        );
        for (x, y) in [
            (0.5, 0.5),
            (63.5, 0.5),
            (31.5, 23.5),
            (0.5, 47.5),
            (50.5, 40.5),
        ] {
            let (origin, direction) = view.ray(DVec2::new(x, y));
            let (wanted_origin, wanted_direction) = rig.ray(index, DVec2::new(x, y));
            assert!(
                (origin - wanted_origin).length() < 1e-5,
                "{} {origin} {wanted_origin}",
                view.name
            );
            assert!(
                (direction - wanted_direction).length() < 1e-5,
                "{} {direction} {wanted_direction}",
                view.name
            );
        }
    }
}
