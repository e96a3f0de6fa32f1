//! COLMAP sparse models, binary and text: cameras, images, points3D (COLMAP, `doc/format.rst`).
//!
//! A pose is a unit quaternion (w, x, y, z) and a translation from world to camera, with y down and z forward. Binary files are
//! little-endian with a 64-bit count in front; counts are never believed, only what the file holds. COLMAP 4 writes rigs and frames
//! beside them; the poses are still in images, so those are not read.

mod binary;
mod text;

use std::collections::HashMap;
use std::path::{Path, PathBuf};

use glam::{DMat4, DQuat, DVec3};

use super::json::file_name;
use super::{Camera, CameraModel, Format, Frame, FrameLens, Point, PriorPaths, Reading, Skipped};
use crate::{Error, Result};

/// Where a model may lie below a dataset's directory.
const PLACES: [&str; 8] = [
    "sparse/0",
    "sparse",
    "0",
    "colmap/sparse/0",
    "colmap/sparse",
    "colmap/0",
    "colmap",
    "",
];

/// Where pictures may lie below a dataset's directory.
const IMAGE_FOLDERS: [&str; 7] = [
    "images",
    "image",
    "rgb",
    "input",
    "imgs",
    "resized_images", // ScanNet++
    "",
];

/// The directory of the COLMAP model that belongs to the dataset at `path`, if there is one.
pub(super) fn find_model(path: &Path) -> Option<PathBuf> {
    PLACES
        .into_iter()
        .map(|place| {
            if place.is_empty() {
                path.to_path_buf()
            } else {
                path.join(place)
            }
        })
        .find(|folder| part(folder, "cameras").is_some() || part(folder, "images").is_some())
}

/// One of a model's files: binary before text, as COLMAP has it.
fn part(model: &Path, name: &str) -> Option<PathBuf> {
    [".bin", ".txt"]
        .into_iter()
        .map(|ending| model.join(format!("{name}{ending}")))
        .find(|file| file.is_file())
}

/// Reads `model` for the dataset at `path`.
pub(super) fn read(path: &Path, model: &Path) -> Result<Reading> {
    let require = |name: &str| {
        part(model, name).ok_or_else(|| {
            Error::input(
                model,
                format!("the COLMAP model lacks {name}.bin (or {name}.txt)"),
                "copy all of cameras, images and points3D",
            )
        })
    };
    let (cameras_file, images_file) = (require("cameras")?, require("images")?);
    let cameras = read_cameras(&cameras_file)?;
    let (mut skipped, mut notes) = (Vec::new(), Vec::new());
    let mut images = read_images(&images_file, &mut notes)?;
    images.sort_by(|a, b| a.name.cmp(&b.name));
    let points = match part(model, "points3D") {
        Some(file) => read_points(&file, &mut notes)?,
        None => {
            skipped.push(Skipped {
                what: "points3D".into(),
                why: "not there: the region is guessed from the cameras alone".into(),
            });
            Vec::new()
        }
    };
    // Of a model that is given as `.`, the path does not hold the directories around it.
    let resolved = model.canonicalize().unwrap_or_else(|_| model.into());
    note_other_models(&resolved, &mut skipped);

    let folder = image_folder(path, [model, &resolved], &images);
    let mut frames = Vec::with_capacity(images.len());
    for image in images {
        let camera = cameras.get(&image.camera_id).ok_or_else(|| {
            Error::input(
                &images_file,
                format!(
                    "image {} refers to camera {}, which {} does not hold",
                    image.name,
                    image.camera_id,
                    cameras_file.display()
                ),
                "export cameras and images together",
            )
        })?;
        let file = folder.join(&image.name);
        frames.push(Frame {
            image: if file.is_file() {
                Ok(file)
            } else {
                Err(format!("no such file: {}", file.display()))
            },
            mask: None,
            lens: FrameLens::Stated(camera.clone()),
            world_from_camera: image.world_from_camera,
            split: None,
            priors: PriorPaths::default(),
            name: image.name,
        });
    }
    Ok(Reading {
        root: folder_root(path, &folder),
        file: images_file,
        format: Format::Colmap,
        frames,
        points,
        region_hint: None,
        skipped,
        notes,
        world_from_colmap: vec![DMat4::IDENTITY],
        truth_from_world: None,
    })
}

