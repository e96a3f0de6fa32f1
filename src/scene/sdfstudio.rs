//! sdfstudio's meta_data.json, the layout in which ScanNet++ is prepared for NeuRodin.
//!
//! `camtoworld` has OpenCV's camera axes. Its world is a scene made to fit a box about the origin; `scene_box` is that box, or a ball,
//! and `worldtogt` leads back into the frame of the ground truth. Intrinsics stand per frame, in pixels of `width` x `height`.

use std::path::Path;

use glam::{DMat3, DMat4, DVec3};
use serde_json::Value;

use super::json::{Document, ENDINGS, Object, brief, file_name, find};
use super::{
    Camera, CameraModel, Format, Frame, FrameLens, PriorKind, PriorPaths, Reading, RegionHint,
};
use crate::{Error, Result};

/// Reads `file`.
pub(super) fn read(file: &Path) -> Result<Reading> {
    let root = file.parent().unwrap_or(Path::new("")).to_path_buf();
    let document = Document::open(file)?;
    let truth_from_world = document.world_to_truth()?;
    let entries = document.frame_objects()?;
    let size = document.picture_size()?;
    let frames = entries
        .iter()
        .enumerate()
        .map(|(index, entry)| document.frame(&root, index, entry, size))
        .collect::<Result<Vec<_>>>()?;
    let mut notes = Vec::new();
    for kind in PriorKind::ALL {
        let named = (frames.iter())
            .filter(|frame| frame.priors.of(kind).is_some())
            .count();
        if named > 0 {
            let (key, setting) = (kind.key(), kind.setting());
            notes.push(format!(
                "{key} of {named} frames is used where {setting} is above 0"
            ));
        }
    }
    if truth_from_world.is_some() {
        notes.push(format!(
            "worldtogt leads from these cameras' coordinates to the ground truth's: `neurodin eval --align {}` applies it to a mesh",
            file.display()
        ));
    }
    Ok(Reading {
        root,
        file: file.to_path_buf(),
        format: Format::Sdfstudio,
        frames,
        points: Vec::new(),
        region_hint: document.scene_box()?,
        skipped: Vec::new(),
        notes,
        // Scans are aligned in COLMAP's world, so that a model beside the file is in the frame that worldtogt leads to.
        world_from_colmap: vec![truth_from_world.map_or(DMat4::IDENTITY, |truth| truth.inverse())],
        truth_from_world,
    })
}

/// The `worldtogt` of a meta_data.json: from the coordinates of its cameras to those of the ground truth.
///
/// # Errors
/// [`Error::Input`] for a file that is none, or a matrix that is none.
pub fn truth_from_world(file: &Path) -> Result<Option<DMat4>> {
    Document::open(file)?.world_to_truth()
}

