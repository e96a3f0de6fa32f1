//! The picture half of `neurodin eval`: PSNR and SSIM of a run's held-out views.

use super::EvalArgs;
use crate::Error;
use crate::cli::progress::Progress;
use crate::cli::{Context, interrupt};
use crate::eval::images::{psnr, ssim};
use crate::render::Rendered;
use crate::scene::{Picture, Split};
use crate::train::run_directory::RunDirectory;
use crate::train::trained::Trained;
use serde_json::{Value, json};
use std::fmt::Write;
use std::path::Path;
use std::sync::atomic::Ordering;

/// Renders the held-out views of a run and compares them with their photographs: the report for programs, and the one for people.
///
/// # Errors
/// Those of reading run and dataset; `Config` if no view was held out; whatever the device fails with.
pub(super) fn score(
    run: &Path,
    args: &EvalArgs,
    context: &Context,
) -> anyhow::Result<(Value, String)> {
    let run = RunDirectory::open(run)?;
    let gpu = context.gpu()?;
    let mut trained = Trained::open(&gpu, &run)?;
    if let Some(appearance) = args.appearance {
        trained.config.appearance.at_eval = appearance.into();
    }
    for refused in &trained.refused {
        context.warn(&refused.to_string());
    }
    let scene = trained
        .record
        .open(args.dataset.as_deref(), &trained.config)?;
    let held_out: Vec<usize> = scene.split(Split::Test).collect();
    if held_out.is_empty() {
        return Err(Error::Config {
            what: format!(
                "{}: no view was held out, so there is nothing to compare with\n  next: train with --holdout 8",
                run.root().display()
            ),
        }
        .into());
    }
    let viewer = trained.viewer(&scene)?;
    let interrupted = interrupt::flag("stopping")?;
    let masked = trained.config.scene.masks.reads();
    let mut progress = Progress::new(context, "eval", 100 * held_out.len() as u64);
    let mut scores = Vec::new();
    for (nth, &view) in held_out.iter().enumerate() {
        let name = &scene.views[view].name;
        let rendered = viewer.render(&scene, view, &mut |share| {
            progress.at(100 * nth as u64 + (100.0 * share) as u64, name);
            !interrupted.load(Ordering::SeqCst)
        })?;
        let picture = scene.load_picture(view)?;
        let (psnr, ssim) = compare(&rendered, &picture, masked);
        scores.push((name, psnr, ssim));
    }
    drop(progress);
    let mean = |present: Vec<f64>| {
        (!present.is_empty()).then(|| present.iter().sum::<f64>() / present.len() as f64)
    };
    let mean_psnr = mean(scores.iter().map(|(_, psnr, _)| *psnr).collect());
    let mean_ssim = mean(scores.iter().filter_map(|(.., ssim)| *ssim).collect());
    let in_words =
        |ssim: Option<f64>| ssim.map_or("too small for SSIM".into(), |ssim| format!("{ssim:.4}"));
    let mut text = String::new();
    let width = scores
        .iter()
        .map(|(name, ..)| name.len())
        .max()
        .unwrap_or(0);
    for (name, psnr, ssim) in &scores {
        let _ = writeln!(text, "{name:<width$}  {psnr:6.2} dB  {}", in_words(*ssim));
    }
    let _ = write!(
        text,
        "{:<width$}  {:6.2} dB  {}",
        "mean",
        mean_psnr.unwrap_or(f64::NAN),
        in_words(mean_ssim)
    );
    let report = json!({
        "run": run.root(),
        "step": trained.step,
        "appearance": trained.config.appearance.at_eval,
        "psnr": mean_psnr,
        "ssim": mean_ssim,
        "views": scores
            .iter()
            .map(|(name, psnr, ssim)| json!({ "name": name, "psnr": psnr, "ssim": ssim }))
            .collect::<Vec<_>>(),
    });
    Ok((report, text))
}

/// PSNR and SSIM of a rendering; with `masked`, of what its mask keeps.
fn compare(rendered: &Rendered, picture: &Picture, masked: bool) -> (f64, Option<f64>) {
    let counts = |pixel: &[u8]| !masked || pixel[3] >= 128;
    let photo: Vec<f32> = picture
        .rgba
        .chunks_exact(4)
        .flat_map(|pixel| [0, 1, 2].map(|c| f32::from(pixel[c]) / 255.0))
        .collect();
    // What does not count is made equal, and left out of the mean.
    let ours: Vec<f32> = rendered
        .rgb
        .iter()
        .zip(picture.rgba.chunks_exact(4))
        .flat_map(|(rgb, pixel)| {
            [0, 1, 2].map(|c| match counts(pixel) {
                true => rgb[c].clamp(0.0, 1.0),
                false => f32::from(pixel[c]) / 255.0,
            })
        })
        .collect();
    let counted = picture
        .rgba
        .chunks_exact(4)
        .filter(|pixel| counts(pixel))
        .count();
    let share = counted as f64 / rendered.rgb.len() as f64;
    let (width, height) = (picture.width as usize, picture.height as usize);
    (
        psnr(&ours, &photo) + 10.0 * share.log10(),
        ssim(&ours, &photo, width, height, 3),
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A rendering that is 0.1 off where the mask keeps it and wrong elsewhere has 20 dB.
    #[test]
    fn what_is_masked_out_does_not_count() {
        let rendered = Rendered {
            width: 4,
            height: 2,
            rgb: (0..8)
                .map(|i| if i < 4 { [0.5; 3] } else { [1.0; 3] })
                .collect(),
            depth: Vec::new(),
            normal: Vec::new(),
            accumulation: Vec::new(),
        };
        let picture = Picture {
            width: 4,
            height: 2,
            rgba: (0..8)
                .flat_map(|i| if i < 4 { [102, 102, 102, 255] } else { [0; 4] })
                .collect(),
        };
        let (masked, _) = compare(&rendered, &picture, true);
        assert!((masked - 20.0).abs() < 1e-3, "{masked}");
        let (whole, ssim) = compare(&rendered, &picture, false);
        assert!(
            (whole + 10.0 * (0.5f64 * 0.01 + 0.5).log10()).abs() < 1e-3,
            "{whole}"
        );
        assert_eq!(ssim, None, "too small for a window");
    }
}
