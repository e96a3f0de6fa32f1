//! `neurodin bias`: how far the heaviest point of a ray lies from the surface, with and without explicit bias correction.

use super::progress::Progress;
use super::scene_args::SceneArgs;
use super::settings::SettingsArgs;
use super::study::Study;
use super::{Context, interrupt, render};
use crate::Error;
use crate::config::DensityKind;
use crate::render::bias::{closed_form, on_plane};
use crate::scene::Split;
use crate::train::run_directory::RunDirectory;
use crate::train::trained::Trained;
use clap::Args;
use image::RgbImage;
use serde_json::{Value, json};
use std::fmt::Write;
use std::path::{Path, PathBuf};
use std::sync::atomic::Ordering;

/// Show how far rendered surfaces lie from the zero crossing
#[derive(Args)]
#[command(after_help = "\
Example:
  neurodin bias run --out pictures
  neurodin bias photos/ --out study --steps 2000
  neurodin bias --plane

Of a run, the rays of held-out views. Of a dataset, two runs are trained in --out, without bias correction and with it.
Distances are from the first zero crossing of a ray to its heaviest sample, in the input's units, positive behind the surface.
Pictures: red behind, blue before, white where both agree, black where a ray meets no surface.")]
#[command(group = clap::ArgGroup::new("measured").required(true).args(["source", "plane"]))]
pub(super) struct BiasArgs {
    /// Run directory, or a dataset to train two runs on
    pub source: Option<PathBuf>,
    /// A plane under angles from 0 to 85 degrees instead, beside its closed form
    #[arg(long)]
    pub plane: bool,
    /// Directory for pictures; of a dataset, for the two runs, too
    #[arg(short, long, value_name = "DIR")]
    pub out: Option<PathBuf>,
    /// Where the run's dataset is now, if it has moved
    #[arg(long, value_name = "DATASET", conflicts_with = "plane")]
    pub dataset: Option<PathBuf>,
    /// Held-out views to look at
    #[arg(long, value_name = "N", default_value_t = 2, value_parser = clap::value_parser!(u64).range(1..))]
    pub views: u64,
    /// They are reduced to at most this many pixels
    #[arg(long, value_name = "N", default_value_t = 5000, value_parser = clap::value_parser!(u64).range(16..))]
    pub pixels: u64,
    /// Samples of a ray, more than in training: the distance is known to one of them
    #[arg(long, value_name = "N", default_value_t = 256, value_parser = clap::value_parser!(u32).range(8..=4096))]
    pub samples: u32,
    #[command(flatten)]
    pub settings: SettingsArgs,
    #[command(flatten)]
    pub scene: SceneArgs,
}

pub(super) fn run(args: &BiasArgs, context: &Context) -> anyhow::Result<()> {
    let (report, text) = match &args.source {
        None => plane(context)?,
        Some(source) if RunDirectory::open(source).is_ok() => {
            compare(&[("run", source.clone())], args, context)?
        }
        Some(dataset) => {
            let runs = train_both(dataset, args, context)?;
            compare(&runs, args, context)?
        }
    };
    Ok(context.result(&report, text.trim_end())?)
}

fn plane(context: &Context) -> anyhow::Result<(Value, String)> {
    let gpu = context.gpu()?;
    let degrees: Vec<f64> = (0..=17).map(|i| 5.0 * f64::from(i)).collect();
    let cosines: Vec<f64> = degrees.iter().map(|d| d.to_radians().cos()).collect();
    let mut text = String::from(
        "distance of the heaviest point behind a plane, in units of beta: measured (closed form)\n\
         angle      density of the distance      along the line of sight\n",
    );
    let densities = [DensityKind::Laplace, DensityKind::Sight];
    let measured = [
        on_plane(&gpu, densities[0], &cosines)?,
        on_plane(&gpu, densities[1], &cosines)?,
    ];
    let mut rows = Vec::new();
    for (i, angle) in degrees.iter().enumerate() {
        let known = densities.map(|density| closed_form(density, cosines[i]).unwrap_or(f64::NAN));
        let _ = writeln!(
            text,
            "{angle:4}°  {:12.4} ({:8.4})  {:16.4} ({:8.4})",
            measured[0][i], known[0], measured[1][i], known[1]
        );
        rows.push(json!({
            "degrees": angle,
            "laplace": { "measured": measured[0][i], "closed_form": known[0] },
            "sight": { "measured": measured[1][i], "closed_form": known[1] },
        }));
    }
    Ok((json!({ "unit": "beta", "plane": rows }), text))
}

