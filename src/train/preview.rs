//! Previews: the picture of a held-out view that a run writes from time to time, and how good it is.

use super::Trainer;
use crate::config::Config;
use crate::eval::images::{compare, keeps_any};
use crate::render::Rendered;
use crate::scene::{Camera, Picture, Scene, Split};
use crate::srgb;
use crate::{Error, Result};
use glam::DMat4;
use image::imageops::{self, FilterType};
use image::{RgbImage, RgbaImage};
use std::path::Path;

/// The view that previews show, with a camera of their size.
pub(super) struct PreviewView {
    pub view: usize,
    pub camera: Camera,
    pub world_from_camera: DMat4,
}

impl PreviewView {
    /// The middle one of the held-out views, or of all where none is held out; `None` if previews are off.
    pub fn choose(scene: &Scene, config: &Config) -> Option<PreviewView> {
        if config.report.preview_steps == 0 {
            return None;
        }
        let held_out: Vec<usize> = scene.split(Split::Test).collect();
        let view = match held_out.len() {
            0 => scene.views.len() / 2,
            count => held_out[count / 2],
        };
        let from = scene.views.get(view)?;
        Some(PreviewView {
            view,
            camera: from.camera.within(config.report.preview_pixels),
            world_from_camera: from.world_from_camera,
        })
    }
}

impl Trainer {
    /// Writes a preview: photograph, rendering and normals side by side. Returns the rendering's PSNR in dB, or `None` if there is no view or
    /// its mask keeps nothing.
    ///
    /// # Errors
    /// [`Error::Interrupted`] once `stop` says so; [`Error::Output`] if it cannot be written; whatever reading the photograph and the
    /// device fail with.
    pub(super) fn look(
        &self,
        scene: &Scene,
        path: &Path,
        stop: &mut dyn FnMut() -> bool,
    ) -> Result<Option<f64>> {
        let Some(preview) = &self.preview else {
            return Ok(None);
        };
        let size = (preview.camera.width, preview.camera.height);
        let row = self.view_order.len() as u32;
        let appearance = self.views.n_training();
        let rendered = self.render_row(row, size, appearance, &mut |_| !stop())?;
        let photo = reduced(scene.load_picture(preview.view)?, size);
        side_by_side(&rendered, &photo)
            .save(path)
            .map_err(|error| {
                Error::output(
                    path,
                    format!("cannot write this preview: {error}"),
                    "make room or mend the permissions there, then go on with --resume",
                )
            })?;
        let masked = self.config.scene.masks.reads();
        let counts = !masked || keeps_any(&photo);
        Ok(counts.then(|| compare(&rendered.rgb, &photo, masked).0))
    }
}

/// A photograph at the size of a preview.
fn reduced(photo: Picture, (width, height): (u32, u32)) -> Picture {
    let photo = RgbaImage::from_raw(photo.width, photo.height, photo.rgba)
        .expect("a picture has four bytes a pixel");
    Picture {
        width,
        height,
        rgba: imageops::resize(&photo, width, height, FilterType::Triangle).into_raw(),
    }
}

fn side_by_side(rendered: &Rendered, photo: &Picture) -> RgbImage {
    let (width, height) = (rendered.width, rendered.height);
    RgbImage::from_fn(3 * width, height, |x, y| {
        let at = (y * width + x % width) as usize;
        image::Rgb(match x / width {
            0 => [0, 1, 2].map(|c| photo.rgba[4 * at + c]),
            1 => rendered.rgb[at].map(srgb::byte),
            _ => rendered.normal[at].map(|n| srgb::byte(0.5 + 0.5 * n)),
        })
    })
}
