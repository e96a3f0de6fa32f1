//! Pictures and cameras: what a dataset on disk becomes. CPU only; knows of no GPU.
//!
//! [`Scene::open`] recognises the layout, reads poses and lenses, finds the pictures and masks, and says what it left out.
//! [`Region::estimate`] chooses the part of space to reconstruct.
//!
//! Frames of reference: the world is that of the input. A camera looks along its -z with y up (OpenGL), and `world_from_camera` is
//! rigid. Pixel (0.5, 0.5) is the centre of the first pixel. Where a layout holds two frames, the world is the one that its cameras
//! are written in: for sdfstudio that of `camtoworld`, for NeuS that of `world_mat` (before `scale_mat`).

mod beyond;
mod bounds;
mod camera;
mod colmap;
mod images;
mod json;
mod mvsnet;
mod neus;
mod points;
mod preview;
mod priors;
mod sdfstudio;
pub mod synthetic;
mod transforms;

use std::collections::HashSet;
use std::path::{Path, PathBuf};

use glam::{DMat3, DMat4, DVec2, DVec3, DVec4};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::{Error, Result};

pub use beyond::Beyond;
pub use bounds::{Facing, Looks, Region, RegionOverrides, RegionShape};
pub use camera::{Camera, CameraModel, UNSUPPORTED_MODELS};
pub use images::Picture;
pub use preview::write_preview;
pub use priors::{ObjectMasks, Prior, PriorKind, PriorPaths};
pub use sdfstudio::truth_from_world;

/// A dataset: posed views, sparse points where it has any, and what its author said of the region.
#[derive(Clone, Debug)]
pub struct Scene {
    /// The directory that paths in the dataset are relative to.
    pub root: PathBuf,
    pub format: Format,
    /// Training and held-out views, in the order of the dataset (COLMAP: by name).
    pub views: Vec<View>,
    /// Sparse points, world frame; empty where the dataset has none.
    pub points: Vec<Point>,
    pub region_hint: Option<RegionHint>,
    /// Into the frame of the ground truth, where the dataset states it (sdfstudio's worldtogt): a similarity.
    pub truth_from_world: Option<DMat4>,
    /// What was there, or should have been, and is not used.
    pub skipped: Vec<Skipped>,
    /// What was done to the input that its author may want to know of, such as scaled intrinsics.
    pub notes: Vec<String>,
    /// Whether masks and alpha channels reach [`Picture::rgba`].
    pub masks: bool,
}

/// The dialect that a dataset is written in.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Format {
    /// cameras, images and points3D, `.bin` or `.txt`
    Colmap,
    /// transforms.json with intrinsics
    Nerfstudio,
    /// transforms.json with aabb_scale, scale or offset
    InstantNgp,
    /// transforms.json with sphere_center and sphere_radius
    Neuralangelo,
    /// transforms_train.json, transforms_test.json
    Blender,
    /// meta_data.json
    Sdfstudio,
    /// cameras_sphere.npz
    Neus,
    /// cams/*_cam.txt
    VisMvsnet,
}

impl std::fmt::Display for Format {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Format::Colmap => "COLMAP",
            Format::Nerfstudio => "nerfstudio transforms.json",
            Format::InstantNgp => "instant-ngp transforms.json",
            Format::Neuralangelo => "Neuralangelo transforms.json",
            Format::Blender => "Blender transforms_train.json",
            Format::Sdfstudio => "sdfstudio meta_data.json",
            Format::Neus => "NeuS cameras_sphere.npz",
            Format::VisMvsnet => "Vis-MVSNet cams",
        })
    }
}

/// One posed picture.
#[derive(Clone, Debug)]
pub struct View {
    /// As the dataset calls it, with forward slashes.
    pub name: String,
    pub image_path: PathBuf,
    /// White (or 1) where the picture counts; for instant-ngp's `dynamic_mask_*` the reverse.
    pub mask_path: Option<PathBuf>,
    pub priors: PriorPaths,
    /// Lens and raster of the picture as [`Scene::load_picture`] gives it, that is after down-scaling.
    pub camera: Camera,
    pub world_from_camera: DMat4,
    pub split: Split,
}

impl View {
    /// Where the camera stands, world frame.
    pub fn position(&self) -> DVec3 {
        self.world_from_camera.w_axis.truncate()
    }

    /// The optical axis: unit, world frame.
    pub fn forward(&self) -> DVec3 {
        -self.world_from_camera.z_axis.truncate()
    }

    /// Origin and unit direction of the ray through `pixel`, world frame.
    pub fn ray(&self, pixel: DVec2) -> (DVec3, DVec3) {
        let direction = self
            .world_from_camera
            .transform_vector3(self.camera.direction(pixel));
        (self.position(), direction.normalize())
    }