/// Trains stage 1 on a dataset without bias correction and with it; a run that is there already goes on, or is taken as it is.
fn train_both(
    dataset: &Path,
    args: &BiasArgs,
    context: &Context,
) -> anyhow::Result<Vec<(&'static str, PathBuf)>> {
    let Some(out) = &args.out else {
        return Err(Error::Config {
            what: format!(
                "{}: is no run directory; as a dataset it needs --out, the directory for two runs on it",
                dataset.display()
            ),
        }
        .into());
    };
    let mut study = Study::open(dataset, &args.settings, &args.scene)?;
    study.settings.stage = Some(1);
    study.check_held_out("distances are those of rays of held-out views")?;
    let mut planned = Vec::new();
    for (name, method) in [("without", "ablation-c"), ("with", "neurodin")] {
        let run = study.plan(out.join(name), method, 0)?;
        run.check()?;
        planned.push((name, run));
    }
    let mut runs = Vec::new();
    for (name, run) in planned {
        let place = run.run.display();
        context.say(&format!("\n{name} bias correction: {place}"));
        run.train(context)?;
        runs.push((name, run.run));
    }
    Ok(runs)
}

/// What the rays of a run's views say.
struct Measured {
    name: &'static str,
    run: PathBuf,
    step: u64,
    views: Vec<ViewBias>,
}

/// One view: its rays' distances, row by row.
struct ViewBias {
    name: String,
    size: (u32, u32),
    distances: Vec<Option<f64>>,
}

impl Measured {
    /// Distances of the rays that meet the surface, in ascending order.
    fn sorted(&self) -> Vec<f64> {
        let rays = self.views.iter().flat_map(|view| &view.distances);
        let mut met: Vec<f64> = rays.copied().flatten().collect();
        met.sort_by(f64::total_cmp);
        met
    }
}

