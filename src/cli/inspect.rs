//! `neurodin inspect`: what a dataset holds, what was left out and why, and the region that would be reconstructed.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::path::PathBuf;

use clap::Args;
use serde_json::{Value, json};

use super::Context;
use super::chosen::{Chosen, open_scene};
use super::scene_args::SceneArgs;
use super::settings::SettingsArgs;
use super::suggestion::Suggestion;
use crate::Error;
use crate::scene::{Facing, Region, RegionShape, Scene, Split, write_preview};

/// Say what a dataset holds, what was skipped, and which region would be reconstructed
#[derive(Args, Clone, Debug)]
#[command(after_help = "Examples:
  neurodin inspect photos/
  neurodin inspect photos/ --preview preview.ply
  neurodin inspect photos/ --center 0,0,0.6 --radius 1.35 --json")]
pub struct InspectArgs {
    /// Directory of the dataset, its transforms.json, meta_data.json or cameras_sphere.npz, or the directory of a COLMAP model
    pub dataset: PathBuf,
    /// Write cameras, points and region to this PLY file
    #[arg(long, value_name = "FILE")]
    pub preview: Option<PathBuf>,
    /// Replace the preview if it exists
    #[arg(long)]
    pub force: bool,
    /// The preset whose region to show; without it the one that `train` would take
    #[arg(long, value_name = "NAME", env = "NEURODIN_PRESET")]
    pub preset: Option<String>,
    #[command(flatten)]
    pub scene: SceneArgs,
}

/// Opens the dataset, reports on it and writes the preview.
pub(super) fn run(args: &InspectArgs, context: &Context) -> anyhow::Result<()> {
    if let Some(preview) = args
        .preview
        .as_ref()
        .filter(|preview| preview.exists() && !args.force)
    {
        return Err(Error::Output {
            path: preview.clone(),
            what: "exists already".into(),
            next: "name another file, or replace it with --force".into(),
        }
        .into());
    }
    // As `train` would open it, for the region that it would take.
    let settings = SettingsArgs {
        preset: args.preset.clone(),
        ..SettingsArgs::default()
    };
    let scene = open_scene(&settings, &args.scene, &args.dataset)?;
    let suggestion = Suggestion::for_scene(&scene, &args.scene)?;
    let Chosen { region, .. } = Chosen::of(&settings, &args.scene, &scene)?;
    if let Some(preview) = &args.preview {
        write_preview(&scene, &region, preview)?;
    }
    let report = report(&scene, &suggestion, &region, args.preview.as_ref());
    let text = as_text(&scene, &suggestion, &region, args.preview.as_ref());
    context.result(&report, &text)?;
    Ok(())
}

/// Views counted by the model and size of their cameras.
fn cameras(scene: &Scene) -> BTreeMap<(&'static str, u32, u32), usize> {
    let mut counts = BTreeMap::new();
    for view in &scene.views {
        let camera = &view.camera;
        *counts
            .entry((camera.model.name(), camera.width, camera.height))
            .or_default() += 1;
    }
    counts
}

fn report(
    scene: &Scene,
    suggestion: &Suggestion,
    region: &Region,
    preview: Option<&PathBuf>,
) -> Value {
    let cameras: Vec<Value> = cameras(scene)
        .into_iter()
        .map(|((model, width, height), views)| json!({"model": model, "width": width, "height": height, "views": views}))
        .collect();
    json!({
        "root": scene.root,
        "format": scene.format,
        "views": {
            "train": scene.split(Split::Train).count(),
            "test": scene.split(Split::Test).count(),
        },
        "cameras": cameras,
        "points": scene.points.len(),
        "looks": suggestion.looks,
        "beyond": suggestion.beyond,
        "presets": suggestion.kind(),
        "suggested": { "preset": suggestion.preset(), "settings": suggestion.settings() },
        "region": region,
        "inside": {
            "cameras": region.cameras_inside(scene),
            "points": region.points_inside(scene),
        },
        "skipped": scene.skipped,
        "notes": scene.notes,
        "warnings": suggestion.warnings(scene, region),
        "preview": preview,
    })
}

fn as_text(
    scene: &Scene,
    suggestion: &Suggestion,
    region: &Region,
    preview: Option<&PathBuf>,
) -> String {
    let mut text = String::new();
    let mut row = |name: &str, value: String| {
        let _ = writeln!(text, "{name:<10} {value}");
    };
    let (train, test) = (
        scene.split(Split::Train).count(),
        scene.split(Split::Test).count(),
    );
    row(
        "dataset",
        format!("{}, {}", scene.root.display(), scene.format),
    );
    row("views", format!("{train} to train on, {test} held out"));
    for ((model, width, height), views) in cameras(scene) {
        row("camera", format!("{model} {width}x{height}, {views} views"));
    }
    row("points", format!("{}", scene.points.len()));
    let looks = &suggestion.looks;
    let facing = match looks.facing {
        Facing::Inward => "inwards, at an object or building",
        Facing::Outward => "outwards, from within a room",
    };
    row("look", format!("{facing}: {}", looks.why));
    if let Some(beyond) = &suggestion.beyond {
        let what = match beyond.runs_on {
            true => "ground and surroundings run on",
            false => "an even backdrop",
        };
        row("beyond", format!("{what}: {}", beyond.why));
    }
    let settings: Vec<String> = suggestion
        .settings()
        .iter()
        .map(|setting| format!(" --set {setting}"))
        .collect();
    let (kind, preset) = (suggestion.kind(), suggestion.preset());
    row(
        "suggested",
        format!(
            "{kind} presets: --preset {preset}{}, or {kind}-large on a GPU",
            settings.concat()
        ),
    );
    let (center, radius) = (region.center, region.radius);
    let shape = match region.shape {
        RegionShape::Sphere => format!("sphere, radius {radius:.6}"),
        RegionShape::Box { half } => format!("box, half extents {:.6}", half * radius),
    };
    row("region", format!("{shape}, centre {center:.6}"));
    row("", format!("from {}", region.how));
    row(
        "inside",
        format!(
            "{} of {} cameras, {} of {} points",
            region.cameras_inside(scene),
            scene.views.len(),
            region.points_inside(scene),
            scene.points.len()
        ),
    );
    // A long list of the same reason is said once.
    const LISTED: usize = 10;
    for skipped in scene.skipped.iter().take(LISTED) {
        row("skipped", format!("{}: {}", skipped.what, skipped.why));
    }
    if scene.skipped.len() > LISTED {
        row(
            "",
            format!(
                "and {} more; --json lists them all",
                scene.skipped.len() - LISTED
            ),
        );
    }
    for note in &scene.notes {
        row("note", note.clone());
    }
    for warning in suggestion.warnings(scene, region) {
        row("warning", warning);
    }
    if let Some(preview) = preview {
        row("preview", format!("{}", preview.display()));
    }
    text
}