    /// The pixel that `point` (world frame) falls on, if it lies within the picture.
    pub fn sees(&self, point: DVec3) -> Option<DVec2> {
        let rotation = DMat3::from_mat4(self.world_from_camera);
        let pixel = self
            .camera
            .project(rotation.transpose() * (point - self.position()))?;
        self.camera.contains(pixel).then_some(pixel)
    }
}

/// What a view is for.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Split {
    Train,
    Test,
}

/// A sparse point, world frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Point {
    pub position: DVec3,
    pub color: [u8; 3],
}

/// Something left out, and the reason.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Skipped {
    pub what: String,
    pub why: String,
}

/// What the dataset itself says of the region to reconstruct, world frame.
#[derive(Clone, Debug, PartialEq)]
pub struct RegionHint {
    pub center: DVec3,
    pub radius: f64,
    /// Half extents where the dataset names a box; its largest is `radius` then.
    pub half: Option<DVec3>,
    /// The keys it was read from.
    pub how: String,
}

/// How a dataset is opened.
#[derive(Clone, Debug, PartialEq)]
pub struct SceneOptions {
    /// Pictures are reduced by this factor, at least 1.
    pub downscale: f64,
    /// Every n-th view is held out where the dataset has no split of its own; 0 holds out none.
    pub holdout: u32,
    /// Whether masks and alpha channels are used.
    pub masks: bool,
}

impl Default for SceneOptions {
    fn default() -> Self {
        SceneOptions {
            downscale: 1.0,
            holdout: 8,
            masks: true,
        }
    }
}

/// A view as a reader found it: its picture not yet looked at.
struct Frame {
    name: String,
    /// The picture, or where it was looked for.
    image: std::result::Result<PathBuf, String>,
    /// The mask that the dataset names, or where it was looked for.
    mask: Option<std::result::Result<PathBuf, String>>,
    priors: PriorPaths,
    lens: FrameLens,
    world_from_camera: DMat4,
    split: Option<Split>,
}

/// A lens as a reader found it.
enum FrameLens {
    /// Complete.
    Stated(Camera),
    /// A pinhole's focal lengths and centre, in pixels of the picture as it is: the dataset states no size.
    Pinhole([f64; 4]),
    /// Keys of a transforms.json; some may have to come from the picture's size.
    Keys(transforms::Intrinsics),
}

/// What a reader makes of a dataset.
struct Reading {
    root: PathBuf,
    /// The file that errors about frames should name.
    file: PathBuf,
    format: Format,
    frames: Vec<Frame>,
    points: Vec<Point>,
    region_hint: Option<RegionHint>,
    skipped: Vec<Skipped>,
    notes: Vec<String>,
    /// What was done to COLMAP's world to make this one, or what may have been.
    world_from_colmap: Vec<DMat4>,
    truth_from_world: Option<DMat4>,
}

