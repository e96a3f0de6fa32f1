//! COLMAP's binary files: little-endian, a 64-bit count in front of records of varying length.
//!
//! Counts are never believed: what a file of this size cannot hold is refused before anything is allocated.

use std::collections::HashMap;
use std::path::Path;

use glam::DVec3;

use super::super::camera::UNSUPPORTED_MODELS;
use super::super::{Camera, CameraModel, Point};
use super::{ImageRecord, camera_from, unsupported};
use crate::{Error, Result};

/// A binary file in memory and the place that was read up to.
struct Bytes<'a> {
    file: &'a Path,
    data: Vec<u8>,
    at: usize,
}

impl<'a> Bytes<'a> {
    fn open(file: &'a Path) -> Result<Self> {
        let data = std::fs::read(file).map_err(|error| Error::unreadable(file, &error))?;
        Ok(Bytes { file, data, at: 0 })
    }

    /// The next `count` bytes, which are (part of) `what`.
    fn take(&mut self, count: u64, what: &dyn Fn() -> String) -> Result<&[u8]> {
        let left = (self.data.len() - self.at) as u64;
        if count > left {
            return Err(Error::input(
                self.file,
                format!(
                    "ends within {}: at byte {} it takes {count} more, but the file has {} bytes",
                    what(),
                    self.at,
                    self.data.len()
                ),
                "the file is truncated or damaged: copy it again, or export the model again",
            ));
        }
        let start = self.at;
        self.at += count as usize;
        Ok(&self.data[start..self.at])
    }

    fn array<const N: usize>(&mut self, what: &dyn Fn() -> String) -> Result<[u8; N]> {
        Ok(self
            .take(N as u64, what)?
            .try_into()
            .expect("N bytes were taken"))
    }

    fn u32(&mut self, what: &dyn Fn() -> String) -> Result<u32> {
        self.array(what).map(u32::from_le_bytes)
    }

    fn u64(&mut self, what: &dyn Fn() -> String) -> Result<u64> {
        self.array(what).map(u64::from_le_bytes)
    }

    fn f64s<const N: usize>(&mut self, what: &dyn Fn() -> String) -> Result<[f64; N]> {
        let mut values = [0.0; N];
        for value in &mut values {
            *value = f64::from_le_bytes(self.array(what)?);
        }
        Ok(values)
    }

    /// A count in front of records of at least `smallest` bytes: what the file cannot hold is refused before anything is allocated.
    fn count(&mut self, smallest: u64, records: &str) -> Result<usize> {
        let count = self.u64(&|| format!("the number of {records}"))?;
        let left = (self.data.len() - self.at) as u64;
        if count > left / smallest {
            return Err(Error::input(
                self.file,
                format!(
                    "says that {count} {records} follow byte {}, each of {smallest} bytes or more, but the file has {} bytes",
                    self.at,
                    self.data.len()
                ),
                "the file is truncated or damaged: copy it again, or export the model again",
            ));
        }
        Ok(count as usize)
    }
}

pub(super) fn cameras(file: &Path) -> Result<HashMap<u32, Camera>> {
    let mut bytes = Bytes::open(file)?;
    let count = bytes.count(48, "cameras")?;
    let mut cameras = HashMap::with_capacity(count);
    for number in 1..=count {
        let what = || format!("camera {number} of {count}");
        let (id, model_id) = (bytes.u32(&what)?, bytes.u32(&what)?);
        let Some(model) = CameraModel::from_id(model_id) else {
            // The model says how many parameters follow: behind an unknown one nothing can be read.
            let name = UNSUPPORTED_MODELS
                .into_iter()
                .find(|(known, _)| *known == model_id);
            return Err(match name {
                Some((_, name)) => unsupported(file, id, &format!("{name} (number {model_id})")),
                None => unsupported(file, id, &format!("number {model_id}, unknown to COLMAP 4")),
            });
        };
        let size = (bytes.u64(&what)?, bytes.u64(&what)?);
        let mut params = vec![0.0; model.param_count()];
        for param in &mut params {
            [*param] = bytes.f64s(&what)?;
        }
        cameras.insert(id, camera_from(file, id, model, size, params)?);
    }
    Ok(cameras)
}

pub(super) fn images(file: &Path) -> Result<Vec<ImageRecord>> {
    let mut bytes = Bytes::open(file)?;
    let count = bytes.count(73, "images")?;
    let mut images = Vec::with_capacity(count);
    for number in 1..=count {
        let what = || format!("image {number} of {count}");
        bytes.u32(&what)?; // COLMAP's number for it
        let (q, t) = (bytes.f64s::<4>(&what)?, bytes.f64s::<3>(&what)?);
        let camera_id = bytes.u32(&what)?;
        let rest = &bytes.data[bytes.at..];
        let length = rest
            .iter()
            .position(|byte| *byte == 0)
            .unwrap_or(rest.len());
        let name = bytes.take(length as u64 + 1, &|| {
            format!("the name of image {number} of {count}")
        })?;
        let name = String::from_utf8_lossy(&name[..length]).into_owned();
        let observations = bytes.count(24, "observed points of an image")?;
        bytes.take(observations as u64 * 24, &what)?;
        images.push(ImageRecord::new(file, name, camera_id, q, t)?);
    }
    Ok(images)
}

pub(super) fn points(file: &Path) -> Result<Vec<Point>> {
    let mut bytes = Bytes::open(file)?;
    let count = bytes.count(51, "points")?;
    let mut points = Vec::with_capacity(count);
    for number in 1..=count {
        let what = || format!("point {number} of {count}");
        bytes.u64(&what)?;
        let position = DVec3::from(bytes.f64s::<3>(&what)?);
        let color = bytes.array(&what)?;
        bytes.f64s::<1>(&what)?; // reprojection error
        let track = bytes.count(8, "observations of a point")?;
        bytes.take(track as u64 * 8, &what)?;
        points.push(Point { position, color });
    }
    Ok(points)
}
