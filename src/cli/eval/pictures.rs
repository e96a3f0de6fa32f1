//! The picture half of `neurodin eval`: PSNR and SSIM of a run's views.

use crate::Error;
use crate::cli::progress::Progress;
use crate::cli::render::Which;
use crate::cli::{Context, interrupt};
use crate::config::AppearanceAtEval;
use crate::eval::images::{compare, keeps_any};
use crate::render::Rendered;
use crate::scene::{Picture, Split};
use crate::train::run_directory::RunDirectory;
use crate::train::trained::Trained;
use serde_json::{Value, json};
use std::fmt::Write;
use std::path::{Path, PathBuf};
use std::sync::atomic::Ordering;

/// How well a run renders its views.
pub(in crate::cli) struct PictureScores {
    run: PathBuf,
    step: u64,
    appearance: AppearanceAtEval,
    pub views: Vec<ViewScore>,
    /// Names of the views of which the mask keeps nothing: they have no scores.
    masked_out: Vec<String>,
}

/// How alike a view's rendering and photograph are.
pub(in crate::cli) struct ViewScore {
    pub name: String,
    /// In dB.
    pub psnr: f64,
    /// `None` for pictures that are too small for it, or of which the mask keeps too little.
    pub ssim: Option<f64>,
}

impl PictureScores {
    /// Compares a view's rendering with its photograph; with `masked`, what the photograph's mask keeps of it. False if that is nothing.
    fn add(&mut self, name: &str, rendered: &[[f32; 3]], photo: &Picture, masked: bool) -> bool {
        let name = name.to_owned();
        if masked && !keeps_any(photo) {
            self.masked_out.push(name);
            return false;
        }
        let (psnr, ssim) = compare(rendered, photo, masked);
        self.views.push(ViewScore { name, psnr, ssim });
        true
    }

    /// Mean over the views, in dB.
    pub fn psnr(&self) -> Option<f64> {
        mean(self.views.iter().map(|view| view.psnr).collect())
    }

    /// Mean over the views that have it.
    pub fn ssim(&self) -> Option<f64> {
        mean(self.views.iter().filter_map(|view| view.ssim).collect())
    }

    pub fn to_json(&self) -> Value {
        json!({
            "run": self.run,
            "step": self.step,
            "appearance": self.appearance,
            "psnr": self.psnr(),
            "ssim": self.ssim(),
            "views": self
                .views
                .iter()
                .map(|view| json!({ "name": view.name, "psnr": view.psnr, "ssim": view.ssim }))
                .collect::<Vec<_>>(),
            "masked_out": self.masked_out,
        })
    }

    pub fn text(&self) -> String {
        let in_words = |ssim: Option<f64>| {
            ssim.map_or("too small for SSIM".into(), |ssim| format!("{ssim:.4}"))
        };
        let names = self.views.iter().map(|view| &view.name);
        let widths = names.chain(&self.masked_out).map(String::len);
        let width = widths.max().unwrap_or(0);
        let mut text = String::new();
        for ViewScore { name, psnr, ssim } in &self.views {
            let _ = writeln!(text, "{name:<width$}  {psnr:6.2} dB  {}", in_words(*ssim));
        }
        for name in &self.masked_out {
            let _ = writeln!(text, "{name:<width$}  masked out");
        }
        let _ = match self.psnr() {
            Some(psnr) => write!(
                text,
                "{:<width$}  {psnr:6.2} dB  {}",
                "mean",
                in_words(self.ssim())
            ),
            None => write!(text, "no mean: the masks keep nothing of any view"),
        };
        text
    }
}

fn mean(present: Vec<f64>) -> Option<f64> {
    (!present.is_empty()).then(|| present.iter().sum::<f64>() / present.len() as f64)
}

/// Renders views of a run with the appearance code that `at_eval` or else its settings say, and compares them with their
/// photographs. `show` gets every pair; all of them at once might not fit into memory.
///
/// # Errors
/// Those of reading run and dataset; `Config` if there are no such views, or some have no code of the kind that is asked for; whatever the
/// device fails with.
pub(in crate::cli) fn score(
    run: &Path,
    dataset: Option<&Path>,
    which: Which,
    at_eval: Option<AppearanceAtEval>,
    context: &Context,
    show: &mut dyn FnMut(Rendered, Picture),
) -> anyhow::Result<PictureScores> {
    let run = RunDirectory::open(run)?;
    let gpu = context.gpu()?;
    let trained = Trained::open(&gpu, &run)?;
    let appearance = at_eval.unwrap_or(trained.config().appearance.at_eval);
    for refused in &trained.refused {
        context.warn(&refused.to_string());
    }
    let scene = trained.record.open(dataset, trained.config())?;
    let wanted = which.of(&scene);
    if wanted.is_empty() {
        return Err(Error::Config {
            what: format!(
                "{}: there are no such views; {} were trained with\n  next: --split train, or a run with a --holdout of at most half the views",
                run.root().display(),
                scene.split(Split::Train).count()
            ),
        }
        .into());
    }
    let strangers = wanted
        .iter()
        .filter(|&&view| scene.views[view].split != Split::Train);
    let strangers = strangers.count();
    if at_eval == Some(AppearanceAtEval::Frame)
        && trained.config().appearance.dims > 0
        && strangers > 0
    {
        return Err(Error::Config {
            what: format!(
                "--appearance frame: {strangers} of {} views were not trained with, and have no code of their own\n  next: --split train, or \
                 --appearance zero or mean",
                wanted.len()
            ),
        }
        .into());
    }
    let viewer = trained.viewer(&scene, appearance)?;
    let interrupted = interrupt::flag(context, "stopping")?;
    let masked = trained.config().scene.masks.reads();
    let mut progress = Progress::new(context, "eval", 100 * wanted.len() as u64);
    let mut scores = PictureScores {
        run: run.root().into(),
        step: trained.step,
        appearance,
        views: Vec::new(),
        masked_out: Vec::new(),
    };
    for (nth, &view) in wanted.iter().enumerate() {
        let name = &scene.views[view].name;
        let rendered = viewer.render(&scene, view, &mut |share| {
            progress.at(100 * nth as u64 + (100.0 * share) as u64, name);
            !interrupted.load(Ordering::SeqCst)
        })?;
        let picture = scene.load_picture(view)?;
        if !scores.add(name, &rendered.rgb, &picture, masked) {
            context.warn(&format!(
                "{name}: its mask keeps no pixel to compare, so that it has no scores and no part in the mean"
            ));
        }
        show(rendered, picture);
    }
    Ok(scores)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_view_that_is_masked_out_has_no_part_in_the_mean() {
        let mut scores = PictureScores {
            run: "run".into(),
            step: 1,
            appearance: AppearanceAtEval::Zero,
            views: Vec::new(),
            masked_out: Vec::new(),
        };
        let photo = |alpha| Picture {
            width: 1,
            height: 1,
            rgba: vec![102, 102, 102, alpha],
        };
        let rendered = [[0.5; 3]];
        assert!(!scores.add("hidden", &rendered, &photo(0), true));
        assert_eq!(scores.psnr(), None);
        assert!(scores.text().ends_with("nothing of any view"));
        assert!(scores.add("shown", &rendered, &photo(255), true));
        assert!(scores.add("ignored", &rendered, &photo(0), false));
        assert!((scores.psnr().unwrap() - 20.0).abs() < 1e-3);
        assert_eq!(scores.to_json()["masked_out"], json!(["hidden"]));
        assert!(scores.text().contains("hidden   masked out\n"));
    }
}