impl Scene {
    /// Opens the dataset at `path`: a directory, the file that its layout is known by, or a COLMAP model's own directory.
    ///
    /// Only headers of pictures are read. Errors are [`Error::Input`] with the file, the numbers and what to do, and
    /// [`Error::Config`] for options that make no sense.
    pub fn open(path: &Path, options: &SceneOptions) -> Result<Scene> {
        if !(options.downscale >= 1.0 && options.downscale.is_finite()) {
            return Err(Error::Config {
                what: format!(
                    "images can be reduced by a factor of 1 or more, not {}",
                    options.downscale
                ),
            });
        }
        if options.holdout == 1 {
            return Err(Error::Config {
                what:
                    "holding out every view leaves none to train on; 8 is usual, 0 holds out none"
                        .into(),
            });
        }
        let mut reading = read(path)?;
        let frames = present(&mut reading)?;
        let headers: Vec<_> = frames
            .par_iter()
            .map(|(_, image)| images::header(image))
            .collect::<Result<_>>()?;

        let mut scene = Scene {
            root: reading.root.clone(),
            format: reading.format,
            views: Vec::with_capacity(frames.len()),
            points: std::mem::take(&mut reading.points),
            region_hint: reading.region_hint.take(),
            truth_from_world: reading.truth_from_world,
            skipped: std::mem::take(&mut reading.skipped),
            notes: std::mem::take(&mut reading.notes),
            masks: options.masks,
        };
        let given_split = frames
            .iter()
            .any(|(frame, _)| frame.split == Some(Split::Test));
        let mut resized: Vec<String> = Vec::new();
        let mut unused_masks = 0;
        for ((frame, image_path), header) in frames.into_iter().zip(headers) {
            let camera = frame_camera(&reading.file, &frame, &image_path, &header, &mut resized)?;
            let reduced = |side: u32| ((f64::from(side) / options.downscale).round() as u32).max(1);
            let camera = if options.downscale == 1.0 {
                camera
            } else {
                camera.scaled(reduced(camera.width), reduced(camera.height))
            };
            let mask_path = match frame.mask {
                named if !options.masks => {
                    let there = match named {
                        Some(named) => named.is_ok(),
                        None => images::find_mask(&scene.root, &image_path).is_some(),
                    };
                    unused_masks += u32::from(there);
                    None
                }
                Some(Ok(path)) => Some(path),
                Some(Err(why)) => {
                    return Err(Error::input(
                        &reading.file,
                        format!("the mask of {}: {why}", frame.name),
                        "put the mask there, take its mention out of the file, or do without masks (--no-masks)",
                    ));
                }
                None => images::find_mask(&scene.root, &image_path),
            };
            scene.views.push(View {
                name: frame.name,
                image_path,
                mask_path,
                priors: frame.priors,
                camera,
                world_from_camera: frame.world_from_camera,
                split: frame.split.unwrap_or(Split::Train),
            });
        }
        if unused_masks > 0 {
            scene.skipped.push(Skipped {
                what: "masks".into(),
                why: format!(
                    "of {unused_masks} of {} views, not asked for: --set scene.masks=exclude or foreground uses them",
                    scene.views.len()
                ),
            });
        }
        if let Some(first) = resized.first() {
            let more = if resized.len() > 1 {
                format!(", and {} more like it", resized.len() - 1)
            } else {
                String::new()
            };
            scene
                .notes
                .push(format!("{first}: the intrinsics were scaled{more}"));
        }
        scene.views.par_iter().try_for_each(|view| {
            images::check_mask(view, |header| header.stored_or_turned_for(&view.camera))
        })?;
        if !given_split {
            hold_out(&mut scene, options.holdout);
        }
        check_enough_views(&scene, &reading.file)?;
        tracing::info!(
            format = %scene.format,
            file = %reading.file.display(),
            train = scene.split(Split::Train).count(),
            test = scene.split(Split::Test).count(),
            masks = scene.views.iter().filter(|view| view.mask_path.is_some()).count(),
            points = scene.points.len(),
            skipped = scene.skipped.len(),
            downscale = options.downscale,
            "dataset opened"
        );
        Ok(scene)
    }

    /// Reads view number `view`'s picture, reduced to its camera's size.
    pub fn load_picture(&self, view: usize) -> Result<Picture> {
        images::load(&self.views[view], self.masks)
    }

    /// Indices into `views` of one split, in order.
    pub fn split(&self, split: Split) -> impl Iterator<Item = usize> + '_ {
        (0..self.views.len()).filter(move |view| self.views[*view].split == split)
    }
}

/// What a dataset is known by.
enum Layout {
    /// transforms.json, transforms_train.json, or NeuS2's transform_train.json
    Transforms(PathBuf),
    /// meta_data.json
    Sdfstudio(PathBuf),
    /// cameras_sphere.npz or cameras.npz
    Neus(PathBuf),
    /// A model's directory.
    Colmap(PathBuf),
    /// cams
    VisMvsnet(PathBuf),
}

impl Layout {
    /// Those that are found in the directory `path`; the first is to be read.
    fn found_in(path: &Path) -> Vec<Layout> {
        let first = |names: &[&str]| {
            let mut files = names.iter().map(|name| path.join(name));
            files.find(|file| file.is_file())
        };
        [
            first(&[
                "transforms.json",
                "transforms_train.json",
                transforms::NEUS2,
            ])
            .map(Layout::Transforms),
            first(&["meta_data.json"]).map(Layout::Sdfstudio),
            first(&["cameras_sphere.npz", "cameras.npz"]).map(Layout::Neus),
            colmap::find_model(path).map(Layout::Colmap),
            mvsnet::find_cameras(path).map(Layout::VisMvsnet),
        ]
        .into_iter()
        .flatten()
        .collect()
    }

    /// The layout that is known by this file.
    fn of_file(file: &Path) -> Option<Layout> {
        let name = json::file_name(file);
        match file.extension()?.to_str()? {
            "json" if name.starts_with("meta_data") => Some(Layout::Sdfstudio(file.into())),
            "json" => Some(Layout::Transforms(file.into())),
            "npz" => Some(Layout::Neus(file.into())),
            _ => None,
        }
    }