/// The directory that masks are looked for in: the dataset's, or the one above the pictures if that lies elsewhere.
fn folder_root(path: &Path, images: &Path) -> PathBuf {
    if images.starts_with(path) {
        path.to_path_buf()
    } else {
        images.parent().unwrap_or(images).to_path_buf()
    }
}

/// The folder that holds most of the pictures: below the dataset, or below one of the directories around the model, by either of its paths.
fn image_folder(path: &Path, models: [&Path; 2], images: &[ImageRecord]) -> PathBuf {
    let around = models
        .into_iter()
        .flat_map(|model| model.ancestors().skip(1).take(3));
    let roots = std::iter::once(path).chain(around);
    let candidates = roots.flat_map(|root| {
        IMAGE_FOLDERS
            .into_iter()
            .map(move |folder| root.join(folder))
    });
    // A sample is enough to tell the folders apart.
    let sample: Vec<_> = images.iter().step_by((images.len() / 32).max(1)).collect();
    let mut best = (0, path.join("images"));
    for folder in candidates.filter(|folder| folder.is_dir()) {
        let there = sample
            .iter()
            .filter(|image| folder.join(&image.name).is_file())
            .count();
        if there > best.0 {
            best = (there, folder);
        }
    }
    best.1
}

/// COLMAP numbers the models that it could not join; only one of them is read.
fn note_other_models(model: &Path, skipped: &mut Vec<Skipped>) {
    if model.file_name().is_none_or(|name| name != "0") {
        return;
    }
    for number in 1.. {
        let other = model.with_file_name(number.to_string());
        if part(&other, "images").is_none() {
            break;
        }
        skipped.push(Skipped {
            what: other.display().to_string(),
            why: "another model of the same pictures, not joined to the first; give its own path to use it".into(),
        });
    }
}

/// Gives a dataset of another layout the points of the COLMAP model beside it, if both have their cameras in the same places.
pub(super) fn adopt_points(reading: &mut Reading, model: &Path) {
    let used = file_name(&reading.file);
    let mut skip = |why: String| {
        reading.skipped.push(Skipped {
            what: model.display().to_string(),
            why,
        });
    };
    let other = match part(model, "images").map(|file| read_images(&file, &mut reading.notes)) {
        Some(Ok(images)) => images,
        Some(Err(error)) => {
            return skip(format!(
                "{used} is used, and this COLMAP model is not readable: {error}"
            ));
        }
        None => return skip(format!("{used} is used; this COLMAP model has no images")),
    };
    if !reading.points.is_empty() {
        return skip(format!(
            "{used} is used, with its own points; give this path to use the COLMAP model"
        ));
    }
    let base = |name: &str| name.rsplit('/').next().unwrap_or(name).to_owned();
    let positions: HashMap<String, DVec3> = other
        .iter()
        .map(|image| {
            let position = image.world_from_camera.w_axis.truncate();
            (base(&image.name), position)
        })
        .collect();
    let pairs: Vec<(DVec3, DVec3)> = reading
        .frames
        .iter()
        .filter_map(|frame| {
            Some((
                frame.world_from_camera.w_axis.truncate(),
                *positions.get(&base(&frame.name))?,
            ))
        })
        .collect();
    let mean = pairs.iter().map(|(here, _)| *here).sum::<DVec3>() / pairs.len().max(1) as f64;
    let spread = pairs
        .iter()
        .map(|(here, _)| (*here - mean).length())
        .sum::<f64>()
        / pairs.len().max(1) as f64;
    let agreeing = |world: &DMat4| {
        let off = |here: DVec3, there: DVec3| (here - world.transform_point3(there)).length();
        let near = pairs
            .iter()
            .filter(|(here, there)| off(*here, *there) <= 1e-3 * spread);
        (near.count(), *world)
    };
    let (agree, world) = reading
        .world_from_colmap
        .iter()
        .map(agreeing)
        .max_by_key(|(agree, _)| *agree)
        .expect("at least one");
    if pairs.len() < 3 || agree * 10 < pairs.len() * 9 {
        return skip(format!(
            "{used} is used; this COLMAP model has {agree} of {} cameras in the same places, so its points are of another frame",
            reading.frames.len()
        ));
    }
    let Some(file) = part(model, "points3D") else {
        return skip(format!("{used} is used; this COLMAP model has no points"));
    };
    match read_points(&file, &mut reading.notes) {
        Ok(mut points) => {
            for point in &mut points {
                point.position = world.transform_point3(point.position);
            }
            let agreeing = format!("{agree} of {} cameras agree", pairs.len());
            reading.notes.push(format!(
                "{} points are from {}: {agreeing}",
                points.len(),
                file.display()
            ));
            reading.points = points;
        }
        Err(error) => skip(format!("its points are not readable: {error}")),
    }
}

