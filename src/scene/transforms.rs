//! transforms.json and its dialects: nerfstudio, instant-ngp, Neuralangelo, and Blender's split files.
//!
//! All of them hold camera-to-world matrices with OpenGL's camera axes (with OpenCV's where NeuS2 writes from_na), and intrinsics that
//! may stand once or per frame, in pixels or as angles, with or without the picture's size. Neuralangelo adds sphere_center,
//! sphere_radius and aabb_range; instant-ngp adds aabb_scale, scale and offset, which say that the region is the cube of aabb_scale
//! about 0.5 of `scale · x + offset`.

mod intrinsics;
mod splits;

use std::path::{Path, PathBuf};

use glam::{DMat4, DVec3, DVec4};
use serde_json::Value;

use super::json::{Document, ENDINGS, Object, brief, file_name, find};
use super::{Format, Frame, FrameLens, PriorPaths, Reading, RegionHint, Skipped};
use super::{opengl_from_opencv, points};
use crate::Result;

pub(super) use intrinsics::Intrinsics;

/// instant-ngp's defaults for `scale` and `offset`.
const NGP_SCALE: f64 = 0.33;
const NGP_OFFSET: f64 = 0.5;

/// What nerfstudio did to COLMAP's world before it came to write applied_transform: x, y, z to y, x, -z.
const UNSTATED_TRANSFORM: DMat4 = DMat4::from_cols(DVec4::Y, DVec4::X, DVec4::NEG_Z, DVec4::W);

/// NeuS2's training views.
pub(super) const NEUS2: &str = "transform_train.json";

/// Reads `file` and the held-out views of the file beside it that is for them.
pub(super) fn read(file: &Path) -> Result<Reading> {
    let root = file.parent().unwrap_or(Path::new("")).to_path_buf();
    let blender = file_name(file) == "transforms_train.json";
    let document = Document::open(file)?;
    let mut skipped = Vec::new();
    let mut reading = Reading {
        format: document.format(blender),
        frames: document.frames("frames", &root, &mut skipped)?,
        points: Vec::new(),
        region_hint: None,
        skipped,
        notes: Vec::new(),
        world_from_colmap: document.applied_transforms()?,
        truth_from_world: None,
        file: file.to_path_buf(),
        root,
    };
    splits::read_held_out(&mut reading)?;
    document.hold_out_test_frames(&mut reading)?;
    document.split_by_lists(&mut reading)?;
    if let Some(path) = document.text("ply_file_path")? {
        let path = reading.root.join(path.replace('\\', "/"));
        if path.is_file() {
            reading.points = points::read_ply(&path)?;
        } else {
            reading.skipped.push(Skipped {
                what: path.display().to_string(),
                why: "ply_file_path names it, but there is no such file".into(),
            });
        }
    }
    reading.region_hint = document.region_hint(reading.points.is_empty())?;
    document.note_unused(&mut reading.skipped);
    let skew = document.number(&document.top, "sk_x", "")?.unwrap_or(0.0);
    if skew.abs() > 1e-3 {
        reading.notes.push(format!(
            "sk_x = {skew} is not used: no camera model has skew"
        ));
    }
    Ok(reading)
}

/// ScanNet++: where pictures and masks are, beside the folder `nerfstudio` of the files of poses.
fn scannetpp_folders(file: &Path) -> Option<(PathBuf, PathBuf)> {
    let (pictures, masks) = match file_name(file).as_str() {
        "transforms.json" => ("resized_images", "resized_anon_masks"),
        "transforms_undistorted.json" => {
            ("resized_undistorted_images", "resized_undistorted_masks")
        }
        _ => return None,
    };
    let file = file.canonicalize().ok()?;
    let folder = file.parent()?;
    (file_name(folder) == "nerfstudio").then(|| {
        (
            folder.with_file_name(pictures),
            folder.with_file_name(masks),
        )
    })
}

