//! JSON files of datasets: numbers, paths and matrices, and errors that name the file, the key and what stands there.

use std::path::{Path, PathBuf};

use glam::DMat4;
use serde_json::{Map, Value};

use crate::{Error, Result};

pub(super) type Object = Map<String, Value>;

/// Endings tried where a path has none, or another one.
pub(super) const ENDINGS: [&str; 10] = [
    "png", "jpg", "jpeg", "JPG", "JPEG", "PNG", "exr", "tif", "tiff", "TIF",
];

/// A parsed file and its path, for errors.
pub(super) struct Document<'a> {
    pub file: &'a Path,
    pub top: Object,
}

impl<'a> Document<'a> {
    pub fn open(file: &'a Path) -> Result<Self> {
        let data = std::fs::read(file).map_err(|error| Error::unreadable(file, &error))?;
        let text = String::from_utf8_lossy(&data);
        let text = text.trim_start_matches('\u{feff}');
        let parsed = serde_json::from_str(text)
            // Python writes NaN and Infinity, which JSON has not: as texts they are found where they matter, with their key.
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

    pub fn error(&self, what: impl Into<String>) -> Error {
        Error::input(
            self.file,
            what,
            "correct the file, or export the poses again",
        )
    }
    /// A number under `key`; `place` says whose it is. Null counts as absent.
    pub fn number(&self, object: &Object, key: &str, place: &str) -> Result<Option<f64>> {
        match object.get(key) {
            None | Some(Value::Null) => Ok(None),
            Some(value) => match value.as_f64() {
                Some(number) => Ok(Some(number)),
                None => Err(self.error(format!("{place}{key} is {}, not a number", brief(value)))),
            },
        }
    }

    pub fn text(&self, key: &str) -> Result<Option<&str>> {
        match self.top.get(key) {
            None | Some(Value::Null) => Ok(None),
            Some(Value::String(text)) => Ok(Some(text)),
            Some(value) => Err(self.error(format!("{key} is {}, not a path", brief(value)))),
        }
    }

    /// `N` finite numbers under `key`.
    pub fn vector<const N: usize>(&self, key: &str) -> Result<Option<[f64; N]>> {
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

    /// The rigid matrix that is the value of `key`; `place` says whose it is.
    pub fn pose(&self, value: &Value, key: &str, place: &str) -> Result<DMat4> {
        let matrix = self
            .matrix(value)
            .map_err(|what| self.error(format!("{place}{key} {what}")))?;
        super::rigid(matrix).map_err(|what| {
            let next = "take this frame out of the file, or export the poses again";
            Error::input(self.file, format!("{place}{what}"), next)
        })
    }

    /// Three or four rows of four numbers.
    pub fn matrix(&self, value: &Value) -> std::result::Result<DMat4, String> {
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
                // Texts are what NaN and Infinity were read as; some write null in their place.
                let number = if entry.is_null() || entry.is_string() {
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
}

/// The file that `path` means: as it is (with either slash), with another ending, or by its last parts below `root`.
pub(super) fn find(
    root: &Path,
    path: &str,
    endings: &[&str],
) -> std::result::Result<PathBuf, String> {
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

/// `text` with NaN, Infinity and -Infinity outside of strings in quotes.
fn without_bare_words(text: &str) -> String {
    let mut cleaned = String::with_capacity(text.len());
    let (mut in_string, mut escaped) = (false, false);
    let mut rest = text;
    while let Some(character) = rest.chars().next() {
        let bare = ["NaN", "-Infinity", "Infinity", "nan", "-inf", "inf"]
            .into_iter()
            .find(|word| !in_string && rest.starts_with(word));
        if let Some(word) = bare {
            cleaned.push_str(&format!("\"{word}\""));
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
pub(super) fn brief(value: &Value) -> String {
    let text = value.to_string();
    match text.char_indices().nth(40) {
        Some((end, _)) => format!("{}...", &text[..end]),
        None => text,
    }
}

pub(super) fn file_name(path: &Path) -> String {
    path.file_name()
        .unwrap_or(path.as_os_str())
        .to_string_lossy()
        .into_owned()
}
