//! What a dataset knows of its pictures beforehand: depths and normals as arrays beside them, and object masks that hold something.
//!
//! sdfstudio's files: depths `[height, width]`, along the optical axis (z-depth); a sensor's in units of the cameras' world, 0 where it
//! measured none; a monocular one in any unit. Normals `[3, height, width]` in OpenCV's camera axes (x right, y down, z forward), towards
//! the camera, stored as (n + 1)/2.

use std::path::PathBuf;

use super::images::proportional;
use super::{Picture, Scene, View};
use crate::arrays::Arrays;
use crate::{Error, Result};

/// A kind of prior.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PriorKind {
    MonoDepth,
    MonoNormal,
    SensorDepth,
}

impl PriorKind {
    pub const ALL: [PriorKind; 3] = [
        PriorKind::MonoDepth,
        PriorKind::MonoNormal,
        PriorKind::SensorDepth,
    ];

    /// Its key in a frame of meta_data.json.
    pub fn key(self) -> &'static str {
        match self {
            PriorKind::MonoDepth => "mono_depth_path",
            PriorKind::MonoNormal => "mono_normal_path",
            PriorKind::SensorDepth => "sensor_depth_path",
        }
    }

    /// The setting that makes use of it.
    pub fn setting(self) -> &'static str {
        match self {
            PriorKind::MonoDepth => "loss.mono_depth",
            PriorKind::MonoNormal => "loss.mono_normal",
            PriorKind::SensorDepth => "loss.sensor_depth",
        }
    }

    /// Numbers per pixel.
    fn channels(self) -> usize {
        match self {
            PriorKind::MonoNormal => 3,
            _ => 1,
        }
    }
}

/// The files of a view's priors, in the order of [`PriorKind::ALL`].
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct PriorPaths(pub [Option<PathBuf>; 3]);

impl PriorPaths {
    /// The file of one kind.
    pub fn of(&self, kind: PriorKind) -> Option<&PathBuf> {
        self.0[kind as usize].as_ref()
    }
}

/// A prior in memory.
#[derive(Clone, Debug, PartialEq)]
pub struct Prior {
    pub width: u32,
    pub height: u32,
    /// `[channels, height, width]`: a monocular depth, not finite where unknown; a sensor's depth in the world's units, 0 where unknown;
    /// a unit normal in the camera's own axes (x right, y up, z backward), zero where unknown.
    pub values: Vec<f32>,
}

impl Scene {
    /// Reads a prior of view number `view`.
    ///
    /// # Errors
    /// [`Error::Input`] if the view has none, or one that is no prior of its picture.
    pub fn load_prior(&self, view: usize, kind: PriorKind) -> Result<Prior> {
        load(self, &self.views[view], kind)
    }
}

fn load(scene: &Scene, view: &View, kind: PriorKind) -> Result<Prior> {
    let (key, setting) = (kind.key(), kind.setting());
    let Some(file) = view.priors.of(kind) else {
        let with = |view: &&View| view.priors.of(kind).is_some();
        return Err(Error::input(
            &scene.root,
            format!(
                "{setting} takes a {key} from every training view, but {} has none; {} of {} views have one",
                view.name,
                scene.views.iter().filter(with).count(),
                scene.views.len()
            ),
            format!(
                "add them to the dataset's meta_data.json (sdfstudio's layout), or train with {setting}=0"
            ),
        ));
    };
    let array = Arrays::open(file)?.numbers(key)?;
    // Axes of length 1 beside height and width say nothing.
    let sides: Vec<usize> = match (kind.channels(), &array.shape[..]) {
        (1, shape) => shape.iter().copied().filter(|&side| side != 1).collect(),
        (_, [3, rest @ ..]) => rest.to_vec(),
        _ => Vec::new(),
    };
    let wrong = |what: String| {
        let next = format!("compute it again from the picture, or train with {setting}=0");
        Error::input(file, what, next)
    };
    let (&[height, width], expected) = (&sides[..], (view.camera.width, view.camera.height)) else {
        let expected = match kind.channels() {
            1 => "[height, width]",
            _ => "[3, height, width]",
        };
        let shape = &array.shape;
        return Err(wrong(format!(
            "has the shape {shape:?}, not {expected} as a {key} has"
        )));
    };
    let size = (width as u32, height as u32);
    if width == 0 || height == 0 || !proportional(size, expected) {
        return Err(wrong(format!(
            "the prior has {width}x{height} pixels, its picture {} {}x{}, of which it is no scaled version",
            view.image_path.display(),
            expected.0,
            expected.1
        )));
    }
    let values = match kind {
        PriorKind::MonoDepth => array.values.iter().map(|&depth| depth as f32).collect(),
        PriorKind::SensorDepth => {
            let known = |depth: f64| depth > 0.0 && (depth as f32).is_finite();
            let depths = array.values.iter();
            depths
                .map(|&depth| if known(depth) { depth as f32 } else { 0.0 })
                .collect()
        }
        PriorKind::MonoNormal => camera_normals(&array.values).map_err(wrong)?,
    };
    let known = match kind {
        PriorKind::MonoDepth => values.iter().any(|depth: &f32| depth.is_finite()),
        _ => values.iter().any(|&value| value != 0.0),
    };
    if !known {
        return Err(wrong("holds no value for any pixel".into()));
    }
    Ok(Prior {
        width: size.0,
        height: size.1,
        values,
    })
}