impl Document<'_> {
    fn format(&self, blender: bool) -> Format {
        let has = |key: &str| self.top.contains_key(key);
        if has("sphere_center") {
            Format::Neuralangelo
        } else if blender {
            Format::Blender
        } else if ["aabb_scale", "scale", "offset", "from_na"]
            .into_iter()
            .any(has)
        {
            Format::InstantNgp
        } else {
            Format::Nerfstudio
        }
    }

    /// The frames that are listed under `key`, in the file's order, without those that are said to be bad.
    fn frames(&self, key: &str, root: &Path, skipped: &mut Vec<Skipped>) -> Result<Vec<Frame>> {
        let Some(entries) = self.top.get(key).and_then(Value::as_array) else {
            return Err(self.error(format!("has no list of {key}")));
        };
        let frame = key.trim_end_matches('s');
        let (pictures, masks) = scannetpp_folders(self.file).unzip();
        let find = |path: &str, beside: &Option<PathBuf>, endings: &[&str]| {
            find(root, path, endings).or_else(|why| match beside {
                Some(folder) => find(folder, path, endings).map_err(|_| why),
                None => Err(why),
            })
        };
        let opencv = self.top.get("from_na").and_then(Value::as_bool) == Some(true);
        let mut frames = Vec::with_capacity(entries.len());
        for (index, entry) in entries.iter().enumerate() {
            let Some(entry) = entry.as_object() else {
                return Err(self.error(format!(
                    "{frame} {index} is {}, not an object",
                    brief(entry)
                )));
            };
            let Some(path) = entry.get("file_path").and_then(Value::as_str) else {
                return Err(self.error(format!("{frame} {index} has no file_path")));
            };
            let name = path.replace('\\', "/");
            let name = name.trim_start_matches("./").to_owned();
            // ScanNet++: blurred, or with a pose that did not come out well.
            if entry.get("is_bad").and_then(Value::as_bool) == Some(true) {
                skipped.push(Skipped {
                    what: name,
                    why: format!("is_bad says that it is, in {}", file_name(self.file)),
                });
                continue;
            }
            let place = format!("{frame} {index} ({name}): ");
            let matrix = entry
                .get("transform_matrix")
                .ok_or_else(|| self.error(format!("{place}has no transform_matrix")))?;
            let pose = self.pose(matrix, "transform_matrix", &place)?;
            let mask = entry
                .get("mask_path")
                .and_then(Value::as_str)
                .map(|mask| find(mask, &masks, &[]));
            frames.push(Frame {
                image: find(path, &pictures, &ENDINGS),
                mask,
                lens: FrameLens::Keys(self.intrinsics(entry, &place)?),
                world_from_camera: match opencv {
                    true => opengl_from_opencv(pose),
                    false => pose,
                },
                split: None,
                priors: PriorPaths::default(),
                name,
            });
        }
        Ok(frames)
    }

    /// nerfstudio: what was done to COLMAP's world on the way into this file; what may have been, where it does not say.
    fn applied_transforms(&self) -> Result<Vec<DMat4>> {
        let scale = self.number(&self.top, "applied_scale", "")?.unwrap_or(1.0);
        let transforms = match self
            .top
            .get("applied_transform")
            .filter(|value| !value.is_null())
        {
            Some(value) => vec![
                self.matrix(value)
                    .map_err(|what| self.error(format!("applied_transform {what}")))?,
            ],
            None => vec![DMat4::IDENTITY, UNSTATED_TRANSFORM],
        };
        let scale = DMat4::from_scale(DVec3::splat(scale));
        Ok(transforms.into_iter().map(|t| scale * t).collect())
    }

    /// Says which keys would make a difference, but are not used.
    fn note_unused(&self, skipped: &mut Vec<Skipped>) {
        for (key, why) in [
            (
                "fisheye_crop_radius",
                "not used: pixels outside of that circle are trained on unless masks hide them",
            ),
            (
                "depth_file_path",
                "not used: depths are read from sdfstudio's meta_data.json (sensor_depth_path)",
            ),
        ] {
            let has = |object: &Object| object.get(key).is_some_and(|value| !value.is_null());
            let frames = self.top.get("frames").and_then(Value::as_array);
            let frames = frames.into_iter().flatten().filter_map(Value::as_object);
            let what = match frames.filter(|frame| has(frame)).count() {
                0 if has(&self.top) => key.to_owned(),
                0 => continue,
                named => format!("{key} of {named} frames"),
            };
            let why = why.to_owned();
            skipped.push(Skipped { what, why });
        }
    }

    fn region_hint(&self, no_points: bool) -> Result<Option<RegionHint>> {
        let positive = |radius: f64, key: &str| {
            if radius > 0.0 && radius.is_finite() {
                Ok(radius)
            } else {
                Err(self.error(format!("{key} is {radius}, not a positive length")))
            }
        };
        if let (Some(center), Some(radius)) = (
            self.vector("sphere_center")?,
            self.number(&self.top, "sphere_radius", "")?,
        ) {
            return Ok(Some(RegionHint {
                center: DVec3::from(center),
                radius: positive(radius, "sphere_radius")?,
                half: None,
                how: format!(
                    "sphere_center and sphere_radius of {}",
                    file_name(self.file)
                ),
            }));
        }
        if let Some(rows) = self.top.get("aabb_range").and_then(Value::as_array) {
            let ends: Vec<[f64; 2]> = rows
                .iter()
                .filter_map(|row| Some([row.get(0)?.as_f64()?, row.get(1)?.as_f64()?]))
                .collect();
            let [x, y, z] = ends[..] else {
                return Err(self.error("aabb_range is not three pairs of numbers"));
            };
            let (low, high) = (DVec3::new(x[0], y[0], z[0]), DVec3::new(x[1], y[1], z[1]));
            let half = (high - low) * 0.5;
            positive(half.min_element(), "the smallest half extent of aabb_range")?;
            return Ok(Some(RegionHint {
                center: (low + high) * 0.5,
                radius: positive(half.max_element(), "the largest half extent of aabb_range")?,
                half: Some(half),
                how: format!("aabb_range of {}", file_name(self.file)),
            }));
        }
        // A larger aabb_scale takes in the background; a scale of 1 is the author's word for where the object is.
        let aabb_scale = self.number(&self.top, "aabb_scale", "")?;
        if let Some(aabb_scale) = aabb_scale.filter(|scale| no_points && *scale <= 1.0) {
            let scale = positive(
                self.number(&self.top, "scale", "")?.unwrap_or(NGP_SCALE),
                "scale",
            )?;
            let offset = self.vector("offset")?.unwrap_or([NGP_OFFSET; 3]);
            let radius = positive(0.5 * aabb_scale / scale, "aabb_scale / scale / 2")?;
            return Ok(Some(RegionHint {
                center: (DVec3::splat(0.5) - DVec3::from(offset)) / scale,
                radius,
                half: Some(DVec3::splat(radius)),
                how: format!(
                    "instant-ngp's unit cube (aabb_scale {aabb_scale}, scale {scale}) of {}",
                    file_name(self.file)
                ),
            }));
        }
        Ok(None)
    }
}