/// An image's pose and name.
struct ImageRecord {
    name: String,
    camera_id: u32,
    world_from_camera: DMat4,
}

impl ImageRecord {
    /// From COLMAP's world-to-camera quaternion (w, x, y, z) and translation.
    fn new(file: &Path, name: String, camera_id: u32, q: [f64; 4], t: [f64; 3]) -> Result<Self> {
        let bad_pose = |what: String| {
            Error::input(
                file,
                format!("{name}: {what}"),
                format!(
                    "take {name} out of the model (colmap image_deleter), or export the poses again"
                ),
            )
        };
        if let Some(bad) = q.iter().chain(&t).find(|value| !value.is_finite()) {
            return Err(bad_pose(format!("its pose holds {bad}")));
        }
        let quaternion = DQuat::from_xyzw(q[1], q[2], q[3], q[0]);
        if quaternion.length() <= 1e-6 {
            return Err(bad_pose(format!(
                "its rotation {q:?} is a quaternion of length 0"
            )));
        }
        let camera_from_world =
            DMat4::from_rotation_translation(quaternion.normalize(), DVec3::from(t));
        let world_from_camera = super::rigid(camera_from_world.inverse()).map_err(bad_pose)?;
        Ok(ImageRecord {
            world_from_camera: super::opengl_from_opencv(world_from_camera),
            name: name.replace('\\', "/"),
            camera_id,
        })
    }
}

fn is_binary(file: &Path) -> bool {
    file.extension().is_some_and(|extension| extension == "bin")
}

fn read_cameras(file: &Path) -> Result<HashMap<u32, Camera>> {
    if is_binary(file) {
        binary::cameras(file)
    } else {
        text::cameras(file)
    }
}

fn read_images(file: &Path, notes: &mut Vec<String>) -> Result<Vec<ImageRecord>> {
    if is_binary(file) {
        binary::images(file)
    } else {
        text::images(file, notes)
    }
}

/// Points with finite positions; how many have not is noted.
fn read_points(file: &Path, notes: &mut Vec<String>) -> Result<Vec<Point>> {
    let mut points = if is_binary(file) {
        binary::points(file)?
    } else {
        text::points(file, notes)?
    };
    let all = points.len();
    points.retain(|point| point.position.is_finite());
    if points.len() < all {
        notes.push(format!(
            "{} of {all} points in {} are not finite and left out",
            all - points.len(),
            file.display()
        ));
    }
    Ok(points)
}

fn camera_from(
    file: &Path,
    id: u32,
    model: CameraModel,
    size: (u64, u64),
    params: Vec<f64>,
) -> Result<Camera> {
    let side = |pixels: u64| u32::try_from(pixels).unwrap_or(u32::MAX);
    Camera::new(model, side(size.0), side(size.1), params).map_err(|what| {
        Error::input(
            file,
            format!("camera {id}: {what}"),
            "correct or recompute the camera",
        )
    })
}

fn unsupported(file: &Path, id: u32, name: &str) -> Error {
    Error::input(
        file,
        format!(
            "camera {id} has the model {name}, which is not supported; models 0 (SIMPLE_PINHOLE) to 10 (THIN_PRISM_FISHEYE) are"
        ),
        "undistort the pictures with `colmap image_undistorter`, or use one of those models",
    )
}