    /// Where it is.
    fn place(&self) -> &Path {
        match self {
            Layout::Transforms(place)
            | Layout::Sdfstudio(place)
            | Layout::Neus(place)
            | Layout::Colmap(place)
            | Layout::VisMvsnet(place) => place,
        }
    }

    /// Reads it, for the dataset at `path`.
    fn read(&self, path: &Path) -> Result<Reading> {
        match self {
            Layout::Transforms(file) => transforms::read(file),
            Layout::Sdfstudio(file) => sdfstudio::read(file),
            Layout::Neus(file) => neus::read(file),
            Layout::Colmap(model) => colmap::read(path, model),
            Layout::VisMvsnet(cameras) => mvsnet::read(path, cameras),
        }
    }
}

/// Recognises the layout and reads it. Of several, the others are said to be left out; a COLMAP model may still give its points.
fn read(path: &Path) -> Result<Reading> {
    if path.is_file() {
        let layout = Layout::of_file(path).ok_or_else(|| {
            Error::input(
                path,
                "is a file, but neither a directory nor a transforms.json, meta_data.json or cameras_sphere.npz",
                "give the dataset's directory",
            )
        })?;
        return layout.read(path);
    }
    if !path.is_dir() {
        return Err(Error::input(
            path,
            "does not exist",
            "check the path of the dataset",
        ));
    }
    let layouts = Layout::found_in(path);
    let (layout, others) = layouts.split_first().ok_or_else(|| unrecognised(path))?;
    let mut reading = layout.read(path)?;
    for other in others {
        if let Layout::Colmap(model) = other {
            colmap::adopt_points(&mut reading, model);
        } else {
            reading.skipped.push(Skipped {
                what: other.place().display().to_string(),
                why: format!(
                    "{} is used; move that away to use this",
                    json::file_name(&reading.file)
                ),
            });
        }
    }
    Ok(reading)
}

/// The error for a directory that holds no dataset that can be read: names what is there.
fn unrecognised(path: &Path) -> Error {
    let mut names: Vec<String> = std::fs::read_dir(path)
        .map(|entries| {
            entries
                .flatten()
                .map(|entry| entry.file_name().to_string_lossy().into_owned())
                .collect()
        })
        .unwrap_or_default();
    names.sort();
    let mut there = names.iter().take(8).cloned().collect::<Vec<_>>().join(", ");
    if names.len() > 8 {
        there += &format!(" and {} more", names.len() - 8);
    }
    Error::input(
        path,
        format!(
            "no dataset here: neither transforms.json, transforms_train.json, transform_train.json, meta_data.json, cameras_sphere.npz, \
             cams/*_cam.txt, nor a COLMAP model (cameras, images and points3D as .bin or .txt) in sparse/0, sparse, colmap/sparse/0 or the \
             directory itself; it holds {}",
            if names.is_empty() {
                "nothing".into()
            } else {
                there
            }
        ),
        "give the directory that holds one of them",
    )
}

/// Frames whose pictures exist; the others are noted as skipped, and an error if they are most.
fn present(reading: &mut Reading) -> Result<Vec<(Frame, PathBuf)>> {
    let total = reading.frames.len();
    if total == 0 {
        return Err(Error::input(
            &reading.file,
            "names no picture: there are 0 cameras to reconstruct from",
            "export the poses again, or give the directory of a model that has some",
        ));
    }
    let mut present = Vec::with_capacity(total);
    let mut missing: Vec<(String, String)> = Vec::new();
    let mut seen = HashSet::new();
    for frame in reading.frames.drain(..) {
        match &frame.image {
            Ok(path) if !seen.insert(path.clone()) => reading.skipped.push(Skipped {
                what: frame.name,
                why: "the same picture is listed twice; its first pose is used".into(),
            }),
            Ok(path) => {
                let path = path.clone();
                present.push((frame, path));
            }
            Err(why) => missing.push((frame.name, why.clone())),
        }
    }
    if missing.len() * 2 > total {
        let (name, why) = &missing[0];
        return Err(Error::input(
            &reading.file,
            format!(
                "{} of the {total} pictures it names are missing; the first is {name}: {why}",
                missing.len()
            ),
            "put the pictures where the dataset says they are, or correct its paths",
        ));
    }
    reading
        .skipped
        .extend(missing.into_iter().map(|(what, why)| Skipped { what, why }));
    Ok(present)
}