impl Document<'_> {
    fn world_to_truth(&self) -> Result<Option<DMat4>> {
        let Some(value) = self.top.get("worldtogt").filter(|value| !value.is_null()) else {
            return Ok(None);
        };
        let matrix = self
            .matrix(value)
            .map_err(|what| self.error(format!("worldtogt {what}")))?;
        let determinant = DMat3::from_mat4(matrix).determinant();
        if determinant.abs() < 1e-30 {
            return Err(self.error("worldtogt is singular: it leads nowhere"));
        }
        Ok(Some(matrix))
    }

    fn frame_objects(&self) -> Result<Vec<&Object>> {
        let Some(entries) = self.top.get("frames").and_then(Value::as_array) else {
            return Err(self.error("has no list of frames"));
        };
        let objects = entries.iter().enumerate().map(|(index, entry)| {
            entry
                .as_object()
                .ok_or_else(|| self.error(format!("frame {index} is {}, no object", brief(entry))))
        });
        objects.collect()
    }

    /// Width and height that the intrinsics refer to, where they are stated.
    fn picture_size(&self) -> Result<Option<(u32, u32)>> {
        let side = |key: &str| self.number(&self.top, key, "");
        match (side("width")?, side("height")?) {
            (Some(width), Some(height)) if width >= 1.0 && height >= 1.0 => {
                Ok(Some((width as u32, height as u32)))
            }
            (None, None) => Ok(None),
            (width, height) => Err(self.error(format!(
                "width {width:?} and height {height:?} are no picture size"
            ))),
        }
    }

    fn frame(
        &self,
        root: &Path,
        index: usize,
        entry: &Object,
        size: Option<(u32, u32)>,
    ) -> Result<Frame> {
        let Some(path) = entry.get("rgb_path").and_then(Value::as_str) else {
            return Err(self.error(format!("frame {index} has no rgb_path")));
        };
        let name = path.replace('\\', "/");
        let place = format!("frame {index} ({name}): ");
        let lacks = |key: &str| self.error(format!("{place}has no {key}"));
        let pose = entry
            .get("camtoworld")
            .ok_or_else(|| lacks("camtoworld"))
            .and_then(|matrix| self.pose(matrix, "camtoworld", &place))?;
        let lengths = entry
            .get("intrinsics")
            .or_else(|| self.top.get("intrinsics"))
            .ok_or_else(|| lacks("intrinsics"))
            .and_then(|matrix| self.lengths(matrix, &place))?;
        let lens = match size {
            None => FrameLens::Pinhole(lengths),
            Some((width, height)) => FrameLens::Stated(
                Camera::new(CameraModel::Pinhole, width, height, lengths.to_vec())
                    .map_err(|what| self.error(format!("{place}{what}")))?,
            ),
        };
        let mask = entry
            .get("foreground_mask")
            .and_then(Value::as_str)
            .map(|mask| find(root, mask, &[]));
        // A file that is not there is missed when it is read: most runs do without.
        let prior = |kind: PriorKind| {
            let stated = entry.get(kind.key()).and_then(Value::as_str)?;
            Some(find(root, stated, &[]).unwrap_or_else(|_| root.join(stated)))
        };
        Ok(Frame {
            image: find(root, path, &ENDINGS),
            priors: PriorPaths(PriorKind::ALL.map(prior)),
            mask,
            lens,
            world_from_camera: super::opengl_from_opencv(pose),
            split: None,
            name,
        })
    }

    /// Focal lengths and centre of a matrix of 3 or 4 rows.
    fn lengths(&self, matrix: &Value, place: &str) -> Result<[f64; 4]> {
        let is_square = matrix.as_array().is_some_and(|rows| {
            matches!(rows.len(), 3 | 4)
                && rows
                    .iter()
                    .all(|row| row.as_array().is_some_and(|row| row.len() == rows.len()))
        });
        if !is_square {
            return Err(self.error(format!(
                "{place}intrinsics is {}, not a 3x3 or 4x4 matrix",
                brief(matrix)
            )));
        }
        let mut lengths = [0.0; 4];
        for (length, [row, column]) in lengths.iter_mut().zip([[0, 0], [1, 1], [0, 2], [1, 2]]) {
            *length = matrix[row][column].as_f64().ok_or_else(|| {
                self.error(format!(
                    "{place}intrinsics has {} in row {row}, column {column}",
                    brief(&matrix[row][column])
                ))
            })?;
        }
        Ok(lengths)
    }

    /// The region: a ball where the collider is a sphere, a box otherwise.
    fn scene_box(&self) -> Result<Option<RegionHint>> {
        let Some(stated) = self.top.get("scene_box").and_then(Value::as_object) else {
            return Ok(None);
        };
        let wrong = |what: String| {
            Error::input(
                self.file,
                format!("scene_box: {what}"),
                "correct the file, or take scene_box out and state the region by --center and --radius, or --box",
            )
        };
        let corners: Vec<DVec3> = stated
            .get("aabb")
            .and_then(Value::as_array)
            .into_iter()
            .flatten()
            .filter_map(|corner| {
                let number = |axis: usize| corner.get(axis).and_then(Value::as_f64);
                Some(DVec3::new(number(0)?, number(1)?, number(2)?))
            })
            .collect();
        let (center, half) = match corners[..] {
            [low, high] => ((low + high) * 0.5, (high - low) * 0.5),
            _ => {
                let there = stated.get("aabb").map_or("not there".into(), brief);
                return Err(wrong(format!("aabb is {there}, not two corners")));
            }
        };
        if half.min_element() <= 0.0 {
            return Err(wrong(format!("aabb is empty: its half extents are {half}")));
        }
        let file = file_name(self.file);
        let collider = stated.get("collider_type").and_then(Value::as_str);
        if collider == Some("sphere") {
            let radius = self.number(stated, "radius", "scene_box: ")?.unwrap_or(1.0);
            if radius <= 0.0 {
                return Err(wrong(format!("radius is {radius}, not a positive length")));
            }
            return Ok(Some(RegionHint {
                center,
                radius,
                half: None,
                how: format!("scene_box of {file}, a sphere"),
            }));
        }
        Ok(Some(RegionHint {
            center,
            radius: half.max_element(),
            half: Some(half),
            how: format!("scene_box of {file}"),
        }))
    }
}
