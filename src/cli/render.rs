//! `neurodin render`: views of a dataset as a run sees them: pictures, depths, normals.

use super::progress::Progress;
use super::{Context, interrupt};
use crate::config::{AppearanceAtEval, nearest};
use crate::render::Rendered;
use crate::scene::{Camera, Scene, Split};
use crate::srgb::byte;
use crate::train::run_directory::RunDirectory;
use crate::train::trained::Trained;
use crate::{Error, Result};
use clap::{Args, ValueEnum};
use exr::prelude::{Encoding, Image, SpecificChannels, WritableImage};
use glam::DVec2;
use image::{GrayImage, RgbImage};
use serde_json::json;
use std::collections::HashSet;
use std::path::{Path, PathBuf};
use std::sync::atomic::Ordering;

/// Render views of a run
#[derive(Args)]
#[command(after_help = "\
Example:
  neurodin render run --split test --out pictures
  neurodin render run --split all --out pictures --what rgb,depth,normal
  neurodin render run --view DSC_0042 --out pictures

Files are named after the views: VIEW.png, VIEW.depth.png, VIEW.depth.exr, VIEW.normal.png, VIEW.normal.exr.
Depth in EXR is along the optical axis in the input's units, 0 where nothing is; in PNG, near is bright.
Normals are in the input's axes; in PNG, -1 to 1 becomes 0 to 255.")]
pub(super) struct RenderArgs {
    /// Run directory, as `neurodin train --out` wrote it
    pub run: PathBuf,
    /// Which views
    #[arg(long, value_enum, default_value_t, value_name = "SPLIT")]
    pub split: Which,
    /// These views alone, of whichever split, by the names that their files get; commas between
    #[arg(
        long = "view",
        value_name = "NAME",
        value_delimiter = ',',
        conflicts_with = "split"
    )]
    pub views: Vec<String>,
    /// Directory to write to
    #[arg(short, long, value_name = "DIR")]
    pub out: PathBuf,
    /// What of them, with commas between
    #[arg(
        long,
        value_enum,
        value_name = "WHAT",
        value_delimiter = ',',
        default_value = "rgb"
    )]
    pub what: Vec<What>,
    /// Divide width and height by this
    #[arg(long, value_name = "FACTOR", default_value_t = 1.0, value_parser = at_least_one)]
    pub downscale: f64,
    /// Appearance code [default: as the run's settings say]
    #[arg(long, value_enum, value_name = "CODE")]
    pub appearance: Option<Appearance>,
    /// Where the dataset is now, if it has moved
    #[arg(long, value_name = "DATASET")]
    pub dataset: Option<PathBuf>,
    /// Write into a directory that is not empty, over files of the same names
    #[arg(long)]
    pub force: bool,
}

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub enum Which {
    /// Held-out views
    #[default]
    Test,
    /// Views that were trained with
    Train,
    All,
}