/// Unit normals in OpenGL's camera axes from (n + 1)/2 in OpenCV's.
fn camera_normals(stored: &[f64]) -> std::result::Result<Vec<f32>, String> {
    // Interpolation may leave the range a little; normals that were never encoded leave it by far.
    if let Some(&value) = stored
        .iter()
        .find(|&&v| !(-0.01..=1.01).contains(&v) && v.is_finite())
    {
        return Err(format!(
            "holds {value:.3}: normals are stored as (n + 1)/2, between 0 and 1"
        ));
    }
    let size = stored.len() / 3;
    let mut values = vec![0.0; stored.len()];
    for pixel in 0..size {
        let n = [0, 1, 2].map(|axis| 2.0 * stored[axis * size + pixel] - 1.0);
        let length = n.iter().map(|n| n * n).sum::<f64>().sqrt();
        if length.is_finite() && length > 1e-6 {
            for (axis, sign) in [1.0, -1.0, -1.0].into_iter().enumerate() {
                values[axis * size + pixel] = (sign * n[axis] / length) as f32;
            }
        }
    }
    Ok(values)
}

/// Looks at object masks while their pictures are read: one that is empty would have the object carved away, none at all would fill space.
#[derive(Debug, Default)]
pub struct ObjectMasks {
    hides: bool,
    shows: bool,
}

impl ObjectMasks {
    /// Looks at one view's.
    ///
    /// # Errors
    /// [`Error::Input`] if no pixel is of the object.
    pub fn look(&mut self, view: &View, picture: &Picture) -> Result<()> {
        let pixels = picture.rgba.len() / 4;
        let object = picture.rgba.chunks_exact(4).filter(|p| p[3] >= 128).count();
        if object == 0 {
            let file = view.mask_path.as_ref().unwrap_or(&view.image_path);
            return Err(Error::input(
                file,
                format!(
                    "the object mask of {} is empty: none of {pixels} pixels is marked",
                    view.name
                ),
                "mark the object in white, take the view out of the dataset, or train with scene.masks=\"exclude\" or \"ignore\"",
            ));
        }
        self.note(object, pixels);
        Ok(())
    }

    /// Looks at one view's, which may leave nothing of it.
    pub fn look_at_any(&mut self, picture: &Picture) {
        let shown = picture.rgba.chunks_exact(4).filter(|p| p[3] >= 128).count();
        self.note(shown, picture.rgba.len() / 4);
    }

    fn note(&mut self, shown: usize, pixels: usize) {
        self.hides |= shown < pixels;
        self.shows |= shown > 0;
    }

    /// # Errors
    /// [`Error::Input`] if none of those that were looked at leaves a pixel to train on.
    pub fn check_anything_is_left(&self, scene: &Scene) -> Result<()> {
        if self.shows {
            return Ok(());
        }
        Err(Error::input(
            &scene.root,
            "the masks of all training views leave no pixel to train on",
            "masks are white where a picture counts: invert them, or train with scene.masks=\"ignore\"",
        ))
    }

    /// # Errors
    /// [`Error::Input`] if none of those that were looked at leaves a pixel out.
    pub fn check(&self, scene: &Scene) -> Result<()> {
        if self.hides {
            return Ok(());
        }
        Err(Error::input(
            &scene.root,
            "loss.mask takes object masks or alpha channels, but those of all training views cover their whole pictures, or there are none",
            "add masks/ beside the pictures' folder, or train with loss.mask=0",
        ))
    }
}
