//! Which views of a transforms.json are held out: those of another file, of a second list of frames, or of a list of names.

use std::collections::HashSet;
use std::path::PathBuf;

use serde_json::Value;

use super::super::json::{Document, file_name};
use super::super::{Frame, Reading, Skipped, Split};
use super::NEUS2;
use crate::Result;

/// Adds the frames of the first file of held-out views that is there.
pub(super) fn read_held_out(reading: &mut Reading) -> Result<()> {
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
    let document = Document::open(&file)?;
    let test = document.frames("frames", &reading.root, &mut reading.skipped)?;
    hold_out(reading, test, &file.display().to_string());
    Ok(())
}

/// Adds `test` as held-out views, in place of frames with the same pictures. They are from `place`.
fn hold_out(reading: &mut Reading, mut test: Vec<Frame>, place: &str) {
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
            "{shared} views are in {place} too, and so not trained on"
        ));
    }
    reading.frames.extend(test);
}

impl Document<'_> {
    /// ScanNet++: a second list, of the frames that its benchmark holds out.
    pub(super) fn hold_out_test_frames(&self, reading: &mut Reading) -> Result<()> {
        const KEY: &str = "test_frames";
        if self.top.get(KEY).is_some_and(|list| !list.is_null()) {
            let mut bad = Vec::new();
            let test = self.frames(KEY, &reading.root, &mut bad)?;
            hold_out(reading, test, KEY);
            // What is too bad to be held out is not trained on instead.
            let bad_names: HashSet<&String> = bad.iter().map(|bad| &bad.what).collect();
            reading
                .frames
                .retain(|frame| !bad_names.contains(&frame.name));
            reading.skipped.extend(bad);
        }
        Ok(())
    }

    /// nerfstudio: lists of the frames that belong to each split.
    pub(super) fn split_by_lists(&self, reading: &mut Reading) -> Result<()> {
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
}