impl Which {
    /// The views of a scene that are meant.
    pub fn of(self, scene: &Scene) -> Vec<usize> {
        match self {
            Which::Test => scene.split(Split::Test).collect(),
            Which::Train => scene.split(Split::Train).collect(),
            Which::All => (0..scene.views.len()).collect(),
        }
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(super) enum What {
    Rgb,
    Depth,
    Normal,
}

/// Appearance codes by the names that settings give them.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Appearance {
    Zero,
    Mean,
    /// The view's own, where it was trained with
    Frame,
}

impl From<Appearance> for AppearanceAtEval {
    fn from(appearance: Appearance) -> Self {
        match appearance {
            Appearance::Zero => AppearanceAtEval::Zero,
            Appearance::Mean => AppearanceAtEval::Mean,
            Appearance::Frame => AppearanceAtEval::Frame,
        }
    }
}

fn at_least_one(text: &str) -> Result<f64, String> {
    match text.parse() {
        Ok(factor) if (1.0..=64.0).contains(&factor) => Ok(factor),
        _ => Err("expected a number from 1 to 64".into()),
    }
}

pub(super) fn run(args: &RenderArgs, context: &Context) -> anyhow::Result<()> {
    let run = RunDirectory::open(&args.run)?;
    check_destination(&args.out, args.force)?;
    let gpu = context.gpu()?;
    let trained = Trained::open(&gpu, &run)?;
    for refused in &trained.refused {
        context.warn(&refused.to_string());
    }
    let mut scene = trained
        .record
        .open(args.dataset.as_deref(), trained.config())?;
    let reduced = |size: u32| ((f64::from(size) / args.downscale).round() as u32).max(1);
    for view in &mut scene.views {
        view.camera = view
            .camera
            .scaled(reduced(view.camera.width), reduced(view.camera.height));
    }
    let names = file_names(&scene);
    let wanted = match args.views.is_empty() {
        true => args.split.of(&scene),
        false => views_named(&args.views, &names)?,
    };
    if wanted.is_empty() {
        return Err(Error::Config {
            what: format!(
                "{}: there are no such views to render\n  next: --split train or --split all",
                run.root().display()
            ),
        }
        .into());
    }
    std::fs::create_dir_all(&args.out).map_err(|error| {
        Error::output(
            &args.out,
            format!("cannot be made: {error}"),
            "give another --out",
        )
    })?;
    let usual = trained.config().appearance.at_eval;
    let viewer = trained.viewer(&scene, args.appearance.map_or(usual, Into::into))?;
    let interrupted = interrupt::flag(context, "stopping after what is written")?;
    let pixels = |view: usize| {
        let camera = &scene.views[view].camera;
        u64::from(camera.width) * u64::from(camera.height)
    };
    let total = wanted.iter().map(|&view| pixels(view)).sum();
    let mut progress = Progress::new(context, "render", total);
    let (mut done, mut files) = (0, Vec::new());
    for (nth, &view) in wanted.iter().enumerate() {
        let note = format!("view {} of {}", nth + 1, wanted.len());
        let rendered = viewer.render(&scene, view, &mut |share| {
            progress.at(done + (share * pixels(view) as f64) as u64, &note);
            !interrupted.load(Ordering::SeqCst)
        })?;
        done += pixels(view);
        let camera = &scene.views[view].camera;
        for what in &args.what {
            files.extend(write(
                *what,
                &rendered,
                camera,
                trained.region.radius,
                &args.out.join(&names[view]),
            )?);
        }
    }
    drop(progress);
    let text = format!(
        "done     {} views, {} files in {}",
        wanted.len(),
        files.len(),
        args.out.display()
    );
    let result = json!({
        "views": wanted.iter().map(|&view| &scene.views[view].name).collect::<Vec<_>>(),
        "files": files,
        "step": trained.step,
    });
    Ok(context.result(&result, &text)?)
}

fn check_destination(out: &Path, force: bool) -> Result<()> {
    let occupied = std::fs::read_dir(out).is_ok_and(|mut entries| entries.next().is_some());
    if out.is_file() {
        Err(Error::output(out, "is a file", "name a directory"))
    } else if occupied && !force {
        Err(Error::output(
            out,
            "exists and is not empty",
            "give another --out, or --force to write over files of the same names",
        ))
    } else {
        Ok(())
    }
}

/// The views whose files get these names.
///
/// # Errors
/// [`Error::Config`] for a name that none has, with the nearest one.
fn views_named(wanted: &[String], names: &[String]) -> Result<Vec<usize>> {
    let find = |name: &String| {
        names.iter().position(|own| own == name).ok_or_else(|| {
            let next = match nearest(name, names.iter().map(String::as_str)) {
                Some(own) => format!("did you mean \"{own}\"?"),
                None => format!("there are {}, from \"{}\" on", names.len(), names[0]),
            };
            Error::Config {
                what: format!(
                    "--view {name}: no view of the dataset has this name\n  next: {next}"
                ),
            }
        })
    };
    wanted.iter().map(find).collect()
}

/// A file name without extension for each view: the picture's own, or with its folders where those are not all different.
pub(super) fn file_names(scene: &Scene) -> Vec<String> {
    let stem = |name: &str| {
        let path = Path::new(name);
        path.file_stem()
            .map_or_else(|| name.into(), |stem| stem.to_string_lossy().into_owned())
    };
    let short: Vec<String> = scene.views.iter().map(|view| stem(&view.name)).collect();
    if short.iter().collect::<HashSet<_>>().len() == short.len() {
        return short;
    }
    scene
        .views
        .iter()
        .map(|view| {
            view.name
                .replace(['/', '\\', ':'], "_")
                .trim_start_matches('.')
                .into()
        })
        .collect()
}

/// Writes one kind of picture beside `stem` and returns its files.
fn write(
    what: What,
    rendered: &Rendered,
    camera: &Camera,
    radius: f64,
    stem: &Path,
) -> Result<Vec<PathBuf>> {
    let (width, height) = (rendered.width, rendered.height);
    let size = (width as usize, height as usize);
    let named = |ending: &str| {
        let mut name = stem.as_os_str().to_owned();
        name.push(ending);
        PathBuf::from(name)
    };
    let at = |x: u32, y: u32| (y * width + x) as usize;
    match what {
        What::Rgb => {
            let path = named(".png");
            RgbImage::from_fn(width, height, |x, y| {
                image::Rgb(rendered.rgb[at(x, y)].map(byte))
            })
            .save(&path)
            .map_err(|error| Error::unwritable(&path, &error))?;
            Ok(vec![path])
        }
        What::Depth => {
            let depths = depths(rendered, camera, radius);
            let (exr, png) = (named(".depth.exr"), named(".depth.png"));
            let channels = SpecificChannels::build()
                .with_channel("Z")
                .with_pixel_fn(|at| (depths[at.y() * size.0 + at.x()],));
            Image::from_encoded_channels(size, Encoding::FAST_LOSSLESS, channels)
                .write()
                .to_file(&exr)
                .map_err(|error| Error::unwritable(&exr, &error))?;
            let there = depths.iter().copied().filter(|depth| *depth > 0.0);
            let (near, far) = there.fold((f32::INFINITY, 0.0f32), |(near, far), depth| {
                (near.min(depth), far.max(depth))
            });
            GrayImage::from_fn(width, height, |x, y| {
                let depth = depths[at(x, y)];
                image::Luma([match depth > 0.0 {
                    true => byte(1.0 - 0.9 * (depth - near) / (far - near).max(f32::MIN_POSITIVE)),
                    false => 0,
                }])
            })
            .save(&png)
            .map_err(|error| Error::unwritable(&png, &error))?;
            Ok(vec![exr, png])
        }
        What::Normal => {
            let (exr, png) = (named(".normal.exr"), named(".normal.png"));
            let channels = SpecificChannels::build()
                .with_channel("X")
                .with_channel("Y")
                .with_channel("Z")
                .with_pixel_fn(|at| {
                    let [x, y, z] = rendered.normal[at.y() * size.0 + at.x()];
                    (x, y, z)
                });
            Image::from_encoded_channels(size, Encoding::FAST_LOSSLESS, channels)
                .write()
                .to_file(&exr)
                .map_err(|error| Error::unwritable(&exr, &error))?;
            RgbImage::from_fn(width, height, |x, y| {
                image::Rgb(rendered.normal[at(x, y)].map(|n| byte(0.5 + 0.5 * n)))
            })
            .save(&png)
            .map_err(|error| Error::unwritable(&png, &error))?;
            Ok(vec![exr, png])
        }
    }
}

/// Below this accumulated weight a pixel shows the background.
const MATTER: f32 = 0.5;

/// Depth of each pixel along the optical axis, in the input's units; 0 where there is no surface.
fn depths(rendered: &Rendered, camera: &Camera, radius: f64) -> Vec<f32> {
    let along_axis = |index: usize| {
        let (x, y) = (index as u32 % rendered.width, index as u32 / rendered.width);
        let pixel = DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5);
        -camera.direction(pixel).normalize().z
    };
    (0..rendered.depth.len())
        .map(|index| match rendered.accumulation[index] >= MATTER {
            true => (f64::from(rendered.depth[index]) * radius * along_axis(index)) as f32,
            false => 0.0,
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::CameraModel;

    /// A wall across the optical axis has one depth, however far its corners are along their rays.
    #[test]
    fn depth_is_along_the_axis() {
        let camera = Camera {
            model: CameraModel::Pinhole,
            width: 8,
            height: 6,
            params: vec![4.0, 4.0, 4.0, 3.0],
        };
        let distance = |index: u32| {
            let (x, y) = (f64::from(index % 8) + 0.5, f64::from(index / 8) + 0.5);
            camera.direction(DVec2::new(x, y)).length() as f32 * 0.75
        };
        let mut rendered = Rendered {
            width: 8,
            height: 6,
            rgb: Vec::new(),
            depth: (0..48).map(distance).collect(),
            normal: Vec::new(),
            accumulation: vec![1.0; 48],
        };
        rendered.accumulation[7] = 0.1;
        for (index, depth) in depths(&rendered, &camera, 2.0).into_iter().enumerate() {
            let expected = if index == 7 { 0.0 } else { 1.5 };
            assert!((depth - expected).abs() < 1e-6, "{index}: {depth}");
        }
    }
}
