//! Vis-MVSNet's cams/*_cam.txt, the layout of the Tanks and Temples advanced set (and of MVSNet's and BlendedMVS's own folders).
//!
//! A file holds the word `extrinsic`, a world-to-camera matrix with OpenCV's axes, the word `intrinsic`, a 3x3 matrix in pixels as
//! COLMAP counts them, and a range of depths. Its leading number is that of its picture. The world is that of the matrices; no region
//! is stated.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use glam::DMat4;

use super::{Format, Frame, FrameLens, PriorPaths, Reading, Skipped};
use crate::{Error, Result};

const IMAGE_FOLDERS: [&str; 3] = ["images", "image", "blended_images"];
const ENDING: &str = "_cam.txt";

/// The folder of cameras of the dataset at `path`, if there is one.
pub(super) fn find_cameras(path: &Path) -> Option<PathBuf> {
    let folder = path.join("cams");
    let mut entries = std::fs::read_dir(&folder).ok()?.flatten();
    entries
        .any(|entry| entry.file_name().to_string_lossy().ends_with(ENDING))
        .then_some(folder)
}

/// Reads the folder `cameras` of the dataset at `path`.
pub(super) fn read(path: &Path, cameras: &Path) -> Result<Reading> {
    let cams = numbered(cameras, |name| name.ends_with(ENDING))?;
    let folder = IMAGE_FOLDERS
        .into_iter()
        .map(|name| path.join(name))
        .find(|folder| folder.is_dir())
        .unwrap_or_else(|| path.join(IMAGE_FOLDERS[0]));
    let mut images = if folder.is_dir() {
        numbered(&folder, |name| !name.ends_with(".txt"))?
    } else {
        BTreeMap::new()
    };
    let mut frames = Vec::with_capacity(cams.len());
    for (number, cam) in cams {
        let (world_from_camera, lengths) = read_camera(&cam)?;
        let image = images.remove(&number);
        frames.push(Frame {
            name: match &image {
                Some(image) => super::json::file_name(image),
                None => super::json::file_name(&cam),
            },
            image: image.ok_or_else(|| {
                format!(
                    "no picture with the number {number} in {}",
                    folder.display()
                )
            }),
            mask: None,
            lens: FrameLens::Pinhole(lengths),
            world_from_camera,
            split: None,
            priors: PriorPaths::default(),
        });
    }
    let without_camera = images.values().map(|image| Skipped {
        what: image.display().to_string(),
        why: format!("no camera with its number in {}", cameras.display()),
    });
    Ok(Reading {
        root: path.to_path_buf(),
        file: cameras.to_path_buf(),
        format: Format::VisMvsnet,
        frames,
        points: Vec::new(),
        region_hint: None,
        skipped: without_camera.collect(),
        notes: Vec::new(),
        world_from_colmap: vec![DMat4::IDENTITY],
        truth_from_world: None,
    })
}

/// Files by the number that their names begin with. Of several with one number (a picture and its masked copy) the shortest name counts.
fn numbered(folder: &Path, wanted: impl Fn(&str) -> bool) -> Result<BTreeMap<u64, PathBuf>> {
    let entries = std::fs::read_dir(folder).map_err(|error| Error::unreadable(folder, &error))?;
    let mut names: Vec<String> = entries
        .flatten()
        .map(|entry| entry.file_name().to_string_lossy().into_owned())
        .filter(|name| wanted(name))
        .collect();
    names.sort_by_key(|name| (name.len(), name.clone()));
    let mut files = BTreeMap::new();
    for name in names {
        let digits = name.bytes().take_while(u8::is_ascii_digit).count();
        if let Ok(number) = name[..digits].parse() {
            files.entry(number).or_insert_with(|| folder.join(&name));
        }
    }
    Ok(files)
}

/// Pose (with OpenGL's camera axes), focal lengths and centre of one file.
fn read_camera(file: &Path) -> Result<(DMat4, [f64; 4])> {
    let wrong = |what: String| {
        let next = "take this camera and its picture out, or export it again";
        Error::input(file, what, next)
    };
    let data = std::fs::read(file).map_err(|error| Error::unreadable(file, &error))?;
    let text = String::from_utf8_lossy(&data);
    let words: Vec<&str> = text.split_whitespace().collect();
    let matrix = |key: &str, count: usize| -> Result<Vec<f64>> {
        let start = words.iter().position(|word| *word == key);
        let start = start.ok_or_else(|| wrong(format!("has no word {key}")))? + 1;
        let numbers: Vec<f64> = words[start..]
            .iter()
            .take(count)
            .map_while(|word| word.parse().ok())
            .collect();
        if numbers.len() < count {
            let (there, next) = (numbers.len(), words.get(start + numbers.len()));
            let next = next.map_or("the file ends".into(), |word| format!("{word:?} follows"));
            return Err(wrong(format!(
                "{key} takes {count} numbers, but after {there} of them {next}"
            )));
        }
        Ok(numbers)
    };
    let extrinsic: [f64; 16] = matrix("extrinsic", 16)?.try_into().expect("16 numbers");
    let intrinsic = matrix("intrinsic", 9)?;
    if let Some(bad) = extrinsic
        .iter()
        .chain(&intrinsic)
        .find(|number| !number.is_finite())
    {
        return Err(wrong(format!("holds {bad}, which no camera has")));
    }
    let camera_from_world = DMat4::from_cols_array(&extrinsic).transpose();
    let world_from_camera = super::rigid(camera_from_world.inverse())
        .map_err(|what| wrong(format!("extrinsic: {what}")))?;
    let lengths = [0, 4, 2, 5].map(|at| intrinsic[at]);
    Ok((super::opengl_from_opencv(world_from_camera), lengths))
}