fn compare(
    runs: &[(&'static str, PathBuf)],
    args: &BiasArgs,
    context: &Context,
) -> anyhow::Result<(Value, String)> {
    let mut measured = Vec::new();
    for (name, run) in runs {
        measured.push(measure(name, run, args, context)?);
    }
    // One scale for all of them: what 95 % of the worst run's rays stay within.
    let limit = measured
        .iter()
        .map(|of| {
            let mut sizes: Vec<f64> = of.sorted().iter().map(|d| d.abs()).collect();
            sizes.sort_by(f64::total_cmp);
            share(&sizes, 0.95).unwrap_or(0.0)
        })
        .fold(f64::MIN_POSITIVE, f64::max);
    let mut text = String::new();
    let mut reports = Vec::new();
    for of in &measured {
        let sorted = of.sorted();
        if sorted.is_empty() {
            return Err(Error::input(
                &of.run,
                "no ray of these views meets a zero crossing",
                "look at the previews, and train longer; --views looks at more of them",
            )
            .into());
        }
        let counts = histogram(&sorted, limit);
        let quantiles = [0.05, 0.25, 0.5, 0.75, 0.95].map(|q| share(&sorted, q).unwrap_or(0.0));
        let mean_size = sorted.iter().map(|d| d.abs()).sum::<f64>() / sorted.len() as f64;
        let _ = writeln!(
            text,
            "\n{} ({}, step {}): {} rays meet the surface; |distance| {mean_size:.3e} in the mean; 5, 25, 50, 75, 95 %: {}",
            of.name,
            of.run.display(),
            of.step,
            sorted.len(),
            quantiles.map(|q| format!("{q:.2e}")).join(", ")
        );
        draw(&counts, limit, &mut text);
        let mut pictures = Vec::new();
        if let Some(out) = &args.out {
            std::fs::create_dir_all(out).map_err(|e| Error::unwritable(out, &e))?;
            for view in &of.views {
                let path = out.join(format!("{}.{}.bias.png", view.name, of.name));
                picture(&view.distances, view.size, limit)
                    .save(&path)
                    .map_err(|error| Error::unwritable(&path, &error))?;
                pictures.push(path);
            }
        }
        reports.push(json!({
            "name": of.name,
            "run": of.run,
            "step": of.step,
            "rays": sorted.len(),
            "mean_absolute": mean_size,
            "quantiles": { "0.05": quantiles[0], "0.25": quantiles[1], "0.5": quantiles[2], "0.75": quantiles[3], "0.95": quantiles[4] },
            "histogram": { "from": -limit, "to": limit, "counts": counts },
            "pictures": pictures,
        }));
    }
    Ok((json!({ "runs": reports }), text))
}

fn measure(
    name: &'static str,
    run: &Path,
    args: &BiasArgs,
    context: &Context,
) -> anyhow::Result<Measured> {
    let directory = RunDirectory::open(run)?;
    let gpu = context.gpu()?;
    let trained = Trained::open(&gpu, &directory)?;
    let moved = args.dataset.as_deref();
    let mut scene = trained.record.open(moved, trained.config())?;
    let views: Vec<usize> = scene.split(Split::Test).take(args.views as usize).collect();
    if views.is_empty() {
        let next = "train with a --holdout of at most half as many as there are views";
        return Err(Error::input(run, "no view was held out", next).into());
    }
    for &view in &views {
        let camera = &mut scene.views[view].camera;
        *camera = camera.within(args.pixels);
    }
    let names = render::file_names(&scene);
    // As many samples at once as in training.
    let config = trained.config();
    let rays = (config.rays * config.sampling.samples / args.samples).max(8);
    let viewer = trained.fine_viewer(&scene, rays, args.samples)?;
    let interrupted = interrupt::flag(context, "stopping")?;
    let mut progress = Progress::new(context, "bias", 100 * views.len() as u64);
    let mut measured = Vec::new();
    for (nth, &view) in views.iter().enumerate() {
        let distances = viewer.bias(&scene, view, &mut |share| {
            progress.at(100 * nth as u64 + (100.0 * share) as u64, &names[view]);
            !interrupted.load(Ordering::SeqCst)
        })?;
        let camera = &scene.views[view].camera;
        measured.push(ViewBias {
            name: names[view].clone(),
            size: (camera.width, camera.height),
            distances,
        });
    }
    Ok(Measured {
        name,
        run: run.into(),
        step: trained.step,
        views: measured,
    })
}

/// The value that a share of the sorted ones stay below.
fn share(sorted: &[f64], share: f64) -> Option<f64> {
    let last = sorted.len().checked_sub(1)?;
    sorted.get((share * last as f64).round() as usize).copied()
}

/// Bins of the histogram; the outermost hold all that is beyond them.
const BINS: usize = 21;

fn histogram(distances: &[f64], limit: f64) -> [usize; BINS] {
    let mut counts = [0; BINS];
    for distance in distances {
        let at = (distance / limit + 1.0) * 0.5 * BINS as f64;
        counts[(at.max(0.0) as usize).min(BINS - 1)] += 1;
    }
    counts
}

fn draw(counts: &[usize; BINS], limit: f64, text: &mut String) {
    const WIDTH: usize = 60;
    let most = counts.iter().copied().max().unwrap_or(1).max(1);
    for (bin, count) in counts.iter().enumerate() {
        let middle = limit * ((2 * bin + 1) as f64 / BINS as f64 - 1.0);
        let bar = "#".repeat(count * WIDTH / most);
        let _ = writeln!(text, "  {middle:+.2e} {bar:<WIDTH$} {count}");
    }
}

fn picture(distances: &[Option<f64>], (width, height): (u32, u32), limit: f64) -> RgbImage {
    RgbImage::from_fn(width, height, |x, y| {
        let color = match distances[(y * width + x) as usize] {
            None => [0; 3],
            Some(distance) => {
                let amount = (distance / limit).clamp(-1.0, 1.0);
                let rest = (255.0 * (1.0 - amount.abs())).round() as u8;
                match amount > 0.0 {
                    true => [255, rest, rest],
                    false => [rest, rest, 255],
                }
            }
        };
        image::Rgb(color)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_histogram_is_centred_and_loses_nothing() {
        let counts = histogram(&[-9.0, -0.99, -0.01, 0.0, 0.01, 0.99, 9.0], 1.0);
        assert_eq!(counts.iter().sum::<usize>(), 7);
        assert_eq!((counts[0], counts[BINS / 2], counts[BINS - 1]), (2, 3, 2));
    }

    #[test]
    fn pictures_tell_before_from_behind() {
        let picture = picture(&[Some(1.0), Some(-1.0), Some(0.0), None], (2, 2), 1.0);
        let at = |x, y| picture.get_pixel(x, y).0;
        assert_eq!([at(0, 0), at(1, 0)], [[255, 0, 0], [0, 0, 255]]);
        assert_eq!([at(0, 1), at(1, 1)], [[255; 3], [0; 3]]);
    }
}
