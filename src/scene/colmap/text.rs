//! COLMAP's text files: words and numbers in lines, `#` in front of comments; an image takes two lines.

use std::collections::HashMap;
use std::path::Path;

use glam::DVec3;

use super::super::{Camera, CameraModel, Point};
use super::{ImageRecord, camera_from, unsupported};
use crate::{Error, Result};

/// A text file's lines, with what is needed to say which of them is wrong.
struct Lines<'a> {
    file: &'a Path,
    text: String,
}

/// One line's words.
struct Words<'a> {
    file: &'a Path,
    line: usize,
    rest: &'a str,
}

impl<'a> Lines<'a> {
    fn open(file: &'a Path) -> Result<Self> {
        let data = std::fs::read(file).map_err(|error| Error::unreadable(file, &error))?;
        let text = String::from_utf8_lossy(&data).into_owned();
        Ok(Lines { file, text })
    }

    /// All lines with their numbers from 1.
    fn all(&self) -> impl Iterator<Item = Words<'_>> {
        self.text.lines().enumerate().map(|(index, line)| Words {
            file: self.file,
            line: index + 1,
            rest: line.trim(),
        })
    }

    /// Notes where the comment on top says that there are more than were read: a file that ends between two of them is no error in itself.
    fn note_missing(&self, what: &str, read: usize, notes: &mut Vec<String>) {
        let comments = self.text.lines().take_while(|line| line.starts_with('#'));
        let stated = comments
            .filter_map(|line| line.strip_prefix("# Number of ")?.strip_prefix(what))
            .find_map(|rest| rest.strip_prefix(": ")?.split(',').next()?.parse().ok());
        if let Some(stated) = stated.filter(|&stated: &usize| stated > read) {
            notes.push(format!(
                "{} holds {read} {what}, but says {stated} on top: it ends early, or some were taken out",
                self.file.display()
            ));
        }
    }
}

impl<'a> Words<'a> {
    fn is_comment_or_empty(&self) -> bool {
        self.rest.is_empty() || self.rest.starts_with('#')
    }

    fn error(&self, what: impl std::fmt::Display) -> Error {
        Error::input(
            self.file,
            format!("line {}: {what}", self.line),
            "the file is truncated or damaged: copy it again, or export the model again",
        )
    }

    fn word(&mut self, name: &str) -> Result<&'a str> {
        let word = self.rest.split_whitespace().next();
        let Some(word) = word else {
            return Err(self.error(format!("ends before {name}")));
        };
        self.rest = self.rest[word.len()..].trim_start();
        Ok(word)
    }

    fn number<T: std::str::FromStr>(&mut self, name: &str) -> Result<T> {
        let word = self.word(name)?;
        word.parse()
            .map_err(|_| self.error(format!("{word:?} cannot be {name}")))
    }

    fn numbers<const N: usize>(&mut self, name: &str) -> Result<[f64; N]> {
        let mut values = [0.0; N];
        for value in &mut values {
            *value = self.number(name)?;
        }
        Ok(values)
    }
}

pub(super) fn cameras(file: &Path) -> Result<HashMap<u32, Camera>> {
    let lines = Lines::open(file)?;
    let mut cameras = HashMap::new();
    for mut words in lines.all().filter(|words| !words.is_comment_or_empty()) {
        let id = words.number("a camera's number")?;
        let name = words.word("a camera model")?;
        let Some(model) = CameraModel::from_name(name) else {
            return Err(unsupported(file, id, name));
        };
        let size = (words.number("the width")?, words.number("the height")?);
        let mut params = Vec::new();
        while !words.rest.is_empty() {
            params.push(words.number("a camera parameter")?);
        }
        cameras.insert(id, camera_from(file, id, model, size, params)?);
    }
    Ok(cameras)
}

pub(super) fn images(file: &Path, notes: &mut Vec<String>) -> Result<Vec<ImageRecord>> {
    let lines = Lines::open(file)?;
    let mut images = Vec::new();
    let mut all = lines.all();
    while let Some(mut words) = all.next() {
        if words.is_comment_or_empty() {
            continue;
        }
        words.number::<u32>("an image's number")?;
        let q = words.numbers::<4>("an entry of the quaternion")?;
        let t = words.numbers::<3>("an entry of the translation")?;
        let camera_id = words.number("the camera's number")?;
        if words.rest.is_empty() {
            return Err(words.error("ends before the picture's name"));
        }
        images.push(ImageRecord::new(
            file,
            words.rest.to_owned(),
            camera_id,
            q,
            t,
        )?);
        // The second line, which may be empty, holds (x, y, point) for every feature.
        if let Some(observed) = all.next() {
            let count = observed.rest.split_whitespace().count();
            if count % 3 != 0 {
                return Err(observed.error(format!(
                    "{count} numbers are no list of x, y, point (an image takes two lines, the second may be empty)"
                )));
            }
        }
    }
    lines.note_missing("images", images.len(), notes);
    Ok(images)
}

pub(super) fn points(file: &Path, notes: &mut Vec<String>) -> Result<Vec<Point>> {
    let lines = Lines::open(file)?;
    let mut points = Vec::new();
    for mut words in lines.all().filter(|words| !words.is_comment_or_empty()) {
        words.number::<u64>("a point's number")?;
        let position = DVec3::from(words.numbers::<3>("a coordinate")?);
        let mut color = [0; 3];
        for channel in &mut color {
            *channel = words.number("a colour from 0 to 255")?;
        }
        points.push(Point { position, color });
    }
    lines.note_missing("points", points.len(), notes);
    Ok(points)
}
