//! transforms.json and its dialects: nerfstudio, instant-ngp, Neuralangelo, and Blender's split files.
//!
//! All of them hold camera-to-world matrices with OpenGL's camera axes, and intrinsics that may stand once or per frame, in pixels
//! or as angles, with or without the picture's size. Neuralangelo adds sphere_center, sphere_radius and aabb_range; instant-ngp
//! adds aabb_scale, scale and offset, which say that the region is the cube of aabb_scale about 0.5 of `scale · x + offset`.

mod intrinsics;

use std::collections::HashSet;
use std::path::{Path, PathBuf};

use glam::{DMat4, DVec3};
use serde_json::{Map, Value};

use super::{Format, Frame, FrameLens, Reading, RegionHint, Skipped, Split, points};
use crate::{Error, Result};

pub(super) use intrinsics::Intrinsics;

type Object = Map<String, Value>;

/// Endings tried where a path has none, or another one.
const ENDINGS: [&str; 10] = [
    "png", "jpg", "jpeg", "JPG", "JPEG", "PNG", "exr", "tif", "tiff", "TIF",
];

/// instant-ngp's defaults for `scale` and `offset`.
const NGP_SCALE: f64 = 0.33;
const NGP_OFFSET: f64 = 0.5;

/// Reads `file` and, beside a transforms.json or transforms_train.json, the held-out views of transforms_test.json or _val.json.
pub(super) fn read(file: &Path) -> Result<Reading> {
    let root = file.parent().unwrap_or(Path::new("")).to_path_buf();
    let blender = file
        .file_name()
        .is_some_and(|name| name == "transforms_train.json");
    let document = Document::open(file)?;
    let mut reading = Reading {
        format: document.format(blender),
        frames: document.frames(&root)?,
        points: Vec::new(),
        region_hint: None,
        skipped: Vec::new(),
        notes: Vec::new(),
        world_from_colmap: document.applied_transform()?,
        file: file.to_path_buf(),
        root,
    };
    if blender
        || file
            .file_name()
            .is_some_and(|name| name == "transforms.json")
    {
        read_held_out(&mut reading)?;
    }
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

/// Adds the frames of transforms_test.json, or else of transforms_val.json, as held-out views.
fn read_held_out(reading: &mut Reading) -> Result<()> {
    let mut files = ["transforms_test.json", "transforms_val.json"]
        .into_iter()
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

/// A parsed file and its path, for errors.
struct Document<'a> {
    file: &'a Path,
    top: Object,
}

impl<'a> Document<'a> {
    fn open(file: &'a Path) -> Result<Self> {
        let data = std::fs::read(file).map_err(|source| Error::io(file, source))?;
        let text = String::from_utf8_lossy(&data);
        let text = text.trim_start_matches('\u{feff}');
        let parsed = serde_json::from_str(text)
            // Python writes NaN and Infinity, which JSON has not: as null they are found where they matter, with their key.
            .or_else(|error| serde_json::from_str(&without_bare_words(text)).map_err(|_| error));
        match parsed {
            Ok(Value::Object(top)) => Ok(Document { file, top }),
            Ok(_) => Err(Error::input(
                file,
                "holds no object at its top",
                "export the poses again",
            )),
            Err(error) => Err(Error::input(
                file,
                format!("is no JSON: {error} ({} bytes)", data.len()),
                "the file is truncated or was edited by hand: export the poses again",
            )),
        }
    }

    fn error(&self, what: impl Into<String>) -> Error {
        Error::input(
            self.file,
            what,
            "correct the file, or export the poses again",
        )
    }

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

    /// A number under `key`; `place` says whose it is. Null counts as absent.
    fn number(&self, object: &Object, key: &str, place: &str) -> Result<Option<f64>> {
        match object.get(key) {
            None | Some(Value::Null) => Ok(None),
            Some(value) => match value.as_f64() {
                Some(number) => Ok(Some(number)),
                None => Err(self.error(format!("{place}{key} is {}, not a number", brief(value)))),
            },
        }
    }

    fn text(&self, key: &str) -> Result<Option<&str>> {
        match self.top.get(key) {
            None | Some(Value::Null) => Ok(None),
            Some(Value::String(text)) => Ok(Some(text)),
            Some(value) => Err(self.error(format!("{key} is {}, not a path", brief(value)))),
        }
    }

    /// `N` finite numbers under `key`.
    fn vector<const N: usize>(&self, key: &str) -> Result<Option<[f64; N]>> {
        let Some(value) = self.top.get(key).filter(|value| !value.is_null()) else {
            return Ok(None);
        };
        let mut vector = [0.0; N];
        let entries = value.as_array().filter(|entries| entries.len() == N);
        let whole = entries.is_some_and(|entries| {
            vector.iter_mut().zip(entries).all(|(slot, entry)| {
                *slot = entry.as_f64().unwrap_or(f64::NAN);
                slot.is_finite()
            })
        });
        if !whole {
            return Err(self.error(format!("{key} is {}, not {N} numbers", brief(value))));
        }
        Ok(Some(vector))
    }

    /// The frames, in the file's order.
    fn frames(&self, root: &Path) -> Result<Vec<Frame>> {
        let Some(entries) = self.top.get("frames").and_then(Value::as_array) else {
            return Err(self.error("has no list of frames"));
        };
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
            let mask = entry
                .get("mask_path")
                .and_then(Value::as_str)
                .map(|mask| find(root, mask, &[]));
            frames.push(Frame {
                image: find(root, path, &ENDINGS),
                mask,
                lens: FrameLens::Keys(self.intrinsics(entry, &place)?),
                world_from_camera: self.pose(matrix, &place)?,
                split: None,
                name,
            });
        }
        Ok(frames)
    }

    fn pose(&self, value: &Value, place: &str) -> Result<DMat4> {
        let matrix = self
            .matrix(value)
            .map_err(|what| self.error(format!("{place}transform_matrix {what}")))?;
        super::rigid(matrix).map_err(|what| {
            let next = "take this frame out of the file, or export the poses again";
            Error::input(self.file, format!("{place}{what}"), next)
        })
    }

    /// Three or four rows of four numbers.
    fn matrix(&self, value: &Value) -> std::result::Result<DMat4, String> {
        let rows = value.as_array().map(Vec::as_slice).unwrap_or_default();
        if rows.len() != 3 && rows.len() != 4 {
            return Err(format!("is {}, not a 4x4 matrix", brief(value)));
        }
        let mut matrix = DMat4::IDENTITY;
        for (row, entries) in rows.iter().enumerate() {
            let entries = entries.as_array().filter(|entries| entries.len() == 4);
            let entries =
                entries.ok_or_else(|| format!("has a row {row} that is not 4 numbers"))?;
            for (column, entry) in entries.iter().enumerate() {
                // Null is what NaN and Infinity were read as.
                let number = if entry.is_null() {
                    Some(f64::NAN)
                } else {
                    entry.as_f64()
                };
                let number = number
                    .ok_or_else(|| format!("has {} in row {row}, column {column}", brief(entry)))?;
                if !number.is_finite() {
                    return Err(format!("has NaN or infinity in row {row}, column {column}"));
                }
                if row < 3 {
                    matrix.col_mut(column)[row] = number;
                }
            }
        }
        Ok(matrix)
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

/// The file that `path` means: as it is (with either slash), with another ending, or by its last parts below `root`.
fn find(root: &Path, path: &str, endings: &[&str]) -> std::result::Result<PathBuf, String> {
    let path = path.replace('\\', "/");
    let parts: Vec<&str> = path
        .split('/')
        .filter(|part| !part.is_empty() && *part != ".")
        .collect();
    let stated = root.join(&path);
    let shorter = (1..parts.len()).map(|from| root.join(parts[from..].join("/")));
    let in_images = parts.last().map(|name| root.join("images").join(name));
    for candidate in std::iter::once(stated.clone())
        .chain(shorter)
        .chain(in_images)
    {
        if candidate.is_file() {
            return Ok(candidate);
        }
        let appended = |ending: &&str| PathBuf::from(format!("{}.{ending}", candidate.display()));
        let replaced = |ending: &&str| candidate.with_extension(ending);
        let named = candidate.file_name().is_some();
        if let Some(found) = endings
            .iter()
            .map(appended)
            .chain(endings.iter().map(replaced))
            .find(|other| named && other.is_file())
        {
            return Ok(found);
        }
    }
    Err(format!("no such file: {}", stated.display()))
}

/// `text` with NaN, Infinity and -Infinity outside of strings replaced by null.
fn without_bare_words(text: &str) -> String {
    let mut cleaned = String::with_capacity(text.len());
    let (mut in_string, mut escaped) = (false, false);
    let mut rest = text;
    while let Some(character) = rest.chars().next() {
        let bare = ["NaN", "-Infinity", "Infinity", "nan", "-inf", "inf"]
            .into_iter()
            .find(|word| !in_string && rest.starts_with(word));
        if let Some(word) = bare {
            cleaned.push_str("null");
            rest = &rest[word.len()..];
            continue;
        }
        in_string = match (character, in_string, escaped) {
            ('"', true, true) => true,
            ('"', _, _) => !in_string,
            _ => in_string,
        };
        escaped = in_string && character == '\\' && !escaped;
        cleaned.push(character);
        rest = &rest[character.len_utf8()..];
    }
    cleaned
}

/// A JSON value, short enough for an error.
fn brief(value: &Value) -> String {
    let text = value.to_string();
    match text.char_indices().nth(40) {
        Some((end, _)) => format!("{}...", &text[..end]),
        None => text,
    }
}

fn file_name(path: &Path) -> String {
    path.file_name()
        .unwrap_or(path.as_os_str())
        .to_string_lossy()
        .into_owned()
}
