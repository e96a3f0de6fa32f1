//! transforms.json and its dialects: nerfstudio, instant-ngp, Neuralangelo, and Blender's split files.
//!
//! All of them hold camera-to-world matrices with OpenGL's camera axes (with OpenCV's where NeuS2 writes from_na), and intrinsics that
//! may stand once or per frame, in pixels or as angles, with or without the picture's size. Neuralangelo adds sphere_center,
//! sphere_radius and aabb_range; instant-ngp adds aabb_scale, scale and offset, which say that the region is the cube of aabb_scale
//! about 0.5 of `scale · x + offset`.

mod intrinsics;

use std::collections::HashSet;
use std::path::{Path, PathBuf};

use glam::{DMat4, DVec3};
use serde_json::Value;

use super::json::{Document, ENDINGS, brief, file_name, find};
use super::{Format, Frame, FrameLens, PriorPaths, Reading, RegionHint, Skipped, Split};
use super::{opengl_from_opencv, points};
use crate::Result;

pub(super) use intrinsics::Intrinsics;

/// instant-ngp's defaults for `scale` and `offset`.
const NGP_SCALE: f64 = 0.33;
const NGP_OFFSET: f64 = 0.5;

/// NeuS2's training views.
pub(super) const NEUS2: &str = "transform_train.json";

/// Reads `file` and the held-out views of the file beside it that is for them.
pub(super) fn read(file: &Path) -> Result<Reading> {
    let root = file.parent().unwrap_or(Path::new("")).to_path_buf();
    let blender = file_name(file) == "transforms_train.json";
    let document = Document::open(file)?;
    let mut reading = Reading {
        format: document.format(blender),
        frames: document.frames(&root)?,
        points: Vec::new(),
        region_hint: None,
        skipped: Vec::new(),
        notes: Vec::new(),
        world_from_colmap: document.applied_transform()?,
        truth_from_world: None,
        file: file.to_path_buf(),
        root,
    };
    read_held_out(&mut reading)?;
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
    let skew = document.number(&document.top, "sk_x", "")?.unwrap_or(0.0);
    if skew.abs() > 1e-3 {
        reading.notes.push(format!(
            "sk_x = {skew} is not used: no camera model has skew"
        ));
    }
    Ok(reading)
}

/// Adds the frames of the first file of held-out views that is there.
fn read_held_out(reading: &mut Reading) -> Result<()> {
    let names: &[&str] = match file_name(&reading.file).as_str() {
        "transforms.json" | "transforms_train.json" => {
            &["transforms_test.json", "transforms_val.json"]
        }
        NEUS2 => &["transform_test.json"],
        _ => &[],
    };
    let mut files = names
        .iter()
        .map(|name| reading.root.join(name))
        .filter(|file| file.is_file());
    let Some(file) = files.next() else {
        return Ok(());
    };
    if let Some(other) = files.next() {
        reading.skipped.push(Skipped {
            what: other.display().to_string(),
            why: "the held-out views are those of transforms_test.json".into(),
        });
    }
    let mut test = Document::open(&file)?.frames(&reading.root)?;
    for frame in &mut test {
        frame.split = Some(Split::Test);
    }
    let images: HashSet<&PathBuf> = test
        .iter()
        .filter_map(|frame| frame.image.as_ref().ok())
        .collect();
    let before = reading.frames.len();
    reading.frames.retain(|frame| {
        !frame
            .image
            .as_ref()
            .is_ok_and(|image| images.contains(image))
    });
    if reading.frames.len() < before {
        let shared = before - reading.frames.len();
        reading.notes.push(format!(
            "{shared} views are in {} too, and so not trained on",
            file.display()
        ));
    }
    reading.frames.extend(test);
    Ok(())
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

    /// The frames, in the file's order.
    fn frames(&self, root: &Path) -> Result<Vec<Frame>> {
        let Some(entries) = self.top.get("frames").and_then(Value::as_array) else {
            return Err(self.error("has no list of frames"));
        };
        let opencv = self.top.get("from_na").and_then(Value::as_bool) == Some(true);
        let mut frames = Vec::with_capacity(entries.len());
        for (index, entry) in entries.iter().enumerate() {
            let Some(entry) = entry.as_object() else {
                return Err(self.error(format!("frame {index} is {}, not an object", brief(entry))));
            };
            let Some(path) = entry.get("file_path").and_then(Value::as_str) else {
                return Err(self.error(format!("frame {index} has no file_path")));
            };
            let name = path.replace('\\', "/");
            let name = name.trim_start_matches("./").to_owned();
            let place = format!("frame {index} ({name}): ");
            let matrix = entry
                .get("transform_matrix")
                .ok_or_else(|| self.error(format!("{place}has no transform_matrix")))?;
            let pose = self.pose(matrix, "transform_matrix", &place)?;
            let mask = entry
                .get("mask_path")
                .and_then(Value::as_str)
                .map(|mask| find(root, mask, &[]));
            frames.push(Frame {
                image: find(root, path, &ENDINGS),
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

    /// nerfstudio: what was done to COLMAP's world on the way into this file.
    fn applied_transform(&self) -> Result<DMat4> {
        let scale = self.number(&self.top, "applied_scale", "")?.unwrap_or(1.0);
        let transform = match self
            .top
            .get("applied_transform")
            .filter(|value| !value.is_null())
        {
            Some(value) => self
                .matrix(value)
                .map_err(|what| self.error(format!("applied_transform {what}")))?,
            None => DMat4::IDENTITY,
        };
        Ok(DMat4::from_scale(DVec3::splat(scale)) * transform)
    }

    /// nerfstudio: lists of the frames that belong to each split.
    fn split_by_lists(&self, reading: &mut Reading) -> Result<()> {
        let list = |key: &str| -> Option<HashSet<String>> {
            let names = self
                .top
                .get(key)?
                .as_array()?
                .iter()
                .filter_map(Value::as_str);
            Some(
                names
                    .map(|name| name.replace('\\', "/").trim_start_matches("./").to_owned())
                    .collect(),
            )
        };
        let (train, val, test) = (
            list("train_filenames"),
            list("val_filenames"),
            list("test_filenames"),
        );
        let Some(held_out) = test.as_ref().or(val.as_ref()) else {
            return Ok(());
        };
        let mut unlisted = 0;
        reading.frames.retain_mut(|frame| {
            if frame.split.is_none() && held_out.contains(&frame.name) {
                frame.split = Some(Split::Test);
            }
            let keep = frame.split.is_some()
                || train
                    .as_ref()
                    .is_none_or(|train| train.contains(&frame.name));
            unlisted += usize::from(!keep);
            keep
        });
        if unlisted > 0 {
            reading.skipped.push(Skipped {
                what: format!("{unlisted} frames"),
                why: "neither in train_filenames nor among the held-out ones".into(),
            });
        }
        Ok(())
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