/// The camera for the picture as it is stored, scaled where its stated size is another.
fn frame_camera(
    file: &Path,
    frame: &Frame,
    image: &Path,
    header: &images::Header,
    resized: &mut Vec<String>,
) -> Result<Camera> {
    let stored = (header.width, header.height);
    let wrong_lens = |what: String| {
        let next = "correct the intrinsics and try again";
        Error::input(file, format!("{}: {what}", frame.name), next)
    };
    let camera = match &frame.lens {
        FrameLens::Stated(camera) => camera.clone(),
        FrameLens::Pinhole(lengths) => {
            let params = lengths.to_vec();
            Camera::new(CameraModel::Pinhole, stored.0, stored.1, params).map_err(wrong_lens)?
        }
        FrameLens::Keys(keys) => keys.camera(stored).map_err(wrong_lens)?,
    };
    let Some((width, height)) = header.stored_or_turned_for(&camera) else {
        return Err(Error::input(
            image,
            format!(
                "the picture has {}x{} pixels, but its camera says {}x{}, which is no scaled version of that",
                stored.0, stored.1, camera.width, camera.height
            ),
            format!(
                "use the pictures that the poses in {} were computed from",
                file.display()
            ),
        ));
    };
    if (width, height) == (camera.width, camera.height) {
        return Ok(camera);
    }
    resized.push(format!(
        "{} has {width}x{height} pixels where its camera says {}x{}",
        frame.name, camera.width, camera.height
    ));
    Ok(camera.scaled(width, height))
}

/// Marks every n-th view as held out, if enough are left to train on.
fn hold_out(scene: &mut Scene, every: u32) {
    if every == 0 {
        return;
    }
    if scene.views.len() < 2 * every as usize {
        scene.notes.push(format!(
            "with {} views none are held out (one in {every} was asked for)",
            scene.views.len()
        ));
        return;
    }
    for view in scene.views.iter_mut().step_by(every as usize) {
        view.split = Split::Test;
    }
}

/// Refuses what no surface can be found from.
fn check_enough_views(scene: &Scene, file: &Path) -> Result<()> {
    let train = scene.split(Split::Train).count();
    if train >= 2 {
        return Ok(());
    }
    let (what, skipped) = (
        format!("{train} training view(s) of {}", scene.views.len()),
        scene.skipped.len(),
    );
    Err(Error::input(
        file,
        format!("{what}, {skipped} skipped: a surface takes at least 2, and tens for a good one"),
        "add posed pictures, or put back those that were skipped (see `neurodin inspect`)",
    ))
}

/// `matrix` as an exactly rigid transform, or why it is none: entries that are not finite, a mirror image, or axes that are skew.
///
/// A uniform scale is taken out of the rotation; the position stays.
fn rigid(matrix: DMat4) -> std::result::Result<DMat4, String> {
    if let Some(bad) = matrix
        .to_cols_array()
        .into_iter()
        .find(|entry| !entry.is_finite())
    {
        return Err(format!(
            "the pose holds {bad}, which is not a number that a pose can have"
        ));
    }
    let (axes, position) = (DMat3::from_mat4(matrix), matrix.w_axis.truncate());
    let scale = axes.determinant().abs().cbrt();
    if !(scale.is_finite() && scale > 1e-12) {
        return Err("the pose has no rotation: its 3x3 part is singular".into());
    }
    if axes.determinant() < 0.0 {
        return Err("the pose is a mirror image: its 3x3 part has a negative determinant".into());
    }
    // The nearest rotation: R ← (R + R⁻ᵀ)/2 converges quadratically to the orthogonal factor of the polar decomposition.
    let mut rotation = axes * scale.recip();
    let skew = off_orthonormal(rotation);
    if skew > 0.05 {
        return Err(format!(
            "the pose is not rigid: its axes are off from orthonormal by {skew:.3}"
        ));
    }
    for _ in 0..6 {
        rotation = (rotation + rotation.inverse().transpose()) * 0.5;
    }
    Ok(DMat4::from_cols(
        rotation.x_axis.extend(0.0),
        rotation.y_axis.extend(0.0),
        rotation.z_axis.extend(0.0),
        position.extend(1.0),
    ))
}

/// How far axes are from orthonormal: the largest entry of RᵀR − 1.
pub(crate) fn off_orthonormal(axes: DMat3) -> f64 {
    (axes.transpose() * axes - DMat3::IDENTITY)
        .to_cols_array()
        .into_iter()
        .fold(0.0, |largest: f64, entry| largest.max(entry.abs()))
}

/// From COLMAP's and OpenCV's camera axes (y down, looking along +z) to OpenGL's, on the camera's side.
fn opengl_from_opencv(world_from_camera: DMat4) -> DMat4 {
    world_from_camera * DMat4::from_diagonal(DVec4::new(1.0, -1.0, -1.0, 1.0))
}
